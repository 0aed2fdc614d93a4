"""Codes straight from detections: each adds one row of a table, and no histogram is ever built."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import pad

from csph.codes.blocks import check_tiling
from scenes.errors import InputError, require

# Measured: a table of more bytes is met place by place, so that a core's cache holds what it meets
CACHE_BYTES = 1 << 20
# Measured: up to so many time blocks, a table that marks them counts detections faster than a count of each
MARKED_TIMES = 16
EXACT_FLOAT = 1 << 24  # float32 holds whole numbers up to here
LONG_BAG = 1 << 10  # rows that are added one by one in float32, at most


def photon_table(weights: Tensor) -> Tensor:
    """Return (K, Mt, Mr, Mc) -> (Mr Mc Mt, K), the column of C at each place of a block as one row.

    Time runs fastest: detections of one pixel then stay within Mt neighbouring rows, which a cache may hold.
    """
    return weights.permute(2, 3, 1, 0).reshape(-1, weights.shape[0]).contiguous()


class _Tiling(NamedTuple):
    """Tiling of images by blocks, as far as it does not depend on detections; P pixels, all int32."""

    row: Tensor  # (P,) where the part of the table that is of each pixel's place in its block begins
    by_place: Tensor  # (P,) the pixels of the first place in their blocks, then of the next
    row_by_place: Tensor  # (P,) `row` in that order
    bags: Tensor  # (P T',) pixel T' + time block, block after block, its places side by side
    starts: Tensor  # (P T' / places + 1,) where each block's begin, and the end


@lru_cache(maxsize=32)
def _tiling(
    images: int, size: tuple[int, int, int], block: tuple[int, int, int], kind: torch.dtype, device: torch.device
) -> _Tiling:
    (bins, rows, columns), (mt, mr, mc) = size, block
    places, times = mr * mc, bins // mt
    pixels = torch.arange(images * rows * columns, dtype=kind, device=device)
    tiles = pixels.view(images, rows // mr, mr, columns // mc, mc)
    place = torch.arange(0, places * mt, mt, dtype=kind, device=device).view(mr, 1, mc)
    row, by_place = place.expand(tiles.shape).reshape(-1), tiles.permute(2, 4, 0, 1, 3).reshape(-1)
    in_blocks = tiles.permute(0, 1, 3, 2, 4).reshape(-1, 1, places) * times
    bags = (in_blocks + torch.arange(times, dtype=kind, device=device).view(-1, 1)).reshape(-1)
    starts = torch.arange(0, len(bags) + 1, places, dtype=kind, device=device)
    return _Tiling(row, by_place, row[by_place], bags, starts)


def encode_photons(
    timestamps: Tensor,
    offsets: Tensor,
    table: Tensor,
    block: tuple[int, int, int],
    size: tuple[int, int, int],
    *,
    name: str = "the histogram",
) -> Tensor:
    """Return what `encode_blocks` gives for the histogram of these detections: (B, K, T/Mt, R/Mr, C/Mc), type of the
    table.

    timestamps (N,) time bin of each detection, pixel after pixel, row by row, image after image; offsets (P + 1,)
    where each pixel's begin, and the end, P = B R C; `table` of `photon_table`; block (Mt, Mr, Mc); size (T, R, C).
    Quickest where a pixel's detections are in ascending order, as `Histogram.timestamps` gives them. Differentiable by
    the table. Raises InputError for blocks that do not tile, and for bad offsets or bins.
    """
    (mt, mr, mc), (bins, rows, columns) = block, size
    check_tiling(size, block)
    stamps, starts, counts = _checked(timestamps, offsets, bins, name)
    pixels, times, places = len(counts), bins // mt, mr * mc
    require(pixels % (rows * columns) == 0, f"{pixels} pixels of timestamps are no images of {rows} x {columns}")
    images = pixels // (rows * columns)
    tiling = _tiling(images, tuple(size), tuple(block), starts.dtype, stamps.device)
    index, row = stamps, tiling.row
    by_place = places > 1 and stamps.device.type == "cpu" and table.nbytes > CACHE_BYTES
    if by_place:
        row = tiling.row_by_place
        index, starts, counts = _reordered(stamps, starts, counts, tiling.by_place, bins)
    if times > 1:
        index, starts = _time_bags(index, starts, counts, mt, times)
    if places > 1:
        index = _repeated(row, counts).add_(index)
    sums = _bags(index, table, starts)
    if by_place:
        sums = sums.view(places, -1, table.shape[-1]).sum(0)
    elif places > 1:
        sums = _bags(tiling.bags, sums, tiling.starts)
    return sums.view(images, rows // mr, columns // mc, times, -1).permute(0, 4, 3, 1, 2)


def _checked(timestamps: Tensor, offsets: Tensor, bins: int, name: str) -> tuple[Tensor, Tensor, Tensor]:
    """Check timestamps and offsets; return both, in int32 where that suffices, which halves what is read, and
    detections per pixel; or raise an InputError."""
    whole = not (timestamps.is_floating_point() or offsets.is_floating_point())
    if not (whole and timestamps.ndim == offsets.ndim == 1 and len(offsets)):
        raise InputError(
            f"timestamps {timestamps.dtype}{tuple(timestamps.shape)} and offsets {offsets.dtype}"
            f"{tuple(offsets.shape)}: expected integers of shapes (N,) and (pixels + 1,)"
        )
    kind = torch.int32 if len(timestamps) < 2**31 else torch.int64
    starts = offsets.cpu().numpy().astype(np.int64, copy=False)
    counts = np.diff(starts)
    if not (starts[0] == 0 and starts[-1] == len(timestamps) and counts.min(initial=0) >= 0):
        raise InputError(
            f"timestamp offsets must rise from 0 to the {len(timestamps)} timestamps, one entry more than pixels"
        )
    if len(timestamps):
        low, high = _extremes(timestamps)
        inside = low >= 0 and high < bins
        require(inside, f"timestamps from {low} to {high} are outside the bins 0 to {bins - 1} of {name}")
    device = timestamps.device
    return timestamps.to(kind), torch.from_numpy(starts).to(device, kind), torch.from_numpy(counts).to(device, kind)


def _extremes(stamps: Tensor) -> tuple[int, int]:
    """Return the least and the greatest stamp; by numpy on a CPU, which also knows uint16."""
    if stamps.device.type == "cpu":
        values = stamps.numpy()
        return int(values.min()), int(values.max())
    low, high = torch.aminmax(stamps.to(torch.int64))
    return int(low), int(high)


def _bags(index: Tensor, table: Tensor, starts: Tensor) -> Tensor:
    """Sum table[index] between neighbouring starts, (bags, K). What float32 rounds away grows with the rows that are
    added one by one: longer bags than LONG_BAG are summed in parts of that length, and these in float64."""
    starts = starts.to(index.dtype)
    lengths = starts.diff()
    if len(index) <= LONG_BAG or int(lengths.max()) <= LONG_BAG:
        return _sums(index, table, starts)
    parts = lengths.add(LONG_BAG - 1).div(LONG_BAG, rounding_mode="floor")  # none of an empty bag
    ends = pad(parts.cumsum(0), (1, 0)).to(index.dtype)
    part = torch.arange(int(ends[-1]), dtype=index.dtype, device=index.device)
    bag = torch.repeat_interleave(torch.arange(len(parts), device=index.device), parts)
    first = starts[bag] + LONG_BAG * (part - ends[bag])
    subtotals = _sums(index, table, pad(first, (0, 1), value=len(index)))
    return _sums(part, subtotals.double(), ends).to(table.dtype)


def _sums(index: Tensor, table: Tensor, starts: Tensor) -> Tensor:
    return torch.nn.functional.embedding_bag(index, table, starts, mode="sum", include_last_offset=True)


def _reordered(
    stamps: Tensor, starts: Tensor, counts: Tensor, order: Tensor, bins: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Put the detections of pixels in another order, by copying runs: the rows of a sparse matrix, whose values nobody
    reads."""
    values = np.empty(len(stamps), np.int8)
    pixels = csr_array((values, stamps.numpy(), starts.numpy()), shape=(len(order), bins))[order.numpy()]
    return torch.from_numpy(pixels.indices), torch.from_numpy(pixels.indptr), counts[order]


