"""Filtered indirect light: energy is kept, noise falls, the bias is stated, small and goes with more paths."""

import math
from dataclasses import replace

import numpy as np
import pytest

from render import pipeline
from render.engine import render
from render.error import response
from render.indirect.path_space_filter import GATHER_POINTS, SHRINKING, octaves
from render.pipeline import trace
from render.planning import make_plan
from render.scene.traced_scene import TracedScene, dr
from render.settings import RenderSettings
from render.transient.samples import Samples, select
from scene2spad.bench.hard import oracles
from scene2spad.bench.hard.case import moments_of
from scene2spad.bench.hard.oracles_optics import integrating_sphere
from scene2spad.bench.rendering import settings
from scene2spad.bench.rendering.binning import binned
from scenes import Camera, InputError, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere
from scenes.library import hard_cases
from scenes.library.catalog import load_scene
from scenes.library.hard_cases import hard_case

SLOW = pytest.mark.slow


def room(width: int = 24, kind: str = "diffuse", **laser) -> Scene:
    vertices, faces, uv = box((4, 3, 5))
    walls = Surface(vertices + [0, 0, -1.5], faces[:, ::-1], Material(albedo=0.7), uv=uv)
    vertices, faces, _ = sphere(0.4, 4)
    ball = Surface(vertices + [0.5, -0.1, -2.2], faces, Material(kind, albedo=0.3))
    return Scene("room", (walls, ball), oracles.camera(width, width, 60), Laser(**{"cone_deg": 360, **laser}))


def indirect(transient) -> np.ndarray:
    """Radiance of indirect light in every pixel."""
    return moments_of(transient, transient.bounces > 1).total.ravel()


def samples_of(transient, least_bounces: int = 1) -> Samples:
    """A transient's returns as samples, those of so many bounces or more."""
    near, far = transient.path_near_m.astype(float), transient.path_far_m.astype(float)
    columns = (transient.return_pixel, (near + far) / 2, (far - near) / 2, transient.radiance, transient.bounces)
    return select(Samples(*columns), transient.bounces >= least_bounces)


def test_octaves_cover_every_path_and_narrow_with_more_paths():
    for paths in (1, 16, 4096):
        filter_octaves = octaves(paths, 0.05, 3.0, 40.0, 0.03, 0.05)
        assert np.allclose(np.diff(np.log2(filter_octaves.size_m)), 1) and filter_octaves.size_m[0] == 0.05
        assert filter_octaves.size_m[-1] < 3.0 and np.allclose(
            filter_octaves.size_m / filter_octaves.from_m, filter_octaves.size_m[0] / filter_octaves.from_m[0]
        )
    few, many = (octaves(paths, 0.05, 3.0, 40.0, 0.03, 0.05) for paths in (16, 256))
    assert few.size_m[0] / few.from_m[0] == pytest.approx(16**SHRINKING * many.size_m[0] / many.from_m[0])
    assert many.size < few.size


@pytest.mark.parametrize("albedo", [0.5, 0.99])
def test_integrating_sphere_is_exact_but_for_noise(albedo):
    """Everywhere the same light: averaging over regions changes nothing but the noise.

    The path's mean and spread are right as well: what comes from one side is moved along the surface to first order.
    """
    scene, bounces = hard_case(f"sphere-{albedo:g}"), 4
    radius_m, offset_m = hard_cases.SPHERE_RADIUS_M, hard_cases.SPHERE_OFFSET_M
    expected = integrating_sphere(scene, radius_m=radius_m, offset_m=offset_m, albedo=albedo, bounces=bounces)
    ratios, lags, spreads = [], [], []
    for seed in range(8):
        transient = render(scene, RenderSettings(bounces=bounces, spp=16, grid=2, filter=True), seed=seed)
        got = moments_of(transient, transient.bounces > 1)
        ratios.append(got.total.mean() / expected.radiance - 1)
        weight = got.total / got.total.sum()
        lags.append((weight * (got.mean_m - expected.mean_path_m)).sum())
        variance = got.deviation_m**2 + (got.mean_m - expected.mean_path_m) ** 2
        spreads.append(np.sqrt((weight * variance).sum() / (weight * expected.variance_m2).sum()) - 1)
    for values, allowed in ((ratios, 1e-3), (lags, 2e-3 * radius_m), (spreads, 5e-3)):
        assert abs(np.mean(values)) < allowed + 4 * np.std(values, ddof=1) / math.sqrt(len(values)), values


