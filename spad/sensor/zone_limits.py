"""Limits of the numbers of a multi-zone sensor: bad ones in one line that names the key, the zone and the limit."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from scenes.errors import require, require_number

VIEW = ("centre_x", "centre_y", "width", "height")
_SIGNED = ("centre_x", "centre_y", "delay_s", "chirp_hz", "baseline_m", "illumination_x", "illumination_y")
_POSITIVE = ("width", "height", "clock", "trials")
MAX_TANGENT = 4.0  # 76 degrees off the axis; as the size of a zone 127 degrees
MAX_DELAY_S = 1.0
MAX_CLOCK = 2.0  # and at least 1 / MAX_CLOCK, as the chirp may change the rate by a half
MAX_AMOUNT = 1e30  # of what has no limit of its own: products of two stay finite
MAX_COUNTS = (1 << 31) - 1  # of a zone in one exposure, which a histogram's int32 holds
_MOST = dict.fromkeys(VIEW, MAX_TANGENT) | {"delay_s": MAX_DELAY_S, "clock": MAX_CLOCK, "trials": math.inf}


def key_of(name: str) -> str:
    """Return a field's key in a sensor file."""
    key = re.sub("_(s|m|m2|hz)$", "", name)
    return f"zones.{key}"


def numbers_of(name: str, values: object) -> Sequence[object]:
    """Return what is a list, tuple or array of one dimension, not yet checked; InputError that names the key."""
    kind = isinstance(values, tuple | list) or (isinstance(values, np.ndarray) and values.ndim == 1)
    require(kind, f"{key_of(name)}: {values!r}, expected a list of numbers")
    return values  # type: ignore[return-value]


def checked_number(name: str, value: object, index: str = "") -> float:
    """Return a number within the limits of its field; InputError names its key, its zone and the limits."""
    where = f"{key_of(name)}{index}"
    number = float(require_number(value, f"{where}:"))
    most = _MOST.get(name, MAX_AMOUNT)
    require(math.isfinite(number) or (name == "trials" and number > 0), f"{where}: {number:g} is not finite")
    if name == "chirp_hz":  # its limit is the sensor's, see `check_times`
        return number
    low = -most if name in _SIGNED else 1 / MAX_CLOCK if name == "clock" else 0.0
    good = low <= number <= most and (number > 0 or name not in _POSITIVE)
    hint = ", tangents of angles and not degrees" if name in VIEW and abs(number) > most else ""
    opening = "(" if low == 0 and name in _POSITIVE else "["
    require(good, f"{where}: {number:g} is outside {opening}{low:g}, {most:g}]{hint}")
    return number
