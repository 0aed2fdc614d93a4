"""Saturation of a converter that many detectors share: the exact first-photon law, behind detectors that take cycles to
recover.

A zone sums converters and laser cycles: `trials` pairs of the two. In a trial a converter times the first detection
of its detectors and none after it. A detection, timed or not, also blinds its detector for r further cycles. Each of K
detectors sees a K-th of the light, and of its cycles the share 1 / (1 + r q) is armed, q = 1 - exp(-flux / K): renewal
theory. Of many detectors armed = 1 / (1 + recovery flux), recovery = r / K and the flux that of one trial: all light,
background as well, is detected less by this factor, and then the first photon is taken.

`compression` is no law but a description: a bin of n counts keeps n / (1 + compression n / trials).
"""

from __future__ import annotations

import numpy as np

MANY_TRIALS = 1e15  # above them a multinomial of 2^31 counts is Poisson to 2e-6
PerZone = float | np.ndarray  # one number, or one of each zone (Z,)


def armed_fraction(flux: np.ndarray, trials: np.ndarray, recovery: PerZone) -> np.ndarray:
    """Return the share of a zone's detectors that are armed: flux (Z, T) detections a histogram -> (Z,)."""
    return 1 / (1 + recovery * flux.sum(axis=-1) / trials)


def saturated(flux: np.ndarray, trials: np.ndarray, recovery: PerZone, compression: PerZone = 0.0) -> np.ndarray:
    """Return counts (Z, T) expected of a flux (Z, T) of primary detections; `trials` (Z,), infinite for none lost.

    n_k = trials x exp(-sum_(j<k) mu_j) (1 - exp(-mu_k)), mu = armed x flux / trials; then the compression.
    """
    mu = flux * (armed_fraction(flux, trials, recovery) / trials)[:, None]
    before = np.cumsum(mu, axis=-1) - mu
    finite = np.isfinite(trials)[:, None]
    scale = np.where(finite, trials[:, None], 1.0)
    first = np.where(finite, scale * np.exp(-before) * -np.expm1(-mu), flux)
    return first / (1 + np.reshape(compression, (-1, 1)) * first / trials[:, None])


def draw_saturated(
    flux: np.ndarray, trials: np.ndarray, recovery: PerZone, rng: np.random.Generator, compression: PerZone = 0.0
) -> np.ndarray:
    """Draw counts (Z, T) int64 of one exposure: Poisson without saturation, with it the multinomial of all trials,
    which is Poisson again above MANY_TRIALS.

    Of trials that are no whole number, as a fit gives them, the last takes place with the probability of its fraction:
    the mean is that of `saturated`. What the compression takes is thinned from the bins.
    """
    counts = np.empty(flux.shape, dtype=np.int64)
    expected = saturated(flux, trials, recovery)
    for zone, mean in enumerate(expected):
        if trials[zone] > MANY_TRIALS:  # also where they are infinite: nothing is lost
            counts[zone] = rng.poisson(mean)
            continue
        cycles = int(trials[zone]) + rng.binomial(1, trials[zone] % 1)
        masses = mean / trials[zone]
        counts[zone] = rng.multinomial(cycles, np.append(masses, max(0.0, 1 - masses.sum())))[:-1]
    if not np.any(compression):
        return counts
    return rng.binomial(counts, 1 / (1 + np.reshape(compression, (-1, 1)) * expected / trials[:, None]))


def saturated_jacobian(
    flux: np.ndarray, jacobian: np.ndarray, trials: np.ndarray, recovery: PerZone, compression: PerZone = 0.0
) -> np.ndarray:
    """Apply the chain rule through `saturated` to a flux (Z, T) and its derivatives (Z, T, P)."""
    armed = armed_fraction(flux, trials, recovery)
    mu = flux * (armed / trials)[:, None]
    blinded = (recovery * armed**2 / trials)[:, None] * jacobian.sum(axis=1)  # of `armed`: (Z, P), falling
    dmu = (armed[:, None, None] * jacobian - flux[..., None] * blinded[:, None]) / trials[:, None, None]
    after, dafter = np.cumsum(mu, axis=1), np.cumsum(dmu, axis=1)
    left, right = np.exp(mu - after)[..., None], np.exp(-after)[..., None]
    finite = np.isfinite(trials)[:, None, None]
    scale = np.where(finite, trials[:, None, None], 1.0)
    slope = np.where(finite, scale * (right * dafter - left * (dafter - dmu)), jacobian)
    first = saturated(flux, trials, recovery)
    return slope / (1 + np.reshape(compression, (-1, 1)) * first / trials[:, None])[..., None] ** 2
