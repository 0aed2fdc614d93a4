"""A set of transients in one HDF5 file, small enough to carry to where a network is trained. No renderer, no OpenEXR.

Numbers are rounded to steps far below what a sensor resolves, so that they compress: paths to 2^-9 m (2 mm), depths
to 2^-12 m (0.24 mm), radiances to 2^(1/125) (0.55 %), ambient light to 2^(1/16), albedo to 1/255. Normals and error
estimates stay behind in the EXR files.
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

PATH_STEP_M, DEPTH_STEP_M = 2.0**-9, 2.0**-12
RADIANCE_STEPS, AMBIENT_STEPS = 125, 16  # per octave
FINER = 4  # an EXR file of a set keeps lengths in steps that much smaller
OCTAVES = 32  # below and above 1; codes are uint16, 0 is 0
NO_DEPTH = np.iinfo(np.int32).min
PER_VIEW = {"count": np.uint16, "depth": np.int32, "mixed": np.uint8, "albedo": np.uint8, "ambient": np.uint16}
PER_RETURN = {"near": np.int32, "width": np.uint16, "radiance": np.uint16, "bounces": np.uint8}
CHUNK = 1 << 16  # returns


@dataclass(frozen=True, eq=False)
class Pack:
    """A read pack: `len(pack)` views, `pack[i]` the i-th as a `Transient`, `metas[i]` its record.

    Normals and errors are 0. The compact arrays stay in memory as they are in the file; floats are made on demand.
    """

    arrays: dict[str, np.ndarray]
    starts: np.ndarray
    metas: tuple[dict, ...]

    def __len__(self) -> int:
        return len(self.metas)

    def __iter__(self) -> Iterator[Transient]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Transient:
        if not 0 <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        view = {name: self.arrays[name][index] for name in PER_VIEW}
        rows = slice(self.starts[index], self.starts[index + 1])
        near, width, radiance, bounces = (self.arrays[name][rows] for name in PER_RETURN)
        height, columns = view["count"].shape
        depth = np.where(view["depth"] == NO_DEPTH, np.nan, view["depth"] * DEPTH_STEP_M)
        near_m = (near * PATH_STEP_M).astype(np.float32)
        return Transient(
            height,
            columns,
            np.concatenate(([0], np.cumsum(view["count"].ravel(), dtype=np.int64))),
            near_m,
            np.maximum(((near + width.astype(np.int32)) * PATH_STEP_M).astype(np.float32), near_m),
            _decoded(radiance, RADIANCE_STEPS),
            bounces,
            depth_m=depth.astype(np.float32),
            normal=np.zeros((height, columns, 3), np.float16),
            albedo=(view["albedo"] / 255).astype(np.float16),
            ambient=_decoded(view["ambient"], AMBIENT_STEPS),
            mixed=view["mixed"].astype(bool),
            error=np.zeros((height, columns), np.float32),
            meta=self.metas[index],
        )


def rounded(view: Transient) -> Transient:
    """The transient rounded for a smaller EXR file: lengths in quarter steps of a pack, radiances of 11 bits, ambient
    light and errors of 8, normals in steps of 1/256."""

    def stepped(lengths: np.ndarray, step: float) -> np.ndarray:
        return (np.rint(lengths.astype(np.float64) / step) * step).astype(np.float32)

    return replace(
        view,
        path_near_m=stepped(view.path_near_m, PATH_STEP_M / FINER),
        path_far_m=stepped(view.path_far_m, PATH_STEP_M / FINER),
        depth_m=stepped(view.depth_m, DEPTH_STEP_M / FINER),
        normal=(np.rint(view.normal.astype(np.float32) * 256) / 256).astype(np.float16),
        radiance=_short(view.radiance, 11),
        ambient=_short(view.ambient, 8),
        error=_short(view.error, 8),
    )


def _short(values: np.ndarray, bits: int) -> np.ndarray:
    """float32 rounded to that many bits of mantissa."""
    mantissa, exponent = np.frexp(values.astype(np.float64))
    return np.ldexp(np.rint(np.ldexp(mantissa, bits)), exponent - bits).astype(np.float32)


def _encoded(values: np.ndarray, steps: int) -> np.ndarray:
    """Values as uint16 on a scale of `steps` per octave, from 2^-32 to 2^32; 0 stays 0."""
    with np.errstate(divide="ignore"):
        code = np.rint((np.log2(values, dtype=np.float64) + OCTAVES) * steps)
    return np.where(values > 0, np.clip(code, 1, 65535), 0).astype(np.uint16)


def _decoded(codes: np.ndarray, steps: int) -> np.ndarray:
    value = np.exp2(codes / steps - OCTAVES)
    return np.where(codes > 0, value, 0).astype(np.float32)


def _arrays(view: Transient) -> dict[str, np.ndarray]:
    """A transient in the pack's whole numbers."""
    near = np.rint(view.path_near_m.astype(np.float64) / PATH_STEP_M)
    far = np.rint(view.path_far_m.astype(np.float64) / PATH_STEP_M)
    depth = np.where(np.isnan(view.depth_m), NO_DEPTH, np.rint(np.nan_to_num(view.depth_m) / DEPTH_STEP_M))
    limits = (("path", near, 2**30), ("width of a return", far - near, 65535), ("depth", depth, 2**30))
    for name, values, most in limits:
        require(
            bool(values.size == 0 or values.max() <= most), f"{name} of {values.max(initial=0):g} steps is over {most}"
        )
    counts = np.diff(view.offsets).reshape(view.height, view.width)
    require(bool(counts.max() <= 65535), f"{counts.max()} returns in one pixel, a pack holds 65535")
    return {
        "count": counts,
        "depth": depth,
        "mixed": view.mixed,
        "albedo": np.rint(np.clip(view.albedo.astype(np.float64), 0, 1) * 255),
        "ambient": _encoded(view.ambient, AMBIENT_STEPS),
        "near": near,
        "width": far - near,
        "radiance": _encoded(view.radiance, RADIANCE_STEPS),
        "bounces": view.bounces,
    }


