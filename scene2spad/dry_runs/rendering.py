"""Dry run of `render`: its plan from the usual pilot, and its cost from trials of two smaller images.

Time grows as a constant and a slope by pixels. Returns and the file's bytes grow as a sqrt(p) + b p by the p pixels:
edges, along which pixels have several returns, are lines, all else is an area.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from render.engine import planned, render
from render.scene.traced_scene import TracedScene
from render.settings import MIN_PIXEL_BYTES, Plan, RenderSettings
from render.transient.data import exr_bytes
from scene2spad.datasets.rendering import quiet
from scene2spad.dry_runs.resources import peak_bytes, timed
from scenes.limits import memory_limit, require_memory
from scenes.model import Scene

TRIAL_PIXELS = 9216  # of the larger trial; a quarter of it where the request has no more
SMALLER = 4  # times fewer pixels has the other trial
FIRST_PIXELS = 64  # compiles, so that the trials' times are those of tracing
# Fitted to the peaks of 14 renders of 64 x 64 to 640 x 480 pixels, of one bounce and of 24, with their pictures: either
# the launches' memory, as a trial's, or libraries, layers and all returns while they are merged and written.
LIBRARY_BYTES, PIXEL_BYTES, RETURN_BYTES = 265e6, 1400, 46
MEMORY_MARGIN = 1.1


class Trial(NamedTuple):
    """Hold what the render of one smaller image took."""

    width: int
    height: int
    wall_s: float
    cpu_s: float
    rays: int
    returns: int
    file_bytes: int
    spp: int

    @property
    def pixels(self) -> int:
        return self.width * self.height


def dry_run(scene: Scene, settings: RenderSettings, seed: int) -> dict:
    """Return plan, memory and estimated work of a render, and what the estimate is based on."""
    camera = scene.camera
    pixels = camera.width * camera.height
    require_memory(MIN_PIXEL_BYTES * pixels, f"a render of {camera.width} x {camera.height}")
    with quiet():
        plan, planning = timed(lambda: planned(TracedScene(scene), settings, seed))
        _, compiling = timed(lambda: render(_smaller(scene, FIRST_PIXELS), settings, seed=seed, plan=plan))
        trials = [_trial(scene, size, settings, seed, plan) for size in trial_sizes(pixels)]
    estimate = estimated(trials, planning.wall_s + compiling.wall_s, pixels)
    sizes = " and ".join(f"{one.width} x {one.height} pixels in {one.wall_s:.2f} s" for one in trials)
    return {
        "dry_run": True,
        "scene": scene.name,
        "pixels": [camera.width, camera.height],
        "plan": plan.to_dict(),
        "memory": {
            "peak_bytes": peak_of_render(pixels, estimate["returns"], peak_bytes()),
            "limit_bytes": memory_limit(),
        },
        "estimate": estimate,
        "basis": f"the plan's pilot, and trials of {sizes} by that plan, extended to {pixels} pixels; other work on "
        "this machine, and paths on top where the target is missed, take more time",
    }


def trial_sizes(pixels: int) -> list[int]:
    """Return the pixels of the trials for an image of so many: at the most the image itself."""
    largest = TRIAL_PIXELS if pixels > TRIAL_PIXELS else TRIAL_PIXELS // SMALLER
    return [pixels] if pixels <= largest else [largest // SMALLER, largest]


def peak_of_render(pixels: int, returns: float, trial_bytes: float) -> int:
    """Return the memory that a render's process takes at its peak, rather too much than too little [bytes].

    `trial_bytes` is the peak of this process, which has made the trials.
    """
    made = LIBRARY_BYTES + PIXEL_BYTES * pixels + RETURN_BYTES * returns
    return round(MEMORY_MARGIN * max(trial_bytes, made))


def estimated(trials: Sequence[Trial], start_s: float, pixels: int) -> dict[str, float]:
    """Return the estimate for so many pixels from one trial of as many, or from two smaller ones."""
    small, large = trials[0], trials[-1]

    def line(one: float, other: float) -> float:
        slope = max(0.0, other - one) / max(large.pixels - small.pixels, 1)
        return other + slope * (pixels - large.pixels)

    def edges_and_area(one: float, other: float) -> float:
        if large.pixels == small.pixels:
            return other * pixels / large.pixels
        ends = math.sqrt(small.pixels), math.sqrt(large.pixels)
        area = (other / ends[1] - one / ends[0]) / (ends[1] - ends[0])
        area = min(max(area, 0.0), other / large.pixels)
        return (other / ends[1] - area * ends[1]) * math.sqrt(pixels) + area * pixels

    return {
        "seconds": start_s + line(small.wall_s, large.wall_s),
        "cpu_seconds": line(small.cpu_s, large.cpu_s),
        "rays": round(edges_and_area(small.rays, large.rays)),
        "spp": large.spp,
        "returns": round(edges_and_area(small.returns, large.returns)),
        "file_bytes": round(edges_and_area(small.file_bytes, large.file_bytes)),
    }


def _trial(scene: Scene, pixels: int, settings: RenderSettings, seed: int, plan: Plan) -> Trial:
    made, cost = timed(lambda: render(_smaller(scene, pixels), settings, seed=seed, plan=plan))
    rays, spp = made.meta["rays"], made.meta["plan"]["spp"]
    return Trial(made.width, made.height, cost.wall_s, cost.cpu_s, rays, made.returns, len(exr_bytes(made)), spp)


def _smaller(scene: Scene, pixels: int) -> Scene:
    """Return the same view in about so many pixels, or as it is where it has fewer."""
    camera = scene.camera
    factor = min(1.0, math.sqrt(pixels / (camera.width * camera.height)))
    size = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    return replace(scene, camera=camera.resized(*size))
