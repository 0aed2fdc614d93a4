"""The integrators against their plain twins (`render.reference`): energy in coarse intervals of path length."""

from dataclasses import replace

import numpy as np
import pytest

from render.engine import render
from render.reference import path_traced, ray_grid
from render.settings import RenderSettings
from render.transient import Transient
from scenes.library.catalog import load_scene
from scenes.model import Scene


def by_interval(transient: Transient, edges_m: np.ndarray) -> np.ndarray:
    """(T,) radiance of the whole image in each interval; a return is spread evenly over its own."""
    near, far = transient.path_near_m.astype(float), transient.path_far_m.astype(float)
    length = np.maximum(far - near, 1e-9)
    below = np.clip((edges_m[:, None] - near) / length, 0, 1)
    return np.diff(below @ transient.radiance.astype(float))


def small(name: str) -> Scene:
    return load_scene(name, width=16, height=12, seed=1)


@pytest.mark.parametrize("name", ["living-room", "gallery", "hall", "washroom"])
def test_direct_light_is_that_of_a_grid_of_rays(name):
    # mirrors and panes show images of the laser, which no grid of rays finds; chrome shows some narrower than cells
    polished = ("conductor", "roughconductor", "dielectric", "thindielectric")
    scene, grid = small(name), 8
    if name == "washroom":
        grid = 16  # joints between tiles are a sixth of a cell wide at 8
        scene = replace(scene, surfaces=tuple(s for s in scene.surfaces if s.material.kind not in polished))
    edges_m = np.linspace(0, 30, 11)
    plain = ray_grid(scene, edges_m, grid=24).sum((0, 1))
    ours = by_interval(render(scene, RenderSettings(bounces=1, grid=grid), seed=1), edges_m)
    # silhouettes: a grid of 24 knows a pixel's coverage to about 1 / 24^1.5 on each edge, 192 pixels together
    assert np.abs(ours - plain).max() < 0.01 * plain.sum()
    assert abs(ours.sum() - plain.sum()) < 5e-3 * plain.sum()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["living-room", "gallery", "corner", "hall"])
def test_indirect_light_is_that_of_plain_paths(name):
    """Mean of ten renders and of ten plain path traces: within 4.5 standard errors in each of ten intervals."""
    scene = small(name)
    edges_m = np.linspace(0, 30, 11)
    plain = np.array([path_traced(scene, edges_m, bounces=3, spp=128, seed=s).sum((0, 1)) for s in range(10)])
    settings = RenderSettings(bounces=3, spp=64, grid=8)
    ours = np.array([by_interval(render(scene, settings, seed=s), edges_m) for s in range(10)])
    error = np.hypot(plain.std(0, ddof=1), ours.std(0, ddof=1)) / np.sqrt(10)
    difference = np.abs(plain.mean(0) - ours.mean(0))
    # Student's t of 18 degrees of freedom, 10 intervals: 4.5 is one in 3,000; where light is exact, cells' edges remain
    assert (difference < 4.5 * error + 2e-3 * ours.mean(0).sum()).all(), (difference, error)
