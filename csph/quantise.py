"""Coding tensors in 8 bits and sums in 16: what an in-pixel core computes, and how often it overflows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from csph.blocks import encode_blocks
from csph.coding import CodingTensor
from scenes.errors import require

LEVELS = 127  # +-: symmetric, -128 is left out so that a sign can always be turned
PRODUCT_SHIFT = 7  # bits that the product of two 8-bit factors is shifted by, back into 8 bits
ACCUMULATOR_BITS = 16


@dataclass(frozen=True, eq=False)
class Quantised:
    """An 8-bit coding tensor: C is about scale x tensor.

    tensor             (K, Mt, Mr, Mc) int8. Of separable tensors the product of the factors as integers, rounded by a
                       shift: (temporal x spatial + 64) >> 7
    scale              value of one step of `tensor`
    temporal, spatial  the int8 factors, (K, Mt) or (K, Mt, Mr, Mc), and (K, Mr, Mc) or None
    temporal_scale, spatial_scale   value of one step of each
    clipped            how many entries lay beyond the range and were clamped to it
    """

    name: str
    tensor: np.ndarray
    scale: float
    temporal: np.ndarray
    temporal_scale: float
    spatial: np.ndarray | None
    spatial_scale: float
    clipped: int

    def coding(self) -> CodingTensor:
        """The values that the 8-bit tensor stands for."""
        return CodingTensor(
            f"{self.name} int8", torch.from_numpy(self.tensor.astype(np.float32) * np.float32(self.scale))
        )


def _to_int8(values: Tensor, top: float | None) -> tuple[np.ndarray, float, int]:
    array = values.double().cpu().numpy()
    top = float(np.abs(array).max()) if top is None else top
    scale = top / LEVELS if top > 0 else 1.0
    steps = np.rint(array / scale)
    clipped = int((np.abs(steps) > LEVELS).sum())
    return np.clip(steps, -LEVELS, LEVELS).astype(np.int8), scale, clipped


def quantised(
    coding: CodingTensor, scaling: Literal["calibrated", "fixed"] = "calibrated", *, top: float = 1.0
) -> Quantised:
    """Round every factor to the nearest of 255 steps between -top and top, clamped.

    calibrated: top is each factor's largest magnitude, nothing is clamped. fixed: `top` for all (1 as published, where
    what lay beyond wrapped around instead). Raises InputError for another scaling or a top that is not positive.
    """
    require(scaling in ("calibrated", "fixed"), f"quantisation {scaling!r}: expected calibrated or fixed")
    require(scaling == "calibrated" or 0 < top < np.inf, f"quantisation: top {top:g} is not a positive number")
    asked = None if scaling == "calibrated" else top
    temporal, temporal_scale, clipped = _to_int8(coding.temporal, asked)
    if coding.spatial is None:
        tensor = temporal.reshape(coding.codes, *coding.block)
        return Quantised(coding.name, tensor, temporal_scale, temporal, temporal_scale, None, 1.0, clipped)
    spatial, spatial_scale, more = _to_int8(coding.spatial, asked)
    product = temporal[:, :, None, None].astype(np.int16) * spatial[:, None].astype(np.int16)
    tensor = ((product + (1 << PRODUCT_SHIFT - 1)) >> PRODUCT_SHIFT).astype(np.int8)
    scale = temporal_scale * spatial_scale * (1 << PRODUCT_SHIFT)
    return Quantised(coding.name, tensor, scale, temporal, temporal_scale, spatial, spatial_scale, clipped + more)


class IntegerCodes(NamedTuple):
    """codes (B, K, T/Mt, R/Mr, C/Mc) int16 as a 16-bit accumulator holds them at the end; `overflows`, how many of them
    lie outside its range and so have wrapped around."""

    codes: Tensor
    overflows: int


def encode_int16(counts: Tensor, tensor: Quantised) -> IntegerCodes:
    """Sums of 8-bit weights in 16-bit accumulators that wrap around: (B, 1, T, R, C) -> int16 codes.

    Wrapping is modular, so the result does not depend on the order of detections, and a sum that leaves the range and
    comes back is right. Exact for up to 2^53 / 127 photons a block. Raises InputError as `encode_blocks` does.
    """
    exact = encode_blocks(counts, torch.from_numpy(tensor.tensor).double()).round().to(torch.int64)
    half = 1 << ACCUMULATOR_BITS - 1
    wrapped = torch.remainder(exact + half, 2 * half) - half
    return IntegerCodes(wrapped.to(torch.int16), int((wrapped != exact).sum()))
