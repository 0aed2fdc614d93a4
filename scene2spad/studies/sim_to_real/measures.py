"""Measure how a predicted histogram differs from a measured one: shape, amplitude, range, intervals, and the model's
error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import pdtr
from scipy.stats import poisson

from scene2spad.studies.sim_to_real.plan import FULL_BIN
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.json_types import JsonObject
from spad.zones.calibration import poisson_deviance

WINDOW = (-4, 8)  # bins around the fullest that a range is the centroid of


class Comparison(NamedTuple):
    """Differences between predicted and measured histograms of captures (N,) and zones (Z,), all (N, Z) float64.

    shape      nRMSE |n - s e| / |n|, s the ratio of sums; `floor` what photon noise alone makes of it
    amplitude  predicted over measured counts, less 1
    range_mm   measured less predicted depth, by the same centroid
    covered    share of bins under FULL_BIN counts inside their 95 % interval; `pit` share of their randomised
               probability integral transforms inside 2.5 to 97.5 %
    deviance   Poisson, a bin
    excess     of bins from FULL_BIN on: the mean square of (n - e) / e, photon noise taken out, so that it may be
               below 0
    """

    shape: np.ndarray
    floor: np.ndarray
    amplitude: np.ndarray
    range_mm: np.ndarray
    covered: np.ndarray
    pit: np.ndarray
    deviance: np.ndarray
    excess: np.ndarray

    @property
    def model_error(self) -> float:
        """Return the relative error of the model in bins from FULL_BIN on, of all captures and zones together; NaN
        without such bins.

        The root of the mean: of each by itself it would be above 0 by chance alone, and never below.
        """
        return float(np.sqrt(max(float(np.nanmean(self.excess)), 0.0)))


def compare(counts: np.ndarray, expected: np.ndarray, bin_width_s: float, seed: int = 0) -> Comparison:
    """Compare counts (N, Z, T) with expected counts (N, Z, T). NaN where there are no bins to judge by."""
    total = counts.sum(axis=2)
    scale = total / np.maximum(expected.sum(axis=2), 1e-9)
    norm = np.sqrt(np.maximum((counts.astype(np.float64) ** 2).sum(axis=2), 1.0))
    few = expected < FULL_BIN
    low, high = poisson.ppf(0.025, expected), poisson.ppf(0.975, expected)
    inside = (counts >= low) & (counts <= high)
    place = randomised_pit(counts, expected, seed)
    depth_mm = 1e3 * bin_width_s * SPEED_OF_LIGHT_M_PER_S / 2
    deviances = [
        [poisson_deviance(n, e) / n.size for n, e in zip(*pair, strict=True)]
        for pair in zip(counts, expected, strict=True)
    ]
    excess = ((counts - expected) ** 2 - expected) / np.maximum(expected, 1e-9) ** 2
    return Comparison(
        np.linalg.norm(counts - expected * scale[..., None], axis=2) / norm,
        np.sqrt(total * (1 - _concentration(expected))) / norm,
        1 / np.maximum(scale, 1e-9) - 1,
        (centroid(counts) - centroid(expected)) * depth_mm,
        _mean_where(inside, few),
        _mean_where((place >= 0.025) & (place <= 0.975), few),
        np.array(deviances),
        _mean_where(excess, ~few),
    )


def _concentration(expected: np.ndarray) -> np.ndarray:
    """Sum of squared shares of the bins (N, Z): what fitting the sum takes from the noise of the shape."""
    return (expected**2).sum(axis=2) / np.maximum(expected.sum(axis=2), 1e-9) ** 2


def _mean_where(values: np.ndarray, which: np.ndarray) -> np.ndarray:
    number = which.sum(axis=2)
    return np.where(number > 0, np.where(which, values, 0.0).sum(axis=2) / np.maximum(number, 1), np.nan)


def randomised_pit(counts: np.ndarray, expected: np.ndarray, seed: int = 0) -> np.ndarray:
    """Transform Poisson counts to P(N < n) + u P(N = n), u uniform, which is uniform for a true model."""
    below = np.where(counts > 0, pdtr(counts - 1.0, expected), 0.0)
    return below + np.random.default_rng(seed).random(counts.shape) * (
        pdtr(counts.astype(np.float64), expected) - below
    )


def centroid(histograms: np.ndarray) -> np.ndarray:
    """Return the centroid in bins (...,) of WINDOW around the fullest bin of histograms (..., T) less their median."""
    signal = np.maximum(histograms - np.median(histograms, axis=-1, keepdims=True), 0.0)
    bins = np.arange(signal.shape[-1])
    after = bins - signal.argmax(axis=-1)[..., None]
    window = np.where((after >= WINDOW[0]) & (after < WINDOW[1]), signal, 0.0)
    return window @ (bins + 0.5) / np.maximum(window.sum(axis=-1), 1e-9)


def summary(of: Comparison, which: np.ndarray) -> JsonObject:
    """Summarise some captures (a mask or indices) by zone: the numbers that bars are set on."""
    chosen = Comparison(*(values[which] for values in of))
    return {
        "captures": len(chosen.shape),
        "shape_median": np.median(chosen.shape, axis=0).tolist(),
        "noise_floor": np.median(chosen.floor, axis=0).tolist(),
        "amplitude_worst": np.abs(chosen.amplitude).max(axis=0).tolist(),
        "amplitude_mean": chosen.amplitude.mean(axis=0).tolist(),
        "range_bias_mm": chosen.range_mm.mean(axis=0).tolist(),
        "range_spread_mm": chosen.range_mm.std(axis=0).tolist(),
        "covered": float(np.nanmean(chosen.covered)),
        "pit_covered": float(np.nanmean(chosen.pit)),
        "deviance": float(chosen.deviance.mean()),
        "model_error": chosen.model_error,
    }
