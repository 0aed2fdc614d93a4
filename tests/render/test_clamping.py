"""A clamp on paths: what it takes is what is missing, in pixels, over path length, and in the stated error."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from render import engine
from render import pipeline as tracing
from render.clamping import FLOOR, RADIUS, make_clamp
from render.engine import render
from render.error import ErrorEstimate, power_of, response
from render.pipeline import LightSamples, trace
from render.planning import make_plan
from render.reference import path_traced
from render.scene.traced_scene import TracedScene
from render.settings import Plan, RenderSettings
from scenes import Camera, InputError, Laser, Material, Scene
from scenes.library.hard_cases import quad

WIDTH, HEIGHT = 16, 12
PIXELS = np.arange(WIDTH * HEIGHT)


@cache
def scene() -> Scene:
    """A corner, and a panel of polished metal that throws the flash on it: few paths are far brighter than most."""
    wall, metal = Material(albedo=0.7), Material("roughconductor", roughness=0.05, eta=2.9, k=3.1)
    surfaces = (
        quad([(-2, -1, 1), (2, -1, 1), (2, -1, -4), (-2, -1, -4)], wall, "floor"),
        quad([(-2, -1, -4), (2, -1, -4), (2, 2, -4), (-2, 2, -4)], wall, "far wall"),
        quad([(-2, -1, 1), (-2, -1, -4), (-2, 2, -4), (-2, 2, 1)], wall, "left wall"),
        quad([(0.7, -1, -3.6), (1.4, -1, -2.6), (1.4, 0.6, -2.6), (0.7, 0.6, -3.6)], metal, "panel"),
    )
    view = Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=60, width=WIDTH, height=HEIGHT)
    return Scene("sparks", surfaces, view, Laser("flood"))


def light(seed: int, clamp: float | None, *, spp: int = 16, **more: object) -> LightSamples:
    forced = {
        "bounces": 3,
        "spp": spp,
        "grid": 2,
        "edge_threshold": 1.0,
        "direct_tolerance_m": 1e-3,
        "clamp": clamp,
    } | more
    plan = Plan(**forced, ambient=False, reasons=())
    return trace(TracedScene(scene()), plan, RenderSettings(**forced), seed=seed, pilot=PIXELS)


def totals(traced: LightSamples) -> np.ndarray:
    samples = traced.indirect_samples
    return np.bincount(samples.pixel, weights=samples.radiance, minlength=len(PIXELS))


@pytest.mark.parametrize(
    "more", [{}, {"spp": 64}, {"filter": True}, {"spp": 1}], ids=["own", "shared", "filtered", "one"]
)
def test_what_is_removed_is_what_the_same_paths_had_more(more):
    """Path by path: with one schedule the clamped light and the removed light add up to the light without a clamp."""
    free, clamped = light(3, None, adaptive=False, **more), light(3, 2.0, adaptive=False, **more)
    removed = clamped.indirect.removed
    assert removed.pixels.sum() > 1e-3 * totals(free).sum()
    whole = totals(clamped) + removed.pixels
    if "filter" in more:  # regions share what is left of it among pixels
        assert whole.sum() == pytest.approx(totals(free).sum(), rel=2e-3)
    else:
        assert whole == pytest.approx(totals(free), rel=1e-4, abs=1e-6 * whole.mean())
    by_region = removed.moments[0].sum(axis=2).mean(axis=1)[removed.region]
    assert by_region.sum() == pytest.approx(removed.pixels.sum(), rel=1e-4)


@pytest.mark.slow
def test_removed_energy_is_what_an_independent_reference_has_more():
    """Plain paths have what the clamped light lacks: within 4.5 standard errors, and these within 20 % of it."""
    edges_m = np.linspace(0, 40, 3)
    plain = np.array([path_traced(scene(), edges_m, bounces=3, spp=128, seed=s).sum() for s in range(8)])
    direct = path_traced(scene(), edges_m, bounces=1, spp=512, seed=99).sum()
    runs = [light(s, 0.5, spp=64) for s in range(8)]
    lacking = plain - direct - np.array([totals(run).sum() for run in runs])
    removed = np.array([run.indirect.removed.pixels.sum() for run in runs])
    error = np.hypot(lacking.std(ddof=1), removed.std(ddof=1)) / np.sqrt(8)
    assert abs(lacking.mean() - removed.mean()) < 4.5 * error + 2e-3 * plain.mean()
    assert error < 0.2 * removed.mean()


@pytest.mark.slow
def test_stated_error_of_a_clamp_is_the_true_one():
    """The light that many clamped renders lack, squared after the pulse, against what they state in the mean.

    Rare bright paths make single statements uneven: half of them lie below two thirds of the truth. Of 120 runs the
    mean is 0.67 of it, and 0.67 to 0.68 of every 40 of these: removed light is less even than its regions are.
    """
    count = 40
    runs, free = ([light(first + s, clamp, spp=64) for s in range(count)] for first, clamp in ((0, 0.5), (100, None)))
    lacking = [
        response(one.indirect_samples, PIXELS) - response(other.indirect_samples, PIXELS)
        for one, other in zip(free, runs, strict=True)
    ]
    # products of different renders alone: their noise cancels
    total, squares = np.sum(lacking, axis=0), np.sum(np.square(lacking), axis=0)
    true = (total**2 - squares).sum() / (count * (count - 1))
    stated = [run.indirect.removed.squared_error().sum() for run in runs]
    assert 0.6 < np.sqrt(np.mean(stated) / true) < 1.2


def test_limits_follow_the_light_around_and_not_the_number_of_paths():
    direct = np.zeros((HEIGHT, WIDTH))
    direct[:, 8:] = 4.0
    clamp = make_clamp(direct.ravel(), scene().camera, 10)
    limit = clamp.limit.reshape(HEIGHT, WIDTH)
    assert limit[:, 8 + RADIUS :] == pytest.approx(40) and limit[:, : 8 - RADIUS] == pytest.approx(10 * FLOOR * 2)
    assert (np.diff(limit, axis=1) >= 0).all()
    assert clamp.region.reshape(HEIGHT, WIDTH)[[0, 3, 4], [3, 4, 0]].tolist() == [0, 1, 4]
    # of paths of one kind: those that a block shares are weighted, and no path of theirs is as bright
    few, many = (
        np.array([light(s, 1.0, spp=n, adaptive=False).indirect.removed.pixels.sum() for s in range(8)])
        for n in (16, 128)
    )
    error = np.hypot(few.std(ddof=1), many.std(ddof=1)) / np.sqrt(8)
    assert abs(few.mean() - many.mean()) < 4.5 * error and error < 0.3 * many.mean()


def test_a_render_says_what_it_removed_and_counts_it():
    free, clamped = (
        render(scene(), RenderSettings(bounces=3, spp=64, grid=2, clamp=clamp), seed=1) for clamp in (None, 0.5)
    )
    error = clamped.meta["relative_error"]
    assert free.meta["relative_error"]["clamped"] == 0 < error["clamped"] < error["total"]
    assert clamped.meta["plan"]["clamp"] == 0.5 and any(
        "clamp: paths" in why for why in clamped.meta["plan"]["reasons"]
    )
    assert error["monte_carlo"] < free.meta["relative_error"]["monte_carlo"]
    again = render(scene(), RenderSettings(bounces=3, spp=64, grid=2, clamp=0.5), seed=1)
    assert np.array_equal(again.radiance, clamped.radiance) and np.array_equal(again.error, clamped.error)


def test_a_target_out_of_reach_is_not_chased():
    """Ten times the planned work does not help: as many paths again are all, and the plan names what would help."""
    settings = RenderSettings(bounces=3, error=0.02, grid=2)
    world, plan, traced = TracedScene(scene()), make_plan(TracedScene(scene()), settings, 1), light(1, None)
    before = traced.schedule._replace(spp=np.full(12, 160))
    traced = traced._replace(schedule=before)
    near, far = (ErrorEstimate(mc, 0.0, 0.0, mc, 0.0, 0.01, 0.05, worst_share=0.9) for mc in (0.03, 0.1))
    for error, least, most in ((near, 1, 3.5), (far, 0.5, 1.2)):
        more = engine.additional_schedule(world, plan, settings, traced, error, 3.0)
        assert least < more.cost / before.cost < most
    assert engine.additional_schedule(world, plan, settings, traced, replace(far, total=0.01), 3.0) is None
    assert engine.clamp_reasons(plan, settings, traced, near) == ()
    (reason,) = engine.clamp_reasons(plan, settings, traced, far)
    assert "stopped" in reason and "25 times" in reason and "--clamp" not in reason  # 16 of 192 pixels are not few
    (reason,) = engine.clamp_reasons(plan, settings, traced._replace(origin_m=np.zeros(4096)), far)
    assert "stopped" in reason and "25 times" in reason and "--clamp" in reason and "\n" not in reason


def test_a_pilot_that_asks_too_much_spends_little(monkeypatch):
    settings = RenderSettings(bounces=3, error=0.02, grid=2)
    world = TracedScene(scene())
    plan = make_plan(world, settings, 1)
    direct = light(1, None).direct

    def schedule(times: float) -> tuple[float, str]:
        """Cost and remedy where the pilot finds that many times the noise that the largest plan could meet."""
        power, each = power_of(direct)
        noise = times * plan.noise**2 * power / each * tracing.MAX_SPP / 12
        monkeypatch.setattr(tracing, "pilot_noise", lambda *_, **__: (np.full(12, noise), np.full(12, 1e9 * noise)))
        found, _ = tracing.planned_schedule(world, plan, settings, direct, np.zeros(len(PIXELS)), 1)
        return found.cost, found.remedy

    assert schedule(0.5)[0] == pytest.approx(tracing.MAX_SPP / 2, rel=0.05)
    cost, remedy = schedule(5)
    assert cost == pytest.approx(tracing.MAX_SPP, rel=0.05) and "--clamp" not in remedy
    cost, remedy = schedule(20)
    assert cost == pytest.approx(tracing.MAX_SPP_BY_DEFAULT, rel=0.05) and "--clamp" in remedy


@pytest.mark.parametrize("clamp", [0.0, -1.0, 1e7, float("nan")])
def test_clamps_that_mean_nothing_are_refused(clamp):
    with pytest.raises(InputError, match=r"^render: clamp \S+ is outside 0\.001 to 1000000\.0$"):
        RenderSettings(clamp=clamp)
