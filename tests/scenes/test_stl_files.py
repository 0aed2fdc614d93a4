"""STL files as programs write them: words before and behind the solid, headers of binary files, colours per face."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from scenes import InputError, Scene
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.placing import Placing

FACES = np.array((((0, 0, 0), (1, 0, 0), (1, 1, 0)), ((0, 0, 0), (1, 1, 0), (0, 1, 0))), "<f4")
FLAG = 0x8000


def text(name: str = "a") -> str:
    loops = ["\n".join(f"vertex {x:g} {y:g} {z:g}" for x, y, z in face) for face in FACES]
    faces = "".join(f"facet normal 0 0 1\nouter loop\n{loop}\nendloop\nendfacet\n" for loop in loops)
    return f"solid {name}\n{faces}endsolid {name}\n"


def binary(header: bytes = b"", attributes: tuple[int, ...] = (0, 0)) -> bytes:
    rows = [bytes(12) + face.tobytes() + struct.pack("<H", one) for face, one in zip(FACES, attributes, strict=False)]
    return header.ljust(80)[:80] + struct.pack("<I", len(rows)) + b"".join(rows)


def loaded(path: Path, content: bytes) -> Scene:
    (path / "a.stl").write_bytes(content)
    return load_mesh(path / "a.stl", placing=Placing(scale=1, bare=True))


def refusal(path: Path, content: bytes) -> str:
    with pytest.raises(InputError) as caught:
        loaded(path, content)
    return str(caught.value)


@pytest.mark.parametrize("content", ["# by a program\n" + text(), "x" * 5000 + "\n" + text(), text("n" * 5000), text()])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_words_around_a_text_change_nothing(tmp_path: Path, content: str, end: str) -> None:
    assert loaded(tmp_path, content.replace("\n", end).encode()).triangles == 2


@pytest.mark.parametrize("header", [b"solid by a program", b"solid with facet normal and vertex"])
def test_a_binary_file_may_begin_as_a_text(tmp_path: Path, header: bytes) -> None:
    assert loaded(tmp_path, binary(header)).triangles == 2
    assert "its header says 2 triangles in 184 bytes, it has 174" in refusal(tmp_path, binary(header)[:-10])


@pytest.mark.parametrize("content", [text()[8:].encode(), b"<html>not found</html>" * 9, bytes(83)])
def test_what_is_no_stl_is_refused_as_such(tmp_path: Path, content: bytes) -> None:
    """A text was said to be cut short, by a number of triangles that its letters made."""
    assert "is no STL" in refusal(tmp_path, content)


@pytest.mark.parametrize("content", [b"solid a\nendsolid a\n", binary(attributes=()), binary(b"solid", ())])
def test_a_file_without_faces_is_refused(tmp_path: Path, content: bytes) -> None:
    assert "empty, no mesh in it" in refusal(tmp_path, content)


def test_colours_of_some_faces_are_noted(tmp_path: Path) -> None:
    for attributes, note in (((FLAG | 31, 0), "its colours of some faces are left out"), ((0, 0), "no colour in the")):
        scene = loaded(tmp_path, binary(attributes=attributes))
        assert scene.surfaces[0].material.albedo == 0.6
        assert any(f"a: {note}" in one for one in scene.notes)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("vertex 1 1 0", "vertex 1 one 0", "line 7: 'vertex 1 one 0', expected vertex and three numbers"),
        ("vertex 1 0 0", "vertex 1 0", "line 6: 'vertex 1 0', expected"),
        ("vertex 0 1 0", "VERTEX 0 1 0 2", "line 14: 'vertex 0 1 0 2', expected"),
    ],
)
def test_a_vertex_that_is_no_point_is_refused_with_its_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    """The line is that of the file, words before the solid counted in."""
    assert said in refusal(tmp_path, ("written by hand\n" + text().replace(old, new, 1)).encode())


def test_numbers_of_a_text_may_be_written_in_any_way(tmp_path: Path) -> None:
    content = text().replace("vertex 1 1 0", "vertex +1.0E+0 .1e1 -0.")
    corners = loaded(tmp_path, content.encode()).surfaces[0]
    assert len(corners.faces) == 2
