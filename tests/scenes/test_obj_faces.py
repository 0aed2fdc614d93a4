"""Faces of an .obj with and without texture coordinates and normals side by side: each keeps what it has."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from xml_files import load

from scenes import Surface
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.placing import Placing

AS_FILE = Placing(scale=1, bare=True)
RNG = np.random.default_rng(5)
POINTS = RNG.random((12, 3)).round(3)
UV = RNG.random((7, 2)).round(3)
NORMALS = (RNG.random((5, 3)) + 0.1).round(3)
FORMS = ("{}", "{}/{}", "{}//{}", "{}/{}/{}")
VALUES = "".join(
    f"{key} {' '.join(map(str, row))}\n" for key, rows in (("v", POINTS), ("vt", UV), ("vn", NORMALS)) for row in rows
)
# Mitsuba keeps one variant a process.
ORACLE = """
import json, sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
read = mi.traverse(mi.load_dict({"type": "obj", "filename": sys.argv[1]}))
keys = "vertex_positions", "vertex_texcoords", "vertex_normals", "faces"
print(json.dumps([[float(one) if key != "faces" else int(one) for one in read[key]] for key in keys]))
"""
Corner = tuple[int, int | None, int | None]
Rows = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]


def random_faces(count: int, seed: int) -> tuple[list[str], list[list[Corner]]]:
    """Make faces of different points in all four forms: their lines, and the numbers in these."""
    rng = np.random.default_rng(seed)
    triples = {tuple(sorted(rng.choice(12, 3, replace=False).tolist())) for _ in range(4 * count)}
    lines, faces = [], []
    for number, triple in enumerate(sorted(triples)[:count]):
        form = number % 4 if number < 4 else int(rng.integers(4))
        face: list[Corner] = []
        for vertex in triple:
            texture = int(rng.integers(7)) if form in (1, 3) else None
            normal = int(rng.integers(5)) if form in (2, 3) else None
            face.append((vertex, texture, normal))
        words = [FORMS[form].format(*(one + 1 for one in corner if one is not None)) for corner in face]
        lines.append("f " + " ".join(words))
        faces.append(face)
    return lines, faces


def corners(surface: Surface) -> list[Rows]:
    """Return for each face of a surface its points, uv and normals."""
    return [
        (
            surface.vertices[face],
            None if surface.uv is None else surface.uv[face],
            None if surface.normals is None else surface.normals[face],
        )
        for face in surface.faces
    ]


def stated(face: list[Corner]) -> Rows:
    vertices, textures, normals = (list(one) for one in zip(*face, strict=True))
    directions = None if None in normals else NORMALS[normals]
    if directions is not None:
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return POINTS[vertices], None if None in textures else UV[textures], directions


def settled(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return points - ((low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2)


def close(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b if a is None or b is None else np.allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("materials", [0, 1, 3])
def test_each_face_keeps_its_texture_coordinates_and_normals(tmp_path: Path, materials: int) -> None:
    """Whatever the others of its material have, and in whatever groups of the file they are."""
    lines, faces = random_faces(40, seed=materials)
    if materials:
        (tmp_path / "a.mtl").write_text("".join(f"newmtl m{i}\nKd 0.{i + 1} 0 0\n" for i in range(materials)))
        for at in range(0, 40, 6):
            lines[at] = f"usemtl m{at // 6 % materials}\n{lines[at]}"
    text = "mtllib a.mtl\n" * bool(materials) + VALUES + "g one\n" + "\n".join([*lines[:20], "g two", *lines[20:]])
    (tmp_path / "a.obj").write_text(text + "\n")
    scene = load_mesh(tmp_path / "a.obj", placing=AS_FILE)
    found = [corner for surface in scene.surfaces for corner in corners(surface)]
    used = POINTS[[corner[0] for face in faces for corner in face]]
    low, high = used.min(axis=0), used.max(axis=0)
    assert len(found) == len(faces)
    for face in faces:
        points, uv, normals = stated(face)
        points = settled(points, low, high)
        assert sum(close(points, one) and close(uv, two) and close(normals, three) for one, two, three in found) == 1
    albedos = {round(float(surface.material.albedo), 6) for surface in scene.surfaces}
    assert len(albedos) == max(materials, 1)


def test_a_texture_is_left_out_where_it_has_no_coordinates_alone(tmp_path: Path) -> None:
    from PIL import Image

    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text("newmtl cloth\nmap_Kd t.png\n")
    lines = "mtllib a.mtl\nusemtl cloth\nf 1/1 2/2 3/3\nf 4/4 5/5 6/6\nf 7 8 9\n"
    (tmp_path / "a.obj").write_text(VALUES + lines)
    scene = load_mesh(tmp_path / "a.obj", placing=AS_FILE)
    assert {one.name: (len(one.faces), one.uv is not None) for one in scene.surfaces} == {
        "a.obj": (2, True),
        "faces without vt": (1, False),
    }
    assert "faces without vt: its texture is left out, it has no texture coordinates" in scene.notes


def test_a_corner_without_what_others_of_its_face_have_takes_it_from_these_too(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(VALUES + "f 1/1/1 2/2 3\nf 4/1 5//2 6/3/1\n")
    surface = load_mesh(tmp_path / "a.obj", placing=AS_FILE).surfaces[0]
    assert len(surface.faces) == 2
    assert surface.uv is None and surface.normals is None


def test_faces_of_materials_that_are_alike_in_each_make_no_groups(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 1 1\nnewmtl b\nKd 0 0 0\n")
    lines = "mtllib a.mtl\ng x\nusemtl a\nf 1/1 2/2 3/3\ng y\nf 1/1 3/3 4/4\nusemtl b\nf 7 8 9\nf 8 9 10\n"
    (tmp_path / "a.obj").write_text(VALUES + lines)
    scene = load_mesh(tmp_path / "a.obj", placing=AS_FILE)
    assert {one.name: len(one.faces) for one in scene.surfaces} == {"a": 2, "b": 2}


def test_mitsubas_obj_keeps_what_faces_have(tmp_path: Path) -> None:
    """One surface has all faces; what Mitsuba leaves to chance is (0, 0), or the face's own normal, and noted."""
    lines, faces = random_faces(40, seed=9)
    (tmp_path / "a.obj").write_text(VALUES + "usemtl a\n" + "\n".join(lines) + "\n")
    flags = '<boolean name="flip_tex_coords" value="false"/>'
    scene = load(tmp_path, f'<shape type="obj"><string name="filename" value="a.obj"/>{flags}</shape>')
    found = corners(scene.surfaces[0])
    assert len(found) == len(faces)
    for face in faces:
        points, uv, normals = stated(face)
        a, b, c = points
        flat = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        uv = np.zeros((3, 2)) if uv is None else uv
        normals = np.array([flat] * 3) if normals is None else normals
        mirrored = uv * (1, -1) + (0, 1)
        assert sum(close(points, x) and close(mirrored, y) and close(normals, z) for x, y, z in found) == 1
    without = [sum(any(corner[place] is None for corner in face) for face in faces) for place in (1, 2)]
    assert any(f"{without[0]} of 40 faces have no texture coordinates" in note for note in scene.notes)
    assert any(f"{without[1]} of 40 faces have no vertex normals" in note for note in scene.notes)


