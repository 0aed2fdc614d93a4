"""Exact products of histograms with a program's integer table, by matrix products of floating point or of bytes.

Sums below 2^24 are exact in float32. Counts up to 127 are multiplied as bytes, with 32-bit sums, where the processor
has instructions for it (VNNI) and the process has PyTorch loaded: half the time of a frame. A table of equal blocks
along its diagonal (codes over blocks of timestamps) is one block, and each histogram several. (Adding and subtracting
the halves of histograms first, as even and odd harmonics allow, halves the multiplications, but made a frame only 15 %
faster: it is not done.)
The plain form is `ultraphase.reference.add_photons`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scenes.errors import require, require_kind

_EXACT_IN_FLOAT32, _EXACT_IN_FLOAT64, _EXACT_IN_INT64 = 1 << 24, 1 << 53, 1 << 63
_CHUNK_BYTES = 1 << 19  # of histograms in bytes at a time: their floats, and all else, stay in a cache
_LARGEST_BYTE = 127
_ONE_THREAD = 1 << 18  # multiplications of a product that OpenBLAS does without threads, at most


@dataclass(frozen=True, eq=False)
class Tabulated:
    """A program whose photons each add a row of `table` to the numbers in its RAM, whatever these are.

    table      (timestamps, numbers) int64: what a photon of that timestamp adds
    low, high  range of the numbers, (numbers,)
    saturates  (numbers,) bool: stays at `high` (then nothing is ever subtracted); otherwise wraps around
    clocks     (timestamps,) int64: clocks that the photon takes
    states     from how many different contents of RAM and registers each timestamp was run
    puts_out   number in RAM, as `sum[0]`, that each word is which leaves a core at the frame's end, "" for any other;
               None where cores send to their neighbours then, which no core alone can run
    numbers    names of all numbers in RAM
    """

    program: str
    table: np.ndarray
    low: np.ndarray
    high: np.ndarray
    saturates: np.ndarray
    clocks: np.ndarray
    states: int
    puts_out: tuple[str, ...] | None = None
    numbers: tuple[str, ...] = ()

    def sums(self, histograms: np.ndarray) -> np.ndarray:
        """Add the photons of every pixel without a limit: counts (pixels, timestamps) of any integer type -> (pixels,
        numbers) int64, exact. Raises InputError as `photon_sums` does: for other bins, negative counts, and sums that
        reach 2^63."""
        require_kind(histograms, np.ndarray, f"sums of {self.program}")
        held, count = histograms.shape, len(self.table)
        wide = len(held) == 2
        require(wide, f"histograms of shape {held}, expected (pixels, {count}), the timestamps of {self.program}")
        require(held[1] == count, f"histograms of {held[1]} bins, {self.program} has {count} timestamps")
        return photon_sums(histograms, self.table)

    def frame(self, histograms: np.ndarray) -> np.ndarray:
        """Return numbers in RAM at the end of a frame that began with zeros, (pixels, timestamps) -> (pixels, numbers)
        int64: what the core holds after the same photons in any order."""
        return self.limited(self.sums(histograms))

    def limited(self, sums: np.ndarray) -> np.ndarray:
        """Return sums as the RAM holds them: saturated or wrapped."""
        if not self.overflowed(sums):
            return sums
        wrapped = (sums - self.low) % (self.high - self.low + 1) + self.low
        return np.where(self.saturates, np.minimum(sums, self.high), wrapped)

    def overflowed(self, sums: np.ndarray) -> int:
        """Return how many sums the RAM cannot hold."""
        return int(np.count_nonzero((sums < self.low) | (sums > self.high)))


def photon_sums(histograms: np.ndarray, table: np.ndarray, *, in_bytes: bool = True) -> np.ndarray:
    """Multiply counts (pixels, timestamps) of any integer type with a table (timestamps, numbers) of integers.

    `in_bytes` False keeps to products of floating point. Returns (pixels, numbers) int64, exact. Raises InputError for
    negative counts, for counts that are no integers, for another shape, and for so many photons of a pixel that they
    times the table's largest entry reach 2^63.
    """
    require_kind(histograms, np.ndarray, "photon_sums")
    require(histograms.dtype.kind in "iub", f"histograms of {histograms.dtype}, expected whole numbers")
    fits = histograms.ndim == 2 and histograms.shape[1] == len(table)
    require(fits, f"histograms of shape {histograms.shape}, expected (pixels, {len(table)}) as the table's timestamps")
    (count, bins), numbers = histograms.shape, table.shape[1]
    blocks = equal_blocks(table)
    if blocks > 1:
        parts = np.ascontiguousarray(histograms).reshape(count * blocks, bins // blocks)
        block = table[: bins // blocks, : numbers // blocks]
        return photon_sums(parts, block, in_bytes=in_bytes).reshape(count, numbers)
    chunk = 1 << max(0, (_CHUNK_BYTES // bins).bit_length() - 1)
    product, result = _Product(table, chunk), np.empty((count, numbers), np.int64)
    of_bytes = in_bytes and _bytes_are_multiplied() and _ByteProduct.takes(table)
    bytes_product = _ByteProduct(table) if of_bytes else None
    largest = max(int(np.abs(table).max()), 1)
    for first in range(0, count, chunk):
        part = histograms[first : first + chunk]
        fullest = _fullest_bin(part)
        if bytes_product and fullest <= _LARGEST_BYTE:
            result[first : first + chunk] = bytes_product.of_histograms(part)
            continue
        most = largest * _most_photons(part, fullest)
        if most < _EXACT_IN_FLOAT32:
            result[first : first + chunk] = product.of_histograms(part)
        elif most < _EXACT_IN_FLOAT64:
            result[first : first + chunk] = part.astype(np.float64) @ table.astype(np.float64)
        else:
            over = f"histogram holds {fullest} counts in a bin: with entries to {largest}, sums reach 2^63"
            require(most < _EXACT_IN_INT64, over)
            result[first : first + chunk] = part.astype(np.int64) @ table.astype(np.int64)
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


def _fullest_bin(histograms: np.ndarray) -> int:
    """Return the largest count. Raises InputError for a negative one."""
    least = int(histograms.min(initial=0)) if histograms.dtype.kind != "u" else 0
    require(least >= 0, f"histogram holds {least} counts")
    return int(histograms.max(initial=0))


def _most_photons(histograms: np.ndarray, fullest: int) -> int:
    """Bound on the photons of a pixel: from the fullest bin where that is enough to be small, else counted."""
    bound = fullest * histograms.shape[1]
    if bound < 1 << 16:
        return bound
    kind = np.int64 if bound < _EXACT_IN_INT64 else object  # Python's own whole numbers have no limit
    return int(histograms.sum(axis=1, dtype=kind).max(initial=0))


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


class _ByteProduct:
    """Products of histograms of bytes with one table, in 32-bit sums."""

    def __init__(self, table: np.ndarray) -> None:
        import torch

        self.table = torch.from_numpy(np.ascontiguousarray(table, np.int8))

    @staticmethod
    def takes(table: np.ndarray) -> bool:
        """Return whether the entries of a table are bytes, and no sum of bytes leaves 32 bits."""
        fits = bool(np.abs(table).max(initial=0) <= _LARGEST_BYTE)
        return fits and len(table) * _LARGEST_BYTE**2 < 1 << 31

    def of_histograms(self, part: np.ndarray) -> np.ndarray:
        """Compute the sums (pixels, numbers) int32 of histograms whose counts are at most 127."""
        import torch

        counts = part.view(np.int8) if part.dtype == np.uint8 else part.astype(np.int8)
        return torch._int_mm(torch.from_numpy(np.ascontiguousarray(counts)), self.table).numpy()


def _bytes_are_multiplied() -> bool:
    """Return whether products of bytes are fast and exact here. PyTorch is not imported for it: that takes longer than
    a frame."""
    return "torch" in sys.modules and bytes_are_exact()


@lru_cache(maxsize=1)
def bytes_are_exact() -> bool:
    """Try the largest products there are. Without VNNI, libraries add pairs of products in 16 bits, which saturate."""
    import torch

    vnni = getattr(torch.cpu, "_is_vnni_supported", None)
    if vnni is None or not vnni() or not hasattr(torch, "_int_mm"):
        return False
    counts = np.full((64, 256), _LARGEST_BYTE, np.uint8)
    table = np.full((256, 16), _LARGEST_BYTE)
    table[:, 1::2] *= -1
    table[1::2, 2::4] = -1
    try:
        return np.array_equal(_ByteProduct(table).of_histograms(counts), counts.astype(np.int64) @ table)
    except RuntimeError:  # a build of PyTorch without this product
        return False
