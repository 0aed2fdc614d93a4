"""`Compact`: a small depth network of our own, for two cores; under 1.5 GMAC for 1024 x 32 x 32 counts.

The back-projection is folded: 16 neighbouring bins become 16 channels of one coarse bin, and every convolution works
on 1/16 of the time axis. Three levels of space (1, 1/2, 1/4) gather what neighbours know; the result says of every
coarse bin how likely its 16 fine bins are, and how far to trust the back-projection itself there, as it is and
averaged over 3 x 3 and about 6 x 6 pixels:

    logits = fine + g0 x + g1 <x>_3 + g2 <x>_6

Between the first and the last product, features are (B T/16, channels, R, C) with channels last in memory, which is
(B, channels, T/16, R C) as well: convolutions over space and over time both take it as it lies, in two dimensions. The
back-projection, its averages and the logits stay in the order of the histogram. On a CPU a step's time goes into
memory as much as into arithmetic, hence the two functions with derivatives of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import product

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from csph.autograd import Context
from csph.networks.published import check_input

FOLD = 16  # fine bins of one coarse bin
Step = Callable[[Tensor], Tensor]
VIEWS = 3  # of the back-projection: as it is, and two averages


def channels_last(network: nn.Module) -> None:
    """Lay all convolutions out with channels last in memory: half the time of small ones on a CPU."""
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.Conv3d)):
            order = torch.channels_last if isinstance(module, nn.Conv2d) else torch.channels_last_3d
            module.to(memory_format=order)  # type: ignore[call-overload]  # not in torch's stubs


class FactorisedConv(nn.Module):
    """x + relu(convolution over time of relu(convolution over space)): 12 taps instead of 27."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.space = nn.Conv2d(channels, channels, 3, padding=1)
        self.time = nn.Conv2d(channels, channels, (3, 1), padding=(1, 0))

    def forward(self, x: Tensor, batch: int) -> Tensor:
        return x + over_time(self.time, self.space(x).relu_(), batch)


