"""From depth to recorded time and back: bistatic geometry of a displaced laser, and converters with delays.

With d the distance from the camera, r the unit ray and b the laser's place relative to the camera, light travels
p = |d r - b| + d. Points of one path lie on an ellipsoid whose foci are the laser and the camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from scenes.json_types import JsonObject
from scenes.model import Camera
from spad.measurements.histogram import Histogram
from spad.sensor.clock import chirped, unchirped
from spad.sensor.model import Sensor

CO_LOCATED = (0.0, 0.0, 0.0)
ROUNDING = 1e-6  # of a period: what float32 depths and sums of times leave


def radial_depth_m(half_path_m: np.ndarray, directions: np.ndarray, baseline_m: Iterable[float]) -> np.ndarray:
    """Return distance from the camera, given half the optical path from a displaced laser to the surface to the camera
    [m].

    With p the path, b the laser's place relative to the camera and r the unit ray: the ellipsoid
    d = (p^2 - |b|^2) / (2 (p - r.b)). half_path_m (...,), directions (..., 3) and b in one frame -> (...,) float32.
    NaN for a path that is not longer than the baseline: no surface gives one.
    """
    path, baseline = 2.0 * np.asarray(half_path_m, dtype=np.float64), np.asarray(tuple(baseline_m), dtype=np.float64)
    squared = baseline @ baseline
    path = np.where(path > math.sqrt(squared), path, np.nan)
    distance = (path**2 - squared) / (2 * (path - directions @ baseline))
    return distance.astype(np.float32)


def optical_path_m(depth_m: np.ndarray, directions: np.ndarray, baseline_m: Iterable[float]) -> np.ndarray:
    """Return the path from a displaced laser to the surface to the camera [m]: `radial_depth_m` the other way round.

    depth_m (...,) is the distance from the camera, directions (..., 3) and the baseline in one frame -> (...,) float64.
    """
    depth = np.asarray(depth_m, dtype=np.float64)
    return depth + np.linalg.norm(depth[..., None] * directions - np.asarray(tuple(baseline_m)), axis=-1)


def baseline_of(rendered: JsonObject) -> tuple[float, ...]:
    """Return the laser's place relative to the camera, in the camera's frame [m], by what a transient states of itself
    (`Transient.meta`); 0 0 0 if not told."""
    return tuple(rendered.get("laser", {}).get("baseline_m", CO_LOCATED))


def laser_baseline_m(histogram: Histogram) -> tuple[float, ...]:
    """Return the laser's place relative to the camera, in the camera's frame [m]; 0 0 0 if not told."""
    return baseline_of(histogram.meta.get("transient", {}))


def time_tells_depth(histogram: Histogram) -> bool:
    """Tell whether depth is half of c times the recorded time: the laser is at the camera, converters measure what
    is."""
    return not any(laser_baseline_m(histogram)) and not _converters_differ(histogram)


def radial_depth_of(histogram: Histogram, half_path_m: np.ndarray) -> np.ndarray:
    """Convert half of c times the recorded time (H, W) [m] into distance from the camera, by the histogram's own
    converters, camera and laser.

    With a co-located laser and converters that measure what is, or where the histogram does not know of any, it is the
    same array. Raises InputError beside a displaced laser where the histogram does not tell where its pixels look.
    """
    return _distance_m(histogram, _light_half_path_m(histogram, half_path_m))


def _light_half_path_m(histogram: Histogram, half_path_m: np.ndarray) -> np.ndarray:
    """Return half of the light's path [m], given half of c times the time that its converter recorded."""
    if _converters_differ(histogram):
        recorded_s = 2 / SPEED_OF_LIGHT_M_PER_S * np.asarray(half_path_m, np.float64)
        time_s = _light_time_s(recorded_s, histogram.meta["zones"], histogram.sensor)
        half_path_m = (SPEED_OF_LIGHT_M_PER_S / 2 * time_s).astype(half_path_m.dtype)
    return half_path_m


def _distance_m(histogram: Histogram, half_path_m: np.ndarray) -> np.ndarray:
    """Return distance from the camera [m], given half of the light's path."""
    directions = check_pointing(histogram)
    return half_path_m if directions is None else radial_depth_m(half_path_m, directions, laser_baseline_m(histogram))


def check_pointing(histogram: Histogram) -> np.ndarray | None:
    """Return unit rays (H, W, 3) of the pixels beside a displaced laser, None beside one that is at the camera.

    Raises InputError where the histogram does not tell where its pixels look: then it has no depth.
    """
    baseline = laser_baseline_m(histogram)
    if not any(baseline):
        return None
    pointing, shape = pointing_of(histogram.meta), histogram.depth_m.shape
    directions = pixel_directions(pointing, shape)
    if directions is None:
        why = "its camera has another image" if pointing else "it states no camera"
        place = " ".join(f"{value:g}" for value in baseline)
        what = f"histogram of {shape[0]} x {shape[1]} pixels beside a laser at {place} m"
        raise InputError(f"{what}: {why}, so nothing tells where its pixels look")
    return directions


