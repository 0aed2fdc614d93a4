"""Simulate a multi-zone sensor (`spad.sensor.zone_array`): each zone's returns, expected counts, and draws."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import require
from scenes.progress import Progress
from scenes.random_streams import Stream
from spad.detection.saturation import draw_saturated, saturated
from spad.sensor.clock import chirped
from spad.sensor.model import Sensor
from spad.sensor.zone_array import ZoneArray, check_times
from spad.sensor.zone_limits import MAX_COUNTS


class ZoneReturns(NamedTuple):
    """Light that reaches one zone: path intervals [m] and light [1 / (m^2 J)], (N,) float64 each."""

    near_m: np.ndarray
    far_m: np.ndarray
    light: np.ndarray

    def fraction_behind(self, path_m: float) -> np.ndarray:
        """Return which fraction of each path interval, evenly lit, lies behind a path."""
        near, far, _ = self
        behind = np.where(near >= path_m, 1.0, 0.0)  # intervals without length
        return np.divide(far - np.maximum(near, path_m), far - near, out=behind, where=far > near).clip(0, 1)


def zone_returns(transient: Transient, zones: ZoneArray) -> list[ZoneReturns]:
    """Gather the returns that each zone sees: radiance x share of the pixel in the zone x cos^4 of its direction.

    The emitter's intensity is taken at the first surface of each pixel, exact for direct light. Raises InputError for a
    transient without a camera in its `meta`, or whose laser is not where the zones' emitter is.
    """
    _check_laser(transient, zones)
    x, y, depth = _pixel_tangents(transient)
    # a single column of pixels is as wide as the field of view
    pitch = x[0, 1] - x[0, 0] if x.shape[1] > 1 else 2 * _half_view(transient)
    flat = np.where(np.isfinite(depth), depth, 1e9)
    light = _intensity(zones, x, y, flat) / (1 + x * x + y * y) ** 2
    blur = zones.aperture_m / flat
    owner = transient.return_pixel
    near, far = (path.astype(np.float64) for path in (transient.path_near_m, transient.path_far_m))
    found = []
    for zone in range(zones.count):
        across = _overlap(x - zones.centre_x[zone], zones.width[zone], pitch, blur)
        along = _overlap(y - zones.centre_y[zone], zones.height[zone], pitch, blur)
        energy = (across * along * light).ravel()[owner] * transient.radiance
        seen = energy > 0
        found.append(ZoneReturns(near[seen], far[seen], energy[seen]))
    return found


def _check_laser(transient: Transient, zones: ZoneArray) -> None:
    laser = transient.meta.get("laser", {})
    require("camera" in transient.meta, "zones need a transient that states its camera: render it")
    rendered = np.asarray(laser.get("baseline_m", (0.0, 0.0, 0.0)))
    there = bool(np.allclose(rendered, zones.baseline_m, atol=1e-9))
    stated, asked = ((" ".join(f"{1e3 * v:g}" for v in b)) for b in (rendered, zones.baseline_m))
    require(there, f"rendered with an emitter at {stated} mm, the zones' is at {asked} mm: render --baseline")


def _pixel_tangents(transient: Transient) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangents x, y (H, W) of the pixels' centres, and their depth along the axis [m], NaN where nothing is."""
    height, width = transient.height, transient.width
    focal = 0.5 * width / _half_view(transient)
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    return x, y, transient.depth_m.astype(np.float64) / np.sqrt(1 + x * x + y * y)


def _half_view(transient: Transient) -> float:
    """Return the tangent of half the camera's horizontal field of view."""
    return math.tan(math.radians(transient.meta["camera"]["fov_deg"]) / 2)


