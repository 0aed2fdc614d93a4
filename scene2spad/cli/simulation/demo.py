"""From a scene to depth, with one figure."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from scene2spad.cli.checks import check_image
from scene2spad.cli.paths import file_stem, output_file, output_folder
from scene2spad.cli.simulation.render import in_view
from scene2spad.options.common import Common
from scenes.errors import InputError
from scenes.library.catalog import load_scene
from scenes.progress import Progress

NETWORK = "learned-1024x2x2-128x-t12-mixed-s13"
METHODS = {
    "argmax, all bins": "argmax",
    "log-matched, all bins": "log-matched",
    "Fourier, 128x": "fourier-8",
    "learned 1024x2x2, 128x": NETWORK,
}
ON_THE_CHIP = ("fourier-1024x1x1-128x-s0", "fourier-learned-256x2x2-128x-s0", NETWORK)


@dataclass(frozen=True, kw_only=True)
class Demo(Common):
    """Go from the default scene to depth, with a figure: render, sense, and depth from all bins, from Fourier codes and
    from learned codes by a network that ships, both at 128x; and what the codes cost on the chip."""

    scene: str = "living-room"
    """A scene as `render` takes it."""
    width: int = 128
    """Image width, pixels."""
    height: int = 96
    """Image height, pixels."""
    signal: float = 10.0
    """Mean signal photons per pixel; the network was trained on 1 to 100."""
    background: float = 50.0
    """Mean background photons per pixel."""
    out: Path = Path("out/demo")
    """Folder for the transient (.exr), the histogram (.h5) and the figure (.png)."""


def run(command: Demo, progress: Progress) -> dict:
    """Run the command: scene -> transient -> histogram -> four depth maps -> one figure."""
    from spad.sensor.model import PRESETS, PhotonBudget

    budget = PhotonBudget(command.signal, command.background)
    check_image("demo", width=command.width, height=command.height)
    folder = output_folder(command.out, "the demo's results")
    scene = load_scene(command.scene, seed=command.seed, width=command.width, height=command.height)
    from render.engine import render
    from render.transient import write_transient
    from scene2spad.methods import depth_method
    from scene2spad.plots.pixels import draw_demo
    from spad.detection.detect import sense
    from spad.estimators.depth import histogram_errors
    from spad.measurements.histogram import write_histogram

    folder.mkdir(parents=True, exist_ok=True)
    light = output_file(folder / f"{file_stem(scene.name)}.exr", ".exr", "transient")
    counts = output_file(light.with_suffix(".h5"), ".h5", "histogram")
    start = time.perf_counter()
    transient = in_view(render(scene, seed=command.seed, progress=progress))
    rendered = time.perf_counter()
    sensor = PRESETS["reference"]
    histogram = sense(transient, sensor, budget, seed=command.seed, progress=progress)
    sensed = time.perf_counter()
    depths = {}
    for number, (label, method) in enumerate(METHODS.items()):
        progress(label, number / len(METHODS))
        depths[label] = depth_method(method, sensor, seed=command.seed)(histogram)
    errors = {n: histogram_errors(d, histogram) for n, d in depths.items()}
    estimated = time.perf_counter()
    write_transient(transient, light)
    write_histogram(histogram, counts)
    costs = {model: chip_cost(model) for model in ON_THE_CHIP}
    figure = draw_demo(transient, histogram, depths, errors, folder / "demo.png", costs)
    return {
        "seconds": time.perf_counter() - start,
        "seconds_render": rendered - start,
        "seconds_sense": sensed - rendered,
        "seconds_depth": estimated - sensed,
        "relative_error": transient.meta["relative_error"]["total"],
        "target_met": transient.meta["target_met"],
        "mae_mm": {name: e["mae_mm"] for name, e in errors.items()},
        "within_10mm": {name: e["within_10mm"] for name, e in errors.items()},
        "chip": costs,
        "figure": str(figure),
    }


def chip_cost(model: str) -> str:
    """Say what a model's codes cost on emulated cores, or why they do not fit."""
    from csph.networks.checkpoint import load_model
    from csph.weights.cards import checkpoint_of
    from scene2spad.studies.chip.chain import measured
    from scene2spad.studies.chip.code import compile_model

    try:
        compiled = compile_model(load_model(checkpoint_of(model))[0], model).compiled
    except InputError as error:
        return "does not fit: " + str(error).removeprefix(f"code {model} ").partition(";")[0]
    cost = measured(compiled)
    return (
        f"{cost.clocks_per_photon:.0f} clocks a photon, {compiled.layout.total} of {compiled.chip.ram_bytes} bytes of "
        f"RAM a core, {cost.bits_per_pixel / 8:.0f} bytes read out a pixel"
    )
