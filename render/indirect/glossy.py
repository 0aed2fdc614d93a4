"""Find polished surfaces that the laser shines on, and weight the paths of indirect light that are better begun on
them.

Polished metal throws a flash's light as caustics on what is around it. A path from a wall meets such metal by chance
where that sends the light of the laser on its way, once in ten thousand times, and is as bright then. A path from the
laser that begins on the metal, in a direction that its lobe sends light to, finds the wall
(`render.indirect.light_tracing`).

Both ways sample paths C ... y x L whose last point x before the laser is such a surface. The one that begins on x keeps

    c = a / (a + b),   a = RATIO p_x(L -> y) cos_xL cos_yx |y - C|^2,   b = p_y(C -> x) cos_yC cos_xy |x - L|^2,

the other 1 - c: the balance heuristic (Veach 1997, eq. 9.8) for the densities of the pair x, y per area, as both ways
sample it. p_x and p_y are the densities of all lobes of both surfaces together: what y reflects is taken as the camera
sees it, which is exact where y is the pixel's own surface, and the same for both ways elsewhere. Whatever c is, the sum
of both is right, as long as both take it from the same points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Interactions, Masks, UInts, Vectors
from render.scene.rays import camera_rays, first_opaque, interaction_from_parts, parts_of, raster_of, shape_index
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload

RATIO = 1.0  # paths that begin in a polished pixel of the laser's image, for every path of others (1 to 2 do best)
# Where SEEN_BY x SEEN_BY rays a pixel meet no polished surface there may be a sliver: the share that begins there.
SEEN_BY, ELSEWHERE = 2, 1 / 8
WIDEST_DEG = 60.0  # off the optical axis, how far such surfaces are looked for


class Glossy(NamedTuple):
    """An image as an eye in the laser's place has it that looks as the camera does: how many paths begin in each pixel,
    1 where it shows polished surfaces. It is `width` x `height`, and begins so much to the `left` of the camera's and
    `up` that it holds what the laser lights. Arrays of Dr.Jit."""

    sampling_density: Array
    left: UInts
    up: UInts
    width: UInts
    height: UInts


def glossy_of(world: TracedScene) -> Glossy | None:
    """Return where a flood laser lights polished surfaces, looked for once; None if nowhere."""
    if not world.has_glossy or world.scene.laser.mode != "flood":
        return None
    if world.glossy is None:
        world.glossy = _look_for(world)
    return Glossy(*world.glossy) if world.glossy else None


def _look_for(world: TracedScene) -> tuple[Array, ...]:
    """Find the parts of `Glossy`, none if no surface is glossy: a plain tuple, which recordings take for an input."""
    camera, laser = world.scene.camera, world.scene.laser
    angle = min(math.acos(laser.cos_half_angle(camera)), math.radians(WIDEST_DEG))
    reach = camera.focal_px * math.tan(angle)
    left, up = (max(0, math.ceil(reach - side / 2)) for side in (camera.width, camera.height))
    width, height = camera.width + 2 * left, camera.height + 2 * up
    pixel = dr.arange(UInt32, width * height)
    dr.eval(pixel)
    numbers = [dr.opaque(UInt32, number) for number in (left, up, width, height)]
    polished = world.recordings.call(world, "glossy", _shows, pixel, *numbers).numpy().reshape(height, width)
    sampling_density = polished.astype(np.float64)
    if not polished.any():
        return ()
    own = sampling_density[up : up + camera.height, left : left + camera.width]
    own[own == 0] = ELSEWHERE
    # of no launch's length, or Dr.Jit would record it anew (`render.indirect.camera_paths`)
    return upload(Float, sampling_density, 16 * (sampling_density.size // 16 + 1) + 5), *numbers


def _shows(world: TracedScene, pixel: UInts, left: UInts, up: UInts, width: UInts, height: UInts) -> Array:
    shown = Bool(False)
    for place in range(SEEN_BY**2):
        x, y = ((part + 0.5) / SEEN_BY for part in (place % SEEN_BY, place // SEEN_BY))
        ray, _ = laser_rays(world, pixel, x, y, left, up, width)
        si, _, _, _ = first_opaque(world, ray, Bool(True))
        hit = si.is_valid()
        shown |= hit & is_glossy(world, si, hit)
    return shown


def laser_rays(
    world: TracedScene, pixel: UInts, x: Floats, y: Floats, left: UInts, up: UInts, width: UInts
) -> tuple[Array, Array]:
    """Return `camera_rays` from the laser through places in pixels of its image."""
    column, row = Float(pixel % width) - Float(left), Float(pixel // width) - Float(up)
    return camera_rays(world, column + x, row + y, world.laser)


def is_glossy(world: TracedScene, si: Interactions, active: Masks) -> Array:
    """Return whether a point lies on a polished surface."""
    return active & (dr.gather(Float, world.glossy_materials, shape_index(si), active) > 0)


def mis_weight_camera_path(
    world: TracedScene, y: Interactions, direction: Vectors, x: Interactions, active: Masks
) -> Array:
    """Return 1 - c: what a path from `y` in that direction to `x`, and on to the laser, keeps of its light.

    Rays start a little off their points, which tell the direction badly where these are close.
    """
    glossy = glossy_of(world)
    if glossy is None:
        return 1
    column, row, seen = raster_of(world, world.laser, x.p)
    column, row = dr.floor(column) + Float(glossy.left), dr.floor(row) + Float(glossy.up)
    seen &= (column >= 0) & (column < Float(glossy.width)) & (row >= 0) & (row < Float(glossy.height))
    seen &= is_glossy(world, x, active)
    pixel = UInt32(dr.select(seen, row, 0)) * glossy.width + UInt32(dr.select(seen, column, 0))
    return 1 - _light_path_weight(world, pixel, y, direction, x, seen)


def mis_weight_light_path(
    world: TracedScene, pixel: UInts, y: Interactions, direction: Vectors, x: Interactions, active: Masks
) -> Array:
    """Return c: what the path that begins in this pixel, on `x`, and goes to `y` has of that light; `direction` is the
    way back."""
    return _light_path_weight(world, pixel, y, direction, x, active)


def _light_path_weight(
    world: TracedScene, pixel: UInts, y: Interactions, direction: Vectors, x: Interactions, active: Masks
) -> Array:
    """Compute the weight c of a path from the laser, as in the module's text; 0 where no path from the laser samples
    the pair."""
    to_x, to_laser, to_eye = dr.normalize(direction), world.laser - x.p, world.eye - y.p
    light, eye = dr.normalize(to_laser), dr.normalize(to_eye)
    glossy = glossy_of(world)
    assert glossy is not None
    begun = dr.gather(Float, glossy.sampling_density, pixel, active) * RATIO
    begun *= dr.abs(dr.dot(x.n, light) * dr.dot(y.n, to_x)) * dr.squared_norm(to_eye)
    begun *= _density(x, light, -to_x, active)
    ended = dr.abs(dr.dot(y.n, eye) * dr.dot(x.n, to_x)) * dr.squared_norm(to_laser)
    ended *= _density(y, eye, to_x, active)
    weight = begun / (begun + ended)
    return dr.select(active & (begun > 0) & dr.isfinite(weight), weight, 0)


def _density(si: Interactions, seen_from: Vectors, towards: Vectors, active: Masks) -> Array:
    """Compute the density per solid angle with which the lobes of a surface, seen from one direction, sample
    another."""
    seen = interaction_from_parts(parts_of(si))
    seen.wi = si.to_local(seen_from)
    return si.bsdf().pdf(mi.BSDFContext(), seen, si.to_local(towards), active)
