"""Put the coordinates of a GLB as trimesh reads them rightly: as floats, those of textures where these are moved to."""

from __future__ import annotations

import numpy as np

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

    Raises NotReadError where that is not so simple: numbers in another file, or a transform that turns a texture.
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
    # programs turn it in one sense, the extension's own example in the other
    require(moved.get("rotation", 0) == 0, f"a base colour's {_TRANSFORM} has a rotation, bake it into the coordinates")
    offset, scale = np.array(moved.get("offset", (0, 0)), float), np.array(moved.get("scale", (1, 1)), float)
    still = [*offset, *scale] == [0, 0, 1, 1]
    if still and name == "TEXCOORD_0" and header["accessors"][attributes[name]]["componentType"] == FLOAT:
        return
    uv = offset + scale * _held_numbers(header, binary, attributes[name])
    attributes["TEXCOORD_0"] = _appended(header, made, uv)


def accessor_numbers(header: JsonObject, binary: bytes, number: int) -> np.ndarray | None:
    """Return the numbers (count, width) of an accessor, normalized ones as fractions; None where they are not plain
    numbers of the file itself. Raises InputError where they are cut short."""
    accessor = header["accessors"][number]
    if "bufferView" not in accessor or "sparse" in accessor:
        return None
    view = header["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "uri" in header["buffers"][0]:
        return None
    kind, width, count = np.dtype(_KINDS[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    start, size = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), width * kind.itemsize
    step = view.get("byteStride", size)
    require(
        count > 0 and step >= size and start + step * (count - 1) + size <= len(binary),
        f"accessor {number} is cut short",
    )
    values = np.ndarray((count, width), kind, binary, start, (step, kind.itemsize)).astype(np.float64)
    return np.maximum(values / np.iinfo(kind).max, -1) if accessor.get("normalized") and kind.kind != "f" else values


def _held_numbers(header: JsonObject, binary: bytes, number: int) -> np.ndarray:
    found = accessor_numbers(header, binary, number)
    if found is None:
        raise NotReadError("its coordinates are in another file, and not as they are read; export it as one .glb")
    return found


def _appended(header: JsonObject, made: bytearray, values: np.ndarray) -> int:
    """Put numbers (count, width) behind a binary chunk as an accessor, whose number is returned."""
    made += bytes(-len(made) % 4)
    content = values.astype("<f4").tobytes()
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(made), "byteLength": len(content)})
    made += content
    view, kind = len(header["bufferViews"]) - 1, f"VEC{values.shape[1]}"
    header["accessors"].append({"bufferView": view, "componentType": FLOAT, "count": len(values), "type": kind})
    return len(header["accessors"]) - 1
