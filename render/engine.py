"""Scene -> Transient: plan, direct light, indirect light in independent batches, ambient light, error estimate."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np

from render.ambient.integrator import AmbientLight, ambient_light
from render.direct.integrator import Layers, centre_layers
from render.error import ErrorEstimate, is_met, is_ruled_by_bounces, is_ruled_by_few, target_verdict
from render.image_error import estimated_error
from render.indirect.schedule import Schedule, reallocated
from render.pipeline import (
    HOPELESS,
    PROPOSAL,
    LightSamples,
    MoreSamples,
    add_samples,
    derived_seed,
    filter_octaves_of,
    most_spp,
    trace,
)
from render.planning import make_plan, pilot_pixels, refracting
from render.scene.rays import TOUCHING
from render.scene.traced_scene import TracedScene
from render.settings import BATCHES, FILTERED_BATCHES, MAX_AMBIENT_SPP, MIN_PIXEL_BYTES, Plan, RenderSettings
from render.transient import Transient
from render.transient.samples import to_returns
from scenes.errors import require, told_apart
from scenes.io.versions import installed_versions
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from scenes.model import Scene
from scenes.progress import Progress
from scenes.random_streams import Stream

log = logging.getLogger(__name__)

AMBIENT_BOUNCES = 256  # most paths end long before, by chance
MENTIONED = 1e-3  # share of ambient light left out beyond, above which the plan says so
# Paths traced on top are at most so many times those traced before, pass by pass; filtered light has no pilot. The last
# pass is for targets that are missed, not for the margin below, and by no more than twice as many paths may gain.
MAX_MORE, MAX_MORE_FILTERED, MAX_MORE_HOPELESS = (3.0, 1.0, 1.0), (15.0, 15.0, 15.0), 1.0
MIN_ALLOWED = 0.25


def render(
    scene: Scene,
    settings: RenderSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    world: TracedScene | None = None,
    plan: Plan | None = None,
) -> Transient:
    """Render the time-resolved radiance that the camera's pixels receive from the laser.

    The same scene, settings and seed give the same bytes on any number of threads. A scene with nothing in view gives
    a transient without returns. `progress(what, share)` is called between passes. The plan, its reasons, the error
    estimate and everything needed to repeat the render are in the transient's `meta`. `world` is the scene ready to
    trace, where it is there already, and `plan` what was planned for it, say before another camera in the same room.
    Raises InputError for a camera that lies on a surface.
    """
    settings = settings or RenderSettings()
    report = progress or (lambda what, fraction: None)
    camera = scene.camera
    require_memory(MIN_PIXEL_BYTES * camera.width * camera.height, f"a render of {camera.width} x {camera.height}")
    world = refracting(TracedScene(scene) if world is None else world, settings)
    report("plan", 0.0)
    layers = centre_layers(world)
    _require_clear_view(world, layers)
    plan = planned(world, settings, seed) if plan is None else plan
    plan, traced, error = _traced_to_target(world, plan, settings, seed, report)
    # where nothing is in view there is nothing to explain
    for line in (*scene.notes, *plan.reasons) if len(traced.samples.pixel) else ():
        log.info("%s", line)
    noise = _standard_error(traced)
    ambient = AmbientLight(np.zeros((camera.height, camera.width), np.float32), 0.0, 0)
    if plan.ambient:
        report("ambient light", 0.9)
        by, spp = layers if settings.ambient_filtered else None, settings.ambient_spp or MAX_AMBIENT_SPP
        ambient_seed = derived_seed(seed, Stream.AMBIENT)
        ambient = ambient_light(world, spp, AMBIENT_BOUNCES, ambient_seed, by, noise=plan.ambient_noise)
        message = f"ambient light: {ambient.spp} paths a pixel, noise {ambient.error:.2g} of its mean"
        if ambient.left_out >= MENTIONED:
            message += f"; {ambient.left_out:.2%} of it is left out beyond {AMBIENT_BOUNCES} surfaces"
        plan = replace(plan, reasons=(*plan.reasons, message))
        log.info("%s", message)
    verdict = target_verdict(error, plan.target, len(noise))
    plan = replace(plan, reasons=(*plan.reasons, verdict))
    if len(traced.samples.pixel):
        log.log(logging.INFO if is_met(error, plan.target) else logging.WARNING, "%s", verdict)
    report("done", 1.0)
    return Transient(
        camera.height,
        camera.width,
        *to_returns(traced.samples, camera.height * camera.width),
        depth_m=layers.depth_m,
        normal=layers.normal,
        albedo=layers.albedo,
        ambient=ambient.radiance,
        mixed=traced.mixed.reshape(camera.height, camera.width),
        error=noise.reshape(camera.height, camera.width).astype(np.float32),
        meta=_meta(scene, plan, seed, error, traced) | _of_ambient(plan, settings, ambient),
    )


def _require_clear_view(world: TracedScene, layers: Layers) -> None:
    """Raise InputError where a camera lies on a surface: on which side of it rays begin is up to rounding."""
    camera = world.scene.camera
    nearest_m = float(np.nanmin(layers.depth_m, initial=math.inf))
    limit_m = TOUCHING * max(float(np.abs(corner - camera.origin).max()) for corner in world.scene.bounds())
    at = ", ".join(f"{value:g}" for value in camera.origin)
    near = f"lies on a surface, {abs(nearest_m):.2g} m before it; the limit is {limit_m:.2g} m here"
    require(nearest_m > limit_m, f"scene {world.scene.name}: the camera at ({at}) {near}: move it off")


def _traced_to_target(
    world: TracedScene, plan: Plan, settings: RenderSettings, seed: int, report: Progress
) -> tuple[Plan, LightSamples, ErrorEstimate]:
    """Trace what the plan says, and more where its error misses the target; the plan then says so."""
    pilot = pilot_pixels(world, derived_seed(seed, Stream.PLAN))
    traced = trace(world, plan, settings, seed=seed, pilot=pilot, progress=report)
    filtered = plan.filter and (traced.schedule is None or traced.schedule.filter_octaves is not None)
    plan = replace(plan, spp=traced.spp, filter=filtered, reasons=(*plan.reasons, *traced.reasons))
    error = estimated_error(world, plan, traced)
    passes = MAX_MORE_FILTERED if plan.filter else MAX_MORE
    for number, most in enumerate(passes):
        if number == len(passes) - 1 and not is_within_reach(error, plan.target, most):
            break
        more = additional_schedule(world, plan, settings, traced, error, most)
        if more is None:
            break
        extra = MoreSamples(more, derived_seed(seed, Stream.MORE, 0, number))
        traced = add_samples(world, plan, traced, extra, report)
        plan = replace(plan, spp=traced.spp, reasons=(*plan.reasons, traced.reasons[-1]))
        error = estimated_error(world, plan, traced)
    reasons = (*_bias_reasons(plan, traced, error), *clamp_reasons(plan, settings, traced, error))
    reasons += remedy_reasons(plan, traced, error)
    return replace(plan, reasons=(*plan.reasons, *reasons)), traced, error


def is_within_reach(error: ErrorEstimate, target: float, most: float) -> bool:
    """Tell whether a target is missed, by no more than `most` times as many paths on top may gain."""
    return target < error.total <= target * math.sqrt(1 + most)


def _standard_error(traced: LightSamples) -> np.ndarray:
    """Compute the standard error of every pixel's total radiance; light that a clamp removed counts as error."""
    if traced.indirect is None:
        return np.zeros(len(traced.origin_m))
    removed = traced.indirect.removed
    return traced.indirect.noise if removed is None else np.hypot(traced.indirect.noise, removed.pixels)


