"""Decide how to render from a pilot over a few pixels: bounces, paths per pixel, cells per pixel, ambient light."""

from __future__ import annotations

import math

import numpy as np

from render.direct import direct_light
from render.error import error_for_budget, estimate, response
from render.indirect import indirect_light
from render.returns import concatenate, select
from render.settings import GRIDS, MAX_BOUNCES, Plan, RenderSettings
from render.world import World
from scenes.model import Material

DEFAULT_ERROR = 0.02
# Squares of the parts must sum to less than 1; the rest is for merged returns and the pilot's own uncertainty.
DIRECT_SHARE, MONTE_CARLO_SHARE = 0.4, 0.65
MOST_LEFT_OUT = 0.02  # energy left out is bias, which no number of photons averages away: it stays small at any target
BATCHES = 16
PILOT_PIXELS = 256
PILOT_SPP = 64
PILOT_BOUNCES = 8
# The most paths a pixel that a plan takes by itself: nobody asked for the default target, a long wait needs asking.
MOST_SPP, MOST_SPP_BY_DEFAULT = 4096, 256


def pilot_pixels(world: World, seed: int) -> np.ndarray:
    """A sorted random subset of flat pixel indices, the same for pilot and error estimate."""
    pixels = world.scene.camera.height * world.scene.camera.width
    if pixels <= PILOT_PIXELS:
        return np.arange(pixels)
    return np.sort(np.random.default_rng(seed).choice(pixels, PILOT_PIXELS, replace=False))


def make_plan(world: World, settings: RenderSettings, seed: int) -> Plan:
    """Plan a render: every choice that `settings` leaves open follows from a pilot; every choice gets a reason."""
    pixels = pilot_pixels(world, seed)
    reasons = list(_limits(world))
    fine = response(direct_light(world, pixels, 2 * GRIDS[-1]).samples, pixels)
    target, why = _target(settings, fine)
    reasons.append(why)
    grid, why = _grid(world, settings, pixels, fine, target)
    reasons.append(why)
    bounces, spp, whys = _indirect(world, settings, pixels, fine, target, seed)
    reasons += whys
    if world.scene.has_ambient:
        reasons.append("ambient light: rendered, the scene has environment or area lights")
    else:
        reasons.append("ambient light: none in the scene; a sensor's background will be uniform")
    return Plan(bounces, spp, grid, world.scene.has_ambient, tuple(reasons))


def _limits(world: World) -> list[str]:
    """What this renderer leaves out of the given scene."""
    materials: list[Material] = [surface.material for surface in world.scene.surfaces]
    said = []
    if world.has_glass:
        said.append("glass: passed in a straight line with Fresnel loss and delay; its own reflections are left out")
    if world.has_cutouts:
        said.append("cut-outs: solid where their opacity is 1/2 or more")
    if any(m.kind in ("conductor", "plastic") for m in materials):
        said.append("smooth mirrors: their direct return and light that reaches a surface by way of them are left out")
    if any(m.kind == "roughdiffuse" for m in materials):
        said.append("rough diffuse surfaces: rendered as Lambertian")
    return said


def _target(settings: RenderSettings, fine: np.ndarray) -> tuple[float, str]:
    if settings.budget is not None:
        signal, background = settings.budget
        target = error_for_budget(fine, signal, background)
        why = f"error target: {target:.2g}, 1 % of shot variance at {signal:g} + {background:g} photons a pixel"
        return target, why
    if settings.error is not None:
        return settings.error, f"error target: {settings.error:g}, as asked"
    return DEFAULT_ERROR, f"error target: {DEFAULT_ERROR:g}, the default"


def _grid(
    world: World, settings: RenderSettings, pixels: np.ndarray, fine: np.ndarray, target: float
) -> tuple[int, str]:
    """The smallest grid whose direct light differs from the finest one by at most DIRECT_SHARE of the error target."""
    if settings.grid is not None:
        return settings.grid, f"direct light: {settings.grid} x {settings.grid} rays a pixel, forced"
    for grid in GRIDS:
        error = estimate(response(direct_light(world, pixels, grid).samples, pixels), fine, []).total
        if error <= DIRECT_SHARE * target:
            break
    why = f"direct light: {grid} x {grid} rays a pixel, error {error:.2g} against {2 * GRIDS[-1]} x {2 * GRIDS[-1]}"
    return grid, why if error <= DIRECT_SHARE * target else f"{why}: its share of the target needs more; force grid"


