"""`study real-data`: Supplementary Figures 13 and 14, from captures in the LinoSPAD prototype's layout.

The published captures do not come with this package. Without files of one's own the study renders two scenes, senses
them as the prototype would and writes them in its layout, and everything after that goes through the files: what it
says of these is said of rendered captures.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from csph.networks.checkpoint import load_model
from csph.networks.model import DepthModel
from csph.weights.cards import checkpoint_of
from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient, read_transient, write_transient
from scene2spad.bench.rendering.references import key_of
from scene2spad.networks.training import classical
from scene2spad.options.experiments import Study
from scene2spad.plots.figures import display
from scene2spad.studies.real_data import figures
from scene2spad.studies.real_data.figures import View
from scenes import Laser, Scene
from scenes.errors import require
from scenes.files import finite, whole_file, write_csv
from scenes.library.catalog import load_scene
from scenes.model import Ambient, Texture
from scenes.progress import Progress
from spad.detection.detect import sense_timestamps
from spad.estimators.depth import depth_errors
from spad.formats.linospad import Capture, capture_of, read_linospad, resampled, resampled_sensor, write_linospad
from spad.sensor.model import PRESETS as SENSORS
from spad.sensor.model import PhotonBudget, Sensor

log = logging.getLogger("scene2spad")

NOT_REAL = "No real capture was used: rendered scenes in the LinoSPAD layout"
BINS, POOL = 1024, 2
FOV_DEG = 40.0  # of point clouds of captures: their files do not say it
TILE = 64  # rows and columns that a network answers for at a time
MIXED_M = 0.05  # depths further apart than this in one pooled pixel are no single truth
# What is seen without a network: uncompressed, and decoded by correlation from K of 1024 codes.
BASELINES = ("argmax", "log-matched")
CODES = {256: ("fourier-4", "gray-4"), 128: ("fourier-8", "gray-8", "coarse-8")}


def prototype() -> Sensor:
    """Return the `linospad` preset with the prototype's measured pulse and the dark counts of its rows, some of them
    hot."""
    measured = SENSORS["iccv2023-train"]
    return replace(
        SENSORS["linospad"],
        name="linospad-prototype",
        pulse=measured.pulse,
        dark_count_rate_hz=measured.dark_count_rate_hz,
    )


@dataclass(frozen=True)
class Simulated:
    """A scene that stands in for a capture, and its photons; `sun` replaces its lights by sun and sky."""

    name: str
    scene: str
    budget: PhotonBudget
    sun: bool


@dataclass(frozen=True)
class Preset:
    """Pixels a side, and how they are rendered."""

    side: int
    settings: RenderSettings


SIMULATED = (
    Simulated("ornaments", "tabletop/antlers", PhotonBudget(20, 60), sun=True),
    Simulated("room", "living-room", PhotonBudget(15, 100), sun=False),
)
PRESETS = {
    "smoke": Preset(32, RenderSettings(bounces=1, grid=2, ambient=True)),
    "laptop": Preset(256, RenderSettings(error=0.05, ambient=True)),
    "paper": Preset(256, RenderSettings(error=0.02, ambient=True)),
}

Method = Callable[[torch.Tensor, Sensor], torch.Tensor]


def run(command: Study, progress: Progress) -> dict:
    """Run the study: depth images and point clouds of every capture by every method; figures and a table in
    `command.out`."""
    networks = [(path, load_model(checkpoint_of(path))[0]) for path in command.checkpoints]
    for path, model in networks:
        bins = model.config.sensor.bins
        require(bins == BINS, f"{path}: a network for {bins} bins, captures are resampled to {BINS}")
    by_compression = methods_of([model for _, model in networks])
    if command.capture:
        names = [path.stem for path in command.capture]
        require(len({*names}) == len(names), f"captures {' '.join(names)}: two of one name")
        views = [_view(read_linospad(path, command.frame), path.stem) for path in command.capture]
        note = f"Captures given: {', '.join(names)}, frame {command.frame}; no truth, field of view {FOV_DEG:g} degrees"
    else:
        views, note = _rendered(command, progress), NOT_REAL
    command.out.mkdir(parents=True, exist_ok=True)
    methods = {label: method for found in by_compression.values() for label, method in found.items()}
    depths = {}
    for number, view in enumerate(views):
        for label, method in methods.items():
            progress(f"{view.name}: {label}", 0.6 + 0.35 * number / len(views))
            depth = method(torch.from_numpy(view.counts), view.sensor)
            depths[view.name, label] = depth.numpy()
    rows = [_row(view, label, depths[view.name, label]) for view in views for label in methods]
    table = write_csv(rows, command.out / "real-data.csv")
    drawn = [
        figures.draw(views, [*found], depths, f"{title}. {note}", command.out / name)
        for found, title, name in _pages(by_compression)
    ]
    drawn.append(figures.draw_clouds(views, [*methods], depths, f"Point clouds. {note}", command.out / "clouds.png"))
    # given captures know no preset; `report` sets those of `smoke` apart
    kept = {"preset": None if command.capture else command.preset, "note": note, "figures": [p.name for p in drawn]}
    path = command.out / "real-data.json"
    with whole_file(path) as beside:
        beside.write_text(json.dumps(finite({**kept, "rows": rows}), indent=1, allow_nan=False) + "\n")
    return {
        "note": note,
        "other_sensor": [_describe(path, model) for path, model in networks],
        "table": figures.lines(rows),
        "rows": rows if command.json else len(rows),
        "csv": str(table),
        "figures": [str(one) for one in drawn],
        "numbers": str(path),
    }


# Captures


def _rendered(command: Study, progress: Progress) -> list[View]:
    """Scenes of ours as captures: made once a configuration, in `captures` of the folder, and read back as files."""
    preset, views = PRESETS[command.preset], []
    for number, one in enumerate(SIMULATED):
        fraction = 0.6 / len(SIMULATED)

        def step(what: str, done: float, first: float = number * fraction, name: str = one.name) -> None:
            progress(f"{name}: {what}", first + fraction * done)  # noqa: B023 (called in this turn of the loop)

        scene = scene_of(one, preset.side, command.seed)
        path, transient = make_capture(one, scene, preset, command.out / "captures", command.seed, step)
        views.append(_view(read_linospad(path), one.name, scene.camera.fov_deg, transient))
    return views


def scene_of(one: Simulated, side: int, seed: int) -> Scene:
    """Return the scene with a line laser, square, and where asked under sun and sky instead of its lamps."""
    scene = load_scene(one.scene, seed=seed, width=side, height=side)
    if one.sun:
        scene = replace(scene.without_lights(), ambient=Ambient(environment=sun_and_sky()))
    return replace(scene, laser=Laser("line"))


def sun_and_sky() -> Texture:
    """Return a sky of one unit with a sun 31 degrees high behind the camera's left shoulder, 3 times the sky's
    irradiance."""
    image = np.full((32, 64), 1.0, np.float32)
    image[17:] = 0.2  # the ground
    row, column = 10, 26
    # a pixel spans 2 pi / 64 x pi / 32 cos(elevation); the sky's irradiance on flat ground is pi
    elevation = np.pi * (0.5 - (row + 0.5) / 32)
    image[row, column] = 3 * np.pi / (2 * np.pi / 64 * np.pi / 32 * np.cos(elevation) * np.sin(elevation))
    return Texture(image, "sun and sky")


def make_capture(
    one: Simulated, scene: Scene, preset: Preset, folder: Path, seed: int, progress: Progress
) -> tuple[Path, Transient]:
    """Render and sense a scene unless that was done before: the file in the prototype's layout, and the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    sensor = prototype()
    light = {"scene": scene.digest(), "settings": vars(preset.settings), "seed": seed}
    truth = folder / f"{one.name}-{key_of(light)}.exr"
    whole = {**light, "sensor": sensor.to_dict(), "budget": one.budget.to_dict()}
    path = folder / f"{one.name}-{key_of(whole)}.mat"
    if truth.is_file():
        transient = read_transient(truth)
    else:
        transient = render(scene, preset.settings, seed=seed, progress=progress)
        write_transient(transient, truth)
    if not path.is_file():
        detections = sense_timestamps(transient, sensor, one.budget, seed=seed)
        for reason in detections.meta["plan"]:
            log.info("%s: %s", one.name, reason)
        photograph = np.rint(255 * display(transient.ambient, 0.9)).astype(np.uint8)
        write_linospad([capture_of(detections, photograph)], path)
    return path, transient


