"""Lines of an .obj and its .mtl as programs and editors write them: keywords, weights, comments, marks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from glb_files import RAMP, png, written

from scenes import InputError, Scene
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.mesh_formats.obj import plain_colours
from scenes.io.textures import luminance, srgb_to_linear
from scenes.model import Texture
from scenes.placing import Placing

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
MAPPED = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"


def loaded(path: Path, text: str | bytes) -> Scene:
    return load_mesh(written(path / "a.obj", text), placing=Placing(scale=1, bare=True))


def test_keywords_may_have_capitals(tmp_path: Path) -> None:
    """A file of capitals was refused as empty; its material and coordinates were lost where vertices had none."""
    written(tmp_path / "a.mtl", "NEWMTL Oak\nKD 0.5 0.5 0.5\n")
    text = f"mtllib a.mtl\n{SQUARE}usemtl Oak\n{MAPPED}"
    for keys in ({"mtllib", "usemtl", "vt"}, {"mtllib", "usemtl", "v", "vt", "f"}):
        lines = [line.split(" ", 1) for line in text.splitlines()]
        lines = [[key.upper() if key in keys else key, rest] for key, rest in lines]
        (surface,) = loaded(tmp_path, "\n".join(map(" ".join, lines))).surfaces
        assert len(surface.faces) == 2 and surface.uv is not None
        assert surface.material.albedo == pytest.approx(0.5)


@pytest.mark.parametrize(("before", "behind"), [("", ""), ("1.0 ", ""), ("", " 1"), ("", " 0.5")])
def test_colours_stand_behind_a_weight_or_before_an_alpha(tmp_path: Path, before: str, behind: str) -> None:
    """The seven numbers x y z 1 r g b had the colour 1 r g."""
    text = SQUARE.replace(" 0\n", f" 0 {before}0.25 0.5 0.75{behind}\n") + "f 1 2 3 4\n"
    expected = float(luminance(srgb_to_linear(np.array((0.25, 0.5, 0.75)))))
    (surface,) = loaded(tmp_path, text).surfaces
    assert surface.material.albedo == pytest.approx(expected, abs=3e-3)  # of 8 bits


def test_a_weight_of_its_own_changes_nothing(tmp_path: Path) -> None:
    (surface,) = loaded(tmp_path, SQUARE.replace(" 0\n", " 0 1\n") + "f 1 2 3 4\n").surfaces
    assert len(surface.faces) == 2 and surface.material.albedo == 0.6


def test_faces_may_stand_before_their_vertices_but_cannot_count_back_there(tmp_path: Path) -> None:
    """Counted back from the end of the file, as Python does, such a face was a wrong one."""
    assert loaded(tmp_path, f"f 1 2 3 4\n{SQUARE}").triangles == 2
    with pytest.raises(InputError, match="line 1: a face's index -1, 0 are there to count back"):
        loaded(tmp_path, f"f -1 -2 -3\n{SQUARE}")


@pytest.mark.parametrize("used", ["oak # of the door", "oak"])
@pytest.mark.parametrize("library", ["my own.mtl", "my own.mtl # ours", "./my own.mtl"])
def test_comments_behind_names_are_none_of_theirs(tmp_path: Path, used: str, library: str) -> None:
    written(tmp_path / "my own.mtl", "newmtl oak\nKd 0.5 0.5 0.5\nnewmtl oak #2\nKd 0.25 0.25 0.25\n")
    text = f"mtllib {library}\n{SQUARE}usemtl {used}\nf 1 2 3\nusemtl oak #2\nf 1 3 4\n".replace("\n", "\r\n")
    scene = loaded(tmp_path, text)
    assert sorted(surface.material.albedo for surface in scene.surfaces) == pytest.approx([0.25, 0.5])
    assert not any("material" in note for note in scene.notes)


@pytest.mark.parametrize("option", ["-bm 0.2", "-clamp on", "-s 1 1 1 -mm 0 1"])
def test_a_texture_with_blanks_in_its_name_follows_options(tmp_path: Path, option: str) -> None:
    written(tmp_path / "my oak.png", png(RAMP))
    written(tmp_path / "a.mtl", f"newmtl a\nmap_Kd {option} my oak.png\n")
    (surface,) = loaded(tmp_path, f"mtllib a.mtl\n{SQUARE}usemtl a\n{MAPPED}").surfaces
    assert isinstance(surface.material.albedo, Texture)


def test_text_of_16_bits_is_refused_by_its_encoding(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="UTF-16"):
        loaded(tmp_path, f"{SQUARE}f 1 2 3 4\n".encode("utf-16"))
    assert loaded(tmp_path, f"{SQUARE}f 1 2 3 4\n".encode("utf-8-sig")).triangles == 2


def test_coordinates_beside_colours_go_from_corners_of_every_form() -> None:
    head = b"vt 0 0\nvn 0 0 1\nv 0 0 0 255 0 51\n"
    faces = b"f 1/1 2/2 3/3\nf 1/1/1 2/12/2 3/3/3\nf 1//1 2//2 3//3\nf 1 2 3\nf 1/1/ 2/2/ 3/3/\nf 1// 2// 3//"
    expected = b"f 1 2 3\nf 1//1 2//2 3//3\nf 1//1 2//2 3//3\nf 1 2 3\nf 1 2 3\nf 1 2 3"
    made = plain_colours(head + faces, textured=False)
    assert made == head.replace(b"255 0 51", b"1 0 0.2") + expected
