"""Coding tensors in 8 bits and sums in 16, as an in-pixel core has them, and how often those overflow."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from csph.codes.blocks import encode_blocks
from csph.codes.tensor import LEVELS, CodingTensor
from scenes.errors import listed

log = logging.getLogger("csph")

Int8Rule = Literal["calibrated", "published"]
INT8_RULES: tuple[str, ...] = get_args(Int8Rule)
FEW_STEPS = 4  # a code whose largest magnitude is fewer tells 8-bit sums next to nothing
PRODUCT_SHIFT = 7  # bits that the product of two 8-bit factors is shifted by, back into 8 bits
ACCUMULATOR_BITS = 16
HALF_RANGE = 1 << ACCUMULATOR_BITS - 1
# 255 steps over [-1, 1] for every factor; in single precision as published, so that 1 is 127 steps and not 127.5
PUBLISHED_STEP = float(np.float32(2 / 255))


@dataclass(frozen=True, eq=False)
class Quantised:
    """An 8-bit coding tensor: C is about scale x tensor.

    tensor             (K, Mt, Mr, Mc) int8. Of separable tensors the product of the factors as integers, rounded by a
                       shift: (temporal x spatial + 64) >> 7
    scale              value of one step of `tensor`
    temporal, spatial  the int8 factors, (K, Mt) or (K, Mt, Mr, Mc), and (K, Mr, Mc) or None
    temporal_scale, spatial_scale   value of one step of each
    """

    name: str
    tensor: np.ndarray
    scale: float
    temporal: np.ndarray
    temporal_scale: float
    spatial: np.ndarray | None
    spatial_scale: float

    def coding(self) -> CodingTensor:
        """Return the values that the 8-bit tensor stands for."""
        return CodingTensor(
            f"{self.name} int8", torch.from_numpy(self.tensor.astype(np.float32) * np.float32(self.scale))
        )


def clipped_steps(values: Tensor, log_range: Tensor) -> tuple[Tensor, Tensor]:
    """Round to 255 steps between plus and minus exp(log_range), for training: (steps, value of one step).

    Whole numbers within +-127 in floating point. Backward goes straight through the rounding, so that values and range
    learn: within the range d(step value x steps) / d(step value) is the rounding's error, outside it +-127 (LSQ, Esser
    et al., ICLR 2020); values outside it do not move.
    """
    step = log_range.exp() / LEVELS
    scaled = (values / step).clamp(-LEVELS, LEVELS)
    return straight_through(scaled, scaled.round()), step


def straight_through(values: Tensor, forward: Tensor) -> Tensor:
    """Return `forward`, with the derivative of `values`."""
    return forward.detach() + (values - values.detach())


def _to_int8(values: Tensor, scale: float | None = None) -> tuple[np.ndarray, float]:
    """Round to steps of `scale` (default: 1/127 of the largest magnitude), clamped to +-127; and the scale."""
    array = values.double().cpu().numpy()
    if scale is None:
        scale = float(np.abs(array).max()) / LEVELS or 1.0
    return np.clip(np.rint(array / scale), -LEVELS, LEVELS).astype(np.int8), scale


def quantised(coding: CodingTensor) -> Quantised:
    """Round every factor to the nearest of 255 steps between plus and minus its largest magnitude.

    The result is one 8-bit tensor, of separable factors their product in integers. A tensor that is in steps already
    keeps them. Programs of a core have tables of their own (`ultraphase.compiler`). All codes share a step: a warning
    names those of which fewer than FEW_STEPS are left.

    Examples
    --------
    >>> import torch
    >>> import csph
    >>> from scene2spad import coding_tensor
    >>> in_bytes = csph.quantised(coding_tensor("fourier", 8))
    >>> tuple(in_bytes.tensor.shape), in_bytes.tensor.dtype, round(1 / in_bytes.scale)
    ((8, 1024, 1, 1), dtype('int8'), 127)
    >>> counts = torch.zeros(1, 1, 1024, 2, 2)  # (B, 1, T, R, C)
    >>> counts[0, 0, 0] = 300
    >>> csph.encode_int16(counts, in_bytes).overflows  # 300 x 127 leaves 16 bits: four codes of four pixels
    16
    """
    steps = coding.steps or (None, None)
    spatial = (None, 1.0) if coding.spatial is None else _to_int8(coding.spatial, steps[1])
    found = from_factors(coding.name, _to_int8(coding.temporal, steps[0]), spatial)
    _warn_of_weak(coding, found.tensor)
    return found


def _warn_of_weak(coding: CodingTensor, steps: np.ndarray, least: int = FEW_STEPS) -> None:
    """Warn, once of the same codes, of rows that 8 bits lose, since all rows share a step: of fewer than `least`."""
    left = np.abs(steps.astype(np.int16)).reshape(len(steps), -1).max(1)
    weak = np.flatnonzero((left < least) & (coding.tensor.flatten(1) != 0).any(1).cpu().numpy())
    if weak.size:
        _log_weak(coding.name, coding.codes, listed(f"{row} ({left[row]})" for row in weak))


@lru_cache(maxsize=256)
def _log_weak(name: str, codes: int, rows: str) -> None:
    message = "%s: of its %d codes 8 bits leave few of 127 steps of row %s, as all share one step: scale rows alike"
    log.warning(message, name, codes, rows)


def from_factors(
    name: str, temporal: tuple[np.ndarray, float], spatial: tuple[np.ndarray | None, float] = (None, 1.0)
) -> Quantised:
    """Form the 8-bit tensor of int8 factors, each given with the value of one of its steps."""
    (steps, scale), (weights, weight_scale) = temporal, spatial
    if weights is None:
        tensor = steps if steps.ndim == 4 else steps[..., None, None]
        return Quantised(name, tensor, scale, steps, scale, None, 1.0)
    product = steps[:, :, None, None].astype(np.int16) * weights[:, None].astype(np.int16)
    tensor = ((product + (1 << PRODUCT_SHIFT - 1)) >> PRODUCT_SHIFT).astype(np.int8)
    return Quantised(name, tensor, scale * weight_scale * (1 << PRODUCT_SHIFT), steps, scale, weights, weight_scale)


def published_int8(coding: CodingTensor) -> CodingTensor:
    """Round every factor to the published 8 bits, q = round(127.5 w), and return the values that they stand for.

    Each factor (temporal, spatial, or the full tensor) has steps of 2/255 whatever its largest value, and factors are
    multiplied in floating point: an emulation, not what one 8-bit tensor holds (`quantised`). Weights beyond +-1 are
    clamped, where the published code wraps around. It also casts counts to 8 bits; here they stay as they are. Warns of
    rows that become 0.
    """

    def rounded(part: Tensor) -> Tensor:
        steps, scale = _to_int8(part, PUBLISHED_STEP)
        return torch.from_numpy(steps.astype(np.float32) * np.float32(scale))

    spatial = None if coding.spatial is None else rounded(coding.spatial)
    name, temporal = f"{coding.name} int8 as published", rounded(coding.temporal)
    found = replace(coding, name=name, temporal=temporal, spatial=spatial, steps=None)
    _warn_of_weak(coding, (found.tensor != 0).cpu().numpy(), least=1)
    return found


class IntegerCodes(NamedTuple):
    """codes (B, K, T/Mt, R/Mr, C/Mc) int16 as a 16-bit accumulator holds them at the end; `overflows`, how many of them
    lie outside its range and so have wrapped around."""

    codes: Tensor
    overflows: int


def encode_int16(counts: Tensor, tensor: Quantised) -> IntegerCodes:
    """Return sums of 8-bit weights in 16-bit accumulators that wrap around: (B, 1, T, R, C) -> int16 codes.

    Wrapping is modular, so the result does not depend on the order of detections, and a sum that leaves the range and
    comes back is right. Exact for up to 2^53 / 127 photons a block. Raises InputError as `encode_blocks` does.
    """
    exact = encode_blocks(counts, torch.from_numpy(tensor.tensor).double()).round().to(torch.int64)
    wrapped = wrapped_sums(exact)
    return IntegerCodes(wrapped.to(torch.int16), int((wrapped != exact).sum()))


def wrapped_sums(sums: Tensor) -> Tensor:
    """Wrap whole numbers as a 16-bit accumulator holds them, of any type."""
    return torch.remainder(sums + HALF_RANGE, 2 * HALF_RANGE) - HALF_RANGE
