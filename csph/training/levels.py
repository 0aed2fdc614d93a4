"""Photon levels that a patch is trained at: a list, as published, or drawn from a continuous range."""

from __future__ import annotations

import math

import numpy as np

CONTINUOUS = "continuous"
SIGNAL = (1.0, 100.0)  # mean signal photons, log-uniform
BACKGROUND = (0.5, 1200.0)  # mean background photons: the 16 test levels have 2 to 1000
HARDEST = 0.25  # least signal / sqrt(background); the test levels' is 0.28
HARD_WEIGHT = 0.6  # below 1, strong backgrounds are drawn more often than log-uniformly

Level = tuple[float, float]
Levels = tuple[Level, ...] | str


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
