"""Light that a plan may overlook, and its error: none of it direct, cones narrower than a pixel, very few paths."""

import math

import numpy as np
import pytest

from render.engine import render
from render.error import ErrorEstimate, response, target_verdict
from render.image_error import estimated_error
from render.indirect.path_cells import MomentHistogram, make_cells
from render.pipeline import trace
from render.planning import MIN_BOUNCES, cone_width_px, make_plan
from render.reference import path_traced
from render.scene.traced_scene import TracedScene
from render.settings import RenderSettings
from render.specular.image_method import specular_light
from render.transient.samples import Samples
from scene2spad.bench.hard import oracles
from scenes import Camera, InputError, Laser, Material, Scene, Surface
from scenes.constants import REFERENCE_BINS, REFERENCE_PERIOD_S, REFERENCE_PULSE_SIGMA_S, SPEED_OF_LIGHT_M_PER_S
from scenes.geometry.shapes import box

WALLS = Material(albedo=0.7)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def room(albedo: float = 0.7) -> Surface:
    vertices, faces, uv = box((4, 4, 5))
    return Surface(vertices + [0, 0, 0.5], faces[:, ::-1], Material(albedo=albedo), uv=uv, name="room")


def looking(origin: tuple, target: tuple, fov_deg: float = 60.0, side: int = 8) -> Camera:
    return Camera.look_at(origin, target, fov_deg=fov_deg, width=side, height=side)


def behind_a_panel() -> Scene:
    """A lamp 2 m to the right of the camera, and a panel between it and all that is in view."""
    corners = np.array([(1, -0.6, -0.6), (1, 0.6, -0.6), (1, 0.6, 0.4), (1, -0.6, 0.4)], float)
    camera = looking((-0.5, 0, -1), (-2, 0, -1), 40)
    lamp = Laser("flood", tuple(camera.rotation.T @ np.array([2.0, 0, 1.0])), cone_deg=360)
    return Scene("panel", (room(), Surface(corners, FACES, WALLS, name="panel")), camera, lamp)


def in_a_mirror() -> Scene:
    corners = np.array([(-2, -2, 2.9), (2, -2, 2.9), (2, 2, 2.9), (-2, 2, 2.9)], float)
    mirror = Surface(corners, FACES, Material("conductor"), name="mirror")
    return Scene("mirror", (room(), mirror), looking((0, 0, 0), (0, 0, 1), 40), Laser("flood", cone_deg=360))


def test_indirect_light_is_there_where_no_pixel_is_lit_directly():
    """Against plain path tracing. Pixels of a block share their paths: a sum's error is up to 4 times the pixels'."""
    scene, settings = behind_a_panel(), RenderSettings(bounces=3, spp=64)
    world = TracedScene(scene)
    traced = trace(world, make_plan(world, settings, 1), settings, seed=1)
    assert len(traced.direct.pixel) == 0 and traced.indirect is not None
    total, error = traced.indirect_samples.radiance.sum(), 4 * np.linalg.norm(traced.indirect.noise)
    seeds = [path_traced(scene, np.array([0.0, 100.0]), bounces=3, spp=128, seed=seed).sum() for seed in range(4)]
    error = np.hypot(error, np.std(seeds, ddof=1) / 2)
    assert abs(total - np.mean(seeds)) < 4 * error and error < 0.02 * total
    found = render(scene, settings, seed=1)
    assert found.meta["relative_error"]["monte_carlo"] > 0
    assert any("hardly any direct light" in reason for reason in found.meta["plan"]["reasons"])


