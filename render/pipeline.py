"""A plan -> traced light: direct, specular and indirect, and further paths on top of it."""

from __future__ import annotations

import math
from functools import partial
from numbers import Integral
from typing import NamedTuple

import numpy as np

from render.backend.malloc import trim_memory
from render.clamping import Clamp, make_clamp
from render.direct.integrator import direct_light
from render.error import NOT_CHECKED, CheckedPixels, checked_pixels, power_of
from render.indirect.integrator import (
    IndirectLight,
    IndirectTask,
    combined,
    combined_samples,
    image_cells,
    indirect_light,
    path_grid,
)
from render.indirect.launch_layout import BLOCK, block_order
from render.indirect.light_vertices import connects_suffixes
from render.indirect.path_space_filter import Octaves, octaves
from render.indirect.schedule import Schedule, allocate, least_spp, pilot_noise, uniform
from render.light_scale import LightScale, light_scale
from render.scene.traced_scene import TracedScene
from render.settings import BATCHES, FILTERED_BATCHES, MAX_BOUNCES, MIN_SPP, Plan, RenderSettings
from render.specular.image_method import specular_light
from render.transient.samples import SampleBuffer, Samples, concatenate, no_samples, select
from scenes.errors import require
from scenes.progress import Progress
from scenes.random_streams import Stream

# Work that a plan spends by itself, in paths a pixel: nobody asked for the default target, a long wait needs asking.
MAX_SPP, MAX_SPP_BY_DEFAULT = 16384, 1024
# Beyond so many times the work that a plan may spend, or that it planned, a target is not chased.
HOPELESS = 10
PROPOSAL = "trade fireflies for a stated bias with --clamp 10"
UNEVEN = 1e-3  # of the light's root sum square over pixels: what mirrored light may be off by
MIN_BATCHES = 2  # whose difference tells the noise
FEWEST_ALLOCATED = 2 * BATCHES  # forced paths a pixel from which on a pilot pays, and blocks can share
FIRST_FILTERED_SPP = 16  # filtered light starts with few paths, whatever it needs
# A filter takes up to three times the time and has a bias: the pilot has to promise a squared error so much lower.
# Promised under a flash at 64x64, and kept per time: 2.4, 1.05 (gallery); 3.0, 0.5 (corner); 15, 2; 28, 5 (sphere).
FILTER_GAIN = 4.0


