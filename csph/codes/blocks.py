"""The two products of compressive histograms over blocks: codes = C x block, and block = C^T x codes.

Order of every tensor: batch, channel, time, row, column. A block is Mt bins x Mr rows x Mc columns; blocks tile the
histogram without overlap, so that a strided convolution is one matrix product over rearranged counts, and a
transposed convolution its transpose. Sums are in the type of the weights.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from csph.autograd import Context, applied
from scenes.errors import InputError, require, require_kind

EPSILON = 1e-5  # of zero-normalisation, as published
FORMED = 4  # entries for each count, at most, of a separable coding tensor that is formed
NO_NORM = 1e-13  # of the sum of squares: a variance below it is what rounding in float64 leaves of none
COUNT_TYPES = (
    *(torch.float64, torch.float32, torch.float16, torch.bfloat16),
    *(torch.uint8, torch.int8, torch.uint16, torch.int16, torch.int32, torch.int64),
)


def in_full(values: Tensor) -> torch.autocast:
    """Return the context in which sums over `values` keep their type, whatever autocast is on. Raises InputError for
    what is no tensor, as a numpy array."""
    require_kind(values, Tensor, "counts or codes", " (`torch.from_numpy` makes one)")
    # the meta device, which computes shapes alone, has no autocast
    return torch.autocast("cpu" if values.is_meta else values.device.type, enabled=False)


def widened(values: Tensor) -> Tensor:
    """Return values of 16 bits in float32, in which sums over thousands of counts neither overflow nor lose photons;
    others as they are."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def check_counts(counts: Tensor, block: tuple[int, int, int]) -> None:
    """Raise InputError in one line unless `counts` is (B, 1, T, R, C) of a known type and the block tiles it."""
    shape = tuple(counts.shape)
    good = len(shape) == 5 and shape[1] == 1 and 0 not in shape[2:]
    require(good, f"histogram of shape {shape}: expected (batch, 1, time, rows, columns)")
    check_tiling(shape[2:], block)
    known = counts.dtype in COUNT_TYPES
    require(known, f"histogram of type {counts.dtype}: expected integer or floating-point counts")


def check_tiling(size: tuple[int, ...], block: tuple[int, int, int]) -> None:
    """Raise InputError unless blocks of Mt x Mr x Mc tile a histogram of T x R x C."""
    if any(whole % part for whole, part in zip(size, block, strict=True)):
        # not before: compiled layers of several sizes hold symbols, which have no text
        given, asked = (" x ".join(map(str, numbers)) for numbers in (size, block))
        raise InputError(f"histogram of {given} (time x rows x columns) is not tiled by blocks of {asked}")


def _wide(values: Tensor, columns: int) -> Tensor:
    """View memory in the widest elements that a run of `columns` entries is made of: up to 16 bytes are then moved at a
    time, five times faster than one by one."""
    if torch.compiler.is_compiling() or values.is_meta:  # neither knows where in memory the values begin
        return values
    run = columns * values.element_size()
    for dtype, size in ((torch.complex128, 16), (torch.int64, 8), (torch.int32, 4)):
        if (
            run % size == 0
            and size > values.element_size()
            and values.storage_offset() * values.element_size() % size == 0
        ):
            return values.view(dtype)
    return values


def _rearranged(values: Tensor, shape: tuple[int, ...], order: tuple[int, ...]) -> Tensor:
    """`values.view(shape).permute(order)` made contiguous, where both keep the last axis last."""
    wide = _wide(values.contiguous().view(-1), shape[-1])
    run = shape[-1] * values.element_size() // wide.element_size()
    moved = wide.view(*shape[:-1], run).permute(order).contiguous()
    return moved.view(-1).view(values.dtype)


class _Gather(torch.autograd.Function):
    """(B, 1, T, R, C) -> (blocks, Mt Mr Mc); blocks in order batch, time, row, column, as are entries in a block."""

    @staticmethod
    def forward(ctx: Context, counts: Tensor, block: tuple[int, int, int]) -> Tensor:
        ctx.block, ctx.size = block, counts.shape
        (batch, _, bins, rows, columns), (mt, mr, mc) = counts.shape, block
        shape = (batch, bins // mt, mt, rows // mr, mr, columns // mc, mc)
        return _rearranged(counts, shape, (0, 1, 3, 5, 2, 4, 6)).view(-1, mt * mr * mc)

    @staticmethod
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor, None]:
        return applied(_Scatter, grad, ctx.block, ctx.size), None