@pytest.mark.slow
def test_a_mirror_that_fills_the_view_shows_what_its_light_is_compared_with():
    """Against plain path tracing, which finds all but what the mirror throws on walls; that is later."""
    scene, settings = in_a_mirror(), RenderSettings(bounces=3, spp=64)
    world = TracedScene(scene)
    traced = trace(world, make_plan(world, settings, 1), settings, seed=1)
    assert len(traced.direct.pixel) == 0 and traced.indirect is not None
    assert not any("hardly any direct light" in reason for reason in traced.reasons)
    shown = specular_light(world, 16, bounces=2).shown.radiance.sum(dtype=float)
    total, error = traced.indirect_samples.radiance.sum() + shown, 4 * np.linalg.norm(traced.indirect.noise)
    seeds = [path_traced(scene, np.array([0.0, 100.0]), bounces=3, spp=128, seed=seed).sum() for seed in range(4)]
    error = np.hypot(error, np.std(seeds, ddof=1) / 2)
    assert abs(total - np.mean(seeds)) < 4 * error and error < 0.02 * total


@pytest.mark.parametrize("laser", [Laser(cone_deg=25), Laser(baseline_m=(1.5, 0, 0))], ids=["cone", "shadow"])
def test_cells_are_as_narrow_where_no_direct_light_falls(laser):
    """A quarter of the pixels is lit, or most are; light comes first to all of them by way of what they see."""
    corners = np.array([(0.6, -1.5, 1.5), (0.9, -1.5, 1.5), (0.9, 1.5, 1.5), (0.6, 1.5, 1.5)], float)
    post = Surface(corners, FACES, WALLS, name="post")
    scene = Scene("room", (room(), post), looking((0, 0, -1), (0, 0, 1), side=16), laser)
    found = render(scene, RenderSettings(bounces=3, spp=64), seed=1)
    pixel, indirect = found.return_pixel, found.bounces > 1
    lit = np.isin(np.arange(256), pixel[~indirect])
    assert 16 < lit.sum() < 256 - 16
    of_pixel, first = np.unique(pixel[indirect], return_index=True)
    width_m = (found.path_far_m - found.path_near_m)[indirect][first]
    dark, bright = (np.median(width_m[lit[of_pixel] == side]) for side in (False, True))
    assert dark < 1.5 * bright


@pytest.mark.parametrize("options", [{"filter": True, "adaptive": False}, {"clamp": 10.0}, {"error": 0.3}])
def test_all_ways_of_indirect_light_work_without_direct_light(options):
    """Clamps and targets are counted in a pilot's light, the filter's regions in the nearest paths."""
    plain, found = (render(behind_a_panel(), RenderSettings(bounces=3, spp=n, **o), seed=1)
                    for n, o in ((256, {}), (None if "error" in options else 64, options)))  # fmt: skip
    error = 4 * np.hypot(np.linalg.norm(plain.error), np.linalg.norm(found.error))
    low = 0.7 if "clamp" in options else 1.0
    assert low * plain.total_radiance().sum() - 4 * error < found.total_radiance().sum()
    assert found.total_radiance().sum() < plain.total_radiance().sum() + 4 * error


def test_one_path_a_pixel_states_its_noise():
    """2 are traced, whose noise is twice that of 8: known to 10 % from 256 pixels with 1 and 3 degrees of freedom."""
    scene = Scene("room", (room(),), looking((0, 0, 0), (0, 0, 1), side=16))
    few, more = (render(scene, RenderSettings(bounces=3, spp=spp, grid=4, adaptive=False), seed=1) for spp in (1, 8))
    assert few.meta["plan"]["spp"] == 2 and not few.meta["target_met"]
    ratio = few.meta["relative_error"]["monte_carlo"] / more.meta["relative_error"]["monte_carlo"]
    assert 2 / 1.4 < ratio < 2 * 1.4


def spot(cone_deg: float) -> Scene:
    return Scene("spot", (room(),), looking((0, 0, 0), (0, 0, 1)), Laser("flood", cone_deg=cone_deg))


