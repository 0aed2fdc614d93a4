"""Compute the training loss: KL divergence to the sensor's pulse centred on the depth label, and total variation."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from csph.autograd import Context
from csph.networks.published import soft_argmax
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.sensor.model import Sensor
from spad.sensor.pulse import REACH_SIGMAS
from spad.sensor.template import wrapped_mass


class Target(NamedTuple):
    """The pulse of each label on the L bins that it reaches: bins (..., L) int64, share (..., L) float32, unit sums."""

    bins: Tensor
    mass: Tensor


def pulse_target(depth_m: Tensor, sensor: Sensor) -> Target:
    """Return h_i(tau) of arrivals tau = 2 depth / c, wrapped at the period; what falls outside the sensor's bins is
    left out, and the rest scaled to a unit sum. Depths (...,) must be finite."""
    position = depth_m.double() * (2 / (SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s))
    first = position.floor()
    before, after = sensor.response.window_s(REACH_SIGMAS)
    low = -math.ceil(abs(before) / sensor.bin_width_s) - 1
    high = math.ceil(abs(after) / sensor.bin_width_s) + 1
    count = high - low + 1
    if count > sensor.bins_per_period:  # a longer pulse has gone round
        low, count = -(sensor.bins_per_period // 2), sensor.bins_per_period
    steps = torch.arange(low, low + count, dtype=torch.float64, device=depth_m.device)
    centre = (steps + 0.5 - (position - first).unsqueeze(-1)) * sensor.bin_width_s
    bins = (first.unsqueeze(-1) + steps).remainder(sensor.bins_per_period).long()
    mass = wrapped_mass(centre, sensor) * (bins < sensor.bins)
    mass = mass / mass.sum(-1, keepdim=True).clamp(min=1e-30)
    return Target(bins.clamp(max=sensor.bins - 1), mass.float())


def kl_divergence(logits: Tensor, depth_m: Tensor, valid: Tensor, sensor: Sensor) -> Tensor:
    """Return mean over the valid pixels of KL(h || p) = sum_i h_i log(h_i / p_i), p the softmax over time (supplement
    S.5.2).

    logits (B, T, R, C) of any float type, depth_m and valid (B, R, C). h sums to one, so that the sum is
    logsumexp(logits) - sum_i h_i logits_i + sum_i h_i log h_i, and only the bins that the pulse reaches are touched.
    Zero where no pixel is valid. (The published code divides by the number of bins as well.)
    """
    target = pulse_target(torch.where(valid, depth_m, 0.0), sensor)
    bins, mass = (part.movedim(-1, 1) for part in target)
    entropy = torch.special.entr(target.mass).sum(-1)
    per_pixel = torch.where(valid, _CrossEntropy.apply(logits, bins, mass) - entropy, 0.0)
    return per_pixel.sum() / valid.sum().clamp(min=1)


class _CrossEntropy(torch.autograd.Function):
    """logsumexp(z) - sum_l share_l z[bins_l] over axis 1, in float32 at least; its derivative is softmax(z) - share.

    The exponentials that the first needs are kept for the second: a third of the passes over all bins.
    """

    @staticmethod
    def forward(ctx: Context, logits: Tensor, bins: Tensor, mass: Tensor) -> Tensor:
        ctx.kind = logits.dtype
        logits = logits.to(torch.promote_types(logits.dtype, mass.dtype))
        inside = (mass * logits.gather(1, bins)).sum(1)
        top = logits.amax(1, keepdim=True)
        exponential = (logits - top).exp_()
        total = exponential.sum(1, keepdim=True)
        ctx.save_for_backward(exponential, total, bins, mass)
        return (total.log() + top).squeeze(1) - inside

    @staticmethod
    @once_differentiable
    def backward(ctx: Context, grad: Tensor) -> tuple[Tensor, None, None]:
        exponential, total, bins, mass = ctx.saved_tensors
        grad = grad.unsqueeze(1)
        slope = exponential * (grad / total)
        return slope.scatter_add_(1, bins, mass * -grad).to(ctx.kind), None, None


def decoded_error(logits: Tensor, position: Tensor, valid: Tensor) -> Tensor:
    """Return the mean over the valid pixels of |soft-argmax(logits) - position|, in bins.

    logits (B, T, R, C), position (B, R, C) in bins from the edge of bin 0, valid (B, R, C). Its slope at bin i is
    p_i (i - mean) times a sign: mass far from the answer is moved, mass near it stays with the divergence. Zero where
    no pixel is valid.
    """
    error = torch.where(valid, soft_argmax(logits) - position, 0.0)
    return error.abs().sum() / valid.sum().clamp(min=1)


def total_variation(values: Tensor) -> Tensor:
    """Return (sum |v(r + 1, c) - v(r, c)| + sum |v(r, c + 1) - v(r, c)|) / pixels, of (B, R, C).

    A mean, so that its weight does not depend on batch and crop.
    """
    down, right = values.diff(dim=1).abs().sum(), values.diff(dim=2).abs().sum()
    return (down + right) / values.numel()
