"""Saturation of many detectors that share one histogram: the exact first-photon law with a recovery that takes cycles.

A zone sums detectors and laser cycles: `trials` pairs of the two. In a trial an armed detector counts its first photon
and none after it. A detection also costs the detector `recovery` of its next cycles on average: floor(recovery), and
one more by chance. Of all trials the share 1 / (1 + recovery q) is armed, q = 1 - exp(-flux per trial): renewal theory.

`compression` is no law but a description: a bin of n counts keeps n / (1 + compression n / trials). A TMF8820 near a
plane loses more in its fullest bins than first photons explain.
"""

from __future__ import annotations

import math

import numpy as np

PerZone = float | np.ndarray  # one number, or one of each zone (Z,)


def armed_fraction(flux: np.ndarray, trials: np.ndarray, recovery: PerZone) -> np.ndarray:
    """Return the share of trials that begin armed: flux (Z, T) detections a histogram -> (Z,)."""
    return 1 / (1 - recovery * np.expm1(-flux.sum(axis=-1) / trials))


def saturated(flux: np.ndarray, trials: np.ndarray, recovery: PerZone, compression: PerZone = 0.0) -> np.ndarray:
    """Return counts (Z, T) expected of a flux (Z, T) of primary detections; `trials` (Z,), infinite for none lost.

    n_k = trials x armed x exp(-sum_(j<k) mu_j) (1 - exp(-mu_k)), mu the flux of one trial; then the compression.
    """
    mu = flux / trials[:, None]
    before = np.cumsum(mu, axis=-1) - mu
    armed = armed_fraction(flux, trials, recovery)[:, None]
    finite = np.isfinite(trials)[:, None]
    scale = np.where(finite, trials[:, None], 1.0)
    first = np.where(finite, scale * armed * np.exp(-before) * -np.expm1(-mu), flux)
    return first / (1 + np.reshape(compression, (-1, 1)) * first / trials[:, None])


def draw_saturated(
    flux: np.ndarray, trials: np.ndarray, recovery: PerZone, rng: np.random.Generator, compression: PerZone = 0.0
) -> np.ndarray:
    """Draw counts (Z, T) int64 of one exposure.

    Without saturation Poisson. With it the number of detections is drawn from the renewal process in its central limit
    (mean N a q, variance N a^3 q (1 - q), a the armed share), and their bins from the law's shares, exactly; what the
    compression takes is thinned from the bins.
    """
    counts = np.empty(flux.shape, dtype=np.int64)
    expected = saturated(flux, trials, recovery)
    armed = armed_fraction(flux, trials, recovery)
    for zone, mean in enumerate(expected):
        if not math.isfinite(trials[zone]):
            counts[zone] = rng.poisson(flux[zone])
            continue
        q = -math.expm1(-flux[zone].sum() / trials[zone])
        free = rng.binomial(max(1, round(trials[zone] * armed[zone])), q)
        total = max(0, round(mean.sum() + (free - mean.sum()) * armed[zone]))
        counts[zone] = rng.multinomial(total, mean / mean.sum()) if mean.sum() > 0 else 0
    if not np.any(compression):
        return counts
    return rng.binomial(counts, 1 / (1 + np.reshape(compression, (-1, 1)) * expected / trials[:, None]))


def saturated_jacobian(
    flux: np.ndarray, jacobian: np.ndarray, trials: np.ndarray, recovery: PerZone, compression: PerZone = 0.0
) -> np.ndarray:
    """Apply the chain rule through `saturated` to a flux (Z, T) and its derivatives (Z, T, P)."""
    mu, dmu = flux / trials[:, None], jacobian / trials[:, None, None]
    after, dafter = np.cumsum(mu, axis=1), np.cumsum(dmu, axis=1)
    before, dbefore = after - mu, dafter - dmu
    armed = armed_fraction(flux, trials, recovery)
    first = saturated(flux, trials, recovery)
    finite = np.isfinite(trials)
    scale = np.where(finite, trials, 1.0) * armed
    left, right = np.exp(-before)[..., None], np.exp(-after)[..., None]
    slope = scale[:, None, None] * (right * dafter - left * dbefore)
    slope -= (recovery * armed * np.exp(-after[:, -1]))[:, None, None] * first[..., None] * dafter[:, -1:, :]
    slope = np.where(finite[:, None, None], slope, jacobian)
    return slope / (1 + np.reshape(compression, (-1, 1)) * first / trials[:, None])[..., None] ** 2
