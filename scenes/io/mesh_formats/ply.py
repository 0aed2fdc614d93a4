"""Check a PLY against its header, and read of it what trimesh reads otherwise."""

from __future__ import annotations

import re
import warnings
from typing import Any, NamedTuple

import numpy as np

from scenes.errors import InputError, require
from scenes.io.mesh_formats import NotReadError
from scenes.json_types import JsonObject

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


class _Property(NamedTuple):
    type: str
    count_type: str | None  # of a list


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def plain_ply(content: bytes) -> bytes:
    """Return a PLY as trimesh reads it: with a header in UTF-8, whatever its comments are in.

    Raises InputError unless it holds as many values as its header says, no more and no fewer, all of them numbers.
    """
    elements, order, first = _ply_header(content)
    if any(element.name == "tristrips" and element.rows for element in elements):
        raise NotReadError("holds triangle strips (tristrips), which are not read; export it with faces")
    if order is None:
        _check_ply_text(content[first:], elements)
    else:
        start = first
        for element in elements:
            start = _end_of_binary(content, start, element, order)
        require(start == len(content), f"{len(content) - start} bytes more than its header says")
    header = content[:first]
    plain = header.decode("utf-8", errors="replace").encode()
    return content if plain == header else plain + content[first:]


def _ply_header(content: bytes) -> tuple[list[_Element], str | None, int]:
    """Elements, byte order (None: text), and where the data begins."""
    end = re.search(rb"^[ \t]*end_header[ \t]*\r?\n?", content, re.MULTILINE)
    if end is None:
        raise InputError("its header has no end_header")
    lines = [line.split() for line in content[: end.start()].decode("latin-1").splitlines()]
    formats = [line[1] for line in lines if len(line) > 1 and line[0] == "format"]
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    message = f"format {' '.join(formats) or '(none)'}, expected {', '.join(orders)}"
    require(len(formats) == 1 and formats[0] in orders, message)
    elements: list[_Element] = []
    for line in lines:
        match line:
            case ["element", name, count]:
                require(count.isascii() and count.isdigit() and len(count) < 19, f"{count} elements {name!r}")
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count_type, value_type, _] if elements:
                known = count_type in _PLY_TYPES and value_type in _PLY_TYPES
                require(known, f"property of unknown type: {' '.join(line)}")
                elements[-1].properties.append(_Property(_PLY_TYPES[value_type], _PLY_TYPES[count_type]))
            case ["property", value_type, _] if elements:
                require(value_type in _PLY_TYPES, f"property of unknown type: {' '.join(line)}")
                elements[-1].properties.append(_Property(_PLY_TYPES[value_type], None))
            case ["element" | "property", *_]:
                raise InputError(f"header line {' '.join(line)!r} is not understood")
    return elements, orders[formats[0]], end.end()


def _check_ply_text(body: bytes, elements: list[_Element]) -> None:
    """One line an element, each with the numbers that its properties and its lists' lengths ask for."""
    try:
        lines = body.decode("utf-8").rstrip().splitlines()
    except UnicodeDecodeError:
        raise InputError("its data are no text") from None
    expected = sum(element.rows for element in elements)
    require(len(lines) == expected, f"cut short or damaged: {len(lines)} lines of data, its header says {expected}")
    at = 0
    for element in elements:
        rows, at = lines[at : at + element.rows], at + element.rows
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of what is no number, and ends there
            values = np.fromstring(" ".join(rows), sep=" ")
        end = _end_of_text(values, element)
        message = f"cut short or damaged: {len(values)} numbers for {element.rows} elements {element.name!r}"
        require(end == len(values), f"{message}, expected {end}")


def _end_of_text(values: np.ndarray, element: _Element) -> int:
    """Count the numbers of a text element by its properties and the lengths of its lists."""
    if all(one.count_type is None for one in element.properties):
        return element.rows * len(element.properties)
    width, places = _text_row(values, 0, element)
    end = element.rows * width
    if end <= len(values):
        rows = values[:end].reshape(element.rows, width)
        if all((rows[:, place] == rows[0, place]).all() for place in places):
            return end
    end = 0
    for _ in range(element.rows):
        end += _text_row(values, end, element)[0]
    return end