def _time_bags(stamps: Tensor, starts: Tensor, counts: Tensor, mt: int, times: int) -> tuple[Tensor, Tensor]:
    """Bin within its time block of each detection, by pixel and time block, and where each of these bags begins."""
    few = times <= MARKED_TIMES and len(stamps) <= EXACT_FLOAT and stamps.device.type == "cpu"
    if few and _ascending(stamps.numpy(), starts.numpy()):
        number = _bags(stamps, _marks(times, mt), starts).numpy().cumsum(dtype=np.float64)
        return _in_block(stamps, mt), pad(torch.from_numpy(number).to(starts.dtype), (1, 0))
    bag = _repeated(torch.arange(0, len(counts) * times, times, device=stamps.device), counts) + stamps // mt
    bag, order = bag.sort(stable=True)
    ends = torch.bincount(bag, minlength=len(counts) * times).cumsum(0)
    return _in_block(stamps[order], mt), pad(ends, (1, 0))


@lru_cache(maxsize=16)
def _marks(times: int, mt: int) -> Tensor:
    """Make the (T, T') float32 matrix that is 1 where a bin is in a time block. Summing its rows over detections counts
    them, in a third of the time of a `bincount`."""
    return torch.eye(times).repeat_interleave(mt, 0)


def _ascending(stamps: np.ndarray, starts: np.ndarray) -> bool:
    """Return whether the detections of every pixel are in ascending order of time."""
    falls = stamps[1:] < stamps[:-1]
    firsts = starts[(starts > 0) & (starts < len(stamps))]  # of pixels; repeated where one is empty
    between = np.count_nonzero(falls[firsts - 1][np.diff(firsts, prepend=0) > 0])
    return np.count_nonzero(falls) == between


def _in_block(stamps: Tensor, mt: int) -> Tensor:
    """Bin within its time block; by bits where Mt is a power of two, ten times faster than a division."""
    return stamps & (mt - 1) if mt & (mt - 1) == 0 else stamps % mt


def _repeated(per_pixel: Tensor, counts: Tensor) -> Tensor:
    """Repeat a pixel's number once for each of its detections; by numpy on a CPU, which takes a quarter of torch's
    time."""
    if per_pixel.device.type == "cpu":
        return torch.from_numpy(np.repeat(per_pixel.numpy(), counts.numpy()))
    return torch.repeat_interleave(per_pixel, counts)
