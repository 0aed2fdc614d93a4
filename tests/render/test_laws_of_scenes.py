"""Change what no render may depend on: things far away and unlit, place, side, size and triangles of a scene, and
which of laser and camera is where."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from render.engine import render
from render.settings import RenderSettings
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere
from scenes.placing import scaled

LASERS = {"flash": Laser(), "lamp aside": Laser(cone_deg=360, baseline_m=(0.5, 0.1, 0))}
# One scene for several kinds, as compiling takes longest: a kind that changes anything changes what is beside it, too.
FAR = {
    "opaque": [Material(kind) for kind in ("roughdiffuse", "conductor")],
    "of the room": [Material(kind) for kind in ("plastic", "roughplastic", "roughconductor", "thindielectric")],
    "glass": [Material("dielectric")],
    "cut-out": [Material(opacity=0.0)],
}
SETTINGS = RenderSettings(bounces=4, spp=64, grid=8, refraction="straight")
SAME_PATHS = 1e-3  # of sums whose random numbers are the same


def body(size: tuple[float, float, float], at: tuple[float, float, float], material: Material) -> Surface:
    vertices, faces, uv = box(size)
    return Surface(vertices + np.array(at), faces, material, uv=uv)


def room(laser: Laser) -> Scene:
    """A varnished room with a ball of rough metal, lacquer, and a pane of glass before half of the view."""
    vertices, faces, uv = box((4, 3, 5))
    varnished = Material("roughplastic", albedo=0.5, roughness=0.3)
    walls = Surface(vertices + [0, 0, -1.5], faces[:, ::-1], varnished, uv=uv)
    vertices, faces, _ = sphere(0.4, 3)
    ball = Surface(vertices + [0.4, -0.2, -1.6], faces, Material("roughconductor", roughness=0.3, specular=0.8))
    cube = body((0.6, 0.8, 0.6), (-0.7, -1.1, -2.2), Material("plastic", albedo=0.4))
    pane = body((1.2, 1.2, 0.004), (0.3, 0.2, -0.9), Material("thindielectric"))
    view = Camera.look_at((0, 0, 0.6), (0, 0, -1), fov_deg=60, width=12, height=12)
    return Scene("room", (walls, ball, cube, pane), view, laser)


def sums(scene: Scene, seeds: int = 1) -> np.ndarray:
    """Direct and indirect radiance of all pixels, a row for each seed."""
    rows = []
    for seed in range(seeds):
        rendered = render(scene, SETTINGS, seed=seed)
        direct = rendered.bounces == 1
        rows.append([rendered.radiance[chosen].sum(dtype=np.float64) for chosen in (direct, ~direct)])
    return np.array(rows)


@pytest.fixture(scope="module", params=LASERS)
def lit(request: pytest.FixtureRequest) -> tuple[Scene, np.ndarray]:
    """The room under a laser, and its sums by four seeds."""
    scene = room(LASERS[request.param])
    return scene, sums(scene, 4)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", FAR)
def test_things_behind_the_camera_outside_the_room_change_nothing(lit: tuple[Scene, np.ndarray], kinds: str) -> None:
    scene, found = lit
    things = [body((1, 1, 1), (3 * number, 0, 60), material) for number, material in enumerate(FAR[kinds])]
    farther = replace(scene, surfaces=(*scene.surfaces, *things))
    np.testing.assert_allclose(sums(farther)[0], found[0], rtol=SAME_PATHS)


def turned(scene: Scene) -> Scene:
    """The scene turned about an oblique axis, and moved."""
    x, y, z = np.array([1, 2, -0.5]) / np.linalg.norm([1, 2, -0.5])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation, offset = np.eye(3) + np.sin(0.9) * cross + (1 - np.cos(0.9)) * cross @ cross, np.array([10.0, -4, 7])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation @ scene.camera.rotation, rotation @ scene.camera.origin + offset
    surfaces = tuple(replace(one, vertices=one.vertices @ rotation.T + offset) for one in scene.surfaces)
    return replace(scene, surfaces=surfaces, camera=replace(scene.camera, pose=pose))


def mirrored(scene: Scene) -> Scene:
    """The scene's image in the plane x = 0, in which the camera stands."""
    right, down, forward = scene.laser.baseline_m
    surfaces = tuple(
        replace(one, vertices=one.vertices * (-1, 1, 1), faces=one.faces[:, ::-1]) for one in scene.surfaces
    )
    return replace(scene, surfaces=surfaces, laser=replace(scene.laser, baseline_m=(-right, down, forward)))


