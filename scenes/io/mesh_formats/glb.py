"""Check a GLB: its JSON, its accessors and the images that it uses."""

from __future__ import annotations

import io
import json
import struct
import warnings
from collections.abc import Callable, Iterator

from scenes.arrays import finite_number
from scenes.errors import InputError, listed, require
from scenes.io.inputs import parse_json
from scenes.io.mesh_formats import NotReadError
from scenes.io.mesh_formats.glb_coordinates import dense_accessors, plain_coordinates
from scenes.io.mesh_formats.glb_nodes import VISIBILITY, plain_nodes
from scenes.io.textures import WHITE, Colour, check_checksums
from scenes.json_types import JsonObject

_GLB_INDICES = (
    *("buffer", "bufferView", "camera", "indices", "material", "mesh", "node", "sampler", "scene", "skin", "source"),
    *("index", "count", "byteLength", "byteOffset", "byteStride", "children", "nodes"),
)

_GLB_BYTE = 5121  # component type of whole numbers without a sign
_NEAREST = 9728
_WRAPS = {33071: "CLAMP_TO_EDGE", 33648: "MIRRORED_REPEAT"}

# Extensions that files may need and are read; what is taken off a material changes no shape.
_READ = ("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", VISIBILITY)
_READ_MATERIALS = "KHR_materials_pbrSpecularGlossiness"
_LOOKS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "EXT_lights_", "EXT_materials_")  # how their names begin
_CLEAR = ("KHR_materials_transmission", "KHR_materials_volume", "KHR_materials_diffuse_transmission")
_INSTANCES = "EXT_mesh_gpu_instancing"
_PACKED = {"EXT_meshopt_compression", "KHR_meshopt_compression"}
_WAYS_ROUND = {
    _INSTANCES: "write its instances out as nodes",
    "EXT_meshopt_compression": "export it uncompressed",
    "KHR_meshopt_compression": "export it uncompressed",
    "KHR_draco_mesh_compression": "export it uncompressed",
    "KHR_texture_basisu": "export its textures as .png or .jpg",
}

ReadImage = Callable[[str], bytes]


def check_glb(content: bytes, read: ReadImage) -> None:
    """Raise InputError unless a GLB is whole, its indices and counts are possible, and the textures it uses are there.

    `read` gives the bytes of a file that the GLB names.
    """
    header, binary = _glb_chunks(content)
    _check_indices(header)
    try:
        _check_extensions(header)
        _check_accessors(header, binary, len(content))
        for mesh in header.get("meshes", []):
            for primitive in mesh["primitives"]:
                fan = primitive.get("mode", 4) == 6
                require(not fan, "a mesh is a triangle fan, which is not read; export it as triangles")
        _stated_colours(header)
        for number in sorted(_used_images(header)):
            _check_image(header, number, binary, read)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"its JSON is damaged ({type(error).__name__}: {error})") from None


def _check_extensions(header: JsonObject) -> None:
    """InputError for an extension that a file cannot be read without, and is not read."""
    for name in header.get("extensionsRequired", []):
        read = name in _READ or name.startswith(_LOOKS)
        way_round = _WAYS_ROUND.get(name, "export it without")
        if not read:
            raise NotReadError(f"needs the glTF extension {name[:80]}, which is not read; {way_round}")


def glb_notes(content: bytes) -> list[str]:
    """Return what is left out of a sound GLB: nodes, poses, instances, clear surfaces and other looks, metal and glow,
    and how its textures are sampled."""
    header, binary = _glb_chunks(content)
    notes = plain_nodes(header, dense_accessors(header, binary))
    several = sum(_INSTANCES in node.get("extensions", {}) for node in header.get("nodes", []))
    if several:
        notes.append(f"{_INSTANCES} is left out: each of {several} nodes is there once")
    primitives = [one for mesh in header.get("meshes", []) for one in mesh["primitives"]]
    used = [header["materials"][number] for number in sorted({one.get("material", -1) for one in primitives} - {-1})]
    found = {name for material in used for name in material.get("extensions", {})} - {_READ_MATERIALS}
    for names, words in (
        (found & {*_CLEAR}, "its surfaces are opaque"),
        (found - {*_CLEAR}, "its surfaces are diffuse"),
    ):
        if names:
            notes.append(f"{', '.join(sorted(names))} left out: {words}")
    return [*notes, *_metal_and_glow(used), *_sampling(header, used)]


def _sampling(header: JsonObject, materials: list[JsonObject]) -> list[str]:
    """Name the materials whose base colour is looked up in a way that is taken for another."""
    found: dict[str, list[str]] = {}
    for material in materials:
        base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        texture = {} if base is None else header["textures"][base["index"]]
        sampler = header["samplers"][texture["sampler"]] if "sampler" in texture else {}
        words = [_WRAPS[one] for one in (sampler.get("wrapS"), sampler.get("wrapT")) if one in _WRAPS]
        lines = [f"a texture's wrap mode {' and '.join(dict.fromkeys(words))} is taken as repeat"] if words else []
        lines += ["a texture's magFilter NEAREST is taken as linear"] if sampler.get("magFilter") == _NEAREST else []
        for line in lines:
            found.setdefault(line, []).append(_name(material))
    return [f"{line}: {listed(names)}" for line, names in found.items()]