def write_pack(views: Iterable[tuple[Transient, dict]], path: Path) -> int:
    """Write views of one image size, each with the record that `Pack.metas` is to give back; returns how many.

    One view is in memory at a time. Raises InputError for views of different sizes, or none.
    """
    metas: list[dict] = []
    starts = [0]
    sha = hashlib.sha256()
    with whole_file(path) as beside, h5py.File(beside, "w", track_order=False) as file:
        sets: dict[str, h5py.Dataset] = {}
        for view, meta in views:
            arrays = _arrays(view)
            if not sets:
                sets = _datasets(file, view.height, view.width)
            same = arrays["count"].shape == sets["count"].shape[1:]
            require(same, f"view {len(metas)} is {view.width} x {view.height} pixels, those before it are not")
            for name, dtype in PER_VIEW.items():
                value = arrays[name].astype(dtype)
                sets[name].resize(len(metas) + 1, axis=0)
                sets[name][len(metas)] = value
                sha.update(np.ascontiguousarray(value).tobytes())
            for name, dtype in PER_RETURN.items():
                value = arrays[name].astype(dtype)
                sets[name].resize(starts[-1] + len(value), axis=0)
                sets[name][starts[-1] :] = value
                sha.update(np.ascontiguousarray(value).tobytes())
            starts.append(starts[-1] + view.returns)
            metas.append(meta)
        require(bool(metas), "there is no view to pack")
        file.create_dataset("start", data=np.array(starts, np.int64), track_times=False)
        file.create_dataset("meta", data=[json.dumps(m, sort_keys=True) for m in metas], track_times=False)
        sha.update(json.dumps(metas, sort_keys=True).encode())
        file.attrs[ATTRIBUTE] = seal({"views": len(metas)}, "pack", sha.hexdigest())
    return len(metas)


def _datasets(file: h5py.File, height: int, width: int) -> dict[str, h5py.Dataset]:
    packed = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "track_times": False}
    sets = {
        name: file.create_dataset(
            name, (0, height, width), dtype, maxshape=(None, height, width), chunks=(16, height, width), **packed
        )
        for name, dtype in PER_VIEW.items()
    }
    sets |= {
        name: file.create_dataset(name, (0,), dtype, maxshape=(None,), chunks=(CHUNK,), **packed)
        for name, dtype in PER_RETURN.items()
    }
    return sets


def read_pack(path: Path) -> Pack:
    """Read a pack whole and check it: schema, shapes, and the SHA-256 over all arrays and records.

    Raises InputError in one line for a missing, foreign, truncated or altered file, or one of a newer schema.
    """
    path = Path(path)
    require(path.is_file(), f"{path}: file not found")
    try:
        with h5py.File(path, "r") as file:
            require(ATTRIBUTE in file.attrs, f"no pack of scene2spad (no attribute {ATTRIBUTE})")
            meta, sha256 = open_seal(file.attrs[ATTRIBUTE], "pack")
            arrays = {name: np.asarray(file[name][:], dtype) for name, dtype in (PER_VIEW | PER_RETURN).items()}
            starts = np.asarray(file["start"][:], np.int64)
            metas = tuple(json.loads(text) for text in file["meta"].asstr()[:])
        rises = len(starts) == len(metas) + 1 and starts[0] == 0 and bool((np.diff(starts) >= 0).all())
        require(rises, "its views do not fit its returns")
        check_seal(meta, sha256, _sha256(arrays, starts, metas))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:
        told = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a readable pack ({told or type(error).__name__})") from None
    for array in arrays.values():
        array.setflags(write=False)
    return Pack(arrays, starts, metas)


def _sha256(arrays: dict[str, np.ndarray], starts: np.ndarray, metas: tuple[dict, ...]) -> str:
    sha = hashlib.sha256()
    for i in range(len(metas)):
        for name in PER_VIEW:
            sha.update(np.ascontiguousarray(arrays[name][i]).tobytes())
        for name in PER_RETURN:
            sha.update(np.ascontiguousarray(arrays[name][starts[i] : starts[i + 1]]).tobytes())
    sha.update(json.dumps(list(metas), sort_keys=True).encode())
    return sha.hexdigest()
