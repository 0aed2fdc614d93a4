"""`export FILE --out X`: dense arrays, point clouds and coding tensors for other programs."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import numpy as np

from scene2spad.cli.opening import kind_of, open_coding, open_depth, open_histogram, open_transient, pixel_sensor
from scene2spad.cli.paths import Mark, begins, check_target, input_file, keep_foreign
from scene2spad.options.common import Common, File, GivenFile, Positional, may_stay_open, only_for
from scenes.errors import InputError, require
from scenes.io.hdf5 import HDF5_SUFFIXES
from scenes.json_types import JsonObject
from scenes.progress import Progress

log = logging.getLogger("scene2spad")
DENSE = (".npz", *HDF5_SUFFIXES)
CODES = (".txt", ".npy")
# An array of codes (.npy) has no mark of ours: it is as any program writes it.
MARKS = {
    **dict.fromkeys(DENSE, Mark("dense array", lambda path: _exports().is_dense(path))),
    ".ply": Mark("point cloud", lambda path: _exports().is_cloud(path)),
    ".txt": Mark("table of codes", lambda path: begins(path, rb"# [^\n]*: \d+ codes of blocks of ")),
}


@dataclass(frozen=True, kw_only=True)
class Export(Common):
    """Write for other programs: a dense array (.npz, .h5) of a transient or a histogram, a point cloud (.ply) of a
    depth map or of true depth, or a coding tensor (.txt, .npy) of a model, with --int8 rounded to 8 bits."""

    file: Positional[GivenFile]
    """A transient or depth map (.exr), a histogram (.h5), codes (.npy), a checkpoint, or a model's name."""
    out: Path
    """File to write: .npz or .h5 (dense), .ply (points), .txt or .npy (codes)."""
    layout: Literal["hwt", "thw"] = "hwt"
    """Order of the dense array's axes: row, column, time, or time first."""
    sensor: Annotated[str | None, may_stay_open("NAME")] = None
    """Sensor, by name or file, whose bins and pulse a transient is put into (default: reference)."""
    intensity: File = None
    """The histogram (.h5) whose detections become the intensity of a depth map's points (default: all 1)."""
    int8: bool = False
    """Codes rounded to 8-bit integers, at full scale or in the model's own steps, with the value of one step; what an
    in-pixel program adds is in `ultraphase compile --out`."""
    view: int = 0
    """View of a pack, from 0."""
    frame: int = 0
    """Frame of a capture (.mat), from 0."""


def run(command: Export, progress: Progress) -> dict:
    """Open the file, and write it in the form that the output's ending asks for."""
    path, out, suffix = command.file, command.out, command.out.suffix.lower()
    kind = kind_of(path)
    codes, dense = kind in ("codes", "network"), suffix in DENSE
    binned = dense and kind in ("transient", "pack")
    purposes = {"int8": (codes, "codes"), "sensor": (binned, "a dense array (.npz, .h5) of a transient")}
    purposes |= {"layout": (dense, "a dense array (.npz, .h5)"), "view": (kind == "pack", "a pack")}
    purposes |= {"frame": (kind == "histogram", "captures (.mat)"), "intensity": (kind == "depth", "a depth map")}
    only_for(command, str(path), purposes)
    check_target(out, path)
    keep_foreign(out, MARKS.get(suffix))
    if codes and suffix in CODES:
        return _codes(command, kind)
    if suffix in DENSE and kind in ("transient", "pack", "histogram"):
        arrays = _dense(command, kind)
        from spad.formats.dense import write_dense

        write_dense(arrays, out, layout=command.layout)
        rows, columns, times = arrays["data"].shape
        shape = [times, rows, columns] if command.layout == "thw" else [rows, columns, times]
        light = {name: float(arrays[name]) for name in ("wrapped", "unrecorded") if name in arrays}
        return {"shape": shape, "layout": command.layout, **light, "out": str(out)}
    if suffix == ".ply" and kind in ("transient", "pack", "histogram", "depth"):
        return {"points": _points(command, kind), "out": str(out)}
    all_forms = (".npz", ".h5", ".ply")
    wanted = {"codes": CODES, "network": CODES, "depth": (".ply",), "transient": all_forms, "pack": all_forms}
    wanted["histogram"] = all_forms
    read = "; a table of codes goes to `depth --codes-file`" if kind == "text" else ""
    require(kind in wanted, f"{path}: is of kind {kind}, which is not exported{read}")
    raise InputError(f"{out}: a file of kind {kind} goes to {', '.join(wanted[kind])}")


