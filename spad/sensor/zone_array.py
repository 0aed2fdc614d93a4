"""Zones of a multi-zone sensor: a few histograms, each of a field of view of several physical pixels, at close range.

Every effect is one switch with a unit; with all off it is the identity sensor, which only sums each zone's light.
Tangents are camera coordinates over depth: x right, y down. `spad.sensor.clock` says how converters measure time; they
share one chirp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import Any

import numpy as np

from scenes.errors import require
from spad.sensor.model import Sensor
from spad.sensor.zone_limits import VIEW, checked_number, key_of, numbers_of

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
OFF = {
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
            many = name in (*VIEW, *OFF)
            if many and isinstance(values, Real):
                values = (values,) * count
            elif name in OFF and isinstance(values, tuple | list) and not values:
                values = (OFF[name],) * count
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
            "skew": {"skew_s": (OFF["skew_s"],) * even},
            "leak": {"leak": (OFF["leak"],) * even},
            "echo": {"echo_m2": (OFF["echo_m2"],) * even},
            "crosstalk": {"crosstalk": 0.0},
            "saturation": {"trials": (OFF["trials"],) * even},
            "recovery": {"recovery": (OFF["recovery"],) * even},
            "compression": {"compression": (OFF["compression"],) * even},
            "background": {"background": (OFF["background"],) * even},
        }
        require(effect in off, f"effect {effect!r} is unknown, expected one of {', '.join(EFFECTS)}")
        return replace(self, **off[effect])


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
