"""Random scenes, materials, cameras and lasers: nothing crashes, nothing is NaN, negative or infinite, up to depth."""

import warnings

import numpy as np
import pytest
import torch

from render.engine import render
from render.settings import RenderSettings
from scenes import Ambient, Camera, InputError, Laser, Material, Scene, Surface, Texture
from scenes.geometry import shapes
from scenes.model import LASER_MODES, MATERIAL_KINDS
from spad.detection.detect import sense
from spad.estimators.depth import estimate_depth
from spad.sensor.model import PhotonBudget, Sensor

SEEDS = [*range(8), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(8, 200))]


def random_surface(rng: np.random.Generator, scale: float, texture: Texture) -> Surface:
    kind = str(rng.choice(MATERIAL_KINDS))
    material = Material(
        kind,
        albedo=texture if rng.random() < 0.3 else rng.choice([0, 0.001, 0.5, 0.99, 1]),
        roughness=10 ** rng.uniform(-2.5, 0),
        opacity=1 if kind.endswith("dielectric") else texture if rng.random() < 0.2 else rng.choice([1, 1, 1, 0.3, 0]),
        eta=rng.choice([0, 1.5]),
        k=rng.choice([1, 6]),
    )
    vertices, faces, uv = [
        shapes.rectangle,
        lambda: shapes.box((1, 1, 1)),
        lambda: shapes.sphere(1, int(rng.integers(0, 4))),
        lambda: shapes.disk(1, 16),
        lambda: shapes.cylinder((0, 0, 0), (0, 1, 0), 10 ** rng.uniform(-4, 0)),
    ][rng.integers(5)]()
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    vertices = (vertices * 10 ** rng.uniform(-3, 1.3, 3)) @ turn.T * scale + rng.normal(size=3) * 2 * scale
    smooth = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    normals = None if rng.random() < 0.7 else smooth
    return Surface(vertices, faces, material, uv=uv, normals=normals, emission=rng.choice([0, 0, 0.5]))


def random_scene(rng: np.random.Generator) -> Scene:
    scale = 10 ** rng.uniform(-2, 2)
    texture = Texture(rng.random((8, 8)), "noise")
    surfaces = tuple(random_surface(rng, scale, texture) for _ in range(rng.integers(1, 7)))
    camera = Camera.look_at(
        rng.normal(size=3) * 3 * scale,
        rng.normal(size=3) * scale,
        fov_deg=10 ** rng.uniform(-1, 2.2),
        width=int(rng.integers(1, 20)),
        height=int(rng.integers(1, 15)),
    )
    baseline = tuple(rng.normal(size=3) * scale * 0.1) if rng.random() < 0.4 else (0, 0, 0)
    return Scene(
        "random", surfaces, camera, Laser(str(rng.choice(LASER_MODES)), baseline), Ambient(rng.choice([0, 0.3]))
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_scene_gives_sound_numbers(seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng)
    bounces, grid = [None, 1, 4][rng.integers(3)], [None, 3][rng.integers(2)]
    filtered = seed % 2 == 1 and scene.laser.mode == "flood"
    spp = None if scene.laser.mode == "scan" and bounces is None else 16  # direct light alone has no paths
    settings = RenderSettings(bounces=bounces, spp=spp, grid=grid, filter=filtered)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            transient = render(scene, settings, seed=seed)
        except InputError as refused:  # the one thing that is not rendered: said in one line, with the error's size
            assert "off the refracted one" in str(refused) and any(scene.laser.baseline_m), refused
            return
        for name in ("radiance", "path_near_m", "path_far_m", "ambient", "error", "albedo"):
            values = getattr(transient, name).astype(float)
            assert np.isfinite(values).all() and (values >= 0).all(), name
        assert np.isfinite(transient.normal.astype(float)).all() and not np.isinf(transient.depth_m).any()
        assert np.isfinite(transient.meta["relative_error"]["total"])
        if transient.returns == 0:
            with pytest.raises(InputError, match="no light returns"):
                sense(transient, Sensor(), PhotonBudget(50, 50))
            return
        histogram = sense(transient, Sensor(), PhotonBudget(50, 50), seed=seed)
        assert not torch.isinf(estimate_depth(torch.from_numpy(histogram.counts), histogram.sensor)).any()
