"""The three offsets, rendered: what each keeps and what it changes."""

from functools import cache

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scene2spad.datasets.moving import moved
from scenes import InputError
from scenes.library.catalog import load_scene

OFFSET_M = 7.0
SETTINGS = RenderSettings(bounces=1, grid=4)


@cache
def rendered(mode: str) -> Transient:
    scene = load_scene("tabletop/kitchen", width=48, height=40).without_lights()
    return render(scene if mode in ("", "time") else moved(scene, OFFSET_M, mode), SETTINGS, seed=1)


def off_silhouettes(view: Transient) -> np.ndarray:
    """Pixels on one surface, and with neighbours that are."""
    edge = np.pad(view.mixed, 1, mode="edge")
    rows, columns = view.mixed.shape
    around = [edge[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    return ~np.logical_or.reduce(around)


def test_ray_adds_the_offset_to_the_depth_of_every_pixel_off_silhouettes():
    near, far = rendered(""), rendered("ray")
    inner = off_silhouettes(near) & off_silhouettes(far)
    assert inner.mean() > 0.5
    assert far.depth_m[inner] == pytest.approx(near.depth_m[inner] + OFFSET_M, abs=1e-3)


def test_ray_keeps_the_albedo_image():
    images = [rendered(mode).albedo.astype(np.float64) for mode in ("", "ray")]
    assert structural_similarity(*images, data_range=1.0) > 0.98


def test_ray_makes_surfaces_more_frontal():
    """Slopes shrink by 1 + offset / depth across the ray and not along it: normals turn towards the camera."""
    scene = load_scene("tabletop/kitchen", width=48, height=40)
    rays = scene.camera.rays()
    near, far = (-(rendered(mode).normal.astype(float) * rays).sum(axis=-1) for mode in ("", "ray"))
    inner = off_silhouettes(rendered("")) & off_silhouettes(rendered("ray"))
    expected = near / np.sqrt(near**2 + (1 - near**2) / (1 + OFFSET_M / rendered("").depth_m) ** 2)
    assert np.median(np.abs(far - expected)[inner]) < 0.01

    near = rendered("")
    far = near.delayed(OFFSET_M)
    assert (far.radiance == near.radiance).all()
    assert far.depth_m == pytest.approx(near.depth_m + OFFSET_M, abs=1e-5)
    assert far.path_near_m == pytest.approx(near.path_near_m + 2 * OFFSET_M, abs=1e-5)


def test_rigid_keeps_the_median_content_and_narrows_the_view():
    near, far = rendered(""), rendered("rigid")
    ratio = np.nanmedian(far.depth_m) - np.nanmedian(near.depth_m)
    assert ratio == pytest.approx(OFFSET_M, abs=0.5)
    assert far.meta["camera"]["fov_deg"] < 0.4 * near.meta["camera"]["fov_deg"]
    assert np.isnan(far.depth_m).mean() < 0.2


def test_unknown_modes_are_refused():
    with pytest.raises(InputError, match="offset mode"):
        moved(load_scene("plane"), 1.0, "sideways")
