"""Light by way of polished surfaces: paths begun on them and others together, against others alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import render.indirect.glossy
import render.indirect.light_tracing
from render.indirect.glossy import ELSEWHERE, glossy_of
from render.indirect.light_tracing import trace_light_paths
from render.pipeline import LightSamples, trace
from render.scene.traced_scene import TracedScene
from render.settings import Plan, RenderSettings
from scenes import Camera, Laser, Material, Scene, Surface
from scenes.library.hard_cases import hard_case
from scenes.library.things.shapes import box, sphere

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
    return trace(TracedScene(scene), plan, settings, seed=seed, checked=np.arange(0, WIDTH * HEIGHT, 3))


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


@pytest.mark.parametrize("smooth", [False, True], ids=["facets", "smooth"])
@pytest.mark.parametrize("laser", LASERS)
@pytest.mark.parametrize("material", [METAL, GLOSS], ids=["metal", "gloss"])
def test_both_ways_together_are_as_bright_as_one(material, laser, smooth, mis_weight_sampled):
    scene = room(material, LASERS[laser], smooth=smooth)
    check_both_ways(scene, mis_weight_sampled, 0.1)


@pytest.mark.parametrize("laser", ["flash", "aside"])
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
    assert both.std(axis=0, ddof=1).sum() < alone.std(axis=0, ddof=1).sum()


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


def test_polished_things_behind_the_camera_alone():
    """Lit by a lamp, seen by no pixel: none of the wider image shows them either."""
    scene = room(METAL, LASERS["lamp"])
    behind = quad([(-1, -1, 2), (1, -1, 2), (1, 1, 2), (-1, 1, 2)], METAL)
    scene = replace(scene, surfaces=(*scene.surfaces[:3], behind))
    assert glossy_of(TracedScene(scene)) is None
