"""The renderer under test, behind one function: the only place that changes with its interface."""

from __future__ import annotations

from dataclasses import fields

from render import engine
from render.direct import least_share_of
from render.returns import Samples
from render.settings import Plan, RenderSettings
from render.world import World
from studies.bench.settings import Method, grid_beside

MERGED_M = 0.0  # nothing is merged: a histogram follows at once
HAS_FILTER = "filter" in {f.name for f in fields(RenderSettings)}


def has(method: Method) -> bool:
    return HAS_FILTER or not method.filter


def trace(world: World, method: Method, bounces: int, quality: int, seed: int) -> Samples:
    """Merged samples of all pixels, nothing planned or estimated: every setting is forced."""
    grid, spp = (quality, 1) if method.unit == "grid" else (grid_beside(quality), quality)
    forced = {"bounces": bounces, "spp": spp, "grid": grid}
    switches = {"filter": method.filter} if HAS_FILTER else {}
    exact = {"least_share": least_share_of(grid), "direct_tolerance_m": MERGED_M}
    settings = RenderSettings(**forced, **exact, **switches)
    known = {f.name for f in fields(Plan)}
    plan = Plan(**forced, **exact, ambient=False, reasons=(), **{k: v for k, v in switches.items() if k in known})
    return engine.trace(world, plan, settings, seed=seed).samples
