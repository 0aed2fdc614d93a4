"""Decide how to render from a pilot over a few pixels: bounces, paths per pixel, cells per pixel, ambient light."""

from __future__ import annotations

import math

import numpy as np

from render.direct.integrator import default_edge_threshold, direct_light
from render.error import PULSE_POWER, error_for_budget, error_of_background, estimate, response
from render.indirect.camera_paths import energy_by_bounces
from render.scene.traced_scene import TracedScene
from render.settings import (
    GRIDS,
    MAX_BOUNCES,
    MAX_GRID,
    MIN_ERROR,
    MIN_SPP,
    WIDEST_GROWTH,
    WIDEST_INDIRECT_M,
    Plan,
    RenderSettings,
)
from scenes.errors import InputError
from scenes.model import LaserMode, Material

DEFAULT_ERROR = 0.02
# Of the square that is aimed at: the rest is for merged returns and what twice as many rays a side still miss.
PLANNED = 0.96
MIN_NOISE_FRACTION = 0.1  # of that square, which noise of indirect light may have, however much direct light takes
# Time of a cell in that of a path: where many paths are to come, finer cells leave them more of the error.
CELL_COST = 0.25
SHARED_NOISE = 0.5  # of paths that neighbours share, in that of as many own ones (0.3 to 1.5 in rooms)
# The pilot's pixels are not compared with those beside them, so that it shows 1.3 to 1.4 times the error of cells at
# grids of 4 to 8 (measured in rooms); most of that is not planned for.
PILOT_SHOWS = 1.25
# What noise of ambient light adds to the error at the photons in question, in shares of the target; a constant rate is
# no echo, and what it does to depth grows with its square. At least, and at most, that noise:
AMBIENT_FRACTION, MIN_AMBIENT_NOISE, MAX_AMBIENT_NOISE = 0.5, 0.02, 0.5
# Energy left out by fewer bounces is bias, which no number of photons averages away. It lies in few pixels, inside a
# lampshade or a pot: 0.2 % of an artist's room was 10 to 20 % of some pixels. More bounces cost a few per cent of time.
LEFT_OUT, MAX_LEFT_OUT = 1 / 256, 0.02  # of the target; at most
# More than that share of all light adds to the stated error; the pilot is then repeated with all the bounces there are.
MATTERS, LATE_SPP = 1e-3, 64  # and that many paths in each of PILOT_PIXELS pixels
# The pilot's pixels miss such places: there, light that met more than 11 surfaces was a tenth. Paths that carry little
# end early: this costs up to 3 % of the time in rooms where 8 to 11 would do.
MIN_BOUNCES = 24
PILOT_PIXELS = 256
PILOT_BOUNCES = 8
CHECK_REFINEMENT, MIN_CHECK_REFINEMENT = 2, 1.5  # direct light is checked against this many times the cells a side
PILOT_GRID = 4
# A cone narrower than a pixel may lie between the rays of a few cells a side.
CELLS_ACROSS_CONE, MAX_HALF_ANGLE = 8, math.radians(80)
# Errors of direct light fall at least with this power of the grid (1.2 to 1.9 in rooms); trusted so far beyond a grid.
GRID_POWER, EXTRAPOLATED = 1.3, 2
# Merging direct returns within 1 mm makes an error of 5e-4 on the reference sensor (measured): a tenth of the target.
TOLERANCE_M_PER_ERROR = 0.2
WIDEST_TOLERANCE_M = 0.005
# Merging indirect returns within the widest cells makes about this error in rooms, and where polished metal, mirrors or
# glass gather light in few places (0.001 to 0.0015 and 0.002 to 0.012 were measured). It goes with the square of their
# width, and may take this part of the target.
MERGED, MERGED_POLISHED, MERGED_FRACTION = 0.0015, 0.01, 0.25
PILOT_TOLERANCE_M = 0.01  # of path, within which the pilot's returns merge: a quarter of the pulse's sigma


def pilot_pixels(world: TracedScene, seed: int) -> np.ndarray:
    """Return a sorted random subset of flat pixel indices, the same for pilot and error estimate."""
    pixels = world.scene.camera.height * world.scene.camera.width
    if pixels <= PILOT_PIXELS:
        return np.arange(pixels)
    return np.sort(np.random.default_rng(seed).choice(pixels, PILOT_PIXELS, replace=False))


