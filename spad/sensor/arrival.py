"""Say in the plan's lines which light a sensor's period and record do not hold as it arrives. One wording for all."""

from __future__ import annotations

from spad.sensor.model import Sensor

UNRECORDED_MATTERS = 1e-3  # fraction of the light that finds no bins, from which on the plan says so


def wrap_line(fraction: float, sensor: Sensor, light: str = "signal") -> str:
    """Return the line on light that arrives later than one period after its emission."""
    return f"wrap: {fraction:.3%} of the {light} arrives after the period of {sensor.range_m:.3f} m and wraps"


def record_line(fraction: float, sensor: Sensor) -> str | None:
    """Return the line on signal that arrives when there are no bins, None below UNRECORDED_MATTERS; a warning where it
    is most of it."""
    if sensor.bins == sensor.bins_per_period or fraction < UNRECORDED_MATTERS:
        return None
    record, period = (f"{1e9 * bins * sensor.bin_width_s:.4g} ns" for bins in (sensor.bins, sensor.bins_per_period))
    line = f"record: {fraction:.1%} of the signal arrives when there are no bins, {record} of a period of {period}"
    return warning_of_most(line, fraction)


def warning_of_most(line: str, fraction: float) -> str:
    """Return a line as a warning where it is about more than half of the light."""
    return f"warning: {line}" if fraction > 0.5 else line
