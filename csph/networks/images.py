"""Images of any size through a network that takes whole blocks, large ones in tiles that overlap; and what a network
sees of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

WHOLE_PIXELS = 160 * 160  # an image of at most so many is one tile
TILE = 96  # rows and columns of a tile's own, about


def mirrored(start: int, stop: int, size: int) -> np.ndarray:
    """Return indices start .. stop - 1 of an axis that is reflected at both ends, the outermost repeated: -1 is 0, -2
    is 1."""
    index = np.arange(start, stop) % (2 * size)
    return np.minimum(index, 2 * size - 1 - index)


class Span(NamedTuple):
    """One tile along one axis: the indices that are read, where its own begin among them, and what it answers for."""

    read: np.ndarray
    inner: int
    own: slice


def spans(size: int, block: int, unit: int, halo: int, tile: int | None) -> list[Span]:
    """Return tiles along an axis of `size` pixels, which is reflected at its end to a whole number of blocks.

    `tile` pixels each with `halo` pixels more on either side as far as the image goes, both rounded up to units (whole
    blocks, and whole steps of the network's coarsest level); None: one tile.
    """
    padded = -(-size // block) * block
    if tile is None:
        return [Span(mirrored(0, padded, size), 0, slice(0, size))]
    step, reach = (-(-length // unit) * unit for length in (tile, halo))
    found = []
    for first in range(0, size, step):
        start, stop = max(0, first - reach), min(padded, first + step + reach)
        found.append(Span(mirrored(start, stop, size), first - start, slice(first, min(first + step, size))))
    return found


def sees_photons(counts: np.ndarray, reach: int, block: tuple[int, int, int]) -> np.ndarray:
    """Return whether there is a photon in what a network sees for a pixel, counts (H, W, T) -> (H, W) bool: within
    `reach` pixels, and as far as their blocks go."""
    from scipy.ndimage import maximum_filter  # takes 0.1 s to import

    return maximum_filter(counts.any(axis=2), size=2 * (reach + max(block[1:])) - 1, mode="constant")
