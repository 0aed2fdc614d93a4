"""A multi-zone sensor's exposure as a `Histogram`: zones are its pixels, in rows and columns as they look."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import require
from scenes.progress import Progress
from spad.detection.saturation import saturated
from spad.measurements.histogram import Histogram
from spad.sensor.arrival import wrap_line
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.simulation import ZoneReturns, draw_flux, zone_returns, zone_signal

PULSE_ENDS = 1e-11  # share of a pulse beyond its reach: as much of the light in the record is none of it


def zone_grid(zones: ZoneArray) -> tuple[int, int, np.ndarray]:
    """Return rows, columns, and the zone at each place from top left; one row where the centres form no grid."""
    x, y = np.asarray(zones.centre_x).round(9), np.asarray(zones.centre_y).round(9)
    rows, columns = len(np.unique(y)), len(np.unique(x))
    if rows * columns != zones.count:
        return 1, zones.count, np.arange(zones.count)
    return rows, columns, np.lexsort((x, y))


def with_budget(
    zones: ZoneArray,
    transient: Transient,
    sensor: Sensor,
    budget: PhotonBudget,
    *,
    progress: Progress | None = None,
) -> ZoneArray:
    """Scale gains and set backgrounds so that their means over the zones are the budget's, before saturation.

    Raises InputError where no light reaches a zone.
    """
    returns = zone_returns(transient, zones)
    signal = zone_signal(returns, sensor, zones, progress=progress).sum(axis=1).mean()
    every = np.mean([gain * seen.light.sum() for gain, seen in zip(zones.gain, returns, strict=True)])
    signal = signal if signal > PULSE_ENDS * every else 0.0
    record = f"the {sensor.bins * sensor.bin_width_s * 1e9:.4g} ns that {sensor.name} records"
    message = f"no light reaches a zone within {record}: {budget.signal:g} photons cannot be had"
    require(signal > 0 or budget.signal == 0, message)
    scale = budget.signal / signal if signal > 0 else 0.0
    background = (budget.background / sensor.bins,) * zones.count
    return replace(zones, gain=tuple(gain * scale for gain in zones.gain), background=background)


def sense_zones(
    transient: Transient, sensor: Sensor, zones: ZoneArray, *, seed: int = 0, progress: Progress | None = None
) -> Histogram:
    """Record one exposure of a multi-zone sensor: counts (rows, columns, T) of its zones.

    Depth, albedo and `mixed` are the transient's at each zone's centre. Raises InputError as `zone_returns` does, and
    for a zone whose centre is outside the image.
    """
    rows, columns, order = zone_grid(zones)
    returns = zone_returns(transient, zones)
    binned = zone_signal(returns, sensor, zones, progress=progress)  # once: it takes nearly all of the time
    flux = binned + np.asarray(zones.background)[:, None]
    counts = draw_flux(flux, zones, seed)
    signal, background = binned.sum(axis=1), np.asarray(zones.background) * sensor.bins
    primary = signal + background
    lost = 1 - saturated(flux, *zones.saturation).sum() / max(1e-30, float(primary.sum()))
    reasons = [f"zones: {zones.count} fields of view", *_beside_image(transient, zones)]
    if lost > 1e-9:  # beyond rounding
        reasons[0] += f", {lost:.1%} of the detections lost to saturation"
    wrapped = _wrapped(returns, sensor, zones)
    if wrapped > 0:
        reasons.append(wrap_line(wrapped, sensor, "light"))
    pixel = _centre_pixels(transient, zones)

    def laid(values: np.ndarray, kind: type) -> np.ndarray:
        return values[order].reshape(rows, columns, *values.shape[1:]).astype(kind)

    brightest = float(signal.max() / signal.sum()) if signal.any() else 0.0
    return Histogram(
        laid(counts, np.int32),
        sensor,
        PhotonBudget(float(signal.mean()), float(background.mean())),
        depth_m=laid(transient.depth_m[pixel], np.float32),
        mixed=laid(transient.mixed[pixel], np.bool_),
        albedo=laid(transient.albedo[pixel], np.float16),
        expected_signal=laid(signal, np.float32),
        expected_background=laid(background, np.float32),
        meta={
            "seed": int(seed),
            "model": "zones",
            "plan": reasons,
            "pile_up": float((primary / np.asarray(zones.trials)).max()),
            "wrapped": wrapped,
            "dark_share": None,  # a zone's background is not told apart
            "brightest_pixel": brightest,
            "brightest_thousandth": brightest,
            "median_signal": float(np.median(signal)),
            "transient": {**transient.meta, "sha256": transient.sha256()},
            # as the zones are laid out: what tells depth from a recorded time (`spad.estimators.bistatic`)
            "zones": {
                name: laid(np.asarray(getattr(zones, name)), float).tolist()
                for name in ("centre_x", "centre_y", "delay_s", "clock")
            }
            | {"chirp_hz": zones.chirp_hz},
        },
    )


def _wrapped(returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray) -> float:
    """Return the share of the light that arrives later than one period after the laser's emission; echoes and the
    module's own reflection are not counted."""
    period_m = SPEED_OF_LIGHT_M_PER_S * sensor.period_s
    light = np.array([(seen.light.sum(), seen.light @ seen.fraction_behind(period_m)) for seen in returns])
    every, late = np.asarray(zones.gain) @ light
    return float(late / every) if every > 0 else 0.0


def _beside_image(transient: Transient, zones: ZoneArray) -> list[str]:
    """Warn of zones that look partly beside the image: their light is what the image shows of them."""
    half_x = math.tan(math.radians(transient.meta["camera"]["fov_deg"]) / 2)
    seen = np.ones(zones.count)
    for centre, width, half in (
        (zones.centre_x, zones.width, half_x),
        (zones.centre_y, zones.height, half_x * transient.height / transient.width),
    ):
        low, high = (np.asarray(centre) + sign * np.asarray(width) / 2 for sign in (-1, 1))
        seen *= (np.minimum(high, half) - np.maximum(low, -half)).clip(0) / np.asarray(width)
    cut = int((seen < 1 - 1e-6).sum())
    if not cut:
        return []
    unseen = f"by up to {100 * (1 - seen.min()):.0f} % of their field of view"
    return [f"warning: zones: {cut} of {zones.count} look partly beside the image, {unseen}: render wider"]


def _centre_pixels(transient: Transient, zones: ZoneArray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that each zone's centre falls into."""
    height, width = transient.height, transient.width
    focal = 0.5 * width / math.tan(math.radians(transient.meta["camera"]["fov_deg"]) / 2)
    row = np.floor(np.asarray(zones.centre_y) * focal + height / 2).astype(int)
    column = np.floor(np.asarray(zones.centre_x) * focal + width / 2).astype(int)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    require(bool(inside.all()), f"{int((~inside).sum())} of {zones.count} zones look beside the image: render wider")
    return row, column
