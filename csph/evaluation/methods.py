"""Depth methods on rendered views at the 16 photon levels: every method sees the same photons.

A method is any function of a histogram. What it gives is compared with the truth image by image, and summed up over
all, low and high signal-to-background levels, with intervals over scenes (`csph.evaluation.metrics`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from csph.evaluation.exposures import Plans, asked_law
from csph.evaluation.metrics import (
    TOLERANCES_MM,
    Interval,
    bias_by_depth,
    grouped_errors,
    is_low_sbr,
    mean_over_scenes,
    paired_difference,
)
from csph.levels import PHOTON_LEVELS
from csph.networks.posterior import Decoder
from csph.training.views import Views
from render.backend.malloc import retain_freed_memory
from scenes.errors import require
from scenes.json_types import JsonObject
from scenes.progress import Progress
from scenes.random_streams import Stream
from spad.detection.detect import Model, sense
from spad.estimators.bistatic import recorded_range_m
from spad.measurements.histogram import TRUTH, Histogram
from spad.sensor.model import PhotonBudget, Sensor

PIXELS = ("all", "unmixed", "mixed")
FIGURES = ("mae_mm", "rmse_mm", *(f"within_{t}mm" for t in TOLERANCES_MM))
RANGES = {name: (0.0, 1.0 if name.startswith("within_") else math.inf) for name in FIGURES}  # of their values
LEVEL_GROUPS: dict[str, Callable[[float, float], bool]] = {
    "all": lambda signal, background: True,
    "low_sbr": is_low_sbr,
    "high_sbr": lambda signal, background: not is_low_sbr(signal, background),
}

Method = Callable[[Histogram], np.ndarray]


class DepthEstimator(Protocol):
    """Interface of a depth estimator that evaluation measures: a model, or a stand-in for one."""

    def depth_of(self, histogram: Histogram, *, decoder: Decoder | None = None) -> tuple[np.ndarray, int]: ...


@dataclass(frozen=True)
class Row:
    """One method on one group of pixels of one image; `pixels` counted, `missing` had no estimate: they are left out of
    errors, and are not within any tolerance; `law` drew the photons (tables without it are older, and of Poisson's)."""

    method: str
    scene: str
    view: int
    signal: float
    background: float
    group: str
    mae_mm: float
    rmse_mm: float
    within_1mm: float
    within_5mm: float
    within_10mm: float
    within_20mm: float
    ssim: float
    pixels: int
    missing: int
    beyond_range: int
    law: str = "poisson"


KeepMap = Callable[[Row, np.ndarray, Histogram], None]


@dataclass
class Evaluation:
    """Rows of every method and image, each method's estimates beside the truth, for what depends on depth, and what the
    plans of the exposures say."""

    rows: list[Row] = field(default_factory=list)
    depths: dict[str, list[tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    plans: Plans = field(default_factory=Plans)

    def laws(self) -> dict[str, int]:
        """Return how many exposures each detection law drew."""
        exposures = dict.fromkeys((row.view, row.signal, row.background, row.law) for row in self.rows)
        return dict(Counter(law for *_, law in exposures))

    def values(
        self, methods: Sequence[str], group: str = "all", levels: str = "all", figure: str = "mae_mm"
    ) -> dict[str, np.ndarray]:
        """Return {scene: (methods, images)} of a figure; several methods are trainings of one design by different
        seeds."""
        chosen = LEVEL_GROUPS[levels]
        found: dict[str, dict[str, list[float]]] = {}
        for row in self.rows:
            if row.method in methods and row.group == group and chosen(row.signal, row.background):
                by_method = found.setdefault(row.scene, {name: [] for name in methods})
                by_method[row.method].append(getattr(row, figure))
        return {scene: np.array([*by_method.values()]) for scene, by_method in found.items()}

    def interval(
        self, methods: Sequence[str], group: str = "all", levels: str = "all", figure: str = "mae_mm"
    ) -> Interval | None:
        """Return mean over scenes with its interval; None where there is no finite value.

        Student's interval of few scenes can reach where no figure is: those of errors end at 0, of shares at 0 and 1.
        """
        found = self.values(methods, group, levels, figure)
        if not any(np.isfinite(v).any() for v in found.values()):
            return None
        mean, *ends = mean_over_scenes(found)
        least, most = RANGES.get(figure, (-math.inf, math.inf))
        return Interval(mean, *(float(np.clip(end, least, most)) for end in ends))

    def difference(self, first: Sequence[str], second: Sequence[str], levels: str = "all") -> Interval:
        """Return paired difference of MAE [mm], first - second, over scenes and levels, of the pixels of each image
        where all of both have an estimate. An evaluation of rows alone knows no pixels: there each has its own."""
        among = [*first, *second]
        return paired_difference(*(self._common_mae_mm(methods, among, levels) for methods in (first, second)))

    def _common_mae_mm(self, methods: Sequence[str], among: Sequence[str], levels: str) -> dict[str, np.ndarray]:
        """Return {scene: (methods, images)} of the MAE over the pixels where all methods `among` have an estimate."""
        if not all(self.depths.get(name) for name in among):
            return self.values(methods, levels=levels)
        found: dict[str, dict[str, list[float]]] = {}
        for name in methods:
            rows = (row for row in self.rows if row.method == name and row.group == "all")
            for row, *maps in zip(rows, *(self.depths[one] for one in among), strict=True):
                if LEVEL_GROUPS[levels](row.signal, row.background):
                    errors = {one: _abs_error_mm(*pair) for one, pair in zip(among, maps, strict=True)}
                    both = np.isfinite([*errors.values()]).all(axis=0)
                    # what nothing is missing from is in the table already
                    mae_mm = row.mae_mm if both.all() else _mean(errors[name][both])
                    found.setdefault(row.scene, {one: [] for one in methods})[name].append(mae_mm)
        return {scene: np.array([*by_method.values()]) for scene, by_method in found.items()}

    def counted(self, methods: Sequence[str], group: str = "all", levels: str = "all") -> dict[str, int]:
        """Count the pixels of all images with an estimate (`pixels`) and without one (`missing`)."""
        chosen = LEVEL_GROUPS[levels]
        rows = [row for row in self.rows if row.method in methods and row.group == group]
        rows = [row for row in rows if chosen(row.signal, row.background)]
        return {"pixels": sum(row.pixels for row in rows), "missing": sum(row.missing for row in rows)}

    def summary(self, methods: Sequence[str]) -> JsonObject:
        """Return figures by level group and pixel group (means over scenes), intervals of the MAE, numbers of pixels
        with and without an estimate, and the bias by depth."""
        table: dict[str, Any] = {}
        for levels in LEVEL_GROUPS:
            table[levels] = {}
            for group in PIXELS:
                figures = (*FIGURES, "ssim") if group == "all" else FIGURES
                found = {name: self.interval(methods, group, levels, name) for name in figures}
                line: dict[str, Any] = {name: None if i is None else i.mean for name, i in found.items()}
                mae = found["mae_mm"]
                line["mae_interval_mm"] = None if mae is None else [mae.low, mae.high]
                table[levels][group] = line | self.counted(methods, group, levels)
        estimate, truth = (
            np.concatenate(parts) for parts in zip(*(pair for m in methods for pair in self.depths[m]), strict=True)
        )
        far = math.floor(float(np.nanmax(truth, initial=0.0))) + 1  # a depth of whole metres begins an interval
        return {**table, "bias_by_depth": [b._asdict() for b in bias_by_depth(estimate, truth, range(far + 1))]}


def _abs_error_mm(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.abs(estimate.astype(np.float64) - truth) * 1e3


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else math.nan


@dataclass(frozen=True)
class EvaluationPlan:
    """How views are sensed for an evaluation.

    levels     (signal, background) of each photon budget
    tile       rows and columns of which images are cut to whole numbers after sensing
    offset_m   moves the scenes away in time alone (`Transient.delayed`)
    seed       of the photons
    law        detection law, as of `spad.sense`; None: poisson, which networks are trained by, up to 1 % detections a
               cycle in the mean pixel of a level, and auto above
    """

    levels: Sequence[tuple[float, float]] = PHOTON_LEVELS
    tile: tuple[int, int] = (1, 1)
    offset_m: float = 0.0
    seed: int = 0
    law: Model | None = "poisson"


PUBLISHED_LEVELS = EvaluationPlan()


def evaluate(
    methods: Mapping[str, Method],
    views: Views,
    sensor: Sensor,
    plan: EvaluationPlan = PUBLISHED_LEVELS,
    *,
    progress: Progress | None = None,
    keep: KeepMap | None = None,
) -> Evaluation:
    """Sense every view at every level of the plan and apply all methods to it.

    `keep` is given every depth map, with its row of all pixels and the histogram that it is of. Sets rendered with
    other offsets than in time are given as they are. Raises InputError for an empty set or no method, an image smaller
    than a tile, and what the methods raise.
    """
    require(bool(views.transients) and bool(methods), "evaluation: no view or no method")
    for transient, scene in zip(views.transients, views.scenes, strict=True):  # told now, not after an hour
        lit = bool(transient.radiance.any())
        require(lit, f"evaluation: no light returns from a view of {scene}, its photons cannot be had")
    retain_freed_memory()
    report, result = progress or (lambda what, fraction: None), Evaluation(depths={name: [] for name in methods})
    total = len(views.transients) * len(plan.levels)
    for view, (transient, scene) in enumerate(zip(views.transients, views.scenes, strict=True)):
        moved = transient.delayed(plan.offset_m) if plan.offset_m else transient
        for number, (signal, background) in enumerate(plan.levels):
            report(f"{scene}, {signal:g} + {background:g} photons", (view * len(plan.levels) + number) / total)
            draw = np.random.SeedSequence(plan.seed, spawn_key=(Stream.EVALUATE, view, number)).generate_state(1)[0]
            budget = PhotonBudget(signal, background)
            histogram = sense(moved, sensor, budget, seed=int(draw), model=asked_law(plan.law, sensor, budget))
            result.plans.add(histogram, f"{scene}, {signal:g} + {background:g} photons", plan.law is None)
            histogram = _tiled(histogram, plan.tile)
            for name, method in methods.items():
                estimate = method(histogram)
                rows = [*_rows(name, scene, view, (signal, background), estimate, histogram)]
                result.rows += rows
                if keep is not None:
                    keep(rows[0], estimate, histogram)
                known = np.isfinite(histogram.depth_m) & (histogram.depth_m < recorded_range_m(histogram))
                result.depths[name].append((estimate[known], histogram.depth_m[known]))
    return result


def _tiled(histogram: Histogram, tile: tuple[int, int]) -> Histogram:
    """Crop a histogram to the first rows and columns that whole tiles cover; InputError where not one fits."""
    size = histogram.depth_m.shape
    rows, columns = (side // part * part for side, part in zip(size, tile, strict=True))
    fits = rows > 0 and columns > 0
    require(fits, f"image of {size[1]} x {size[0]} pixels is smaller than a block of {tile[1]} x {tile[0]}")
    cut = {name: getattr(histogram, name)[:rows, :columns].copy() for name in ("counts", *TRUTH)}
    return histogram if (rows, columns) == size else replace(histogram, **cut)


def _rows(
    method: str, scene: str, view: int, level: tuple[float, float], estimate: np.ndarray, histogram: Histogram
) -> Iterable[Row]:
    groups = grouped_errors(estimate, histogram.depth_m, histogram.mixed, recorded_range_m(histogram))
    for group, errors in groups.items():
        kept = {key: errors[key] for key in (*FIGURES, "pixels", "missing", "beyond_range")}
        law = histogram.meta["model"]
        yield Row(method, scene, view, *level, group, ssim=errors.get("ssim", math.nan), law=law, **kept)


def as_dicts(rows: Iterable[Row]) -> list[JsonObject]:
    return [asdict(row) for row in rows]
