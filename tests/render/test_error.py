"""The stated error where the checked pixels are not like the image: a highlight, rare bright paths."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from render.engine import remedy_reasons, render
from render.error import PULSE_POWER, IndirectErrors, checked_pixels, estimate, power_of, response, target_verdict
from render.indirect.schedule import Schedule
from render.planning import PILOT_PIXELS, cell_narrowing, make_plan
from render.scene.traced_scene import TracedScene
from render.settings import WIDEST_GROWTH, WIDEST_INDIRECT_M, RenderSettings
from render.transient import Transient
from render.transient.samples import Samples
from scene2spad.bench.hard import oracles
from scenes import Camera, Material, Scene, Surface
from scenes.constants import REFERENCE_BINS
from scenes.geometry.shapes import box

WIDTH, HEIGHT = 40, 30


def responses(transient: Transient) -> np.ndarray:
    near, far = transient.path_near_m.astype(float), transient.path_far_m.astype(float)
    samples = Samples(transient.return_pixel, (near + far) / 2, (far - near) / 2, transient.radiance, transient.bounces)
    return response(samples, np.arange(WIDTH * HEIGHT))


def groove_with_a_bright_chip() -> Scene:
    """A V-groove, and 0.3 m before the camera a white chip of 2 x 2 pixels, which holds most of the squared power."""
    scene = oracles.groove_scene(WIDTH, HEIGHT, albedo=0.6)
    vertices, faces, uv = box((0.014, 0.014, 0.001))
    chip = Surface(vertices + [0.05, 0.04, -0.3], faces, Material(albedo=0.9), uv=uv, name="chip")
    return replace(scene, surfaces=(*scene.surfaces, chip))


def test_a_highlight_of_a_few_pixels_counts_whether_it_is_checked_or_not():
    """All seeds have the same noise, and in the mean the same power: each has to state it, whatever pixels it checks.

    75 blocks of pixels and 4 batches tell the noise of a render to 10 %, 6 seeds the true one to 5 %. Batches continue
    one low-discrepancy set, so that their mean is better than they differ: 30 seeds state 1.17 times the true noise.
    """
    assert WIDTH * HEIGHT > 4 * PILOT_PIXELS
    scene, settings = groove_with_a_bright_chip(), RenderSettings(bounces=2, spp=64, grid=2)
    found = [render(scene, settings, seed=seed) for seed in range(6)]
    images = np.array([responses(one) for one in found])
    power = (images.mean(axis=0) ** 2).sum(axis=1)
    assert np.sort(power)[-12:].sum() > 0.8 * power.sum()
    true = np.sqrt(images.var(axis=0, ddof=1).sum() / power.sum())
    stated = np.array([one.meta["relative_error"]["monte_carlo"] for one in found])
    assert np.all(stated > true / 1.2) and np.all(stated < 1.5 * true)
    assert np.sqrt(np.mean(stated**2)) == pytest.approx(1.17 * true, rel=0.15)


def test_the_brightest_pixels_stand_for_themselves_where_they_hold_much():
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0.5, 1.5, 5000)
    pilot = np.sort(rng.choice(5000, 256, replace=False))
    even = checked_pixels(pilot, radiance)
    assert np.array_equal(even.pixel, pilot) and len(even.added) == 0
    assert even.mean(radiance**2) == pytest.approx(np.mean(radiance**2), rel=0.1)
    bright = np.array([*pilot[:3], 7, 4999])
    radiance[bright] = 100
    checked = checked_pixels(pilot, radiance)
    assert np.all(np.isin(bright, checked.pixel)) and np.all(np.diff(checked.pixel) > 0)
    assert np.array_equal(np.union1d(pilot, checked.added), checked.pixel)
    assert checked.weight.sum() == pytest.approx(5000)
    assert np.all(checked.weight[np.isin(checked.pixel, bright)] == 1)
    assert checked.mean(radiance**2) == pytest.approx(np.mean(radiance**2), rel=0.01)
    assert np.mean(radiance[pilot] ** 2) > 5 * np.mean(radiance**2)  # the pilot met three of five
    few = checked_pixels(np.arange(9), np.arange(9.0))
    assert np.array_equal(few.pixel, np.arange(9)) and np.all(few.weight == 1)


def test_the_power_of_light_is_the_same_at_any_distance():
    """Two returns 0.1 m apart in a pixel, at 4 m and at a kilometre, in float32 as samples are."""
    near, far = (
        power_of(Samples(np.zeros(2, int), *(np.array(column, np.float32) for column in (path, [0.05] * 2, [1, 3])), 1))
        for path in ([4.0, 4.125], [1024.0, 1024.125])
    )
    assert far == pytest.approx(near, rel=1e-6)


def test_pixels_count_as_often_as_they_stand_for_others():
    pixels = np.arange(2)
    light = Samples(pixels, np.full(2, 8.0), np.zeros(2), np.array([3.0, 1.0]), np.full(2, 1))
    fine = response(light, pixels)
    stated = estimate(fine * [[1.0], [1.1]], fine, weight=np.array([1.0, 9.0]))
    assert stated.direct == pytest.approx(np.sqrt(9 * 0.1**2 / (9 + 9)))
    assert stated.pixel_median == stated.pixel_p95 == pytest.approx(0.1)  # of those that stand for most


def test_scales_are_for_the_image_and_not_for_its_pixels():
    pixels = np.arange(100)
    light = Samples(pixels, np.full(100, 8.0), np.zeros(100), np.ones(100), np.full(100, 2))
    mean, nothing = response(light, pixels), np.zeros((100, 1))
    noise = np.full(100, 0.01**2 * PULSE_POWER)
    alike, scaled = (
        estimate(nothing, 0 * mean, mean, IndirectErrors(noise, noise_scale=scale)) for scale in (1.0, 9.0)
    )
    assert alike.monte_carlo == pytest.approx(0.01, rel=1e-3) and scaled.monte_carlo == pytest.approx(0.03, rel=1e-3)
    assert scaled.pixel_median == alike.pixel_median == pytest.approx(0.01, rel=1e-3)
    lost = estimate(nothing, 0 * mean, mean, IndirectErrors(clamped=noise, clamped_scale=4.0))
    assert lost.clamped == lost.total == pytest.approx(0.02, rel=1e-3)


def test_cells_are_as_wide_as_the_target_allows():
    assert cell_narrowing(0.02, polished=False) == 1
    assert cell_narrowing(0.02, polished=True) == pytest.approx(0.5**0.5)
    # the error goes with the square of the width: a quarter of the target, whatever the target
    for target in (1e-4, 1e-3, 5e-3):
        assert cell_narrowing(target, polished=True) ** 2 * 0.01 == pytest.approx(target / 4)


def test_plans_say_how_wide_cells_are_and_settings_rule():
    scene = groove_with_a_bright_chip()
    plan = render(scene, RenderSettings(bounces=2, spp=16, grid=2, error=1e-3)).meta["plan"]
    assert plan["indirect_tolerance_m"] == pytest.approx(WIDEST_INDIRECT_M * cell_narrowing(1e-3, polished=False))
    assert plan["indirect_growth"] == pytest.approx(WIDEST_GROWTH * cell_narrowing(1e-3, polished=False))
    asked = RenderSettings(bounces=2, spp=16, grid=2, error=1e-3, indirect_tolerance_m=0.02, indirect_growth=0.0)
    plan = render(scene, asked).meta["plan"]
    assert plan["indirect_tolerance_m"] == 0.02 and plan["indirect_growth"] == 0


def just_above_the_floor_of_a_room() -> Scene:
    """Show a floor a tenth of a millimetre away, 10^8 times as bright as the walls."""
    vertices, faces, uv = box((4, 3, 5))
    walls = Surface(vertices + [0, 1.5, 0], faces[:, ::-1], Material(albedo=0.6), uv=uv)
    return Scene("floor", (walls,), Camera.look_at((0, 1e-4, 1), (0, 1e-4, 0), fov_deg=60, width=8, height=8))


def test_forced_paths_plan_for_no_smaller_error_than_can_be_asked_for():
    """Else cells have no width where direct light is all but everything: 20 GB of them, before the render began."""
    world = TracedScene(just_above_the_floor_of_a_room())
    forced, asked = (
        make_plan(world, RenderSettings(bounces=3, **settings), seed=1) for settings in ({"spp": 64}, {"error": 1e-4})
    )
    assert forced.indirect_growth == asked.indirect_growth and forced.indirect_tolerance_m == asked.indirect_tolerance_m
    assert forced.grid <= asked.grid


@pytest.mark.parametrize(("total", "words"), [(0.03, ("indirect light: too few paths; ask",)), (0.01, ())])
def test_more_paths_are_asked_for_only_where_the_target_is_missed(total, words):
    """The pilot's own estimate may be 40 times too large: a remedy beside a target that is met contradicts it."""
    plan, error = SimpleNamespace(target=0.02), SimpleNamespace(total=total, truncated=0.0)
    empty = np.zeros(0, np.int64)
    schedule = Schedule(empty, empty, empty, remedy="ask")
    assert remedy_reasons(plan, SimpleNamespace(schedule=schedule), error) == words
    assert remedy_reasons(plan, SimpleNamespace(schedule=None), error) == ()


