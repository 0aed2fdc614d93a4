"""`study codes`: error of depth decoded without a network, by code and number of codes K, at the paper's photon levels.

Codes over one pixel and all time bins, decoded by correlation over K; beside them the Poisson maximum likelihood of the
uncompressed histogram, and its Cramer-Rao bound.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from torch import Tensor

from csph import CodingTensor, decode_depth, encode, temporal_code
from csph.evaluation.metrics import LOW_SBR
from csph.levels import PHOTON_LEVELS as LEVELS
from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scene2spad.options.experiments import Study
from scene2spad.plots.figures import save
from scenes import Laser
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError, require
from scenes.files import write_csv
from scenes.library.catalog import load_scene
from scenes.progress import Progress
from spad.detection.detect import sense
from spad.estimators.bistatic import recorded_range_m
from spad.estimators.depth import cramer_rao_m, depth_errors, estimate_depth
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor

log = logging.getLogger("scene2spad")

GROUPS = ("all", "high_sbr", "low_sbr")
CODES = ("fourier", "gray", "coarse", "hadamard")
NUMBERS = (4, 8, 16, 32, 64, 128, 256)
UNCOMPRESSED = "log-matched"


@dataclass(frozen=True)
class Row:
    """One method at one photon level; errors over the pixels whose surfaces do not mix.

    codes     K; 0 for the uncompressed histogram
    bound_mm  mean over the pixels of the least mean absolute error that an unbiased estimate of the uncompressed
              histogram has if its error is Gaussian, sqrt(2 / pi) times the Cramer-Rao standard deviation
    """

    method: str
    codes: int
    signal: float
    background: float
    mae_mm: float
    median_abs_mm: float
    within_10mm: float
    bound_mm: float
    pixels: int

    @property
    def low_sbr(self) -> bool:
        return self.signal <= LOW_SBR * self.background


class _Truth(NamedTuple):
    """Truth of a histogram that is kept once it is encoded."""

    depth_m: np.ndarray
    left_out: np.ndarray
    budget: PhotonBudget
    bound_mm: float


def decoded_table(
    histograms: Iterable[Histogram], codes: tuple[str, ...] = CODES, numbers: tuple[int, ...] = NUMBERS
) -> list[Row]:
    """Return rows of every code and K, and of the uncompressed histogram, for each of the histograms, all of one
    sensor.

    A K that does not fit a code is left out. The histograms may come one by one: their codes are kept, not they.
    """
    sensor: Sensor | None = None
    codings: list[tuple[str, CodingTensor]] = []
    kept: list[tuple[_Truth, list[Tensor]]] = []
    rows: list[Row] = []
    for histogram in histograms:
        if sensor is None:
            sensor = histogram.sensor
            codings = _codings(codes, numbers, sensor)
        require(histogram.sensor == sensor, "the histograms of one table must be of one sensor")
        counts = torch.from_numpy(histogram.counts)
        truth = _truth(histogram)
        kept.append((truth, [encode(counts, coding) for _, coding in codings]))
        rows.append(_row(UNCOMPRESSED, 0, truth, estimate_depth(counts, sensor, UNCOMPRESSED)))
    if sensor is None:
        return rows
    for number, (name, coding) in enumerate(codings):  # one code after the other: its templates are made once
        for truth, encoded in kept:
            depth = decode_depth(encoded[number], coding, sensor)
            rows.append(_row(name, coding.codes, truth, depth))
    return rows


def _codings(codes: tuple[str, ...], numbers: tuple[int, ...], sensor: Sensor) -> list[tuple[str, CodingTensor]]:
    found = []
    for name in codes:
        for number in numbers:
            try:
                temporal = temporal_code(name, number, sensor.bins, sensor)
            except InputError as misfit:
                log.warning("%s K = %d is left out: %s", name, number, misfit)
                continue
            found.append((name, CodingTensor(f"{name}-{number}", temporal)))
    return found


def _truth(histogram: Histogram) -> _Truth:
    sensor = histogram.sensor
    left_out = histogram.mixed | ~np.isfinite(histogram.depth_m) | (histogram.depth_m >= recorded_range_m(histogram))
    arrival, signal, background = (
        torch.from_numpy(values[~left_out].astype(np.float64))
        for values in (
            2 * histogram.depth_m / SPEED_OF_LIGHT_M_PER_S,
            histogram.expected_signal,
            histogram.expected_background / sensor.bins,
        )
    )
    bound = 1e3 * math.sqrt(2 / math.pi) * cramer_rao_m(arrival, signal, background, sensor)
    return _Truth(histogram.depth_m, left_out, histogram.budget, float(bound.mean()))


def _row(method: str, codes: int, truth: _Truth, depth_m: Tensor) -> Row:
    # a pixel without a detection is missing for every method alike: it does not count
    errors = depth_errors(depth_m, truth.depth_m, range_m=math.inf, exclude=truth.left_out)
    return Row(
        method,
        codes,
        truth.budget.signal,
        truth.budget.background,
        mae_mm=errors["mae_mm"],
        median_abs_mm=errors["median_abs_mm"],
        within_10mm=errors["within_10mm"],
        bound_mm=truth.bound_mm,
        pixels=int(errors["pixels"]),
    )


def sensed(transient: Transient, sensor: Sensor, seed: int, progress: Progress) -> Iterator[Histogram]:
    """Yield the transient at each of the paper's 16 photon levels."""
    for number, level in enumerate(LEVELS):
        progress(f"{level[0]} + {level[1]} photons", number / len(LEVELS))
        yield sense(transient, sensor, PhotonBudget(*level), seed=seed)


