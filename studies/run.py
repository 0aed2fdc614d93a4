"""What each command does: configuration in, files and one dictionary of results out."""

from __future__ import annotations

import hashlib
import importlib
import logging
import mmap
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from csph import CodingTensor, decode_depth, encode, temporal_code
from csph.model import DepthModel, load_model
from render.engine import render
from render.settings import RenderSettings
from render.tracing import Progress
from render.transient import Transient, write_transient
from scenes import InputError, Laser, Scene
from scenes.catalog import SCENES, WIDTH, load_scene
from scenes.files import ATTRIBUTE, seal, whole_file
from scenes.offsets import check_offset
from scenes.sets import SETS, scene_set
from spad.depth import depth_errors, histogram_depth_m
from spad.detect import sense
from spad.histogram import Histogram, read_histogram, write_histogram
from spad.sensor import PhotonBudget, sensor_by_name
from studies import commands, experiments, figures, sensing

log = logging.getLogger("scene2spad")


def _input(path: Path) -> Path:
    if not path.is_file():
        raise InputError(
            f"{path}: {'is a folder, expected a file' if path.is_dir() and path.name else 'file not found'}"
        )
    return path


def _output(path: Path, suffix: str, kind: str) -> Path:
    """An output path that can be written later, with its picture: checked before the work, not after it.

    Results of the same kind may be written again; any other file is not overwritten.
    """
    if path.suffix.lower() != suffix:
        raise InputError(f"{path}: the output must end in {suffix}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: folder {path.parent} cannot be written to")
    for target in (path, _picture(path, kind)):
        if target.is_dir():
            raise InputError(f"{target}: is a folder, expected a file name")
    if path.is_file() and not _holds(path, f'"kind": "{kind}"'.encode()):
        raise InputError(f"{path}: exists and is no {kind} of scene2spad; choose another --out")
    return path


def _holds(path: Path, words: bytes) -> bool:
    if path.stat().st_size == 0:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as contents:
        return contents.find(words) >= 0


def _picture(path: Path, kind: str) -> Path:
    """The picture's name beside a result: its own kind, so that it meets no texture and no other picture."""
    return path.with_name(f"{path.stem}.{kind}.png")


def _load(command: commands.Render | commands.Demo) -> Scene:
    if isinstance(command, commands.Render) and (command.depth or command.focal or command.depth_scale):
        return _rgbd(command)
    return load_scene(command.scene, seed=command.seed, width=command.width, height=command.height)


def _rgbd(command: commands.Render) -> Scene:
    """The relief of a photograph and its depth image."""
    from scenes.relief import RgbdFiles, rgbd

    if command.depth is None or command.focal is None:
        raise InputError(f"{command.scene}: an RGB-D pair needs --depth FILE and --focal PIXELS (and --depth-scale)")
    files = RgbdFiles(Path(command.scene), command.depth, command.focal, command.depth_scale, command.cosine)
    return rgbd(files, width=command.width or (None if command.height else WIDTH), height=command.height)


def _in_view(transient: Transient) -> Transient:
    if transient.returns == 0:
        raise InputError(f"scene {transient.meta['scene']}: nothing in view of the camera returns light")
    return transient


def run_scenes(command: commands.Scenes, progress: Progress) -> dict:
    """List or describe."""
    if command.sheet is not None:
        return _sheet(command, progress)
    if not command.scene:
        return {"scenes": dict(SCENES), "sets": dict(SETS)}
    scene = load_scene(command.scene, seed=command.seed)
    low, high = scene.bounds()
    camera, laser = scene.camera, scene.laser
    described = {
        "size_m": (high - low).tolist(),
        "surfaces": len(scene.surfaces),
        "materials": sorted({f"{s.material.name} ({s.material.kind})" for s in scene.surfaces}),
        "triangles": scene.triangles,
        "camera": {
            "position_m": camera.origin.tolist(),
            "fov_deg": camera.fov_deg,
            "pixels": [camera.width, camera.height],
        },
        "laser": {"mode": laser.mode, "baseline_m": list(laser.baseline_m)},
        "ambient_light": scene.has_ambient,
        "notes": list(scene.notes),
    }
    return {"scenes": {scene.name: described}}


def _sheet(command: commands.Scenes, progress: Progress) -> dict:
    """A contact sheet of a set."""
    from studies.sheets import draw_sheet

    path = command.sheet
    if path.suffix.lower() != ".png" or not path.parent.is_dir():
        raise InputError(f"{path}: expected a .png in a folder that exists")
    of = scene_set(command.scene or "rooms")
    if command.count < 1:
        raise InputError(f"count {command.count} is less than 1")
    count = command.count if of.size is None else min(of.size, command.count)
    width, height = (command.width or 128, None) if of.size is None else (command.width, None)
    height = round(0.75 * width) if of.size is None else None
    scenes = [of.view(i, seed=command.seed, width=width, height=height) for i in range(count)]
    draw_sheet(scenes, path, progress=progress)
    return {"scenes": [scene.name for scene in scenes], "figure": str(path)}


