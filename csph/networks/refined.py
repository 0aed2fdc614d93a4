"""`Refined`: the blockwise network with a second look at the codes, one unrolled step of a least-squares fit.

The back-projection of a block holds the returns of all its pixels on top of each other. Once there is an answer, the
codes that it explains can be told from those that it does not:

    p = softmax(first logits)       posterior of each pixel over time bins
    l = exp(a) p                    mean counts up to one scale; a is learned, one number a pixel and coarse bin
    r = y - s C l                   y: the block's codes, length 1; s >= 0: least squares
    logits = first + fine + g0 x' + g1 <x'>_3 + g2 <x'>_6        x' = ZN(C)^T r

What is left, x', is large where the first answer misses a return and negative where it sees one that is not there. Two
convolutions and a `BlockMixer` of the blockwise kind decide what it means, from x', p and r. Their last product begins
at zero: the network then begins as the blockwise one of the same weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from csph.layer import CompressiveLayer
from csph.networks.blockwise import BlockMixer, Blockwise, code_features
from csph.networks.compact import FOLD, VIEWS, FactorisedConv, channels_last, logits_of, over_time, time_to_channels

NO_LIGHT = 1e-6  # length of codes, or of their square, below which they hold no signal
MAX_LOG_AMPLITUDE = 4.0  # of a coarse bin: mean counts of a block's pixels differ by less than exp(8)


def unexplained(codes: Tensor, predicted: Tensor, *, centre: bool = True) -> Tensor:
    """Return r = y - s q of each block, codes and predicted codes (B, K, T/Mt, R/Mr, C/Mc) alike in shape.

    y are the codes scaled to length 1 over codes and time, 0 where there are none; s >= 0 is the least-squares scale of
    the prediction q. With `centre` both lose their mean over K first, as zero-normalisation takes it.
    """
    y, q = (one - one.mean(1, keepdim=True) if centre else one for one in (codes, predicted))
    y = y / torch.linalg.vector_norm(y, dim=(1, 2), keepdim=True).clamp(min=NO_LIGHT)
    scale = (y * q).sum((1, 2), keepdim=True) / (q * q).sum((1, 2), keepdim=True).clamp(min=NO_LIGHT)
    return y - scale.clamp(min=0) * q


class Refined(Blockwise):
    """Back-projection (B, 1, T, R, C), codes (B, K, T/Mt, R/Mr, C/Mc) and the layer that made them -> logits (B, T, R,
    C), any sign.

    Mt is a multiple of 16. See the module.
    """

    read_outs = (*Blockwise.read_outs, "amplitude", "correction", "correction_gates")

    def __init__(self, block: tuple[int, int, int], codes: int, *, keep_mean: bool = False) -> None:
        super().__init__(block, codes, keep_mean=keep_mean)
        # averages see 3 pixels, the codes of a block and its mixer to the end of the block
        self.reach += 3 + 2 * (max(block[1:]) - 1)
        channels = self.stem.out_channels
        self.amplitude = nn.Linear(channels, 1)
        self.residual_stem = nn.Conv2d(2 * FOLD, channels, (3, 1), padding=(1, 0))
        self.second = FactorisedConv(channels)
        self.residual_mixer = BlockMixer(channels, block, codes)
        self.third = FactorisedConv(channels)
        self.correction = nn.Linear(channels, FOLD)
        self.correction_gates = nn.Linear(channels, VIEWS)
        for layer in (self.amplitude, self.correction, self.correction_gates):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        channels_last(self)

    def forward(self, x: Tensor, codes: Tensor, layer: CompressiveLayer) -> Tensor:  # type: ignore[override]
        block_codes = code_features(codes, centre=self.centre).to(x.dtype)
        features, slices = self.features(x, lambda f: self.early(f, block_codes), lambda f: self.late(f, block_codes))
        first = logits_of(features, slices, self.fine, self.skip_gates, x)
        posterior = first.softmax(1).view(x.shape)
        predicted = layer.encode_mean(self.mean_counts(posterior, features))
        residual = unexplained(codes, predicted, centre=self.centre)
        return first + self._correction(features, residual, posterior, layer)

    def mean_counts(self, posterior: Tensor, features: Tensor) -> Tensor:
        """Return exp(a) p, (B, 1, T, R, C), up to one scale for each block: the light that the first answer means."""
        batch, _, bins, rows, columns = posterior.shape
        log = self.amplitude(features.permute(0, 2, 3, 1)).clamp(-MAX_LOG_AMPLITUDE, MAX_LOG_AMPLITUDE)
        amplitude = log.exp().view(batch, bins // FOLD, 1, rows, columns)
        return (posterior.view(batch, bins // FOLD, FOLD, rows, columns) * amplitude).view(posterior.shape)

    def _correction(self, features: Tensor, residual: Tensor, posterior: Tensor, layer: CompressiveLayer) -> Tensor:
        """Compute what the second look adds to the logits, (B, T, R, C)."""
        batch, (rows, columns) = len(posterior), posterior.shape[-2:]
        slices = layer.back_project(residual).to(posterior.dtype).reshape(-1, FOLD, rows, columns)
        both = torch.cat([time_to_channels(slices), time_to_channels(posterior.reshape(-1, FOLD, rows, columns))], 1)
        both = both.contiguous(memory_format=torch.channels_last)
        features = self.second(features + over_time(self.residual_stem, both, batch), batch)
        length = torch.linalg.vector_norm(residual, dim=1, keepdim=True)
        left = torch.cat([residual, length], 1).to(posterior.dtype).permute(0, 2, 3, 4, 1)
        features = self.third(self.residual_mixer(features, left), batch)
        return logits_of(features, slices, self.correction, self.correction_gates, posterior)
