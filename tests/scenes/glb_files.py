"""Small GLB files: a square with any attributes and a texture."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
UV = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32)
TEXTURED = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}


def written(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def png(values: np.ndarray, mode: str | None = None) -> bytes:
    picture = io.BytesIO()
    image = Image.fromarray(values)
    (image if mode is None else image.convert(mode)).save(picture, "PNG")
    return picture.getvalue()


RAMP = np.arange(0, 256, 4, dtype=np.uint8).reshape(8, 8)


def glb(
    path: Path,
    attributes: dict[str, np.ndarray],
    material: dict | None = None,
    picture: bytes = png(RAMP, "RGB"),
    extensions: dict | None = None,
    **primitive: object,
) -> Path:
    """Write a square: whole numbers of attributes are normalized; its one image is a grey ramp; `extensions` of its
    node."""
    names = {"float32": 5126, "uint16": 5123, "uint8": 5121, "int16": 5122}
    arrays = [*attributes.values(), np.array([0, 1, 2, 0, 2, 3], np.uint16)]
    blocks = [*(array.tobytes() for array in arrays), picture]
    starts = np.cumsum([0, *(len(block) + -len(block) % 4 for block in blocks)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(block)}
        for start, block in zip(starts, blocks, strict=False)
    ]
    accessors = [
        {
            "bufferView": i,
            "componentType": names[array.dtype.name],
            "count": len(array),
            "type": "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
            "normalized": array.dtype.kind in "iu" and array.ndim > 1,
        }
        for i, array in enumerate(arrays)
    ]
    used = {"material": 0} if material is not None else {}
    one = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "indices": len(arrays) - 1,
        **used,
        **primitive,
    }
    header = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "extensions": extensions or {}}],
        "meshes": [{"primitives": [one]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
        "images": [{"bufferView": len(blocks) - 1, "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        "materials": [] if material is None else [material],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(block + b"\0" * (-len(block) % 4) for block in blocks)
    size = 28 + len(text) + len(binary)
    head = b"glTF" + struct.pack("<IIII", 2, size, len(text), 0x4E4F534A)
    return written(path, head + text + struct.pack("<II", len(binary), 0x4E4942) + binary)
