"""Figures of merit of depth maps, the paper's groups of photon levels, and intervals over scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from scenes.errors import require
from spad.estimators.depth import depth_errors

LOW_SBR = 0.1  # the paper's two groups of levels: at most, and above
TOLERANCES_MM = (1, 5, 10, 20)
_SSIM_SIDE = 7  # pixels of scikit-image's window


def is_low_sbr(signal: float, background: float) -> bool:
    """Return whether signal / background is at most 0.1, without dividing by zero."""
    return signal <= LOW_SBR * background


def image_errors(
    estimate: np.ndarray, truth: np.ndarray, range_m: float | np.ndarray, exclude: np.ndarray | None = None
) -> dict:
    """Return `spad.estimators.depth.depth_errors` with the shares strictly within 1, 5, 10 and 20 mm of the pixels
    with and without an estimate, as there; depths (H, W) [m]."""
    errors = depth_errors(estimate, truth, range_m=range_m, exclude=exclude)
    error = np.abs(_error_mm(estimate, truth, range_m, exclude))
    asked = error.size + errors["missing"]
    fractions = {f"within_{t}mm": int((error < t).sum()) / asked if asked else math.nan for t in TOLERANCES_MM}
    return {**errors, **fractions}


def _error_mm(
    estimate: np.ndarray, truth: np.ndarray, range_m: float | np.ndarray, exclude: np.ndarray | None
) -> np.ndarray:
    keep = np.isfinite(truth) & (truth < range_m) & np.isfinite(estimate)
    keep = keep if exclude is None else keep & ~exclude
    return (estimate.astype(np.float64) - truth)[keep] * 1e3


def grouped_errors(
    estimate: np.ndarray, truth: np.ndarray, mixed: np.ndarray, range_m: float | np.ndarray
) -> dict[str, dict]:
    """Return `image_errors` of all pixels, of those with one surface, and of those where surfaces mix; SSIM of all."""
    left_out = {"all": None, "unmixed": mixed, "mixed": ~mixed}
    groups = {name: image_errors(estimate, truth, range_m, exclude) for name, exclude in left_out.items()}
    groups["all"]["ssim"] = ssim(estimate, truth, range_m)
    return groups


def ssim(estimate: np.ndarray, truth: np.ndarray, range_m: float | np.ndarray) -> float:
    """Return mean structural similarity (Wang et al. 2004, 7 x 7 windows) over the pixels that have a truth.

    The data range is that of the truth, so that a wild estimate cannot raise its own score. Where there is no truth,
    or no estimate, both are set to the truth's (mean) value. NaN for a truth that is flat, or under 7 pixels.
    """
    from skimage.metrics import structural_similarity

    known = np.isfinite(truth) & (truth < range_m)
    if min(truth.shape) < _SSIM_SIDE or not known.any():
        return math.nan
    span = float(truth[known].max() - truth[known].min())
    if span <= 0:
        return math.nan
    filled = np.where(known, truth, truth[known].mean()).astype(np.float64)
    shown = np.where(known & np.isfinite(estimate), estimate, filled).astype(np.float64)
    _, local = structural_similarity(filled, shown, win_size=_SSIM_SIDE, data_range=span, full=True)
    return float(local[known].mean())


class Bias(NamedTuple):
    """Signed error in one interval of depth [m]."""

    near_m: float
    far_m: float
    pixels: int
    mean_mm: float
    median_mm: float


def bias_by_depth(
    estimate: np.ndarray, truth: np.ndarray, edges_m: Sequence[float], exclude: np.ndarray | None = None
) -> list[Bias]:
    """Return mean and median of estimate - truth in intervals of true depth; those without a pixel are left out.

    What soft-argmax draws towards mid-range shows as a mean that falls with depth while the median stays.
    """
    found = []
    for near, far in pairwise(edges_m):
        outside = ~((truth >= near) & (truth < far))
        error = _error_mm(estimate, truth, math.inf, outside if exclude is None else outside | exclude)
        if error.size:
            found.append(Bias(near, far, error.size, float(error.mean()), float(np.median(error))))
    return found


INTERVAL_LEVEL = 0.95


class Interval(NamedTuple):
    """A mean over scenes with its interval of INTERVAL_LEVEL."""

    mean: float
    low: float
    high: float


def mean_over_scenes(values: Mapping[str, ArrayLike]) -> Interval:
    """Return mean of the scenes' means, and its 95 % interval: what other scenes, and other trainings, would give.

    values: scene -> (values,) or (seeds, values), the photon levels of that scene under one or several trainings. The
    levels belong to the question and are no sample: each scene counts by its mean over them. The interval is Student's,
    of variances of scenes and of seeds added, with the degrees of freedom of Welch and Satterthwaite (Satterthwaite
    1946, eq. 17). NaN values are left out. One scene gives an interval of NaN.
    """
    kept = [np.atleast_2d(np.asarray(v, float)) for v in values.values()]
    kept = [v for v in kept if np.isfinite(v).any()]
    require(bool(kept), "mean over scenes: no finite value")
    require(len({len(v) for v in kept}) == 1, "mean over scenes: scenes with different numbers of seeds")
    return _interval([float(np.nanmean(v)) for v in kept], _means_of_seeds(kept))


def _means_of_seeds(scenes: Sequence[np.ndarray]) -> list[float]:
    """Return each seed's mean over scenes; scenes are arrays (seeds, values), and NaN is left out."""
    by_seed = ([np.nanmean(one) for one in seed if np.isfinite(one).any()] for seed in zip(*scenes, strict=True))
    return [float(np.mean(means)) for means in by_seed if means]