def test_a_narrow_cone_has_the_indirect_light_of_a_wider_one():
    """Spots of 5 and 26 cm on a wall 3 m away: their indirect light differs by less than a per cent."""
    narrow, wider = (render(spot(cone_deg), RenderSettings(bounces=6, spp=64), seed=1) for cone_deg in (1, 5))
    totals = [one.radiance[one.bounces > 1].sum(dtype=float) for one in (narrow, wider)]
    error = 4 * np.hypot(np.linalg.norm(narrow.error), np.linalg.norm(wider.error))
    assert abs(totals[0] - totals[1]) < 3 * error + 0.01 * totals[1] and error < 0.1 * totals[1]


def test_plans_have_cells_for_the_cone_and_bounces_for_what_no_path_found():
    width_px = 8 * math.tan(math.radians(2.5)) / math.tan(math.radians(30))
    assert cone_width_px(TracedScene(spot(5))) == pytest.approx(width_px)
    plan = make_plan(TracedScene(spot(2)), RenderSettings(), 1)
    assert 2 * plan.grid * cone_width_px(TracedScene(spot(2))) > 8 and any("cone" in reason for reason in plan.reasons)
    assert make_plan(TracedScene(Scene("b", (room(0.0),), spot(5).camera)), RenderSettings(), 1).bounces == MIN_BOUNCES


def test_a_cone_that_falls_between_all_rays_misses_the_target():
    found = render(spot(1e-6), RenderSettings(bounces=2, spp=4))
    assert found.meta["relative_error"]["total"] == 1 and found.meta["target_met"] is False


def test_an_error_that_no_checked_pixel_tells_is_no_zero():
    """The wall fills the left of the view; the pixels that are checked look past it."""
    wall = Surface(np.array([(-9, -9, 3), (-0.5, -9, 3), (-0.5, 9, 3), (-9, 9, 3)], float), FACES, WALLS)
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), fov_deg=60, width=8, height=4)
    world, settings = TracedScene(Scene("half", (wall,), camera)), RenderSettings(bounces=1, grid=4)
    plan, everywhere = make_plan(world, settings, 1), np.arange(32)
    light = trace(world, plan, settings, seed=1, pilot=everywhere)
    dark = np.setdiff1d(everywhere, light.samples.pixel)
    assert len(dark) and estimated_error(world, plan, light).total < 0.1
    assert estimated_error(world, plan, trace(world, plan, settings, seed=1, pilot=dark)).total == 1


def aside(camera_m: tuple, laser_m: tuple) -> Scene:
    """One pixel of half a degree, and a spot of as much that it does not see, on the same wall of a room."""
    camera = Camera.look_at(camera_m, np.add(camera_m, (0.1, 0.05, 1)), fov_deg=0.5, width=1, height=1)
    baseline_m = tuple(camera.rotation.T @ np.subtract(laser_m, camera_m))
    return Scene("aside", (room(),), camera, Laser("flood", baseline_m, cone_deg=0.5))


def test_light_of_a_spot_out_of_view_is_as_bright_the_other_way_round():
    """Helmholtz: camera and laser change places. Paths that go on by chance never meet the spot."""
    ends, settings = ((0, 0, -1), (0.7, 0.3, -1)), RenderSettings(bounces=4, spp=512)
    sums = [
        [render(aside(*places), settings, seed=seed).radiance.sum(dtype=float) for seed in range(4)]
        for places in (ends, ends[::-1])
    ]
    one, other = np.mean(sums, axis=1)
    error = np.sqrt(np.var(sums, axis=1, ddof=1).sum() / 4)
    assert one > 0 and abs(one - other) < 5 * error and error < 0.02 * one


def test_darkness_that_few_paths_found_is_no_certainty():
    """The laser lights another part of a wall than the camera sees; where that is black no path could find any."""
    stated = []
    for albedo in (0.7, 0.0):
        scene = aside((0, 0, -1), (0.7, 0.3, -1))
        scene = Scene("wall", (oracles.wall(-4.0, albedo, half_size_m=9),), scene.camera, scene.laser)
        found = render(scene, RenderSettings(bounces=3))
        assert found.returns == 0 and np.isfinite(found.depth_m).all()
        stated.append((found.meta["relative_error"]["total"], found.meta["target_met"]))
    assert stated == [(1, False), (0, True)]


