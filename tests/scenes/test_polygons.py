"""Polygons of an .obj or .ply with dents: what is outside of them stays empty."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenes import Surface
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.mesh_formats.polygons import MAX_CORNERS, cut_polygon, without_dents
from scenes.placing import Placing
from tests.scenes.xml_files import load

ELL = np.array([(2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)], float)  # of area 3


def obj(outline: np.ndarray) -> str:
    """Write one polygon in the plane x + z = 0, whose texture coordinates are its corners in that plane."""
    points = "".join(f"v {x} {y} {-x}\nvt {x} {y}\n" for x, y in outline.tolist())
    return points + "f " + " ".join(f"{i}/{i}" for i in range(1, len(outline) + 1)) + "\n"


def area(surface: Surface) -> float:
    a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def enclosed(outline: np.ndarray) -> float:
    x, y = outline.T
    return float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("order", [1, -1])
def test_a_polygon_with_a_dent_keeps_its_area_and_coordinates(tmp_path: Path, first: int, order: int) -> None:
    """A fan from its first corner covered 4 in place of 3."""
    (tmp_path / "a.obj").write_text(obj(np.roll(ELL[::order], first, axis=0)))
    (surface,) = load_mesh(tmp_path / "a.obj", placing=Placing(scale=1, bare=True)).surfaces
    assert area(surface) == pytest.approx(3 * np.sqrt(2))
    assert np.ptp(surface.vertices[:, 0] - surface.uv[:, 0]) == pytest.approx(0, abs=1e-9)


APART = np.array([(5, 0), (6, 0), (5, 1)], float)  # a triangle of area 1/2


def ply(outline: np.ndarray, *, binary: bool, mixed: bool) -> bytes:
    """Write one polygon in the plane x + z = 0, with a normal at each corner, and a triangle beside it if `mixed`."""
    points = np.concatenate((outline, APART)) if mixed else outline
    faces = [[*range(len(outline))], [*range(len(outline), len(points))]][: 1 + mixed]
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    kind = "binary_little_endian" if binary else "ascii"
    header = f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n{names}element face {len(faces)}\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    rows = np.column_stack((points, -points[:, 0], np.tile((0.6, 0, 0.8), (len(points), 1)))).astype("<f4")
    if binary:
        lists = [bytes([len(face)]) + np.array(face, "<i4").tobytes() for face in faces]
        return header.encode() + rows.tobytes() + b"".join(lists)
    lines = [" ".join(map(str, row)) for row in [*rows.tolist(), *([len(face), *face] for face in faces)]]
    return (header + "\n".join(lines) + "\n").encode()


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("binary", "mixed"), [(True, False), (False, False), (False, True)])
def test_a_polygon_of_a_ply_with_a_dent_keeps_its_area_and_normals(
    tmp_path: Path, first: int, order: int, binary: bool, mixed: bool
) -> None:
    outline = np.roll(ELL[::order], first, axis=0)
    (tmp_path / "a.ply").write_bytes(ply(outline, binary=binary, mixed=mixed))
    (surface,) = load_mesh(tmp_path / "a.ply", placing=Placing(scale=1, bare=True)).surfaces
    assert area(surface) == pytest.approx((3.5 if mixed else 3) * np.sqrt(2), rel=1e-5)
    assert surface.normals is not None
    np.testing.assert_allclose(surface.normals, np.tile((0.6, 0, 0.8), (len(surface.vertices), 1)), atol=1e-6)


def test_stars_of_any_shape_are_cut_into_triangles_of_one_sense() -> None:
    rng = np.random.default_rng(3)
    for corners in range(4, 24):
        angle = 2 * np.pi * (np.arange(corners) + 0.4 * rng.random(corners)) / corners
        outline = rng.uniform(0.2, 1, corners)[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
        outline = np.insert(outline, 1, outline[:2].mean(axis=0), axis=0)  # on a straight side
        found = cut_polygon(np.column_stack((outline, np.zeros(len(outline)))))
        sides = np.array([outline[[*one]] for one in found])
        turns = np.linalg.det(sides[:, 1:] - sides[:, :1])
        assert (turns > 0).all() and turns.sum() / 2 == pytest.approx(enclosed(outline))


@pytest.mark.parametrize(
    "text",
    [
        obj(np.roll(ELL[:, ::-1], 1, axis=0)[[0, 1, 2, 5]]),  # without a dent
        obj(np.array([(0, 0), (1, 1), (1, 0), (0, 1)], float)),  # crosses itself
        obj(np.tile(ELL, (MAX_CORNERS // 6 + 1, 1))),
        "v 0 0 0\nv 1 0 0\nf 1 2 9 1\n",
        "v 0 0 zero\nv 1 0 0\nf 1 2 2 1\n",
    ],
)
def test_what_a_fan_cuts_rightly_or_nothing_does_stays_as_it_is(text: str) -> None:
    assert without_dents(text.encode()) == text.encode()


def test_the_obj_of_a_mitsuba_scene_is_a_fan_as_in_mitsuba(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(obj(ELL))
    (surface,) = load(tmp_path, '<shape type="obj"><string name="filename" value="a.obj"/></shape>').surfaces
    assert len(surface.faces) == len(ELL) - 2