def _intensity(zones: ZoneArray, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the emitter's relative intensity towards the points that pixels see."""
    right, down, forward = zones.baseline_m
    away = np.maximum(depth - forward, 1e-6)
    u = (x * depth - right) / away - zones.illumination_x
    v = (y * depth - down) / away - zones.illumination_y
    return np.exp(-(zones.curvature_x * u * u + zones.curvature_y * v * v) / 2)


def _overlap(offset: np.ndarray, width: float, pitch: float, blur: np.ndarray) -> np.ndarray:
    """Length of pixels of `pitch` at `offset` from a zone's centre that lies in it, its edges blurred by a box."""

    def inside(at: np.ndarray) -> np.ndarray:
        return _ramp(at + width / 2, blur) - _ramp(at - width / 2, blur)

    return inside(offset + pitch / 2) - inside(offset - pitch / 2)


def _ramp(at: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Integral of a step at 0 that is blurred by a box of width `blur`."""
    half = np.maximum(blur, 1e-12) / 2
    return np.where(np.abs(at) < half, (at + half) ** 2 / (4 * half), np.maximum(at, 0.0))


def since_emission(returns: ZoneReturns, period_m: float) -> ZoneReturns:
    """Return light by its path since the last emission, `period_m` the path in one period of the laser.

    A converter starts anew at each emission: its clock and its chirp act on the time since the last one. An interval
    that holds an emission is cut there, its light in proportion to the lengths.
    """
    near_m, far_m, light = returns
    first = np.floor(near_m / period_m)
    periods = np.maximum(np.ceil(far_m / period_m) - first, 1).astype(np.int64)
    near, far, before = (np.repeat(value, periods) for value in (near_m, far_m, first))
    before += np.arange(len(before)) - np.repeat(np.cumsum(periods) - periods, periods)
    start = np.maximum(near - before * period_m, 0.0)
    end = np.maximum(np.minimum(far - before * period_m, period_m), start)
    fraction = np.divide(end - start, far - near, out=np.ones_like(far), where=far > near)
    return ZoneReturns(start, end, np.repeat(light, periods) * fraction)


def with_skew(returns: ZoneReturns, skew_m: float) -> ZoneReturns:
    """Split returns into halves, half of `skew_m` [m of path] before and behind."""
    if not skew_m:
        return returns
    near_m, far_m, light = returns
    half = skew_m / 2
    return ZoneReturns(
        np.concatenate((near_m - half, near_m + half)),
        np.concatenate((far_m - half, far_m + half)),
        np.tile(light / 2, 2),
    )


def stray_returns(returns: ZoneReturns, leak: float, echo_m2: float) -> ZoneReturns:
    """Return the module's own reflection, at a path of 0, and the echo at twice the paths, as one interval each.

    The reflection is there also where a zone sees nothing, and so has no echo.
    """
    near_m, far_m, light = returns
    if not (leak or echo_m2):
        return ZoneReturns(*np.zeros((3, 0)))
    if not len(light):
        return ZoneReturns(np.zeros(1), np.zeros(1), np.array([float(leak)]))
    echo = echo_m2 * float((light / ((near_m + far_m) / 4) ** 2).sum())
    near, far = 2 * near_m.min(), 2 * far_m.max()
    return ZoneReturns(np.array([0.0, near]), np.array([0.0, far]), np.array([leak, echo]))


def zone_signal(
    returns: list[ZoneReturns],
    sensor: Sensor,
    zones: ZoneArray,
    drift_s: float = 0.0,
    *,
    progress: Progress | None = None,
) -> np.ndarray:
    """Return expected primary signal detections (Z, T) float64: pulses integrated over each zone's own bins, crosstalk
    added.

    Time wraps at the laser's period; what arrives in a part of it without bins is not counted. `drift_s` delays all
    zones, as a laser that warms up does.
    """
    check_times(sensor, zones)
    period_m = SPEED_OF_LIGHT_M_PER_S * sensor.period_s
    own = np.zeros((zones.count, sensor.bins))
    for zone, seen in enumerate(returns):
        if progress is not None:
            progress("zones", zone / zones.count)
        scale = 1 / (SPEED_OF_LIGHT_M_PER_S * zones.clock[zone])
        every = zip(seen, stray_returns(seen, zones.leak[zone], zones.echo_m2[zone]), strict=True)
        all_light = since_emission(ZoneReturns(*(np.concatenate(pair) for pair in every)), period_m)
        near_m, far_m, light = with_skew(all_light, zones.skew_s[zone] / scale)
        near_s, far_s = (chirped(path * scale, zones.chirp_hz) for path in (near_m, far_m))
        late = zones.delay_s[zone] + drift_s
        own[zone] = _binned(ZoneReturns(near_s + late, far_s + late, light), sensor) * zones.gain[zone]
    own = np.maximum(own, 0.0)
    return own + zones.crosstalk * own.sum(axis=0)


def _binned(measured: ZoneReturns, sensor: Sensor) -> np.ndarray:
    """Integrate pulses of light at measured times, intervals [s], over the bins, folded at the period, (T,) float64.

    Delays and the pulse's width carry light beyond the period's ends, into the bins of the cycles beside it.
    """
    import torch  # takes a second, and sensors of pixels need none of it

    from spad.detection.flux import Arrivals, arrivals_per_bin

    start_s, end_s, light = (torch.from_numpy(value) for value in measured)
    one = torch.zeros(len(light), dtype=torch.int64)
    return arrivals_per_bin(Arrivals(start_s, end_s - start_s, light, one), sensor, 1)[0][0].numpy()


def zone_flux(returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, drift_s: float = 0.0) -> np.ndarray:
    """Return expected primary detections (Z, T) float64: signal and background."""
    return zone_signal(returns, sensor, zones, drift_s) + np.asarray(zones.background)[:, None]


def expected_zone_counts(
    returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, drift_s: float = 0.0
) -> np.ndarray:
    """Return expected counts (Z, T) float64 of one exposure, after saturation."""
    return saturated(zone_flux(returns, sensor, zones, drift_s), *zones.saturation)


def draw_zone_counts(
    returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, *, seed: int = 0, drift_s: float = 0.0
) -> np.ndarray:
    """Draw counts (Z, T) int64 of one exposure; the same seed gives the same counts.

    Raises InputError for a zone of more than 2^31 - 1 counts, expected or drawn.
    """
    return draw_flux(zone_flux(returns, sensor, zones, drift_s), zones, seed)


def draw_flux(flux: np.ndarray, zones: ZoneArray, seed: int) -> np.ndarray:
    """Draw counts (Z, T) int64 of one exposure from expected primary detections (Z, T), as `draw_zone_counts` does."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.ZONES, 0, 0)))
    trials, recovery, compression = zones.saturation
    _check_counts(saturated(flux, trials, recovery), "expected counts")
    counts = draw_saturated(flux, trials, recovery, rng, compression)
    _check_counts(counts, "counts")
    return counts


def _check_counts(counts: np.ndarray, what: str) -> None:
    total = counts.sum(axis=1)
    worst = int(total.argmax())
    message = f"zones: zone {worst} (of 0 to {len(total) - 1}) has {float(total[worst]):.4g} {what} in one exposure"
    require(bool(total[worst] <= MAX_COUNTS), f"{message}, the limit is {MAX_COUNTS}: lower its gain or its background")
