"""Photon levels: the paper's 16, and those that a patch is trained at, a list or drawn from a continuous range."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np

from scenes.errors import require
from scenes.random_streams import Stream

# mean signal and background photons of the 16 test levels; training draws from the first nine
PHOTON_LEVELS: tuple[tuple[float, float], ...] = (
    *((signal, background) for signal in (10.0, 5.0, 2.0) for background in (2.0, 10.0, 50.0)),
    *((10.0, background) for background in (200.0, 500.0, 1000.0)),
    *((50.0, background) for background in (50.0, 200.0, 500.0, 1000.0)),
)
TRAIN_LEVELS = PHOTON_LEVELS[:9]

CONTINUOUS = "continuous"
SIGNAL = (1.0, 100.0)  # mean signal photons, log-uniform
BACKGROUND = (0.5, 1200.0)  # mean background photons: the 16 test levels have 2 to 1000
HARDEST = 0.25  # least signal / sqrt(background); the test levels' is 0.28
HARD_WEIGHT = 0.6  # below 1, strong backgrounds are drawn more often than log-uniformly

Level = tuple[float, float]
Levels = tuple[Level, ...] | str


def checked_levels(levels: Levels) -> Levels:
    """Return levels, pairs or rows of an array, as a tuple of pairs, or "continuous". Raises InputError for anything
    else, none, levels without signal, and photons that cannot be."""
    if isinstance(levels, str):
        require(levels == CONTINUOUS, f"training: levels {levels!r}, expected a list or {CONTINUOUS}")
        return levels
    expected = "expected pairs of signal and background photons, finite and not negative, signal above 0"
    levels = levels.tolist() if isinstance(levels, np.ndarray) else levels
    pairs = list(levels) if isinstance(levels, list | tuple) else [levels]
    require(bool(pairs), "training: no photon level")
    for pair in pairs:
        good = isinstance(pair, list | tuple) and len(pair) == 2
        good = good and all(isinstance(mean, Real) and not isinstance(mean, bool) for mean in pair)
        good = good and 0 < float(pair[0]) < math.inf and 0 <= float(pair[1]) < math.inf
        require(good, f"training: level {pair!r}, {expected}")
    return tuple((float(signal), float(background)) for signal, background in pairs)


def dealt_levels(levels: tuple[Level, ...], views: int, first: int = 0) -> list[Level]:
    """Deal levels to views, from the `first`-th on: every one once in each round of as many views as there are levels.

    A round has an order of its own, drawn from its number alone: in step with nothing that a set may repeat, as the
    views of a room do, and the same for every training.
    """
    rounds = range(first // len(levels), (first + views) // len(levels) + 1)
    orders = [np.random.default_rng(np.random.SeedSequence(n, spawn_key=(Stream.VALIDATE,))) for n in rounds]
    dealt = [levels[i] for order in orders for i in order.permutation(len(levels))]
    skipped = first % len(levels)
    return dealt[skipped : skipped + views]


def draw_level(rng: np.random.Generator, levels: Levels) -> Level:
    """Draw mean (signal, background) photons: one of a list, or, for "continuous", signal log-uniform from 1 to 100,
    and background from 0.5 to 1200 as far as signal / sqrt(background) stays at or above 0.25.

    The background is exp(low + (high - low) u^0.6) for a uniform u, so that the harder half of its range (in
    logarithms) is drawn 68 times of 100.
    """
    if not isinstance(levels, str):
        return levels[rng.integers(len(levels))]
    low, high = map(math.log, SIGNAL)
    signal = math.exp(rng.uniform(low, high))
    least, most = math.log(BACKGROUND[0]), math.log(min(BACKGROUND[1], (signal / HARDEST) ** 2))
    return signal, math.exp(least + (most - least) * rng.random() ** HARD_WEIGHT)