@pytest.mark.parametrize(
    "kind", ["diffuse", pytest.param("plastic", marks=SLOW), pytest.param("roughconductor", marks=SLOW)]
)
def test_energy_is_kept(kind):
    """Every path goes into one region of one octave, and regions are read by all that is in them.

    Coated and rough surfaces: their diffuse lobe is filtered, the rest stays with its pixel.
    """
    scene = room(kind=kind)
    world = TracedScene(scene)
    wanted = indirect(render(scene, RenderSettings(bounces=4, spp=1024, grid=2), seed=99, world=world))
    settings = RenderSettings(bounces=4, spp=16, grid=2, filter=True)
    totals = [indirect(render(scene, settings, seed=seed, world=world)).sum() for seed in range(8)]
    standard = np.std(totals, ddof=1) / math.sqrt(len(totals)) / wanted.sum()
    assert abs(np.mean(totals) / wanted.sum() - 1) < 0.005 + 4 * standard


@pytest.mark.slow
def test_noise_falls_and_the_bias_goes_with_more_paths():
    """At 16 paths the filter's error is half of the same paths' own; at 256 its mean is nearer to the truth.

    Direct light is not touched.
    """
    scene = room()
    world, pixels = TracedScene(scene), np.arange(24 * 24)
    fine = render(scene, RenderSettings(bounces=4, spp=8192, grid=4, direct_tolerance_m=0.004), seed=99, world=world)

    def late(spp: int, filtered: bool, seed: int) -> np.ndarray:
        way = {"filter": filtered, "adaptive": filtered}
        given = RenderSettings(bounces=4, spp=spp, grid=4, direct_tolerance_m=0.004, **way)
        transient = render(scene, given, seed=seed, world=world)
        direct = transient.bounces == 1
        assert np.array_equal(transient.radiance[direct], fine.radiance[fine.bounces == 1])
        return response(samples_of(transient, 2), pixels)

    truth = response(samples_of(fine, 2), pixels)
    size = np.linalg.norm(truth)
    own, few = (np.linalg.norm(late(16, filtered, 1) - truth) / size for filtered in (False, True))
    assert few < own / 2
    biases = [np.linalg.norm(np.mean([late(n, True, s) for s in range(8)], axis=0) - truth) / size for n in (16, 256)]
    assert biases[1] < biases[0]


def test_same_seed_same_bytes_with_one_and_two_threads():
    threads, hashes = dr.thread_count(), set()
    given = RenderSettings(bounces=4, spp=16, grid=2, filter=True)
    try:
        for count in (1, 2, 2):
            dr.set_thread_count(count)
            hashes.add(render(room(), given, seed=5).sha256())
    finally:
        dr.set_thread_count(threads)
    assert len(hashes) == 1
    assert render(room(), given, seed=6).sha256() not in hashes


@pytest.mark.slow
def test_the_stated_error_is_the_true_one():
    """Of the mean over seeds, within the issue's factor of 1.3; a filtered result says that it is biased."""
    scene = room(32)
    world, pixels = TracedScene(scene), np.arange(32 * 32)
    given = RenderSettings(bounces=4, spp=64, grid=4, filter=True)
    fine = render(scene, RenderSettings(bounces=4, spp=8192, grid=16), seed=99, world=world)

    truth, stated, true = response(samples_of(fine), pixels), [], []
    for seed in range(8):
        transient = render(scene, given, seed=seed, world=world)
        stated.append(transient.meta["relative_error"]["total"])
        true.append(np.linalg.norm(response(samples_of(transient), pixels) - truth) / np.linalg.norm(truth))
        assert transient.meta["plan"]["filter"] and "biased" in transient.meta["plan"]["reasons"][-2]
    ratio = math.sqrt(np.mean(np.square(stated)) / np.mean(np.square(true)))
    assert 1 / 1.3 < ratio < 1.3, (stated, true)


def test_rays_count_the_points_that_read():
    filtered, plain = (
        render(room(8), RenderSettings(bounces=3, spp=4, grid=2, filter=f, adaptive=False)).meta["rays"]
        for f in (True, False)
    )
    assert filtered == plain + GATHER_POINTS * 8 * 8


def test_a_target_is_met_by_more_paths():
    transient = render(room(), RenderSettings(bounces=4, error=0.06, filter=True), seed=3)
    assert transient.meta["relative_error"]["total"] < 0.06
    assert any("on top" in reason for reason in transient.meta["plan"]["reasons"])


@pytest.mark.slow
def test_one_pixel_nothing_in_view_and_glass():
    assert "filter: biased" in render(room(2), RenderSettings(spp=1, filter=True)).meta["plan"]["reasons"][-2]
    assert "filter" not in render(room(2), RenderSettings(bounces=1, filter=True)).meta["plan"]["reasons"][-2]
    tiny = render(room(1), RenderSettings(bounces=3, spp=64, filter=True), seed=1)
    assert np.isfinite(tiny.radiance).all() and (tiny.bounces > 1).any()
    away = replace(room(), camera=Camera.look_at((0, 0, 20), (0, 0, 40), fov_deg=30, width=4, height=4))
    assert render(away, RenderSettings(bounces=3, spp=16, filter=True), seed=1).returns == 0
    for name in ("window", "leaf", "mirror"):
        found = render(hard_case(name), RenderSettings(bounces=3, spp=16, filter=True), seed=1)
        assert np.isfinite(found.radiance).all() and (found.radiance >= 0).all()


