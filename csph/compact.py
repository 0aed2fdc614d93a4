"""`Compact`: a small depth network of our own, for two cores; under 1.5 GMAC for 1024 x 32 x 32 counts.

The back-projection is folded: 16 neighbouring bins become 16 channels of one coarse bin, and every convolution works
on 1/16 of the time axis. Three levels of space (1, 1/2, 1/4) gather what neighbours know; the result says of every
coarse bin how likely its 16 fine bins are, and how far to trust the back-projection itself there, as it is and
averaged over 3 x 3 and about 6 x 6 pixels:

    logits = fine + g0 x + g1 <x>_3 + g2 <x>_6
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from csph.backbone import check_input

FOLD = 16  # fine bins of one coarse bin
VIEWS = 3  # of the back-projection: as it is, and two averages


class TimeConvolution(nn.Conv2d):
    """Kernel 3 x 1 x 1, written as a convolution of two dimensions: torch has no quick one of three for it on a CPU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, (3, 1), padding=(1, 0))

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.flatten(3)).unflatten(3, x.shape[3:])


class _Split(nn.Module):
    """x + relu(convolution over space, then over time): 12 taps instead of 27."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.space = nn.Conv3d(channels, channels, (1, 3, 3), padding=(0, 1, 1))
        self.time = TimeConvolution(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.time(self.space(x).relu_()).relu_()


class _Whole(nn.Module):
    """x + relu(3^3 convolution of x)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.whole = nn.Conv3d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.whole(x).relu_()


class Compact(nn.Module):
    """(B, 1, T, R, C) -> logits (B, T, R, C), any sign; T a multiple of 16, R and C free.

    Raises InputError for another number of bins.
    """

    def __init__(self) -> None:
        super().__init__()
        near, middle, far = 16, 32, 48
        self.stem = TimeConvolution(FOLD, near)
        self.near = _Split(near)
        self.halved = nn.Conv3d(near, middle, 3, stride=(1, 2, 2), padding=1)
        self.middle = nn.Sequential(_Split(middle), _Split(middle))
        self.quartered = nn.Conv3d(middle, far, 3, stride=2, padding=1)
        self.far = nn.Sequential(*(_Whole(far) for _ in range(2)))
        self.from_far = nn.Conv3d(far, middle, 1)
        self.from_middle = nn.Conv3d(middle, near, 1)
        self.last = _Split(near)
        self.fine = nn.Conv3d(near, FOLD, 1)
        self.trust = nn.Conv3d(near, VIEWS, 1)
        with torch.no_grad():  # begin with what the back-projection says
            self.fine.weight.mul_(0.1)
            self.trust.weight.mul_(0.1)
            self.trust.bias.fill_(4.0)
        # channels last in memory: half the time of small convolutions on a CPU
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.Conv3d)):
                flat = isinstance(module, nn.Conv2d)
                module.to(memory_format=torch.channels_last if flat else torch.channels_last_3d)

    def forward(self, x: Tensor) -> Tensor:
        check_input(x, FOLD)
        folded = fold(x)
        near = self.near(self.stem(folded).relu_())
        middle = self.middle(self.halved(near).relu_())
        far = self.far(self.quartered(middle).relu_())
        middle = middle + enlarged(self.from_far(far), middle)
        features = self.last(near + enlarged(self.from_middle(middle), near))
        views = (folded, *averages(folded))
        trust = self.trust(features).split(1, dim=1)
        logits = self.fine(features)
        for gate, view in zip(trust, views, strict=True):
            logits = torch.addcmul(logits, gate, view)
        return unfold(logits)


def fold(x: Tensor) -> Tensor:
    """(B, 1, T, R, C) -> (B, 16, T/16, R, C): the fine bins of a coarse bin side by side as channels."""
    batch, _, bins, rows, columns = x.shape
    coarse = x.reshape(batch, bins // FOLD, FOLD, rows, columns).transpose(1, 2)
    return coarse.contiguous(memory_format=torch.channels_last_3d)


def unfold(x: Tensor) -> Tensor:
    """(B, 16, T/16, R, C) -> (B, T, R, C), undoes `fold`."""
    return x.transpose(1, 2).contiguous().flatten(1, 2)


def averages(x: Tensor) -> tuple[Tensor, Tensor]:
    """Means of each time slice over 3 x 3 pixels, and over 3 x 3 squares of 2 x 2; at the border, of what there is."""
    slices = x.transpose(1, 2).flatten(0, 1)
    halved = functional.avg_pool2d(slices, 2, ceil_mode=True, count_include_pad=False)
    wide = functional.interpolate(_of_nine(halved), size=x.shape[3:], mode="nearest")
    near, wide = (values.unflatten(0, (len(x), -1)).transpose(1, 2) for values in (_of_nine(slices), wide))
    return near, wide


def _of_nine(slices: Tensor) -> Tensor:
    return functional.avg_pool2d(slices, 3, 1, 1, count_include_pad=False)


def enlarged(x: Tensor, like: Tensor) -> Tensor:
    """Each value repeated over what it stands for, to the size of `like`."""
    return functional.interpolate(x, size=like.shape[2:], mode="nearest")
