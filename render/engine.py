"""Scene -> Transient: plan, direct light, indirect light in independent batches, ambient light, error estimate."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from render.ambient import AmbientLight, ambient_light
from render.cells import coarsened
from render.direct import centre_layers, direct_light
from render.error import ErrorEstimate, estimate, noise_power, power_of, response
from render.heap import release
from render.indirect import (
    IndirectLight,
    Schedule,
    allocate,
    combined,
    combined_samples,
    image_cells,
    indirect_light,
    pilot_noise,
    uniform,
)
from render.paths import BLOCK, block_order
from render.planning import finer_pilot, make_plan, pilot_pixels
from render.returns import Growing, Samples, concatenate, no_samples, of_pixels, select, to_returns
from render.settings import BATCHES, MOST_AMBIENT_SPP, Plan, RenderSettings
from render.specular import specular_light
from render.transient import Transient
from render.world import World
from scenes.model import Scene

log = logging.getLogger(__name__)

STAGE_PLAN, STAGE_INDIRECT, STAGE_AMBIENT, STAGE_PILOT, STAGE_MORE = 10, 11, 12, 13, 14
# Work that a plan spends by itself, in paths a pixel: nobody asked for the default target, a long wait needs asking.
MOST_SPP, MOST_SPP_BY_DEFAULT = 16384, 1024
AMBIENT_BOUNCES = 16  # most paths end long before, by chance
MOST_MORE = 3.0  # paths traced on top are at most this many times those traced before

Progress = Callable[[str, float], None]


class Traced(NamedTuple):
    """Light of a planned render before it is packed: its samples, what is known of indirect light or None, counts.

    Samples of direct light come first, then those of specular light, up to `ends`, then those of indirect light.
    """

    samples: Samples
    ends: tuple[int, int]
    indirect: IndirectLight | None
    origin_m: np.ndarray
    mixed: np.ndarray
    clipped: int
    rays: int
    schedule: Schedule | None
    reasons: tuple[str, ...]

    @property
    def spp(self) -> int:
        """Work on indirect light in paths a pixel."""
        return 0 if self.schedule is None else round(self.schedule.cost)

    @property
    def direct(self) -> Samples:
        return select(self.samples, slice(self.ends[0]))

    @property
    def specular(self) -> Samples:
        return select(self.samples, slice(*self.ends))

    @property
    def indirect_samples(self) -> Samples:
        return select(self.samples, slice(self.ends[1], None))


def derived_seed(seed: int, stage: int, scene: int = 0, number: int = 0) -> int:
    """A 32-bit seed for one pass of one stage of one scene: independent streams from one number."""
    return int(np.random.SeedSequence(seed, spawn_key=(stage, scene, number)).generate_state(1)[0])


def render(
    scene: Scene,
    settings: RenderSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    world: World | None = None,
    plan: Plan | None = None,
) -> Transient:
    """Render the time-resolved radiance that the camera's pixels receive from the laser.

    The same scene, settings and seed give the same bytes on any number of threads. A scene with nothing in view gives
    a transient without returns. `progress(what, share)` is called between passes. The plan, its reasons, the error
    estimate and everything needed to repeat the render are in the transient's `meta`. `world` is the scene ready to
    trace, where it is there already, and `plan` what was planned for it, say before another camera in the same room.
    """
    settings = settings or RenderSettings()
    say = progress or (lambda what, share: None)
    world = World(scene) if world is None else world
    camera = scene.camera
    say("plan", 0.0)
    plan = planned(world, settings, seed) if plan is None else plan
    checked = pilot_pixels(world, derived_seed(seed, STAGE_PLAN))
    traced = trace(world, plan, settings, seed=seed, checked=checked, progress=say)
    layers = centre_layers(world)
    # where nothing is in view there is nothing to explain
    plan = replace(plan, spp=traced.spp, reasons=(*plan.reasons, *traced.reasons))
    error = _estimated(world, plan, settings, traced, checked)
    more = _missing(plan, settings, traced, error)
    if more is not None:
        traced = _traced_on(world, plan, settings, traced, more, seed, checked, say)
        plan = replace(plan, spp=traced.spp, reasons=(*plan.reasons, traced.reasons[-1]))
        error = _estimated(world, plan, settings, traced, checked)
    for line in (*scene.notes, *plan.reasons) if len(traced.samples.pixel) else ():
        log.info("%s", line)
    noise = np.zeros(camera.height * camera.width) if traced.indirect is None else traced.indirect.noise

    ambient = AmbientLight(np.zeros((camera.height, camera.width), np.float32), 0.0, 0)
    if plan.ambient:
        say("ambient light", 0.9)
        by, spp = layers if settings.ambient_shared else None, settings.ambient_spp or MOST_AMBIENT_SPP
        its_seed = derived_seed(seed, STAGE_AMBIENT)
        ambient = ambient_light(world, spp, AMBIENT_BOUNCES, its_seed, by, noise=plan.ambient_noise)
        told = f"ambient light: {ambient.spp} paths a pixel, noise {ambient.error:.2g} of its mean"
        plan = replace(plan, reasons=(*plan.reasons, told))
        log.info("%s", told)
    say("done", 1.0)
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
        meta=_meta(scene, settings, plan, seed, error, traced) | _of_ambient(plan, settings, ambient),
    )


def planned(world: World, settings: RenderSettings, seed: int = 0) -> Plan:
    """The plan that `render` makes with these settings and this seed."""
    return make_plan(world, settings, derived_seed(seed, STAGE_PLAN))


def trace(
    world: World,
    plan: Plan,
    settings: RenderSettings,
    *,
    seed: int = 0,
    checked: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Traced:
    """Trace what the plan says: the light alone, without layers, ambient light or an error estimate.

    `checked` are sorted flat pixels whose indirect light is kept by batches, for the error estimate.
    """
    say = progress or (lambda what, share: None)
    camera = world.scene.camera
    pixels = np.arange(camera.height * camera.width)
    say("direct light", 0.05)
    direct = direct_light(world, pixels, plan.grid, plan.direct_tolerance_m, least_share=plan.least_share)
    # only indirect light is counted from where direct light is
    origin_m, brightest = _mean_path(direct.samples, len(pixels)) if plan.bounces > 1 else (np.zeros(len(pixels)), 0.0)
    specular = specular_light(world, plan.grid, plan.direct_tolerance_m)
    release(len(pixels))
    rays, indirect, schedule, reasons = direct.rays, None, None, ()
    if plan.bounces > 1 and brightest > 0:
        schedule, reasons = _schedule(world, plan, settings, direct.samples, seed)
    light = Growing()
    light.add(direct.samples)
    direct = direct._replace(samples=no_samples())  # they are in the list now
    ends = len(light), len(light) + len(specular.samples.pixel)
    light.add(specular.samples)
    release(len(pixels))
    if schedule is not None:
        indirect = _indirect(
            world, plan, settings, schedule, STAGE_INDIRECT, seed, origin_m, brightest, checked, light, say
        )
        rays += schedule.paths * (2 * plan.bounces - 1) + schedule.connections
    reasons = (*specular.notes, *reasons)
    return Traced(light.finished(), ends, indirect, origin_m, direct.mixed, direct.clipped, rays, schedule, reasons)


def _indirect(
    world: World,
    plan: Plan,
    settings: RenderSettings,
    schedule: Schedule,
    stage: int,
    seed: int,
    origin_m: np.ndarray,
    brightest: float,
    checked: np.ndarray | None,
    light: Growing,
    say: Progress,
) -> IndirectLight:
    return indirect_light(
        world,
        schedule,
        plan.bounces,
        derived_seed(seed, stage),
        origin_m,
        brightest,
        np.empty(0, np.int64) if checked is None else checked,
        light.add,
        width_m=settings.indirect_tolerance_m,
        growth=settings.indirect_growth,
        say=lambda share: say("indirect light", 0.1 + 0.8 * share),
    )


def _missing(plan: Plan, settings: RenderSettings, traced: Traced, error: ErrorEstimate) -> Schedule | None:
    """What to trace on top where a planned render misses its target: pilots see few of the rare bright paths."""
    if settings.spp is not None or traced.schedule is None or traced.indirect is None or plan.target <= 0:
        return None
    allowed = settings.aim * plan.target**2 - error.direct**2 - error.merging**2
    if error.total**2 <= settings.aim * plan.target**2 or allowed <= 0 or traced.schedule.batches < BATCHES:
        return None
    asked = settings.error is not None or settings.budget is not None
    left = (MOST_SPP if asked else MOST_SPP_BY_DEFAULT) / traced.schedule.cost - 1
    factor = min(error.monte_carlo**2 / allowed - 1, MOST_MORE, left)
    if factor <= 0:
        return None
    rounds = np.ceil(traced.schedule.rounds * factor / BATCHES).astype(np.int64) * BATCHES
    return traced.schedule._replace(rounds=rounds)


def _traced_on(
    world: World,
    plan: Plan,
    settings: RenderSettings,
    traced: Traced,
    more: Schedule,
    seed: int,
    checked: np.ndarray,
    say: Progress,
) -> Traced:
    """A trace with further paths, weighted by their numbers.

    These follow the first paths' noise; the bias of such a stop is of second order in it.
    """
    _, brightest = _mean_path(traced.direct, len(traced.origin_m))
    light = Growing()
    added = _indirect(world, plan, settings, more, STAGE_MORE, seed, traced.origin_m, brightest, checked, light, say)
    before = traced.schedule
    share = np.ones(len(traced.origin_m))
    pixels, real = before.pixels, before.pixels >= 0
    share[pixels[real]] = np.repeat(before.rounds / (before.rounds + more.rounds), BLOCK)[real]
    cells = image_cells(world, settings.indirect_tolerance_m, settings.indirect_growth, traced.origin_m, plan.bounces)
    merged = combined_samples(traced.indirect_samples, light.finished(), share, cells, traced.origin_m)
    reason = f"indirect light: the work of {more.cost:.0f} paths a pixel on top, to meet the target"
    return traced._replace(
        samples=concatenate([traced.direct, traced.specular, merged]),
        indirect=combined(traced.indirect, added, share),
        rays=traced.rays + more.paths * (2 * plan.bounces - 1) + more.connections,
        schedule=before._replace(rounds=before.rounds + more.rounds),
        reasons=(*traced.reasons, reason),
    )


def _schedule(
    world: World, plan: Plan, settings: RenderSettings, direct: Samples, seed: int
) -> tuple[Schedule, tuple[str, ...]]:
    """How many paths each pixel traces, and why: from the noise of a pilot of a few paths, which is not used again."""
    camera = world.scene.camera
    blocks = block_order(np.arange(camera.height * camera.width), camera.width)
    if plan.spp is not None and (not plan.adaptive or plan.spp < BATCHES):
        rounds = plan.spp if plan.spp < BATCHES else -(-plan.spp // BATCHES) * BATCHES
        return uniform(blocks, rounds, shared=False), ()
    own, shared = pilot_noise(world, blocks, plan.bounces, derived_seed(seed, STAGE_PILOT))
    if not plan.adaptive:
        own, shared = np.full_like(own, own.mean()), np.full_like(own, 1e3 * own.mean())
    if plan.spp is not None:
        return allocate(blocks, own, shared, cost=plan.spp), ()
    power, per_sample = power_of(direct)
    allowed = plan.noise**2 * power / per_sample
    schedule = allocate(blocks, own, shared, squared_error=allowed)
    asked = settings.error is not None or settings.budget is not None
    limit = MOST_SPP if asked else MOST_SPP_BY_DEFAULT
    wanted, reasons = schedule.cost, []
    if wanted > limit:
        schedule = allocate(blocks, own, shared, cost=limit)
        remedy = "force more with spp" if asked else "ask for more with an error target"
        reasons.append(f"indirect light: the work of {wanted:.0f} paths a pixel would meet the target; {remedy}")
    spread = f"{schedule.rounds.min()} to {schedule.rounds.max()} paths a pixel, {schedule.shared.mean():.0%} shared"
    reasons.append(f"indirect light: {spread}; the work of {schedule.cost:.0f} paths a pixel")
    return schedule, tuple(reasons)


def _estimated(
    world: World, plan: Plan, settings: RenderSettings, traced: Traced, checked: np.ndarray
) -> ErrorEstimate:
    """The error of a trace, from the checked pixels' batches and from finer direct light there."""
    coarse = response(of_pixels(traced.direct, checked), checked)
    glints = response(of_pixels(traced.specular, checked), checked)
    fine = finer_pilot(world, checked, plan.grid, plan.least_share) + glints
    coarse += glints
    if traced.indirect is None:
        return estimate(coarse, fine)
    seen = traced.indirect.watched
    place, origin_m = np.arange(len(checked)), traced.origin_m[checked]
    cells = image_cells(world, settings.indirect_tolerance_m, settings.indirect_growth, traced.origin_m, plan.bounces)
    # what merging changes, in two independent halves: their noise, which merging smooths, cancels in the product
    changes = []
    for half in (slice(0, None, 2), slice(1, None, 2)):
        kept = seen.samples(half) if seen.radiance.shape[1] > 1 else no_samples()
        merged = coarsened(kept, cells, origin_m)
        changes.append(response(concatenate([merged, kept._replace(radiance=-kept.radiance)]), place))
    merging = (changes[0] * changes[1]).sum(axis=1)
    indirect = response(seen.samples(), place)
    noise = noise_power(seen.radiance, seen.cells.width_of_m)
    # few pixels hold the rare bright paths: the noise of all pixels' totals says how typical the checked ones are
    variance = traced.indirect.noise**2
    of_checked = variance[checked].mean()
    typical = variance.mean() / of_checked if of_checked > 0 else 1.0
    return estimate(coarse, fine, indirect, noise * typical, merging)


