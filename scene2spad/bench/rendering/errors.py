"""Measure the error of a histogram against two independent halves of a reference whose own noise cancels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.special import erf

from scenes.constants import REFERENCE_BINS, REFERENCE_PERIOD_S, REFERENCE_PULSE_SIGMA_S

PULSE_SIGMA_BINS = REFERENCE_PULSE_SIGMA_S * REFERENCE_BINS / REFERENCE_PERIOD_S
ROWS = 512  # pixels a block
STEP = 64  # bins a block
FIREFLY, FIREFLY_TIMES = 0.002, 100
KINDS = ("raw", "pulse")


def pulse_kernel(sigma_bins: float = PULSE_SIGMA_BINS) -> np.ndarray:
    """Return weights of bins 0, 1, 2, ... away from a pulse at a bin's centre: Phi over each bin; both sides sum to
    1."""
    edge = np.arange(math.ceil(5 * sigma_bins) + 2) - 0.5
    weight = np.diff(0.5 * (1 + erf(edge / (sigma_bins * math.sqrt(2)))))
    return weight / (weight[0] + 2 * weight[1:].sum())


@cache
def _band() -> tuple[int, np.ndarray]:
    """Return the kernel's reach r [bins] and its band matrix, (STEP + 2 r, STEP) float32."""
    kernel = pulse_kernel()
    reach = len(kernel) - 1
    lag = np.abs(np.arange(STEP + 2 * reach)[:, None] - reach - np.arange(STEP))
    return reach, np.where(lag <= reach, kernel[np.minimum(lag, reach)], 0).astype(np.float32)


def pulsed(histogram: np.ndarray) -> np.ndarray:
    """Return (pixels, bins) after the Gaussian pulse; what it pushes past the first and last bin is dropped."""
    reach, band = _band()
    pixels, bins = histogram.shape
    padded = np.zeros((pixels, bins + 2 * reach), np.float32)
    padded[:, reach : reach + bins] = histogram
    result = np.empty((pixels, bins), np.float32)
    for start in range(0, bins, STEP):  # a matrix product a block of bins: several times faster than shifted sums
        width = min(STEP, bins - start)
        np.matmul(padded[:, start : start + width + 2 * reach], band[: width + 2 * reach, :width],
                  out=result[:, start : start + width])  # fmt: skip
    return result


def crosswise(deviation_a: np.ndarray, deviation_b: np.ndarray) -> np.ndarray:
    """Sum over bins of the product of two deviations, per pixel (pixels,), raw and after the pulse: (2, pixels)."""
    sums = np.empty((2, len(deviation_a)))
    for start in range(0, len(deviation_a), ROWS):
        block = slice(start, start + ROWS)
        a, b = deviation_a[block], deviation_b[block]
        sums[0, block] = np.einsum("ij,ij->i", a, b)
        sums[1, block] = np.einsum("ij,ij->i", pulsed(a), pulsed(b))
    return sums


@dataclass(frozen=True, eq=False)
class Reference:
    """Two independent unbiased estimates of one histogram, (pixels, bins) float32 each, and who made them.

    kept        pixels that are judged. One that alone gives the reference more than 0.2 % of noise, and 100 times the
                mean pixel's, holds a firefly (a glint that few samples meet): nothing can be said about it
    power       sum of A * B per pixel (raw, pulse), (2, pixels): unbiased for the squared truth; 0 where not kept
    noise       nRMSE of the mean of the halves, ||A - B|| / 2 (raw, pulse)
    resolution  error below which `Judge` sees no difference (raw, pulse): two standard deviations of what an exact x
                gives, sum (mu - A)(mu - B); its variance is sum (A - B)^4 / 12 for Gaussian noise, bins independent
    """

    a: np.ndarray
    b: np.ndarray
    maker: str
    kept: np.ndarray = field(init=False)
    power: np.ndarray = field(init=False)
    noise: tuple[float, float] = field(init=False)
    resolution: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        power, second, fourth = (np.empty((2, len(self.a))) for _ in range(3))
        for start in range(0, len(self.a), ROWS):
            block = slice(start, start + ROWS)
            a, b = self.a[block], self.b[block]
            for kind, (x, y) in enumerate(((a, b), (pulsed(a), pulsed(b)))):
                power[kind, block] = np.einsum("ij,ij->i", x, y)
                squared = (x - y).astype(np.float64) ** 2
                second[kind, block], fourth[kind, block] = squared.sum(axis=1), (squared**2).sum(axis=1)
        kept = (second[0] / 4 <= FIREFLY**2 * power[0].sum()) | (second[0] <= FIREFLY_TIMES * second[0].mean())
        power[:, ~kept] = 0
        whole = np.maximum(power.sum(axis=1), 1e-300)
        # the pulse correlates neighbours by exp(-k^2 / (4 sigma^2)): its squares sum to sigma sqrt(2 pi)
        variance = fourth[:, kept].sum(axis=1) / 12 * (1, math.sqrt(2 * math.pi) * PULSE_SIGMA_BINS)
        object.__setattr__(self, "kept", kept)
        object.__setattr__(self, "power", power)
        object.__setattr__(self, "noise", _pair(np.sqrt(second[:, kept].sum(axis=1) / whole) / 2))
        object.__setattr__(self, "resolution", _pair(np.sqrt(2 * np.sqrt(variance) / whole)))

    @property
    def left_out(self) -> int:
        """Number of pixels that are not judged."""
        return int((~self.kept).sum())

    def energy(self) -> float:
        """Return the sum of the mean of the halves over all judged pixels and bins [1/(m^2 sr)]."""
        return (radiance(self.a, self.kept) + radiance(self.b, self.kept)) / 2


