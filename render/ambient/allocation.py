"""Allocate paths of ambient light to pixels: most where their light differs most.

A pixel that sees a lamp takes hundreds of times as many paths as one that sees a lit wall. How many is seen in the
first paths. Were it seen in a pixel's own, a rare bright path would bring more paths, which outvote it, and the
estimate would be too dark. So the paths of a pixel are two streams. Each takes as many as the other's first paths, and
those of the pixels around, ask for: no path's light decides in how large a mean it is taken, and the mean of the two
streams' means is unbiased.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

STREAMS = 2  # of a pixel's paths: set s belongs to stream s modulo STREAMS
AROUND = 5  # pixels a side, whose variance counts as much as a pixel's own
FLOOR = 0.1  # of the mean variance, which every pixel has at least: what is rare the first paths have not met
MOST = 256.0  # of the mean number


def relative_numbers(sums: np.ndarray, number: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return relative numbers of paths, (STREAMS, pixels), mean 1, from the first paths: their sums and numbers (SETS,
    pixels).

    The squared error of the image at a given number of paths is least where each pixel's number goes with the root of
    its paths' variance.
    """
    of_set = (sums / number).reshape(-1, STREAMS, sums.shape[1])
    variance = of_set.var(axis=0, ddof=1) * number.reshape(of_set.shape).mean(axis=0)
    own = variance.mean(axis=0).reshape(shape)
    inside = uniform_filter(np.ones(shape), AROUND, mode="constant")
    alone = 1 / AROUND**2
    around = (uniform_filter(own, AROUND, mode="constant") - alone * own) / np.maximum(inside - alone, alone)
    expected = (variance[::-1] + np.maximum(around, 0).ravel()) / 2 + FLOOR * variance.mean()
    if not expected.any():
        return np.ones_like(expected)
    relative = np.sqrt(expected)
    return np.minimum(relative / relative.mean(), MOST)


def numbers_for(mean: float, relative: np.ndarray, present: np.ndarray, step: int) -> np.ndarray:
    """Return paths of each stream and pixel, (STREAMS, pixels) int64, in steps, by their relative numbers.

    None has fewer than are present. The mean over pixels and streams is at least `mean`, by less than a step more.
    """

    def at(scale: float) -> np.ndarray:
        return np.maximum(present, step * np.ceil(scale * relative / step)).astype(np.int64)

    low, high = 0.0, mean / relative.mean()
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if at(middle).mean() < mean else (low, middle)
    return at(high)