class LightSamples(NamedTuple):
    """Light of a planned render before it is packed: its samples, what is known of indirect light or None, counts.

    Samples of direct light come first, then those of specular light, up to `ends`, then those of indirect light. Light
    of the `checked` pixels is kept by batches.
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
    checked: CheckedPixels
    brightest: float = 0.0  # radiance that sets the fixed-point scale of indirect light

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
    """Return a 32-bit seed for one pass of one stage of one scene: independent streams from one number.

    Raises InputError for a seed that is no whole number of 0 or more.
    """
    require(isinstance(seed, Integral) and seed >= 0, f"seed {seed!r}: expected a whole number, 0 or more")
    return int(np.random.SeedSequence(seed, spawn_key=(stage, scene, number)).generate_state(1)[0])


def most_spp(settings: RenderSettings) -> tuple[int, bool]:
    """Return paths a pixel that a plan may spend, and whether a target was asked for."""
    asked = settings.error is not None or settings.budget is not None
    return MAX_SPP if asked else MAX_SPP_BY_DEFAULT, asked


def trace(
    world: TracedScene,
    plan: Plan,
    settings: RenderSettings,
    *,
    seed: int = 0,
    pilot: np.ndarray | None = None,
    progress: Progress | None = None,
) -> LightSamples:
    """Trace what the plan says: the light alone, without layers, ambient light or an error estimate.

    Indirect light of the `pilot`, sorted flat pixels, is kept by batches for the error estimate, and that of the
    brightest pixels where the image's error hangs on them.
    """
    report = progress or (lambda what, fraction: None)
    camera = world.scene.camera
    pixels = np.arange(camera.height * camera.width)
    report("direct light", 0.05)
    direct = direct_light(world, pixels, plan.grid, plan.direct_tolerance_m, edge_threshold=plan.edge_threshold)
    # direct light alone takes little, and to map it anew half as long as tracing it
    trim = partial(trim_memory, len(pixels)) if plan.bounces > 1 else lambda: None
    trim()
    radiance = np.bincount(direct.samples.pixel, weights=direct.samples.radiance, minlength=len(pixels))
    allowed = UNEVEN, float(np.linalg.norm(radiance))
    # the image method finds light of more surfaces than asked for, too
    most = MAX_BOUNCES if settings.bounces is None else settings.bounces
    specular = specular_light(world, plan.grid, plan.direct_tolerance_m, allowed, most)
    trim()
    mirrored = np.bincount(specular.samples.pixel, weights=specular.samples.radiance, minlength=len(pixels))
    checked = NOT_CHECKED if pilot is None else checked_pixels(pilot, radiance + mirrored)
    rays, indirect, schedule = direct.rays, None, None
    scale, reasons = LightScale(np.zeros(len(pixels)), 0.0, no_samples()), tuple[str, ...]()
    if plan.bounces > 1:
        seen = concatenate([direct.samples, specular.shown]) if len(specular.shown.pixel) else direct.samples
        scale = light_scale(world, plan, seen, derived_seed(seed, Stream.PILOT, 0, 1))
    if scale.brightest > 0:
        schedule, reasons = planned_schedule(world, plan, settings, scale.light, scale.origin_m, seed)
    light = SampleBuffer()
    light.add(direct.samples)
    direct = direct._replace(samples=no_samples())  # they are in the list now
    ends = len(light), len(light) + len(specular.samples.pixel)
    light.add(specular.samples)
    if schedule is not None:
        task = _task(world, plan, schedule, derived_seed(seed, Stream.INDIRECT), scale.origin_m, scale.brightest)
        indirect = indirect_light(
            task, checked.pixel, light.add, lambda part: report("indirect light", 0.1 + 0.8 * part)
        )
        rays += schedule.rays(plan.bounces)
    reasons = (*specular.notes, *scale.reasons, *reasons)
    samples, counts = light.finished(trim), (direct.clipped, rays)
    return LightSamples(
        samples, ends, indirect, scale.origin_m, direct.mixed, *counts, schedule, reasons, checked, scale.brightest
    )


def _task(
    world: TracedScene, plan: Plan, schedule: Schedule, seed: int, origin_m: np.ndarray, brightest: float
) -> IndirectTask:
    """Describe what is to be traced of indirect light."""
    width_m, growth = plan.indirect_tolerance_m, plan.indirect_growth
    grid = path_grid(world, origin_m, brightest, plan.bounces, width_m, growth)
    return IndirectTask(world, schedule, plan.bounces, seed, grid)


class MoreSamples(NamedTuple):
    """Paths to trace on top of a render: their schedule and seed."""

    schedule: Schedule
    seed: int


def add_samples(
    world: TracedScene, plan: Plan, traced: LightSamples, extra: MoreSamples, report: Progress
) -> LightSamples:
    """Return a render's light with further paths, weighted by their numbers.

    These follow the first paths' noise. The bias of such a stop is of second order in it, but for light of paths so
    rare that few renders find any: a part of it is lost, as each calls for more paths and then counts less.
    """
    light, more = SampleBuffer(), extra.schedule
    task = _task(world, plan, more, extra.seed, traced.origin_m, traced.brightest)
    added = indirect_light(
        task, traced.checked.pixel, light.add, lambda part: report("indirect light", 0.1 + 0.8 * part)
    )
    before = traced.schedule
    assert before is not None and traced.indirect is not None
    fraction = np.ones(len(traced.origin_m))
    pixels, real = before.pixels, before.pixels >= 0
    fraction[pixels[real]] = np.repeat(before.spp / (before.spp + more.spp), BLOCK)[real]
    merged = combined_samples(traced.indirect_samples, light.finished(), fraction, task.grid.cells, traced.origin_m)
    reason = f"indirect light: the work of {more.cost:.0f} paths a pixel on top, as the target was missed"
    return traced._replace(
        samples=concatenate([traced.direct, traced.specular, merged]),
        indirect=combined(traced.indirect, added, fraction),
        rays=traced.rays + more.rays(plan.bounces),
        schedule=before._replace(spp=before.spp + more.spp),
        reasons=(*traced.reasons, reason),
    )


def planned_schedule(
    world: TracedScene, plan: Plan, settings: RenderSettings, direct: Samples, origin_m: np.ndarray, seed: int
) -> tuple[Schedule, tuple[str, ...]]:
    """Allocate paths to pixels by the noise of a pilot of a few paths, which is not used again; return the schedule and
    the reasons for it. Targets and clamps are counted in the `direct` light, that which mirrors show among it, or what
    is there in place of it."""
    clamp = None
    if plan.clamp is not None:
        camera = world.scene.camera
        light = np.bincount(direct.pixel, weights=direct.radiance, minlength=camera.height * camera.width)
        clamp = make_clamp(light, camera, plan.clamp)
    schedule, reasons = _allocated(world, plan, settings, direct, origin_m, seed, clamp)
    return schedule._replace(clamp=clamp), reasons


def _allocated(
    world: TracedScene,
    plan: Plan,
    settings: RenderSettings,
    direct: Samples,
    origin_m: np.ndarray,
    seed: int,
    clamp: Clamp | None,
) -> tuple[Schedule, tuple[str, ...]]:
    """Allocate paths, and say why: the schedule but for its clamp, with which the pilot's paths are clamped, too."""
    camera = world.scene.camera
    blocks = block_order(np.arange(camera.height * camera.width), camera.width)
    pilot_seed, least = derived_seed(seed, Stream.PILOT), settings.min_spp if plan.spp is None else least_spp(plan.spp)
    forced = math.inf if plan.spp is None else plan.spp
    # under a lamp much light is late, and the noise that the filter leaves is even: a pilot costs more than it saves
    if plan.filter and (not plan.adaptive or forced < MIN_SPP or connects_suffixes(world)):
        return _filtered(world, plan, settings, blocks, origin_m)
    if plan.spp is not None and (not plan.adaptive or forced < FEWEST_ALLOCATED):
        return uniform(blocks, _in_batches(plan.spp, BATCHES), reuses_paths=False), ()
    own, reused = pilot_noise(world, blocks, plan.bounces, pilot_seed, clamp=clamp)
    schedule, reasons = _unfiltered(plan, settings, blocks, (own, reused), direct, least)
    if not plan.filter:
        return schedule, reasons
    spp = max(schedule.cost, FIRST_FILTERED_SPP)
    from_m = float(filter_octaves_of(world, plan, origin_m, spp).from_m[0])
    (noise,) = pilot_noise(world, blocks, plan.bounces, pilot_seed, from_m, clamp)
    gain = gain_of_filter(blocks, (own, reused), noise, spp, least)
    if gain < FILTER_GAIN:
        message = f"filter: left out, as it would lower the squared error {gain:.2g} times, not {FILTER_GAIN:g} or more"
        return schedule, (f"{message}; adaptive=False forces it", *reasons)
    return _filtered(world, plan, settings, blocks, origin_m, noise)


