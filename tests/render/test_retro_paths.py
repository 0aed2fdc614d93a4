"""Light that comes back over polished metal: the density of its directions, the shares of all ways, and its noise."""

from __future__ import annotations

import numpy as np
import pytest

import render.indirect.light_tracing
import render.indirect.retro_paths
import render.indirect.reuse
from render.indirect.camera_paths import PathTask, trace_paths
from render.indirect.glossy import camera_share, light_share, lobe_density
from render.indirect.launch_layout import BLOCK, make_launch
from render.indirect.retro_paths import has_retro_paths, retro_density, retro_direction, retro_ratio
from render.indirect.reuse import all_pairs, pair_lanes
from render.pipeline import trace
from render.reference import path_traced
from render.scene.rays import camera_rays, first_opaque, sample_bsdf, spawn
from render.scene.traced_scene import Bool, Float, TracedScene, dr, mi
from render.settings import Plan, RenderSettings
from scenes import Camera, Laser, Material, Scene, Surface

SIDE = 12
METAL = Material("roughconductor", roughness=0.05, eta=2.9, k=3.1)
LASERS = {"flash": Laser("flood"), "aside": Laser("flood", (0.1, 0.05, 0), 40)}


def quad(corners: list, material: Material) -> Surface:
    return Surface(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]), material)


def mirrored_wall(laser: Laser = LASERS["flash"], metal: Material = METAL) -> Scene:
    """Show a wall at the side in a strip of metal, which stands before another wall."""
    paint = Material(albedo=0.6)
    strip = [(-0.2, -0.5, -2.2), (0.2, -0.5, -1.8), (0.2, 0.5, -1.8), (-0.2, 0.5, -2.2)]
    beside = [(-2, -1, -1), (-2, -1, -3), (-2, 1, -3), (-2, 1, -1)]
    behind = [(-2, -1, -3), (2, -1, -3), (2, 1, -3), (-2, 1, -3)]
    view = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=25, width=SIDE, height=SIDE)
    return Scene("mirrored wall", (quad(strip, metal), quad(beside, paint), quad(behind, paint)), view, laser)


def totals(scene: Scene, spp: int, seed: int, *, filtered: bool = False, bounces: int = 3) -> np.ndarray:
    forced = {"bounces": bounces, "spp": spp, "grid": 2, "filter": filtered, "edge_threshold": 1.0}
    settings = RenderSettings(**forced, direct_tolerance_m=1e-3)
    plan = Plan(**forced, direct_tolerance_m=1e-3, ambient=False, reasons=())
    traced = trace(TracedScene(scene), plan, settings, seed=seed, pilot=np.arange(SIDE**2))
    samples = traced.indirect_samples
    return np.bincount(samples.pixel, weights=samples.radiance, minlength=SIDE**2)


@pytest.fixture(scope="module")
def under_flash() -> np.ndarray:
    """Radiance of every pixel by twelve seeds, 256 paths each, (12, pixels)."""
    return np.array([totals(mirrored_wall(), 256, seed) for seed in range(12)])


@pytest.fixture
def without_retro_paths(monkeypatch):
    """Leave such light to the two other ways."""

    def off() -> None:
        for module in (render.indirect.light_tracing, render.indirect.retro_paths, render.indirect.reuse):
            monkeypatch.setattr(module, "has_retro_paths", lambda world: False)

    return off


def two_vertices(world: TracedScene, lanes: int) -> tuple[mi.SurfaceInteraction3f, mi.SurfaceInteraction3f, Bool]:
    """Trace camera paths over two surfaces; return both, and which paths left the metal for another surface."""
    random = mi.PCG32(lanes, initstate=3)
    ray, _ = camera_rays(world, *(random.next_float32() * size for size in (world.width, world.height)))
    x1, _, _, _ = first_opaque(world, ray, Bool(True))
    sample, _ = sample_bsdf(x1, random, x1.is_valid())
    x2, _, _, _ = first_opaque(world, spawn(x1, x1.to_world(sample.wo)), x1.is_valid(), x1.p)
    towards = dr.normalize(x1.p - x2.p)
    return x1, x2, x2.is_valid() & (retro_density(world, x1, x2.p, towards, x2.is_valid()) > 0)


def test_directions_have_their_density() -> None:
    """The density is 1 over all directions, and the cosine of the angle with the lobe's middle has its distribution."""
    world = TracedScene(mirrored_wall())
    assert has_retro_paths(world)
    count = 1 << 16
    x1, x2, found = (dr.detach(part) for part in two_vertices(world, 64))
    chosen = int(np.flatnonzero(found.numpy())[0])
    one = dr.full(mi.UInt32, chosen, count)
    x1, x2 = (dr.gather(mi.SurfaceInteraction3f, si, one) for si in (x1, x2))
    sampled = retro_direction(world, x1, x2.p, mi.PCG32(count), Bool(True))
    mirrored = world.laser - 2 * dr.dot(world.laser - x1.p, x1.n) * x1.n
    axis = dr.normalize(mirrored - x2.p)
    # a ladder of angles from 1e-4 to a right angle, even in their logarithms
    ladder = np.geomspace(1e-4, np.pi / 2, count)
    angle = Float(ladder)
    direction = mi.Frame3f(axis).to_world(mi.Vector3f(dr.sin(angle), 0, dr.cos(angle)))
    density = retro_density(world, x1, x2.p, direction, Bool(True)).numpy().astype(float)
    below = np.concatenate(([0], np.cumsum(np.diff(ladder) * (density[1:] * np.sin(ladder[1:])) * 2 * np.pi)))
    assert below[-1] == pytest.approx(1, abs=2e-3)
    off = np.sort(np.arcsin(np.clip(dr.norm(dr.cross(axis, sampled)).numpy(), 0, 1)))
    steps = np.interp(off, ladder, below)
    # Kolmogorov and Smirnov: one in 10^4 lies farther off than 2.2 / root(n), the ladder by 2e-3
    assert np.abs(steps - (np.arange(count) + 0.5) / count).max() < 2.2 / np.sqrt(count) + 2e-3


