"""The published depth network: plain deep boosting "C64B10" (Peng et al., ECCV 2020), without its non-local block.

    features at four dilations -> time / 16 by four strided convolutions -> ten dense blocks -> time x 16 -> logits

568,278 parameters and 50.2 GMAC for 1024 x 32 x 32 counts, of which 41.6 in the four transposed convolutions. Order of
every tensor: batch, channel, time, row, column. `list(network.parameters())` is in the order of the published table.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from scenes.errors import require

TIME_FACTOR = 16  # the time axis must be a multiple of it: four halvings
_UP_INIT_STD = 1e-3  # of the last transposed convolution, as published


class DenseBlock(nn.Module):
    """c -> c + 8 channels: 1x1x1 to 16, two pairs of 3^3 convolutions of dilations 1, 2 and 2, 1, and 1x1x1 to 8."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.f0 = nn.Conv3d(channels, 16, 1)
        self.p1 = nn.Conv3d(16, 8, 3, padding=1)
        self.p15 = nn.Conv3d(8, 4, 3, padding=2, dilation=2)
        self.p2 = nn.Conv3d(16, 8, 3, padding=2, dilation=2)
        self.p25 = nn.Conv3d(8, 4, 3, padding=1)
        self.f = nn.Conv3d(24, 8, 1)

    def forward(self, x: Tensor) -> Tensor:
        narrow = self.f0(x).relu_()
        first, second = self.p1(narrow).relu_(), self.p2(narrow).relu_()
        third, fourth = self.p15(first).relu_(), self.p25(second).relu_()
        return torch.cat([x, self.f(torch.cat([first, third, second, fourth], 1)).relu_()], 1)


