"""Depth from the network's posterior over time bins: mean, median, and how sure it is."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from csph.networks.published import soft_argmax
from scenes.errors import require

Decoder = Literal["soft-argmax", "median"]
DECODERS: tuple[Decoder, ...] = ("soft-argmax", "median")
CONFIDENT_BINS = 3.0  # either side of the answer: what `confidence` counts as agreeing with it


def posterior_median(logits: Tensor) -> Tensor:
    """Return median of softmax(logits) over time, (B, T, R, C) -> (B, R, C) float32, in bins from the edge of bin 0.

    Probability is taken as uniform within a bin, so that the median is continuous and moves with the posterior. Unlike
    the mean (`soft_argmax`) it is not drawn to mid-range by a background that is flat. NaN where a logit is NaN.
    """
    cumulative = _cumulative(logits)
    # of what rounding made the whole, so that the middle is there whatever the sum
    half = 0.5 * cumulative[:, -1:]
    bins = (cumulative < half).sum(1, keepdim=True).clamp(max=logits.shape[1] - 1)
    upper = cumulative.gather(1, bins)
    lower = torch.where(bins > 0, cumulative.gather(1, (bins - 1).clamp(min=0)), 0.0)
    return (bins + (half - lower) / (upper - lower)).squeeze(1)


def confidence(logits: Tensor, position: Tensor, within: float = CONFIDENT_BINS, *, circular: bool = False) -> Tensor:
    """Return share of softmax(logits) within `within` bins of a position, (B, T, R, C), (B, R, C) -> (B, R, C) in [0,
    1].

    Positions are in bins from the edge of bin 0; a bin that the interval cuts counts in part. On a circle of time what
    the interval has beyond one end of the range is at the other. NaN where a logit or the position is NaN.
    """
    cumulative = _cumulative(logits)
    whole, bins = cumulative[:, -1], logits.shape[1]
    inside = _at(cumulative, position + within) - _at(cumulative, position - within)
    if circular:
        inside = inside + _at(cumulative, position + within - bins) + whole - _at(cumulative, position - within + bins)
    return (inside / whole).clamp(0, 1)


def decoded(logits: Tensor, decoder: Decoder) -> Tensor:
    """Return position of the answer in bins from the edge of bin 0, (B, T, R, C) -> (B, R, C), by `soft_argmax` or
    `posterior_median`. Raises InputError for another decoder."""
    require(decoder in DECODERS, f"decoder {decoder!r} is unknown, expected {' or '.join(DECODERS)}")
    return posterior_median(logits) if decoder == "median" else soft_argmax(logits)


def _cumulative(logits: Tensor) -> Tensor:
    return logits.float().softmax(1).cumsum(1)


def _at(cumulative: Tensor, position: Tensor) -> Tensor:
    """Cumulative probability at a position between the bins' edges, linear within a bin."""
    bins = cumulative.shape[1]
    place = position.clamp(0, bins).unsqueeze(1)
    index = place.nan_to_num().floor().clamp(max=bins - 1).long()
    upper = cumulative.gather(1, index)
    lower = torch.where(index > 0, cumulative.gather(1, (index - 1).clamp(min=0)), 0.0)
    return (lower + (place - index) * (upper - lower)).squeeze(1)
