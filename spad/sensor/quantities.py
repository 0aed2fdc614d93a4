"""Numbers with units as people write them in a file: "91 ps", "0.4 mm", "2.5 kHz". Exact both ways."""

from __future__ import annotations

import math
import re
from decimal import Decimal, InvalidOperation, Overflow

from scenes.errors import InputError, require

# Powers of ten of each unit, the base unit first: SI, but for bandwidths of filters, which are nanometres everywhere.
UNITS: dict[str, dict[str, int]] = {
    "time": {"s": 0, "ms": -3, "us": -6, "ns": -9, "ps": -12, "fs": -15},
    "rate": {"Hz": 0, "kHz": 3, "MHz": 6, "mHz": -3},
    "length": {"m": 0, "mm": -3, "um": -6, "nm": -9},
    "area": {"m2": 0, "mm2": -6, "um2": -12},
    "bandwidth": {"nm": 0, "um": 3},
    "energy": {"J": 0, "mJ": -3, "uJ": -6, "nJ": -9, "pJ": -12, "fJ": -15},
}
# Both characters that are read as micro, and counts per second.
_MICRO = str.maketrans({"\u00b5": "u", "\u03bc": "u"})
_PER_SECOND = {"cps": "Hz", "1/s": "Hz", "kcps": "kHz", "mcps": "MHz"}
_QUANTITY = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?\d+)?|[-+]?nan|[-+]?inf)\s*(\S*)\s*")


def parse_quantity(value: object, dimension: str, where: str, *, signed: bool = False, infinite: bool = False) -> float:
    """Return a quantity in its dimension's base unit.

    `value` is a number where `dimension` is empty, else a text of number and unit.

    Raises InputError, which begins with `where`, for a value that is no finite number of 0 or more (`signed`: of any
    sign; `infinite`: infinity too), and for a unit that is missing or of another dimension.
    """
    if not dimension:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{where}: {value!r} is no number")
        try:
            number = float(value)
        except OverflowError:
            raise InputError(f"{where}: a whole number of more than 308 digits is too large") from None
        return _checked(number, value, where, signed, infinite)
    units = UNITS[dimension]
    example = f'a {dimension} in {", ".join(units)}, as "1 {next(iter(units))}"'
    if not isinstance(value, str):
        raise InputError(f"{where}: {value!r} has no unit, expected {example}")
    found = _QUANTITY.fullmatch(value)
    if found is None:
        raise InputError(f"{where}: {value!r} is no number with a unit, expected {example}")
    digits, unit = found[1], found[2].translate(_MICRO)
    named = f"the unit {unit}" if unit else "no unit"
    require(unit in units, f"{where}: {value!r} has {named}, expected {example}{_meant(unit, dimension)}")
    try:
        exact = Decimal(digits).scaleb(units[unit])
    except (InvalidOperation, Overflow):
        raise InputError(f"{where}: {value!r} is no number with a unit, expected {example}") from None
    return _checked(float(exact), value, where, signed, infinite)


def _meant(unit: str, dimension: str) -> str:
    """Return a hint at the units that differ in case alone; none where the case would make milli of mega."""
    close = _PER_SECOND.get(unit.lower(), unit)
    alike = [known for known in UNITS[dimension] if known.lower() == close.lower()]
    other_prefix = len(alike) == 1 and len(close) > 1 and {close[0], alike[0][0]} == {"m", "M"}
    return "" if not alike or other_prefix else f"; did you mean {' or '.join(map(repr, alike))}?"


def _checked(number: float, value: object, where: str, signed: bool, infinite: bool) -> float:
    require(math.isfinite(number) or (infinite and math.isinf(number)), f"{where}: {value!r} is not finite")
    require(signed or number >= 0, f"{where}: {value!r} is negative, expected 0 or more")
    return number


def format_quantity(value: float, dimension: str) -> str:
    """Write a value in the unit that leaves 1 to 999 before the point; `parse_quantity` returns the same float."""
    units = UNITS[dimension]
    exact = Decimal(repr(float(value)))
    fitting = [unit for unit, power in units.items() if exact and abs(exact) >= Decimal(1).scaleb(power)]
    largest = max(fitting, key=lambda unit: units[unit]) if fitting else next(iter(units))
    number = exact.scaleb(-units[largest]).normalize()
    return f"{number:f} {largest}" if abs(number.adjusted()) < 12 else f"{number} {largest}"
