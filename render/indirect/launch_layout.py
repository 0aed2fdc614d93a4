"""Blocks of pixels that lie together, and the launches in which they trace paths. Plain numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

BLOCK = 16  # pixels that share their paths


class LaunchLayout(NamedTuple):
    """One launch: entry n traces a path in each pixel of block `block[n]`, number `stream[n]` of the image.

    `sample_index` numbers the samples of a block. With the seed, stream and sample index decide the random numbers.
    `per_batch` is the number of samples that a block has in a batch, rounded up.
    """

    block: np.ndarray
    stream: np.ndarray
    sample_index: np.ndarray
    per_batch: np.ndarray


def make_launch(
    blocks: np.ndarray, streams: np.ndarray, spp: np.ndarray, batches: int = 1, indices: np.ndarray | None = None
) -> LaunchLayout:
    """Lay out the samples of some blocks, `spp` each, block by block; or those that `indices` numbers among them."""
    ends = np.cumsum(spp)
    indices = np.arange(int(ends[-1])) if indices is None else indices
    place = np.searchsorted(ends, indices, side="right")
    per_batch = np.maximum(-(-spp // batches), 1)
    return LaunchLayout(blocks[place], streams[place], indices - (ends - spp)[place], per_batch[place])


def block_order(pixels: np.ndarray, width: int) -> np.ndarray:
    """Return flat pixel indices along a Z-order curve, so that runs of 16 are square neighbourhoods; padded with -1."""
    row, column = np.divmod(pixels.astype(np.uint64), np.uint64(width))
    code = np.zeros(len(pixels), np.uint64)
    for bit in range(15):
        one, shift = np.uint64(1), np.uint64(bit)
        code |= ((column >> shift) & one) << np.uint64(2 * bit) | ((row >> shift) & one) << np.uint64(2 * bit + 1)
    ordered = pixels[np.argsort(code, kind="stable")]
    return np.concatenate((ordered, np.full(-len(ordered) % BLOCK, -1, ordered.dtype)))