def _view(capture: Capture, name: str, fov_deg: float = FOV_DEG, truth: Transient | None = None) -> View:
    """Prepare a capture as the methods see it: resampled and pooled, with the truth pooled alike where it is known."""
    counts = resampled(capture, BINS, POOL)
    depth, mixed = (None, None) if truth is None else pooled_truth(truth)
    return View(name, counts, resampled_sensor(prototype(), BINS), capture.image, fov_deg, depth, mixed)


def pooled_truth(transient: Transient) -> tuple[np.ndarray, np.ndarray]:
    """Return mean depth of the pixels that are summed [m], NaN where one has none, and where they are no single
    depth."""
    side = transient.height // POOL
    depth = transient.depth_m.reshape(side, POOL, side, POOL).swapaxes(1, 2).reshape(side, side, -1)
    mixed = transient.mixed.reshape(side, POOL, side, POOL).any(axis=(1, 3))
    return depth.mean(axis=-1), mixed | (np.ptp(depth, axis=-1) > MIXED_M)


# Methods


def methods_of(models: list[DepthModel]) -> dict[int, dict[str, Method]]:
    """Return by compression ratio, 1 for what sees all counts: label and function. Models of one name are numbered."""
    found: dict[int, dict[str, Method]] = {1: {name: classical(name) for name in BASELINES}}
    found |= {ratio: {name: classical(name) for name in names} for ratio, names in CODES.items()}
    for model in models:
        design = model.config.design
        group = found.setdefault(1 if design is None else round(design.compression_ratio), {})
        label = f"network {model.config.name}"
        same = sum(other.split(" #")[0] == label for other in group)
        group[f"{label} #{same + 1}" if same else label] = network(model)
    return found