def cone_width_px(world: TracedScene) -> float:
    """Return the width of a flood laser's own cone in pixels, as if it were at the camera; inf where it is the image's,
    or another laser."""
    laser, camera = world.scene.laser, world.scene.camera
    if laser.cone_deg is None:
        return math.inf
    return 2 * camera.focal_px * math.tan(min(laser.half_angle(camera), MAX_HALF_ANGLE))


def _grid_for_cone(world: TracedScene) -> int:
    """Return the grid whose cells are narrow enough for the laser's cone, or the finest there is."""
    return min(math.ceil(CELLS_ACROSS_CONE / cone_width_px(world)), MAX_GRID)


def pilot_response(
    world: TracedScene, pixels: np.ndarray, grid: int, edge_threshold: float | None = None
) -> np.ndarray:
    """Return `response` of direct light in a few pixels. Kept with the world: the plan and the error estimate ask the
    same."""
    fraction = default_edge_threshold(grid) if edge_threshold is None else edge_threshold
    key = grid, fraction, pixels.tobytes()
    if key not in world.responses:
        light = direct_light(world, pixels, grid, PILOT_TOLERANCE_M, edge_threshold=fraction)
        world.responses[key] = response(light.samples, pixels)
    return world.responses[key]


def finer_pilot(world: TracedScene, pixels: np.ndarray, grid: int, edge_threshold: float) -> np.ndarray:
    """Return direct light of a few pixels by clearly more rays than `grid`: of the plan's pilot, or twice as many a
    side."""
    if edge_threshold == default_edge_threshold(grid) and grid * MIN_CHECK_REFINEMENT <= 2 * PILOT_GRID:
        return pilot_response(world, pixels, 2 * PILOT_GRID)
    return pilot_response(world, pixels, CHECK_REFINEMENT * grid, edge_threshold / CHECK_REFINEMENT)


def direct_fraction_of(settings: RenderSettings, direct_alone: bool) -> float:
    """Return the part of the target nRMSE that direct light may use: its own, or all that is planned where there is no
    other light."""
    return math.sqrt(settings.target_fraction) if direct_alone else settings.direct_fraction


def refracting(world: TracedScene, settings: RenderSettings) -> TracedScene:
    """Return the world whose solid glass bends direct light if `settings` ask for it, or leave it open and it can.

    Raises InputError where it is asked for beside a displaced laser: its light comes by another way than the camera's.
    """
    at_camera = world.scene.laser.is_colocated
    if settings.refraction == "bent" and not at_camera:
        raise InputError(
            "render: refraction is bent for a laser at the camera, this one is displaced: leave it straight"
        )
    return world.refracting(bool(world.solid_indices) and at_camera and settings.refraction != "straight")


def _check_laser(mode: LaserMode, settings: RenderSettings) -> None:
    """Raise InputError for settings of indirect light that mean nothing under a laser of this mode."""
    if settings.filter and mode != "flood":
        raise InputError(
            f"render: a filter shares light of a flood laser among pixels, this one is {mode}: leave it out"
        )
    for name in ("spp", "clamp"):
        value = getattr(settings, name)
        if mode == "scan" and settings.bounces is None and value is not None:
            raise InputError(
                f"render: {name} {value:g} is for indirect light, which a scanning laser has only with bounces above 1"
            )


