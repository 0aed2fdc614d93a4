"""Transient -> expected detections per bin: the pulse integrated over bins against each return's path interval."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from spad.sensor import PhotonBudget, Pulse, Sensor
from spad.template import pulse_cdf, pulse_cdf_integral

# A return this much shorter than the pulse is a point: what it adds to the variance is under float64's sight.
POINT_RETURN_SIGMAS = 1e-3
LENGTH_STEP = 8
BLOCK_ENTRIES = 1 << 18


class Rates(NamedTuple):
    """Scale from radiance to expected signal detections; background detections per pixel and exposure (H, W) and why.

    dark_share is the share of the mean background that is dark counts; `reasons` belong into the plan.
    """

    signal_scale: float
    background: np.ndarray
    dark_share: float
    reasons: tuple[str, ...]


def rates_for(transient: Transient, sensor: Sensor, budget: PhotonBudget) -> Rates:
    """Scale a transient to a photon budget by means.

    Signal: all returns times one factor, so that their mean over the image is `budget.signal`. Background: dark counts
    are what the sensor says, ambient light fills the mean up to `budget.background`; dark counts alone above it are
    scaled down to it, and the reason says so. Raises InputError when there is no light to scale.
    """
    pixels = transient.height * transient.width
    total = float(transient.radiance.sum(dtype=np.float64))
    if total <= 0 and budget.signal > 0:
        raise InputError(f"no light returns to the camera: {budget.signal:g} signal photons a pixel cannot be had")
    scale = budget.signal * pixels / total if total > 0 else 0.0
    counted = sensor.dark_count_rate_hz * sensor.exposure_s
    dark = min(counted, budget.background)
    ambient = transient.ambient.astype(np.float64)
    share = dark / budget.background if budget.background > 0 else 0.0
    if counted > budget.background:
        reason = (
            f"background: {counted:g} dark counts a pixel exceed the asked {budget.background:g}, scaled down to it"
        )
    elif dark > 0:
        reason = f"background: {share:.1%} dark counts ({sensor.dark_count_rate_hz:g} Hz), the rest ambient light"
    elif ambient.sum() > 0:
        reason = "background: the scene's ambient light"
    else:
        reason = "background: uniform over the image, the scene has no ambient light"
    if ambient.sum() <= 0:
        ambient = np.ones_like(ambient)
    background = dark + ambient * ((budget.background - dark) / ambient.mean())
    return Rates(scale, background, share, (reason,))


def interval_cdf(pulse: Pulse, after_near: Tensor, length: Tensor) -> Tensor:
    """Share of a return that has arrived: its pulse averaged over arrivals in [0, length], `after_near` later [s].

    G(t) = (H(t) - H(t - length)) / length, H the integral of the pulse's CDF F; F(t - length / 2) for a point return.
    """
    point = length < POINT_RETURN_SIGMAS * pulse.sigma_s
    safe = torch.where(point, torch.ones_like(length), length)
    spread = (pulse_cdf_integral(pulse, after_near) - pulse_cdf_integral(pulse, after_near - length)) / safe
    return torch.where(point, pulse_cdf(pulse, after_near - length / 2), spread)


def signal_per_bin(transient: Transient, sensor: Sensor, pixels: slice, device: str = "cpu") -> tuple[Tensor, float]:
    """Expected signal per unit scale in every bin of some pixels, (len, T) float64, and how much of it wrapped.

    Each return's pulse is integrated over bins exactly and keeps its energy exactly. Time wraps at the period; what
    falls into the part of the period that has no bins is not detected. Wrapped is the radiance that arrived later than
    one period after the laser's emission.
    """
    first, last = int(transient.offsets[pixels.start]), int(transient.offsets[pixels.stop])
    count, period = pixels.stop - pixels.start, sensor.bins_per_period

    def column(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values[first:last].astype(np.float64)).to(device)

    near = column(transient.path_near_m) / SPEED_OF_LIGHT_M_PER_S
    length = column(transient.path_far_m) / SPEED_OF_LIGHT_M_PER_S - near
    energy = column(transient.radiance)
    sizes = np.diff(transient.offsets[pixels.start : pixels.stop + 1])
    owner = torch.from_numpy(np.repeat(np.arange(count), sizes)).to(device)
    width, reach = sensor.bin_width_s, sensor.pulse.reach_s
    start = torch.floor((near - reach) / width).long()
    bins = torch.ceil((near + length + reach) / width).long() - start
    # rows of equal length make a dense table; rounding lengths up only adds bins in which nothing arrives
    bins = (bins + LENGTH_STEP - 1) // LENGTH_STEP * LENGTH_STEP
    signal = torch.zeros(count * period, dtype=torch.float64, device=device)
    wrapped = 0.0
    for size in torch.unique(bins).tolist():
        for rows in torch.nonzero(bins == size).squeeze(1).split(max(1, BLOCK_ENTRIES // size)):
            steps = torch.arange(size + 1, device=device)
            # in float64: torch would take integers times a number for float32
            time = (start[rows].double() * width - near[rows])[:, None] + steps.double() * width
            arrived = interval_cdf(sensor.pulse, time, length[rows, None])
            # all of a return's energy lies between its first and last edge, whatever the pulse's tails
            arrived[:, 0], arrived[:, -1] = 0, 1
            mass = arrived.diff(dim=1).clamp_(min=0) * energy[rows, None]
            index = start[rows, None] + steps[:-1]
            wrapped += float((mass * (index >= period)).sum())
            index = (owner[rows, None] * period + index.remainder_(period)).ravel()
            signal.scatter_add_(0, index, mass.ravel())
    return signal.reshape(count, period)[:, : sensor.bins], wrapped


def expected_counts(
    transient: Transient, sensor: Sensor, rates: Rates, pixels: slice, device: str = "cpu"
) -> tuple[Tensor, float]:
    """Expected detections per bin of some pixels, (len, T) float64, and how many of their signal detections wrapped.

    lambda_i = scale x signal_i + background / bins per period.
    """
    signal, wrapped = signal_per_bin(transient, sensor, pixels, device)
    flat = torch.from_numpy(rates.background.reshape(-1)[pixels]).to(device)
    return signal * rates.signal_scale + (flat / sensor.bins_per_period)[:, None], wrapped * rates.signal_scale
