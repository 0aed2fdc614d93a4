"""Every reader of files: a small good file of its kind, and all numbers that reading it hands out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scene_files import (
    XML,
    Numbers,
    read_rgbd,
    read_scene,
    read_serialized,
    read_texture,
    write_depth_exr,
    write_depth_image,
    write_image,
    write_mesh,
    write_serialized,
)


@dataclass(frozen=True)
class Reader:
    """suffix, how a good file is made, what is read of it, and whether a checksum rules out silent changes."""

    suffix: str
    make: Callable[[Path], None]
    read: Callable[[Path], Numbers]
    checked: bool = False


def _transient():
    from spad.formats.rgbd import transient_from_rgbd

    rng = np.random.default_rng(3)
    depth = rng.uniform(0.5, 6, (4, 6))
    depth[1, 2] = np.nan
    image = rng.uniform(0.2, 1, (4, 6))
    return transient_from_rgbd(depth, image, image)


def _histogram():
    from spad.detection.detect import sense
    from spad.sensor.model import PhotonBudget, Sensor

    return sense(_transient(), Sensor(bins=64), PhotonBudget(20, 10), seed=1)


def _of_histogram(histogram) -> Numbers:
    yield histogram.counts, False
    for name in ("depth_m", "mixed", "albedo", "expected_signal", "expected_background"):
        yield getattr(histogram, name), True


def _of_transient(transient) -> Numbers:
    for name in ("offsets", "path_near_m", "path_far_m", "radiance", "bounces"):
        yield getattr(transient, name), False
    for name in ("depth_m", "normal", "albedo", "ambient", "mixed", "error"):
        yield getattr(transient, name), True


def _write_histogram(path: Path) -> None:
    from spad.measurements.histogram import write_histogram

    write_histogram(_histogram(), path)


def _read_histogram(path: Path) -> Numbers:
    from spad.measurements.histogram import read_histogram

    return _of_histogram(read_histogram(path))


def _write_transient(path: Path) -> None:
    from render.transient import write_transient

    write_transient(_transient(), path)


def _read_transient(path: Path) -> Numbers:
    from render.transient import read_transient

    return _of_transient(read_transient(path))


def _write_pack(path: Path) -> None:
    from render.transient.packs import rounded, write_pack

    write_pack([(rounded(_transient()), {"scene": "a"})] * 2, path)


def _read_pack(path: Path) -> Numbers:
    from render.transient.packs import read_pack

    for transient in read_pack(path):
        yield from _of_transient(transient)


def _write_frame(path: Path) -> None:
    from spad.formats.mat import write_mat

    write_mat(_histogram(), path)


def _read_frame(path: Path) -> Numbers:
    from spad.formats.mat import read_mat

    return _of_histogram(read_mat(path))


def _write_capture(path: Path) -> None:
    import scipy.sparse

    from spad.formats.linospad import Capture, write_linospad

    counts = scipy.sparse.random(64, 16, 0.2, "csc", rng=np.random.default_rng(0))
    counts.data = np.ceil(9 * counts.data)
    write_linospad([Capture(counts, np.arange(16.0).reshape(4, 4))], path)


def _read_capture(path: Path) -> Numbers:
    from spad.formats.linospad import read_linospad, resampled

    capture = read_linospad(path, bins=64)
    yield resampled(capture, 32, 2), False
    if capture.image is not None:
        yield capture.image, True


def _write_weights(path: Path) -> None:
    from csph.codes.design import Design
    from csph.networks.checkpoint import save_model
    from csph.networks.config import ModelConfig, TrainConfig
    from csph.networks.model import DepthModel
    from spad.sensor.model import Sensor

    design = Design.named("learned", (16, 2, 2), codes=8)
    config = TrainConfig(model=ModelConfig(design=design, sensor=Sensor(bins=64)))
    save_model(DepthModel(config.model, 0), config, {"step": 1}, path, half=True)


def _read_weights(path: Path) -> Numbers:
    from csph.networks.checkpoint import load_model

    model, _, _ = load_model(path)
    return ((value.numpy(), False) for value in model.state_dict().values())


def _write_numbers(path: Path) -> None:
    np.save(path, np.abs(np.random.default_rng(0).normal(0, 1, 40)).astype(np.float32))


def _read_pulse(path: Path) -> Numbers:
    from spad.sensor.pulse import read_pulse

    yield np.array(read_pulse(path, 1e-11).samples), False


def _write_assembly(path: Path) -> None:
    path.write_text(
        ".equ K, 4\n.space codes, s16, K\n.reg t, r1\nloop:   BNT idle\n        RDT t\n.for k in 0..K - 1\n"
        "        ADDM [codes + 2*k], t\n.end\n        JMP loop\nidle:   BFE end\n        JMP loop\nend:    HALT\n"
    )


def _read_assembly(path: Path) -> Numbers:
    from ultraphase import ChipSpec, assemble_file

    program = assemble_file(path)
    program.check(ChipSpec())
    yield np.array(program.words, np.int64), False


def _write_index(path: Path) -> None:
    import json

    lines = [{"view": i, "file": f"views/{i:06d}.exr", "error": 0.01, "place": f"room {i}"} for i in range(4)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def _read_index(path: Path) -> Numbers:
    """The reader takes a folder: the damaged index is put into one."""
    import shutil
    import tempfile

    from scenes.errors import InputError
    from scenes.io.set_index import read_set_index

    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(path, Path(folder) / "index.jsonl")
        (Path(folder) / "views").mkdir()
        for view in range(4):
            (Path(folder) / f"views/{view:06d}.exr").touch()
        try:
            records = read_set_index(Path(folder))
        except InputError as error:
            raise InputError(f"{path.name}: {error}") from None
    yield np.array([record["view"] for record in records]), False


def _write_state(path: Path) -> None:
    """The state of an interrupted run, small: what Lightning keeps, and two layers' weights."""
    import torch

    from csph.training.resume import KEYS, WholeFileCheckpoints

    weights = torch.nn.Linear(7, 5, dtype=torch.float64).state_dict()
    weights = {name: torch.linspace(-1, 1, value.numel()).reshape(value.shape) for name, value in weights.items()}
    state = {key: {"plain": [1, 2.5, "text"]} for key in KEYS} | {"state_dict": weights}
    WholeFileCheckpoints().save_checkpoint(state, path)


