"""Check what mesh files declare of themselves against what is in them, before a loader allocates or believes anything.

trimesh reads a text file that was cut, drops a texture that it cannot find, and takes negative indices as Python does.
It passes over what it has no model for: what would then be seen as something else is refused, or put as it reads it.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from scenes.errors import InputError, require
from scenes.io.inputs import parse_json
from scenes.io.textures import check_checksums
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
_STL_HEADER, _STL_TRIANGLE = 84, 50
_GLB_INDICES = (
    *("buffer", "bufferView", "camera", "indices", "material", "mesh", "node", "sampler", "scene", "skin", "source"),
    *("index", "count", "byteLength", "byteOffset", "byteStride", "children", "nodes"),
)

_GLB_USHORT, _GLB_FLOAT = 5123, 5126  # component types

ReadImage = Callable[[str], bytes]


# --- PLY -------------------------------------------------------------------------------------------------------------


class _Property(NamedTuple):
    type: str
    count_type: str | None  # of a list


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def check_ply(content: bytes) -> None:
    """Raise InputError unless a PLY holds as many values as its header says, no more and no fewer, all of them
    numbers."""
    elements, order, start = _ply_header(content)
    if order is None:
        _check_ply_text(content[start:], elements)
        return
    for element in elements:
        start = _end_of_binary(content, start, element, order)
    require(start == len(content), f"{len(content) - start} bytes more than its header says")


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


# --- OBJ -------------------------------------------------------------------------------------------------------------


def plain_obj(content: bytes) -> bytes:
    """Return an OBJ as trimesh reads it rightly: no indents and tabs, indices from the first vertex on.

    trimesh passes over indented lines, takes the first `mtllib` of comments too, counts negative indices from the end
    of the file instead of from their line, and takes vertex 0 for vertex 1. Raises InputError for an index of 0, or
    before the first.
    """
    content = content.replace(b"\r\n", b"\n").replace(b"\\\n", b" ").replace(b"\t", b" ")
    if content[:1] in b" #" or b"\n " in content or re.search(rb"\n#.*mtllib", content):
        content = re.sub(rb"^ +|^#.*mtllib.*", b"", content, flags=re.MULTILINE)
    if re.search(rb"\nf[^-\n]*[ /]-|\nf.*? 0+(?=[ /\n]|$)", content) is None:
        return content
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = content.split(b"\n")
    for number, line in enumerate(lines):
        key, *corners = line.partition(b"#")[0].split() or [b""]
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            found = [_corner(corner, [*counts.values()], number + 1) for corner in corners]
            lines[number] = b" ".join((key, *found))
    return b"\n".join(lines)


def _corner(corner: bytes, counts: list[int], line: int) -> bytes:
    """Return a corner, vertex/uv/normal, with indices that count from 1; `counts` of each are above its line."""
    parts = corner.split(b"/")
    for place, count in zip(range(len(parts)), counts, strict=False):
        index = int(parts[place] or 1)
        wrong = index < -count or (index == 0 and place == 0)
        require(not wrong, f"line {line}: a face's index {index}, {count} are there to count back, and 1 is the first")
        if index < 0:
            parts[place] = b"%d" % (count + 1 + index)
    return b"/".join(parts)


# --- STL -------------------------------------------------------------------------------------------------------------


def check_stl(content: bytes) -> int:
    """Return the number of triangles of an STL, binary or text. InputError for one that was cut."""
    if len(content) >= _STL_HEADER:
        count = struct.unpack_from("<I", content, _STL_HEADER - 4)[0]
        expected = _STL_HEADER + count * _STL_TRIANGLE
        if len(content) == expected:
            return count
        text = content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower()
        message = f"cut short or damaged: its header says {count} triangles in {expected} bytes"
        require(text, f"{message}, it has {len(content)}")
    return _check_stl_text(content.lower())


def _check_stl_text(text: bytes) -> int:
    words = ("solid", "endsolid", "facet", "endfacet", "vertex")
    counts = {word: len(re.findall(rb"^[ \t]*%s\b" % word.encode(), text, re.MULTILINE)) for word in words}
    whole = counts["solid"] == counts["endsolid"] and counts["facet"] == counts["endfacet"]
    whole = whole and counts["vertex"] == 3 * counts["facet"]
    require(whole, f"cut short or damaged: {', '.join(f'{count} {word}' for word, count in counts.items())}")
    return counts["facet"]


# --- GLB -------------------------------------------------------------------------------------------------------------


def check_glb(content: bytes, read: ReadImage) -> None:
    """Raise InputError unless a GLB is whole, its indices and counts are possible, and the textures it uses are there.

    `read` gives the bytes of a file that the GLB names.
    """
    header, binary = _glb_chunks(content)
    _check_indices(header)
    try:
        _check_accessors(header, len(content))
        for mesh in header.get("meshes", []):
            for primitive in mesh["primitives"]:
                _check_primitive(header, primitive)
        for number in sorted(_used_images(header)):
            _check_image(header, number, binary, read)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"its JSON is damaged ({type(error).__name__}: {error})") from None


def _glb_chunks(content: bytes) -> tuple[JsonObject, bytes]:
    """Read the JSON object and the first binary chunk."""
    require(len(content) >= 20 and content[:4] == b"glTF", "is no GLB")
    version, length, size, kind = struct.unpack_from("<II I4s", content, 4)
    require(version == 2, f"glTF of version {version}, expected 2")
    require(length == len(content), f"cut short or damaged: its header says {length} bytes, it has {len(content)}")
    require(kind == b"JSON" and 20 + size <= length, f"its JSON chunk of {size} bytes does not fit {length} bytes")
    header = parse_json(content[20 : 20 + size])
    if not isinstance(header, dict):
        raise InputError("its JSON holds no object")
    at = 20 + size
    if at + 8 > length:
        return header, b""
    size, kind = struct.unpack_from("<I4s", content, at)
    require(at + 8 + size <= length, f"its second chunk of {size} bytes does not fit {length} bytes")
    return header, content[at + 8 : at + 8 + size] if kind == b"BIN\0" else b""


def _check_indices(header: JsonObject) -> None:
    """All indices and counts are whole numbers of 0 or more: Python counts negative ones from the end."""
    for key, value in _entries(header):
        if key in _GLB_INDICES:
            for number in value if isinstance(value, list) else [value]:
                bad = isinstance(number, (int, float)) and (isinstance(number, float) or number < 0)
                require(not bad, f"its {key} is {number}, expected a whole number of 0 or more")


def _entries(value: object) -> Iterator[tuple[str, object]]:
    """Every key and value of nested objects but the user's own `extras` and extensions."""
    pending = [value]
    while pending:
        one = pending.pop()
        if isinstance(one, dict):
            yield from one.items()
            pending.extend(inner for key, inner in one.items() if key not in ("extras", "extensions"))
        elif isinstance(one, list):
            pending.extend(one)


