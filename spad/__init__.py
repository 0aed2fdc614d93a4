"""Transient -> expected counts -> detections -> Histogram, and the classical depth estimators.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scenes.lazy import lazy_names

if TYPE_CHECKING:
    from spad.detection.detect import sense
    from spad.estimators.depth import estimate_depth
    from spad.measurements.histogram import Histogram, read_histogram, write_histogram
    from spad.sensor.model import PhotonBudget, Sensor
    from spad.sensor.pulse import Pulse
    from spad.sensor_names import sensor_by_name

__all__ = [
    "Histogram",
    "PhotonBudget",
    "Pulse",
    "Sensor",
    "estimate_depth",
    "read_histogram",
    "sense",
    "sensor_by_name",
    "write_histogram",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "spad.detection.detect": ("sense",),
        "spad.estimators.depth": ("estimate_depth",),
        "spad.measurements.histogram": ("Histogram", "read_histogram", "write_histogram"),
        "spad.sensor.model": ("PhotonBudget", "Sensor"),
        "spad.sensor_names": ("sensor_by_name",),
        "spad.sensor.pulse": ("Pulse",),
    },
)
