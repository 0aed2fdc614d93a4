"""Nodes and colours of a GLB as the standard means them: names of primitives, skins, morphs, samplers, metres."""

from __future__ import annotations

import base64
import io
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from scenes import InputError, Scene
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.placing import Placing

AS_FILE = Placing(scale=1, bare=True)
BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
POINTS = np.asarray(BALL.vertices, np.float32) + np.float32((1, 0.5, 0))
BIND = {"inverseBindMatrices": 2, "joints": [1, 2]}
TARGET = {"targets": [{"POSITION": 0}]}


def mesh(count: int = 1, **primitive: object) -> dict:
    return {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, **primitive}] * count}


def glb(path: Path, nodes: list[dict], inverse: np.ndarray | None = None, **header: object) -> Path:
    """Write nodes, roots where no other names them, over one ball; `inverse` is the array of accessor 2."""
    matrices = np.array([np.eye(4)] * 2 if inverse is None else inverse, np.float32)
    arrays = POINTS, np.asarray(BALL.faces, np.uint32).ravel(), matrices.transpose(0, 2, 1).copy()
    starts = np.cumsum([0, *(one.nbytes for one in arrays)]).tolist()
    kinds = ((5126, "VEC3", len(POINTS)), (5125, "SCALAR", BALL.faces.size), (5126, "MAT4", 2))
    children = {child for node in nodes for child in node.get("children", [])}
    whole = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [number for number in range(len(nodes)) if number not in children]}],
        "nodes": nodes,
        "meshes": [mesh()],
        "accessors": [
            {"bufferView": i, "componentType": kind, "type": shape, "count": count}
            for i, (kind, shape, count) in enumerate(kinds)
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": one.nbytes}
            for start, one in zip(starts, arrays, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
        **header,
    }
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(one.tobytes() for one in arrays)
    head = b"glTF" + struct.pack("<IIII", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", len(binary), 0x4E4942) + binary)
    return path


def loaded(path: Path) -> Scene:
    return load_mesh(path, placing=AS_FILE)


def settled(points: np.ndarray) -> np.ndarray:
    """Move points as a model is: their middle to x = z = 0, the lowest to y = 0."""
    low, high = points.min(axis=0), points.max(axis=0)
    return points - ((low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2)


def placed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def column_major(matrix: np.ndarray) -> list[float]:
    return matrix.T.ravel().tolist()


def posed(*, angle: float = 0.7, shift: float = 1.0, scale: float = 1.0) -> np.ndarray:
    matrix = trimesh.transformations.rotation_matrix(angle, (1, 2, 3))
    matrix[:3, :3] *= scale
    matrix[:3, 3] = shift, -shift, 2 * shift
    return matrix


def test_primitives_are_named_by_their_number(tmp_path: Path) -> None:
    """Names, and the notes that have them, must not depend on chance: transients hold them."""
    nodes = [{"mesh": 0, "name": "pair", "children": [1]}, {"mesh": 0, "translation": [3, 0, 0]}]
    path = glb(tmp_path / "a.glb", nodes, meshes=[mesh(3)])
    scenes = [loaded(path) for _ in range(2)]
    assert sorted(one.name for one in scenes[0].surfaces) == ["1_0", "1_1", "1_2", "pair_0", "pair_1", "pair_2"]
    assert [one.name for one in scenes[0].surfaces] == [one.name for one in scenes[1].surfaces]
    assert scenes[0].notes == scenes[1].notes and any("pair_2: no colour" in note for note in scenes[0].notes)
    assert scenes[0].digest() == scenes[1].digest()


def test_a_primitive_stands_where_its_node_does(tmp_path: Path) -> None:
    matrix = posed(scale=0.5)
    path = glb(tmp_path / "a.glb", [{"mesh": 0, "matrix": column_major(matrix)}], meshes=[mesh(2)])
    for surface in loaded(path).surfaces:
        assert surface.vertices == pytest.approx(settled(placed(POINTS, matrix)), abs=1e-6)


@pytest.mark.parametrize("scale", [(0, 0, 0), (1, 1, 0)])
def test_a_mesh_that_is_scaled_to_nothing_is_left_out(tmp_path: Path, scale: tuple[float, ...]) -> None:
    """Also below the node that has the scale, turned once more."""
    turned = {"mesh": 0, "name": "below", "rotation": [0.5, 0.5, 0.5, 0.5], "translation": [0, 9, 0]}
    hidden = {"mesh": 0, "name": "hidden", "scale": scale, "rotation": [0.1, 0.7, 0.1, 0.7], "children": [2]}
    scene = loaded(glb(tmp_path / "a.glb", [{"mesh": 0}, hidden, turned]))
    assert len(scene.surfaces) == 1
    assert scene.surfaces[0].vertices == pytest.approx(settled(POINTS), abs=1e-6)
    assert "scaled to nothing by their nodes and left out: hidden, below" in scene.notes
    with pytest.raises(InputError, match="all its meshes are scaled to nothing by their nodes: hidden") as caught:
        loaded(glb(tmp_path / "b.glb", [{**hidden, "children": []}]))
    assert "\n" not in str(caught.value)


def test_a_camera_changes_no_mesh(tmp_path: Path) -> None:
    camera = {"type": "perspective", "perspective": {"yfov": 0.6, "znear": 0.1}}
    nodes = [{"camera": 0, "mesh": 0, "translation": [0, 0, 3], "children": [1]}, {"mesh": 0, "translation": [5, 0, 0]}]
    scene = loaded(glb(tmp_path / "a.glb", nodes, cameras=[camera]))
    expected = settled(np.concatenate((POINTS, POINTS + (5, 0, 0))))
    assert np.concatenate([one.vertices for one in scene.surfaces]) == pytest.approx(expected, abs=1e-6)


def skinned(path: Path, inverse: np.ndarray, *joints: np.ndarray) -> Scene:
    """Load a ball beside one that hangs below a node and has a skin of two joints."""
    nodes = [
        {"mesh": 0, "skin": 0, "scale": [10, 10, 10]},
        {"matrix": column_major(joints[0]), "children": [2]},
        {"matrix": column_major(np.linalg.inv(joints[0]) @ joints[1])},
        {"mesh": 0},
    ]
    return loaded(glb(path, nodes, inverse, skins=[BIND]))


def test_a_mesh_in_the_pose_it_was_bound_in_stands_where_its_joints_place_it(tmp_path: Path) -> None:
    """The oracle is linear blend skinning with weights of each vertex at random."""
    joints = np.array([posed(), posed(angle=-1.0, shift=2.0)])
    moved = posed(angle=0.3, shift=0.5, scale=0.25)
    inverse = np.linalg.inv(joints) @ moved
    weights = np.random.default_rng(0).dirichlet((1, 1), len(POINTS))
    blended = np.einsum("vj,jvk->vk", weights, [placed(POINTS, joint) for joint in joints @ inverse])
    scene = skinned(tmp_path / "a.glb", inverse, *joints)
    expected = settled(np.concatenate((POINTS, blended)))
    found = sorted((one.vertices for one in scene.surfaces), key=np.ptp, reverse=True)
    assert np.concatenate(found) == pytest.approx(expected, abs=1e-5)
    assert not any("skin" in note for note in scene.notes)


def test_another_pose_is_noted(tmp_path: Path) -> None:
    joints = np.array([posed(), posed(angle=-1.0, shift=2.0)])
    notes = skinned(tmp_path / "a.glb", np.linalg.inv(joints[::-1]), *joints).notes
    assert "the pose of a skin is left out, the first joint alone places the mesh: 0" in notes


def test_inverse_bind_matrices_that_are_not_there_are_refused(tmp_path: Path) -> None:
    nodes: list[dict] = [{"mesh": 0, "skin": 0}, *({} for _ in range(3))]
    with pytest.raises(InputError, match="inverse bind matrices are cut short"):
        loaded(glb(tmp_path / "a.glb", nodes, skins=[{**BIND, "joints": [1, 2, 3]}]))


def test_cameras_and_lights_and_bumps_that_are_left_out_are_noted(tmp_path: Path) -> None:
    lamp = {"name": "sun", "extensions": {"KHR_lights_punctual": {"light": 0}}}
    nodes = [{"mesh": 0}, {"name": "view", "camera": 0}, lamp]
    scene = load_mesh(
        glb(
            tmp_path / "a.glb",
            nodes,
            meshes=[mesh(material=0)],
            materials=[{"name": "brick", "normalTexture": {"index": 0}}],
            cameras=[{"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}}],
            extensionsUsed=["KHR_lights_punctual"],
            extensions={"KHR_lights_punctual": {"lights": [{"type": "directional"}]}},
        ),
        placing=AS_FILE,
    )
    for words in ("cameras are left out.*: view", "lights of KHR_lights_punctual.*: sun", "normalTexture.*: brick"):
        assert sum(bool(re.search(words, note)) for note in scene.notes) == 1, words
    assert len(scene.surfaces) == 1
    plain = load_mesh(glb(tmp_path / "b.glb", [{"mesh": 0}]), placing=AS_FILE)
    assert not any("left out" in note for note in plain.notes)


@pytest.mark.parametrize(
    ("node", "whole", "noted"),
    [
        ({}, {"weights": [0.5]}, True),
        ({"weights": [0.0]}, {"weights": [0.5]}, False),
        ({"weights": [0.5]}, {}, True),
        ({}, {}, False),
    ],
)
def test_a_morph_that_is_seen_is_noted(tmp_path: Path, node: dict, whole: dict, noted: bool) -> None:
    """A node's weights replace the mesh's."""
    notes = loaded(glb(tmp_path / "a.glb", [{"mesh": 0, **node}], meshes=[{**mesh(**TARGET), **whole}])).notes
    assert ("morph targets are left out, meshes are as without: 0" in notes) == noted


@pytest.mark.parametrize(
    ("sampler", "expected"),
    [
        ({"wrapS": 10497, "wrapT": 10497, "magFilter": 9729}, []),
        ({"wrapS": 33071}, ["a texture's wrap mode CLAMP_TO_EDGE is taken as repeat: cloth"]),
        (
            {"wrapS": 33648, "wrapT": 33071},
            ["a texture's wrap mode MIRRORED_REPEAT and CLAMP_TO_EDGE is taken as repeat: cloth"],
        ),
        ({"magFilter": 9728}, ["a texture's magFilter NEAREST is taken as linear: cloth"]),
    ],
)
def test_a_sampler_that_is_taken_for_another_is_noted(tmp_path: Path, sampler: dict, expected: list[str]) -> None:
    picture = io.BytesIO()
    Image.new("RGB", (2, 2)).save(picture, "PNG")
    source = "data:image/png;base64," + base64.b64encode(picture.getvalue()).decode()
    look = {"baseColorTexture": {"index": 0}, "metallicFactor": 0}
    scene = loaded(
        glb(
            tmp_path / "a.glb",
            [{"mesh": 0}],
            meshes=[mesh(material=0)],
            materials=[{"name": "cloth", "pbrMetallicRoughness": look}],
            textures=[{"source": 0, "sampler": 0}],
            images=[{"uri": source}],
            samplers=[sampler],
        )
    )
    assert [note for note in scene.notes if note.startswith("a texture's")] == expected


@pytest.mark.parametrize(("size", "odd"), [(0.04, True), (0.15, False), (1.0, False), (6.0, False), (60.0, True)])
def test_a_glb_is_in_metres(tmp_path: Path, size: float, odd: bool) -> None:
    """The standard says so (glTF 2.0, 3.4); what a mesh of another format would be scaled to is kept."""
    path = glb(tmp_path / "a.glb", [{"mesh": 0, "scale": [size] * 3}])
    scene = load_mesh(path, placing=Placing(bare=True))
    extent = np.ptp(POINTS, axis=0).max() * size
    assert np.ptp(scene.surfaces[0].vertices, axis=0).max() == pytest.approx(extent, rel=1e-5)
    warnings = [note for note in scene.notes if note.startswith("warning")]
    expected = f"warning: glTF is in metres, but {extent:.4g} m is outside 0.05 to 50 m; --scale says otherwise"
    assert warnings == ([expected] if odd else [])
    with_scale = load_mesh(path, placing=Placing(bare=True, scale=0.5))
    assert np.ptp(with_scale.surfaces[0].vertices, axis=0).max() == pytest.approx(extent / 2, rel=1e-5)
    assert not any(note.startswith("warning") for note in with_scale.notes)


def test_a_model_too_large_for_a_floor_is_refused_by_the_files_name(tmp_path: Path) -> None:
    path = tmp_path / "planet.glb"
    trimesh.creation.box((1e6, 1e6, 1e6)).export(path)
    with pytest.raises(InputError, match=r"planet\.glb: largest extent of 1e\+06 m is beyond the 100000 m"):
        load_mesh(path)
    assert load_mesh(path, placing=Placing(scale=1e-6)).surfaces


@pytest.mark.parametrize(
    ("material", "albedo"),
    [
        ({"pbrMetallicRoughness": {"baseColorFactor": [0.003] * 3 + [1]}}, 0.003),
        ({"pbrMetallicRoughness": {"baseColorFactor": [0.5] * 3 + [1]}}, 0.5),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}, 0.2126),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1.5] * 3 + [1]}}, 1),
        ({"pbrMetallicRoughness": {}}, 1),
        ({"name": "0"}, 1),
    ],
)
def test_a_base_colour_is_what_its_material_states_and_white_by_default(
    tmp_path: Path, material: dict, albedo: float
) -> None:
    """It was rounded to 8 bits, and 0.6 where it was left out, as it is of white ones."""
    materials = [{"name": "0", "pbrMetallicRoughness": {"baseColorFactor": [0.1] * 3 + [1]}}, material]
    path = glb(tmp_path / "a.glb", [{"mesh": 0}], meshes=[mesh(material=1)], materials=materials)
    assert loaded(path).surfaces[0].material.albedo == pytest.approx(albedo, rel=1e-6)


@pytest.mark.parametrize("factor", [0.5, [0.5, 0.5], ["a", 0, 0, 1], [float("nan"), 0, 0, 1], None])
def test_a_base_colour_that_is_none_is_refused(tmp_path: Path, factor: object) -> None:
    materials = [{"pbrMetallicRoughness": {"baseColorFactor": factor}}]
    path = glb(tmp_path / "a.glb", [{"mesh": 0}], meshes=[mesh(material=0)], materials=materials)
    with pytest.raises(InputError, match=r"^.*baseColorFactor of material 0.*$"):
        loaded(path)
