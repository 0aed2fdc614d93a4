"""Blocks of pixels that lie together, the launches in which they trace paths, and where these begin.

Positions in pixels and first directions come from low-discrepancy sequences. An additive recurrence fract(shift + n g)
is even over every run of consecutive numbers n, however long. So samples are numbered batch by batch: each batch is
even by itself, and all batches are together. A (0, 2)-sequence (Sobol 1967) is more even still, but over aligned runs
of 2^m numbers alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, UInts
from render.scene.traced_scene import Float, dr, mi

BLOCK = 16  # pixels that share their paths
# Bits of the generalised golden ratio in two dimensions (real root of x^3 = x + 1), in units of 2^-32
GOLDEN = (3242174889, 2447445414)
POSITIONS = 0x9E3779B9  # tells the stream of positions from that of directions
# Members of a block change places in its sequence by ROTATION from sample to sample: each then has a recurrence of its
# own, of step (BLOCK + ROTATION) g = (0.59, 0.26). Without, its directions would be (0.08, 0.12) apart. Positions in
# pixels go in steps of POSITION_STEP g, so that positions and directions of a member are even together, too: of pairs
# of these two numbers few have a lower discrepancy in two and in four dimensions at 16 to 128 samples.
ROTATION, POSITION_STEP = 2, 9


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


def traced_members(pixels: np.ndarray, *, shared: bool) -> int:
    """Return how many members of a block each of its samples traces: all, but of a single block only real pixels.

    `pixels` of some blocks, -1 pads at the end. Where paths are `shared`, groups of BLOCK lanes belong together.
    """
    if shared or len(pixels) > BLOCK:
        return BLOCK
    return max(1, int(np.count_nonzero(pixels >= 0)))


def sample_order(sample_index: UInts, batches: UInts, per_batch: UInts) -> tuple[Array, Array]:
    """Return the batch of a sample, and its number among those of its pixel, counted batch by batch."""
    batch = sample_index % batches
    return batch, batch * per_batch + sample_index // batches


def block_sequence(member: UInts, order: UInts) -> Array:
    """Return the number of a member's sample in the sequence that its block shares: every number once.

    The first n samples of all members are the numbers below n BLOCK.
    """
    return BLOCK * order + (member + ROTATION * order) % BLOCK


def recurrence(number: UInts, shift: tuple[UInts, UInts]) -> tuple[Array, Array]:
    """Return the point of the additive recurrence with this number, in the unit square."""
    u, v = (Float((start + number * step) >> 8) * 2.0**-24 for start, step in zip(shift, GOLDEN, strict=True))
    return u, v


def positions_in_pixel(stream: UInts, member: UInts, order: UInts, key: UInts) -> tuple[Array, Array]:
    """Return where in its pixel a path begins: a recurrence of the pixel's own."""
    return recurrence(POSITION_STEP * order, mi.sample_tea_32(stream * BLOCK + member, key ^ POSITIONS))


def shared_directions(stream: UInts, member: UInts, order: UInts, key: UInts) -> tuple[Array, Array]:
    """Return first directions of paths that a block shares: one recurrence of all its samples."""
    return recurrence(block_sequence(member, order), mi.sample_tea_32(stream, key))


def aligned_number(member: UInts, sample_index: UInts, batches: UInts, per_batch: UInts) -> Array:
    """Return the number of a sample in a batch of a block whose members have aligned runs of a power of two each."""
    bits = 32 - dr.lzcnt(dr.maximum(per_batch, 1) - 1)
    return (member << bits) + sample_index // batches


def own_directions(stream: UInts, batch: UInts, number: UInts, key: UInts) -> tuple[Array, Array]:
    """Return first directions of paths that are a pixel's own: a randomised (0, 2)-sequence a block and batch."""
    shift = mi.sample_tea_32(stream, batch ^ key)
    return mi.radical_inverse_2(number, shift[0]), mi.sobol_2(number, shift[1])
