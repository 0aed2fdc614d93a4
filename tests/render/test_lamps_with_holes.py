"""A lamp with holes painted in it, by an opacity, shines as one whose mesh has them."""

import numpy as np
import pytest

from render.ambient.integrator import ambient_light
from render.scene.traced_scene import TracedScene
from scenes.geometry.shapes import box, rectangle
from scenes.model import Camera, Material, Scene, Surface, Texture

THERE = np.array([[1, 0, 1], [0, 0, 1], [1, 1, 0]])  # row 0 on top
TEXTURE = Texture(np.kron(THERE, np.ones((100, 100))), "holes")


def painted(material: Material) -> Surface:
    """Make a square lamp of 2 m, before z = 0, with its holes by opacity."""
    vertices, faces, uv = rectangle()
    return Surface(vertices, faces, material, uv=uv, emission=2.0)


def cut() -> Surface:
    """Make the same with its holes in its mesh."""
    vertices, faces, _ = rectangle()
    squares = [(vertices + (2 * column - 2, 2 - 2 * row, 0)) / 3 for row, column in np.argwhere(THERE)]
    corners = np.concatenate([faces + 4 * number for number in range(len(squares))])
    return Surface(np.concatenate(squares), corners, Material(albedo=0.5), emission=2.0)


def room(lamp: Surface, things: tuple[Surface, ...]) -> Scene:
    vertices, faces, _ = box((4, 4, 5))
    walls = Surface(vertices + (0, 0, 1.5), faces[:, ::-1], Material(albedo=0.4))
    camera = Camera.look_at((0.4, 1.2, 3.5), (0, -0.3, 0), fov_deg=70, width=8, height=6)
    return Scene("lamp", (walls, lamp, *things), camera)


def mirror() -> Surface:
    """Make a mirror beside the lamp, which throws its light on the floor."""
    vertices, faces, _ = rectangle()
    return Surface(vertices[:, [2, 1, 0]] * (1, 1, 0.8) + (1.6, 0, 1.2), faces, Material("conductor"))


def means(scene: Scene) -> np.ndarray:
    return np.array([ambient_light(TracedScene(scene), 256, 8, seed).radiance.mean() for seed in range(6)])


@pytest.mark.parametrize("mirrors", [False, True], ids=["alone", "beside a mirror"])
def test_painted_holes_of_a_lamp_are_as_dark_as_cut_ones(mirrors: bool) -> None:
    things = (mirror(),) if mirrors else ()
    of_opacity = means(room(painted(Material(albedo=0.5, opacity=TEXTURE)), things))
    of_mesh = means(room(cut(), things))
    error = np.sqrt((of_opacity.var(ddof=1) + of_mesh.var(ddof=1)) / 6)
    assert abs(of_opacity.mean() - of_mesh.mean()) < 5 * error + 2e-3 * of_mesh.mean() and error < 0.01 * of_mesh.mean()


def test_a_lamp_that_is_all_hole_gives_no_light() -> None:
    assert not means(room(painted(Material(opacity=0.0)), ())).any()