def run_dataset(command: commands.Dataset, progress: Progress) -> dict:
    """A scene set -> a folder of .exr files, and one .h5 of them all."""
    from studies.dataset import Job, make_set, pack_set

    of = scene_set(command.set)
    error = command.error or (0.01 if command.bounces == 1 else 0.03)
    job = Job(
        of.name, command.seed, command.width, command.height, command.bounces, command.spp, command.grid, error,
        command.offset, command.offset_mode, command.ambient, command.ambient_spp, filter=command.filter,
    )  # fmt: skip
    if command.pack is not None:
        _output(command.pack, ".h5", "pack")
    out = command.out or Path("out") / of.name.replace("/", "-")
    count = command.count if command.count is not None else of.size or 100
    options = {"workers": command.workers, "scheduler": command.scheduler, "progress": progress}
    result = make_set(job, count, out, **options)
    if command.pack is not None:
        result |= {"pack_bytes": pack_set(out, command.pack, progress), "pack": str(command.pack)}
    return result


def run_render(command: commands.Render, progress: Progress) -> dict:
    """Scene -> .exr and a picture of its layers."""
    settings = RenderSettings(
        bounces=command.bounces,
        spp=command.spp,
        filter=command.filter,
        grid=command.grid,
        ambient={"auto": None, "on": True, "off": False}[command.ambient],
        ambient_spp=command.ambient_spp,
        error=command.error,
        budget=command.budget,
    )
    check_offset(command.offset)
    if command.out is not None:
        _output(command.out, ".exr", "transient")
    scene = _load(command)
    out = command.out or _output(Path(f"{scene.name}.exr"), ".exr", "transient")
    if command.laser is not None:
        scene = replace(scene, laser=Laser(command.laser, scene.laser.baseline_m))
    start = time.perf_counter()
    if command.offset and command.offset_mode != "time":
        from studies.moving import moved

        scene = moved(scene, command.offset, command.offset_mode)
    transient = _in_view(render(scene, settings, seed=command.seed, progress=progress))
    seconds = time.perf_counter() - start
    if command.offset and command.offset_mode == "time":
        transient = transient.delayed(command.offset)
    write_transient(transient, out)
    error, plan = transient.meta["relative_error"], transient.meta["plan"]
    result = {
        "seconds": seconds,
        "rays": transient.meta["rays"],
        "spp": plan["spp"],
        "returns": transient.returns,
        "indirect_fraction": transient.indirect_fraction,
        "relative_error": error["total"],
        "pixel_error_median": error["pixel_median"],
        "pixel_error_p95": error["pixel_p95"],
        "plan": plan,
        "out": str(out),
    }
    if command.figure:
        result["figure"] = str(figures.draw_transient(transient, _picture(out, "transient")))
    return result | {"target_met": transient.meta["target_met"]}


def run_sense(command: commands.Sense, progress: Progress) -> dict:
    """Transient -> .h5, a picture of its counts, and with --export the .mat layout."""
    return sensing.run(command, progress, input_file=_input, output_file=_output, picture=_picture)


def depth_map(
    histogram: Histogram,
    method: str,
    codes: int = 16,
    code: str = "fourier",
    seed: int = 0,
    network: DepthModel | None = None,
    int8: bool = False,
) -> np.ndarray:
    """Estimate depth [m] by a method's name, (H, W) float32; `compressive` keeps K codes of a temporal code."""
    if network is not None:
        depth, overflows = network.depth_of(histogram, int8=int8)
        if overflows:
            log.warning("%d sums of 16 bits wrapped around", overflows)
        return depth
    if method != "compressive":
        return histogram_depth_m(histogram, method)
    temporal = temporal_code(code, codes, histogram.sensor.bins, histogram.sensor, seed)
    coding = CodingTensor(f"{code}-{codes}", temporal)
    return histogram_depth_m(histogram, lambda counts, sensor: decode_depth(encode(counts, coding), coding, sensor))


def run_depth(command: commands.Depth, progress: Progress) -> dict:
    """Histogram -> depth map, error figures and a picture."""
    label = command.method if command.method != "compressive" else f"{command.code}-{command.codes}"
    source = _input(command.file)
    out = _output(command.out or source.with_name(f"{source.stem}-{label}.exr"), ".exr", "depth")
    histogram = read_histogram(source)
    progress(command.method, 0.1)
    network = _network(command)
    start = time.perf_counter()
    depth = depth_map(histogram, command.method, command.codes, command.code, command.seed, network, command.int8)
    seconds = time.perf_counter() - start
    sure = sensing.mean_confidence(histogram, depth)
    range_m = histogram.sensor.range_m
    errors = depth_errors(depth, histogram.depth_m, range_m=range_m)
    _write_depth(depth, out, {"method": label, "histogram_sha256": histogram.sha256()})
    result = {
        "seconds": seconds,
        "method": label,
        **errors,
        "confidence": sure,
        "unmixed": depth_errors(depth, histogram.depth_m, range_m=range_m, exclude=histogram.mixed),
        "out": str(out),
    }
    if command.figure:
        result["figure"] = str(figures.draw_depth(histogram, depth, label, errors, _picture(out, "depth")))
    return result