def make_plan(world: TracedScene, settings: RenderSettings, seed: int) -> Plan:
    """Plan a render: every choice that `settings` leaves open follows from a pilot; every choice gets a reason.

    Where nothing is left open there is no pilot.
    """
    pixels = pilot_pixels(world, seed)
    reasons = list(_limits(world))
    mode_is_flood = world.scene.laser.mode == "flood"
    _check_laser(world.scene.laser.mode, settings)
    direct_alone = settings.bounces == 1 or (settings.bounces is None and world.scene.laser.mode == "scan")
    fine = None
    if settings.grid is None or settings.budget is not None or not direct_alone:
        fine = pilot_response(world, pixels, max(PILOT_GRID, _grid_for_cone(world)))
    target, why = _target(settings, fine)
    reasons.append(why)
    bounces, left_out, spp, paths, more_reasons = _indirect(world, settings, pixels, fine, target, seed)
    fraction = direct_fraction_of(settings, direct_alone)
    aim, paths = _aim(settings, target, paths)
    if aim < target:
        reasons.append(
            f"direct light and merging: planned for an error of {aim:.2g}, as the forced paths leave no more"
        )
    planned = PLANNED * settings.target_fraction * aim**2
    grid, off, why = _grid(world, settings, pixels, fraction * aim, paths, planned)
    if settings.grid is None and grid < _grid_for_cone(world):
        grid, width_px = _grid_for_cone(world), cone_width_px(world)
        why = f"direct light: {grid} x {grid} rays a pixel, as the laser's cone is {width_px:.2g} pixels wide"
    reasons += [why, *more_reasons]
    tolerance_m = settings.direct_tolerance_m
    if tolerance_m is None:
        tolerance_m = float(np.clip(TOLERANCE_M_PER_ERROR * aim, 1e-4, WIDEST_TOLERANCE_M))
    mirrors = any(surface.material.kind in ("conductor", "dielectric") for surface in world.scene.surfaces)
    narrowing = cell_narrowing(aim, world.has_glints or mirrors)
    width_m, growth = settings.indirect_tolerance_m, settings.indirect_growth
    fraction = default_edge_threshold(grid) if settings.edge_threshold is None else settings.edge_threshold
    ambient, ambient_noise, why = _ambient(world, settings, target)
    reasons.append(why)
    return Plan(
        bounces,
        spp,
        grid,
        ambient,
        tuple(reasons),
        edge_threshold=fraction,
        direct_tolerance_m=tolerance_m,
        indirect_tolerance_m=narrowing * WIDEST_INDIRECT_M if width_m is None else width_m,
        indirect_growth=narrowing * WIDEST_GROWTH if growth is None else growth,
        noise=math.sqrt(max(planned - off**2, MIN_NOISE_FRACTION * planned)),
        target=target,
        adaptive=settings.adaptive and mode_is_flood,
        filter=settings.filter,
        ambient_noise=ambient_noise,
        clamp=settings.clamp,
        refraction="bent" if world.refracts else "straight",
        left_out=left_out,
    )


def cell_narrowing(target: float, polished: bool) -> float:
    """Return the part of the widest cells of indirect light at which merging keeps to its part of a target."""
    return min(1.0, math.sqrt(MERGED_FRACTION * target / (MERGED_POLISHED if polished else MERGED)))


def _ambient(world: TracedScene, settings: RenderSettings, target: float) -> tuple[bool, float, str]:
    """Decide whether to render ambient light, to which noise, and say why: if there is any that a budget has room for.

    Noise that would make an error of AMBIENT_FRACTION of the target beside the signal of the budget's photons, or where
    there is no budget beside as many signal photons as background.
    """
    if not world.scene.has_ambient:
        return False, 0.0, "ambient light: none in the scene; a sensor's background will be uniform"
    if settings.ambient is False:
        return False, 0.0, "ambient light: left out, as asked"
    signal, background = settings.budget or (1.0, 1.0)
    if settings.ambient is None and background == 0:
        return False, 0.0, "ambient light: left out, the photon budget has no background"
    why = "as asked" if settings.ambient else "the scene has environment or area lights"
    if settings.ambient_spp is not None:
        return True, 0.0, f"ambient light: rendered, {why}, with {settings.ambient_spp} paths a pixel, forced"
    noise = AMBIENT_FRACTION * target / error_of_background(background or 1.0, signal)
    noise = float(np.clip(noise, MIN_AMBIENT_NOISE, MAX_AMBIENT_NOISE))
    return True, noise, f"ambient light: rendered, {why}, until its noise is {noise:.2g} of its mean"


