"""Read a PLY, text or binary: the columns that its header declares, among them lists of any lengths."""

from __future__ import annotations

import re
import struct
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from scenes.errors import InputError, require

_PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float": "f4",
    "double": "f8",
    "float16": "f2",
    "float32": "f4",
    "float64": "f8",
    "int64": "i8",
    "uint64": "u8",
}
_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}  # of struct
_LETTERS |= {"f2": "e", "f4": "f", "f8": "d"}
_TEXT_TYPE = "f8"  # as which all numbers of a text are held


@dataclass(frozen=True)
class Lists:
    """Lists of numbers, one a row: the values of all of them in one array, and the length of each."""

    values: np.ndarray
    lengths: np.ndarray


@dataclass(frozen=True)
class Element:
    """An element of a PLY: the numbers (rows,) or lists of each property by its name, and the types it declares."""

    rows: int
    columns: dict[str, np.ndarray | Lists]
    types: dict[str, np.dtype[Any]]

    def numbers(self, *names: str) -> np.ndarray | None:
        """Return columns of numbers side by side, (rows, names) in double precision; None where one is not there."""
        found = [self.columns.get(name) for name in names]
        whole = [np.asarray(one, np.float64) for one in found if isinstance(one, np.ndarray)]
        return np.column_stack(whole) if len(whole) == len(names) else None


@dataclass(frozen=True)
class Ply:
    """Hold what a PLY says: its elements by name, and the textures that its comments name."""

    elements: dict[str, Element]
    textures: list[str]


class _Property(NamedTuple):
    name: str
    type: str
    count_type: str | None  # of a list