def _network(command: commands.Depth) -> DepthModel | None:
    wanted = command.method == "network"
    if wanted != (command.checkpoint is not None) or (command.int8 and not wanted):
        raise InputError("depth: --method network and --checkpoint go together, and --int8 with both")
    if not wanted:
        return None
    return load_model(command.checkpoint)[0]


def _write_depth(depth_m: np.ndarray, path: Path, meta: dict) -> None:
    import OpenEXR

    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        ATTRIBUTE: seal({**meta, "unit": "m"}, "depth", hashlib.sha256(depth_m.tobytes()).hexdigest()),
    }
    with whole_file(path) as beside:
        try:
            OpenEXR.File(header, {"Z": np.ascontiguousarray(depth_m, dtype=np.float32)}).write(str(beside))
        except RuntimeError as error:
            raise OSError(str(error)) from None


def run_demo(command: commands.Demo, progress: Progress) -> dict:
    """Scene -> transient -> histogram -> four depth maps -> one figure."""
    budget = PhotonBudget(command.signal, command.background)
    folder = command.out
    if not (folder.is_dir() or not folder.exists()):
        raise InputError(f"{folder}: is a file, expected a folder for the demo's results")
    scene = _load(command)
    folder.mkdir(parents=True, exist_ok=True)
    _output(folder / f"{scene.name}.exr", ".exr", "transient")
    _output(folder / f"{scene.name}.h5", ".h5", "histogram")
    start = time.perf_counter()
    transient = _in_view(render(scene, seed=command.seed, progress=progress))
    rendered = time.perf_counter()
    sensor = sensor_by_name("reference")
    histogram = sense(transient, sensor, budget, seed=command.seed, progress=progress)
    sensed = time.perf_counter()
    names = {"argmax": "argmax", "matched": "matched", "log-matched": "log-matched", "compressive": "Fourier K = 16"}
    depths = {name: depth_map(histogram, method) for method, name in names.items()}
    errors = {n: depth_errors(d, histogram.depth_m, range_m=sensor.range_m) for n, d in depths.items()}
    estimated = time.perf_counter()
    write_transient(transient, folder / f"{scene.name}.exr")
    write_histogram(histogram, folder / f"{scene.name}.h5")
    figure = figures.draw_demo(transient, histogram, depths, errors, folder / "demo.png")
    return {
        "seconds": time.perf_counter() - start,
        "seconds_render": rendered - start,
        "seconds_sense": sensed - rendered,
        "seconds_depth": estimated - sensed,
        "relative_error": transient.meta["relative_error"]["total"],
        "target_met": transient.meta["target_met"],
        "mae_mm": {name: e["mae_mm"] for name, e in errors.items()},
        "within_10mm": {name: e["within_10mm"] for name, e in errors.items()},
        "figure": str(figure),
    }


def run_bench(command: experiments.Bench, progress: Progress) -> dict:
    """One stage of the bench: the module of its name, imported only when it is asked for."""
    for name, value in (("seeds", command.seeds), ("repeats", command.repeats)):
        if not 1 <= value <= 1000:
            raise InputError(f"bench: {name} {value} is outside 1 to 1000")
    return importlib.import_module(f"studies.bench.{command.stage.replace('-', '_')}").run(command, progress)


def run_ultraphase(command: commands.Ultraphase, progress: Progress) -> dict:
    """The emulated in-pixel processor."""
    from studies import ultraphase_cli

    return ultraphase_cli.run(command, progress)


def run_study(command: experiments.Study, progress: Progress) -> dict:
    """One study: the module of its name, imported only when it is asked for."""
    if command.out.is_file():
        raise InputError(f"{command.out}: is a file, expected a folder for the figures")
    module = "ablations" if command.name in experiments.ABLATIONS else command.name.replace("-", "_")
    return importlib.import_module(f"studies.{module}").run(command, progress)


def run_train(command: commands.Train, progress: Progress) -> dict:
    """Set -> checkpoint; Lightning is imported only when it is asked for."""
    from studies import training

    return training.run_train(command, progress)


def run_evaluate(command: commands.Evaluate, progress: Progress) -> dict:
    """Checkpoints and a set -> errors."""
    from studies import training

    return training.run_evaluate(command, progress)


def run_report(command: experiments.Report, progress: Progress) -> dict:
    """Results -> one page."""
    from studies import report

    return report.run(command, progress)


RUNNERS: dict[type, Callable] = {
    commands.Demo: run_demo,
    commands.Scenes: run_scenes,
    commands.Render: run_render,
    commands.Dataset: run_dataset,
    commands.Sense: run_sense,
    commands.Depth: run_depth,
    commands.Train: run_train,
    commands.Evaluate: run_evaluate,
    experiments.Bench: run_bench,
    commands.Ultraphase: run_ultraphase,
    experiments.Study: run_study,
    experiments.Report: run_report,
}
