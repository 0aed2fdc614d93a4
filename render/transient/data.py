"""`Transient`: what a camera's pixels see of a pulse, over path length, and its file. Imports no renderer.

One render serves every sensor: nothing here is tied to a bin width. The file is one multi-part OpenEXR. Its first part
is flat and all float32, since viewers open the first part, some in the type of its first channel; then a flat part of
other types, then the deep one (Z = near, ZBack = far, Y = radiance, bounces) with all metadata in one JSON attribute
`scene2spad`. Files of schema 1 had the deep part first and all layers in the other; parts are found by name.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from render.transient.exr_files import write_exr
from scenes.errors import InputError, require, require_kind, require_kinds, require_number, require_whole
from scenes.files import ATTRIBUTE, check_seal, open_seal, seal, silenced, whole_file
from scenes.json_types import JsonObject
from scenes.notebook import html_card
from scenes.offsets import LIMIT_M, check_delay

RETURN_FIELDS = {"path_near_m": "Z", "path_far_m": "ZBack", "radiance": "Y", "bounces": "bounces"}
FLAT_PARTS = {
    "layers": ("depth", "ambient", "error"),
    "surface": ("normal.X", "normal.Y", "normal.Z", "albedo", "mixed"),
}
ARRAYS = ("offsets", *RETURN_FIELDS, "depth_m", "normal", "albedo", "ambient", "mixed", "error")
LAYER_CHANNELS = ("depth", "normal.X", "normal.Y", "normal.Z", "albedo", "ambient", "mixed", "error")


@dataclass(frozen=True, eq=False, repr=False)
class Transient:
    """Per-pixel time-resolved radiance as a ragged list of returns, and flat layers beside it.

    offsets       (H*W + 1,) int64: the returns of pixel p are [offsets[p], offsets[p+1])
    path_near_m, path_far_m  (N,) float32: a return is uniform over this interval of optical path length, laser to
                  surface to camera; sorted by `path_near_m` within a pixel
    radiance      (N,) float32: radiance integrated over time, per joule emitted, pixel mean [1/(m^2 sr)]
    bounces       (N,) uint8: surfaces met (1 = direct; 2 of all indirect light but that of mirrors)
    depth_m       (H, W) float32: radial distance to the first opaque surface at the pixel centre, NaN for none
    normal        (H, W, 3) float16, world, toward the camera; albedo (H, W) float16 at the pixel centre
    ambient       (H, W) float32: steady spectral radiance [W/(m^2 sr nm)]
    mixed         (H, W) bool: surfaces more than 50 mm apart, or a surface and nothing, in one pixel
    error         (H, W) float32: estimated standard error of the pixel's total radiance by indirect light, from four
                  batches (3 degrees of freedom): one pixel in 250 is off by more than 8 of its own. Light that is
                  filtered has two, and so have 1 or 2 paths a pixel; 3 have three. Together batches are more even than
                  each alone: the error is up to a third smaller
    meta          scene, seed, plan, versions: anything JSON holds

    Raises InputError for fields of another kind, arrays of other types or shapes, and values that are no light.

    Examples
    --------
    A wall of albedo rho at d metres sends rho / (pi d^2) back, 0.5 / (4 pi) = 0.0398 at 2 m, on a path of 4 m. The
    returns of a pixel are a slice of the list:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> image = np.ones((3, 4))
    >>> transient = s2s.transient_from_rgbd(2.0 * image, 0.5 * image, 0.0 * image)  # depth [m], albedo, ambient light
    >>> pixel = slice(transient.offsets[5], transient.offsets[6])  # row 1, column 1
    >>> transient.path_near_m[pixel].tolist(), transient.radiance[pixel].astype(float).round(4).tolist()
    ([4.0], [0.0398])
    >>> float(transient.delayed(1.0).mean_path_m()[1, 1])  # 1 m farther, there and back
    6.0
    """

    height: int
    width: int
    offsets: np.ndarray
    path_near_m: np.ndarray
    path_far_m: np.ndarray
    radiance: np.ndarray
    bounces: np.ndarray
    depth_m: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    ambient: np.ndarray
    mixed: np.ndarray
    error: np.ndarray
    meta: JsonObject = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_kinds(self, "transient", meta=dict, **dict.fromkeys(ARRAYS, np.ndarray))
        for side in ("height", "width"):
            require_whole(getattr(self, side), f"transient: {side}")
        pixels, shape = self.height * self.width, (self.height, self.width)
        expected = {
            "offsets": (np.int64, (pixels + 1,)),
            "depth_m": (np.float32, shape),
            "normal": (np.float16, (*shape, 3)),
            "albedo": (np.float16, shape),
            "ambient": (np.float32, shape),
            "mixed": (np.bool_, shape),
            "error": (np.float32, shape),
        }
        returns = (int(self.offsets[-1]),) if len(self.offsets) else (0,)
        for name in ("path_near_m", "path_far_m", "radiance"):
            expected[name] = (np.float32, returns)
        expected["bounces"] = (np.uint8, returns)
        for name, (dtype, size) in expected.items():
            array = getattr(self, name)
            if array.dtype != dtype or array.shape != size:
                raise InputError(f"transient: {name} is {array.dtype}{array.shape}, expected {np.dtype(dtype)}{size}")
            frozen = array.view()  # the caller's own array can still be written to
            frozen.setflags(write=False)
            object.__setattr__(self, name, frozen)
        if self.offsets[0] != 0 or (np.diff(self.offsets) < 0).any():
            raise InputError("transient: offsets do not rise from 0")
        good = (
            np.isfinite(self.radiance) & (self.radiance >= 0) & np.isfinite(self.path_far_m) & (self.path_near_m >= 0)
        )
        good &= self.path_far_m >= self.path_near_m
        if not good.all():
            raise InputError(f"transient: {(~good).sum()} of {good.size} returns are negative, not finite or reversed")
        for name in ("depth_m", "ambient", "error"):
            layer = getattr(self, name)
            good = np.isfinite(layer) & (layer >= 0) | (np.isnan(layer) & (name == "depth_m"))
            if not good.all():
                row, column = np.argwhere(~good)[0]
                count, value = (~good).sum(), layer[row, column]
                raise InputError(
                    f"transient: {count} of {good.size} values of {name} are negative or not finite: {value:g} in row "
                    f"{row}, column {column}"
                )

    def __repr__(self) -> str:
        paths = f"paths {self.path_near_m.min():.3f} to {self.path_far_m.max():.3f} m, " if self.returns else ""
        return (
            f"Transient({self.meta.get('scene', 'unnamed')!r}, {self.height} x {self.width} pixels (rows x columns), "
            f"{self.returns} returns, {paths}{self.indirect_fraction:.1%} indirect)"
        )

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the facts, and the laser's light as a picture."""
        facts = {
            "scene": self.meta.get("scene", "unnamed"),
            "pixels": f"{self.height} rows x {self.width} columns",
            "returns": f"{self.returns:,}",
            "indirect light": f"{self.indirect_fraction:.1%}",
        }
        return html_card("Transient", facts, self.total_radiance())

    @property
    def returns(self) -> int:
        """Return the number N of returns of all pixels."""
        return len(self.radiance)

    @property
    def return_pixel(self) -> np.ndarray:
        """Return the flat pixel index of every return, (N,) int64."""
        return np.repeat(np.arange(self.height * self.width), np.diff(self.offsets))

    def total_radiance(self) -> np.ndarray:
        """Return the sum of the returns of each pixel [1/(m^2 sr)], (H, W) float64."""
        total = np.bincount(self.return_pixel, weights=self.radiance, minlength=self.height * self.width)
        return total.reshape(self.height, self.width)

    def mean_path_m(self) -> np.ndarray:
        """Return radiance-weighted mean optical path length of each pixel [m], (H, W) float64; NaN without returns."""
        centre = 0.5 * (self.path_near_m.astype(np.float64) + self.path_far_m)
        pixels = self.height * self.width
        moment = np.bincount(self.return_pixel, weights=self.radiance * centre, minlength=pixels)
        total = self.total_radiance().ravel()
        mean = np.divide(moment, total, out=np.full(pixels, np.nan), where=total > 0)
        return mean.reshape(self.height, self.width)

    @property
    def indirect_fraction(self) -> float:
        """Return the share of the summed radiance that met more than one surface."""
        total = float(self.radiance.sum(dtype=np.float64))
        return float(self.radiance[self.bounces > 1].sum(dtype=np.float64)) / total if total > 0 else 0.0

    def delayed(self, offset_m: float) -> Transient:
        """Return the same scene `offset_m` farther in time alone (a `time` offset): paths + 2 offset, depth + offset.

        offset_m: metres; a negative one brings it nearer, at most until the nearest return or surface is at the
        laser. Raises InputError for other offsets, for what is no number, and with a displaced laser, for which a
        delay is no distance.
        """
        offset_m = require_number(offset_m, "time offset")
        check_delay(self.meta.get("laser", {}).get("baseline_m", ()))
        depth_m = np.fmin.reduce(self.depth_m, axis=None, initial=LIMIT_M)
        least = -min(float(self.path_near_m.min(initial=2 * LIMIT_M)) / 2, float(depth_m))
        require(least <= offset_m <= LIMIT_M, f"time offset {offset_m:g} m is outside {least:g} to {LIMIT_M:g}")
        return replace(
            self,
            path_near_m=self.path_near_m + np.float32(2 * offset_m),
            path_far_m=self.path_far_m + np.float32(2 * offset_m),
            depth_m=self.depth_m + np.float32(offset_m),
            meta={**self.meta, "time_offset_m": self.meta.get("time_offset_m", 0.0) + offset_m},
        )

    def sha256(self) -> str:
        """Return SHA-256 over all arrays, in the order of the fields."""
        sha = hashlib.sha256(f"{self.height}x{self.width}".encode())
        for name in (*RETURN_FIELDS, "offsets", "depth_m", "normal", "albedo", "ambient", "mixed", "error"):
            sha.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return sha.hexdigest()