def planned(world: TracedScene, settings: RenderSettings, seed: int = 0) -> Plan:
    """Return the plan that `render` makes with these settings and this seed."""
    return make_plan(refracting(world, settings), settings, derived_seed(seed, Stream.PLAN))


def additional_schedule(
    world: TracedScene, plan: Plan, settings: RenderSettings, traced: LightSamples, error: ErrorEstimate, most: float
) -> Schedule | None:
    """Return the schedule of extra samples if a planned render misses its target, else None: at most so many times
    those before.

    A short pilot sees few of the rare bright paths and underestimates the variance. Where as many as may be spent would
    still miss the target, they go where the noise is.
    """
    if settings.spp is not None or traced.schedule is None or traced.indirect is None or plan.target <= 0:
        return None
    batches = traced.schedule.batches
    allowed = settings.target_fraction * plan.target**2
    allowed -= error.direct**2 + error.merging**2 + error.bias**2 + error.clamped**2 + error.truncated**2
    if plan.filter and error.bias < plan.target:
        # what merging and the filter seem to cost after few paths falls with more
        allowed = max(allowed, MIN_ALLOWED * settings.target_fraction * plan.target**2)
    enough = error.total**2 <= settings.target_fraction * plan.target**2
    if enough or allowed <= 0 or batches < (FILTERED_BATCHES if plan.filter else BATCHES):
        return None
    left = most_spp(settings)[0] / traced.schedule.cost - 1
    needed = error.monte_carlo**2 / allowed - 1
    if needed > HOPELESS and not plan.filter:  # filtered light begins with few paths, whatever it needs
        most = min(most, MAX_MORE_HOPELESS)
    factor = min(needed, most, left)
    if factor <= 0:
        return None
    if factor < needed and not plan.filter:
        return reallocated(traced.schedule, traced.indirect.noise, 1 / (1 + needed), factor)
    rounds = np.ceil(traced.schedule.spp * factor / batches).astype(np.int64) * batches
    more = traced.schedule._replace(spp=rounds)
    if plan.filter:
        filter_octaves = filter_octaves_of(world, plan, traced.origin_m, traced.schedule.cost + more.cost)
        return more._replace(filter_octaves=filter_octaves)
    return more