class _Scatter(torch.autograd.Function):
    """(blocks, Mt Mr Mc) -> (B, 1, T, R, C): the inverse of `_Gather`."""

    @staticmethod
    def forward(ctx: Context, blocks: Tensor, block: tuple[int, int, int], size: torch.Size) -> Tensor:
        ctx.block = block
        (batch, _, bins, rows, columns), (mt, mr, mc) = size, block
        shape = (batch, bins // mt, rows // mr, columns // mc, mt, mr, mc)
        return _rearranged(blocks, shape, (0, 1, 4, 2, 5, 3, 6)).view(size)

    @staticmethod
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor, None, None]:
        return applied(_Gather, grad, ctx.block), None, None


class _Centre(torch.autograd.Function):
    """v minus its mean over an axis; a projection, so it is its own derivative. The mean by a matrix product, which
    takes a third of the time of a reduction over an outer axis."""

    @staticmethod
    def forward(ctx: Context, values: Tensor, axis: int) -> Tensor:
        ctx.axis = axis
        return values - mean_over(values, axis)

    @staticmethod
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor, None]:
        return applied(_Centre, grad, ctx.axis), None


def mean_over(values: Tensor, axis: int) -> Tensor:
    """Return mean over the first or second axis, kept with length 1."""
    flat = values.reshape(*values.shape[: axis + 1], math.prod(values.shape[axis + 1 :]))
    weights = torch.full((1, flat.shape[axis]), 1 / flat.shape[axis], dtype=values.dtype, device=values.device)
    return (weights @ flat).view(*values.shape[:axis], 1, *values.shape[axis + 1 :])


def centred(values: Tensor, axis: int) -> Tensor:
    """Return v - mean of v over axis 0 or 1."""
    return applied(_Centre, values, axis)


class _ZeroNormalise(torch.autograd.Function):
    """u = v / (n + eps), v = w - mean w, n = |v|; its derivative is (g / (n + eps) - u <u, g> / n) less its mean, and
    g / (n + eps) less its mean where n = 0. In place where it can be: the weights are megabytes, and memory is what
    takes time."""

    @staticmethod
    def forward(ctx: Context, values: Tensor, axis: int, centre: bool, over: tuple[int, ...]) -> Tensor:
        unit = values - mean_over(values, axis) if centre else values.clone()
        norm = (unit * unit).sum((axis, *over), keepdim=True).sqrt()
        # compiled by torch 2.11, a result that was written in place has derivatives of 0
        unit = unit / (norm + EPSILON) if torch.compiler.is_compiling() else unit.div_(norm + EPSILON)
        ctx.save_for_backward(unit, norm)
        ctx.axis, ctx.centre, ctx.over = axis, centre, over
        return unit

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor, None, None, None]:
        unit, norm = ctx.saved_tensors
        along = (unit * grad).sum((ctx.axis, *ctx.over), keepdim=True)
        slope = torch.where(norm > 0, along / norm.clamp(min=torch.finfo(norm.dtype).tiny), 0.0)
        change = (grad / (norm + EPSILON)).addcmul_(unit, slope, value=-1)
        if ctx.centre:
            change.sub_(mean_over(change, ctx.axis))
        return change, None, None, None


def zero_normalised(values: Tensor, axis: int, *, centre: bool = True, over: tuple[int, ...] = ()) -> Tensor:
    """Return ZN(v) = (v - mean v) / (|v - mean v|_2 + 1e-5) over the codes, axis 0 or 1 (supplement S.5.2, equation 1).

    `centre` = False leaves the mean in; the norm is taken over the axes `over` too.
    """
    return applied(_ZeroNormalise, values, axis, centre, over)