def _in_batches(spp: int, batches: int) -> int:
    """Round paths of a pixel up to batches of one size; fewer than there are batches are one each, two at least: the
    noise of one batch is unknown."""
    return max(spp, MIN_BATCHES) if spp < batches else -(-spp // batches) * batches


def gain_of_filter(
    blocks: np.ndarray, plain: tuple[np.ndarray, np.ndarray], filtered: np.ndarray, spp: float, least: int
) -> float:
    """Estimate how many times a filter lowers the squared error of `spp` paths a pixel, from the pilot's noise of every
    block without it (each path for its own pixel, and for all of the block), `least` each, and with it."""
    own, reused = plain
    shared = allocate(blocks, own, reused, cost=spp, min_spp=least)
    without = float((np.where(shared.reuses_paths, reused, own) / shared.spp).sum())
    alone = allocate(blocks, filtered, cost=spp, batches=FILTERED_BATCHES, min_spp=FILTERED_BATCHES)
    with_filter = float((filtered / alone.spp).sum())
    return without / with_filter if with_filter > 0 else 1.0


def _filtered(
    world: TracedScene,
    plan: Plan,
    settings: RenderSettings,
    blocks: np.ndarray,
    origin_m: np.ndarray,
    noise: np.ndarray | None = None,
) -> tuple[Schedule, tuple[str, ...]]:
    """Allocate paths of filtered light by the pilot's noise of every block, or without it evenly."""
    spp = FIRST_FILTERED_SPP if plan.spp is None else plan.spp
    filter_octaves = filter_octaves_of(world, plan, origin_m, spp)
    schedule = uniform(blocks, _in_batches(spp, FILTERED_BATCHES), reuses_paths=False)
    if noise is not None:
        schedule = allocate(blocks, noise, cost=spp, batches=FILTERED_BATCHES, min_spp=FILTERED_BATCHES)
    least, most = schedule.spp.min(), schedule.spp.max()
    least_m, most_m = filter_octaves.size_m[0], filter_octaves.size_m[-1]
    message = f"indirect light: filtered, later than {filter_octaves.from_m[0]:.2g} m behind direct light, over "
    message += f"regions of surfaces {least_m:.2g} to {most_m:.2g} m wide; {least} to {most} paths a pixel"
    return schedule._replace(filter_octaves=filter_octaves), (message,)


def _unfiltered(
    plan: Plan,
    settings: RenderSettings,
    blocks: np.ndarray,
    noise: tuple[np.ndarray, np.ndarray],
    direct: Samples,
    least: int,
) -> tuple[Schedule, tuple[str, ...]]:
    """Allocate paths, at least so many a pixel, by the pilot's noise of every block: each path for its own pixel, and
    for all of the block."""
    own, reused = noise
    if not plan.adaptive:
        own, reused = np.full_like(own, own.mean()), np.full_like(own, 1e3 * own.mean())
    if plan.spp is not None:
        return allocate(blocks, own, reused, cost=plan.spp, min_spp=least), ()
    power, per_sample = power_of(direct)
    allowed = plan.noise**2 * power / per_sample
    schedule = allocate(blocks, own, reused, squared_error=allowed, min_spp=least)
    limit, asked = most_spp(settings)
    wanted, reasons = schedule.cost, []
    if wanted > limit:
        hopeless = wanted > HOPELESS * limit
        schedule = allocate(
            blocks, own, reused, cost=min(limit, MAX_SPP_BY_DEFAULT) if hopeless else limit, min_spp=least
        )
        remedy = "force more with spp" if asked else "ask for more with an error target"
        if hopeless and plan.clamp is None:
            remedy = f"{remedy}, or {PROPOSAL}"
        schedule = schedule._replace(remedy=remedy)
        reasons.append(
            f"indirect light: the pilot asks for the work of {wanted:.0f} paths a pixel, the limit is {limit:g}"
        )
    spread = f"{schedule.spp.min()} to {schedule.spp.max()} paths a pixel, {schedule.reuses_paths.mean():.0%} shared"
    reasons.append(f"indirect light: {spread}; the work of {schedule.cost:.0f} paths a pixel")
    return schedule, tuple(reasons)


def filter_octaves_of(world: TracedScene, plan: Plan, origin_m: np.ndarray, spp: float) -> Octaves:
    """Return octaves of filtered light for so many paths a pixel in all."""
    distance_m = float(origin_m[origin_m > 0].mean()) / 2
    width_m, growth = plan.indirect_tolerance_m, plan.indirect_growth
    longest_m = float(image_cells(world, width_m, growth, origin_m, plan.bounces).edges_m[-1])
    footprint_m = distance_m / world.scene.camera.focal_px
    return octaves(spp, footprint_m, distance_m, longest_m, width_m, growth)