def test_light_beyond_the_last_bounce_is_part_of_the_error():
    """Take the share left out for twice as uneven as light spread over the whole period."""
    even = np.full((4, REFERENCE_BINS), 1.0)
    stated = estimate(even, even, errors=IndirectErrors(left_out=0.1))
    assert stated.truncated == pytest.approx(0.1 / 0.9 * np.sqrt(2)) == stated.total == stated.pixel_median
    assert stated.to_dict()["truncated"] == stated.truncated
    assert "light beyond the last bounce" in target_verdict(stated, 0.02, 4)
    whole = estimate(even, even)
    assert whole.total == 0 and "truncated" not in whole.to_dict()


@pytest.mark.parametrize(("albedo", "beyond"), [(0.6, False), (0.98, True)])
def test_a_white_room_states_what_its_bounces_leave_out(albedo: float, beyond: bool):
    vertices, faces, uv = box((6, 6, 6))
    walls = Surface(vertices, faces[:, ::-1], Material(albedo=albedo), uv=uv)
    meta = render(Scene("white", (walls,), oracles.camera(8, 8, 50)), RenderSettings(error=0.1), seed=1).meta
    left_out = meta["plan"].get("left_out", 0.0)
    assert (left_out > 0.05) == beyond and ("truncated" in meta["relative_error"]) == beyond
    # of light that is even; what is first lit, and seen, is brighter
    assert not beyond or 0.4 * 0.98**63 < left_out < 1.2 * 0.98**63
    assert meta["relative_error"]["total"] > meta["relative_error"].get("truncated", 0.0)