def _name(material: JsonObject) -> str:
    return str(material.get("name", "without a name"))[:80]


def _metal_and_glow(materials: list[JsonObject]) -> list[str]:
    """Name the materials that are metal, as they are where metallicFactor is not given, that glow, or have bumps."""
    looks = [(_name(one), one.get("pbrMetallicRoughness"), one) for one in materials]
    metal = [
        name for name, pbr, one in looks if pbr is not None and _is_lit(one) and _is_some(pbr, "metallicFactor", 1)
    ]
    glow = [name for name, _, one in looks if _is_some(one, "emissiveFactor", 0)]
    bumpy = [name for name, _, one in looks if "normalTexture" in one]
    lines = (
        ("metallicFactor (1 unless given) is left out, their surfaces are diffuse", metal),
        ("emissiveFactor is left out, their surfaces give no light", glow),
        ("normalTexture is left out, their surfaces keep their own normals", bumpy),
    )
    return [f"{words}: {listed(list(dict.fromkeys(names)))}" for words, names in lines if names]


def _is_some(look: JsonObject, key: str, default: float) -> bool:
    """Return whether a factor, a number or several, is above 0 anywhere."""
    value = look.get(key, default)
    numbers = value if isinstance(value, list) else [value]
    return any(isinstance(one, (int, float)) and one > 0 for one in numbers)


def _is_lit(material: JsonObject) -> bool:
    return "KHR_materials_unlit" not in material.get("extensions", {})


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


def _check_accessors(header: JsonObject, binary: bytes, size: int) -> None:
    """InputError where primitives read what has no data of its own, or accessors declare more than the file has.

    Sparse ones are made dense here, as they will be read.
    """
    accessors = header.get("accessors", [])
    for number, accessor in enumerate(accessors):
        fits = ("bufferView" in accessor and "sparse" not in accessor) or accessor["count"] <= size
        require(fits, f"accessor {number} declares {accessor['count']} elements in a file of {size} bytes")
    dense_accessors(header, binary)
    primitives = [one for mesh in header.get("meshes", []) for one in mesh["primitives"]]
    used = [[*one["attributes"].values(), *([one["indices"]] if "indices" in one else [])] for one in primitives]
    read = {number for numbers in used for number in numbers}
    for number, accessor in enumerate(accessors):
        if number not in read:
            continue
        message = f"accessor {number} has no numbers in a buffer, as of compressed files; export it uncompressed"
        require("bufferView" in accessor, message)
        if "sparse" in accessor:
            raise NotReadError(f"accessor {number} is sparse with numbers in another file; export it as one .glb")
        view = header["bufferViews"][accessor["bufferView"]]
        packed = _PACKED & view.get("extensions", {}).keys()
        if packed and view["buffer"] > 0 and "uri" not in header["buffers"][view["buffer"]]:
            message = f"accessor {number} is compressed by {min(packed)}, which is not read; export it uncompressed"
            raise NotReadError(message)


def plain_glb(content: bytes) -> bytes:
    """Return a GLB as trimesh reads it rightly: no sparse accessors, nodes as in `plain_nodes`, coordinates as in
    `plain_coordinates`, materials named by their numbers, and vertex colours of more than 8 bits with a material.

    trimesh keeps such colours as they are only beside a material.
    """
    header, binary = _glb_chunks(content)
    dense = dense_accessors(header, binary)
    made = plain_coordinates(header, dense)
    plain_nodes(header, dense)
    header["materials"] = [{**one, "name": str(number)} for number, one in enumerate(header.get("materials", []))]
    primitives = [one for mesh in header.get("meshes", []) for one in mesh["primitives"] if "material" not in one]
    colours = [(one, one["attributes"].get("COLOR_0")) for one in primitives]
    wide = [one for one, at in colours if at is not None and header["accessors"][at]["componentType"] != _GLB_BYTE]
    if wide:
        header["materials"].append({})
    for one in wide:
        one["material"] = len(header["materials"]) - 1
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + struct.unpack_from("<I", content, 12)[0] :]
    if len(made) > len(binary):
        made += bytes(-len(made) % 4)
        rest = struct.pack("<I4s", len(made), b"BIN\0") + made
    return content[:8] + struct.pack("<II4s", 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def base_colours(content: bytes) -> dict[str, Colour]:
    """Return the base colours of a sound GLB, linear RGB, white where none is stated, by their names in `plain_glb`.

    trimesh rounds them to 8 bits, which is a third of a black of 0.003. Colours that it works out of an extension are
    not among them.
    """
    return _stated_colours(_glb_chunks(content)[0])


def _stated_colours(header: JsonObject) -> dict[str, Colour]:
    found = {}
    for number, material in enumerate(header.get("materials", [])):
        factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [*WHITE, 1])
        where = f"baseColorFactor of material {number}"
        require(
            isinstance(factor, list) and len(factor) in (3, 4), f"{where} is {str(factor)[:80]}, expected 4 numbers"
        )
        red, green, blue = (min(max(finite_number(one, where), 0.0), 1.0) for one in factor[:3])
        if _READ_MATERIALS not in material.get("extensions", {}):
            found[str(number)] = red, green, blue
    return found


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
