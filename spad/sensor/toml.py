"""TOML as sensor files need it: tables of texts, numbers, booleans and flat lists. Read by the standard library."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path

from scenes.errors import InputError, require
from scenes.io.inputs import read_text

MAX_BYTES = 1 << 24
_LINE = 110


def read_toml(path: Path, what: str = "sensor file") -> dict[str, object]:
    """Return the tables of a TOML file.

    Raises InputError naming the file, and the line where it is no TOML; and for whole numbers beyond the 64 bits that
    TOML has.
    """
    text = read_text(path, what, most_bytes=MAX_BYTES).removeprefix("\ufeff")  # a mark of byte order
    try:
        tables = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is no TOML ({error})") from None
    except ValueError:  # a number of more digits than Python reads
        raise InputError(f"{path}: holds a whole number beyond the 64 bits that TOML has") from None
    for key, value in _whole_numbers(tables, ""):
        require(-(1 << 63) <= value < 1 << 63, f"{path}: {key}: a whole number beyond the 64 bits that TOML has")
    return tables


def _whole_numbers(value: object, where: str) -> Iterator[tuple[str, int]]:
    """Yield every whole number in tables and lists, with its key."""
    if isinstance(value, int):
        yield where, value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _whole_numbers(inner, f"{where}.{key}" if where else key)
    elif isinstance(value, list):
        for at, inner in enumerate(value):
            yield from _whole_numbers(inner, f"{where}[{at}]")


def format_toml(tables: Mapping[str, object], comment: str = "") -> str:
    """Write values, then tables of values (one level), as TOML text. Lists are broken at about 110 characters."""
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += [f"{_key(key)} = {_value(value)}" for key, value in tables.items() if not isinstance(value, Mapping)]
    for name, table in tables.items():
        if isinstance(table, Mapping):
            lines += ["", f"[{_key(name)}]", *(f"{_key(key)} = {_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _key(key: str) -> str:
    plain = key and all(letter.isascii() and (letter.isalnum() or letter in "_-") for letter in key)
    return key if plain else json.dumps(key)


def _value(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return str(value)
        case float():
            return repr(value) if math.isfinite(value) else ("nan" if math.isnan(value) else f"{'-' * (value < 0)}inf")
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case list() | tuple():
            return _list([_value(item) for item in value])
    raise TypeError(f"TOML: {type(value).__name__} cannot be written")


def _list(items: list[str]) -> str:
    lines, line = [], ""
    for item in items:
        if line and len(line) + len(item) > _LINE:
            lines.append(line)
            line = ""
        line += f" {item}," if line else f"{item},"
    lines.append(line)
    return f"[{line.rstrip(',')}]" if len(lines) == 1 else "[\n" + "".join(f"  {line}\n" for line in lines) + "]"
