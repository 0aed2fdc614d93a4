"""The normal distribution and the complementary error function of arrays. `scipy.special` takes 0.3 s to import."""

from __future__ import annotations

import math

import numpy as np

_ERFC = np.frompyfunc(math.erfc, 1, 1)  # of the C library, within an ulp or two; arrays here have some thousand values


def erfc(x: np.ndarray | float) -> np.ndarray:
    """Return the complementary error function, 2/sqrt(pi) times the integral of exp(-t^2) from x on, float64."""
    return np.asarray(_ERFC(np.asarray(x, dtype=np.float64)), dtype=np.float64)


def erfcx_far(x: np.ndarray) -> np.ndarray:
    """Return exp(x^2) erfc(x), the scaled complementary error function, float64, for x of 20 and more.

    By the asymptotic series 1 / (x sqrt(pi)) sum_n (-1)^n (2n - 1)!! / (2 x^2)^n; eight terms are exact to rounding.
    """
    inverse = 0.5 / np.asarray(x, dtype=np.float64) ** 2
    total = np.ones_like(inverse)
    for term in range(8, 0, -1):
        total = 1 - (2 * term - 1) * inverse * total
    return total / (x * math.sqrt(math.pi))


def ndtr(x: np.ndarray | float) -> np.ndarray:
    """Return the cumulative standard normal distribution, float64."""
    return 0.5 * erfc(-np.asarray(x, dtype=np.float64) / math.sqrt(2))