def _read_state(path: Path) -> Numbers:
    import torch

    from csph.training.resume import check_resume
    from csph.weights.torch_files import load_torch_file

    check_resume(path, torch.nn.Linear(7, 5))
    for value in load_torch_file(path)["state_dict"].values():
        yield value.numpy(), False


def _write_dark_map(path: Path) -> None:
    np.save(path, np.random.default_rng(0).uniform(10, 1000, (4, 6)))


def _read_dark_map(path: Path) -> Numbers:
    from scene2spad.cli.simulation.sensing import read_dark_map

    yield read_dark_map(path, _transient()), True


def _write_codes(path: Path) -> None:
    np.save(path, np.random.default_rng(0).normal(0, 1, (4, 16)))


def _read_codes(path: Path) -> Numbers:
    from scene2spad.studies.tensors import coding_of

    yield coding_of(path).temporal.numpy(), False


def _write_sensor(path: Path) -> None:
    from spad.sensor.files import preset_files

    path.write_bytes(preset_files()["tmf8820"].read_bytes())


def _read_sensor(path: Path) -> Numbers:
    import math
    from dataclasses import asdict

    from spad.sensor.files import read_sensor

    def numbers(value: object) -> list[float]:
        if isinstance(value, (list, tuple)):
            return [number for item in value for number in numbers(item)]
        return [float(value)] if isinstance(value, (bool, int, float)) else []

    found = read_sensor(path)
    for part in (found.sensor, found.optics, found.zones):
        values = [numbers(value) for value in asdict(part).values()] if part else []
        # infinite is what has no limit unless one is stated: filter width, trials of saturation
        yield np.array([number for some in values if math.inf not in some for number in some]), False


def _write_plane_captures(path: Path) -> None:
    rng = np.random.default_rng(0)
    counts, reference = rng.integers(0, 99, (6, 2, 24)), rng.integers(0, 99, (6, 24))
    np.savez_compressed(path, distance_m=np.linspace(0.1, 0.5, 6), counts=counts, reference_counts=reference)


def _read_plane_captures(path: Path) -> Numbers:
    from scene2spad.datasets.zone_captures import read_plane_captures

    found = read_plane_captures(path)
    for array in (found.distance_m, found.counts, found.drift_bins):
        yield array, False
    yield found.chip_m, True


def _write_depth_map(path: Path) -> None:
    from spad.formats.depth_map import write_depth

    depth = _transient().depth_m
    write_depth(depth, path, {"method": "argmax"}, np.where(np.isnan(depth), 0, 0.5))


def _read_depth_map(path: Path) -> Numbers:
    from spad.formats.depth_map import read_depth

    depth, confidence, _ = read_depth(path)
    yield depth, True
    yield confidence, False


READERS: dict[str, Reader] = {
    "obj": Reader(".obj", write_mesh, read_scene),
    "ply": Reader(".ply", write_mesh, read_scene),
    "stl": Reader(".stl", write_mesh, read_scene),
    "glb": Reader(".glb", write_mesh, read_scene),
    "xml": Reader(".xml", lambda path: path.write_text(XML) and None, read_scene),
    "texture": Reader(".png", write_image, read_texture, checked=True),
    "rgbd": Reader(".png", write_depth_image, read_rgbd, checked=True),
    "transient": Reader(".exr", _write_transient, _read_transient, checked=True),
    "histogram": Reader(".h5", _write_histogram, _read_histogram, checked=True),
    "pack": Reader(".h5", _write_pack, _read_pack, checked=True),
    "index": Reader(".jsonl", _write_index, _read_index),
    "frame": Reader(".mat", _write_frame, _read_frame, checked=True),
    "capture": Reader(".mat", _write_capture, _read_capture, checked=True),
    "weights": Reader(".safetensors", _write_weights, _read_weights, checked=True),
    "pulse": Reader(".npy", _write_numbers, _read_pulse),
    "assembly": Reader(".s", _write_assembly, _read_assembly),
    "state": Reader(".ckpt", _write_state, _read_state, checked=True),
    "serialized": Reader(".serialized", write_serialized, read_serialized, checked=True),
    "jpeg": Reader(".jpg", write_image, read_texture),
    "depth exr": Reader(".exr", write_depth_exr, read_rgbd),
    "dark map": Reader(".npy", _write_dark_map, _read_dark_map),
    "codes": Reader(".npy", _write_codes, _read_codes),
    "sensor": Reader(".toml", _write_sensor, _read_sensor),
    "plane captures": Reader(".npz", _write_plane_captures, _read_plane_captures, checked=True),
    "depth map": Reader(".exr", _write_depth_map, _read_depth_map, checked=True),
}
