"""Ray and rigid offsets against the map they stand for, on scenes whose truth is a formula."""

import math

import numpy as np
import pytest

from scenes import Camera, InputError, Material, Scene, Surface
from scenes.geometry.shapes import box, rectangle, sphere
from scenes.offsets import moved_away, pushed_along_rays


def camera(fov: float = 50.0) -> Camera:
    return Camera.look_at((0.3, 0.2, 0.1), (0.2, 0.1, -2), fov_deg=fov, width=24, height=18)


def scene_of(vertices, faces, uv=None, normals=None, cam=None) -> Scene:
    return Scene("one", (Surface(vertices, faces, Material(), uv=uv, normals=normals),), cam or camera())


def distances(scene: Scene, rays: np.ndarray) -> np.ndarray:
    """To the nearest triangle along rays from the camera, by solving for barycentric coordinates."""
    a, b, c = (
        np.concatenate([s.vertices[s.faces] for s in scene.surfaces]).transpose(1, 0, 2)
        - scene.camera.origin[:, None].T
    )
    found = []
    for ray in rays:
        matrix = np.stack((a, b, c), axis=-1)
        good = np.abs(np.linalg.det(matrix)) > 1e-15
        weights = np.full((len(a), 3), -1.0)
        weights[good] = np.linalg.solve(matrix[good], np.broadcast_to(ray, (int(good.sum()), 3))[..., None])[..., 0]
        hit = (weights > -1e-9).all(axis=1)
        found.append((1 / weights[hit].sum(axis=1)).min() if hit.any() else np.inf)
    return np.array(found)


@pytest.mark.parametrize("metres", [0.5, 7.0])
def test_a_wall_pushed_along_rays_is_farther_by_the_offset_in_every_pixel(metres):
    square, faces, uv = rectangle()
    wall = scene_of(square * 2.5 - (0, 0, 2), faces, uv)
    rays = wall.camera.rays().reshape(-1, 3)[::29]
    pushed = pushed_along_rays(wall, metres)
    assert pushed.triangles > wall.triangles and pushed.camera is wall.camera
    assert distances(pushed, rays) == pytest.approx(distances(wall, rays) + metres, abs=1e-3)


def test_texture_coordinates_stay_with_their_ray():
    square, faces, uv = rectangle()
    wall = scene_of(square * 3 - (0, 0, 2), faces, uv)
    (pushed,) = pushed_along_rays(wall, 5).surfaces
    back = wall.camera.origin + (pushed.vertices - wall.camera.origin) * (
        1 - 5 / np.linalg.norm(pushed.vertices - wall.camera.origin, axis=1, keepdims=True)
    )
    assert back[:, 2] == pytest.approx(-2) and pushed.uv * 2 - 1 == pytest.approx(back[:, :2] / 3)


def test_shading_normals_follow_the_map():
    """Those of a ball around the camera's axis: the pushed surface's own normals, by finite differences."""
    points, faces, uv = sphere(1.0, 4)
    ball = scene_of(points * 0.5 - (0, 0, 3), faces, uv, normals=points)
    (pushed,) = pushed_along_rays(ball, 4).surfaces
    a, b, c = pushed.vertices[pushed.faces].transpose(1, 0, 2)
    own = np.cross(b - a, c - a)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    given = pushed.normals[pushed.faces].mean(axis=1)
    given /= np.linalg.norm(given, axis=1, keepdims=True)
    assert np.median((own * given).sum(axis=1)) > 0.999
    assert np.linalg.norm(pushed.normals, axis=1) == pytest.approx(1)


def test_neighbouring_faces_stay_joined():
    """A closed box stays closed: every edge of the divided mesh has two faces."""
    vertices, faces, _ = box((3, 2, 4))
    welded, which = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    pushed = pushed_along_rays(scene_of(welded, which.ravel()[faces]), 7.0)
    edges = np.sort(pushed.surfaces[0].faces[:, ((0, 1), (1, 2), (2, 0))].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}


def test_zero_and_bad_offsets():
    square, faces, _ = rectangle()
    wall = scene_of(square - (0, 0, 2), faces)
    assert pushed_along_rays(wall, 0.0).digest() == wall.digest()
    for metres in (-1.0, math.nan, 1e5):
        with pytest.raises(InputError, match="outside 0"):
            pushed_along_rays(wall, metres)
    with pytest.raises(InputError, match="camera's centre"):
        pushed_along_rays(scene_of(np.array([(0.3, 0.2, 0.1), (1, 0, 0), (0, 1, 0)]), [(0, 1, 2)]), 1.0)


def test_rigid_holds_the_same_width_at_the_median_and_cuts_what_is_nearer():
    square, faces, uv = rectangle()
    ahead = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=60, width=20, height=20)
    near_plane = np.array([(-1, 0, 1), (1, 0, -1), (1, 0.2, -1.0)])
    surfaces = (Surface(square * 5 - (0, 0, 4), faces, uv=uv), Surface(near_plane, np.array([(0, 1, 2)])))
    moved = moved_away(Scene("two", surfaces, ahead), 7.0, median_m=4.0, nearest_m=0.5)
    half = math.tan(math.radians(moved.camera.fov_deg) / 2)
    assert half * 11 == pytest.approx(math.tan(math.radians(30)) * 4)
    assert moved.camera.origin == pytest.approx((0, 0, 7))
    assert moved.surfaces[1].vertices[:, 2].max() == pytest.approx(-0.4995)
    assert moved.surfaces[0].faces.shape == (2, 3)
    # a clipped triangle loses exactly the area beyond the plane
    a, b, c = moved.surfaces[1].vertices[moved.surfaces[1].faces].transpose(1, 0, 2)
    left = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    whole = np.linalg.norm(np.cross(near_plane[1] - near_plane[0], near_plane[2] - near_plane[0])) / 2
    # the side towards the camera shrinks linearly from the far edge (z = -1) to the tip (z = 1)
    assert left == pytest.approx(whole * (1 - ((1 + 0.4995) / 2) ** 2), rel=1e-6)
