"""Exact products of histograms with a program's integer table, by matrix products of floating point.

Sums below 2^24 are exact in float32. A table of equal blocks along its diagonal (codes over blocks of timestamps) is
one block, and each histogram several. (Adding and subtracting the halves of histograms first, as even and odd harmonics
allow, halves the multiplications, but made a frame only 15 % faster: it is not done.)
The plain form is `ultraphase.reference.add_photons`.
"""

from __future__ import annotations

import numpy as np

from scenes.errors import require

_EXACT_IN_FLOAT32 = 1 << 24
_CHUNK_BYTES = 1 << 19  # of histograms in bytes at a time: their floats, and all else, stay in a cache
_ONE_THREAD = 1 << 18  # multiplications of a product that OpenBLAS does without threads, at most


def photon_sums(histograms: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Multiply counts (pixels, timestamps) of any integer type with a table (timestamps, numbers) of integers.

    Returns (pixels, numbers) int64, exact. Raises InputError for negative counts.
    """
    (count, bins), numbers = histograms.shape, table.shape[1]
    blocks = equal_blocks(table)
    if blocks > 1:
        parts = np.ascontiguousarray(histograms).reshape(count * blocks, bins // blocks)
        return photon_sums(parts, table[: bins // blocks, : numbers // blocks]).reshape(count, numbers)
    chunk = 1 << max(0, (_CHUNK_BYTES // bins).bit_length() - 1)
    product, result = _Product(table, chunk), np.empty((count, numbers), np.int64)
    largest = max(int(np.abs(table).max()), 1)
    for first in range(0, count, chunk):
        part = histograms[first : first + chunk]
        if largest * _most_photons(part) < _EXACT_IN_FLOAT32:
            result[first : first + chunk] = product.of_histograms(part)
        else:  # exact to 2^53
            result[first : first + chunk] = part.astype(np.float64) @ table.astype(np.float64)
    return result


def equal_blocks(table: np.ndarray) -> int:
    """Return how many equal blocks along its diagonal a table (timestamps, numbers) consists of, zero elsewhere; a
    power of two."""
    bins, numbers = table.shape
    found = 1
    while found * 2 <= numbers and bins % (found * 2) == 0 and numbers % (found * 2) == 0:
        found *= 2
    while found > 1:
        block = table[: bins // found, : numbers // found]
        if np.array_equal(np.kron(np.eye(found, dtype=table.dtype), block), table):
            return found
        found //= 2
    return 1


def _most_photons(histograms: np.ndarray) -> int:
    """Bound on the photons of a pixel: from the fullest bin where that is enough to be small, else counted."""
    least = int(histograms.min(initial=0)) if histograms.dtype.kind != "u" else 0
    require(least >= 0, f"histogram holds {least} counts")
    bound = int(histograms.max(initial=0)) * histograms.shape[1]
    return bound if bound < 1 << 16 else int(histograms.sum(axis=1, dtype=np.int64).max(initial=0))


class _Product:
    """Products of up to `chunk` histograms with one table, in buffers that stay in the cache."""

    def __init__(self, table: np.ndarray, chunk: int) -> None:
        bins, numbers = table.shape
        # products so small that a BLAS with threads of its own does them in the caller's: those threads wait for each
        # other, which took 9 s of CPU a megapixel on two busy cores instead of 0.5 (measured)
        rows = 1 << max(0, (_ONE_THREAD // (bins * numbers)).bit_length() - 1)
        rows = min(rows, chunk)
        self.table = np.ascontiguousarray(table, np.float32)
        self.counts = np.zeros((chunk // rows, rows, bins), np.float32)
        self.sums = np.empty((chunk // rows, rows, numbers), np.float32)

    def of_histograms(self, part: np.ndarray) -> np.ndarray:
        """Compute the sums (pixels, numbers) float32 of histograms, valid until the next call."""
        np.copyto(self.counts.reshape(-1, part.shape[1])[: len(part)], part, casting="unsafe")
        np.matmul(self.counts, self.table, out=self.sums)
        return self.sums.reshape(-1, self.sums.shape[-1])[: len(part)]
