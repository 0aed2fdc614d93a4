"""A multi-zone sensor: a few histograms, each of a field of view of several physical pixels, at close range.

Every effect is one switch with a unit; with all off it is the identity sensor, which only sums each zone's light.
Tangents are camera coordinates over depth: x right, y down. `spad.sensor.clock` says how converters measure time; they
share one chirp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import require
from scenes.random_streams import Stream
from spad.detection.saturation import draw_saturated, saturated
from spad.sensor.clock import chirped
from spad.sensor.model import Sensor
from spad.zones.limits import MAX_COUNTS, VIEW, checked_number, key_of, numbers_of

# Switches that an ablation turns off one by one: name and what `without` puts in their place.
EFFECTS = (
    "parallax",
    "aperture",
    "illumination",
    "clock",
    "chirp",
    "delay",
    "skew",
    "leak",
    "echo",
    "crosstalk",
    "saturation",
    "recovery",
    "compression",
    "background",
)
# What a switch is where it is off, of those that have a number for each zone.
_OFF = {
    "gain": 1.0,
    "delay_s": 0.0,
    "skew_s": 0.0,
    "clock": 1.0,
    "background": 0.0,
    "leak": 0.0,
    "echo_m2": 0.0,
    "trials": math.inf,
    "recovery": 0.0,
    "compression": 0.0,
}


@dataclass(frozen=True)
class ZoneArray:
    """Zones and the switches of what happens to their light.

    centre_x, centre_y, width, height   fields of view [tangents], one number a zone
    gain          primary detections an exposure per unit of a zone's light, 1 / (m^2 J); one number a zone
    delay_s       electronic delay of each zone's converter [s]; off 0
    skew_s        of the delays of a zone's detectors: half of them are late by half of it, half early; off 0
    clock         real seconds per second of each zone's converter; off 1
    chirp_hz      of all converters' clock, which slows down or speeds up after the laser has fired; off 0
    background    primary detections an exposure and bin of each zone, dark counts and ambient light; off 0
    leak          light that the module itself reflects at a path of 0, in units of a zone's light; off 0
    echo_m2       of light that goes from the scene to the module, and once more to the scene and back: at twice the
                  path, this over the squared distance of the light that came back first; off 0
    crosstalk     share of the sum of all zones' signal that every zone sees besides, light scattered in the lens; off 0
    trials        detectors times laser cycles of each zone, which saturate (`spad.detection.saturation`); off infinite
    recovery      further trials that a detection costs its detector, over the zone's detectors, one number a zone or
                  one for all; off 0
    compression   of full bins, n / (1 + compression n / trials), the same; no law but a description; off 0
    illumination_x, illumination_y   direction in which the emitter is brightest [tangent]
    curvature_x, curvature_y         of the emitter's intensity exp(-(k_x u^2 + k_y v^2) / 2); off 0, uniform
    baseline_m    emitter minus receiver (x right, y down, z forward): parallax in the near field; off 0
    aperture_m    diameter of the receiver's lens, which blurs the zones' edges by aperture / depth; off 0

    Raises InputError that names the key as in a sensor file, the zone from 0, and the limit.
    """

    centre_x: tuple[float, ...]
    centre_y: tuple[float, ...]
    width: tuple[float, ...]
    height: tuple[float, ...]
    gain: tuple[float, ...] = ()
    delay_s: tuple[float, ...] = ()
    skew_s: tuple[float, ...] = ()
    clock: tuple[float, ...] = ()
    chirp_hz: float = 0.0
    background: tuple[float, ...] = ()
    leak: tuple[float, ...] = ()
    echo_m2: tuple[float, ...] = ()
    crosstalk: float = 0.0
    trials: tuple[float, ...] = ()
    recovery: float | tuple[float, ...] = ()
    compression: float | tuple[float, ...] = ()
    illumination_x: float = 0.0
    illumination_y: float = 0.0
    curvature_x: float = 0.0
    curvature_y: float = 0.0
    baseline_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    aperture_m: float = 0.0

    def __post_init__(self) -> None:
        count = len(numbers_of("centre_x", self.centre_x))
        require(1 <= count <= 4096, f"zones: {count} of them, expected 1 to 4096")
        for spec in fields(self):
            name, values = spec.name, getattr(self, spec.name)
            many = name in (*VIEW, *_OFF)
            if many and isinstance(values, Real):
                values = (values,) * count
            elif name in _OFF and isinstance(values, tuple | list) and not values:
                values = (_OFF[name],) * count
            if many or name == "baseline_m":
                values = numbers_of(name, values)
                expected = count if many else 3
                kind = f"{count} zones" if many else "x, y and z"
                require(len(values) == expected, f"{key_of(name)}: {len(values)} numbers for {kind}")
                checked: Any = tuple(checked_number(name, value, f"[{at}]") for at, value in enumerate(values))
            else:
                checked = checked_number(name, values)
            object.__setattr__(self, name, checked)
        require(self.crosstalk < 1, f"zones.crosstalk: {self.crosstalk:g} is outside [0, 1)")

    @property
    def count(self) -> int:
        return len(self.centre_x)

    @property
    def saturation(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return trials, recovery and compression of the zones, (Z,) each."""
        return np.asarray(self.trials), np.asarray(self.recovery), np.asarray(self.compression)

    def without(self, effect: str) -> ZoneArray:
        """Return the array with one of EFFECTS off; delays and clocks become their mean over the zones."""
        even = self.count
        off: dict[str, dict[str, Any]] = {
            "parallax": {"baseline_m": (0.0, 0.0, 0.0)},
            "aperture": {"aperture_m": 0.0},
            "illumination": {"curvature_x": 0.0, "curvature_y": 0.0},
            "clock": {"clock": (float(np.mean(self.clock)),) * even},
            "chirp": {"chirp_hz": 0.0},
            "delay": {"delay_s": (float(np.mean(self.delay_s)),) * even},
            "skew": {"skew_s": (0.0,) * even},
            "leak": {"leak": (0.0,) * even},
            "echo": {"echo_m2": (0.0,) * even},
            "crosstalk": {"crosstalk": 0.0},
            "saturation": {"trials": (math.inf,) * even},
            "recovery": {"recovery": (0.0,) * even},
            "compression": {"compression": (0.0,) * even},
            "background": {"background": (0.0,) * even},
        }
        require(effect in off, f"effect {effect!r} is unknown, expected one of {', '.join(EFFECTS)}")
        return replace(self, **off[effect])


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


