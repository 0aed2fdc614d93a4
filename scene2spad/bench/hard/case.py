"""Define hard cases, and compare their renders with an oracle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scene2spad.bench.hard.oracles import Moments
from scenes.model import Scene

# Independent renders behind a Monte-Carlo limit. Only they tell the error of an image's mean: paths may be shared, so
# that pixels of one render are not independent, and the errors of its pixels do not add as squares.
RENDERS = 16
FALSE_ALARM = 1e-4


class Measured(NamedTuple):
    """An error and the limit it must keep, both relative unless the quantity's name has a unit."""

    error: float
    limit: float

    @property
    def fraction(self) -> float:
        """Error in units of its limit; a limit of 0 allows no error at all."""
        if not math.isfinite(self.error):
            return math.inf
        return self.error / self.limit if self.limit > 0 else math.inf if self.error > 0 else 0.0


class Outcome(NamedTuple):
    """Result of a case: errors by quantity, and how many footprints or sums its renders had to clip."""

    errors: dict[str, Measured]
    clipped: int


@dataclass(frozen=True)
class Case:
    """A named hard case: what its oracle is, in one line, and a function of the seed that renders and measures."""

    name: str
    oracle: str
    measure: Callable[[int], Outcome]
    slow: bool = False


def clipped(*transients: Transient) -> int:
    """Return everything that the renders say they clipped or could not hold."""
    counters = ("clipped_footprints", "overflowed", "clipped_samples")
    return sum(int(transient.meta.get(name, 0)) for transient in transients for name in counters)


def moments_of(transient: Transient, kept: np.ndarray | None = None) -> Moments:
    """Return per pixel: total radiance, mean path and the path's standard deviation (intervals included) of kept
    returns."""
    kept = np.ones(transient.returns, bool) if kept is None else kept
    pixel, shape = transient.return_pixel[kept], (transient.height, transient.width)
    near, far = transient.path_near_m[kept].astype(float), transient.path_far_m[kept].astype(float)
    radiance = transient.radiance[kept].astype(float)
    total = np.bincount(pixel, radiance, transient.height * transient.width)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(pixel, radiance * (near + far) / 2, total.size) / total
        second = ((near + far) / 2 - mean[pixel]) ** 2 + (far - near) ** 2 / 12
        deviation = np.sqrt(np.bincount(pixel, radiance * second, total.size) / total)
    return Moments(total.reshape(shape), mean.reshape(shape), deviation.reshape(shape))


def centre_path_m(transient: Transient) -> np.ndarray:
    """Return the middle of every return's path interval [m], float64."""
    return (transient.path_near_m.astype(float) + transient.path_far_m) / 2


def worst(got: np.ndarray, expected: np.ndarray) -> float:
    """Return largest relative difference; infinite where something is missing."""
    return float(np.nan_to_num(np.abs(got / expected - 1), nan=np.inf).max())


def farthest_m(got: np.ndarray, expected: np.ndarray | float) -> float:
    """Return largest difference; infinite where something is missing."""
    return float(np.nan_to_num(np.abs(got - expected), nan=np.inf).max())


def nrmse(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


def relative(got: float, expected: float) -> float:
    return abs(float(got) / float(expected) - 1)


def over_renders(values: list[float], bias: float = 0.0) -> Measured:
    """Return the mean of an error that independent renders measured, against what its scatter allows.

    The limit is Student's t with n - 1 degrees of freedom at a two-sided FALSE_ALARM, times the standard error of the
    mean, and what the comparison itself is off by.
    """
    quantile = float(stats.t.ppf(1 - FALSE_ALARM / 2, len(values) - 1))
    return Measured(abs(float(np.mean(values))), quantile * float(stats.sem(values)) + bias)


def independent(scene: Scene, settings: RenderSettings, seed: int) -> list[Transient]:
    """Return RENDERS renders whose seeds follow from one."""
    seeds = np.random.SeedSequence(seed).generate_state(RENDERS)
    return [render(scene, settings, seed=int(one)) for one in seeds]
