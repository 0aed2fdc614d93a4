"""Scene -> Transient: plan, direct light, indirect light in independent batches, ambient light, error estimate."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Callable

import numpy as np

from render.direct import centre_layers, direct_light
from render.error import ErrorEstimate, estimate, merging_error, response
from render.indirect import ambient_light, indirect_light
from render.planning import BATCHES, make_plan, pilot_pixels
from render.returns import Samples, concatenate, merge, select, to_returns
from render.settings import Plan, RenderSettings
from render.transient import Transient
from render.world import World
from scenes.model import Scene

log = logging.getLogger(__name__)

STAGE_PLAN, STAGE_INDIRECT, STAGE_AMBIENT = 10, 11, 12
AMBIENT_SPP = 64
AMBIENT_BOUNCES = 6
FINER = 2  # direct light is checked, on the pilot's pixels, against this many times the cells a side

Progress = Callable[[str, float], None]


def derived_seed(seed: int, stage: int, scene: int = 0, number: int = 0) -> int:
    """A 32-bit seed for one pass of one stage of one scene: independent streams from one number."""
    return int(np.random.SeedSequence(seed, spawn_key=(stage, scene, number)).generate_state(1)[0])


def render(
    scene: Scene, settings: RenderSettings | None = None, *, seed: int = 0, progress: Progress | None = None
) -> Transient:
    """Render the time-resolved radiance that the camera's pixels receive from the laser.

    The same scene, settings and seed give the same bytes on any number of threads. A scene with nothing in view gives
    a transient without returns. `progress(what, share)` is called between passes. The plan, its reasons, the error
    estimate and everything needed to repeat the render are in the transient's `meta`.
    """
    settings = settings or RenderSettings()
    say = progress or (lambda what, share: None)
    world = World(scene)
    camera = scene.camera
    say("plan", 0.0)
    pilot_seed = derived_seed(seed, STAGE_PLAN)
    plan = make_plan(world, settings, pilot_seed)
    pixels = np.arange(camera.height * camera.width)
    say("direct light", 0.05)
    direct = direct_light(world, pixels, plan.grid, settings.direct_tolerance_m)
    layers = centre_layers(world)
    merged = direct.samples
    # where nothing is in view there is nothing to explain
    for line in (*scene.notes, *plan.reasons) if len(merged.pixel) else ():
        log.info("%s", line)
    checked = pilot_pixels(world, pilot_seed)
    start_m = _mean_path(merged, len(pixels))
    indirect, noise, batches = _indirect(world, plan, settings, start_m, checked, seed, say)
    coarse = response(_of_pixels(merged, checked), checked)
    fine = response(direct_light(world, checked, FINER * plan.grid).samples, checked)
    responses = [response(batch, checked) for batch in batches]
    error = estimate(coarse, fine, responses, _merging(batches, responses, settings, start_m, checked))
    merged = concatenate([merged, indirect])

    ambient = np.zeros((camera.height, camera.width), np.float32)
    if plan.ambient:
        say("ambient light", 0.9)
        ambient = ambient_light(world, AMBIENT_SPP, AMBIENT_BOUNCES, derived_seed(seed, STAGE_AMBIENT))
    rays = direct.rays + pixels.size * plan.spp * (2 * plan.bounces - 1) * (plan.bounces > 1)
    say("done", 1.0)
    return Transient(
        camera.height,
        camera.width,
        *to_returns(merged, len(pixels)),
        depth_m=layers.depth_m,
        normal=layers.normal,
        albedo=layers.albedo,
        ambient=ambient,
        mixed=direct.mixed.reshape(camera.height, camera.width),
        error=noise.reshape(camera.height, camera.width).astype(np.float32),
        meta=_meta(scene, settings, plan, seed, error, rays, direct.clipped),
    )


def _indirect(
    world: World,
    plan: Plan,
    settings: RenderSettings,
    start_m: np.ndarray,
    checked: np.ndarray,
    seed: int,
    say: Progress,
) -> tuple[Samples, np.ndarray, list[Samples]]:
    """Merged indirect samples of all pixels, each pixel's standard error, and each batch's samples where `checked`.

    `start_m` is the pixels' direct path, from which the cells that merge are counted.
    """
    pixels = np.arange(len(start_m))
    none = Samples(np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty(0), np.empty(0, np.uint8))
    if plan.bounces == 1:
        return none, np.zeros(len(pixels)), []
    count = min(BATCHES, plan.spp)
    merged, totals, batches = none, [], []
    for number in range(count):
        say("indirect light", 0.1 + 0.8 * number / count)
        batch_seed = derived_seed(seed, STAGE_INDIRECT, 0, number)
        total, seen, shares = np.zeros(len(pixels)), [none], [merged]
        for chunk in indirect_light(world, pixels, plan.spp // count, plan.bounces, batch_seed):
            total += np.bincount(chunk.pixel, weights=chunk.radiance, minlength=len(pixels))
            seen.append(_of_pixels(chunk, checked))
            share = chunk._replace(radiance=chunk.radiance / count)
            shares.append(merge(share, settings.indirect_tolerance_m, start_m, settings.indirect_growth))
        totals.append(total)
        batches.append(concatenate(seen))
        merged = merge(concatenate(shares), settings.indirect_tolerance_m, start_m, settings.indirect_growth)
    spread = np.std(totals, axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.zeros(len(pixels))
    return merged, spread, batches


def _merging(
    batches: list[Samples],
    responses: list[np.ndarray],
    settings: RenderSettings,
    start_m: np.ndarray,
    checked: np.ndarray,
) -> np.ndarray | None:
    """Squared error of merged indirect returns in the checked pixels, from even against odd batches."""
    if len(batches) < 2:
        return None
    raw, merged = [], []
    for half in (slice(0, None, 2), slice(1, None, 2)):
        count = len(batches[half])
        together = concatenate(batches[half])
        kept = merge(together, settings.indirect_tolerance_m, start_m, settings.indirect_growth)
        raw.append(sum(responses[half]) / count)
        merged.append(response(kept, checked) / count)
    return merging_error(tuple(raw), tuple(merged))


def _of_pixels(samples: Samples, pixels: np.ndarray) -> Samples:
    return select(samples, np.isin(samples.pixel, pixels))


def _mean_path(samples: Samples, pixels: int) -> np.ndarray:
    """Radiance-weighted mean path of each pixel [m], 0 where there is none."""
    total = np.bincount(samples.pixel, weights=samples.radiance, minlength=pixels)
    moment = np.bincount(samples.pixel, weights=samples.radiance * samples.path_m, minlength=pixels)
    return np.divide(moment, total, out=np.zeros(pixels), where=total > 0)


def _meta(
    scene: Scene, settings: RenderSettings, plan: Plan, seed: int, error: ErrorEstimate, rays: int, clipped: int
) -> dict:
    camera, laser = scene.camera, scene.laser
    return {
        "scene": scene.name,
        "scene_sha256": scene.digest(),
        "notes": list(scene.notes),
        "triangles": scene.triangles,
        "camera": {
            "pose": camera.pose.tolist(),
            "fov_deg": camera.fov_deg,
            "width": camera.width,
            "height": camera.height,
        },
        "laser": {"mode": laser.mode, "baseline_m": list(laser.baseline_m), "cone_deg": laser.cone_deg},
        "seed": seed,
        "plan": plan.to_dict(),
        "tolerance_m": {
            "direct": settings.direct_tolerance_m,
            "indirect": settings.indirect_tolerance_m,
            "growth": settings.indirect_growth,
        },
        "rays": int(rays),
        "clipped_footprints": clipped,
        "relative_error": error.to_dict(),
        "versions": {name: importlib.metadata.version(name) for name in ("scene2spad", "mitsuba", "drjit", "numpy")},
    }