def test_direct_light_leaves_noise_a_part_of_the_target():
    plan = make_plan(TracedScene(spot(40)), RenderSettings(direct_fraction=0.9, grid=8, error=0.1, bounces=2), 1)
    assert plan.noise**2 == pytest.approx(0.1 * 0.96 * 0.75 * 0.1**2)


def test_cells_beyond_memory_are_refused(monkeypatch):
    monkeypatch.setenv("SCENE2SPAD_MEMORY_GB", "4")
    settings = RenderSettings(bounces=3, spp=4, grid=2, indirect_tolerance_m=1e-4, indirect_growth=0.0)
    with pytest.raises(InputError, match=r"^\d+ x \d+ cells of indirect light \(widen indirect_tol\S+ or .*is 4 GB;"):
        render(Scene("room", (room(),), looking((0, 0, 0), (0, 0, 1), side=16)), settings)
    with pytest.raises(InputError, match="cells of indirect light"):
        make_cells(1e-4, 0.0, -10.0, 1e6)
    monkeypatch.setenv("SCENE2SPAD_MEMORY_GB", "1e6")
    with pytest.raises(InputError, match="4500000000 entries, the limit is 4294967295"):
        MomentHistogram(1_500_000, make_cells(1.0, 0.0, 0.0, 998.0), 1e-12)


@pytest.mark.parametrize("half_m", [5.0, 20.0, 1000.0])
def test_returns_wider_than_the_period_respond_evenly(half_m):
    """Against the integral of the pulse over a box, bin by bin: many periods are a constant and what is left over."""
    bin_m = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PERIOD_S / REFERENCE_BINS
    path_m, at = 20000.5, (np.arange(REFERENCE_BINS) + 0.5) * bin_m
    wraps = np.arange(-40, 41) + round(path_m / (REFERENCE_BINS * bin_m))
    ends = [path_m + side * half_m - at - wraps[:, None] * REFERENCE_BINS * bin_m for side in (-1, 1)]
    sigma_m = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PULSE_SIGMA_S
    rise, fall = (np.vectorize(math.erf)(end / sigma_m / math.sqrt(2)).sum(axis=0) for end in ends)
    expected = (fall - rise) / 2 * bin_m / (2 * half_m)
    got = response(Samples(*(np.array([v]) for v in (7, path_m, half_m, 1.0, 1))), np.array([3, 7]))
    assert not got[0].any() and got[1].sum() == pytest.approx(1, rel=1e-9)
    assert np.abs(got[1] - expected).max() < 0.01 * expected.max()


def test_few_pixels_are_named_in_large_images_only():
    missed = ErrorEstimate(0.1, 0.0, 0.0, 0.1, 0.0, 0.05, 0.2, worst_share=0.9)
    assert [("fireflies" in target_verdict(missed, 0.02, pixels)) for pixels in (1, 64, 255, 256, 4096)] == [
        *(False,) * 3, *(True,) * 2,
    ]  # fmt: skip


@pytest.mark.parametrize("seed", [-1, 0.5, "1"])
def test_seeds_are_whole_numbers(seed):
    with pytest.raises(InputError, match=r"^seed \S+: expected a whole number, 0 or more$"):
        render(Scene("wall", (oracles.wall(3.0, 0.5),), oracles.camera(4, 4)), RenderSettings(bounces=1), seed=seed)


