"""Compute what a sensor stores and sends with and without compressive histograms (supplement S.6, Table 1).

A histogram tensor of N counts in B blocks of M = N/B counts each keeps B K codes; the sensor also holds the K coding
tensors, once for all blocks, in as many bits a number as counts. Needs numpy alone; every argument may be an array.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scenes.errors import require

SEPARABLE_FACTOR = 16.0  # how much smaller a separable tensor is than a full one in Figure 16


def transmitted(compressive: ArrayLike, codes: ArrayLike) -> np.ndarray:
    """Count the numbers that leave the sensor: B K."""
    return np.asarray(compressive, dtype=float) * np.asarray(codes, dtype=float)


def stored(counts: ArrayLike, compressive: ArrayLike, codes: ArrayLike, factor: float = 1.0) -> np.ndarray:
    """Count the numbers that stay in the sensor: K (B + M / factor), M = N / B; factor is 1 for full coding tensors."""
    blocks, k = np.asarray(compressive, dtype=float), np.asarray(codes, dtype=float)
    require(
        bool((blocks > 0).all() and (k > 0).all()) and factor > 0, "memory: blocks, codes and factor must be positive"
    )
    return k * (blocks + np.asarray(counts, dtype=float) / blocks / factor)


def data_compression(counts: ArrayLike, compressive: ArrayLike, codes: ArrayLike) -> np.ndarray:
    """Return how many times less data leave the sensor than without compression: N / (B K)."""
    return np.asarray(counts, dtype=float) / transmitted(compressive, codes)


def memory_compression(counts: ArrayLike, compressive: ArrayLike, codes: ArrayLike, factor: float = 1.0) -> np.ndarray:
    """Return how many times less memory the sensor needs than without compression: N / (K (B + M / factor)).

    Below 1 the codes and their tensors need more memory than the histogram.
    """
    return np.asarray(counts, dtype=float) / stored(counts, compressive, codes, factor)


def best_blocks(counts: ArrayLike, factor: float = 1.0) -> np.ndarray:
    """Return the number of blocks sqrt(N / factor) at which `memory_compression` is largest, whatever K: B = M /
    factor."""
    return np.sqrt(np.asarray(counts, dtype=float) / factor)


def separable_factor(bins: int, rows: int, columns: int) -> float:
    """Return Mt Mr Mc / (Mt + Mr Mc): how much smaller a separable tensor of this block is than a full one."""
    return bins * rows * columns / (bins + rows * columns)