def _interval(by_scene: Sequence[float], *by_seed: Sequence[float]) -> Interval:
    """Return the mean over scenes with its interval, in which the variances over each group of trainings are, too."""
    mean = float(np.mean(by_scene))
    if len(by_scene) < 2:
        return Interval(mean, math.nan, math.nan)
    parts = [(_variance_of_mean(values), len(values) - 1) for values in (by_scene, *by_seed) if len(values) > 1]
    variance = sum(part for part, _ in parts)
    if variance == 0:
        return Interval(mean, mean, mean)
    freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
    reach = _student_quantile(freedom) * math.sqrt(variance)
    return Interval(mean, mean - reach, mean + reach)


def _variance_of_mean(values: Sequence[float]) -> float:
    return float(np.var(values, ddof=1)) / len(values)


def _student_quantile(freedom: float) -> float:
    from scipy.special import stdtrit  # takes 0.3 s to import

    return float(stdtrit(freedom, 0.5 + INTERVAL_LEVEL / 2))


def paired_difference(first: Mapping[str, ArrayLike], second: Mapping[str, ArrayLike]) -> Interval:
    """Return mean of first - second, value by value, with its interval; both as in `mean_over_scenes`.

    What makes a scene or a level hard is in both and cancels. With as many seeds in both, seeds are paired, too. With
    other numbers of seeds the means over seeds are compared, and the variances over the seeds of either are added to
    that over scenes (Welch 1947). NaN values are left out, and where no value of both is finite the mean is NaN.
    """
    scenes = [scene for scene in first if scene in second]
    require(bool(scenes), "paired difference: the two have no scene in common")
    pairs = []
    for scene in scenes:
        a, b = (np.atleast_2d(np.asarray(v[scene], float)) for v in (first, second))
        require(a.shape[1] == b.shape[1], f"paired difference: scene {scene} has other levels in the two")
        pairs.append((a, b))
    if all(len(a) == len(b) for a, b in pairs):
        differences = {scene: a - b for scene, (a, b) in zip(scenes, pairs, strict=True)}
        nothing = not any(np.isfinite(values).any() for values in differences.values())
        return Interval(math.nan, math.nan, math.nan) if nothing else mean_over_scenes(differences)
    return _unpaired_seeds(pairs)


def _unpaired_seeds(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Interval:
    """Return the mean difference of scenes (seeds, values) that have other numbers of seeds in both, with its
    interval."""
    ours, theirs = [], []  # each seed against the mean of the other's seeds
    for a, b in pairs:
        known = np.isfinite(a).any(0) & np.isfinite(b).any(0)
        if known.any():
            a, b = a[:, known], b[:, known]
            ours.append(a - np.nanmean(b, 0))
            theirs.append(b - np.nanmean(a, 0))
    if not ours:
        return Interval(math.nan, math.nan, math.nan)
    gaps = [float(np.nanmean(np.nanmean(a, 0))) for a in ours]  # each level once, whatever seeds have a value there
    return _interval(gaps, _means_of_seeds(ours), _means_of_seeds(theirs))
