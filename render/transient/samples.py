"""Merging raw samples of light into the few returns a pixel keeps. Plain numpy, same bytes on any number of threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Samples(NamedTuple):
    """Unsorted samples: flat pixel index, path centre and half width [m], radiance, number of bounces.

    Lists of millions are kept as `COLUMN_TYPES`; sums over them run in float64.
    """

    pixel: np.ndarray
    path_m: np.ndarray
    half_width_m: np.ndarray
    radiance: np.ndarray
    bounces: np.ndarray


COLUMN_TYPES = (np.int32, np.float32, np.float32, np.float32, np.uint8)
SORTED = 1 << 19  # samples sorted at a time
# Of a key of 63 bits: the number of a cell; the others hold a flat pixel of int32 and one bit for indirect light.
CELL_BITS = 31
MAX_CELL = 1 << (CELL_BITS - 1)  # cells on either side of 0


class SampleBuffer:
    """Samples that come part by part. They are joined one column at a time: no more than one is ever held twice."""

    def __init__(self) -> None:
        self._columns: list[list[np.ndarray]] = [[column] for column in no_samples()]
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, part: Samples) -> None:
        for parts, column in zip(self._columns, packed(*part), strict=True):
            parts.append(column)
        self._count += len(part.pixel)

    def finished(self, release: Callable[[], None] = lambda: None) -> Samples:
        """Return all samples; nothing more can be added. `release` is called before each column is joined: the parts of
        the last one are free then."""
        joined = []
        while self._columns:
            release()
            joined.append(np.concatenate(self._columns.pop(0)))
        return Samples(*joined)


class Returns(NamedTuple):
    """Returns sorted by pixel, then path: `offsets` (pixels + 1), path interval [m], radiance, bounces."""

    offsets: np.ndarray
    path_near_m: np.ndarray
    path_far_m: np.ndarray
    radiance: np.ndarray
    bounces: np.ndarray


def select(samples: Samples, kept: np.ndarray | slice) -> Samples:
    """Return the samples where `kept` is true, or those that it numbers; of a slice, views."""
    return Samples(*(column[kept] for column in samples))


def select_pixels(samples: Samples, pixels: np.ndarray) -> Samples:
    """Return those of some pixels."""
    return select(samples, np.isin(samples.pixel, pixels))


def packed(*columns: np.ndarray) -> Samples:
    """Return samples of columns of any type, as `COLUMN_TYPES`."""
    return Samples(*(column.astype(kind, copy=False) for column, kind in zip(columns, COLUMN_TYPES, strict=True)))


def concatenate(parts: list[Samples]) -> Samples:
    return packed(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def merge(samples: Samples, tolerance_m: float) -> Samples:
    """Merge samples of one pixel whose path centres share a cell; direct and indirect samples stay apart.

    Cells are `tolerance_m` wide, wider where a path is longer than MAX_CELL of them. Samples without energy go; with a
    tolerance of 0 that is all.
    """
    samples = with_energy(samples)
    if len(samples.pixel) == 0 or tolerance_m == 0:
        return samples
    path_m = samples.path_m.astype(np.float64)
    # beyond, float32 does not tell such cells apart
    tolerance_m = max(tolerance_m, float(np.abs(path_m).max()) / (MAX_CELL - 1))
    cell = np.floor(path_m / tolerance_m)
    number = cell.astype(np.int64) + MAX_CELL
    key = (samples.pixel.astype(np.int64) << 1 | (samples.bounces > 1)) << CELL_BITS | number
    return merge_by(samples, key, cell * tolerance_m)


def with_energy(samples: Samples) -> Samples:
    """Return those that carry light."""
    lit = samples.radiance > 0
    return samples if lit.all() else select(samples, lit)


def merge_by(samples: Samples, key: np.ndarray, base: np.ndarray) -> Samples:
    """Merge samples, each of positive energy, that have one key; their cell begins at `base` [m].

    Energy, centroid and variance of the path length are kept: the merged sample is uniform over centroid +-
    sqrt(3 variance), where one uniform over c +- h has variance h^2 / 3, and has the fewest bounces of its parts. The
    sums run over a stable sort in float64, so that the result depends on the samples' order alone.
    """
    if len(key) == 0:
        return samples
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
    # moments about the cell's beginning: float64 holds them to 1e-16 of a cell
    offset, moments = samples.path_m - base, np.empty((3, len(key)))
    moments[0] = samples.radiance
    np.multiply(moments[0], offset, out=moments[1])
    np.multiply(moments[0], offset**2 + np.square(samples.half_width_m, dtype=np.float64) / 3, out=moments[2])
    total, mean, square = np.add.reduceat(moments.take(order, axis=1), first, axis=1)
    mean /= total
    variance = np.maximum(square / total - mean**2, 0)
    leading = order[first]
    bounces = samples.bounces[leading]
    if samples.bounces.max() > 1:
        bounces = np.minimum.reduceat(samples.bounces[order], first)
    return packed(samples.pixel[leading], base[leading] + mean, np.sqrt(3 * variance), total, bounces)


def to_returns(samples: Samples, pixels: int) -> Returns:
    """Sort merged samples by pixel and path and pack them as ragged float32 lists, some pixels at a time."""
    counts = np.bincount(samples.pixel, minlength=pixels)
    offsets = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    returns = Returns(offsets, *(np.empty(len(samples.pixel), kind) for kind in (*(np.float32,) * 3, np.uint8)))
    first = 0
    while first < pixels:
        end = max(first + 1, int(np.searchsorted(offsets, offsets[first] + SORTED, side="right")) - 1)
        some = slice(offsets[first], offsets[end])
        part = samples
        if end - first < pixels:
            part = select(samples, np.flatnonzero((samples.pixel >= first) & (samples.pixel < end)))
        near = np.maximum(part.path_m - part.half_width_m, 0)
        far = part.path_m + part.half_width_m
        order = np.lexsort((part.bounces, far, near, part.pixel))
        near, far = near[order].astype(np.float32), far[order].astype(np.float32)
        returns.path_near_m[some], returns.path_far_m[some] = near, np.maximum(far, near)
        returns.radiance[some], returns.bounces[some] = part.radiance[order], part.bounces[order]
        first = end
    return returns


def no_samples(room: int = 0) -> Samples:
    """Return an empty list of samples, or room for so many."""
    return Samples(*(np.empty(room, kind) for kind in COLUMN_TYPES))
