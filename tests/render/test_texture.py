"""Direct light of textured surfaces against the texture's own formula in float64: scaled, turned, mirrored and
repeated coordinates, an edge between two textures, and paint under a rough coat."""

from __future__ import annotations

import numpy as np
import pytest

from render.direct.integrator import direct_light
from render.reference import ray_grid
from render.scene.traced_scene import TracedScene
from scenes import Camera, Laser, Material, Scene, Surface, Texture

WIDTH, HEIGHT = 16, 12
GRID = 8
POINTS = 72  # a pixel side: a million in the image
NORMAL = np.array([0.5, 0.6, 1.0]) / np.sqrt(0.25 + 0.36 + 1.0)  # toward the camera, 38 degrees off its axis
OFFSET_M = 2.0  # from the camera to the plane
NOISE = Texture(np.random.default_rng(29).uniform(0.05, 0.95, (8, 6)), "noise")
CHECKER = Texture(np.kron([[0.2, 0.8], [0.8, 0.2]], np.ones((8, 8))), "checker")
# uv = matrix (x, y) + shift, of a point's x and y [m]; the image is 1.4 m wide, and u, v take both signs
SCALED = np.array([[1.2, 0.0], [0.0, 0.7]])
TURNED = 0.9 * np.array([[0.8, -0.6], [0.6, 0.8]])
MIRRORED = np.array([[-1.0, 0.3], [0.0, 1.4]])
SHIFT = np.array([0.13, -0.4])


def slanted(material: Material, matrix: np.ndarray, low_m: float = -6.0, high_m: float = 6.0) -> Surface:
    """The part of the plane between two x."""
    x, y = np.array([low_m, high_m, high_m, low_m]), np.array([-6.0, -6.0, 6.0, 6.0])
    z = (-OFFSET_M - NORMAL[0] * x - NORMAL[1] * y) / NORMAL[2]
    uv = np.column_stack((x, y)) @ matrix.T + SHIFT
    return Surface(np.column_stack((x, y, z)), [[0, 1, 2], [0, 2, 3]], material, uv=uv)


def view(*surfaces: Surface) -> Scene:
    camera = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=34, width=WIDTH, height=HEIGHT)
    return Scene("painted", surfaces, camera, Laser("flood"))


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Look a repeating texture up as `Texture` says: u to the right, v upwards; texels' centres at halves."""
    height, width = image.shape
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    right, below = x - column, y - row
    corner = [[image[(row + i) % height, (column + j) % width] for j in range(2)] for i in range(2)]
    above = corner[0][0] * (1 - right) + corner[0][1] * right
    return above * (1 - below) + (corner[1][0] * (1 - right) + corner[1][1] * right) * below


def points(scene: Scene) -> np.ndarray:
    """Return where POINTS x POINTS rays of each pixel meet the plane [m], (H, W, POINTS, POINTS, 3) float64."""
    offset = (np.arange(POINTS) + 0.5) / POINTS
    row, column, down, aside = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), offset, offset, indexing="ij")
    rays = scene.camera.rays(column + aside, row + down)
    return rays * (-OFFSET_M / (rays @ NORMAL))[..., None]


def expected(scene: Scene, albedo: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Mean of albedo / pi I cos / d^2 over the points of each pixel."""
    distance = np.linalg.norm(point, axis=-1)
    intensity = float(scene.laser.intensity(scene.camera)[0, 0])
    return (albedo / np.pi * intensity * OFFSET_M / distance**3).mean((-2, -1)).ravel()


def check(scene: Scene, right: np.ndarray) -> None:
    """Judge each pixel against the root mean square of all, and the sum.

    An edge of paint is left alone where it changes less than 2 / GRID^3 of that (`default_edge_threshold`), 0.4 %; the
    few that cross a pixel have no sign, and average out over 192 pixels.
    """
    samples = direct_light(TracedScene(scene), np.arange(WIDTH * HEIGHT), GRID).samples
    found = np.bincount(samples.pixel, samples.radiance, minlength=WIDTH * HEIGHT)
    worst = 2 * 2 / GRID**3
    assert np.abs(found - right).max() < worst * np.sqrt((right**2).mean())
    assert found.sum() == pytest.approx(right.sum(), rel=worst / np.sqrt(len(right)))


@pytest.mark.parametrize("texture", [NOISE, CHECKER], ids=["noise", "checker"])
@pytest.mark.parametrize("matrix", [SCALED, TURNED, MIRRORED], ids=["scaled", "turned", "mirrored"])
def test_paint_on_a_slanted_plane(texture: Texture, matrix: np.ndarray) -> None:
    """A checker of contrast 4 whose edges are ramps one texel wide, narrower than a cell, and noise of 6 x 8 texels."""
    scene = view(slanted(Material(albedo=texture), matrix))
    point = points(scene)
    u, v = np.moveaxis(point[..., :2] @ matrix.T + SHIFT, -1, 0)
    right = expected(scene, bilinear(texture.image.astype(float), u, v), point)
    check(scene, right)


def test_an_edge_between_two_textures() -> None:
    """Both are painted by one formula each, on one plane; pixels that see both get the share of each."""
    left, right_half = (
        slanted(Material(albedo=NOISE), SCALED, high_m=0.03),
        slanted(Material(albedo=CHECKER), TURNED, 0.03),
    )
    scene = view(left, right_half)
    point = points(scene)
    painted = [
        bilinear(texture.image.astype(float), *np.moveaxis(point[..., :2] @ matrix.T + SHIFT, -1, 0))
        for texture, matrix in ((NOISE, SCALED), (CHECKER, TURNED))
    ]
    right = expected(scene, np.where(point[..., 0] < 0.03, *painted), point)
    check(scene, right)


def test_paint_under_a_rough_coat() -> None:
    """The coat's highlight is no paint: by a second route, a plain grid of rays."""
    coat = Material("roughplastic", albedo=CHECKER, roughness=0.3)
    scene = view(slanted(coat, TURNED))
    right = ray_grid(scene, np.array([0.0, 1e3]), grid=64).ravel()
    matte = ray_grid(view(slanted(Material(albedo=CHECKER), TURNED)), np.array([0.0, 1e3]), grid=8).ravel()
    assert np.corrcoef(right, matte)[0, 1] < 0.999
    check(scene, right)
