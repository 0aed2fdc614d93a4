"""Colours and materials of mesh files as programs write them: none is lost without a word, none is another."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from scenes import Scene
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.textures import luminance, srgb_to_linear
from scenes.placing import Placing

CORNERS = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
FACE = "f 1 2 3 4\n"
MAPPED = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1 4/4/1\n"


def written(path: Path, content: str | bytes) -> Scene:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_mesh(path, placing=Placing(scale=1, bare=True))


def albedo(scene: Scene) -> float:
    (surface,) = scene.surfaces
    assert isinstance(surface.material.albedo, float)
    return surface.material.albedo


def coloured(colour: str) -> str:
    return "".join(f"v {corner} {colour}\n" for corner in CORNERS)


SHARES = float(luminance(srgb_to_linear(np.array((1.0, 0.5, 0.25)))))


@pytest.mark.parametrize("colour", ["1 0.5 0.25", "1.0 0.5 0.25 1.0", "255 127.5 63.75"])
@pytest.mark.parametrize("face", [FACE, MAPPED, "usemtl none\n" + MAPPED])
def test_colours_per_vertex_of_an_obj_count_in_any_levels_and_beside_coordinates(
    tmp_path: Path, colour: str, face: str
) -> None:
    """Levels up to 255 had made it white, and texture coordinates without a texture had taken its colours."""
    scene = written(tmp_path / "a.obj", coloured(colour) + face)
    assert albedo(scene) == pytest.approx(SHARES, abs=4e-3)
    assert (scene.surfaces[0].normals is not None) == (face != FACE)


@pytest.mark.parametrize("library", ["newmtl a\nKd 0.5 0.5 0.5\n", "newmtl a\nKd 1 1 1\nmap_Kd t.png\n"])
def test_colours_per_vertex_that_are_not_taken_are_noted(tmp_path: Path, library: str) -> None:
    Image.new("RGB", (2, 2)).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text(library)
    lines = coloured("1 0 0") + "usemtl a\n" + MAPPED
    assert "a: its colours per vertex are left out" in written(tmp_path / "a.obj", "mtllib a.mtl\n" + lines).notes
    some = coloured("1 0 0").replace("0 1 0 1 0 0", "0 1 0") + FACE
    notes = written(tmp_path / "a.obj", some).notes
    assert notes[-2:] == ("a: its colours per vertex are left out", "a: no other colour in the file, albedo 0.6")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("behind", ["", " # 1 0 0"])
def test_without_colours_per_vertex_none_is_left_out(tmp_path: Path, end: str, behind: str) -> None:
    notes = written(tmp_path / "a.obj", (coloured(behind) + FACE).replace("\n", end)).notes
    assert notes[-1] == "a: no colour in the file, albedo 0.6" and not any("left out" in note for note in notes)


@pytest.mark.parametrize("comment", ["#usemtl b", "# usemtl b", "  # no usemtl b"])
def test_a_material_in_a_comment_is_none(tmp_path: Path, comment: str) -> None:
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 0.25 0.25 0.25\nnewmtl b\nKd 1 1 1\n")
    text = f"mtllib a.mtl\n{coloured('')}usemtl a\nf 1 2 3\n{comment}\nf 1 3 4\n"
    assert albedo(written(tmp_path / "a.obj", text)) == pytest.approx(0.25)


def stl(header: bytes, attributes: list[int]) -> bytes:
    """Write a box whose triangles have these two bytes."""
    box = trimesh.creation.box()
    rows = [
        np.concatenate((normal, corners.ravel())).astype("<f4").tobytes() + struct.pack("<H", attribute)
        for normal, corners, attribute in zip(box.face_normals, box.triangles, attributes, strict=True)
    ]
    return header.ljust(80, b" ") + struct.pack("<I", len(rows)) + b"".join(rows)


RED, BLUE = (float(luminance(np.eye(3)[channel])) for channel in (0, 2))


@pytest.mark.parametrize(
    ("header", "attributes", "expected"),
    [
        (b"COLOR=\xff\0\0\xff,MATERIAL=", [0x7C00] * 12, BLUE),
        (b"COLOR=\xff\0\0\xff", [0x8000] * 12, RED),
        (b"exported COLOR=\xff\0\0\xff", [0] * 12, RED),
        (b"COLOR=\xff\0\0\xff", [0x8000] * 6 + [0x7C00] * 6, (RED + BLUE) / 2),
        (b"solid of another program", [0xFC00] * 12, RED),
        (b"", [0x801F] * 12, BLUE),
        (b"", [0] * 12, None),
        (b"", [0x801F] * 11 + [0], None),
    ],
)
def test_colours_of_a_binary_stl_count_as_either_program_writes_them(
    tmp_path: Path, header: bytes, attributes: list[int], expected: float | None
) -> None:
    scene = written(tmp_path / "a.stl", stl(header, attributes))
    assert albedo(scene) == pytest.approx(0.6 if expected is None else expected)
    without = "colours of some faces are left out" if any(attributes) else "no colour in the file"
    assert any(without in note for note in scene.notes) == (expected is None)


@pytest.mark.parametrize("level", [0.001, 0.5])
def test_dark_colours_of_a_glb_are_not_rounded(tmp_path: Path, level: float) -> None:
    """Without a material they had 8 bits: 0.001 was black."""
    mesh = trimesh.creation.box()
    mesh.vertex_attributes["COLOR_0"] = np.full((8, 3), level, np.float32)
    content = mesh.export(file_type="glb").replace(b'"_COLOR_0"', b'"COLOR_0" ')
    assert b'"COLOR_0"' in content
    assert albedo(written(tmp_path / "a.glb", content)) == pytest.approx(level, rel=1e-6)
