"""Photon budget -> rates: the scale of the signal, and each pixel's background with its dark counts. Needs no torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.transient import Transient
from scenes.errors import InputError
from spad.sensor.model import PhotonBudget, Sensor, detector_maps


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
    are what the sensor says (or a measured map (H, W) in Hz, NaN in pixels that are dead besides the sensor's), ambient
    light fills the mean up to `budget.background`; dark counts alone above it are scaled down to it, and the reason
    warns of it. Dead pixels lose their share afterwards: the others are not brighter for it. The seed places hot and
    dead pixels. Raises InputError when there is no light to scale, and for a map of another shape or below 0.
    """
    shape = (transient.height, transient.width)
    total = float(transient.radiance.sum(dtype=np.float64))
    if total <= 0 and budget.signal > 0:
        raise InputError(f"no light returns to the camera: {budget.signal:g} signal photons a pixel cannot be had")
    scale = budget.signal * transient.height * transient.width / total if total > 0 else 0.0
    dark_hz, dead = detector_maps(sensor, shape, dark_map_hz, seed)
    filled = fill_background(transient.ambient, dark_hz * sensor.exposure_s, budget.background)
    reasons = (filled.reason, *_odd_pixels(sensor, dead, measured=dark_map_hz is not None))
    background, alive = np.where(dead, 0.0, filled.background), np.where(dead, 0.0, 1.0)
    return Rates(scale, background, filled.dark_fraction, reasons, alive, sensor.converter_map(*shape, seed))


def default_background(
    transient: Transient, sensor: Sensor, *, dark_map_hz: np.ndarray | None = None, seed: int = 0
) -> float:
    """Return the mean background where none is asked for: 50 detections a pixel, or the dark counts if they are more.

    So dark counts are always those of the sensor, and ambient light fills what they leave of 50.
    """
    dark_hz, _ = detector_maps(sensor, (transient.height, transient.width), dark_map_hz, seed)
    return max(PhotonBudget().background, float((dark_hz * sensor.exposure_s).mean()))


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
    # a radiometric budget of dark counts alone is their mean but for rounding
    if counted > asked * (1 + 1e-9):
        reason = f"warning: background: {counted:g} dark counts a pixel exceed the asked {asked:g}, scaled down to it"
        _, dark_scale = background_scales(1.0, counted, asked)
        return Filled(dark * dark_scale, 1.0 if asked > 0 else 0.0, reason)
    fraction = min(1.0, counted / asked) if asked > 0 else 0.0
    if counted > 0:
        rest = "ambient light" if ambient.sum() > 0 else "uniform over the image, the scene has no ambient light"
        reason = f"background: {fraction:.1%} dark counts ({counted:g} a pixel), the rest {rest}"
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


def _odd_pixels(sensor: Sensor, dead: np.ndarray, measured: bool) -> tuple[str, ...]:
    """Return the plan's lines on hot and dead pixels; a measured map of dark counts holds its own hot pixels."""
    drawn = sensor.hot_share and not measured
    hot = (f"hot pixels: {sensor.hot_share:.2%} at {sensor.hot_rate_hz:g} Hz",) if drawn else ()
    if sensor.hot_rate_hz > 0 and not sensor.hot_share and not measured:
        hot = (f"hot pixels: none, their rate of {sensor.hot_rate_hz:g} Hz needs a hot_fraction (--hot-pixels)",)
    return (*hot, f"dead pixels: {int(dead.sum())} of {dead.size}") if dead.any() else hot