def test_shares_of_three_ways_are_one_together() -> None:
    """For directions that the lobes of x2 sample, and any ratio of the two older ways."""
    world = TracedScene(mirrored_wall())
    x1, x2, found = two_vertices(world, 1 << 12)
    direction = retro_direction(world, x1, x2.p, mi.PCG32(1 << 12, initstate=5), found)
    density = lobe_density(x2, x2.wi, x2.to_local(direction), found)
    q = retro_density(world, x1, x2.p, direction, found)
    kept = found.numpy() & (density.numpy() > 0)
    assert kept.sum() > 300
    for ratio in (0.0, 1e-3, 1.0, 1e4):
        other = retro_ratio(world, x1, x2.p, direction, density, found)
        shares = camera_share(ratio + other), light_share(Float(ratio), other), q / (q + density * (1 + ratio))
        assert np.allclose(sum(share.numpy()[kept] for share in shares), 1, rtol=1e-5)


@pytest.mark.parametrize("laser", [pytest.param("flash", marks=pytest.mark.slow), "aside"])
def test_light_over_the_same_metal_twice_is_as_bright_and_more_even(
    laser: str, under_flash: np.ndarray, without_retro_paths
) -> None:
    scene = mirrored_wall(LASERS[laser])
    assert has_retro_paths(TracedScene(scene))
    both = under_flash if laser == "flash" else np.array([totals(scene, 256, seed) for seed in range(12)])
    without_retro_paths()
    alone = np.array([totals(scene, 1024, 100 + seed) for seed in range(12)])
    noise = [runs.sum(axis=1).std(ddof=1) / 12**0.5 for runs in (both, alone)]
    # Student's t of 11 to 22 degrees of freedom: one in 2,000 at the worst
    assert abs(both.sum(axis=1).mean() - alone.sum(axis=1).mean()) < 5 * np.hypot(*noise)
    assert noise[0] < 0.01 * both.sum() / 12 and noise[1] < 0.03 * both.sum() / 12
    # a quarter of the paths, and a fifth of the squared noise or less
    assert both.var(axis=0, ddof=1).sum() < alone.var(axis=0, ddof=1).sum() / 5


@pytest.mark.slow
def test_light_over_the_same_metal_twice_is_that_of_plain_paths(under_flash: np.ndarray) -> None:
    """Against the plain path tracer, which finds it by chance."""
    scene, own = mirrored_wall(), under_flash.sum(axis=1)
    everything = np.array([0.0, 100.0])
    plain = [
        [path_traced(scene, everything, bounces=bounces, spp=20000, seed=seed).sum() for bounces in (3, 1)]
        for seed in range(10)
    ]
    indirect = np.array(plain) @ (1, -1)
    noise = np.hypot(own.std(ddof=1) / 12**0.5, indirect.std(ddof=1) / 10**0.5)
    assert abs(own.mean() - indirect.mean()) < 5 * noise and noise < 0.015 * own.mean()


def test_a_block_of_one_pixel_has_the_ratios_of_its_own_paths() -> None:
    """A mask that was changed in place had set a third of the own ratios to 0: 6 % more light."""
    world = TracedScene(mirrored_wall())
    pixels = np.array([5 * SIDE + 6, *[-1] * (BLOCK - 1)])
    launch = make_launch(np.array([0]), np.array([0]), np.array([1024]))
    paths = trace_paths(PathTask(world, pixels, launch, 4, 1, reuses_paths=True))
    lanes = pair_lanes(world, paths, all_pairs(dr.width(paths.batch)))
    member_0 = np.arange(1024) * BLOCK
    onward = member_0[paths.suffixes.onward.numpy()[member_0]]
    by_reuse, own = lanes.retro.numpy()[onward * BLOCK], paths.suffixes.own_retro.numpy()[onward]
    assert (own > 0).sum() > 500
    np.testing.assert_allclose(by_reuse, own, rtol=0.02)


def test_light_of_two_surfaces_holds_none_of_three() -> None:
    """The flash lights no wall that the metal shows, so that all indirect light is of three surfaces."""
    assert totals(mirrored_wall(), 64, 1, bounces=2).sum() == 0
    assert totals(mirrored_wall(), 64, 1).sum() > 0.1


def test_a_filter_leaves_the_light_as_it_is(under_flash: np.ndarray) -> None:
    plain = under_flash.sum(axis=1)
    filtered = np.array([totals(mirrored_wall(), 256, 50 + seed, filtered=True).sum() for seed in range(8)])
    noise = np.hypot(plain.std(ddof=1) / 12**0.5, filtered.std(ddof=1) / 8**0.5)
    assert abs(plain.mean() - filtered.mean()) < 5 * noise + 0.005 * plain.mean()


@pytest.mark.parametrize(
    "scene",
    [
        mirrored_wall(Laser("scan")),
        mirrored_wall(Laser("flood", cone_deg=360)),
        mirrored_wall(metal=Material("roughplastic", albedo=0.5, roughness=0.3)),
    ],
    ids=["scanning", "lamp", "dull"],
)
def test_where_nothing_is_sampled(scene: Scene) -> None:
    assert not has_retro_paths(TracedScene(scene))