def _limits(world: TracedScene) -> list[str]:
    """List the features of a scene that this renderer simplifies, a line each."""
    materials: list[Material] = [surface.material for surface in world.scene.surfaces]
    lines = []
    if world.has_cutouts:
        lines.append("cut-outs: solid where their opacity is 1/2 or more")
    if world.solid_indices:
        way = "direct light is refracted, other laser light crosses it in a straight line"
        lines.append(f"thick glass: {way if world.refracts else 'crossed in a straight line'}")
    if any(m.kind == "roughdiffuse" for m in materials):
        lines.append("rough diffuse surfaces: rendered as Lambertian")
    return lines


def _target(settings: RenderSettings, fine: np.ndarray | None) -> tuple[float, str]:
    if settings.budget is not None:
        signal, background = settings.budget
        assert fine is not None
        target = error_for_budget(fine, signal, background)
        why = f"error target: {target:.2g}, 1 % of shot variance at {signal:g} + {background:g} photons a pixel"
        return target, why
    if settings.error is not None:
        return settings.error, f"error target: {settings.error:g}, as asked"
    return DEFAULT_ERROR, f"error target: {DEFAULT_ERROR:g}, the default"


def _grid(
    world: TracedScene, settings: RenderSettings, pixels: np.ndarray, allowed: float, paths: float, squared: float
) -> tuple[int, float, str]:
    """Choose the grid whose direct light is off by at most `allowed`; return it, how much it is off, and why.

    The smallest such; or a finer one, if that saves more than it costs where the square of the error of all light may
    be `squared`, for which indirect light alone takes `paths` a pixel.

    Grids double, or halve, until one differs by no more from the next and one by more; between two, errors follow a
    power of the grid. Up to EXTRAPOLATED times the last one measured they fall at least as GRID_POWER says: another
    pilot would cost more than it saves.
    """
    if settings.grid is not None:
        return settings.grid, allowed, f"direct light: {settings.grid} x {settings.grid} rays a pixel, forced"

    def off(grid: int) -> float:
        coarse, finer = (pilot_response(world, pixels, number) for number in (grid, 2 * grid))
        # what no ray has met yet may be thin
        return estimate(coarse, finer).total / PILOT_SHOWS if finer.any() else math.inf

    errors = {PILOT_GRID: off(PILOT_GRID)}
    while errors[min(errors)] <= allowed and min(errors) > GRIDS[0]:
        errors[min(errors) // 2] = off(min(errors) // 2)
    while errors[max(errors)] > EXTRAPOLATED**GRID_POWER * allowed and max(errors) < GRIDS[-1]:
        errors[2 * max(errors)] = off(2 * max(errors))
    coarse = max((grid for grid, error in errors.items() if error > allowed), default=min(errors))
    error, finer = errors[coarse], errors.get(2 * coarse, 0)
    if error == math.inf:
        return coarse, allowed, f"direct light: {coarse} x {coarse} rays a pixel, none of the pilot's pixels is lit"
    power = math.log2(error / finer) if 0 < finer < error else GRID_POWER
    grid = max(min(math.ceil(coarse * (error / allowed) ** (1 / power)), GRIDS[-1]), coarse)
    offs = {g: error * (coarse / g) ** (power if g <= 2 * coarse else GRID_POWER) for g in range(grid, GRIDS[-1] + 1)}
    grid = min(offs, key=lambda g: CELL_COST * g**2 + paths / max(1 - offs[g] ** 2 / squared, MIN_NOISE_FRACTION))
    why = f"direct light: {grid} x {grid} rays a pixel, error {offs[grid]:.2g} by twice as many a side"
    if offs[grid] > allowed:
        asked = settings.spp is None or settings.error is not None
        return grid, allowed, f"{why}: its share of the target needs more; force grid" if asked else why
    return grid, offs[grid], why


def _indirect(
    world: TracedScene, settings: RenderSettings, pixels: np.ndarray, fine: np.ndarray | None, target: float, seed: int
) -> tuple[int, float, int | None, float, list[str]]:
    """Choose bounces and paths a pixel; return the bounces, the share of light left out beyond where it matters, the
    paths (None: left to the schedule), about how many meet the target if every pixel has its own, and why."""
    mode = world.scene.laser.mode
    if settings.bounces == 1:
        return 1, 0.0, 0, 0.0, ["indirect light: none, forced by 1 bounce"]
    if settings.bounces is None and mode == "scan":
        why = "indirect light: left out, also of the error, under a scanning laser unless bounces ask for it"
        return 1, 0.0, 0, 0.0, [why]
    most = PILOT_BOUNCES if settings.bounces is None else settings.bounces
    energy, noise = energy_by_bounces(world, pixels, MIN_SPP, most, seed)
    assert fine is not None
    energy[1] = fine.sum()
    lines, bounces, left_out = list[str](), settings.bounces, 0.0
    if energy.sum() <= 0:  # what the laser lights may lie between the pilot's rays
        most = bounces or MIN_BOUNCES
        return most, 0.0, settings.spp, 0.0, [f"bounces: {most}; indirect light: the pilot's paths found no light"]
    if bounces is None:
        bounces, left_out = bounces_for(energy, min(LEFT_OUT * target, MAX_LEFT_OUT), MIN_BOUNCES)
        if bounces == MAX_BOUNCES and left_out > MATTERS:
            spp = LATE_SPP * PILOT_PIXELS // len(pixels)
            energy = energy_by_bounces(world, pixels, spp, bounces, seed)[0]
            energy[1] = fine.sum()
            left_out = share_beyond(energy)
        fraction = energy[2:].sum() / energy.sum()
        lines.append(
            f"bounces: {bounces}; indirect light is {fraction:.2%} of the energy, {left_out:.2%} is left out beyond"
        )
    else:
        lines.append(f"bounces: {bounces}, forced")
    if bounces == 1:
        return 1, 0.0, 0, 0.0, [*lines, "indirect light: none, what it adds is less than may be left out"]
    power = float((fine**2).sum())
    paths = noise * PULSE_POWER / (PLANNED * settings.target_fraction * target**2 * power) if power > 0 else 0.0
    if settings.spp is not None:
        lines.append(f"indirect light: the work of {settings.spp} paths a pixel, forced")
    return bounces, left_out if left_out > MATTERS else 0.0, settings.spp, 0.0 if settings.filter else paths, lines


def _aim(settings: RenderSettings, target: float, paths: float) -> tuple[float, float]:
    """Return the error that direct light and merging are planned for, and the paths a pixel beside them: the target,
    or what forced paths leave where no target was asked for and that is less. As many own paths as `paths` meet it.

    Where direct light is all but everything that would be next to nothing, and cells would have no width.
    """
    if settings.spp is None:
        return target, paths
    left = SHARED_NOISE * target * math.sqrt(paths / settings.spp)
    if settings.error is not None or settings.budget is not None or not 0 < left < target:
        return target, 0.0
    return max(left, MIN_ERROR), settings.spp


def bounces_for(energy: np.ndarray, allowed: float, least: int = 1) -> tuple[int, float]:
    """Find the fewest bounces that leave out at most the share `allowed` of the energy, and the share left out.

    More than one are at least as many as `least`. What lies beyond the pilot's last bounce follows the geometric series
    of its later half: of two alone, a rare bright path in the last one would make any number too few.
    """
    half = len(energy) // 2
    before = energy[half:-1].sum()
    ratio = min(energy[half + 1 :].sum() / before, 0.99) if before > 0 else 0.0
    beyond = energy[-1] * ratio ** np.arange(1, MAX_BOUNCES - len(energy) + 2)
    tail = energy[-1] * ratio / (1 - ratio) - beyond.sum()
    full = np.concatenate((energy, beyond))
    left_out = (full.sum() + tail - np.cumsum(full)) / (full.sum() + tail)
    bounces = int(np.argmax(left_out[1:] <= allowed)) + 1 if (left_out[1:] <= allowed).any() else MAX_BOUNCES
    bounces = max(bounces, least) if bounces > 1 else 1
    return bounces, max(float(left_out[bounces]), 0.0)


def share_beyond(energy: np.ndarray) -> float:
    """Estimate the share of all energy beyond the last of many bounces: a geometric series goes on as its last two
    thirds do, one to the other."""
    third = len(energy) // 3
    before, last = energy[-2 * third : -third].sum(), energy[-third:].sum()
    ratio = min(last / before, 0.99) if before > 0 else 0.0
    beyond = last * ratio / (1 - ratio)
    return float(beyond / (energy.sum() + beyond)) if beyond > 0 else 0.0
