"""From a recorded histogram through emulated cores to depth, and the same integers by the torch path.

One core is one pixel, as in S.2; `shared_core_depths` is the exception, 4 x 4 SPADs on one core.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
import torch

from csph import CodingTensor, decode_depth, encode
from csph.codes.quantise import wrapped_sums
from scene2spad.emulation.program_tables import fixed_spatial, int8_temporal
from scenes.errors import require
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor
from ultraphase import CoreArray, Method
from ultraphase.catalog import TIMESTAMPS
from ultraphase.core import Counters
from ultraphase.tables import by_block, spatial_sum

_CORES = 1 << 16  # emulated at a time


@dataclass(frozen=True, eq=False)
class Emulated:
    """Output of the cores for an image, and the cost of its computation.

    codes      (H / block rows, W / block columns, numbers) int64
    counters   sums over all cores
    bits       that left the sensor
    """

    codes: np.ndarray
    counters: Counters
    bits: int


def emulate(counts: np.ndarray, method: Method) -> Emulated:
    """Return one frame of an image, every photon a timestamp that a core's program works on.

    counts (H, W, 1024) integers; H and W are multiples of the method's block.
    """
    height, width = _blocks_fit(counts, method)
    spatial = fixed_spatial(method)
    program, tables = method.program(), method.tables(int8_temporal(method))
    rows = max(_CORES // width // method.block[0], 1) * method.block[0]
    codes, counters, bits = [], [], 0
    for top in range(0, height, rows):
        part = counts[top : top + rows]
        shape = part.shape[:2]
        if spatial is not None:
            tables["weight"] = np.tile(spatial, (shape[0] // method.block[0], shape[1] // method.block[1], 1))
        stamps, offsets = timestamps_of(part)
        frame = CoreArray(program, shape, tables).frame(stamps, offsets)
        codes.append(frame.out.reshape(shape[0] // method.block[0], shape[1] // method.block[1], -1))
        counters.append(frame.counters)
        bits += int(frame.out_bits.sum())
    return Emulated(np.concatenate(codes), reduce(add, counters), bits)


def timestamps_of(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return timestamps of every core, core after core, and where each core's begin: counts (H, W, T) -> (N,), (H W +
    1,)."""
    flat = counts.reshape(-1, counts.shape[-1])
    core, time_bin = np.nonzero(flat)
    number = flat[core, time_bin]
    return np.repeat(time_bin, number), np.concatenate(([0], np.cumsum(flat.sum(axis=1, dtype=np.int64))))


def _blocks_fit(counts: np.ndarray, method: Method) -> tuple[int, int]:
    require(counts.shape[-1] == TIMESTAMPS, f"histogram of {counts.shape[-1]} bins, the chip's have {TIMESTAMPS}")
    height, width = counts.shape[:2]
    down, right = method.block
    fits = height % down == 0 and width % right == 0
    require(fits, f"image of {width} x {height} pixels does not divide into the blocks of {right} x {down} cores")
    return height, width


def by_torch(counts: np.ndarray, method: Method) -> np.ndarray:
    """Return the same numbers without a program: csph's `encode` with the int8 tensor, and the limits of the number
    format.

    Raises InputError where a sum is so large that float32 does not hold it exactly.
    """
    _blocks_fit(counts, method)
    spatial = fixed_spatial(method)
    matrix = torch.from_numpy(method.matrix(int8_temporal(method))).float()
    largest = int(counts.sum(axis=-1, dtype=np.int64).max(initial=0)) * int(matrix.abs().max())
    require(largest < 1 << 24, f"sums up to {largest} are not exact in float32")
    sums = encode(torch.from_numpy(counts), CodingTensor(method.name, matrix)).long()
    if method.family == "coarse":
        return np.minimum(sums.numpy(), 255)
    held = wrapped_sums(sums).numpy()
    if spatial is None:
        return held
    summed = spatial_sum(by_block(held, method.block, method.codes), spatial.reshape(-1, method.codes))
    return summed.reshape(*summed.shape[:2], -1)


def decode(codes: np.ndarray, method: Method, sensor: Sensor) -> np.ndarray:
    """Return depth [m] of every pixel from what the cores put out, (H, W) float32, by csph's correlation decoder.

    The codes of a block answer to a pulse in its pixel p with w[p, k] C[k, t]: that matrix is pixel p's coding tensor.
    """
    matrix, spatial = method.matrix(int8_temporal(method)), fixed_spatial(method)
    found = torch.from_numpy(codes).float()
    down, right = method.block
    depth = np.empty((codes.shape[0] * down, codes.shape[1] * right), np.float32)
    answers: dict[bytes, np.ndarray] = {}
    for row in range(down):
        for column in range(right):
            seen = matrix
            if spatial is not None:
                seen = (matrix.reshape(-1, method.codes, matrix.shape[1]) * spatial[row, column][:, None]) / 128
            seen = seen.reshape(matrix.shape)
            if seen.tobytes() not in answers:
                coding = CodingTensor(method.name, torch.from_numpy(seen).float())
                answers[seen.tobytes()] = decode_depth(found, coding, sensor).numpy()
            depth[row::down, column::right] = answers[seen.tobytes()]
    return depth


def shared_core_depths(histogram: Histogram, codes: int = 8) -> dict[str, np.ndarray]:
    """Return depth (H, W) of 4 x 4 SPADs that share a core, whose timestamps have lost their address (S.2) or kept it.

    Without addresses one set of codes describes the whole group, and all its pixels get one depth; with them the core
    keeps a set for every SPAD. Raises InputError for an image that does not divide into groups.
    """
    side, counts = 4, histogram.counts
    height, width = counts.shape[:2]
    require(
        height % side == 0 and width % side == 0, f"image of {width} x {height} pixels, expected multiples of {side}"
    )
    groups = counts.reshape(height // side, side, width // side, side, TIMESTAMPS).swapaxes(1, 2)
    plain, kept = Method("fourier", codes), Method("addressed", codes)
    pooled = emulate(groups.sum(axis=(2, 3)), plain).codes
    depth_pooled = decode(pooled, plain, histogram.sensor)
    # a timestamp's upper bits are its SPAD: a histogram of 16 x 1024 words
    words = groups.reshape(-1, side * side * TIMESTAMPS)
    program, tables = kept.program(), kept.tables(int8_temporal(kept))
    stamps, offsets = timestamps_of(words[None])
    frame = CoreArray(program, (1, len(words)), tables).frame(stamps, offsets)
    own = frame.out.reshape(height // side, width // side, side, side, codes).swapaxes(1, 2)
    own = own.reshape(height, width, codes)
    depth_own = decode(own, plain, histogram.sensor)
    return {
        "addresses lost": np.repeat(np.repeat(depth_pooled, side, axis=0), side, axis=1),
        "addresses kept": depth_own,
    }