def remedy_reasons(plan: Plan, traced: LightSamples, error: ErrorEstimate) -> tuple[str, ...]:
    """State what to do where fewer paths than the pilot asked for missed the target: its estimate may be far off."""
    remedy = "" if traced.schedule is None else traced.schedule.remedy
    helps = bool(remedy) and not is_met(error, plan.target) and not is_ruled_by_bounces(error)
    return () if not helps else (f"indirect light: too few paths; {remedy}",)


def clamp_reasons(plan: Plan, settings: RenderSettings, traced: LightSamples, error: ErrorEstimate) -> tuple[str, ...]:
    """State how much light a clamp removed; or that a clamp would help, where a few rare bright paths put the target
    out of reach."""
    if traced.indirect is None:
        return ()
    if traced.indirect.removed is not None:
        fraction = traced.indirect.removed.pixels.sum() / max(traced.samples.radiance.sum(), 1e-300)
        message = (
            f"clamp: paths of more than {plan.clamp:g} times the direct light around lost {fraction:.2%} of all light"
        )
        return (f"{message}, an error of {error.clamped:.2g}",)
    missed = settings.spp is None and not plan.filter and not is_met(error, plan.target)
    times = error.monte_carlo**2 / plan.target**2 if missed else 0.0
    if times < 1 + HOPELESS:
        return ()
    remedy = PROPOSAL if is_ruled_by_few(error, len(traced.origin_m)) else "force more with spp"
    return (f"indirect light: stopped, as the target takes {times:.0f} times these paths; {remedy}",)


def _bias_reasons(plan: Plan, traced: LightSamples, error: ErrorEstimate) -> tuple[str, ...]:
    """State the bias of a filter, measured against the same paths without it."""
    if not plan.filter or traced.schedule is None:
        return ()
    if error.bias == 0:
        return ("filter: biased, by less than the noise of as many paths shows",)
    bias, target = told_apart(error.bias, plan.target)
    message = f"filter: biased by {bias}, measured against the same paths without it"
    if error.bias > plan.target:
        message += f", more than the target of {target}: render without a filter"
    return (message,)


def _of_ambient(plan: Plan, settings: RenderSettings, ambient: AmbientLight) -> JsonObject:
    if not plan.ambient:
        return {}
    paths = {"ambient_spp": ambient.spp, "ambient_filtered": settings.ambient_filtered}
    return paths | {"ambient_error": round(math.hypot(ambient.error, ambient.left_out), 6)}


def _meta(scene: Scene, plan: Plan, seed: int, error: ErrorEstimate, traced: LightSamples) -> JsonObject:
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
            "direct": plan.direct_tolerance_m,
            "indirect": plan.indirect_tolerance_m,
            "growth": plan.indirect_growth,
        },
        "rays": int(traced.rays),
        "clipped_footprints": traced.clipped,
        "relative_error": error.to_dict(),
        "target_met": is_met(error, plan.target),
        "versions": installed_versions("scene2spad", "mitsuba", "drjit", "numpy"),
    }
