"""Codes straight from detections: each adds one row of a table, and no histogram is ever built."""

from __future__ import annotations

from functools import reduce

import numpy as np
import torch
from torch import Tensor

from csph.blocks import check_tiling
from scenes.errors import InputError, require


def photon_table(weights: Tensor) -> Tensor:
    """(K, Mt, Mr, Mc) -> (Mr Mc Mt, K), the column of C at each place of a block as one row.

    Time runs fastest: detections of one pixel then stay within Mt neighbouring rows, which a cache may hold.
    """
    return weights.permute(2, 3, 1, 0).reshape(-1, weights.shape[0]).contiguous()


def _checked(timestamps: Tensor, offsets: Tensor, bins: int, name: str) -> tuple[Tensor, Tensor]:
    """Both in int32 where that suffices, which halves what is read; or an InputError."""
    whole = not (timestamps.is_floating_point() or offsets.is_floating_point())
    if not (whole and timestamps.ndim == offsets.ndim == 1 and len(offsets)):
        raise InputError(
            f"timestamps {timestamps.dtype}{tuple(timestamps.shape)} and offsets {offsets.dtype}"
            f"{tuple(offsets.shape)}: expected integers of shapes (N,) and (pixels + 1,)"
        )
    kind = torch.int32 if len(timestamps) < 2**31 else torch.int64
    stamps, starts = timestamps.to(kind), offsets.to(torch.int64)
    if not (starts[0] == 0 and starts[-1] == len(stamps) and bool((starts.diff() >= 0).all())):
        raise InputError(
            f"timestamp offsets must rise from 0 to the {len(stamps)} timestamps, one entry more than pixels"
        )
    if len(stamps):
        low, high = (int(value) for value in torch.aminmax(stamps))
        inside = low >= 0 and high < bins
        require(inside, f"timestamps from {low} to {high} are outside the bins 0 to {bins - 1} of {name}")
    return stamps, starts


def encode_photons(
    timestamps: Tensor,
    offsets: Tensor,
    table: Tensor,
    block: tuple[int, int, int],
    size: tuple[int, int, int],
    *,
    name: str = "the histogram",
) -> Tensor:
    """What `encode_blocks` gives for the histogram of these detections: (B, K, T/Mt, R/Mr, C/Mc), type of the table.

    timestamps (N,) time bin of each detection, pixel after pixel, row by row, image after image; offsets (P + 1,)
    where each pixel's begin, and the end, P = B R C; `table` of `photon_table`; block (Mt, Mr, Mc); size (T, R, C).
    Quickest where a pixel's detections are in ascending order, as `Histogram.timestamps` gives them. Differentiable by
    the table. Raises InputError for blocks that do not tile, and for bad offsets or bins.
    """
    (mt, mr, mc), (bins, rows, columns) = block, size
    check_tiling(size, block)
    stamps, starts = _checked(timestamps, offsets, bins, name)
    pixels, times, device = len(starts) - 1, bins // mt, stamps.device
    require(pixels % (rows * columns) == 0, f"{pixels} pixels of timestamps are no images of {rows} x {columns}")
    images, counts = pixels // (rows * columns), starts.diff()

    index, group = stamps, mc  # with one time block, the detections of mc pixels beside each other are one bag
    if times > 1:
        time, index = _divided(stamps, mt)
        group = 1
        bag = _repeated(torch.arange(0, pixels * times, times, dtype=stamps.dtype, device=device), counts) + time
        if _falls(bag):
            bag, order = bag.sort(stable=True)
            index = index[order]
        starts = torch.nn.functional.pad(torch.bincount(bag, minlength=pixels * times).cumsum(0), (1, 0))
    if mr * mc > 1:
        row = torch.arange(rows, dtype=stamps.dtype, device=device).unsqueeze(-1) % mr
        column = torch.arange(columns, dtype=stamps.dtype, device=device) % mc
        index = _repeated(((row * mc + column) * mt).reshape(-1).repeat(images), counts).add_(index)
    sums = torch.nn.functional.embedding_bag(
        index, table, starts[::group].to(index.dtype), mode="sum", include_last_offset=True
    )
    by_row = reduce(torch.add, sums.view(images, rows // mr, mr, -1).unbind(2))
    by_block = reduce(torch.add, by_row.view(images, rows // mr, columns // mc, mc // group, -1).unbind(3))
    return by_block.view(images, rows // mr, columns // mc, times, table.shape[-1]).permute(0, 4, 3, 1, 2)


def _divided(stamps: Tensor, mt: int) -> tuple[Tensor, Tensor]:
    """Time block, and bin within it; by bits where Mt is a power of two, ten times faster than a division."""
    if mt & (mt - 1) == 0:
        return stamps >> (mt.bit_length() - 1), stamps & (mt - 1)
    time = stamps // mt
    return time, stamps - time * mt


def _falls(values: Tensor) -> bool:
    """Whether a value is below the one before it; by numpy on a CPU, as in `_repeated`."""
    values = values.numpy() if values.device.type == "cpu" else values
    return bool((values[1:] < values[:-1]).any())


def _repeated(per_pixel: Tensor, counts: Tensor) -> Tensor:
    """A pixel's number once for each of its detections; by numpy on a CPU, which takes a quarter of torch's time."""
    if per_pixel.device.type == "cpu":
        return torch.from_numpy(np.repeat(per_pixel.numpy(), counts.numpy()))
    return torch.repeat_interleave(per_pixel, counts)
