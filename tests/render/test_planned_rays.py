"""Test how many rays all views of a set take, and how a missed target is said."""

from dataclasses import replace

import numpy as np
import pytest

from render.engine import planned
from render.error import estimate, target_verdict
from render.scene.traced_scene import TracedScene
from render.set_planning import measured_rays_for_all, rays_for_all
from render.settings import RenderSettings
from scenes.library.catalog import load_scene


def test_many_views_get_the_rays_that_their_mean_squared_error_asks_for():
    """Errors fall with at least the power 1.3 of the grid, 0.7 of the edges; direct light alone has all that is aimed
    at."""
    alone = RenderSettings(bounces=1, error=0.01, target_fraction=1.0)
    for errors in ([0.01], [0.0, 0.01 * 2**0.5]):
        assert rays_for_all(errors, alone) == pytest.approx((4, 0.5), abs=1e-5)
    assert rays_for_all([0.0101 * 2**1.3], alone)[0] == 8
    assert rays_for_all([0.0], alone)[0] == 2 and rays_for_all([1.0], alone)[0] == 16
    grid, fraction = rays_for_all([0.012], alone)
    assert grid == 4 and 0.012 * (fraction / 0.5) ** 0.7 == pytest.approx(0.01)
    assert rays_for_all([0.01], RenderSettings(error=0.01, target_fraction=1.0))[0] > 4
    half = RenderSettings(error=0.01, direct_fraction=0.5)
    assert rays_for_all([0.005 * 2**1.3 * 1.001], half)[0] == 8


@pytest.mark.parametrize(
    ("target", "expected"),
    [(0.08, (2, 1.0)), (0.045, (2, 1.0 * (0.045 / 0.048) ** 2.5)), (0.03, (3, 2 / 3)), (0.018, (4, 0.5))],
)
def test_a_grid_below_the_pilots_is_taken_only_where_its_measured_error_meets_the_target(target, expected):
    """Errors of rooms: they rise with a power of 2.2 below grid 4. With 1.3, 0.03 was planned, and 0.04 found."""
    measured, asked = {2: 0.048, 3: 0.0204, 4: 0.0105}, []

    def errors_at(grid: int) -> list[float]:
        asked.append(grid)
        return [measured[grid]]

    settings = RenderSettings(bounces=1, error=target, target_fraction=1.0)
    grid, threshold, errors = measured_rays_for_all(errors_at, settings)
    assert (grid, threshold) == (expected[0], pytest.approx(expected[1])) and errors == [0.0105]
    assert asked == [4, *range(rays_for_all([0.0105], settings)[0], min(grid + 1, 4))]
    assert measured_rays_for_all(lambda grid: [], settings) == (None, None, [])
    asked.clear()
    assert measured_rays_for_all(errors_at, replace(settings, error=0.01))[0] == 4 and asked == [4]


def test_an_error_just_above_its_target_shows_the_digits_that_tell_them_apart():
    """It said that 0.02 misses the target of 0.02."""
    one = np.ones((4, 8))
    stated = replace(estimate(one, one), total=0.02003)
    assert "error of 0.02003 MISSES the target of 0.02;" in target_verdict(stated, 0.02, 4)
    assert "error: 0.02 stated, meets the target of 0.02" in target_verdict(replace(stated, total=0.02), 0.02, 4)


def test_direct_light_keeps_up_with_the_noise_of_many_forced_paths():
    """With 1,024 paths forced direct light kept the default target of 0.02: the render had four times their noise.

    A target that is asked for stays what it is, and so does the default where forced paths leave more noise.
    """
    world = TracedScene(load_scene("living-room", width=24, height=24))

    def plan(**settings):
        return planned(world, RenderSettings(bounces=3, **settings))

    few, many, asked = plan(spp=4), plan(spp=1024), plan(spp=1024, error=0.02)
    assert many.grid >= few.grid + 3 and many.direct_tolerance_m < 0.5 * few.direct_tolerance_m
    assert (few.grid, few.direct_tolerance_m) == (asked.grid, asked.direct_tolerance_m)
    assert few.target == many.target == asked.target == 0.02
