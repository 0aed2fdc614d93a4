"""Turned textures, sparse accessors, invisible nodes and compressed buffers of a GLB, as the standard means them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from glb_files import CORNERS, TEXTURED, UV, glb, written

from scenes import InputError, Scene
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.placing import Placing

AS_FILE = Placing(scale=1, bare=True)


def edited(path: Path, edit: Callable[[dict], None], more: bytes = b"") -> Path:
    """Write a GLB again with an edited header, and `more` behind its numbers."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    header = json.loads(content[20 : 20 + size])
    binary = content[28 + size :] + more
    header["buffers"][0]["byteLength"] = len(binary)
    edit(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    head = b"glTF" + struct.pack("<IIII", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return written(path, head + text + struct.pack("<II", len(binary), 0x4E4942) + binary)


def loaded(path: Path) -> Scene:
    return load_mesh(path, placing=AS_FILE)


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        ({"rotation": np.pi / 2}, ((1, 0), (1, -1), (0, -1), (0, 0))),
        ({"rotation": np.pi / 2, "scale": [2, 1]}, ((1, 0), (1, -2), (0, -2), (0, 0))),
        (
            {"rotation": -np.pi / 2, "scale": [2, 1], "offset": [0.5, 0.25]},
            ((-0.5, 0.25), (-0.5, 2.25), (0.5, 2.25), (0.5, 0.25)),
        ),
        ({"rotation": np.pi}, ((0, -1), (-1, -1), (-1, 0), (0, 0))),
    ],
)
def test_a_texture_is_scaled_then_turned_then_moved(tmp_path: Path, transform: dict, expected: tuple) -> None:
    """Counter-clockwise as its image is seen, whose v runs down: (1, 0) turns to (0, -1). Worked out by hand."""
    base = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    material = {"pbrMetallicRoughness": {"baseColorTexture": base}}
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS, "TEXCOORD_0": UV}, material)
    (surface,) = loaded(path).surfaces
    np.testing.assert_allclose(surface.uv, np.array(expected) * (1, -1) + (0, 1), atol=1e-6)


@pytest.mark.parametrize("based", [True, False])
def test_sparse_positions_replace_what_they_name(tmp_path: Path, based: bool) -> None:
    """Replace some of an accessor that has numbers, and of one that is 0 where nothing is named."""
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS, "TEXCOORD_0": UV}, TEXTURED)
    start = struct.unpack_from("<I", path.read_bytes(), 20 + struct.unpack_from("<I", path.read_bytes(), 12)[0])[0]
    places, values = np.array([1, 2], np.uint16), np.array([(3, 0, 0), (3, 4, 5)], np.float32)

    def edit(header: dict) -> None:
        views, accessor = header["bufferViews"], header["accessors"][0]
        views.append({"buffer": 0, "byteOffset": start, "byteLength": 4})
        views.append({"buffer": 0, "byteOffset": start + 4, "byteLength": 24})
        indices = {"bufferView": len(views) - 2, "componentType": 5123}
        accessor["sparse"] = {"count": 2, "indices": indices, "values": {"bufferView": len(views) - 1}}
        if not based:
            del accessor["bufferView"]

    (surface,) = loaded(edited(path, edit, places.tobytes() + values.tobytes())).surfaces
    expected = (CORNERS if based else 0 * CORNERS).copy()
    expected[[1, 2]] = values
    expected -= (1.5, 0, 2.5)
    used = expected if based else expected[:3]  # the fourth corner is the first, and its face has no area
    np.testing.assert_allclose(surface.vertices, used, atol=1e-6)


def test_sparse_indices_beyond_the_end_are_refused(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS})

    def edit(header: dict) -> None:
        view = header["accessors"][0]["bufferView"]
        places = {"bufferView": view, "componentType": 5123, "byteOffset": 14}  # the upper half of 1.0: 16256
        header["accessors"][0]["sparse"] = {"count": 1, "indices": places, "values": {"bufferView": view}}

    with pytest.raises(InputError, match="sparse part of accessor 0 reaches beyond its 4 elements"):
        loaded(edited(path, edit))


@pytest.mark.parametrize("hidden", [0, 1])
def test_an_invisible_node_is_left_out_with_what_hangs_below_it(tmp_path: Path, hidden: int) -> None:
    """Also where a node below says that it is visible; a visible node beside stays."""

    def edit(header: dict) -> None:
        nodes = header["nodes"]
        nodes += [{"name": "above", "children": [2]}, {"name": "below", "mesh": 0, "translation": [5, 0, 0]}]
        nodes[2]["extensions"] = {"KHR_node_visibility": {"visible": hidden != 1}}
        nodes[1]["extensions"] = {"KHR_node_visibility": {"visible": hidden != 0}}
        header["scenes"][0]["nodes"] = [0, 1]

    scene = loaded(edited(glb(tmp_path / "a.glb", {"POSITION": CORNERS}), edit))
    assert scene.triangles == 2 and np.ptp(scene.surfaces[0].vertices[:, 0]) == 1
    assert "invisible by KHR_node_visibility and left out: below" in scene.notes


def test_a_file_without_anything_visible_is_refused(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS}, extensions={"KHR_node_visibility": {"visible": False}})
    with pytest.raises(InputError, match="all its meshes are invisible: 0"):
        loaded(path)


def test_compression_that_is_not_declared_as_needed_is_refused_in_a_line(tmp_path: Path) -> None:
    """Read Draco, and meshopt whose fallback buffer has no numbers."""

    def draco(header: dict) -> None:
        header["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
        del header["accessors"][0]["bufferView"]

    def meshopt(header: dict) -> None:
        header["buffers"].append({"byteLength": 48})
        header["bufferViews"][0] |= {"buffer": 1, "byteOffset": 0, "extensions": {"EXT_meshopt_compression": {}}}

    for edit in (draco, meshopt):
        with pytest.raises(InputError, match=r"accessor 0 .*compress.*; export it uncompressed") as caught:
            loaded(edited(glb(tmp_path / "a.glb", {"POSITION": CORNERS}), edit))
        assert "\n" not in str(caught.value)
