"""A set of transients in one HDF5 file, small enough to carry to where a network is trained. No renderer, no OpenEXR.

Numbers are rounded to steps far below what a sensor resolves, so that they compress: centres of returns to 2^-10 m of
path (error at most 0.49 mm), their widths to 2^-8 m (2 mm), depths to 2^-12 m (0.12 mm), radiances to 2^(1/125)
(0.28 %), ambient light to 2^(1/4) (9 %), albedo to 1/255. Normals and error estimates stay behind in the EXR files.
The file holds differences: of depths from the plane through their neighbours, of centres from twice the depth or the
pixel's return before, of radiances from the return before.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from render.transient import Transient
from scenes.errors import InputError, require
from scenes.files import ATTRIBUTE, check_seal, open_seal, seal, whole_file
from scenes.io.hdf5 import Sink, add_checksum, describe, new_hdf5, open_checked, read_dataset
from scenes.io.inputs import parse_json
from scenes.json_types import JsonObject

PATH_STEP_M, WIDTH_STEP_M, DEPTH_STEP_M = 2.0**-10, 2.0**-8, 2.0**-12
RADIANCE_STEPS, AMBIENT_STEPS = 125, 4  # per octave
EXR_STEP_DIVISOR = 4  # an EXR file of a set keeps lengths in steps that much smaller
OCTAVES = 32  # below and above 1; codes are uint16, 0 is 0
NO_DEPTH = 0
PER_VIEW = {"count": np.uint16, "depth": np.int32, "mixed": np.uint8, "albedo": np.uint8, "ambient": np.uint16}
PER_RETURN = {"centre": np.int32, "width": np.uint16, "radiance": np.uint16, "bounces": np.uint8}
# the first returns of pixels, and further ones, compress better apart
PARTS = ("first", "further")
# differences have their sign in the lowest bit
STORED_VIEW, STORED = PER_VIEW | {"depth": np.uint32}, PER_RETURN | {"centre": np.uint32}
CHUNK = 1 << 16  # returns
# `%g` would cut a step's digits off, and nothing but these attributes tells another program how to read the codes
LOGARITHMIC = f"code c > 0 is 2^(c / {{steps}} - {OCTAVES}), 0 is 0"
NOTES = {  # unit and description of every dataset of the file
    "count": ("1", "returns of the pixel, view x row x column"),
    "depth": (f"{DEPTH_STEP_M} m", "radial depth, as difference from the plane through its neighbours; sign lowest"),
    "mixed": ("1", "whether the pixel sees surfaces more than 50 mm apart"),
    "albedo": ("1/255", "diffuse reflectance at the pixel's centre"),
    "ambient": ("W/(m^2 sr nm)", f"steady spectral radiance: {LOGARITHMIC.format(steps=AMBIENT_STEPS)}"),
    "start": ("1", "returns of view v are start[v] to start[v + 1]"),
    "meta": ("1", "JSON of every view's record, UTF-8"),
}
OF_RETURNS = {
    "centre": (f"{PATH_STEP_M} m", "middle of the interval of path length, as difference; sign lowest"),
    "width": (f"{WIDTH_STEP_M} m", "length of the interval of path length"),
    "radiance": ("1/(m^2 sr)", f"per joule: {LOGARITHMIC.format(steps=RADIANCE_STEPS)}; kept as difference of codes"),
    "bounces": ("1", "surfaces met, 1 for direct light"),
}
NOTES |= {f"{part} {name}": note for part in PARTS for name, note in OF_RETURNS.items()}
PACKED = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "track_times": False}


@dataclass(frozen=True, eq=False)
class ViewPack:
    """A read pack: `len(pack)` views, `pack[i]` the i-th as a `Transient`, `metas[i]` its record.

    Normals and errors are 0. The compact arrays stay in memory as they are in the file; floats are made on demand.
    """

    arrays: dict[str, np.ndarray]
    starts: np.ndarray
    metas: tuple[JsonObject, ...]

    def __len__(self) -> int:
        return len(self.metas)

    def __iter__(self) -> Iterator[Transient]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Transient:
        if not 0 <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        view = {name: self.arrays[name][index] for name in PER_VIEW}
        rows = slice(self.starts[index], self.starts[index + 1])
        centre, width, radiance, bounces = (self.arrays[name][rows] for name in PER_RETURN)
        height, columns = view["count"].shape
        near_m, far_m = _interval(centre, width)
        return Transient(
            height,
            columns,
            np.concatenate(([0], np.cumsum(view["count"].ravel(), dtype=np.int64))),
            near_m,
            far_m,
            _decoded(radiance, RADIANCE_STEPS),
            bounces,
            depth_m=np.where(view["depth"] == NO_DEPTH, np.nan, view["depth"] * DEPTH_STEP_M).astype(np.float32),
            normal=np.zeros((height, columns, 3), np.float16),
            albedo=(view["albedo"] / 255).astype(np.float16),
            ambient=_decoded(view["ambient"], AMBIENT_STEPS),
            mixed=view["mixed"].astype(bool),
            error=np.zeros((height, columns), np.float32),
            meta=self.metas[index],
        )


def _interval(centre: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle, half = centre * PATH_STEP_M, width * (WIDTH_STEP_M / 2)
    return np.maximum(middle - half, 0).astype(np.float32), (middle + half).astype(np.float32)


def rounded(view: Transient) -> Transient:
    """Return the transient rounded for a smaller EXR file: lengths in quarter steps of a pack, radiances of 11 bits,
    ambient light and errors of 8, normals in steps of 1/256."""

    def stepped(lengths: np.ndarray, step: float) -> np.ndarray:
        return (np.rint(lengths.astype(np.float64) / step) * step).astype(np.float32)

    return replace(
        view,
        path_near_m=stepped(view.path_near_m, PATH_STEP_M / EXR_STEP_DIVISOR),
        path_far_m=stepped(view.path_far_m, PATH_STEP_M / EXR_STEP_DIVISOR),
        depth_m=stepped(view.depth_m, DEPTH_STEP_M / EXR_STEP_DIVISOR),
        normal=(np.rint(view.normal.astype(np.float32) * 256) / 256).astype(np.float16),
        radiance=_short(view.radiance, 11),
        ambient=_short(view.ambient, 8),
        error=_short(view.error, 8),
    )


def _short(values: np.ndarray, bits: int) -> np.ndarray:
    """Round to float32 with `bits` bits of mantissa."""
    mantissa, exponent = np.frexp(values.astype(np.float64))
    return np.ldexp(np.rint(np.ldexp(mantissa, bits)), exponent - bits).astype(np.float32)


def _encoded(values: np.ndarray, steps: int) -> np.ndarray:
    """Encode values as uint16 on a scale of `steps` per octave, from 2^-32 to 2^32; 0, and what is below, are 0."""
    with np.errstate(divide="ignore"):
        code = np.rint((np.log2(values, dtype=np.float64) + OCTAVES) * steps)
    return np.clip(code, 0, 65535).astype(np.uint16)


def _decoded(codes: np.ndarray, steps: int) -> np.ndarray:
    value = np.exp2(codes / steps - OCTAVES)
    return np.where(codes > 0, value, 0).astype(np.float32)


def _arrays(view: Transient) -> dict[str, np.ndarray]:
    """Convert a transient to the pack's whole numbers, in the types that they have in memory."""
    near, far = view.path_near_m.astype(np.float64), view.path_far_m.astype(np.float64)
    centre, width = np.rint((near + far) / (2 * PATH_STEP_M)), np.rint((far - near) / WIDTH_STEP_M)
    depth = depth_steps(view.depth_m)
    limits = (("path", centre, 2**30), ("width of a return", width, 65535), ("depth", depth, 2**30))
    for name, values, most in limits:
        require(
            bool(values.size == 0 or values.max() <= most), f"{name} of {values.max(initial=0):g} steps is over {most}"
        )
    counts = np.diff(view.offsets).reshape(view.height, view.width)
    require(bool(counts.max() <= 65535), f"{counts.max()} returns in one pixel, a pack holds 65535")
    order = np.lexsort((_interval(centre, width)[0], view.return_pixel))  # rounding may swap neighbours
    arrays = {
        "count": counts,
        "depth": depth,
        "mixed": view.mixed,
        "albedo": np.rint(np.clip(view.albedo.astype(np.float64), 0, 1) * 255),
        "ambient": _encoded(view.ambient, AMBIENT_STEPS),
        "centre": centre[order],
        "width": width[order],
        "radiance": _encoded(view.radiance, RADIANCE_STEPS)[order],
        "bounces": view.bounces[order],
    }
    return {name: arrays[name].astype(dtype) for name, dtype in (PER_VIEW | PER_RETURN).items()}