def bright_sphere(size: int) -> Scene:
    scene = hard_case("sphere-0.5")
    surfaces = tuple(replace(surface, material=Material(albedo=0.9)) for surface in scene.surfaces)
    return replace(scene, surfaces=surfaces, camera=replace(scene.camera, width=size, height=size))


@pytest.mark.parametrize(
    ("name", "spp", "taken"),
    [pytest.param("hall", 64, False, marks=pytest.mark.slow), ("room", 16, False), ("sphere", 16, True)],
)
def test_left_out_where_it_hurts(name, spp, taken):
    """A stairwell under a flash owes its noise to gloss, which no filter takes: with 64 paths it had 0.15 instead of
    0.07 of error. In a diffuse room neighbours share paths, which leaves a filter little. In a closed bright sphere
    most light is late and even: at 64x64 its squared error falls to a seventh in 1.4 times the time."""
    if name == "hall":
        scene = load_scene("hall", width=32, height=24)
        scene = replace(scene, camera=replace(scene.camera, fov_deg=settings.FLASH_FOV_DEG), laser=Laser("flood"))
    else:
        scene = replace(bright_sphere(64) if name == "sphere" else room(32), laser=Laser("flood"))
    world, given = TracedScene(scene), RenderSettings(bounces=8, spp=spp, grid=2, filter=True)
    traced = trace(world, make_plan(world, given, 1), given, seed=1)
    assert (traced.schedule.filter_octaves is not None) == taken
    assert ("filter: left out" in traced.reasons[0]) == (not taken)


def test_left_out_the_plan_and_the_error_are_those_of_unfiltered_light(monkeypatch):
    scene, given = replace(room(8), laser=Laser("flood")), RenderSettings(bounces=3, spp=16, grid=2)
    monkeypatch.setattr(pipeline, "FILTER_GAIN", math.inf)
    without, asked = (render(scene, replace(given, filter=f), seed=4) for f in (False, True))
    forced = render(scene, replace(given, filter=True, adaptive=False), seed=4)
    assert not asked.meta["plan"]["filter"] and forced.meta["plan"]["filter"]
    assert asked.meta["relative_error"] == without.meta["relative_error"]
    assert np.array_equal(asked.radiance, without.radiance)
    assert "filter: left out" in " ".join(asked.meta["plan"]["reasons"])


@pytest.mark.parametrize("mode", ["scan", "line"])
def test_other_lasers_are_refused_in_one_line(mode):
    with pytest.raises(InputError, match=f"flood laser.*{mode}"):
        render(replace(room(), laser=Laser(mode)), RenderSettings(bounces=3, spp=16, filter=True))


@pytest.mark.slow
def test_bias_and_depth_under_a_flash():
    """Mean of 8 filtered runs of the flash scene: off by at most 0.5 % after the pulse, depth by 1 mm (median).

    Its square, by independent halves, is 1.0e-5, and spreads by 0.05e-5: pairs of single runs of truth by 0.09e-5.
    """
    import torch

    from scene2spad.bench.rendering.errors import pulsed
    from scene2spad.bench.rendering.settings import BIN_M, BINS
    from spad.estimators.depth import estimate_depth
    from spad.sensor.model import Sensor

    size, sensor = 64, Sensor()
    world = TracedScene(settings.bench_scene("flash", size))

    def half_means(spp: int, runs: int, first_seed: int, filtered: bool) -> list[np.ndarray]:
        """Means of two independent halves of the runs, after the pulse."""
        given = RenderSettings(bounces=5, spp=spp, grid=8, filter=filtered, adaptive=not filtered)  # forced
        plan = make_plan(world, given, 0)
        means = [np.zeros((size * size, BINS), np.float32) for _ in range(2)]
        for number in range(runs):
            samples = trace(world, plan, given, seed=first_seed + number).samples
            means[number % 2] += pulsed(binned(samples, size * size, BINS, BIN_M)) / (runs / 2)
        return means

    (one, other), (first, second) = half_means(1024, 4, 100, False), half_means(64, 8, 0, True)
    squared = ((first - one) * (second - other)).sum() / (one * other).sum()
    assert squared < 0.005**2, math.sqrt(squared)
    photons = 1000 / (one + other).sum(axis=1).mean()
    depths = [
        estimate_depth(torch.from_numpy(photons * (a + b)).reshape(size, size, BINS), sensor, "log-matched").numpy()
        for a, b in ((one, other), (first, second))
    ]
    shift_m = np.abs(depths[1] - depths[0])
    assert np.median(shift_m) < 0.001 and np.quantile(shift_m, 0.95) < 0.005
