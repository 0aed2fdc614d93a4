"""Put the coordinates of a GLB as trimesh reads them rightly: as floats, those of textures where these are moved to."""

from __future__ import annotations

import math

import numpy as np

from scenes.arrays import finite_number
from scenes.errors import require
from scenes.io.mesh_formats import NotReadError
from scenes.json_types import JsonObject

FLOAT = 5126  # component type
_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TRANSFORM = "KHR_texture_transform"


def plain_coordinates(header: JsonObject, binary: bytes) -> bytes:
    """Change the primitives of a GLB to what trimesh reads rightly; return its binary chunk with numbers behind it.

    - Positions that are normalized whole numbers are floats.
    - Texture coordinates of the base colour are floats, the first set, and moved by their KHR_texture_transform.

    Raises NotReadError where that is not so simple: numbers in another file.
    """
    made = bytearray(binary)
    for primitive in [one for mesh in header.get("meshes", []) for one in mesh["primitives"]]:
        attributes = primitive["attributes"]
        if "POSITION" in attributes and header["accessors"][attributes["POSITION"]].get("normalized", False):
            points = _held_numbers(header, binary, attributes["POSITION"])
            attributes["POSITION"] = _appended(header, made, points)
        material = header["materials"][primitive["material"]] if "material" in primitive else {}
        base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if base is not None:
            _move_coordinates(header, binary, made, attributes, base)
    for material in header.get("materials", []):
        base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        base.pop("texCoord", None)
        base.get("extensions", {}).pop(_TRANSFORM, None)
    if len(made) > len(binary):
        header["buffers"][0]["byteLength"] = len(made)
    return bytes(made)


def _move_coordinates(
    header: JsonObject, binary: bytes, made: bytearray, attributes: JsonObject, base: JsonObject
) -> None:
    """Give a primitive of a texture `base` the coordinates that are looked up as its first set."""
    moved = base.get("extensions", {}).get(_TRANSFORM, {})
    name = f"TEXCOORD_{moved.get('texCoord', base.get('texCoord', 0))}"
    if name not in attributes:
        attributes.pop("TEXCOORD_0", None)
        return
    offset, scale = np.array(moved.get("offset", (0, 0)), float), np.array(moved.get("scale", (1, 1)), float)
    angle = finite_number(moved.get("rotation", 0), f"the rotation of a base colour's {_TRANSFORM}")
    still = [*offset, *scale, angle] == [0, 0, 1, 1, 0]
    if still and name == "TEXCOORD_0" and header["accessors"][attributes[name]]["componentType"] == FLOAT:
        return
    # counter-clockwise as an image is seen, whose v runs down; first scaled, then turned, then moved
    turn = np.array(((math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))))
    uv = offset + (scale * _held_numbers(header, binary, attributes[name])) @ turn.T
    attributes["TEXCOORD_0"] = _appended(header, made, uv)


def dense_accessors(header: JsonObject, binary: bytes) -> bytes:
    """Make accessors of a GLB that are sparse plain ones, as trimesh reads; return its binary chunk with their numbers.

    Ones in another file stay as they are. Raises InputError where one is cut short, or replaces what is not there.
    """
    made = bytearray(binary)
    for number, accessor in enumerate(header.get("accessors", [])):
        if "sparse" not in accessor:
            continue
        count, width = accessor["count"], _WIDTHS[accessor["type"]]
        sparse = accessor["sparse"]
        parts = {**sparse["indices"], "type": "SCALAR"}, {**accessor, "byteOffset": 0, **sparse["values"]}
        where = f"sparse part of accessor {number}"
        places, values = (_elements(header, binary, {**one, "count": sparse["count"]}, where) for one in parts)
        base = None
        if "bufferView" in accessor:
            base = _elements(header, binary, accessor, f"accessor {number}")
        if places is None or values is None or ("bufferView" in accessor and base is None):
            continue
        rows = np.zeros((count, width), values.dtype) if base is None else base.copy()
        require(places.dtype.kind == "u" and int(places.max()) < count, f"{where} reaches beyond its {count} elements")
        rows[places[:, 0]] = values
        plain = _appended(header, made, rows)
        kept = {key: value for key, value in accessor.items() if key not in ("sparse", "byteOffset")}
        header["accessors"][number] = kept | {"bufferView": header["accessors"].pop(plain)["bufferView"]}
    if len(made) > len(binary):
        made += bytes(-len(made) % 4)
        header["buffers"][0]["byteLength"] = len(made)
    return bytes(made)


def accessor_numbers(header: JsonObject, binary: bytes, number: int) -> np.ndarray | None:
    """Return the numbers (count, width) of an accessor, normalized ones as fractions; None where they are not plain
    numbers of the file itself. Raises InputError where they are cut short."""
    accessor = header["accessors"][number]
    if "bufferView" not in accessor or "sparse" in accessor:
        return None
    found = _elements(header, binary, accessor, f"accessor {number}")
    if found is None:
        return None
    kind, values = found.dtype, found.astype(np.float64)
    return np.maximum(values / np.iinfo(kind).max, -1) if accessor.get("normalized") and kind.kind != "f" else values


def _elements(header: JsonObject, binary: bytes, accessor: JsonObject, where: str) -> np.ndarray | None:
    """Return the numbers (count, width) of an accessor's buffer view as they are stored; None of another file."""
    view = header["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "uri" in header["buffers"][0]:
        return None
    kind, width, count = np.dtype(_KINDS[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    start, size = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), width * kind.itemsize
    step = view.get("byteStride", size)
    require(
        count > 0 and step >= size and start + step * (count - 1) + size <= len(binary),
        f"{where} is cut short",
    )
    return np.ndarray((count, width), kind, binary, start, (step, kind.itemsize))


def _held_numbers(header: JsonObject, binary: bytes, number: int) -> np.ndarray:
    found = accessor_numbers(header, binary, number)
    if found is None:
        raise NotReadError("its coordinates are in another file, and not as they are read; export it as one .glb")
    return found


def _appended(header: JsonObject, made: bytearray, values: np.ndarray) -> int:
    """Put numbers (count, width) behind a binary chunk as an accessor, whose number is returned."""
    made += bytes(-len(made) % 4)
    content = (values.astype("<f4") if values.dtype == np.float64 else values).tobytes()
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(made), "byteLength": len(content)})
    made += content
    view, kind = len(header["bufferViews"]) - 1, f"VEC{values.shape[1]}"
    header["accessors"].append({"bufferView": view, "componentType": FLOAT, "count": len(values), "type": kind})
    return len(header["accessors"]) - 1