def depth_steps(depth_m: np.ndarray) -> np.ndarray:
    """Return depth in steps of DEPTH_STEP_M as a pack holds it, at least 1; NO_DEPTH for NaN. Float64, unbounded."""
    return np.where(np.isnan(depth_m), NO_DEPTH, np.maximum(np.rint(np.nan_to_num(depth_m) / DEPTH_STEP_M), 1))


def _is_first(counts: np.ndarray) -> np.ndarray:
    """Return for every return whether it is its pixel's first."""
    counts = counts.ravel().astype(np.int64)
    first = np.zeros(int(counts.sum()), bool)
    first[(np.cumsum(counts) - counts)[counts > 0]] = True
    return first


def _expected_centre(depth: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Predict the first return of each pixel that has one, in steps: twice the depth."""
    return (2 * depth.astype(np.int64) * DEPTH_STEP_M / PATH_STEP_M).astype(np.int64)[counts > 0]


def _unsigned(differences: np.ndarray) -> np.ndarray:
    return ((differences << 1) ^ (differences >> 63)).astype(np.uint32)


def _signed(stored: np.ndarray) -> np.ndarray:
    value = stored.astype(np.int64)
    return (value >> 1) ^ -(value & 1)


def _differences(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Encode a view for the file: differences from what is known already, and returns in two parts."""
    first = _is_first(arrays["count"])
    centre, radiance = arrays["centre"].astype(np.int64), arrays["radiance"]
    step = np.diff(centre, prepend=0)
    step[first] = centre[first] - _expected_centre(arrays["depth"], arrays["count"])
    rise = np.diff(radiance, prepend=np.uint16(0))  # modulo 2^16
    rise[first] = np.diff(radiance[first], prepend=np.uint16(0))
    columns = {**arrays, "centre": _unsigned(step), "radiance": rise}
    bent = np.diff(np.diff(arrays["depth"], axis=0, prepend=np.int32(0)), axis=1, prepend=np.int32(0))
    stored = {**arrays, "depth": _unsigned(bent.astype(np.int64))}
    for part, chosen in zip(PARTS, (first, ~first), strict=True):
        stored |= {f"{part} {name}": columns[name][chosen] for name in PER_RETURN}
    return stored


def _summed(stored: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Decode the whole numbers of a view from what the file holds of it; ValueError if its parts do not fit."""
    arrays = {name: stored[name] for name in PER_VIEW}
    arrays["depth"] = _signed(stored["depth"]).cumsum(axis=1).cumsum(axis=0).astype(np.int32)
    first = _is_first(arrays["count"])
    for name, dtype in STORED.items():
        arrays[name] = np.empty(len(first), dtype)
        for part, chosen in zip(PARTS, (first, ~first), strict=True):
            arrays[name][chosen] = stored[f"{part} {name}"]
    starts = np.flatnonzero(first)[np.cumsum(first) - 1]
    step = _signed(arrays["centre"])
    step[first] += _expected_centre(arrays["depth"], arrays["count"])
    rise = arrays["radiance"].astype(np.int64)
    rise[first] = np.cumsum(rise[first])
    for name, differences in (("centre", step), ("radiance", rise)):
        total = np.cumsum(differences)
        arrays[name] = (total - total[starts] + differences[starts]).astype(PER_RETURN[name])
    return arrays


def write_pack(views: Iterable[tuple[Transient, JsonObject]], path: Path) -> int:
    """Write views of one image size, each with the record that `ViewPack.metas` is to give back; returns how many.

    One view is in memory at a time. Raises InputError for views of different sizes, or none.
    """
    with whole_file(path) as beside:
        with new_hdf5(beside) as (file, sink):
            count = _append_views(views, file, sink)
        add_checksum(beside)
    return count


def _append_views(views: Iterable[tuple[Transient, JsonObject]], file: h5py.File, sink: Sink) -> int:
    """Append view after view, then their records and the seal; return the number of views."""
    metas: list[JsonObject] = []
    starts = [0]
    sha = hashlib.sha256()
    sets: dict[str, h5py.Dataset] = {}
    for view, meta in views:
        sink.check()
        arrays = _arrays(view)
        if not sets:
            sets = _datasets(file, view.height, view.width)
        same = arrays["count"].shape == sets["count"].shape[1:]
        require(same, f"view {len(metas)} is {view.width} x {view.height} pixels, those before it are not")
        stored = _differences(arrays)
        for name, dataset in sets.items():
            rows = stored[name][None] if name in PER_VIEW else stored[name]
            dataset.resize(len(dataset) + len(rows), axis=0)
            dataset[len(dataset) - len(rows) :] = rows
        for name in (*PER_VIEW, *PER_RETURN):
            sha.update(np.ascontiguousarray(arrays[name]).tobytes())
        starts.append(starts[-1] + view.returns)
        metas.append(meta)
    require(bool(metas), "there is no view to pack")
    file.create_dataset("start", data=np.array(starts, np.int64), track_times=False)
    records = json.dumps(metas, sort_keys=True).encode()
    file.create_dataset("meta", data=np.frombuffer(records, np.uint8), **PACKED)
    sha.update(records)
    describe(file, NOTES)
    file.attrs[ATTRIBUTE] = seal({"views": len(metas)}, "pack", sha.hexdigest())
    return len(metas)


def _datasets(file: h5py.File, height: int, width: int) -> dict[str, h5py.Dataset]:
    sets = {
        name: file.create_dataset(
            name, (0, height, width), dtype, maxshape=(None, height, width), chunks=(16, height, width), **PACKED
        )
        for name, dtype in STORED_VIEW.items()
    }
    sets |= {
        f"{part} {name}": file.create_dataset(
            f"{part} {name}", (0,), dtype, maxshape=(None,), chunks=(CHUNK,), **PACKED
        )
        for part in PARTS
        for name, dtype in STORED.items()
    }
    return sets


def _all_views(file: h5py.File) -> dict[str, np.ndarray]:
    """Read the whole numbers of all views of a pack, those of returns one after the other."""
    names = STORED_VIEW | {f"{part} {name}": dtype for part in PARTS for name, dtype in STORED.items()}
    stored = {name: np.asarray(read_dataset(file, name), dtype) for name, dtype in names.items()}
    counts = stored["count"].reshape(len(stored["count"]), -1)
    ends = {"first": (counts > 0).sum(axis=1).cumsum()}
    ends["further"] = counts.sum(axis=1, dtype=np.int64).cumsum() - ends["first"]
    views = []
    for i in range(len(counts)):
        view = {name: stored[name][i] for name in PER_VIEW}
        for part in PARTS:
            rows = slice(ends[part][i - 1] if i else 0, ends[part][i])
            view |= {f"{part} {name}": stored[f"{part} {name}"][rows] for name in STORED}
        views.append(_summed(view))
    arrays = {name: np.stack([view[name] for view in views]) for name in PER_VIEW}
    return arrays | {name: np.concatenate([view[name] for view in views]) for name in PER_RETURN}


def read_pack(path: Path) -> ViewPack:
    """Read a pack whole and check it: schema, shapes, and the SHA-256 over all arrays and records.

    Raises InputError in one line for a missing, foreign, truncated or altered file, or one of a newer schema.
    """
    path = Path(path)
    require(path.is_file(), f"{path}: file not found")
    try:
        with open_checked(path) as file:
            require(ATTRIBUTE in file.attrs, f"no pack of scene2spad (no attribute {ATTRIBUTE})")
            meta, sha256 = open_seal(file.attrs[ATTRIBUTE], "pack")
            arrays = _all_views(file)
            starts = np.asarray(read_dataset(file, "start"), np.int64)
            listed = parse_json(np.asarray(read_dataset(file, "meta"), np.uint8).tobytes())
            if not isinstance(listed, list):
                raise InputError("its metadata are no list")
            metas = tuple(listed)
        returns = arrays["count"].sum(axis=(1, 2), dtype=np.int64)
        fits = len(returns) == len(metas) and np.array_equal(starts, np.concatenate(([0], returns.cumsum())))
        require(fits, "its views do not fit its returns")
        check_seal(meta, sha256, _sha256(arrays, starts, metas))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (OSError, RuntimeError, KeyError, ValueError, IndexError, TypeError, AttributeError, MemoryError) as error:
        message = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a readable pack ({message or type(error).__name__})") from None
    for array in arrays.values():
        array.setflags(write=False)
    return ViewPack(arrays, starts, metas)


def _sha256(arrays: dict[str, np.ndarray], starts: np.ndarray, metas: tuple[JsonObject, ...]) -> str:
    sha = hashlib.sha256()
    for i in range(len(metas)):
        for name in PER_VIEW:
            sha.update(np.ascontiguousarray(arrays[name][i]).tobytes())
        for name in PER_RETURN:
            sha.update(np.ascontiguousarray(arrays[name][starts[i] : starts[i + 1]]).tobytes())
    sha.update(json.dumps(list(metas), sort_keys=True).encode())
    return sha.hexdigest()
