"""`Blockwise`: the compact network, which also sees the codes themselves and knows where in its block a pixel lies.

The back-projection gives every pixel and bin one number. The pixels of a block share their codes, so the numbers of a
pixel hold the returns of its neighbours as well (crosstalk), by an amount that depends on both places within the block.
A convolution is the same everywhere and cannot know these places. Two steps are added to `Compact`, one after its first
convolution and one before its last. For every block and coarse bin of 16 bins:

    h = relu(A x + B_s u + b_s)        x  features of the block's pixels, side by side
    x <- x + D h                       u  the block's normalised codes, and how much of the signal the time block holds
                                       s  place of the coarse bin in its time block

D begins at zero: the network then begins as the compact one of the same weights.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from csph.codes.blocks import zero_normalised
from csph.networks.compact import FOLD, Compact

MAX_HIDDEN = 256  # units of a block and coarse bin


class BlockMixer(nn.Module):
    """Add to the features of each block what its pixels and codes say together; see the module.

    Features (B T/16, channels, R, C) and codes (B, T/Mt, R/Mr, C/Mc, K + 1) -> features.
    """

    def __init__(self, channels: int, block: tuple[int, int, int], codes: int) -> None:
        super().__init__()
        bins, self.rows, self.columns = block
        width, places = self.rows * self.columns * channels, bins // FOLD
        hidden = min(2 * width, MAX_HIDDEN)
        self.inner = nn.Linear(width, hidden, bias=False)
        self.of_codes = nn.Parameter(torch.randn(places, codes + 1, hidden) / math.sqrt(codes + 1))
        self.bias = nn.Parameter(torch.zeros(places, 1, hidden))
        self.outer = nn.Linear(hidden, width)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)

    def forward(self, features: Tensor, codes: Tensor) -> Tensor:
        batch, times, down, across, entries = codes.shape
        places, channels = len(self.of_codes), features.shape[1]
        size = (batch * times, places, down, self.rows, across, self.columns, channels)
        x = features.permute(0, 2, 3, 1).reshape(size).permute(1, 0, 2, 4, 3, 5, 6)
        h = self.inner(x.reshape(places, -1, self.inner.in_features))
        h = (h + torch.baddbmm(self.bias, codes.reshape(1, -1, entries).expand(places, -1, -1), self.of_codes)).relu_()
        added = self.outer(h).view(places, batch * times, down, across, self.rows, self.columns, channels)
        added = added.permute(1, 0, 2, 4, 3, 5, 6).reshape(
            len(features), down * self.rows, across * self.columns, channels
        )
        return features + added.permute(0, 3, 1, 2)


def mixers_for(mine: dict[str, Tensor], theirs: dict[str, Tensor], *, same_pixels: bool) -> dict[str, Tensor]:
    """Return the state of a network with codes for blocks of another size: `theirs`, and mixers as those of `mine` are.

    Blocks of the same pixels and more bins get the mixers repeated: each part of a block, with its share of the codes,
    is mixed as its block was. Blocks of other pixels keep the mixers of `mine`.
    """
    fitted = dict(theirs)
    for name in (name.removesuffix("of_codes") for name in mine.keys() & theirs if name.endswith(".of_codes")):
        parts = {key: theirs[name + key] for key in ("inner.weight", "of_codes", "bias", "outer.weight", "outer.bias")}
        own = {key: mine[name + key] for key in parts}
        fitted |= {name + key: value for key, value in (_repeated(parts, own) if same_pixels else own).items()}
    return fitted


def _repeated(mixer: dict[str, Tensor], larger: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a mixer's weights for blocks of as many pixels, `times` as long, whose codes are `times` as many."""
    (places, entries, hidden), (long, more, _) = mixer["of_codes"].shape, larger["of_codes"].shape
    times = long // places
    if long != times * places or more - 1 != times * (entries - 1):
        return larger
    of_codes = mixer["of_codes"].new_zeros((times, places, more, hidden))
    for part in range(times):
        of_codes[part, :, part * (entries - 1) : (part + 1) * (entries - 1)] = mixer["of_codes"][:, :-1]
        of_codes[part, :, -1] = mixer["of_codes"][:, -1]  # how much of the signal the time block holds
    return {**mixer, "of_codes": of_codes.flatten(0, 1), "bias": mixer["bias"].repeat(times, 1, 1)}


def code_features(codes: Tensor, *, centre: bool = True) -> Tensor:
    """Return what `BlockMixer` sees of codes (B, K, T/Mt, R/Mr, C/Mc), free of their scale: unit codes, and the
    fraction of the block's signal in each time block, (B, T/Mt, R/Mr, C/Mc, K + 1); `centre` as `zero_normalised`."""
    with torch.autocast(codes.device.type, enabled=False):  # 16 bits would overflow in a bright block's mean
        centred = codes - codes.mean(1, keepdim=True) if centre else codes
        norm = centred.norm(dim=1, keepdim=True)
        fraction = norm / norm.norm(dim=2, keepdim=True).clamp(min=1e-20)
        return torch.cat([zero_normalised(codes, 1, centre=centre), fraction], 1).permute(0, 2, 3, 4, 1)


class Blockwise(Compact):
    """Back-projection (B, 1, T, R, C) and codes (B, K, T/Mt, R/Mr, C/Mc) -> logits (B, T, R, C), any sign.

    Mt is a multiple of 16. `keep_mean`: the layer leaves the mean over K in its codes, and so does the network.
    """

    def __init__(self, block: tuple[int, int, int], codes: int, *, keep_mean: bool = False) -> None:
        super().__init__()
        self.centre = not keep_mean
        self.reach = Compact.reach + 2 * (max(block[1:]) - 1)  # each mixer sees to the end of its block
        channels = self.stem.out_channels
        self.early = BlockMixer(channels, block, codes)
        self.late = BlockMixer(channels, block, codes)

    def forward(self, x: Tensor, codes: Tensor) -> Tensor:  # type: ignore[override]
        block_codes = code_features(codes, centre=self.centre).to(x.dtype)
        return self.logits(x, lambda f: self.early(f, block_codes), lambda f: self.late(f, block_codes))