class _ResidualConv3d(nn.Module):
    """x + relu(3^3 convolution of x)."""

    def __init__(self, channels: int, convolution: type[nn.Conv3d]) -> None:
        super().__init__()
        self.whole = convolution(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.whole(x).relu_()


# Names of the modules of `Compact` in checkpoints. They are those that older versions gave the modules, so that their
# checkpoints are read and hashes of weights do not change.
IN_FILES = {
    "full_resolution": "near",
    "half_resolution": "middle",
    "quarter_resolution": "far",
    "quarter_to_half": "from_far",
    "half_to_full": "from_middle",
    "skip_gates": "trust",
}


class Compact(nn.Module):
    """(B, 1, T, R, C) -> logits (B, T, R, C), any sign; T a multiple of 16, R and C free.

    Raises InputError for another number of bins.
    """

    reach = 20  # pixels around one that its answer depends on
    read_outs: tuple[str, ...] = ("fine", "skip_gates")  # layers whose products are the answer, not features
    coarsest = 4  # pixels of a cell of its coarsest level, whose grid begins at the image's first
    convolution = nn.Conv3d  # of its coarsest level, over time and space

    def __init__(self) -> None:
        super().__init__()
        full, half, quarter = 16, 32, 48  # channels at each resolution
        self.stem = nn.Conv2d(FOLD, full, (3, 1), padding=(1, 0))
        self.full_resolution = FactorisedConv(full)
        self.halved = nn.Conv2d(full, half, 3, stride=2, padding=1)
        self.half_resolution = nn.ModuleList([FactorisedConv(half), FactorisedConv(half)])
        self.quartered = self.convolution(half, quarter, 3, stride=2, padding=1)
        self.quarter_resolution = nn.Sequential(*(_ResidualConv3d(quarter, self.convolution) for _ in range(2)))
        self.quarter_to_half = nn.Linear(quarter, half)
        self.half_to_full = nn.Linear(half, full)
        self.last = FactorisedConv(full)
        self.fine = nn.Linear(full, FOLD)
        self.skip_gates = nn.Linear(full, VIEWS)
        with torch.no_grad():  # begin with what the back-projection says
            self.fine.weight.mul_(0.1)
            self.skip_gates.weight.mul_(0.1)
            self.skip_gates.bias.fill_(4.0)
        channels_last(self)
        self.register_state_dict_post_hook(_to_names_in_files)
        self.register_load_state_dict_pre_hook(_from_names_in_files)

    def forward(self, x: Tensor) -> Tensor:
        return self.logits(x)

    def logits(self, x: Tensor, early: Step | None = None, late: Step | None = None) -> Tensor:
        """Return the logits of a back-projection; `early` and `late` as in `features`."""
        features, slices = self.features(x, early, late)
        return logits_of(features, slices, self.fine, self.skip_gates, x)

    def features(self, x: Tensor, early: Step | None = None, late: Step | None = None) -> tuple[Tensor, Tensor]:
        """Return the last features (B T/16, channels, R, C) and the back-projection as slices (B T/16, 16, R, C).

        `early` and `late` change the features after the first and before the last convolution.
        """
        check_input(x, FOLD)
        batch, _, _, rows, columns = x.shape
        slices = x.reshape(-1, FOLD, rows, columns)
        first = over_time(self.stem, time_to_channels(slices), batch)
        full = self.full_resolution(early(first) if early else first, batch)
        half = self.halved(full).relu_()
        for step in self.half_resolution:
            half = step(half, batch)
        volume = half.unflatten(0, (batch, -1)).transpose(1, 2)
        volume = enlarged(
            _linear(self.quarter_to_half, self.quarter_resolution(self.quartered(volume).relu_())), volume, (2, 3, 4)
        )
        half = volume.transpose(1, 2).flatten(0, 1)
        features = enlarged(_linear(self.half_to_full, half), full, (2, 3))
        return self.last(late(features) if late else features, batch), slices


def _renamed(state: dict[str, Tensor], prefix: str, names: Mapping[str, str]) -> None:
    """Rename modules below `prefix` in a state, in place and in its order."""
    held = list(state.items())
    state.clear()
    for key, value in held:
        module, dot, rest = key.removeprefix(prefix).partition(".")
        below = key.startswith(prefix) and module in names
        state[f"{prefix}{names[module]}{dot}{rest}" if below else key] = value


def _to_names_in_files(network: nn.Module, state: dict[str, Tensor], prefix: str, metadata: object) -> None:
    _renamed(state, prefix, IN_FILES)


def _from_names_in_files(network: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    _renamed(state, prefix, {old: new for new, old in IN_FILES.items()})


class _TimeToChannels(torch.autograd.Function):
    """(N, A, B) -> (N, B, A), by a product with the identity: half the time of a strided copy on a CPU."""

    @staticmethod
    def forward(ctx: Context, values: Tensor) -> Tensor:
        one = torch.eye(min(values.shape[1:]), dtype=values.dtype, device=values.device).expand(len(values), -1, -1)
        turned = values.transpose(1, 2)
        return torch.bmm(turned, one) if turned.shape[2] == one.shape[1] else torch.bmm(one, turned)

    @staticmethod
    def backward(ctx: Context, grad: Tensor) -> Tensor:
        return _TimeToChannels.apply(grad.contiguous())


def time_to_channels(slices: Tensor) -> Tensor:
    """Return (N, 16, R, C) with channels last in memory: the fine bins of a coarse bin side by side."""
    return _TimeToChannels.apply(slices.flatten(2)).transpose(1, 2).unflatten(2, slices.shape[2:])


def over_time(convolution: nn.Conv2d, x: Tensor, batch: int) -> Tensor:
    """Convolve features (B T, channels, R, C) with a kernel 3 x 1 over (T, R C), followed by relu."""
    rows, columns = x.shape[2:]
    stretched = x.permute(0, 2, 3, 1).reshape(batch, -1, rows * columns, x.shape[1]).permute(0, 3, 1, 2)
    y = convolution(stretched).relu_().permute(0, 2, 3, 1)  # in place before it is seen otherwise: no copy
    return y.reshape(-1, rows, columns, y.shape[-1]).permute(0, 3, 1, 2)


def _linear(layer: nn.Linear, x: Tensor) -> Tensor:
    """Apply a 1 x 1 convolution to features (N, channels, ...) with channels last in memory."""
    return layer(x.movedim(1, -1)).movedim(-1, 1)


class _ReadOut(torch.autograd.Function):
    """See `read_out`."""

    @staticmethod
    def forward(ctx: Context, features: Tensor, slices: Tensor, *weights: Tensor) -> Tensor:
        matrix, bias, gate_weight, gate_bias = weights
        views = tuple(v.flatten(2).to(slices.dtype) for v in (slices, *averages(slices)))
        across = features.transpose(1, 2)
        total = torch.baddbmm(bias.unsqueeze(-1), matrix.expand(len(features), -1, -1), across).to(slices.dtype)
        gates = torch.baddbmm(gate_bias.unsqueeze(-1), gate_weight.expand(len(features), -1, -1), across).to(
            slices.dtype
        )
        for number, view in enumerate(views):
            total.addcmul_(gates[:, number : number + 1], view)
        ctx.size = slices.shape
        ctx.save_for_backward(features, matrix, gate_weight, gates, *views)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor | None, ...]:
        features, matrix, gate_weight, gates, *views = ctx.saved_tensors
        slopes, scratch = torch.empty_like(gates), torch.empty_like(grad)
        for number, view in enumerate(views):
            torch.sum(torch.mul(grad, view, out=scratch), 1, out=slopes[:, number])
        back = torch.bmm(grad.transpose(1, 2), matrix.expand(len(grad), -1, -1))
        back.baddbmm_(slopes.transpose(1, 2), gate_weight.expand(len(grad), -1, -1))
        exact = features.to(grad.dtype)
        of_weights = (torch.bmm(grad, exact).sum(0), grad.sum((0, 2)), torch.bmm(slopes, exact).sum(0))
        to_slices = _averages_back(grad, gates, scratch, ctx.size) if ctx.needs_input_grad[1] else None
        return back.to(features.dtype), to_slices, *of_weights, slopes.sum((0, 2))


def read_out(
    features: Tensor, slices: Tensor, fine: Tensor, fine_bias: Tensor, gate_weight: Tensor, gate_bias: Tensor
) -> Tensor:
    """Return fine + sum_v gate_v view_v of each slice: fine and gates are linear in the features, the views are the
    slice and its averages. features (N, P, channels), slices (N, F, R, C), P = R C; weights (F, channels), (F,), (3,
    channels) and (3,) -> (N, F, P), in memory as the histogram lies."""
    return _ReadOut.apply(features, slices, fine, fine_bias, gate_weight, gate_bias)


def logits_of(features: Tensor, slices: Tensor, fine: nn.Linear, gates: nn.Linear, like: Tensor) -> Tensor:
    """Return `read_out` of features (N, channels, R, C) as logits (B, T, R, C) of a histogram (B, 1, T, R, C)."""
    flat = features.flatten(2).transpose(1, 2)
    return read_out(flat, slices, fine.weight, fine.bias, gates.weight, gates.bias).view(like.shape[0], *like.shape[2:])


def averages(slices: Tensor) -> tuple[Tensor, Tensor]:
    """Return means of each time slice (N, F, R, C) over 3 x 3 pixels, and over 3 x 3 squares of 2 x 2; at the border,
    of what there is. Both are products with a matrix on either side, R + C multiplications a value."""
    flat = slices.reshape(-1, *slices.shape[2:])
    near, wide = (
        torch.bmm(left.expand(len(flat), -1, -1), flat @ right.T).view(slices.shape)
        for left, right in zip(*_means(slices), strict=True)
    )
    return near, wide


def _averages_back(grad: Tensor, gates: Tensor, scratch: Tensor, size: torch.Size) -> Tensor:
    """Compute gate_0 grad + sum of the transposed averages of gate_v grad: (N, F, P) -> `size`."""
    total = torch.mul(grad, gates[:, :1]).view(-1, *size[2:])
    for number, (left, right) in enumerate(zip(*_means(total), strict=True), start=1):
        torch.mul(grad, gates[:, number : number + 1], out=scratch)
        moved = torch.bmm(left.T.expand(len(total), -1, -1), scratch.view(total.shape))
        total.view(-1, size[3]).addmm_(moved.view(-1, size[3]), right)
    return total.view(size)


def _means(slices: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
    """Return both mean matrices of the rows and both of the columns."""
    return tuple(_mean_matrices(size, slices.dtype, str(slices.device)) for size in slices.shape[-2:])


@lru_cache(maxsize=32)
def _mean_matrices(size: int, dtype: torch.dtype, device: str) -> tuple[Tensor, Tensor]:
    """Make two matrices, (size, size) each: means over three neighbours, and over three pairs, given to both of a
    pair."""
    with torch.inference_mode(False):  # kept beyond the validation that may have asked first
        pairs = torch.arange(-(-size // 2))
        member = (torch.arange(size) // 2 == pairs.unsqueeze(-1)).double()
        wide = member.T @ _of_three(len(pairs)) @ (member / member.sum(1, keepdim=True))
        return _of_three(size).to(device, dtype), wide.to(device, dtype)


def _of_three(size: int) -> Tensor:
    place = torch.arange(size)
    near = ((place - place.unsqueeze(-1)).abs() <= 1).double()
    return near / near.sum(1, keepdim=True)


class _Enlarged(torch.autograd.Function):
    """See `enlarged`."""

    @staticmethod
    def forward(ctx: Context, coarse: Tensor, fine: Tensor, axes: tuple[int, ...]) -> Tensor:
        ctx.axes, ctx.shape, total = axes, coarse.shape, fine.clone()
        for part, whole in _parts(total, coarse, axes):
            part.add_(whole)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        coarse = torch.zeros_like(grad[_every_other(ctx.axes, (0,) * len(ctx.axes))])
        for part, whole in _parts(grad, coarse, ctx.axes):
            whole.add_(part)
        return coarse, grad, None


def _every_other(axes: tuple[int, ...], first: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(first[axes.index(a)], None, 2) if a in axes else slice(None) for a in range(max(axes) + 1))


def _parts(fine: Tensor, coarse: Tensor, axes: tuple[int, ...]) -> list[tuple[Tensor, Tensor]]:
    """View every other value of the fine tensor, and the coarse one as far as those reach (odd sizes)."""
    found = []
    for first in product((0, 1), repeat=len(axes)):
        part = fine[_every_other(axes, first)]
        found.append((part, coarse[tuple(map(slice, part.shape))]))
    return found


def enlarged(coarse: Tensor, fine: Tensor, axes: tuple[int, ...]) -> Tensor:
    """Return fine + coarse, each of whose values stands for two neighbours along `axes` (for one at an odd end)."""
    return _Enlarged.apply(coarse, fine, axes)
