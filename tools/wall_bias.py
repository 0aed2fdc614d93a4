"""Measure how far networks are off before a plane wall, at depths all over the range.

    python tools/wall_bias.py MODEL [MODEL ...] [--from 0.4] [--to 14.5] [--step 0.1] [--draws 4]

A wall faces the camera, 24x24 pixels, direct light, 50 + 50 photons. Its error is the median over its pixels, by each
network's default decoder, and the mean of that over several draws of photons: noise falls with them, a bias does not.
Each model gets one line: the largest error with its standard error and its depth, the walls that are off by more than
3 mm, and the root mean square.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from csph.networks.checkpoint import load_model
from csph.networks.model import DepthModel
from csph.weights.cards import checkpoint_of
from render import RenderSettings, render
from scenes.errors import InputError, require
from scenes.library.catalog import load_scene
from spad.detection.detect import sense
from spad.sensor.model import PhotonBudget

PIXELS, FOV_DEG = 24, 4.0
BUDGET = PhotonBudget(50.0, 50.0)
BOUND_MM = 3.0
MOST = 1000  # walls, and draws of a wall


def wall_errors_mm(models: Sequence[DepthModel], distance_m: float, draws: int, seed: int) -> np.ndarray:
    """Return the median error [mm] of each model before one wall, a column a draw: (models, draws)."""
    scene = load_scene(f"wall@{distance_m:g}", width=PIXELS, height=PIXELS)
    scene = replace(scene, camera=replace(scene.camera, fov_deg=FOV_DEG))
    transient = render(scene, RenderSettings(bounces=1))
    found = np.empty((len(models), draws))
    for draw in range(draws):
        histogram = sense(transient, models[0].config.sensor, BUDGET, seed=seed + draw)
        for row, model in enumerate(models):
            found[row, draw] = 1e3 * np.nanmedian(model.depth_of(histogram)[0] - histogram.depth_m)
    return found


def summary(name: str, depths_m: np.ndarray, errors_mm: np.ndarray) -> str:
    """Return one line on the errors of a model, (walls, draws)."""
    bias = errors_mm.mean(1)
    draws = errors_mm.shape[1]
    uncertain = errors_mm.std(1, ddof=1) / math.sqrt(draws) if draws > 1 else np.full(len(bias), np.nan)
    worst = int(np.abs(bias).argmax())
    return (
        f"{name}: largest {bias[worst]:+.1f} +- {uncertain[worst]:.1f} mm at {depths_m[worst]:g} m, "
        f"{int((np.abs(bias) > BOUND_MM).sum())} of {len(bias)} walls beyond {BOUND_MM:g} mm, "
        f"root mean square {math.sqrt(np.mean(bias**2)):.1f} mm (noise {math.sqrt(np.mean(uncertain**2)):.1f} mm)"
    )


def main(argv: list[str] | None = None) -> int:
    """Run the script; return its exit status, 2 for what cannot be measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="names of models, or checkpoints")
    parser.add_argument("--from", dest="first", type=float, default=0.4, metavar="M", help="first depth (default: 0.4)")
    parser.add_argument("--to", dest="last", type=float, default=14.5, metavar="M", help="last depth (default: 14.5)")
    parser.add_argument("--step", type=float, default=0.1, metavar="M", help="between depths (default: 0.1)")
    parser.add_argument("--draws", type=int, default=4, metavar="N", help="draws of photons a wall (default: 4)")
    options = parser.parse_args(argv)
    try:
        require(options.step > 0, f"step {options.step:g} m: expected more than 0")
        require(1 <= options.draws <= MOST, f"draws {options.draws} is outside 1 to {MOST}")
        some = 0 < options.first <= options.last < math.inf
        require(some, f"depths from {options.first:g} to {options.last:g} m: none")
        walls = (options.last - options.first) / options.step
        require(walls < MOST, f"{walls:.0f} walls, expected {MOST} at most")
        models = [load_model(checkpoint_of(Path(name)))[0] for name in options.models]
        count = round((options.last - options.first) / options.step) + 1
        depths_m = np.round(options.first + options.step * np.arange(count), 6)
        errors = [wall_errors_mm(models, float(d), options.draws, MOST * i) for i, d in enumerate(depths_m)]
    except InputError as error:
        print(f"wall_bias: {error}", file=sys.stderr)
        return 2
    for row, name in enumerate(options.models):
        print(summary(name, depths_m, np.stack([of_wall[row] for of_wall in errors])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
