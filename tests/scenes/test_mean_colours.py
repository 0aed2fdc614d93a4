"""The one albedo of a painted mesh is the mean over its area, however fine the triangles of each colour are."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scenes.io.mesh_formats.meshes import load_mesh
from scenes.placing import Placing

WHITE, BLACK = (255, 255, 255, 255), (0, 0, 0, 255)


def painted() -> trimesh.Trimesh:
    """A white square and a black one of a third of its area, in 2 and in 128 triangles that share no vertex with it."""
    white = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)], process=False)
    black = white.copy()
    black.apply_scale((1 / 3, 1, 1))
    black.apply_translation((2, 0, 0))
    for _ in range(3):
        black = black.subdivide()
    mesh = trimesh.util.concatenate([white, black])
    mesh.visual.vertex_colors = np.array([WHITE] * 4 + [BLACK] * (len(mesh.vertices) - 4), np.uint8)
    return mesh


def albedo_of(path: Path) -> float:
    (surface,) = load_mesh(path, placing=Placing(scale=1, bare=True)).surfaces
    assert isinstance(surface.material.albedo, float)
    return surface.material.albedo


@pytest.mark.parametrize("kind", ["ply", "glb", "obj"])
def test_colours_per_vertex_count_by_the_area_around_them(tmp_path: Path, kind: str) -> None:
    painted().export(tmp_path / f"mesh.{kind}")
    assert albedo_of(tmp_path / f"mesh.{kind}") == pytest.approx(0.75, abs=1e-6)


def test_colours_per_face_count_by_the_area_of_the_face(tmp_path: Path) -> None:
    mesh = painted()
    mesh.visual = trimesh.visual.ColorVisuals(
        mesh, face_colors=np.array([WHITE] * 2 + [BLACK] * (len(mesh.faces) - 2), np.uint8)
    )
    mesh.export(tmp_path / "mesh.ply")
    assert albedo_of(tmp_path / "mesh.ply") == pytest.approx(0.75, abs=1e-6)


def test_colours_of_points_without_a_face_do_not_count(tmp_path: Path) -> None:
    lines = ["v 0 0 0 1 1 1", "v 1 0 0 1 1 1", "v 0 1 0 1 1 1", *(f"v {x} 5 5 0 0 0" for x in range(30)), "f 1 2 3"]
    (tmp_path / "mesh.obj").write_text("\n".join(lines) + "\n")
    assert albedo_of(tmp_path / "mesh.obj") == pytest.approx(1.0, abs=1e-6)