def by_group(rows: list[Row]) -> list[dict]:
    """Return means over the photon levels of each of the paper's groups (SBR at most 0.1, above) and over all, a row a
    code and K."""
    found = []
    for method, codes in dict.fromkeys((row.method, row.codes) for row in rows):
        mine = [row for row in rows if (row.method, row.codes) == (method, codes)]
        groups = {
            "all": mine,
            "low_sbr": [r for r in mine if r.low_sbr],
            "high_sbr": [r for r in mine if not r.low_sbr],
        }
        line: dict = {"method": method, "codes": codes}
        for group, members in groups.items():
            for key in ("mae_mm", "median_abs_mm", "within_10mm", "bound_mm"):
                values = [getattr(row, key) for row in members]
                line[f"{key}_{group}"] = float(np.mean(values)) if values else math.nan
        found.append(line)
    return found


def run(command: Study, progress: Progress) -> dict:
    """Render a scene with direct light alone under a scanning laser, sense it at every level, decode, draw."""
    sensor = Sensor()
    scene = load_scene(command.scene, seed=command.seed, width=command.width, height=command.height)
    scene = replace(scene, laser=Laser("scan", scene.laser.baseline_m))
    require(not any(scene.laser.baseline_m), f"scene {scene.name}: study codes needs a laser at the camera")
    transient = render(scene, RenderSettings(bounces=1), seed=command.seed)
    rows = decoded_table(sensed(transient, sensor, command.seed, progress))
    groups = by_group(rows)
    command.out.mkdir(parents=True, exist_ok=True)
    size = f"{scene.name} {scene.camera.width} x {scene.camera.height}, direct light alone, scanned"
    figure = draw(groups, size, command.out / "codes.png")
    table = write_csv([asdict(row) for row in rows], command.out / "codes.csv")
    shown = {"rows": [asdict(row) for row in rows], "groups": groups} if command.json else {"groups": _lines(groups)}
    return {"scene": size, **shown, "csv": str(table), "figures": [str(figure)]}


def _lines(groups: list[dict]) -> list[str]:
    heads = ("MAE mm, all", "SBR > 0.1", "SBR <= 0.1", "median |error|", "within 10 mm")
    lines = [" ".join([f"{'method':<12} {'K':>4}", *(f"{head:>14}" for head in heads)])]
    for g in groups:
        values = (*(g[f"mae_mm_{group}"] for group in GROUPS), g["median_abs_mm_all"])
        numbers = " ".join(f"{value:>14.1f}" for value in values)
        lines.append(f"{g['method']:<12} {g['codes'] or '-':>4} {numbers} {g['within_10mm_all']:>14.1%}")
    bounds = " ".join(f"{groups[0][f'bound_mm_{group}']:>14.1f}" for group in GROUPS)
    lines.append(f"{'Cramer-Rao':<12} {'-':>4} {bounds}")
    return lines


def draw(groups: list[dict], scene: str, path: Path) -> Path:
    """Draw MAE and median error against K, a column a group of photon levels; the uncompressed histogram as lines."""
    figure, panels = plt.subplots(2, 2, figsize=(12, 8), layout="constrained", sharex=True, sharey="row")
    titles = {"high_sbr": "signal / background above 0.1 (9 levels)", "low_sbr": "at most 0.1 (7 levels)"}
    kinds = {"mae_mm": "mean absolute depth error [mm]", "median_abs_mm": "median absolute depth error [mm]"}
    for row, (kind, label) in zip(panels, kinds.items(), strict=True):
        for axes, (group, title) in zip(row, titles.items(), strict=True):
            _curves(axes, groups, kind, group)
            if kind == "mae_mm":
                bound = groups[0][f"bound_mm_{group}"]
                axes.axhline(bound, color="k", lw=1, ls=":", label="Cramer-Rao, uncompressed")
            axes.set_title(title, fontsize=10)
        row[0].set_ylabel(label)
    # outside: within a panel it would hide the bound, the lowest line of all
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    for axes in panels[1]:
        axes.set_xlabel("codes per pixel K")
    figure.suptitle(f"Depth decoded by correlation over K, no network: {scene}")
    return save(figure, path)


def _curves(axes: Axes, groups: list[dict], kind: str, group: str) -> None:
    for method in dict.fromkeys(line["method"] for line in groups):
        mine = [line for line in groups if line["method"] == method]
        values = [line[f"{kind}_{group}"] for line in mine]
        if method == UNCOMPRESSED:
            axes.axhline(values[0], color="k", lw=1, label=f"{method}, uncompressed")
        else:
            axes.plot([line["codes"] for line in mine], values, "o-", ms=4, label=method)
    axes.set_yscale("log")
    axes.set_xscale("log", base=2)
    axes.grid(alpha=0.3, which="both")