def write_transient(transient: Transient, path: Path) -> None:
    """Write the multi-part EXR, whole or not at all. Raises InputError for another ending than .exr, and where the path
    cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=4, height=3, bounces=1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     s2s.write_transient(transient, folder + "/plane.exr")
    ...     s2s.read_transient(folder + "/plane.exr").meta["scene"]
    'plane'
    """
    require_kind(transient, Transient, "write_transient")
    require(isinstance(path, str | os.PathLike), f"write_transient: expected a path, not {type(path).__name__}")
    require(Path(path).suffix.lower() == ".exr", f"{path}: a transient ends in .exr")
    with whole_file(path) as beside:
        _write_exr(transient, beside)


def exr_bytes(transient: Transient) -> bytes:
    """Return what `write_transient` writes.

    OpenEXR writes to paths alone. On Linux that of a file without a name, which no killed process can leave behind.
    """
    if not hasattr(os, "memfd_create"):
        with tempfile.TemporaryDirectory(prefix="scene2spad-") as folder:
            _write_exr(transient, Path(folder) / "transient.exr")
            return (Path(folder) / "transient.exr").read_bytes()
    with os.fdopen(os.memfd_create("transient.exr"), "rb") as file:
        _write_exr(transient, Path(f"/proc/self/fd/{file.fileno()}"))
        return file.read()


