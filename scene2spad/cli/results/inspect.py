"""Say what is in a file of ours, and what one pixel of it holds."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from scene2spad.cli.opening import open_depth, open_histogram
from scene2spad.cli.paths import holds_kind, input_file
from scene2spad.options.common import Common, GivenFile, Positional, may_stay_open, only_for
from scenes.errors import InputError, require
from scenes.io.hdf5 import HDF5_SUFFIXES
from scenes.json_types import JsonObject
from scenes.progress import Progress

if TYPE_CHECKING:
    from render.transient import Transient
    from spad.measurements.histogram import Histogram

log = logging.getLogger("scene2spad")
KINDS = {".exr": ("transient", "depth"), **dict.fromkeys(HDF5_SUFFIXES, ("histogram", "pack"))}
DENSE_SUFFIXES = (".npz", *HDF5_SUFFIXES)
RANGES = {"path_m", "depth_m", "ambient_W_per_m2_sr_nm"}
MAX_LINES = 40  # of a pixel's table
BARS = " ▁▂▃▄▅▆▇█"
WIDTH = 64  # characters of a drawn histogram


@dataclass(frozen=True, kw_only=True)
class Inspect(Common):
    """Say what is in a file: kind, shape, units, sensor, seed, plan and ranges; with --pixel also that pixel's returns
    or counts. FILE is a transient (.exr of render), a histogram (.h5 of sense), a depth map (.exr of depth), a pack of
    a set (.h5 of dataset), dense arrays (.npz, .h5 of export), or a frame or capture of the published family (.mat)."""

    file: Positional[GivenFile]
    """The file."""
    pixel: Annotated[tuple[int, int] | None, may_stay_open("ROW COLUMN")] = None
    """Row and column of one pixel, both from 0, row 0 on top."""
    view: int = 0
    """View of a pack, from 0."""
    frame: int = 0
    """Frame of a capture (.mat), from 0."""


def run(command: Inspect, progress: Progress) -> dict:
    """Describe a file, and one pixel of it."""
    path = input_file(command.file)
    kind = _kind(path)
    captures = (kind == "histogram", "captures (.mat)")
    only_for(command, str(path), {"view": (kind == "pack", "a pack"), "frame": captures})
    if kind == "histogram":
        histogram = open_histogram(path, command.frame)
        found: JsonObject = {"kind": kind, **_of_histogram(histogram)}
        pixel = None if command.pixel is None else _counts_of(histogram, _checked(command, histogram.depth_m.shape))
    elif kind in ("dense", "depth"):
        found, pixel = (_dense if kind == "dense" else _depth)(command, path)
    else:
        found, transient = _transient(command, path, kind)
        shape = (transient.height, transient.width)
        pixel = None if command.pixel is None else _returns_of(transient, _checked(command, shape))
    if command.json:
        return found | ({} if pixel is None else {"pixel": pixel})
    for name in RANGES & found.keys():
        found[name] = " to ".join(f"{value:.4g}" for value in found[name]) or "none"
    return found | ({} if pixel is None else {"pixel": _as_text(pixel)})


def _kind(path: Path) -> str:
    if path.suffix.lower() == ".mat":
        return "histogram"
    known = KINDS.get(path.suffix.lower(), ())
    kind = next((kind for kind in known if holds_kind(path, kind)), None)
    if kind is not None:
        return kind
    if path.suffix.lower() in DENSE_SUFFIXES:
        from scene2spad.viewer.exports import is_dense

        if is_dense(path):
            return "dense"
    expected = "a transient or depth map (.exr), a histogram or pack (.h5), a frame (.mat) or dense arrays (.npz, .h5)"
    raise InputError(f"{path}: expected {expected}; `show` knows more kinds")


def _dense(command: Inspect, path: Path) -> tuple[JsonObject, JsonObject | None]:
    """Describe a dense export, and the pixel asked for."""
    from scene2spad.cli.results.dense_facts import of_dense, pixel_of_dense
    from scene2spad.viewer.exports import dense_arrays

    arrays, text = dense_arrays(path)
    found: JsonObject = {"kind": "dense", **of_dense(arrays, text)}
    if command.pixel is None:
        return found, None
    pixel = _checked(command, arrays["depth_m"].shape)
    return found, pixel_of_dense(arrays, pixel) | {"drawn": drawn(arrays["data"][pixel])}


def _depth(command: Inspect, path: Path) -> tuple[JsonObject, JsonObject | None]:
    """Describe a depth map, and the pixel asked for."""
    map_ = open_depth(path)
    depth_m, confidence = map_.depth_m, map_.confidence
    known = np.isfinite(depth_m)
    found: JsonObject = {
        "kind": "depth",
        **_known(map_.meta, ("method", "decoder", "int8_rule")),
        "rows": depth_m.shape[0],
        "columns": depth_m.shape[1],
        "depth_m": _range(depth_m),
        "missing": int((~known).sum()),
        "confidence": None if confidence is None or not known.any() else float(np.mean(confidence[known])),
    }
    if command.pixel is None:
        return found, None
    row, column = pixel = _checked(command, depth_m.shape)
    sure = None if confidence is None else _number(confidence[pixel])
    return found, {"row": row, "column": column, "depth_m": _number(depth_m[pixel]), "confidence": sure}


def _transient(command: Inspect, path: Path, kind: str) -> tuple[JsonObject, Transient]:
    """Read the facts that a file states of itself, and its transient; in a pack those of the view asked for."""
    if kind == "transient":
        from render.transient import read_transient

        transient = read_transient(path)
        return {"kind": kind, **_of_transient(transient)}, transient
    from render.transient.packs import read_pack

    pack = read_pack(path)
    views = len(pack)
    require(0 <= command.view < views, f"{path}: no view {command.view}, there are 0 to {views - 1}")
    transient = pack[command.view]
    return {"kind": kind, "views": views, "view": command.view, **_of_transient(transient)}, transient


def _checked(command: Inspect, shape: tuple[int, int]) -> tuple[int, int]:
    row, column = command.pixel or (0, 0)
    inside = 0 <= row < shape[0] and 0 <= column < shape[1]
    last = f"rows 0 to {shape[0] - 1}, columns 0 to {shape[1] - 1}"
    require(inside, f"{command.file}: no pixel in row {row}, column {column} ({last})")
    return row, column


def _of_transient(transient: Transient) -> dict[str, object]:
    meta = transient.meta
    paths = [float(transient.path_near_m.min()), float(transient.path_far_m.max())] if transient.returns else []
    return {
        "scene": meta.get("scene"),
        "rows": transient.height,
        "columns": transient.width,
        "returns": transient.returns,
        "path_m": paths,
        "depth_m": _range(transient.depth_m),
        "indirect_fraction": transient.indirect_fraction,
        "mixed_fraction": float(transient.mixed.mean()),
        "ambient_W_per_m2_sr_nm": _range(transient.ambient),
        **_known(meta, ("seed", "time_offset_m", "relative_error", "plan", "versions")),
    }


def _of_histogram(histogram: Histogram) -> dict[str, object]:
    sensor, budget = histogram.sensor, histogram.budget
    rows, columns, bins = histogram.counts.shape
    asked = {"asked_signal": budget.signal, "asked_background": budget.background} if histogram.signal_known else {}
    return {
        "rows": rows,
        "columns": columns,
        "bins": bins,
        "bin_width_s": sensor.bin_width_s,
        "sensor": sensor.name,
        **asked,
        "detections_per_pixel": float(histogram.counts.sum(dtype=np.int64)) / max(rows * columns, 1),
        "depth_m": _range(histogram.depth_m),
        **_known(histogram.meta, ("scene", "seed", "model", "plan", "versions")),
    }


def _known(meta: JsonObject, names: Sequence[str]) -> dict[str, object]:
    return {name: meta[name] for name in names if name in meta}


def _range(layer: np.ndarray) -> list[float]:
    """Least and largest finite value; empty where there is none."""
    finite = layer[np.isfinite(layer)]
    return [float(finite.min()), float(finite.max())] if finite.size else []


def _returns_of(transient: Transient, pixel: tuple[int, int]) -> JsonObject:
    row, column = pixel
    flat = row * transient.width + column
    mine = slice(int(transient.offsets[flat]), int(transient.offsets[flat + 1]))
    table = zip(
        transient.path_near_m[mine].tolist(),
        transient.path_far_m[mine].tolist(),
        transient.radiance[mine].tolist(),
        transient.bounces[mine].tolist(),
        strict=True,
    )
    names = ("path_near_m", "path_far_m", "radiance_per_m2_sr", "bounces")
    return {
        "row": row,
        "column": column,
        "depth_m": _number(transient.depth_m[pixel]),
        "returns": [dict(zip(names, line, strict=True)) for line in table],
    }


def _counts_of(histogram: Histogram, pixel: tuple[int, int]) -> JsonObject:
    counts = histogram.counts[pixel]
    filled = np.flatnonzero(counts)
    return {
        "row": pixel[0],
        "column": pixel[1],
        "depth_m": _number(histogram.depth_m[pixel]),
        "expected_signal": _number(histogram.expected_signal[pixel]),
        "expected_background": _number(histogram.expected_background[pixel]),
        "detections": int(counts.sum(dtype=np.int64)),
        "counts": [{"bin": int(place), "counts": int(counts[place])} for place in filled],
        "drawn": drawn(counts),
    }


def _number(value: np.floating) -> float | None:
    return float(value) if np.isfinite(value) else None


def drawn(counts: np.ndarray) -> str:
    """Draw counts (T,) as a line of at most WIDTH bars: bins summed, the fullest bar is full."""
    edges = np.linspace(0, len(counts), min(WIDTH, len(counts)) + 1).astype(int)
    sums = np.add.reduceat(counts, edges[:-1]).astype(float) if len(counts) else np.zeros(0)
    most = sums.max(initial=0)
    if most == 0:
        return BARS[0] * len(sums)
    return "".join(BARS[int(np.ceil(value / most * (len(BARS) - 1)))] for value in sums)


def _as_text(pixel: JsonObject) -> list[str]:
    """Return the pixel as lines: what it is, then its table, no longer than MAX_LINES."""
    table = "returns" if "returns" in pixel else "counts"
    lines = [", ".join(f"{name} {_value(value)}" for name, value in pixel.items() if name not in (table, "drawn"))]
    if "drawn" in pixel:
        lines.append(f"|{pixel['drawn']}| bins from first to last")
    rows = pixel.get(table, ())
    lines += [", ".join(f"{name} {_value(value)}" for name, value in row.items()) for row in rows[:MAX_LINES]]
    if len(rows) > MAX_LINES:
        lines.append(f"{len(rows) - MAX_LINES} more: --json gives all")
    return lines


def _value(value: object) -> str:
    return "none" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
