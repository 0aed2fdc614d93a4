"""Transient -> expected detections per bin: the pulse integrated over bins against each return's path interval."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import AnyPulse
from spad.sensor.template import pulse_cdf, pulse_cdf_integral

# A return this much shorter than the pulse is a point: what it adds to the variance is under float64's sight.
POINT_RETURN_SIGMAS = 1e-3
WINDOW_SIGMAS = 7  # outside lies less than 1e-11 of a Gaussian pulse
LENGTH_STEP = 8
BLOCK_ENTRIES = 1 << 18


class Rates(NamedTuple):
    """Scale from radiance to expected signal detections; background detections per pixel and exposure (H, W) and why.

    dark_share is the share of the mean background that is dark counts; `reasons` belong into the plan. `alive` (H, W)
    is 0 in dead pixels, whose background is 0 too, and 1 elsewhere. `converter` (H, W) says which of a sensor's
    time-to-digital converters each pixel has, None where all bins are equal.
    """

    signal_scale: float
    background: np.ndarray
    dark_fraction: float
    reasons: tuple[str, ...]
    alive: np.ndarray
    converter: np.ndarray | None = None


def rates_for(
    transient: Transient,
    sensor: Sensor,
    budget: PhotonBudget,
    *,
    dark_map_hz: np.ndarray | None = None,
    seed: int = 0,
) -> Rates:
    """Scale a transient to a photon budget by means.

    Signal: all returns times one factor, so that their mean over the image is `budget.signal`. Background: dark counts
    are what the sensor says (or a measured map (H, W) in Hz, NaN in dead pixels), ambient light fills the mean up to
    `budget.background`; dark counts alone above it are scaled down to it, and the reason says so. Dead pixels lose
    their share afterwards: the others are not brighter for it. The seed places hot and dead pixels. Raises InputError
    when there is no light to scale, and for a map of another shape or below 0.
    """
    shape = (transient.height, transient.width)
    total = float(transient.radiance.sum(dtype=np.float64))
    if total <= 0 and budget.signal > 0:
        raise InputError(f"no light returns to the camera: {budget.signal:g} signal photons a pixel cannot be had")
    scale = budget.signal * transient.height * transient.width / total if total > 0 else 0.0
    dark_hz, dead = detector_maps(sensor, shape, dark_map_hz, seed)
    filled = fill_background(transient.ambient, dark_hz * sensor.exposure_s, budget.background)
    reasons = (filled.reason, *_odd_pixels(sensor, dead))
    background, alive = np.where(dead, 0.0, filled.background), np.where(dead, 0.0, 1.0)
    return Rates(scale, background, filled.dark_fraction, reasons, alive, sensor.converter_map(*shape, seed))


def detector_maps(
    sensor: Sensor, shape: tuple[int, int], dark_map_hz: np.ndarray | None, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return dark counts per second (H, W) and dead pixels (H, W) bool: a measured map's, or the sensor's."""
    if dark_map_hz is None:
        return sensor.dark_rate_map_hz(*shape, seed), sensor.dead_pixels(*shape, seed)
    return check_dark_map(dark_map_hz, shape)


def check_dark_map(measured_hz: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a measured map's dark counts per second (H, W), 0 in dead pixels, and which are dead (NaN).

    Raises InputError for another shape, and for rates that are negative or infinite.
    """
    measured = np.asarray(measured_hz, dtype=np.float64)
    if measured.shape != shape:
        raise InputError(f"dark count map is {measured.shape}, the image {shape}")
    dead = np.isnan(measured)
    measured = np.where(dead, 0.0, measured)
    if not (np.isfinite(measured).all() and measured.min(initial=0) >= 0):
        raise InputError("dark count map: rates must be finite and 0 or more, NaN for a dead pixel")
    return measured, dead


class Filled(NamedTuple):
    """Background detections of every pixel (H, W), how much of their mean is dark counts, and why."""

    background: np.ndarray
    dark_fraction: float
    reason: str


def fill_background(ambient: np.ndarray, dark: np.ndarray, asked: float) -> Filled:
    """Return dark counts (H, W) as they are and ambient light (H, W, any scale) up to the asked mean; uniform without
    any.

    Dark counts whose mean is above the asked one are scaled down to it, and their share is 1.
    """
    ambient, counted = ambient.astype(np.float64), float(dark.mean())
    if counted > asked:
        reason = f"background: {counted:g} dark counts a pixel exceed the asked {asked:g}, scaled down to it"
        _, dark_scale = background_scales(1.0, counted, asked)
        return Filled(dark * dark_scale, 1.0 if asked > 0 else 0.0, reason)
    fraction = counted / asked if asked > 0 else 0.0
    if counted > 0:
        reason = f"background: {fraction:.1%} dark counts ({counted:g} a pixel), the rest ambient light"
    elif ambient.sum() > 0:
        reason = "background: the scene's ambient light"
    else:
        reason = "background: uniform over the image, the scene has no ambient light"
    if ambient.sum() <= 0:
        ambient = np.ones_like(ambient)
    ambient_scale, _ = background_scales(float(ambient.mean()), counted, asked)
    return Filled(dark + ambient * ambient_scale, fraction, reason)


def background_scales(ambient_mean: float, dark_mean: float, asked: float) -> tuple[float, float]:
    """Return factors of ambient light and of dark counts, whose means are given, that bring their sum to the asked
    mean."""
    if dark_mean > asked:
        return 0.0, asked / dark_mean
    return (asked - dark_mean) / ambient_mean, 1.0


def _odd_pixels(sensor: Sensor, dead: np.ndarray) -> tuple[str, ...]:
    hot = (f"hot pixels: {sensor.hot_share:.2%} at {sensor.hot_rate_hz:g} Hz",) if sensor.hot_share else ()
    return (*hot, f"dead pixels: {int(dead.sum())} of {dead.size}") if dead.any() else hot


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
    count, period = pixels.stop - pixels.start, sensor.bins_per_period

    def column(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values[first:last].astype(np.float64)).to(device)

    near = column(transient.path_near_m) / SPEED_OF_LIGHT_M_PER_S
    length = column(transient.path_far_m) / SPEED_OF_LIGHT_M_PER_S - near
    energy = column(transient.radiance)
    sizes = np.diff(transient.offsets[pixels.start : pixels.stop + 1])
    owner = torch.from_numpy(np.repeat(np.arange(count), sizes)).to(device)
    width, (before, after) = sensor.bin_width_s, sensor.response.window_s(WINDOW_SIGMAS)
    start = torch.floor((near - before) / width).long()
    bins = torch.ceil((near + length + after) / width).long() - start
    edges = _edges_of(sensor, converter, device)
    if edges is not None:
        start, bins = start - edges.reach, bins + 2 * edges.reach
    # rows of equal length make a dense table; rounding lengths up only adds bins in which nothing arrives
    bins = (bins + LENGTH_STEP - 1) // LENGTH_STEP * LENGTH_STEP
    signal = torch.zeros(count * period, dtype=torch.float64, device=device)
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
            index = (owner[rows, None] * period + index.remainder_(period)).ravel()
            signal.scatter_add_(0, index, mass.ravel())
    return signal.reshape(count, period)[:, : sensor.bins], wrapped


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