def _exports() -> ModuleType:
    """Import what knows our exports; it imports torch, and --help must be quick."""
    from scene2spad.viewer import exports

    return exports


def _codes(command: Export, kind: str) -> dict:
    """Write the codes; the step of 8-bit integers stands in the text, or in one beside an array."""
    from csph.codes.files import step_file, write_codes
    from csph.codes.quantise import quantised

    out, step = command.out, {}
    coding = open_coding(command.file, kind)
    if command.int8 and out.suffix.lower() == ".npy":
        beside = step_file(out)
        check_target(beside)
        keep_foreign(beside, MARKS[".txt"])
        step = {"step": quantised(coding).scale, "step_file": str(beside)}
    write_codes(coding, out, int8=command.int8)
    return {"codes": coding.codes, "block": list(coding.block), **step, "out": str(out)}


def _dense(command: Export, kind: str) -> dict[str, np.ndarray]:
    """Return the arrays, and say which light they have at another time than its own."""
    from spad.formats.dense import arrival_reasons, dense

    if kind == "histogram":
        histogram = open_histogram(command.file, command.frame)
        arrays, sensor = dense(histogram), histogram.sensor
    else:
        sensor = pixel_sensor(command.sensor, command.file)
        arrays = dense(open_transient(command.file, kind, command.view), sensor)
    for reason in arrival_reasons(arrays, sensor):
        log.log(logging.WARNING if reason.startswith("warning:") else logging.INFO, "%s", reason)
    return arrays


def _points(command: Export, kind: str) -> int:
    """Write the cloud, and return how many points it has."""
    from spad.formats.ply import points_of, write_ply

    depth_m, intensity, confidence, pointing = _depth_of(command, kind)
    try:
        points = points_of(depth_m, pointing)
    except InputError as error:
        raise InputError(f"{command.file}: {error}") from None
    known = np.isfinite(depth_m)
    top = float(np.quantile(intensity[known], 0.995)) if known.any() else 1.0
    write_ply(points, command.out, intensity=np.clip(intensity / (top or 1.0), 0, 1), confidence=confidence)
    return int(known.sum())


def _depth_of(command: Export, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, JsonObject]:
    """Return depth, intensity and confidence (H, W), and what tells where the pixels look."""
    if kind == "depth":
        found = open_depth(command.file)
        sure = np.ones_like(found.depth_m) if found.confidence is None else found.confidence
        bright = np.ones_like(found.depth_m)
        if command.intensity is not None:
            histogram = open_histogram(input_file(command.intensity))
            bright = histogram.counts.sum(axis=2, dtype=np.int64).astype(np.float32)
            require(bright.shape == found.depth_m.shape, f"{command.intensity}: is of another size than {command.file}")
            if found.meta.get("histogram_sha256") != histogram.sha256():
                log.warning("warning: %s: not the histogram that %s was made from", command.intensity, command.file)
        return found.depth_m, bright, sure, found.meta
    if kind == "histogram":
        from spad.estimators.bistatic import pointing_of

        histogram = open_histogram(command.file, command.frame)
        bright = histogram.counts.sum(axis=2, dtype=np.int64).astype(np.float32)
        return histogram.depth_m, bright, np.ones_like(histogram.depth_m), pointing_of(histogram.meta)
    transient = open_transient(command.file, kind, command.view)
    bright = transient.total_radiance().astype(np.float32)
    return transient.depth_m, bright, np.ones_like(bright), transient.meta