def divided(scene: Scene) -> Scene:
    """The scene with every triangle cut in three."""
    surfaces = []
    for one in scene.surfaces:
        middles = np.arange(len(one.faces)) + len(one.vertices)
        corners = one.faces.T
        faces = np.concatenate([np.stack((corners[k], corners[k - 2], middles), axis=1) for k in range(3)])
        vertices = np.concatenate((one.vertices, one.vertices[one.faces].mean(axis=1)))
        surfaces.append(replace(one, vertices=vertices, faces=faces, uv=None))
    return replace(scene, surfaces=tuple(surfaces))


@pytest.mark.slow
@pytest.mark.parametrize("change", [turned, mirrored, divided])
def test_place_side_and_triangles_do_not_matter(
    lit: tuple[Scene, np.ndarray], change: Callable[[Scene], Scene]
) -> None:
    scene, found = lit
    other = sums(change(scene), 4)
    error = np.sqrt((found.var(axis=0, ddof=1) + other.var(axis=0, ddof=1)) / 4)
    # of four values a side: five standard errors, and what direct light's grid leaves
    assert (abs(other.mean(axis=0) - found.mean(axis=0)) < 5 * error + 2e-3 * found.mean(axis=0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.01, 10.0])
def test_radiance_falls_with_the_square_of_a_scenes_size(lit: tuple[Scene, np.ndarray], factor: float) -> None:
    scene, found = lit
    direct, indirect = sums(scaled(scene, factor))[0] * factor**2
    assert direct == pytest.approx(found[0, 0], rel=2e-3) and indirect == pytest.approx(found[0, 1], rel=SAME_PATHS)


@pytest.mark.slow
def test_laser_and_camera_may_change_places() -> None:
    """Helmholtz reciprocity: a narrow view of one wall of a groove, and a lamp as narrow on the other one.

    Both look the same way. The view is a square of the disk's area, small enough for that not to matter.
    """
    ends, field_deg = (np.array([-0.6, 0.05, 0.7]), np.array([0.5, -0.1, 0.4])), 2.0
    line = np.array([(-1.6, -0.4), (0, -1.2), (1.5, -0.2)])
    vertices = np.array([(x, y, z) for x, z in line for y in (-1, 1)], float)
    faces = np.array([(0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3)])
    groove = Surface(vertices, faces, Material(albedo=0.6))
    light = []
    for eye, lamp in (ends, ends[::-1]):
        view = Camera.look_at(eye, eye - [0, 0, 1], fov_deg=field_deg, width=4, height=4)
        laser = Laser(baseline_m=tuple(view.rotation.T @ (lamp - eye)), cone_deg=field_deg * 2 / np.sqrt(np.pi))
        scene = Scene("groove", (groove,), view, laser)
        light.append([render(scene, RenderSettings(bounces=4, spp=512, grid=2), seed=seed) for seed in range(3)])
    there, back = (np.array([one.total_radiance().sum() for one in ones]) for ones in light)
    error = np.sqrt((there.var(ddof=1) + back.var(ddof=1)) / 3)
    assert (light[0][0].bounces > 1).all()
    assert abs(there.mean() - back.mean()) < 5 * error + 2e-3 * there.mean() and error < 5e-3 * there.mean()