def _write_exr(transient: Transient, path: Path) -> None:
    """Write the multi-part EXR; OSError where that fails."""
    import OpenEXR

    deep = {
        channel: OpenEXR.Channel(channel, _ragged(getattr(transient, name), transient))
        for name, channel in RETURN_FIELDS.items()
    }
    normal = np.moveaxis(transient.normal, -1, 0)
    values = (transient.depth_m, *normal, transient.albedo, transient.ambient, transient.mixed, transient.error)
    flat = {
        name: OpenEXR.Channel(name, np.ascontiguousarray(value.astype(np.uint32) if value.dtype == bool else value))
        for name, value in zip(LAYER_CHANNELS, values, strict=True)
    }
    deep_header = {
        "type": OpenEXR.deepscanline,
        "compression": OpenEXR.ZIPS_COMPRESSION,
        ATTRIBUTE: seal(transient.meta, "transient", transient.sha256()),
    }
    flat_header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    parts = [
        OpenEXR.Part(dict(flat_header), {channel: flat[channel] for channel in channels}, name)
        for name, channels in FLAT_PARTS.items()
    ]
    parts.append(OpenEXR.Part(deep_header, deep, "transient"))
    write_exr(OpenEXR.File(parts), path)


def _ragged(values: np.ndarray, transient: Transient) -> np.ndarray:
    """Arrange each pixel's values in an (H, W) object array, None where a pixel has none: what OpenEXR takes as deep
    samples."""
    if values.dtype == np.uint8:
        values = values.astype(np.uint32)
    cells = np.empty(transient.height * transient.width, dtype=object)
    counts = np.diff(transient.offsets)
    for count in np.unique(counts[counts > 0]):
        pixels = np.flatnonzero(counts == count)
        rows = values[transient.offsets[pixels, None] + np.arange(count)]
        cells[pixels] = np.fromiter(rows, dtype=object, count=len(pixels))
    if cells[0] is None:
        cells[0] = values[:0]  # OpenEXR needs one array to learn the type from, also where no pixel has a return
    return cells.reshape(transient.height, transient.width)