class _Declared(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def read_ply(content: bytes) -> Ply:
    """Return the elements of a PLY. Faces may have any numbers of corners; types and byte order are as declared.

    Raises InputError unless it holds as many values as its header says, no more and no fewer, all of them numbers.
    """
    declared, order, textures, at = _header(content)
    elements = {}
    lines = _text_lines(content[at:], declared) if order is None else []
    at = 0 if order is None else at
    for one in declared:
        if order is None:
            columns = _text_columns(lines[at : at + one.rows], one)
            at += one.rows
        else:
            columns, at = _columns(content, at, one, order)
        types = {each.name: np.dtype(each.type) for each in one.properties}
        elements[one.name] = Element(one.rows, columns, types)
    require(order is None or at == len(content), f"{len(content) - at} bytes more than its header says")
    return Ply(elements, textures)


def _header(content: bytes) -> tuple[list[_Declared], str | None, list[str], int]:
    """Elements, byte order (None: text), names of textures, and where the data begins."""
    end = re.search(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*\r?\n?", content)
    require(content[:3] == b"ply", "does not begin with ply")
    if end is None:
        raise InputError("its header has no end_header")
    text = re.split(r"\r\n?|\n", content[: end.start()].decode("utf-8", errors="replace"))
    lines = [line.split() for line in text]
    formats = [line[1] for line in lines if len(line) > 1 and line[0] == "format"]
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    message = f"format {' '.join(formats) or '(none)'}, expected {', '.join(orders)}"
    require(len(formats) == 1 and formats[0] in orders, message)
    elements: list[_Declared] = []
    for line in lines:
        match line:
            case ["element", name, count]:
                require(count.isascii() and count.isdigit() and len(count) < 19, f"{count} elements {name!r}")
                elements.append(_Declared(name, int(count), []))
            case ["property", "list", count_type, value_type, name] if elements:
                known = count_type in _PLY_TYPES and value_type in _PLY_TYPES
                require(known, f"property of unknown type: {' '.join(line)}")
                elements[-1].properties.append(_Property(name, _PLY_TYPES[value_type], _PLY_TYPES[count_type]))
            case ["property", value_type, name] if elements:
                require(value_type in _PLY_TYPES, f"property of unknown type: {' '.join(line)}")
                elements[-1].properties.append(_Property(name, _PLY_TYPES[value_type], None))
            case ["element" | "property", *_]:
                raise InputError(f"header line {' '.join(line)!r} is not understood")
    first = end.end()
    if end[0].endswith(b"\r\n") and b"\n" not in content[: end.start()]:
        first -= 1  # lines end by CR alone: the data begin with a byte that looks like LF
    for one in elements:
        names = [each.name for each in one.properties]
        twice = [name for name in names if names.count(name) > 1]
        require(not twice, f"elements {one.name!r} have two properties {', '.join(dict.fromkeys(twice))}")
    named = [re.match(r"comment +TextureFile +(.+?)\s*$", line, re.IGNORECASE) for line in text]
    return elements, orders[formats[0]], [one[1] for one in named if one is not None], first


def _text_lines(body: bytes, declared: list[_Declared]) -> list[str]:
    """Return one line an element: blank ones are passed over."""
    try:
        lines = [line for line in body.decode("utf-8").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise InputError("its data are no text") from None
    expected = sum(one.rows for one in declared)
    require(len(lines) == expected, f"cut short or damaged: {len(lines)} lines of data, its header says {expected}")
    return lines


def _text_columns(lines: list[str], declared: _Declared) -> dict[str, np.ndarray | Lists]:
    """Return the columns of a text element: its numbers are put into bytes, and read as a binary element of these."""
    try:
        with warnings.catch_warnings(action="ignore"):  # numpy warns, or raises, at what is no number
            values = np.fromstring(" ".join(lines), sep=" ")
    except ValueError:
        raise InputError(
            f"cut short or damaged: not all of {declared.rows} elements {declared.name!r} are numbers"
        ) from None
    types = [one._replace(type=_TEXT_TYPE, count_type=one.count_type and _TEXT_TYPE) for one in declared.properties]
    message = f"{len(values)} numbers for {declared.rows} elements {declared.name!r}"
    if not any(one.count_type for one in types):
        expected = declared.rows * len(types)
        require(len(values) == expected, f"cut short or damaged: {message}, expected {expected}")
    try:
        columns, end = _columns(values.tobytes(), 0, declared._replace(properties=types), "=")
    except InputError as error:
        raise InputError(f"{error}, of {message}") from None
    require(end == values.nbytes, f"cut short or damaged: {message}, expected {end // values.itemsize}")
    return columns


def _columns(content: bytes, start: int, declared: _Declared, order: str) -> tuple[dict[str, np.ndarray | Lists], int]:
    """Return the columns of a binary element, and where it ends."""
    if declared.rows == 0 or not declared.properties:
        return {}, start
    even = _even_columns(content, start, declared, order)
    if even is not None:
        return even
    starts, end = _row_starts(content, start, declared, order)
    require(end <= len(content), "cut short or damaged: ends within its data")
    columns: dict[str, np.ndarray | Lists] = {}
    at = starts
    for one in declared.properties:
        kind = np.dtype(order + one.type)
        if one.count_type is None:
            columns[one.name] = _at_any_byte(content, kind)[at]
            at = at + kind.itemsize
            continue
        count_kind = np.dtype(order + one.count_type)
        lengths = _at_any_byte(content, count_kind)[at].astype(np.int64)
        at = at + count_kind.itemsize
        inner = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        places = np.repeat(at, lengths) + kind.itemsize * inner
        columns[one.name] = Lists(_at_any_byte(content, kind)[places], lengths)
        at = at + kind.itemsize * lengths
    return columns, end


def _even_columns(
    content: bytes, start: int, declared: _Declared, order: str
) -> tuple[dict[str, np.ndarray | Lists], int] | None:
    """Return columns and end of an element whose rows are as long as its first; None where lists have other lengths."""
    fields: list[tuple[Any, ...]] = []
    size = 0
    for number, one in enumerate(declared.properties):
        length: tuple[int, ...] = ()
        if one.count_type is not None:
            kind = np.dtype(order + one.count_type)
            first = content[start + size : start + size + kind.itemsize]
            require(len(first) == kind.itemsize, "cut short: ends within its data")
            found = np.frombuffer(first, kind)[0]
            if not 0 <= found <= len(content) or found % 1:
                return None
            length = (int(found),)
            fields.append((f"count{number}", kind))
            size += kind.itemsize
        fields.append((f"value{number}", order + one.type, length))
        size += np.dtype(one.type).itemsize * (length[0] if length else 1)
    end = start + declared.rows * size
    lists = [number for number, one in enumerate(declared.properties) if one.count_type is not None]
    if end > len(content):
        message = f"cut short or damaged: {declared.rows} elements {declared.name!r} take {end - start} bytes"
        require(bool(lists), f"{message}, {len(content) - start} are there")
        return None
    rows = np.frombuffer(content, np.dtype(fields), declared.rows, start)
    columns: dict[str, np.ndarray | Lists] = {}
    for number, one in enumerate(declared.properties):
        values = rows[f"value{number}"]
        columns[one.name] = values
        if number in lists:
            counts = rows[f"count{number}"]
            if not (counts == counts[0]).all():
                return None
            columns[one.name] = Lists(values.ravel(), counts.astype(np.int64))
    return columns, end


def _row_starts(content: bytes, start: int, declared: _Declared, order: str) -> tuple[np.ndarray, int]:
    """Return where each row of an element begins, and where the last one ends: lists say their lengths one by one."""
    steps = []
    gap = 0  # bytes of numbers between one list and the next
    for one in declared.properties:
        size = np.dtype(one.type).itemsize
        if one.count_type is None:
            gap += size
        else:
            count = struct.Struct(order + _LETTERS[one.count_type])
            steps.append((gap, count.unpack_from, count.size, size))
            gap = 0
    starts, at = [], start
    try:
        for _ in range(declared.rows):
            starts.append(at)
            for before, unpack, count_size, size in steps:
                at += before
                (length,) = unpack(content, at)
                if not length >= 0 or length % 1:
                    raise InputError(f"a list of {length:g} values")
                at += count_size + size * int(length)
            at += gap
    except (struct.error, OverflowError):  # of a length beyond any file
        raise InputError("cut short or damaged: ends within its data") from None
    return np.array(starts), at


def _at_any_byte(content: bytes, kind: np.dtype[Any]) -> np.ndarray:
    """Return the number that begins at each byte, without a copy."""
    return np.ndarray((max(0, len(content) - kind.itemsize + 1),), kind, content, strides=(1,))
