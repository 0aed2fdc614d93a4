"""The renderer under test, behind one function: the only place that changes with its interface."""

from __future__ import annotations

from render.direct.integrator import default_edge_threshold
from render.pipeline import trace as trace_light
from render.scene.traced_scene import TracedScene
from render.settings import Plan, RenderSettings
from render.transient.samples import Samples
from scene2spad.bench.rendering.settings import Method, grid_beside

MERGED_M = 0.0  # no direct returns are merged: a histogram follows at once
CELL_M = 0.02  # of indirect light: cells as wide as the histogram's bins (29 mm) would straddle them


def trace(world: TracedScene, method: Method, bounces: int, quality: int, seed: int) -> Samples:
    """Return merged samples of all pixels, nothing planned or estimated: every setting is forced."""
    grid, spp = (quality, 1) if method.unit == "grid" else (grid_beside(quality), quality)
    threshold = default_edge_threshold(grid)
    # a pilot would leave the filter out where it does not pay
    adaptive = not method.filter
    plan = Plan(bounces, spp, grid, False, (), threshold, MERGED_M, CELL_M, adaptive=adaptive, filter=method.filter)
    settings = RenderSettings(
        bounces=bounces,
        spp=spp,
        grid=grid,
        filter=method.filter,
        edge_threshold=threshold,
        direct_tolerance_m=MERGED_M,
    )
    return trace_light(world, plan, settings, seed=seed).samples
