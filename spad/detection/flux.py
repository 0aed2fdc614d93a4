"""Transient -> expected detections per bin: the pulse integrated over bins against each return's path interval."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.rates import Rates
from spad.sensor.model import Sensor
from spad.sensor.pulse import AnyPulse
from spad.sensor.template import pulse_cdf, pulse_cdf_integral

# A return this much shorter than the pulse is a point: what it adds to the variance is under float64's sight.
POINT_RETURN_SIGMAS = 1e-3
WINDOW_SIGMAS = 7  # outside lies less than 1e-11 of a Gaussian pulse
LENGTH_STEP = 8
BLOCK_ENTRIES = 1 << 18


def interval_cdf(pulse: AnyPulse, after_near: Tensor, length: Tensor) -> Tensor:
    """Return share of a return that has arrived: its pulse averaged over arrivals in [0, length], `after_near` later
    [s].

    G(t) = (H(t) - H(t - length)) / length, H the integral of the pulse's CDF F; F(t - length / 2) for a point return.
    """
    point = length < POINT_RETURN_SIGMAS * pulse.std_s
    safe = torch.where(point, torch.ones_like(length), length)
    spread = (pulse_cdf_integral(pulse, after_near) - pulse_cdf_integral(pulse, after_near - length)) / safe
    return torch.where(point, pulse_cdf(pulse, after_near - length / 2), spread)


class _Edges(NamedTuple):
    """Edges of unequal bins on a device, for some pixels.

    edges      (converters, bins + 1) float64 in bins
    converter  (pixels,) int64
    """

    edges: Tensor
    converter: Tensor

    @property
    def reach(self) -> int:
        """Return how many bins, at most, an edge lies away from where it is meant to be, and one more."""
        meant = torch.arange(self.edges.shape[1], dtype=torch.float64, device=self.edges.device)
        return math.ceil(float((self.edges - meant).abs().max())) + 1

    def at(self, pixel: Tensor, number: Tensor) -> Tensor:
        """Return the place in bins of edges `number` (n, m), counted from the laser's emission, in pixels (n,)."""
        period = self.edges.shape[1] - 1
        turn = torch.div(number, period, rounding_mode="floor")
        return self.edges[self.converter[pixel, None], number - turn * period] + turn * period


def _edges_of(sensor: Sensor, converter: np.ndarray | None, device: str) -> _Edges | None:
    edges = sensor.code_edges
    if converter is None or edges is None:
        return None
    return _Edges(torch.tensor(edges, device=device), torch.from_numpy(converter).to(device))


def signal_per_bin(
    transient: Transient, sensor: Sensor, pixels: slice, device: str = "cpu", converter: np.ndarray | None = None
) -> tuple[Tensor, float]:
    """Return expected signal per unit scale in every bin of some pixels, (len, T) float64, and how much of it wrapped.

    `converter` (len,) are these pixels' rows of `sensor.code_edges`; without it all bins are equal.

    Each return's pulse is integrated over bins exactly and keeps its energy exactly. Time wraps at the period; what
    falls into the part of the period that has no bins is not detected. Wrapped is the radiance that arrived later than
    one period after the laser's emission.
    """
    first, last = int(transient.offsets[pixels.start]), int(transient.offsets[pixels.stop])

    def column(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values[first:last].astype(np.float64)).to(device)

    near = column(transient.path_near_m) / SPEED_OF_LIGHT_M_PER_S
    length = column(transient.path_far_m) / SPEED_OF_LIGHT_M_PER_S - near
    sizes = np.diff(transient.offsets[pixels.start : pixels.stop + 1])
    owner = torch.from_numpy(np.repeat(np.arange(len(sizes)), sizes)).to(device)
    arrivals = Arrivals(near, length, column(transient.radiance), owner)
    return arrivals_per_bin(arrivals, sensor, len(sizes), _edges_of(sensor, converter, device))


class Arrivals(NamedTuple):
    """Light that arrives evenly over intervals of time, (N,) tensors on one device.

    near_s     begin after the laser's emission [s], float64
    length_s   length [s], float64
    energy     light, float64
    owner      the pixel that it falls into, int64
    """

    near_s: Tensor
    length_s: Tensor
    energy: Tensor
    owner: Tensor


