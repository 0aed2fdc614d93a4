"""Choose the rays of direct light for all views of a set together, from the errors of some of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from render.direct.integrator import default_edge_threshold, direct_light
from render.error import estimate, response
from render.planning import (
    DEFAULT_ERROR,
    GRID_POWER,
    PILOT_GRID,
    WIDEST_TOLERANCE_M,
    direct_fraction_of,
    finer_pilot,
    pilot_pixels,
)
from render.scene.traced_scene import TracedScene
from render.settings import GRIDS, RenderSettings
from render.transient.samples import select_pixels

THRESHOLD_POWER = 0.7  # with which errors fall as fewer edges are left alone (0.7 at grid 4, 0.5 at 5)
# Below PILOT_GRID errors rise with a power of 1.4 to 2.8, which views and their size decide: they are measured there.
# As fewer edges are left alone they fall with one of 0.4 to 0.7 at grid 2, 0.2 to 0.6 at 3 (rooms and clutter).
COARSE_THRESHOLD_POWER = 0.4


def direct_error(world: TracedScene, settings: RenderSettings, seed: int, grid: int = PILOT_GRID) -> float:
    """Return nRMSE of a view's direct light at a grid, by more rays a side in some of its pixels, as a render states
    it."""
    camera, checked = world.scene.camera, pilot_pixels(world, seed)
    tolerance_m = WIDEST_TOLERANCE_M if settings.direct_tolerance_m is None else settings.direct_tolerance_m
    light = direct_light(world, np.arange(camera.height * camera.width), grid, tolerance_m)
    coarse = response(select_pixels(light.samples, checked), checked)
    return estimate(coarse, finer_pilot(world, checked, grid, default_edge_threshold(grid))).total


def rays_for_all(errors: Sequence[float], settings: RenderSettings) -> tuple[int, float]:
    """Return grid and `edge_threshold` at which many views together, their mean squared error, meet direct light's
    target.

    `errors` are some views' `direct_error`. One choice for all costs less than each view's own: rays grow with the
    square of the grid, so that the views that need most would take most of them for the least gain. Between two grids
    the coarser one follows more edges: that costs no more than finer cells everywhere (measured in rooms).
    Below PILOT_GRID the grid is a guess, and `measured_rays_for_all` begins with it.
    """
    ideal = PILOT_GRID * _times_allowed(errors, settings) ** (1 / GRID_POWER)
    ideal = min(max(ideal, GRIDS[0]), GRIDS[-1])
    grid = math.floor(ideal + 1e-6)
    return grid, default_edge_threshold(grid) * (grid / ideal) ** (GRID_POWER / THRESHOLD_POWER)


def measured_rays_for_all(
    errors_at: Callable[[int], list[float]], settings: RenderSettings
) -> tuple[int | None, float | None, list[float]]:
    """Return grid and `edge_threshold` as `rays_for_all`, and the errors at PILOT_GRID; `errors_at` a grid measures
    those of some views. Below PILOT_GRID a grid is taken only if errors that are measured there say so. None without
    any: each view is to plan for itself.
    """
    errors = errors_at(PILOT_GRID)
    if not errors:
        return None, None, errors
    grid, threshold = rays_for_all(errors, settings)
    while grid < PILOT_GRID:
        found = errors_at(grid)
        enough = _edges_for_all(found, grid, settings) if found else None
        if enough is not None:
            return grid, enough, errors
        grid, threshold = grid + 1, default_edge_threshold(grid + 1)
    return grid, threshold, errors


def _edges_for_all(errors: Sequence[float], grid: int, settings: RenderSettings) -> float | None:
    """Return the `edge_threshold` at which views of these errors at a grid below PILOT_GRID meet their target together;
    None where the next grid costs less."""
    ratio = _times_allowed(errors, settings)
    threshold = default_edge_threshold(grid) * min(1, 1 / ratio if ratio else 1) ** (1 / COARSE_THRESHOLD_POWER)
    return threshold if threshold >= default_edge_threshold(grid + 1) else None


def _times_allowed(errors: Sequence[float], settings: RenderSettings) -> float:
    """Return the root mean square of errors, over that which direct light may have."""
    target = DEFAULT_ERROR if settings.error is None else settings.error
    return math.sqrt(np.mean(np.square(errors))) / (direct_fraction_of(settings, settings.bounces == 1) * target)