def encode_blocks(counts: Tensor, weights: Tensor) -> Tensor:
    """Return y_k = sum over a block of C_k n: (B, 1, T, R, C), (K, Mt, Mr, Mc) -> (B, K, T/Mt, R/Mr, C/Mc).

    In the type of the weights. Raises InputError for counts of another shape or that blocks do not tile.
    """
    codes, mt, mr, mc = weights.shape
    block = mt, mr, mc
    check_counts(counts, block)
    batch, _, bins, rows, columns = counts.shape
    matrix = weights.reshape(codes, -1)
    if mr == mc == 1:
        stacked = counts.reshape(batch * (bins // mt), mt, rows * columns).to(weights.dtype)
        product = torch.bmm(matrix.expand(len(stacked), -1, -1), stacked)
        return product.view(batch, bins // mt, codes, rows, columns).transpose(1, 2)
    gathered = applied(_Gather, counts, block).to(weights.dtype)
    product = gathered @ matrix.T
    return product.view(batch, bins // mt, rows // mr, columns // mc, codes).permute(0, 4, 1, 2, 3)


def back_project(codes: Tensor, weights: Tensor) -> Tensor:
    """Return x = sum_k C_k y_k in every block, unfiltered: (B, K, T', R', C') -> (B, 1, T' Mt, R' Mr, C' Mc).

    weights (K, Mt, Mr, Mc), or (T', K, Mt, Mr, Mc) where every time block has its own.
    """
    batch, count, times, rows, columns = codes.shape
    *own, _, mt, mr, mc = weights.shape
    size = torch.Size((batch, 1, times * mt, rows * mr, columns * mc))
    matrix = weights.reshape(*own, count, mt * mr * mc)
    if mr == mc == 1:
        stacked = codes.transpose(1, 2).reshape(batch * times, count, rows * columns)
        matrices = matrix.expand(batch, times, count, mt).reshape(batch * times, count, mt)
        return torch.bmm(matrices.mT, stacked).view(size)
    if own:
        stacked = codes.permute(0, 2, 3, 4, 1).reshape(batch, times, rows * columns, count)
        product = stacked @ matrix
    else:
        product = codes.permute(0, 2, 3, 4, 1).reshape(-1, count) @ matrix
    return applied(_Scatter, product.reshape(-1, mt * mr * mc), (mt, mr, mc), size)


def materialises_full_tensor(codes: int, block: tuple[int, int, int], counts: int) -> bool:
    """Return whether to form a separable coding tensor for so many counts. Else a batch of 6 x 16 x 16 pixels takes a
    fifth of the time with 512 codes of 1024 x 8 x 8 (measured), but up to twice the time where C is small."""
    return codes * math.prod(block) <= FORMED * counts


def encode_separable(counts: Tensor, temporal: Tensor, spatial: Tensor) -> Tensor:
    """Return `encode_blocks` with C[k, t, r, c] = temporal[k, t] spatial[k, r, c], (K, Mt) and (K, Mr, Mc), without
    forming C.

    As many multiplications; where C is far larger than all counts (`materialises_full_tensor`) memory takes the time.
    """
    (codes, mt), (_, mr, mc) = temporal.shape, spatial.shape
    check_counts(counts, (mt, mr, mc))
    batch, _, bins, rows, columns = counts.shape
    stacked = counts.reshape(batch * (bins // mt), mt, rows * columns).to(temporal.dtype)
    per_pixel = torch.bmm(temporal.expand(len(stacked), -1, -1), stacked)
    of_blocks = per_pixel.view(-1, codes, rows // mr, mr, columns // mc, mc)
    summed = (of_blocks * spatial[:, None, :, None, :]).sum((3, 5))
    return summed.view(batch, bins // mt, codes, rows // mr, columns // mc).transpose(1, 2)


def correlate_separable(codes: Tensor, temporal: Tensor, spatial: Tensor, *, centre: bool = True) -> Tensor:
    """Return `back_project(codes, zero_normalised(C, 0, centre=centre))` of a separable C, without forming it.

    With `centre` the codes must have no mean over K, as after `zero_normalised`: what C has then falls out of the
    product. Of C itself only its norms over K are needed, n(t, s)^2 = sum_k T^2 S^2 - K m^2, m = sum_k T S / K.
    """
    (batch, count, times, rows, columns), mt, (_, mr, mc) = codes.shape, temporal.shape[1], spatial.shape
    spread = codes.transpose(1, 2).reshape(batch * times, count, rows, 1, columns, 1) * spatial[:, None, :, None, :]
    product = torch.bmm(
        temporal.T.expand(len(spread), -1, -1), spread.reshape(len(spread), count, rows * mr * columns * mc)
    )
    # in float64, as a small difference of two sums is wanted
    wide, flat = temporal.double().T, spatial.double().flatten(1)
    square = wide.square() @ flat.square()
    squared_norm = square - (wide @ flat).square() / count if centre else square
    there = squared_norm > NO_NORM * square
    norm = torch.where(there, squared_norm, 1.0).sqrt() * there
    fraction = (1 / (norm + EPSILON)).to(codes.dtype).view(mt, 1, mr, 1, mc)
    scaled = product.view(batch * times, mt, rows, mr, columns, mc) * fraction
    return scaled.view(batch, 1, times * mt, rows * mr, columns * mc)