def arrivals_per_bin(
    arrivals: Arrivals, sensor: Sensor, count: int, edges: _Edges | None = None
) -> tuple[Tensor, float]:
    """Return the light of `count` pixels in every bin, (count, T) float64, and how much of it wrapped.

    Special functions are computed for those edges alone that lie within the pulse's reach of an arrival.
    """
    near, length, energy, owner = arrivals
    device, period = near.device, sensor.bins_per_period
    width, (before, after) = sensor.bin_width_s, sensor.response.window_s(WINDOW_SIGMAS)
    start = torch.floor((near - before) / width).long()
    bins = torch.ceil((near + length + after) / width).long() - start
    if edges is not None:
        start, bins = start - edges.reach, bins + 2 * edges.reach
    # rows of equal length make a dense table; rounding lengths up only adds bins in which nothing arrives
    bins = (bins + LENGTH_STEP - 1) // LENGTH_STEP * LENGTH_STEP
    recorded = sensor.bins  # the rest of a longer period needs no memory
    signal = torch.zeros(count * recorded, dtype=torch.float64, device=device)
    wrapped = 0.0
    for size in torch.unique(bins).tolist():
        for rows in torch.split(torch.nonzero(bins == size).squeeze(1), max(1, BLOCK_ENTRIES // size)):
            steps = torch.arange(size + 1, device=device)
            # in float64: torch would take integers times a number for float32
            if edges is None:
                time = (start[rows].double() * width - near[rows])[:, None] + steps.double() * width
            else:
                time = edges.at(owner[rows], start[rows, None] + steps) * width - near[rows, None]
            arrived = interval_cdf(sensor.response, time, length[rows, None])
            # all of a return's energy lies between its first and last edge, whatever the pulse's tails
            arrived[:, 0], arrived[:, -1] = 0, 1
            mass = arrived.diff(dim=1).clamp_(min=0) * energy[rows, None]
            index = start[rows, None] + steps[:-1]
            wrapped += float((mass * (index >= period)).sum())
            index = index.remainder_(period)
            place = owner[rows, None] * recorded + index
            if recorded < period:
                place, mass = place[index < recorded], mass[index < recorded]
            signal.scatter_add_(0, place.ravel(), mass.ravel())
    return signal.reshape(count, recorded), wrapped


def recorded_fraction(near_s: Tensor, length_s: Tensor, sensor: Sensor) -> Tensor:
    """Return the share of each return's light that arrives within the sensor's bins, (N,) float64.

    near_s, length_s   begin of its arrival after the laser's emission, and length, (N,) float64 [s]

    The sum of `signal_per_bin` over equal bins, from the record's two ends in each period alone.
    """
    record, period = (bins * sensor.bin_width_s for bins in (sensor.bins, sensor.bins_per_period))
    before, after = sensor.response.window_s(WINDOW_SIGMAS)
    first, last = torch.floor((near_s - before) / period), torch.floor((near_s + length_s + after) / period)
    fraction = torch.zeros_like(near_s)
    for turn in range(int(first.min()), int(last.max()) + 1) if len(near_s) else ():
        rows = torch.nonzero((first <= turn) & (turn <= last)).squeeze(1)
        begin, length = turn * period - near_s[rows], length_s[rows]
        by_end = interval_cdf(sensor.response, begin + record, length)
        fraction[rows] += (by_end - interval_cdf(sensor.response, begin, length)).clamp(min=0)
    return fraction


def expected_counts(
    transient: Transient, sensor: Sensor, rates: Rates, pixels: slice, device: str = "cpu"
) -> tuple[Tensor, float]:
    """Return expected detections per bin of some pixels, (len, T) float64, and how many of their signal detections
    wrapped.

    lambda_i = scale x signal_i + background x the bin's share of the period.
    """
    converter = None if rates.converter is None else rates.converter.reshape(-1)[pixels]
    signal, wrapped = signal_per_bin(transient, sensor, pixels, device, converter)
    flat = torch.from_numpy(rates.background.reshape(-1)[pixels]).to(device)
    alive = torch.from_numpy(rates.alive.reshape(-1)[pixels]).to(device)
    detected = signal * (rates.signal_scale * alive)[:, None]
    steady = (flat / sensor.bins_per_period)[:, None]
    edges = _edges_of(sensor, converter, device)
    if edges is not None:
        steady = steady * edges.edges.diff(dim=1)[edges.converter]
    return detected + steady, wrapped * rates.signal_scale