def _indirect(
    world: World, settings: RenderSettings, pixels: np.ndarray, fine: np.ndarray, target: float, seed: int
) -> tuple[int, int, list[str]]:
    mode = world.scene.laser.mode
    if settings.bounces == 1:
        return 1, 0, ["indirect light: none, forced by 1 bounce"]
    if settings.bounces is None and mode == "scan":
        return 1, 0, ["indirect light: left out, also of the error, under a scanning laser unless bounces ask for it"]
    most = PILOT_BOUNCES if settings.bounces is None else settings.bounces
    per_batch = PILOT_SPP // BATCHES
    seeds = np.random.SeedSequence(seed).generate_state(BATCHES)
    batches = [concatenate(list(indirect_light(world, pixels, per_batch, most, int(s)))) for s in seeds]
    energy = np.zeros(most + 1)
    energy[1] = fine.sum()
    for batch in batches:
        energy += np.bincount(batch.bounces, weights=batch.radiance, minlength=most + 1)[: most + 1] / BATCHES
    if energy.sum() <= 0:
        return settings.bounces or 1, _whole_batches(settings.spp or BATCHES), ["indirect light: nothing is lit"]
    whys = []
    bounces = settings.bounces
    if bounces is None:
        bounces, left_out = _bounces(energy, min(target / 3, MOST_LEFT_OUT))
        share = energy[2:].sum() / energy.sum()
        whys.append(
            f"bounces: {bounces}; indirect light is {share:.2%} of the energy, {left_out:.2%} is left out beyond"
        )
    else:
        whys.append(f"bounces: {bounces}, forced")
    if bounces == 1:
        return 1, 0, [*whys, "indirect light: none, what it adds is less than may be left out"]
    if settings.spp is not None:
        spp = _whole_batches(settings.spp)
        return bounces, spp, [*whys, f"indirect light: {spp} paths a pixel, forced"]
    responses = [response(select(batch, batch.bounces <= bounces), pixels) for batch in batches]
    error = estimate(fine, fine, responses).monte_carlo
    wanted = _whole_batches(math.ceil(PILOT_SPP * (error / (MONTE_CARLO_SHARE * target)) ** 2))
    asked = settings.error is not None or settings.budget is not None
    spp = int(np.clip(wanted, BATCHES, MOST_SPP if asked else MOST_SPP_BY_DEFAULT))
    whys.append(f"indirect light: {spp} paths a pixel; the pilot's {PILOT_SPP} had an error of {error:.2g}")
    if wanted > spp:
        remedy = "force more with spp" if asked else "ask for more with an error target"
        whys.append(f"indirect light: {wanted} paths a pixel would meet the target, {spp} is a plan's limit; {remedy}")
    return bounces, spp, whys


def _bounces(energy: np.ndarray, allowed: float) -> tuple[int, float]:
    """Fewest bounces that leave out at most the share `allowed` of the energy, and the share left out.

    What lies beyond the pilot's last bounce follows the geometric series of its last two.
    """
    ratio = min(energy[-1] / energy[-2], 0.99) if energy[-2] > 0 else 0.0
    beyond = energy[-1] * ratio ** np.arange(1, MAX_BOUNCES - len(energy) + 2)
    tail = energy[-1] * ratio / (1 - ratio) - beyond.sum()
    full = np.concatenate((energy, beyond))
    left_out = (full.sum() + tail - np.cumsum(full)) / (full.sum() + tail)
    bounces = int(np.argmax(left_out[1:] <= allowed)) + 1 if (left_out[1:] <= allowed).any() else MAX_BOUNCES
    return bounces, max(float(left_out[bounces]), 0.0)


def _whole_batches(spp: int) -> int:
    """The next number of paths that is the same in every batch."""
    return spp if spp < BATCHES else -(-spp // BATCHES) * BATCHES
