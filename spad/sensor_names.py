"""Sensors by name: the presets, and those that come as files."""

from __future__ import annotations

from scenes.errors import did_you_mean, require
from spad.sensor.files import pixel_sensor, preset_files, sensor_names
from spad.sensor.model import PRESETS, Sensor


def sensor_by_name(name: str) -> Sensor:
    """Return the preset of that name, or that of a sensor file of the package; an InputError lists the names.

    One of zones, as tmf8820, is refused: its `Sensor` alone has no pixels to record with (`scene2spad sense` takes it).

    Examples
    --------
    >>> import scene2spad as s2s
    >>> sensor = s2s.sensor_by_name("reference")
    >>> sensor.bins, round(sensor.period_s * 1e9), round(sensor.range_m, 2)  # bins, ns, m
    (1024, 100, 14.99)
    """
    require(isinstance(name, str), f"sensor {name!r}, expected the name of one")
    if name in PRESETS:
        return PRESETS[name]
    names = sensor_names()
    unknown = f"sensor {name!r} is unknown{did_you_mean(name, names)}, expected one of {', '.join(names)}"
    require(name in preset_files(), unknown)
    return pixel_sensor(name)