@pytest.mark.parametrize("mode", ["line", "scan"])
@pytest.mark.parametrize("baseline_m", [(0, 0, 0), (0.3, 0.1, 0)])
def test_a_line_ends_where_its_row_of_the_image_does(mode, baseline_m):
    """A wall fills the view, and white walls stand on both sides of it: these are dark, and light nothing."""
    front = [(-1, -1, -2), (1, -1, -2), (1, 1, -2), (-1, 1, -2)]
    left = [(-1, -2, -2), (-1, -2, 2), (-1, 2, 2), (-1, 2, -2)]
    sides = [np.array(left, float) * (side, 1, 1) for side in (1, -1)]
    surfaces = tuple(Surface(np.array(four, float), FACES, WALLS) for four in (front, *sides))
    scene = Scene("sides", surfaces, looking((0, 0, 0), (0, 0, -1), 40), Laser(mode, baseline_m))
    found = render(scene, RenderSettings(bounces=2, spp=64), seed=1)
    assert (found.bounces == 1).any() and not (found.bounces > 1).any()


def test_a_lamp_on_a_wall_lights_the_room() -> None:
    """Against plain path tracing: a lamp that lies in the ceiling's very plane shines down, and not on the ceiling."""
    lamp = Laser(baseline_m=(0.3, -2.0, 1.2), cone_deg=360)
    scene = Scene("ceiling", (room(),), looking((0, 0, 0), (0, 0, 1)), lamp)
    found = render(scene, RenderSettings(bounces=3, spp=64), seed=1)
    edges_m = np.array([0.0, 100.0])
    direct, all_light = (path_traced(scene, edges_m, bounces=most, spp=256).sum() for most in (1, 3))
    assert found.radiance[found.bounces > 1].sum() == pytest.approx(all_light - direct, rel=0.02)


def test_a_lamp_close_behind_a_panel_does_not_shine_through_it() -> None:
    """The panel is 1 mm before the lamp, and 3 m from the wall that is in view."""
    corners = np.array([(0.5, -1, -0.001), (2.5, -1, -0.001), (2.5, 1, -0.001), (0.5, 1, -0.001)], float)
    panel = Surface(corners, FACES, WALLS, name="panel")
    lamp = Laser(baseline_m=(1.5, 0, 0), cone_deg=180)
    scene = Scene("panel", (oracles.wall(3.0, 0.5), panel), oracles.camera(8, 8, 20), lamp)
    assert render(scene, RenderSettings(bounces=1, grid=4)).returns == 0


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_lamp_on_a_mirror_lights_nothing_by_way_of_it(turn: float) -> None:
    """As one on a wall, it shines into the room alone; a tenth of a millimetre before the mirror it lights all twice,
    less what the metal absorbs."""
    turned = np.array([(np.cos(turn), -np.sin(turn), 0), (np.sin(turn), np.cos(turn), 0), (0, 0, 1)])
    corners = np.array([(-2, 2, -2), (2, 2, -2), (2, 2, 3), (-2, 2, 3)], float)
    mirror = Surface(corners @ turned.T, FACES, Material("conductor"), name="mirror")
    wall, light = oracles.wall(-3.0, 0.7, half_size_m=1.5), []
    for height_m in (2.0, 1.9999):
        camera = looking((0, 0, 0), (0, 0, 1))
        baseline_m = tuple(camera.rotation.T @ turned @ np.array([0.3, height_m, 1.2]))
        scene = Scene("lamp", (wall, mirror), camera, Laser(baseline_m=baseline_m, cone_deg=360))
        found = render(scene, RenderSettings(bounces=2, spp=4, grid=4), seed=1)
        light.append([found.radiance[found.bounces == met].sum() for met in (1, 2)])
    assert light[0][1] == 0 and light[1][1] == pytest.approx(light[0][0], rel=0.01)


def test_a_camera_on_a_surface_is_refused() -> None:
    """Which side of the floor its rays begin on would be up to rounding."""
    settings = RenderSettings(bounces=1, grid=2)

    def seen_from(height_m: float) -> Scene:
        return Scene("room", (room(),), looking((0, height_m, 1), (0, height_m, -1)))

    for height_m in (-2.0, -2.0 + 1e-7):
        with pytest.raises(InputError, match=r"^scene room: the camera at \(0, -2, 1\) lies on a surface, \S+ m"):
            render(seen_from(height_m), settings)
    assert render(seen_from(-1.9), settings).depth_m.min() > 0.1