def true_path_m(seen: Transient | Histogram) -> np.ndarray:
    """Return the optical path (H, W) float64 [m] of light from the true depths; NaN where the depth is, and beside a
    displaced laser where nothing tells where the pixels look."""
    meta = seen.meta if isinstance(seen, Histogram) else {"transient": seen.meta}
    baseline = baseline_of(meta.get("transient", {}))
    if not any(baseline):
        return 2.0 * seen.depth_m.astype(np.float64)
    directions = pixel_directions(pointing_of(meta), seen.depth_m.shape)
    if directions is None:
        return np.full(seen.depth_m.shape, np.nan)
    return optical_path_m(seen.depth_m, directions, baseline)


def true_arrival_s(histogram: Histogram) -> np.ndarray:
    """Return when light from the true depth is recorded, (H, W) float64 [s] after the laser's emission, within the
    laser's period; NaN where no depth is known.

    A time at the record's end or later, in a period longer than the record, is one that the sensor does not record.
    """
    time_s = true_path_m(histogram) / SPEED_OF_LIGHT_M_PER_S
    if _converters_differ(histogram):
        clock, delay_s, chirp_hz = _converters(histogram.meta["zones"])
        # a converter starts anew at each emission
        time_s = chirped(time_s % histogram.sensor.period_s / clock, chirp_hz) + delay_s
    return time_s % histogram.sensor.period_s


def _converters_differ(histogram: Histogram) -> bool:
    """Tell whether zones' converters measure other times than light has."""
    if "zones" not in histogram.meta:
        return False
    clock, delay_s, chirp_hz = _converters(histogram.meta["zones"])
    return bool((clock != 1).any() or delay_s.any() or chirp_hz)


def _light_time_s(recorded_s: np.ndarray, zones: JsonObject, sensor: Sensor) -> np.ndarray:
    """Return when the light arrived that zones recorded at these times, (H, W) [s], within the laser's period.

    Where the bins cover the period, time is circular. Else a time after the last that the zone's bins record, and
    before the emission by no more than the pulse's reach, is 0: noise of light that arrived with the emission.
    """
    clock, delay_s, chirp_hz = _converters(zones)
    since_s = _since_emission_s(recorded_s, delay_s, sensor.period_s)
    if sensor.bins < sensor.bins_per_period:
        last_s = _since_emission_s(sensor.bins * sensor.bin_width_s, delay_s, sensor.period_s)
        last_s = np.maximum(last_s + ROUNDING * sensor.period_s, sensor.period_s - sensor.response.reach_s)
        since_s = np.where(since_s > last_s, 0.0, since_s)
    return clock * unchirped(since_s, chirp_hz)


def _since_emission_s(recorded_s: np.ndarray | float, delay_s: np.ndarray, period_s: float) -> np.ndarray:
    """Return recorded times less their delays, within the period, over whose ends rounding carries none."""
    late_s = recorded_s - delay_s
    within = np.abs(late_s - period_s / 2) <= (0.5 + ROUNDING) * period_s
    return np.where(within, late_s.clip(0, period_s), late_s % period_s)


def _converters(zones: JsonObject) -> tuple[np.ndarray, np.ndarray, float]:
    return np.asarray(zones["clock"]), np.asarray(zones["delay_s"]), float(zones["chirp_hz"])


def recorded_range_m(histogram: Histogram) -> np.ndarray:
    """Return the depth (H, W) [m] of each pixel whose return arrives when the last bin ends; errors are of nearer ones.

    Beside a displaced laser it differs between pixels, and is 0 where the record is shorter than the baseline. It is 0
    as well where a converter's delay moves the return of the true depth out of a record shorter than the period.
    """
    sensor = histogram.sensor
    end_m = np.full(histogram.depth_m.shape, sensor.recorded_range_m)
    if sensor.bins == sensor.bins_per_period:  # all that arrives within the period is recorded, however late
        return np.nan_to_num(_distance_m(histogram, end_m))
    range_m = np.nan_to_num(_distance_m(histogram, _light_half_path_m(histogram, end_m)))
    if _converters_differ(histogram):
        range_m[true_arrival_s(histogram) >= sensor.bins * sensor.bin_width_s] = 0.0
    return range_m


def pointing_of(meta: JsonObject) -> JsonObject:
    """Return what tells where a histogram's pixels look, by its metadata: the centres of its zones, or its camera."""
    if "zones" in meta:
        return {"zones": {name: meta["zones"][name] for name in ("centre_x", "centre_y")}}
    camera = meta.get("transient", {}).get("camera")
    return {"camera": camera} if camera else {}


def pixel_directions(pointing: JsonObject, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return unit rays (H, W, 3) of pixels, x right, y down, z forward; None where the camera's image is of another
    size, or none is known.

    pointing: `camera` of a transient, or `zones` with their centres, (H, W) tangents.
    """
    if "zones" in pointing:
        x, y = (np.asarray(pointing["zones"][name], dtype=np.float64) for name in ("centre_x", "centre_y"))
        ray = np.stack((x, y, np.ones_like(x)), axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True) if x.shape == shape else None
    camera = pointing.get("camera")
    if not camera or (camera.get("height"), camera.get("width")) != shape:
        return None
    return Camera(np.eye(4), float(camera["fov_deg"]), camera["width"], camera["height"]).rays()