def _text_row(values: np.ndarray, start: int, element: _Element) -> tuple[int, list[int]]:
    """Numbers in the row that begins at `start`, and where in it the lengths of lists stand."""
    width, places = 0, []
    for one in element.properties:
        if one.count_type is not None and start + width < len(values):
            length = values[start + width]
            require(0 <= length <= len(values) and length == int(length), f"a list of {length:g} values")
            places.append(width)
            width += int(length)
        width += 1
    return width, places


def _end_of_binary(content: bytes, start: int, element: _Element, order: str) -> int:
    """Find where the rows of a binary element end. InputError for rows that are not all there, or lists of different
    lengths."""
    if element.rows == 0:
        return start
    fields: list[tuple[Any, ...]] = []
    size = 0
    for number, one in enumerate(element.properties):
        length: tuple[int, ...] = ()
        if one.count_type is not None:
            kind = np.dtype(order + one.count_type)
            first = content[start + size : start + size + kind.itemsize]
            require(len(first) == kind.itemsize, "cut short: ends within its data")
            length = (int(np.frombuffer(first, kind)[0]),)
            require(0 <= length[0] <= len(content), f"a list of {length[0]} values")
            fields.append((f"count{number}", kind))
            size += kind.itemsize
        fields.append((f"value{number}", order + one.type, length))
        size += np.dtype(one.type).itemsize * (length[0] if length else 1)
    end = start + element.rows * size
    message = f"cut short or damaged: {element.rows} elements {element.name!r} take {end - start} bytes"
    require(end <= len(content), f"{message}, {len(content) - start} are there")
    if any(one.count_type for one in element.properties):
        rows = np.frombuffer(content, np.dtype(fields), element.rows, start)
        lists = [rows[name] for name, *_ in fields if name.startswith("count")]
        even = all((counts == counts[0]).all() for counts in lists)
        require(even, f"elements {element.name!r} have lists of different lengths, which is read from text alone")
    return end


def ply_polygons(elements: JsonObject) -> list[np.ndarray]:
    """Return the polygons of a PLY, as trimesh read it, by their corners; none where all are triangles."""
    data = elements.get("face", {}).get("data", {})
    names = data if isinstance(data, dict) else data.dtype.names or ()
    for name in ("vertex_index", "vertex_indices"):
        if name in names:
            rows = data[name] if isinstance(data, dict) else data[name]["f1"]
            if np.shape(rows)[1:] == (3,):
                return []
            polygons = [np.asarray(row, np.int64) for row in rows if np.ndim(row) == 1 and len(row) > 2]
            return polygons if any(len(one) > 3 for one in polygons) else []
    return []


def ply_points(elements: JsonObject) -> np.ndarray:
    """Return the vertices (n, 3) of a PLY, as trimesh read it."""
    data = elements["vertex"]["data"]
    return np.column_stack([np.asarray(data[axis], np.float64).ravel() for axis in "xyz"])


def ply_colours(elements: JsonObject) -> tuple[np.ndarray | None, str]:
    """Return the colours (n, 3) that a PLY has per vertex, else per face, and which of the two; shares of white.

    elements  as trimesh read them

    Whole numbers are shares of the most that their type holds, of 255 where they have 32 bits and none is larger.
    Fractions beyond 2 are taken as levels up to 255 too, as some programs write them.
    """
    for element in ("vertex", "face"):
        properties = elements.get(element, {}).get("properties", {})
        for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")):
            if all(name in properties for name in names):
                columns = [np.asarray(elements[element]["data"][name], np.float64).ravel() for name in names]
                values = np.column_stack(columns)
                kind = np.dtype(properties[names[0]])
                largest = values.max(initial=0.0)
                if kind.kind == "f":
                    most = 255 if largest > 2 else 1
                else:
                    most = 255 if kind.itemsize >= 4 and largest <= 255 else np.iinfo(kind).max
                return np.nan_to_num(values / most), element
    return None, "vertex"
