"""Highlights on polished things that a mirror lights: smaller than a pixel, and far brighter than all around."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from render.scene.traced_scene import TracedScene
from render.specular.image_method import specular_light
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere

METAL = Material("roughconductor", roughness=0.02, eta=2.9, k=3.1)


def bathroom(ball: Material) -> Scene:
    """A ball of 8 cm, and a mirror beside it that shows it the laser."""
    vertices, faces, _ = sphere(0.08, 5)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    mirror = [(1, -1, 0), (1, -1, -4), (1, 1, -4), (1, 1, 0)]
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    surfaces = (
        Surface(np.array(mirror, float), halves[:, ::-1], Material("conductor", eta=1.5, k=6.0)),
        Surface(vertices + (0.1, 0, -2), faces, ball, normals=normals),
    )
    view = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=60, width=24, height=16)
    return Scene("bathroom", surfaces, view, Laser("flood", cone_deg=140))


def mirrored(scene: Scene, grid: int, allowed: float) -> np.ndarray:
    found = specular_light(TracedScene(scene), grid, 1e-4, (allowed, 0.0)).samples
    late = found.bounces > 1
    size = scene.camera.width * scene.camera.height
    return np.bincount(found.pixel[late], weights=found.radiance[late], minlength=size)


@pytest.mark.parametrize("grid", [2, 3, 5])
def test_a_highlight_smaller_than_a_pixel_is_integrated_at_any_grid(grid):
    """Against 160 x 160 cells a pixel; with the asked grid alone the pixel is wrong by half of its light or more."""
    scene = bathroom(METAL)
    fine = mirrored(scene, 160, 0.0)
    found, coarse = mirrored(scene, grid, 1e-3), mirrored(scene, grid, 0.0)
    assert np.linalg.norm(found - fine) < 0.01 * np.linalg.norm(fine)
    assert np.linalg.norm(coarse - fine) > 0.2 * np.linalg.norm(fine)


def test_an_asked_grid_is_not_made_coarser():
    scene = bathroom(METAL)
    fine = mirrored(scene, 160, 0.0)
    for grid in (64, 160):
        assert np.linalg.norm(mirrored(scene, grid, 1e-9) - fine) < 0.01 * np.linalg.norm(fine)


def test_paths_of_finer_cells_are_those_of_the_pixel():
    """Their energy, mean path and spread: merging within 2 mm keeps all three."""
    scene = bathroom(replace(METAL, roughness=0.2))
    fine, found = (
        specular_light(TracedScene(scene), grid, 0.0, (allowed, 0.0)).samples
        for grid, allowed in ((32, 0.0), (4, 1e-12))
    )
    ball = np.unique(found.pixel[np.bincount(found.pixel)[found.pixel] > 16])
    assert len(ball) > 3

    def moments(samples, pixel):
        here = (samples.pixel == pixel) & (samples.bounces > 1)
        path, half, energy = (column[here].astype(float) for column in samples[1:4])
        mean = (energy * path).sum() / energy.sum()
        return energy.sum(), mean, np.sqrt((energy * ((path - mean) ** 2 + half**2 / 3)).sum() / energy.sum())

    for pixel in ball[:8]:
        (e, m, s), (energy, mean, spread) = moments(fine, pixel), moments(found, pixel)
        assert energy == pytest.approx(e, rel=0.02) and mean == pytest.approx(m, abs=2e-3)
        assert spread == pytest.approx(s, abs=2e-3)


def test_light_of_more_bounces_is_left_out_before_returns_merge():
    """Three mirrors in a room, returns merged within 5 mm: a merged return has the bounces of its first part."""
    vertices, faces, uv = box((4, 4, 5))
    walls = Surface(vertices + [0, 0, -0.5], faces[:, ::-1], Material(albedo=0.7), uv=uv)
    halves, x = np.array([[0, 1, 2], [0, 2, 3]]), 1.9
    corners = (
        [(x, -x, 0), (x, x, 0), (x, x, -2.9), (x, -x, -2.9)],
        [(-x, -x, 0), (-x, x, 0), (-x, x, -2.9), (-x, -x, -2.9)],
        [(-x, -x, 0), (x, -x, 0), (x, -x, -2.9), (-x, -x, -2.9)],
    )
    mirrors = [Surface(np.array(four, float), halves, Material("conductor")) for four in corners]
    view = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=80, width=16, height=16)
    world = TracedScene(Scene("mirrors", (walls, *mirrors), view))
    merged, every = (specular_light(world, 4, m, bounces=most).samples for m, most in ((5e-3, 2), (0.0, 63)))
    few = every.radiance[every.bounces <= 2].sum(dtype=float)
    assert merged.bounces.max() == 2 and merged.radiance.sum(dtype=float) == pytest.approx(few, rel=1e-5)
    late = specular_light(world, 4, 5e-3).samples
    assert late.radiance[late.bounces <= 2].sum(dtype=float) > 1.002 * few


def test_highlights_that_cells_resolve_are_traced_no_finer():
    """A polished panel that a mirror lights: 5 cells a side but at borders, and its light is that of 160."""
    scene = bathroom(METAL)
    panel = np.array([(-3, -3, -4), (3, -3, -4), (3, 3, -4), (-3, 3, -4)], float)
    coat = Material("roughplastic", albedo=0.4, roughness=0.1, ior=1.5)
    scene = replace(scene, surfaces=(scene.surfaces[0], Surface(panel, [[0, 1, 2], [0, 2, 3]], coat)))
    found = specular_light(TracedScene(scene), 5, 0.0, (1e-2, 0.0)).samples
    cells = np.bincount(found.pixel[found.bounces == 2])
    assert (cells == 25).sum() > 0.6 * (cells > 0).sum()
    fine, coarse = mirrored(scene, 160, 0.0), mirrored(scene, 5, 1e-2)
    assert np.linalg.norm(coarse - fine) < 0.01 * np.linalg.norm(fine)