def test_mitsubas_faces_with_texture_coordinates_and_normals_are_its_own(tmp_path: Path) -> None:
    """Mitsuba gives these faces the same points, uv and normals; the others' values there are not initialized."""
    lines, faces = random_faces(24, seed=3)
    (tmp_path / "a.obj").write_text(VALUES + "\n".join(lines) + "\n")
    scene = load(tmp_path, '<shape type="obj"><string name="filename" value="a.obj"/></shape>')
    answer = subprocess.run([sys.executable, "-c", ORACLE, str(tmp_path / "a.obj")], capture_output=True, check=True)
    read = json.loads(answer.stdout)
    points, uv, normals, indices = (
        np.array(one).reshape(-1, width) for one, width in zip(read, (3, 2, 3, 3), strict=True)
    )
    found = corners(scene.surfaces[0])
    whole = [number for number, face in enumerate(faces) if all(None not in corner for corner in face)]
    assert whole
    for number in whole:
        at = indices[number]
        lengths = np.linalg.norm(normals[at], axis=1, keepdims=True)
        expected = points[at], uv[at] * (1, -1) + (0, 1), normals[at] / lengths
        matches = [all(close(a, b) for a, b in zip(expected, one, strict=True)) for one in found]
        assert sum(matches) == 1


def test_lines_may_end_by_carriage_returns(tmp_path: Path) -> None:
    """As programs of old wrote them, also behind a line that goes on and in the names of materials."""
    (tmp_path / "a.mtl").write_text("newmtl cloth\nKd 0.5 0.5 0.5\n")
    text = "# units: m\nmtllib a.mtl\n" + VALUES + "usemtl cloth\nf 1/1 2/2 \\\n3/3\nusemtl other\nf 4 5 6\n# foot\n"
    found = []
    for end in ("\n", "\r\n", "\r"):
        (tmp_path / "a.obj").write_bytes(text.replace("\n", end).encode())
        found.append(load_mesh(tmp_path / "a.obj", placing=Placing(bare=True)))
    assert all(one.digest() == found[0].digest() and one.notes == found[0].notes for one in found)
    assert "usemtl names what no material file defines: other" in found[0].notes
    assert any("unit 'm' taken" in note for note in found[0].notes)