def read_transient(path: Path) -> Transient:
    """Read a transient and check parts, channels, counts and hash.

    Raises InputError in one line for a missing, foreign, truncated or altered file, or one of a newer schema.

    Examples
    --------
    What is read is what was written, to the last bit:

    >>> import tempfile
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=4, height=3, bounces=1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     s2s.write_transient(transient, folder + "/plane.exr")
    ...     s2s.read_transient(folder + "/plane.exr").sha256() == transient.sha256()
    True
    """
    import OpenEXR

    require(isinstance(path, str | os.PathLike), f"read_transient: expected a path, not {type(path).__name__}")
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: file not found")
    try:
        # OpenEXR reports damage on stdout and returns what it could read
        with silenced(), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = {part.name(): part for part in file.parts}
            headers = {name: dict(part.header) for name, part in parts.items()}
            channels = {name: {k: c.pixels for k, c in part.channels.items()} for name, part in parts.items()}
    except Exception as error:  # OpenEXR raises bare exceptions of its own
        raise InputError(f"{path}: not a readable EXR file ({' '.join(str(error).split())[:120]})") from None
    if ATTRIBUTE not in headers.get("transient", {}) or "layers" not in channels:
        raise InputError(
            f"{path}: no transient of scene2spad, or a truncated one (parts: {', '.join(parts) or 'none'})"
        )
    try:
        meta, sha256 = open_seal(headers["transient"][ATTRIBUTE], "transient")
        flat = channels["layers"] | channels.get("surface", {})
        missing = {*RETURN_FIELDS.values()} - {*channels["transient"]} | {*LAYER_CHANNELS} - {*flat}
        if missing:
            raise InputError(f"channels {', '.join(sorted(missing))} are missing")
        transient = _assemble(channels["transient"], flat)
        return replace(transient, meta=check_seal(meta, sha256, transient.sha256()))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (TypeError, ValueError, AttributeError, MemoryError) as error:
        raise InputError(f"{path}: damaged, {type(error).__name__} {' '.join(str(error).split())[:120]}") from None


def _assemble(deep: dict[str, np.ndarray], flat: dict[str, np.ndarray]) -> Transient:
    height, width = flat["depth"].shape
    sizes = np.zeros(height * width, dtype=np.int64)
    columns = {}
    for name, channel in RETURN_FIELDS.items():
        cells = deep[channel].ravel()
        sizes = np.fromiter((0 if cell is None else len(cell) for cell in cells), np.int64, len(cells))
        dtype = np.uint8 if name == "bounces" else np.float32
        parts = [cell for cell in cells if cell is not None]
        columns[name] = np.concatenate(parts).astype(dtype) if parts else np.empty(0, dtype)
    if len(sizes) != height * width or len({len(column) for column in columns.values()}) != 1:
        raise InputError("its parts differ in size")
    return Transient(
        height=height,
        width=width,
        offsets=np.concatenate(([0], np.cumsum(sizes))).astype(np.int64),
        **columns,  # type: ignore[arg-type]  # names and types of the file's columns, checked above
        depth_m=flat["depth"],
        normal=np.stack([flat[f"normal.{axis}"] for axis in "XYZ"], axis=-1),
        albedo=flat["albedo"],
        ambient=flat["ambient"],
        mixed=flat["mixed"].astype(bool),
        error=flat["error"],
    )
