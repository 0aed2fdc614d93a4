"""Light by way of polished surfaces: paths begun on them and others together, against others alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import render.indirect.glossy
import render.indirect.light_tracing
from render.indirect.camera_paths import PathBatch, PathTask, trace_paths
from render.indirect.glossy import (
    ELSEWHERE,
    MAX_RATIO,
    camera_share,
    finite_ratio,
    glossy_of,
    laser_pixel_of,
    laser_rays,
    light_share,
    ratio_at_camera,
    ratio_at_laser,
    ratio_of_light_path,
    reversal,
)
from render.indirect.launch_layout import BLOCK, make_launch
from render.indirect.light_tracing import trace_light_paths
from render.indirect.reuse import all_pairs, pair_lanes
from render.pipeline import LightSamples, trace
from render.scene.rays import camera_rays, first_opaque, sample_bsdf, spawn
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi
from render.settings import Plan, RenderSettings
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.geometry.shapes import box, sphere
from scenes.library.hard_cases import hard_case

WIDTH, HEIGHT, BATCHES = 16, 12, 16
METAL = Material("roughconductor", roughness=0.1, eta=2.9, k=3.1)
GLOSS = Material("roughplastic", albedo=0.5, roughness=0.05, ior=1.5)
LASERS = {
    "flash": Laser("flood"),
    "lamp": Laser("flood", cone_deg=360),
    "spot": Laser("flood", cone_deg=20),
    "aside": Laser("flood", (0.4, 0.2, 0), 60),
}


def quad(corners: list, material: Material) -> Surface:
    return Surface(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]), material)


def room(polished: Material, laser: Laser, *, smooth: bool = False) -> Scene:
    """A corner with a coarse ball, whose shading normals are far from its faces' if it is `smooth`, and a panel."""
    wall = Material(albedo=0.7)
    vertices, faces, _ = sphere(0.5, 2)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True) if smooth else None
    surfaces = (
        quad([(-3, -1, 0), (3, -1, 0), (3, -1, -4), (-3, -1, -4)], wall),
        quad([(-3, -1, -4), (3, -1, -4), (3, 3, -4), (-3, 3, -4)], wall),
        quad([(-1.5, -1, 1), (-1.5, -1, -4), (-1.5, 3, -4), (-1.5, 3, 1)], wall),
        Surface(vertices + (0.1, -0.3, -2.5), faces, polished, normals=normals),
        quad([(0.9, -1, -3.5), (1.5, -1, -2.2), (1.5, 0.6, -2.2), (0.9, 0.6, -3.5)], polished),
    )
    view = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=50, width=WIDTH, height=HEIGHT)
    return Scene("polished", surfaces, view, laser)


def light(scene: Scene, spp: int, seed: int, *, bounces: int = 3, filtered: bool = False) -> LightSamples:
    forced = {"bounces": bounces, "spp": spp, "grid": 2, "filter": filtered, "edge_threshold": 1.0}
    settings = RenderSettings(**forced, direct_tolerance_m=1e-3)
    plan = Plan(**forced, direct_tolerance_m=1e-3, ambient=False, reasons=())
    return trace(TracedScene(scene), plan, settings, seed=seed, pilot=np.arange(0, WIDTH * HEIGHT, 3))


def totals(traced: LightSamples) -> np.ndarray:
    samples = traced.indirect_samples
    return np.bincount(samples.pixel, weights=samples.radiance, minlength=len(traced.origin_m))


@pytest.fixture
def mis_weight_sampled(monkeypatch):
    """Turns the paths that begin on polished surfaces off."""

    def off() -> None:
        for module in (render.indirect.glossy, render.indirect.light_tracing):
            monkeypatch.setattr(module, "glossy_of", lambda world: None)

    return off


