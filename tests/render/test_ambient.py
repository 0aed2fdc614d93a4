"""Ambient light against Mitsuba's own path integrator, and its stated noise against repetitions."""

import numpy as np
import pytest

from render.ambient import ambient_light
from render.world import World, mi
from scenes.model import Material, Scene, Surface
from scenes.shapes import box, sphere
from studies.bench import oracles

GLASS = Material("thindielectric", ior=1.5)


def windowed_room() -> Scene:
    """A closed room lit through a pane; a metal and a solid glass ball in it."""
    vertices, faces, uv = box((4, 3, 6))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=0.6), uv=uv)
    pane = oracles.quad([(-1, -0.8, -2.5), (1, -0.8, -2.5), (1, 0.8, -2.5), (-1, 0.8, -2.5)], GLASS)
    light = [(-0.8, -0.6, -2.8), (0.8, -0.6, -2.8), (0.8, 0.6, -2.8), (-0.8, 0.6, -2.8)]
    sky = Surface(np.array(light, float), [[0, 1, 2], [0, 2, 3]], Material(albedo=0.3), emission=1.0)
    balls = []
    for x, material in (
        (-1.0, Material("roughconductor", roughness=0.3, eta=2.9, k=3.1)),
        (1.0, Material("dielectric")),
    ):
        points, triangles, _ = sphere(0.4, 3)
        balls.append(Surface(points + (x, -0.6, -1.2), triangles, material, normals=points / 0.4))
    return Scene("windowed room", (walls, pane, sky, *balls), oracles.camera(8, 6, 70))


def mitsuba(world: World, spp: int, bounces: int, seed: int) -> float:
    """The image's mean by Mitsuba's path integrator, whose camera has x to the left and y up."""
    camera, turned = world.scene.camera, np.eye(4)
    turned[:3, :3] = camera.rotation @ np.diag([-1.0, -1.0, 1.0])
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    view = {"type": "perspective", "fov": camera.fov_deg, "fov_axis": "x", "near_clip": 1e-4}
    sensor = mi.load_dict(view | {"to_world": mi.ScalarTransform4f(turned), "film": film})
    integrator = mi.load_dict({"type": "path", "max_depth": bounces})
    return float(np.array(mi.render(world.traced, sensor=sensor, integrator=integrator, spp=spp, seed=seed)).mean())


def test_light_through_panes_is_what_mitsuba_finds_by_chance():
    """The means of independent runs agree within 4 standard errors of their difference."""
    world = World(windowed_room())
    ours = np.array([ambient_light(world, 128, 30, seed).radiance.mean() for seed in range(8)])
    theirs = np.array([mitsuba(world, 1024, 30, seed) for seed in range(8)])
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
    assert abs(ours.mean() - theirs.mean()) < 4 * error and error < 0.03 * ours.mean()


def test_the_stated_noise_is_that_of_repetitions():
    world = World(windowed_room())
    runs = [ambient_light(world, 32, 16, seed) for seed in range(12)]
    images = np.array([run.radiance for run in runs])
    spread = np.sqrt(images.var(axis=0, ddof=1).mean()) / images.mean()
    stated = np.sqrt(np.mean([run.error**2 for run in runs]))
    assert stated == pytest.approx(spread, rel=0.35) and stated > 0
    again = ambient_light(world, 32, 16, 0)
    assert (again.radiance == runs[0].radiance).all() and again.error == runs[0].error
