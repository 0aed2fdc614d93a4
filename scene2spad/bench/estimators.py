"""Every depth estimator at the paper's 16 photon levels: MAE, RMSE and share within 10 mm, unmixed and mixed pixels."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot as plt

from csph.levels import PHOTON_LEVELS as LEVELS
from csph.training.views import read_views
from render.transient import Transient
from scene2spad.options.experiments import Bench
from scene2spad.plots.figures import save
from scenes.errors import InputError, require
from scenes.io.relief import (
    MIDDLEBURY_BASELINE_M,
    MIDDLEBURY_FOCAL_PX,
    MIDDLEBURY_SHRUNK,
    middlebury_folder,
    middlebury_names,
    read_disparity,
    read_luma,
)
from spad.detection.detect import sense
from spad.estimators.depth import METHODS, estimate_depth, histogram_errors
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.model import PhotonBudget, Sensor

log = logging.getLogger("scene2spad")

QUICK_LEVELS = ((50, 50), (10, 1000))
FOCAL_PX = MIDDLEBURY_FOCAL_PX / MIDDLEBURY_SHRUNK
BLOCK = 8  # image pixels a sensor pixel side
GROUPS = ("all", "unmixed", "mixed")


def middlebury(folder: Path) -> Transient:
    """Return one Middlebury RGB-D pair as a transient of 8 x 8 returns a pixel; albedo and ambient light are its luma.

    Cut to a whole number of pixels; samples without disparity return nothing. Raises InputError as `read_disparity`
    does.
    """
    disparity, least = read_disparity(folder)
    luma = read_luma(folder, (len(disparity), disparity.shape[1]))
    height, width = (side // BLOCK * BLOCK for side in disparity.shape)
    disparity, luma = disparity[:height, :width], luma[:height, :width]
    depth = np.where(disparity > 0, MIDDLEBURY_FOCAL_PX * MIDDLEBURY_BASELINE_M / (disparity + least), np.nan)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    radial = depth * np.sqrt(1 + (x**2 + y**2) / FOCAL_PX**2)
    fov = 2 * np.degrees(np.arctan(width / 2 / FOCAL_PX))
    return transient_from_rgbd(radial, luma, luma, fov_deg=float(fov), block=BLOCK, meta={"scene": folder.name})


def table(
    scenes: Iterable[tuple[str, Transient]],
    sensor: Sensor,
    levels: Iterable[tuple[float, float]] = LEVELS,
    *,
    methods: Iterable[str] = METHODS,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda what, fraction: None,
) -> list[dict]:
    """Return one row for each scene, level, method and group of pixels: the figures of `depth_errors`."""
    rows, scenes, levels = [], list(scenes), list(levels)
    for number, (name, transient) in enumerate(scenes):
        leave_out = {"all": np.zeros_like(transient.mixed), "unmixed": transient.mixed, "mixed": ~transient.mixed}
        for index, (signal, background) in enumerate(levels):
            progress(f"estimators, {name}", (number + index / len(levels)) / len(scenes))
            histogram = sense(transient, sensor, PhotonBudget(signal, background), seed=seed)
            counts = torch.from_numpy(histogram.counts)
            for method in methods:
                depth = estimate_depth(counts, sensor, method)
                where = {"scene": name, "signal": signal, "background": background, "method": method}
                for group in GROUPS:
                    errors = histogram_errors(depth, histogram, exclude=leave_out[group])
                    rows.append({**where, "group": group, **errors})
    return rows


def scenes_of(command: Bench) -> list[tuple[str, Transient]]:
    """Return views of the rendered set that is asked for, else the Middlebury images of the data folder; none, and a
    warning, without both.

    Only the first where it is to be quick. Raises InputError as `read_views` and `middlebury` do, and for a given data
    folder without images.
    """
    most = 1 if command.quick else None
    if command.set is not None:
        views = read_views(command.set)
        return list(zip(views.scenes, views.transients, strict=True))[:most]
    try:
        names = middlebury_names(command.data)
        require(bool(names), f"{middlebury_folder('', command.data)}: holds no Middlebury scene (NAME/disp1.png)")
    except InputError as error:
        if command.data is not None:
            raise
        log.warning("%s; the table of estimators is left out", error)
        return []
    return [(name, middlebury(middlebury_folder(name, command.data))) for name in names[:most]]


def mean_over(rows: list[dict], key: str, **where: object) -> float:
    """Return mean of a figure over the rows that match, each scene and level counting once; NaN for none."""
    chosen = [row[key] for row in rows if all(row[name] == value for name, value in where.items())]
    known = [value for value in chosen if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def summary(rows: list[dict]) -> dict:
    """Return {method: {group: {mae_mm, rmse_mm, within_10mm}}}, means over scenes and levels."""
    keys = ("mae_mm", "rmse_mm", "within_10mm")
    return {
        method: {group: {key: mean_over(rows, key, method=method, group=group) for key in keys} for group in GROUPS}
        for method in dict.fromkeys(row["method"] for row in rows)
    }


def markdown(rows: list[dict]) -> list[str]:
    """Return two tables: MAE of every estimator at every level, and all figures over all levels; all, unmixed, mixed
    pixels.

    A cell of the first is the mean over scenes; one of the second also over levels.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    found = [f"| signal / background | {' | '.join(methods)} |", f"|---|{'---|' * len(methods)}"]
    for signal, background in sorted({(row["signal"], row["background"]) for row in rows}):
        where = {"signal": signal, "background": background}
        cells = [_cell(rows, "mae_mm", ".0f", method=method, **where) for method in methods]
        found.append(f"| {signal:g} / {background:g} | {' | '.join(cells)} |")
    found += ["", "| estimator | MAE [mm] | RMSE [mm] | within 10 mm [%] |", "|---|---|---|---|"]
    for method in methods:
        cells = [_cell(rows, key, ".0f", method=method) for key in ("mae_mm", "rmse_mm")]
        found.append(f"| {method} | {' | '.join(cells)} | {_cell(rows, 'within_10mm', '.1f', 100, method=method)} |")
    return found


def _cell(rows: list[dict], key: str, digits: str, scale: float = 1, **where: object) -> str:
    return " / ".join(f"{scale * mean_over(rows, key, group=group, **where):{digits}}" for group in GROUPS)


def draw(rows: list[dict], path: Path) -> Path:
    """Draw MAE and share within 10 mm of every estimator at every level, unmixed pixels, mean over scenes."""
    levels = sorted({(row["signal"], row["background"]) for row in rows})
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
    labels = [f"{signal:g} / {background:g}" for signal, background in levels]
    marks = dict(zip(METHODS, "ovsD^x", strict=True))
    for method in dict.fromkeys(row["method"] for row in rows):
        for axes, key in ((left, "mae_mm"), (right, "within_10mm")):
            values = [
                mean_over(rows, key, method=method, group="unmixed", signal=signal, background=background)
                for signal, background in levels
            ]
            axes.plot(range(len(levels)), values, marks[method] + "-", ms=4, lw=1, label=method)
    left.set(yscale="log", ylabel="mean absolute error [mm]", title="Mean absolute error, unmixed pixels")
    right.set(ylim=(0, 1), ylabel="share of pixels within 10 mm", title="Share within 10 mm, unmixed pixels")
    for axes in (left, right):
        axes.set_xticks(range(len(levels)), labels, rotation=60, fontsize=8)
        axes.set_xlabel("mean signal / background photons per pixel")
        axes.grid(True, lw=0.3)
    left.legend(fontsize=8)
    figure.suptitle(f"Depth estimators, mean over {len({row['scene'] for row in rows})} scenes")
    return save(figure, path)