def check_both_ways(scene: Scene, off: Callable[[], None], most_noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Return totals of paths of both kinds, and of the camera's alone with four times as many, (8, pixels) each; the
    means agree within 5 standard errors: Student's t of 7 to 14 degrees of freedom, one in 600 at the worst."""
    assert glossy_of(TracedScene(scene)) is not None
    both = np.array([totals(light(scene, 256, seed)) for seed in range(8)])
    off()
    alone = np.array([totals(light(scene, 1024, 100 + seed)) for seed in range(8)])
    noise = np.hypot(*(runs.sum(axis=1).std(ddof=1) / 8**0.5 for runs in (both, alone)))
    assert abs(both.sum(axis=1).mean() - alone.sum(axis=1).mean()) < 5 * noise
    assert noise < most_noise * alone.sum() / 8
    return both, alone


@pytest.mark.parametrize("smooth", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["facets", "smooth"])
@pytest.mark.parametrize("laser", ["flash", *(pytest.param(one, marks=pytest.mark.slow) for one in [*LASERS][1:])])
@pytest.mark.parametrize("material", [METAL, GLOSS], ids=["metal", "gloss"])
def test_both_ways_together_are_as_bright_as_one(material, laser, smooth, mis_weight_sampled):
    scene = room(material, LASERS[laser], smooth=smooth)
    check_both_ways(scene, mis_weight_sampled, 0.1)


@pytest.mark.parametrize("laser", [pytest.param("flash", marks=pytest.mark.slow), "aside"])
@pytest.mark.parametrize("kind", ["thindielectric", "dielectric"])
def test_both_ways_together_are_as_bright_as_one_behind_glass(kind, laser, mis_weight_sampled):
    """A pane, or a slab, before half of the view and what the metal shines on; a displaced laser allows a thin one."""
    scene = room(METAL, LASERS[laser], smooth=True)
    glass = Material(kind, ior=1.5)
    corners = [(-0.2, -0.9, -1.2), (2, -0.9, -1.2), (2, 2, -1.2), (-0.2, 2, -1.2)]
    if kind == "dielectric":
        vertices, faces, _ = box((2.2, 2.9, 0.3 if laser == "flash" else 0.01))
        pane = Surface(vertices + (0.9, 0.55, -1.3), faces, glass)
    else:
        pane = quad(corners, glass)
    scene = replace(scene, surfaces=(*scene.surfaces, pane))
    both, alone = check_both_ways(scene, mis_weight_sampled, 0.03)
    # 192 stds of eight renders: their sum is known to 2 %
    assert both.std(axis=0, ddof=1).sum() < 1.08 * alone.std(axis=0, ddof=1).sum()


def test_a_caustic_is_even_where_paths_by_chance_find_sparks(mis_weight_sampled):
    scene = hard_case("caustic")

    def scatter() -> float:
        """Of the pixels' totals from seed to seed, where the panel throws light by the closed form."""
        runs = [totals(light(scene, 64, seed, bounces=2)) for seed in range(6)]
        return float(np.sqrt(np.var(runs, axis=0, ddof=1).sum()) / np.mean(runs, axis=0).sum())

    even = scatter()
    mis_weight_sampled()
    assert even < 0.1 * scatter()


def test_stated_noise_is_that_of_other_seeds():
    scene = room(replace(METAL, roughness=0.02), LASERS["flash"])
    runs = [light(scene, 64, seed) for seed in range(12)]
    true = np.var([totals(run) for run in runs], axis=0, ddof=1).sum()
    stated = np.mean([(run.indirect.noise**2).sum() for run in runs])
    assert 0.6 < stated / true < 1.6


@pytest.mark.parametrize("filtered", [False, True], ids=["unbiased", "filtered"])
def test_watched_pixels_have_the_same_light(filtered):
    scene = room(replace(METAL, roughness=0.02), LASERS["flash"])
    traced = light(scene, 64, 3, filtered=filtered)
    probed = traced.indirect.probed
    fraction = probed.radiance.mean(axis=1).sum() / totals(traced)[probed.pixels].sum()
    assert fraction == pytest.approx(1, rel=1e-5 if not filtered else 1e-3)


def test_same_seed_same_light():
    scene = room(GLOSS, LASERS["flash"])
    one, other = (light(scene, 32, 5).samples for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_paths_begin_where_something_shines_and_a_few_elsewhere():
    world = TracedScene(room(METAL, LASERS["flash"]))
    glossy = glossy_of(world)
    assert set(glossy.sampling_density) == {0.0, ELSEWHERE, 1.0}
    found = list(trace_light_paths(world, 64, BATCHES, 3, 1))
    assert all(part.radiance.min() > 0 and part.pixel.max() < WIDTH * HEIGHT for part in found)
    assert np.bincount(np.concatenate([part.batch for part in found])).min() > 0


@pytest.mark.parametrize(
    ("scene", "why"),
    [
        (room(METAL, Laser("scan")), "scanning"),
        (room(Material("roughplastic", roughness=0.3), LASERS["flash"]), "dull"),
        (room(Material("thindielectric"), LASERS["flash"]), "glass"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_nothing_begins_elsewhere(scene, why):
    world = TracedScene(scene)
    assert glossy_of(world) is None and not list(trace_light_paths(world, 4, 1, 3, 0)), why


@pytest.mark.parametrize("cone_deg", [200, *(pytest.param(one, marks=pytest.mark.slow) for one in (130, 360))])
def test_polished_things_behind_the_camera(cone_deg, mis_weight_sampled):
    """A wide laser lights metal that no pixel shows: what it throws on the walls is found from there. 130 degrees do
    not reach it, and begin on the ball alone."""
    scene = room(METAL, Laser("flood", cone_deg=cone_deg), smooth=True)
    behind = quad([(-1, -1, 2), (-1, 1, 2), (1, 1, 2), (1, -1, 2)], replace(METAL, roughness=0.03))
    aside = quad([(1.5, -1, 1), (1.5, -1, -3), (1.5, 1, -3), (1.5, 1, 1)], replace(METAL, roughness=0.03))
    scene = replace(scene, surfaces=(*scene.surfaces, behind, aside))
    both, alone = check_both_ways(scene, mis_weight_sampled, 0.1)
    assert both.std(axis=0, ddof=1).sum() < alone.std(axis=0, ddof=1).sum()


@pytest.mark.parametrize("laser", [pytest.param("lamp", marks=pytest.mark.slow), "aside"])
def test_an_image_of_few_pixels_gives_the_same_light(laser, mis_weight_sampled, monkeypatch):
    """A telephoto camera has many times more pixels in what a wide laser lights; here are 9, or 3, in each of these."""
    monkeypatch.setattr(render.indirect.glossy, "MAX_IMAGE", 400)
    scene = room(METAL, LASERS[laser])
    glossy = glossy_of(TracedScene(scene))
    assert glossy is not None and int(glossy.width[0]) * int(glossy.height[0]) < 500
    check_both_ways(scene, mis_weight_sampled, 0.1)


def test_pixels_of_a_panorama_have_one_solid_angle_and_are_found_again():
    """Their solid angles are those of all directions; what a ray meets lies in the pixel that it began in."""
    world = TracedScene(room(METAL, LASERS["lamp"]))
    glossy = glossy_of(world)
    assert glossy is not None and glossy.left is None
    pixels = int(glossy.width[0]) * int(glossy.height[0])
    pixel, random = dr.arange(UInt32, pixels), mi.PCG32(pixels)
    ray, solid_angle = laser_rays(world, pixel, random.next_float32(), random.next_float32(), glossy)
    whole = solid_angle.numpy().sum() / float(world.focal_px[0]) ** 2
    assert whole == pytest.approx(4 * np.pi, rel=1e-4)
    assert np.allclose(ray.d.numpy().mean(axis=1), 0, atol=4 / np.sqrt(3 * pixels))
    found, seen = laser_pixel_of(world, ray.o + 3 * ray.d, glossy)
    assert seen.numpy().all() and np.mean(found.numpy() == pixel.numpy()) > 0.998  # rounding at borders


# --- weights of paths that both ways sample -----------------------------------------------------------------------

PATHS = 1 << 13


def trough(laser: Laser) -> Scene:
    """Two plates of narrow metal, 5 mm wide, that meet at right angles 2.4 m from the camera, before a wall."""
    wide, far, tall = 0.005, -2.4, 0.05
    left = [(-wide, -tall, far + wide), (0, -tall, far), (0, tall, far), (-wide, tall, far + wide)]
    right = [(0, -tall, far), (wide, -tall, far + wide), (wide, tall, far + wide), (0, tall, far)]
    wall = [(-2, -2, -2.5), (2, -2, -2.5), (2, 2, -2.5), (-2, 2, -2.5)]
    metal = replace(METAL, roughness=0.02)
    surfaces = (quad(left, metal), quad(right, metal), quad(wall, Material(albedo=0.5)))
    return Scene("trough", surfaces, Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=1, width=5, height=5), laser)


def lone_pixel(world: TracedScene, pixel: int, bounces: int) -> PathBatch:
    """Trace paths of a block that has one pixel: what it reuses are its own suffixes."""
    pixels = np.array([pixel, *[-1] * (BLOCK - 1)])
    launch = make_launch(np.array([0]), np.array([0]), np.array([PATHS]))
    return trace_paths(PathTask(world, pixels, launch, bounces, 1, reuses_paths=True))


@pytest.mark.parametrize(
    ("scene", "pixel"),
    [(trough(LASERS["flash"]), 12), (trough(LASERS["lamp"]), 12), (room(METAL, LASERS["flash"]), 100)],
    ids=["a hair's breadth apart", "under a lamp", "room"],
)
def test_a_block_of_one_pixel_gets_its_own_light_by_reuse(scene, pixel):
    """F / p of the only pixel is the weight of its sample, however near x2 lies. In the trough directions from x1
    itself, not from where its rays begin, were off by more than the metal's lobe: 45 % of the light of two surfaces was
    lost, and single paths were worth a hundred times their pixel."""
    world = TracedScene(scene)
    paths = lone_pixel(world, pixel, 4)
    pairs = all_pairs(dr.width(paths.batch))
    lanes = pair_lanes(world, paths, pairs)
    member_0 = np.arange(PATHS) * BLOCK  # of every sample
    suffixes = paths.suffixes
    reused = member_0[(suffixes.reusable.numpy() & paths.primary.allows_reuse.numpy())[member_0]]
    for by_reuse, own in (
        (lanes.first, suffixes.own_value),
        (lanes.onward, suffixes.own_onward),
        (lanes.ratio, suffixes.own_ratio),
    ):
        by_reuse, own = by_reuse.numpy()[reused * BLOCK], own.numpy()[reused]
        kept = (by_reuse > 0) & (own > 0)
        assert kept.sum() > 50
        # float32 of 2.4 m knows the direction over a leg of 0.2 mm to 1e-3, of a lobe that is 0.02 wide
        assert np.mean(np.abs(by_reuse[kept] / own[kept] - 1) > 0.05) < 0.01
    first, own = lanes.first.numpy()[reused * BLOCK], suffixes.own_value.numpy()[reused]
    assert first.sum() == pytest.approx(own.sum(), rel=0.005)


def vertices(world: TracedScene, count: int, lanes: int) -> tuple[list, mi.Bool]:
    """Trace paths of the camera over `count` surfaces; return the surfaces and which paths have all of them."""
    random = mi.PCG32(lanes, initstate=3)
    ray, _ = camera_rays(world, *(random.next_float32() * size for size in (world.width, world.height)))
    si, _, _, _ = first_opaque(world, ray, Bool(True))
    found, active = [si], si.is_valid()
    for _ in range(count - 1):
        sample, _ = sample_bsdf(found[-1], random, active)
        before = found[-1]
        si, _, _, _ = first_opaque(world, spawn(before, before.to_world(sample.wo)), active, before.p)
        active &= si.is_valid()
        found.append(si)
    return found, active


@pytest.mark.parametrize("material", [METAL, GLOSS], ids=["metal", "gloss"])
def test_the_ratio_of_a_path_is_that_of_its_vertices_from_either_end(material):
    """Forwards and backwards, over four surfaces: a / b in the order of the camera's path and of the laser's."""
    world = TracedScene(room(material, LASERS["aside"], smooth=True))
    glossy = glossy_of(world)
    assert glossy is not None
    points, active = vertices(world, 4, 1 << 15)
    towards = [dr.normalize(b.p - a.p) for a, b in pairwise(points)]
    context = mi.BSDFContext()

    def seen(si, wi, wo):
        """An interaction seen from a direction of the world, with the density of another one."""
        si = mi.SurfaceInteraction3f(si)
        si.wi = si.to_local(wi)
        return si, si.to_local(wo), si.bsdf().pdf(context, si, si.to_local(wo), active)

    forwards = ratio_at_camera(world, points[0], towards[0], active) * ratio_at_laser(
        world, points[3], -towards[2], active
    )
    backwards = ratio_at_camera(world, points[0], towards[0], active)
    for i in (1, 2):
        forwards *= reversal(*seen(points[i], -towards[i - 1], towards[i]), active)
        backwards /= reversal(*seen(points[i], towards[i], -towards[i - 1]), active)
    pixel, _ = laser_pixel_of(world, points[3].p, glossy)
    begun = (ratio_at_laser(world, points[3], -towards[2], active) > 0) & dr.isfinite(forwards)
    backwards *= ratio_of_light_path(world, pixel, points[3], -towards[2], active & begun)
    kept = begun.numpy() & active.numpy()
    assert kept.sum() > 500
    assert np.allclose(forwards.numpy()[kept], backwards.numpy()[kept], rtol=1e-3)


def test_a_diffuse_surface_reverses_as_it_goes():
    world = TracedScene(room(METAL, LASERS["flash"], smooth=True))
    points, active = vertices(world, 1, 1 << 12)
    sample, _ = sample_bsdf(points[0], mi.PCG32(1 << 12), active)
    diffuse = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DiffuseReflection)
    kept = diffuse.numpy()
    assert kept.sum() > 500
    assert np.allclose(reversal(points[0], sample.wo, sample.pdf, diffuse).numpy()[kept], 1, rtol=1e-5)


def test_shares_of_any_ratio_are_one_together():
    # 2e-38 is still a normal number of float32: some processors round those below to 0
    ratio = Float(0, 2e-38, 1e-7, 1, 1e7, 1e30, np.inf, np.nan, -1)
    camera, laser = camera_share(ratio).numpy(), light_share(ratio).numpy()
    assert np.allclose(camera + laser, 1, atol=1e-6) and np.all(laser >= 0)
    assert laser[1] > 0 and laser[2] == pytest.approx(1e-7, rel=1e-5)
    assert finite_ratio(ratio).numpy().max() == np.float32(MAX_RATIO)


@pytest.mark.parametrize("laser", ["flash", "lamp"])
def test_polished_metal_that_shows_light_of_polished_metal_is_even(laser, mis_weight_sampled):
    """Five surfaces, metal of roughness 0.02: paths of both kinds have the camera's light, and less than half of its
    noise. Weighted by their last two surfaces alone, they had more: what a path from the laser throws on metal that the
    camera sees is rare and bright, where the camera's paths find it with ease."""
    scene = room(replace(METAL, roughness=0.02), LASERS[laser], smooth=True)

    def noise_and_total() -> tuple[float, float, float]:
        runs = np.array([totals(light(scene, 128, seed, bounces=5)) for seed in range(10)])
        sums = runs.sum(axis=1)
        return float(np.sqrt(runs.var(axis=0, ddof=1).sum())), sums.mean(), sums.std(ddof=1) / 10**0.5

    both = noise_and_total()
    mis_weight_sampled()
    alone = noise_and_total()
    assert abs(both[1] - alone[1]) < 5 * np.hypot(both[2], alone[2])
    assert both[0] < alone[0] / 2.2