def _check_accessors(header: JsonObject, size: int) -> None:
    """InputError where primitives read what has no data of its own, or accessors declare more than the file has."""
    accessors = header.get("accessors", [])
    primitives = [one for mesh in header.get("meshes", []) for one in mesh["primitives"]]
    used = [[*one["attributes"].values(), *([one["indices"]] if "indices" in one else [])] for one in primitives]
    read = {number for numbers in used for number in numbers}
    for number, accessor in enumerate(accessors):
        held = "bufferView" in accessor and "sparse" not in accessor
        message = f"accessor {number} is sparse or compressed, which is not read; export it uncompressed"
        require(held or number not in read, message)
        fits = held or accessor["count"] <= size
        require(fits, f"accessor {number} declares {accessor['count']} elements in a file of {size} bytes")


def _check_primitive(header: JsonObject, primitive: JsonObject) -> None:
    """Raise InputError for shapes and coordinates that trimesh drops, or takes for others."""
    require(primitive.get("mode", 4) != 6, "a mesh is a triangle fan, which is not read; export it as triangles")
    attributes, accessors = primitive["attributes"], header.get("accessors", [])
    whole = "POSITION" in attributes and accessors[attributes["POSITION"]].get("normalized", False)
    require(not whole, "positions are normalized whole numbers, which are not read; export them as floats")
    material = header["materials"][primitive["material"]] if "material" in primitive else {}
    base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if base is None:
        return
    moved = base.get("extensions", {}).get("KHR_texture_transform", {})
    still = [*moved.get("offset", (0, 0)), *moved.get("scale", (1, 1)), moved.get("rotation", 0)] == [0, 0, 1, 1, 0]
    require(still, "a base colour has a KHR_texture_transform, which is not read; bake it into the coordinates")
    chosen = moved.get("texCoord", base.get("texCoord", 0))
    require(chosen == 0, f"a base colour uses TEXCOORD_{chosen}, TEXCOORD_0 alone is read; export it with one set")
    floats = "TEXCOORD_0" not in attributes or accessors[attributes["TEXCOORD_0"]]["componentType"] == _GLB_FLOAT
    require(floats, "texture coordinates are whole numbers, which are not read; export them as floats")


def with_bare_materials(content: bytes) -> bytes:
    """Return a GLB in which 16-bit vertex colours have a material: trimesh keeps such of these alone as they are."""
    header, _ = _glb_chunks(content)
    primitives = [one for mesh in header.get("meshes", []) for one in mesh["primitives"] if "material" not in one]
    colours = [(one, one["attributes"].get("COLOR_0")) for one in primitives]
    wide = [one for one, at in colours if at is not None and header["accessors"][at]["componentType"] == _GLB_USHORT]
    if not wide:
        return content
    header["materials"] = [*header.get("materials", []), {}]
    for one in wide:
        one["material"] = len(header["materials"]) - 1
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + struct.unpack_from("<I", content, 12)[0] :]
    return content[:8] + struct.pack("<II4s", 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def _used_images(header: JsonObject) -> set[int]:
    """Images of the base colours of materials that primitives use."""
    materials, textures = header.get("materials", []), header.get("textures", [])
    used = {one["material"] for mesh in header.get("meshes", []) for one in mesh["primitives"] if "material" in one}
    found = set()
    for number in used:
        base = materials[number].get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if base is not None:
            texture = textures[base["index"]]
            webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
            found.add(webp.get("source", texture.get("source")))
    require(None not in found, "a base colour's texture names no image")
    return found


def _check_image(header: JsonObject, number: int, binary: bytes, read: ReadImage) -> None:
    """InputError where an image is not there, or none that Pillow knows."""
    from PIL import Image

    image = header["images"][number]
    name = image.get("uri", image.get("name", f"image {number}"))
    if "bufferView" in image:
        view = header["bufferViews"][image["bufferView"]]
        if view.get("buffer", 0) != 0 or "uri" in header["buffers"][0]:
            return  # in a file beside; trimesh reads it
        start = view.get("byteOffset", 0)
        data = binary[start : start + view["byteLength"]]
    elif name.startswith("data:"):
        return  # decoded once, by trimesh
    else:
        data = read(image["uri"])
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as opened:
            check_checksums(opened)
    except Exception as error:  # each of Pillow's formats has its own
        raise InputError(f"texture {name[:80]!r} is no image that can be read ({type(error).__name__})") from None
