"""The one exception a user's mistake ends in, and how its message names things."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from difflib import get_close_matches
from numbers import Integral, Real
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MAX_NAMES = 8
_Item = TypeVar("_Item")


class InputError(ValueError):
    """Bad input, in one line that names value, limit and place. The command line prints it and exits with 2.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> try:
    ...     s2s.Sensor(name="mine", bins=0)
    ... except s2s.InputError as error:
    ...     print(error)
    sensor mine: 0 bins is outside 1 to 65536
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(printable(str(message)).split()))


def printable(text: str) -> str:
    """Return text that UTF-8 can hold: bytes of a file's name that are no text become escapes."""
    return text.encode("utf-8", "backslashreplace").decode()


def require(condition: bool, message: str) -> None:
    """Raise InputError with `message` unless `condition` holds."""
    if not condition:
        raise InputError(message)


def require_kind(value: object, kind: type, where: str, hint: str = "") -> None:
    """Raise InputError unless `value` is of the class `kind`; `where` is the function that was called, `hint` what
    gives one."""
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    require(isinstance(value, kind), f"{where}: expected {article} {kind.__name__}{hint}, not {type(value).__name__}")


def require_kinds(owner: object, where: str, **kinds: type) -> None:
    """Raise InputError unless fields of an object, given by name, are of their classes; `where` comes first."""
    for name, kind in kinds.items():
        require_kind(getattr(owner, name), kind, f"{where}: {name}")


def tuple_of(values: object, kind: type[_Item], what: str) -> tuple[_Item, ...]:
    """Return several objects of one class as a tuple, or an InputError that names the first of another class.

    One object alone, and a text, which would be a list of its letters, are no list.
    """
    if isinstance(values, (kind, str)) or not isinstance(values, Iterable):
        raise InputError(f"{what}: expected a list of {kind.__name__}, not {type(values).__name__}")
    found: tuple[_Item, ...] = tuple(values)
    for place, value in enumerate(found):
        require_kind(value, kind, f"{what}[{place}]")
    return found


def require_choice(value: object, known: Iterable[str], what: str) -> None:
    """Raise InputError unless a word is among those known; `what` it chooses comes first."""
    words = tuple(known)
    good = isinstance(value, str) and value in words
    require(good, f"{what} {value!r} is unknown, expected one of {', '.join(words)}")


def require_number(value: object, what: str) -> float:
    """Return a real number as Python's own, which JSON holds, or an InputError that names `what` was given.

    NumPy's numbers become float, int and float stay as they are; truth values and text are no numbers.
    """
    require(isinstance(value, Real) and not isinstance(value, bool), f"{what} {value!r}, expected a number")
    return value if type(value) in (int, float) else float(value)  # type: ignore[return-value, arg-type]


def require_whole(value: object, what: str) -> int:
    """Return a whole number as Python's int, or an InputError: 20.0 and truth values are none."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    require(whole, f"{what} {value!r}, expected a whole number")
    return int(value)  # type: ignore[call-overload]


def normalise_fields(owner: DataclassInstance, where: str) -> None:
    """Make fields of a frozen dataclass that are annotated as int, float, bool or str Python's own, as JSON holds them.

    A number that may be left out, as in `int | None`, stays None where it is.
    Raises InputError that names the first field of another kind, its value, and what is expected; `where` comes first.
    Its module must postpone annotations, which then are the words that the source has.
    """
    kinds: dict[str, str] = {}  # not of the fields' `type`, which libraries that walk over dataclasses replace
    for cls in reversed(type(owner).__mro__):
        kinds |= vars(cls).get("__annotations__", {})
    for item in fields(owner):
        value, what, kind = getattr(owner, item.name), f"{where}: {item.name}", kinds[item.name]
        if value is None and kind in ("int | None", "float | None"):
            continue
        if kind in ("int", "int | None"):
            object.__setattr__(owner, item.name, require_whole(value, what))
        elif kind in ("float", "float | None"):
            object.__setattr__(owner, item.name, require_number(value, what))
        elif kind == "bool":
            require(isinstance(value, bool), f"{what} {value!r}, expected True or False")
        elif kind == "str":
            require(isinstance(value, str), f"{what} {value!r}, expected text")


def listed(names: Iterable[str]) -> str:
    """Join the first MAX_NAMES of distinct names by commas, and count the rest."""
    distinct = list(dict.fromkeys(names))
    more = f" and {len(distinct) - MAX_NAMES} more" if len(distinct) > MAX_NAMES else ""
    return ", ".join(distinct[:MAX_NAMES]) + more


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the choice that a mistyped word is close to, else an empty string.

    Example: `did_you_mean("galery", ["gallery", "plane"])` is "; did you mean 'gallery'?".
    """
    close = get_close_matches(word, list(choices), n=1, cutoff=0.6)
    return f"; did you mean '{close[0]}'?" if close else ""


def told_apart(value: float, limit: float, digits: int = 2) -> tuple[str, str]:
    """Return two numbers with so many digits, or with the fewest more that tell them apart.

    Example: `told_apart(0.0203, 0.02)` is ("0.0203", "0.02"), where two digits would show 0.02 twice.
    """
    texts = ((f"{value:.{n}g}", f"{limit:.{n}g}") for n in range(digits, 18))
    return next((pair for pair in texts if pair[0] != pair[1]), (f"{value:.{digits}g}", f"{limit:.{digits}g}"))
