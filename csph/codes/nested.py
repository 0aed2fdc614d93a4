"""Codes over small blocks as codes over the larger blocks that they tile, and separable tensors as full ones.

A block of 1024 x 4 x 4 is four of 256 x 4 x 4, one after another. The K codes of each of the four are 4 K codes of the
whole, with zeros outside their own part: same codes, same compression ratio. Training can begin there instead of at
random.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import torch
from torch import Tensor
from torch.nn.functional import pad

from csph.codes.design import Design
from csph.codes.tensor import CodingTensor

Block = tuple[int, int, int]


def block_parts(inner: Block, outer: Block) -> int:
    """Return how many blocks of one size make one of another, 0 where they do not tile it."""
    pairs = list(zip(outer, inner, strict=True))
    return 0 if any(whole % part for whole, part in pairs) else math.prod(whole // part for whole, part in pairs)


def holds(outer: Design, inner: Design) -> bool:
    """Tell whether the weights of one design can be the start of another: learned codes over blocks that the first's
    tile, at the same compression ratio and zero mean, and full where the first are."""
    free = outer.code == "learned" and (outer.full or not inner.full) and outer.zero_mean == inner.zero_mean
    return free and outer.codes == block_parts(inner.block, outer.block) * inner.codes


def nested(coding: CodingTensor, outer: Design) -> CodingTensor:
    """Return the tensor of a design that `holds` another's: its codes part by part, in order time, row, column.

    coding  whose rows sum to zero over Mt where the design wants that: they then do so over the larger block, too
    """
    whole = outer.block
    if outer.full:
        return CodingTensor(outer.name, torch.cat([_placed(coding.tensor, at, whole) for at in _places(coding, whole)]))
    temporal = torch.cat([_placed(coding.temporal, at[:1], whole[:1]) for at in _places(coding, whole)])
    if not outer.has_spatial:
        return CodingTensor(outer.name, temporal)
    pixels = torch.ones((coding.codes, 1, 1)) if coding.spatial is None else coding.spatial
    spatial = torch.cat([_placed(pixels, at[1:], whole[1:]) for at in _places(coding, whole)])
    return CodingTensor(outer.name, temporal, spatial)


def _places(coding: CodingTensor, whole: Block) -> Iterator[tuple[int, ...]]:
    """Yield the first bin, row and column of each part of a block."""
    firsts = (range(0, n, part) for n, part in zip(whole, coding.block, strict=True))
    yield from product(*firsts)


def _placed(part: Tensor, first: tuple[int, ...], size: tuple[int, ...]) -> Tensor:
    """Return zeros (K, *size) with a part (K, ...) at its first indices."""
    sides = [(at, n - at - have) for at, n, have in zip(first, size, part.shape[1:], strict=True)]
    return pad(part, [width for pair in reversed(sides) for width in pair])