def largest_chirp(bins: int) -> float:
    """Return the chirp [per bin] that changes the rate of a clock by a half within `bins` bins."""
    return 0.25 / bins


def check_times(sensor: Sensor, zones: ZoneArray) -> None:
    """Raise InputError for a clock whose rate changes by more than a half within the histogram, and for detectors of a
    zone whose delays differ by more than the laser's period: nobody means that."""
    worst = int(np.argmax(zones.skew_s))
    late_s, period_s = zones.skew_s[worst], sensor.period_s
    require(late_s <= period_s, f"zones.skew[{worst}]: {late_s:g} s is above the laser's period of {period_s:g} s")
    most = largest_chirp(sensor.bins) / sensor.bin_width_s
    message = f"zones: chirp {zones.chirp_hz:g} Hz, at most {most:.3g} Hz lets a clock of {sensor.bins} bins "
    require(abs(zones.chirp_hz) <= most, f"{message}of {sensor.bin_width_s * 1e12:.4g} ps keep half of its rate")


def since_emission(returns: ZoneReturns, period_m: float) -> ZoneReturns:
    """Return light by its path since the last emission, `period_m` the path in one period of the laser.

    A converter starts anew at each emission: its clock and its chirp act on the time since the last one.
    """
    near_m, far_m, light = returns
    before_m = np.floor(near_m / period_m) * period_m
    return ZoneReturns(near_m - before_m, far_m - before_m, light)


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


def zone_signal(returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, drift_s: float = 0.0) -> np.ndarray:
    """Return expected primary signal detections (Z, T) float64: pulses integrated over each zone's own bins, crosstalk
    added.

    Time wraps at the laser's period; what arrives in a part of it without bins is not counted. `drift_s` delays all
    zones, as a laser that warms up does.
    """
    check_times(sensor, zones)
    period_m = SPEED_OF_LIGHT_M_PER_S * sensor.period_s
    own = np.zeros((zones.count, sensor.bins))
    for zone, seen in enumerate(returns):
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

    from spad.detection.flux import interval_cdf

    start_s, end_s, light = measured
    if not len(light):
        return np.zeros(sensor.bins)
    start, length = (torch.from_numpy(value)[:, None] for value in (start_s, end_s - start_s))
    edges = torch.arange(sensor.bins + 1, dtype=torch.float64) * sensor.bin_width_s
    reach_s = sensor.response.reach_s
    first = math.floor((start_s.min() - reach_s) / sensor.period_s)
    last = math.floor((end_s.max() + reach_s) / sensor.period_s)
    counted = np.zeros(sensor.bins)
    for cycle in range(first, last + 1):
        after = edges + cycle * sensor.period_s - start
        arrived = interval_cdf(sensor.response, after, length.expand(-1, len(edges)))
        counted += np.diff(torch.from_numpy(light) @ arrived)
    return counted


def zone_flux(returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, drift_s: float = 0.0) -> np.ndarray:
    """Return expected primary detections (Z, T) float64: signal and background."""
    return zone_signal(returns, sensor, zones, drift_s) + np.asarray(zones.background)[:, None]


def expected_zone_counts(
    returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, drift_s: float = 0.0
) -> np.ndarray:
    """Return expected counts (Z, T) float64 of one exposure, after saturation."""
    flux = zone_flux(returns, sensor, zones, drift_s)
    return saturated(flux, *zones.saturation)


def draw_zone_counts(
    returns: list[ZoneReturns], sensor: Sensor, zones: ZoneArray, *, seed: int = 0, drift_s: float = 0.0
) -> np.ndarray:
    """Draw counts (Z, T) int64 of one exposure; the same seed gives the same counts.

    Raises InputError for a zone of more than 2^31 - 1 counts, expected or drawn.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.ZONES, 0, 0)))
    flux = zone_flux(returns, sensor, zones, drift_s)
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