def network(model: DepthModel, tile: int = TILE) -> Method:
    """Return depth by a trained network, whose bins stand for the capture's: what it learned of a pulse was in bins.

    Tile by tile, each with what the network sees around it, so that an image needs no more memory than a tile.
    """
    unit = math.lcm(*model.config.block[1:], model.network.coarsest)
    tile, margin = (-(-pixels // unit) * unit for pixels in (tile, model.network.reach))

    @torch.no_grad()
    def depth_of(counts: torch.Tensor, sensor: Sensor) -> torch.Tensor:
        height, width = counts.shape[:2]
        down, right = model.config.block[1:]
        fits = height % down == 0 and width % right == 0
        require(fits, f"image of {width} x {height} pixels is not tiled by the network's blocks of {right} x {down}")
        depth = torch.empty(height, width)
        for top in range(0, height, tile):
            for left in range(0, width, tile):
                rows, columns = (slice(max(at - margin, 0), at + tile + margin) for at in (top, left))
                seen = counts[rows, columns].permute(2, 0, 1)[None, None].contiguous()
                found = model.position(model(seen))[0] * sensor.bin_depth_m
                inner = found[top - rows.start :, left - columns.start :][:tile, :tile]
                depth[top : top + tile, left : left + tile] = inner
        return depth

    return depth_of


def _describe(path: Path, model: DepthModel) -> str:
    own, here = model.config.sensor, resampled_sensor(prototype(), BINS)
    widths = f"bins of {own.bin_width_s * 1e12:.1f} ps in training, {here.bin_width_s * 1e12:.1f} ps here"
    return f"{path}: {model.config.name}, {widths}"


# Results


def _row(view: View, label: str, depth: np.ndarray) -> dict:
    """Photons, and errors where there is a truth; NaN without."""
    row = {"capture": view.name, "method": label, "photons": float(view.counts.sum(axis=-1).mean())}
    truth = np.full(depth.shape, np.nan) if view.depth_m is None else view.depth_m
    found = depth_errors(depth, truth, range_m=view.sensor.recorded_range_m, exclude=view.mixed)
    wanted = ("mae_mm", "rmse_mm", "median_mm", "within_10mm", "pixels", "beyond_range")
    return {**row, **{name: found[name] for name in wanted}}


def _pages(found: dict[int, dict[str, Method]]) -> list[tuple[list[str], str, str]]:
    """List the methods, title and file of each figure: the uncompressed beside one compression ratio."""
    published = {256: "After Supplementary Figure 13 (256x)", 128: "After Supplementary Figure 14 (128x)"}
    return [
        ([*found[1], *found[ratio]], published.get(ratio, f"{ratio}x compression"), f"real-data-{ratio}x.png")
        for ratio in sorted(found, reverse=True)
        if ratio != 1
    ]
