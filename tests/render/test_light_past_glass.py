"""Indirect light between surfaces with glass or cut-outs in the scene: beside their way it is as without them, across
their way as Fresnel and the index say."""

from __future__ import annotations

import numpy as np
import pytest

from render.engine import render
from render.reference import path_traced
from render.scene.rays import segment
from render.scene.traced_scene import Float, TracedScene, dr, mi
from render.settings import RenderSettings
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box

HALF_GAP_M, THICKNESS_M, INDEX = 0.3, 0.2, 1.5
GLASS = Material("dielectric", ior=INDEX)


def side_wall(x_m: float) -> Surface:
    corners = [(x_m, -1, -3), (x_m, -1, -1), (x_m, 1, -1), (x_m, 1, -3)]
    return Surface(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], Material(albedo=0.8))


def slab(x_m: float, material: Material) -> Surface:
    vertices, faces, uv = box((THICKNESS_M, 2, 2))
    return Surface(vertices + np.array((x_m, 0, -2.0)), faces, material, uv=uv)


def corridor(*things: Surface, laser: Laser | None = None) -> Scene:
    """Two walls that face each other, closely for their distance to the origin, seen from one end."""
    view = Camera.look_at((0, 0, 1), (0, 0, -1), fov_deg=40, width=16, height=16)
    return Scene("corridor", (side_wall(-HALF_GAP_M), side_wall(HALF_GAP_M), *things), view, laser or Laser())


def indirect(scene: Scene, spp: int = 256) -> float:
    rendered = render(scene, RenderSettings(bounces=2, spp=spp, refraction="straight"), seed=1)
    return float(rendered.radiance[rendered.bounces > 1].sum(dtype=np.float64))


@pytest.fixture(
    scope="module",
    params=[Laser(), pytest.param(Laser(cone_deg=360), marks=pytest.mark.slow)],
    ids=["flash", "lamp"],
)
def lit(request: pytest.FixtureRequest) -> tuple[Laser, float]:
    """A laser, and the corridor's indirect light without anything aside."""
    return request.param, indirect(corridor(laser=request.param), spp=32)


@pytest.mark.parametrize(
    "material", [GLASS, Material("thindielectric"), Material(opacity=0.0)], ids=["thick glass", "pane", "cut-out"]
)
def test_what_stands_aside_takes_no_light(material: Material, lit: tuple[Laser, float]) -> None:
    laser, alone = lit
    aside = indirect(corridor(slab(5, material), laser=laser), spp=32)
    assert aside == pytest.approx(alone, rel=1e-3)  # by the same paths


def test_a_slab_between_two_walls_lets_through_what_a_path_tracer_finds() -> None:
    scene = corridor(slab(0, GLASS))
    all_paths = np.array([0.0, 100.0])
    direct, both = (path_traced(scene, all_paths, bounces=most, spp=4096).sum() for most in (1, 2))
    assert indirect(scene) == pytest.approx(both - direct, rel=0.01)  # three standard errors of 256 paths a pixel


@pytest.mark.parametrize("glass", [False, True], ids=["beside a slab", "across a slab"])
def test_a_segment_is_stopped_by_nothing_but_fresnel(glass: bool) -> None:
    world = TracedScene(corridor(slab(0 if glass else 5, GLASS)))
    random = np.random.default_rng(0)
    near, far = (  # in the renderer's frame, whose origin is the camera
        np.stack([np.full(4000, x), *random.uniform([-0.9, -3.9], [0.9, -2.1], (4000, 2)).T])
        for x in (-HALF_GAP_M, HALF_GAP_M)
    )
    ray = mi.Ray3f(mi.Point3f(*(near + [[0.05], [0], [0]])), mi.Vector3f(-1, 0, 0))
    transmission, path_m = segment(
        world, world.mi_scene.ray_intersect(ray), mi.Point3f(*far), dr.full(mi.Bool, True, 4000), spread=False
    )
    distance = np.linalg.norm(far - near, axis=0)
    cosine = 2 * HALF_GAP_M / distance
    passed = 1 - np.array(mi.fresnel(Float(cosine), INDEX)[0])
    # rays begin 0.36 mm off the wall, 10 cm from the glass: they are aimed by as much as that aside
    np.testing.assert_allclose(np.array(transmission), passed**2 if glass else 1, rtol=2e-3)
    longer = THICKNESS_M / cosine * (INDEX - 1) if glass else 0
    np.testing.assert_allclose(np.array(path_m), distance + longer, atol=2e-4)
