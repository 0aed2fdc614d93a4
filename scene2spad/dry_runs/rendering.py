"""Dry run of `render`: its plan from the usual pilot, and its cost from a trial of a smaller image."""

from __future__ import annotations

import math
from dataclasses import replace

from render.engine import planned, render
from render.scene.traced_scene import TracedScene
from render.settings import MIN_PIXEL_BYTES, RenderSettings
from render.transient import Transient
from render.transient.data import exr_bytes
from scene2spad.datasets.rendering import quiet
from scene2spad.dry_runs.resources import Cost, memory, timed
from scenes.limits import require_memory
from scenes.model import Scene

TRIAL_PIXELS = 2304
FIRST_PIXELS = 64  # compiles, so that the trial's time is that of tracing


def dry_run(scene: Scene, settings: RenderSettings, seed: int) -> dict:
    """Return plan, memory and estimated work of a render, and what the estimate is based on."""
    camera = scene.camera
    pixels = camera.width * camera.height
    require_memory(MIN_PIXEL_BYTES * pixels, f"a render of {camera.width} x {camera.height}")
    with quiet():
        plan, planning = timed(lambda: planned(TracedScene(scene), settings, seed))
        _, compiling = timed(lambda: render(_smaller(scene, FIRST_PIXELS), settings, seed=seed, plan=plan))
        trial, cost = timed(lambda: render(_smaller(scene, TRIAL_PIXELS), settings, seed=seed, plan=plan))
    traced = trial.height * trial.width
    return {
        "dry_run": True,
        "scene": scene.name,
        "pixels": [camera.width, camera.height],
        "plan": plan.to_dict(),
        "memory": memory(MIN_PIXEL_BYTES * pixels),
        "estimate": _estimate(trial, cost, planning.wall_s + compiling.wall_s, pixels / traced),
        "basis": f"the plan's pilot, and a trial of {trial.width} x {trial.height} pixels by that plan in "
        f"{cost.wall_s:.2f} s, scaled by the number of pixels; larger pixels take more rays each, so this is "
        "rather too much, but for other work on this machine",
    }


def _estimate(trial: Transient, cost: Cost, start_s: float, times: float) -> dict[str, float]:
    return {
        "seconds": start_s + cost.wall_s * times,
        "cpu_seconds": cost.cpu_s * times,
        "rays": round(trial.meta["rays"] * times),
        "spp": trial.meta["plan"]["spp"],
        "returns": round(trial.returns * times),
        "file_bytes": round(len(exr_bytes(trial)) * times),
    }


def _smaller(scene: Scene, pixels: int) -> Scene:
    """Return the same view in about so many pixels, or as it is where it has fewer."""
    camera = scene.camera
    factor = min(1.0, math.sqrt(pixels / (camera.width * camera.height)))
    size = (max(1, round(side * factor)) for side in (camera.width, camera.height))
    return replace(scene, camera=camera.resized(*size))