class DeepBoosting(nn.Module):
    """(B, 1, T, R, C) -> logits (B, T, R, C); T a multiple of 16, R and C free.

    final_relu   the published final ReLU: where all logits are 0, so is every gradient, and the depth is mid-range for
              good. False leaves the logits signed: the same parameters, and nothing that can die.
    Raises InputError for another number of bins.
    """

    reach = 41  # pixels around one that its answer depends on: 3 + 4 + 10 x 3 + 4
    coarsest = 1

    def __init__(self, *, final_relu: bool = True) -> None:
        super().__init__()
        self.final_relu = final_relu
        self.a1 = nn.Conv3d(1, 2, 3, padding=1)
        self.a2 = nn.Conv3d(1, 2, 3, padding=2, dilation=2)
        self.a3 = nn.Conv3d(2, 2, 3, padding=1)
        self.a4 = nn.Conv3d(2, 2, 3, padding=2, dilation=2)
        self.c1 = nn.Conv3d(8, 2, 1)
        steps = zip((2, 4, 8, 16), (4, 8, 16, 32), strict=True)
        self.ds = nn.ModuleList(nn.Conv3d(i, o, 3, stride=(2, 1, 1), padding=1) for i, o in steps)
        self.blocks = nn.ModuleList(DenseBlock(channels) for channels in range(32, 112, 8))
        steps = zip((112, 56, 28, 14), (56, 28, 14, 7), strict=True)
        self.up = nn.ModuleList(
            nn.ConvTranspose3d(i, o, (6, 3, 3), stride=(2, 1, 1), padding=(2, 1, 1), bias=False) for i, o in steps
        )
        self.out = nn.Conv3d(7, 1, 1)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw weights: Kaiming-normal by fan-in (of transposed convolutions, the output channels), up4 N(0, 0.001^2),
        biases 0."""
        for module in self.modules():
            if isinstance(module, (nn.Conv3d, nn.ConvTranspose3d)):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        nn.init.normal_(_weight(self.up[-1]), std=_UP_INIT_STD)

    def multiscale(self, x: Tensor) -> Tensor:
        """Return features (B, 8, T, R, C) of a histogram (B, 1, T, R, C), two channels from each of four branches.

        In order: a convolution of dilation 1, one of dilation 2, dilation 1 after dilation 2, and 2 after 1.
        """
        first, second = self.a1(x).relu_(), self.a2(x).relu_()
        return torch.cat([first, second, self.a3(second).relu_(), self.a4(first).relu_()], 1)

    def contract(self, features: Tensor) -> Tensor:
        """Return features (B, 32, T/16, R, C) of (B, 8, T, R, C): a 1x1x1 convolution to two channels, then four
        convolutions that each halve the time axis."""
        x = self.c1(features).relu_()
        for step in self.ds:
            x = step(x).relu_()
        return x

    def boost(self, x: Tensor) -> Tensor:
        """Return features (B, 112, T/16, R, C) of (B, 32, T/16, R, C): ten dense blocks add 8 channels each."""
        for block in self.blocks:
            x = block(x)
        return x

    def expand(self, x: Tensor) -> Tensor:
        """Return logits (B, T, R, C) of features (B, 112, T/16, R, C).

        Four transposed convolutions each double the time axis, and a 1x1x1 convolution leaves one channel.

        No ReLU stands between the last two of these. They are computed as one transposed convolution with the product
        of their kernels, which has one output channel instead of seven, and takes a seventh of the work.
        """
        for step in self.up[:-1]:
            x = transposed_conv_x2(x, _weight(step)).relu_()
        joined = torch.einsum("ioxyz,o->ixyz", _weight(self.up[-1]), self.out.weight.flatten()).unsqueeze(1)
        assert self.out.bias is not None
        logits = transposed_conv_x2(x, joined).squeeze(1) + self.out.bias
        return logits.relu_() if self.final_relu else logits

    def forward(self, x: Tensor) -> Tensor:
        check_input(x, TIME_FACTOR)
        return self.expand(self.boost(self.contract(self.multiscale(x))))


def _weight(module: nn.Module) -> Tensor:
    weight = module.weight
    assert isinstance(weight, Tensor)
    return weight


def transposed_conv_x2(x: Tensor, weight: Tensor) -> Tensor:
    """Return the transposed convolution of kernel 6 x 3 x 3, stride 2 x 1 x 1, padding 2 x 1 x 1, by an ordinary one.

    An output at time 2 t + p takes inputs t - 1, t, t + 1 with taps p + 4, p + 2, p: a 3^3 convolution to twice the
    channels, whose pairs then interleave in time. (B, I, T, R, C), (I, O, 6, 3, 3) -> (B, O, 2 T, R, C).
    """
    inputs, outputs = weight.shape[:2]
    # tap j = 2 m' + p of the kernel is tap m = 2 - m' of the convolution; space is turned over as well
    taps = weight.view(inputs, outputs, 3, 2, 3, 3).flip(2, 4, 5)
    kernel = taps.permute(1, 3, 0, 2, 4, 5).reshape(2 * outputs, inputs, 3, 3, 3)
    pairs = functional.conv3d(x, kernel, padding=1)
    return pairs.unflatten(1, (outputs, 2)).transpose(2, 3).flatten(2, 3)


def check_input(x: Tensor, factor: int) -> None:
    """Raise InputError unless x is (B, 1, T, R, C), none of them 0, with T a multiple of `factor`."""
    shape = tuple(x.shape)
    good = len(shape) == 5 and shape[1] == 1 and 0 not in shape
    require(good, f"network input of shape {shape}: expected (batch, 1, time, rows, columns), each 1 or more")
    require(shape[2] % factor == 0, f"network input of {shape[2]} bins: expected a multiple of {factor}")


def soft_argmax(logits: Tensor) -> Tensor:
    """Return sum_i softmax(logits)_i (i + 1/2), the mean bin centre: (B, T, R, C) -> (B, R, C) float32, in bins.

    Its mean over a softmax that is flat in part is drawn towards T / 2: `metrics.bias_by_depth` measures it.
    """
    with torch.autocast(logits.device.type, enabled=False):  # bf16 would leave 8 bits of a sum: 4 bins of 1024
        logits = logits.float()
        centres = torch.arange(logits.shape[1], dtype=torch.float32, device=logits.device) + 0.5
        return torch.einsum("btrc,t->brc", logits.softmax(1), centres)


def parameters_of(network: nn.Module) -> int:
    return sum(math.prod(parameter.shape) for parameter in network.parameters())