def _mean_path(samples: Samples, pixels: int) -> tuple[np.ndarray, float]:
    """Radiance-weighted mean path of each pixel [m], 0 where there is none; and the brightest pixel's radiance."""
    total = np.bincount(samples.pixel, weights=samples.radiance, minlength=pixels)
    moment = np.bincount(samples.pixel, weights=samples.radiance * samples.path_m, minlength=pixels)
    return np.divide(moment, total, out=np.zeros(pixels), where=total > 0), float(total.max(initial=0))


def _of_ambient(plan: Plan, settings: RenderSettings, ambient: AmbientLight) -> dict:
    if not plan.ambient:
        return {}
    paths = {"ambient_spp": ambient.spp, "ambient_shared": settings.ambient_shared}
    return paths | {"ambient_error": round(ambient.error, 6)}


def _meta(scene: Scene, settings: RenderSettings, plan: Plan, seed: int, error: ErrorEstimate, traced: Traced) -> dict:
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
            "indirect": settings.indirect_tolerance_m,
            "growth": settings.indirect_growth,
        },
        "rays": int(traced.rays),
        "clipped_footprints": traced.clipped,
        "relative_error": error.to_dict(),
        "versions": dict(_versions()),
    }


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    return tuple((name, importlib.metadata.version(name)) for name in ("scene2spad", "mitsuba", "drjit", "numpy"))
