"""`Periodic`: the compact network on a circle of time, for codes that know no first bin.

Codes of Fourier series over the whole range are alike at every delay: a return that comes s bins later turns their
phases, and their back-projection moves by s bins, around the end of the range. `Compact` pads time with zeros, so that
it answers otherwise near both ends, and what it learned at one depth it need not know at another. Here each convolution
over time goes around the circle instead. A delay by 32 bins, one slice of the coarsest level, then moves the logits by
32 bins, exactly. Within 32 bins answers still differ by some millimetres. A trained network is therefore asked four
times, with delays of 0, 8, 16 and 24 bins, and its logits are averaged (`eval`; training takes one of them):

    logits(x delayed by 8 s bins) = logits(x) delayed by 8 s bins

The weights are the compact network's.

A return within some bins of the range's ends has its posterior on both. The median is then on one of them, as
the part on the other is taken for far away: up to 1.5 bins inwards; the mean (soft-argmax) is somewhere between, metres
off.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from csph.networks.compact import FOLD, Compact, Step
from scenes.errors import require

PERIOD = 2 * FOLD  # bins of a delay that the layers follow exactly
ENDS_BINS = 8  # of either end of the range, within which the mean of a posterior on both ends fails
STEP = 8  # bins of a delay that the mean over delays follows exactly


class CircularInTime(nn.Conv3d):
    """A convolution of 3^3: zeros beside the image, and the ends of the range beside each other."""

    def forward(self, x: Tensor) -> Tensor:
        around = torch.cat([x[:, :, -1:], x, x[:, :, :1]], 2).contiguous(memory_format=torch.channels_last_3d)
        return F.conv3d(around, self.weight, self.bias, self.stride, (0, 1, 1))


class Periodic(Compact):
    """(B, 1, T, R, C) -> logits (B, T, R, C), any sign; T a multiple of 32, R and C free. See the module.

    Raises InputError for another number of bins.
    """

    convolution = CircularInTime

    def __init__(self) -> None:
        super().__init__()
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module.kernel_size == (3, 1):  # over time alone
                module.padding_mode = "circular"

    def forward(self, x: Tensor) -> Tensor:
        if self.training:
            return self.logits(x)
        total = self.logits(x)
        for delay in range(STEP, PERIOD, STEP):
            total = total + self.logits(x.roll(delay, 2)).roll(-delay, 1)
        return total / (PERIOD // STEP)

    def features(self, x: Tensor, early: Step | None = None, late: Step | None = None) -> tuple[Tensor, Tensor]:
        require(x.ndim < 3 or x.shape[2] % PERIOD == 0, f"{x.shape[2]} bins: expected a multiple of {PERIOD}")
        return super().features(x, early, late)