def radiance(histogram: np.ndarray, kept: np.ndarray) -> float:
    """Sum over the kept pixels and all bins."""
    return float(histogram.sum(axis=1, dtype=np.float64)[kept].sum())


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


@dataclass(frozen=True)
class Errors:
    """Relative errors of one method at one quality (raw, pulse). Estimates that came out negative are 0.

    nrmse    root of E ||x - mu||^2 / ||mu||^2
    bias     the same of the mean over infinitely many seeds, from pairs of different seeds; 0 where it is not two
             standard deviations above 0, NaN from one seed alone
    pixel    median and 95th percentile over pixels of the per-pixel relative error after the pulse
    energy   ratio of the summed radiance to the reference's
    """

    nrmse: tuple[float, float]
    bias: tuple[float, float]
    pixel: tuple[float, float]
    energy: float


class Judge:
    """Collects runs x_1 .. x_n of one method against a reference (A, B).

    Squared error  = mean_i sum (x_i - A)(x_i - B) / sum A B: unbiased, since the halves' noise is independent.
    Squared bias   = mean_{i != j} sum (x_i - A)(x_j - B) / sum A B: the runs' own noise cancels as well.
    """

    def __init__(self, reference: Reference) -> None:
        self.reference = reference
        self.squared = np.zeros_like(reference.power)
        self.total: np.ndarray | None = None
        self.runs = 0

    def add(self, histogram: np.ndarray) -> None:
        """Judge one run, (pixels, bins) float32; it is not kept."""
        self.squared += self.reference.kept * crosswise(histogram - self.reference.a, histogram - self.reference.b)
        if self.total is None:
            self.total = np.array(histogram, dtype=np.float32)
        else:
            self.total += histogram
        self.runs += 1

    def errors(self) -> Errors:
        assert self.total is not None, "errors of no run"
        whole = self.reference.power.sum(axis=1)
        square = self.squared.sum(axis=1) / self.runs
        nrmse = _root(square[0], whole[0]), _root(square[1], whole[1])
        bias = (math.nan, math.nan)
        n = np.float32(self.runs)
        if self.runs > 1:
            together = crosswise(self.total - n * self.reference.a, self.total - n * self.reference.b)
            pairs = self.reference.kept * (together - self.squared) / (self.runs * (self.runs - 1))
            # without a bias every pixel's sum has mean 0, and its square is its variance
            clear = pairs.sum(axis=1) > 2 * np.sqrt((pairs**2).sum(axis=1))
            square = np.where(clear, pairs.sum(axis=1), 0)
            bias = _root(square[0], whole[0]), _root(square[1], whole[1])
        power = self.reference.power[1]
        lit = power > 0
        relative = np.sqrt(np.maximum(self.squared[1][lit] / self.runs, 0) / power[lit])
        middle, high = np.quantile(relative, (0.5, 0.95)) if lit.any() else (math.nan, math.nan)
        pixel = float(middle), float(high)
        energy = radiance(self.total, self.reference.kept) / self.runs / max(self.reference.energy(), 1e-300)
        return Errors(nrmse, bias, pixel, energy)


def _root(square: float, whole: float) -> float:
    return math.sqrt(max(float(square), 0.0) / whole) if whole > 0 else math.nan
