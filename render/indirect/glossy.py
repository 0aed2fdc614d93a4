"""Polished surfaces that the laser shines on: which paths of indirect light are better begun on them.

Polished metal throws a flash's light as caustics on what is around it. A path from a wall meets such metal by chance
where that sends the light of the laser on its way, once in ten thousand times, and is as bright then. A path from the
laser that begins on the metal, in a direction that its lobe sends light to, finds the wall
(`render.indirect.light_tracing`).

Both ways sample paths C ... y x L whose last point x before the laser is such metal. The one that begins on x keeps

    c = r / (1 + r),   r = RATIO pi D / (4 cos) (|y - C| / |x - L|)^2,

the other 1 - c: the balance heuristic (Veach 1997, eq. 9.8) for the two densities of the pair x, y, a GGX lobe's D / 4
beside a diffuse one's cos / pi. Beckmann lobes, of the same peak, take it too. Whatever c is, the sum of both is right,
as long as both take it from the same points.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from render.scene.rays import camera_rays, first_opaque, raster_of, shape_index
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, upload

RATIO = 2.0  # paths that begin in a polished pixel of the laser's image, for every path of others (1 to 2 do best)
# Where SEEN_BY x SEEN_BY rays a pixel meet no polished surface there may be a sliver: the share that begins there.
SEEN_BY, ELSEWHERE = 2, 1 / 8
WIDEST_DEG = 60.0  # off the optical axis, how far such surfaces are looked for
MIN_COSINE = 1e-2


class Glossy(NamedTuple):
    """An image as an eye in the laser's place has it that looks as the camera does: how many paths begin in each pixel,
    1 where it shows polished surfaces. It is `width` x `height`, and begins so much to the `left` of the camera's and
    `up` that it holds what the laser lights. Arrays of Dr.Jit."""

    shares: Any
    left: Any
    up: Any
    width: Any
    height: Any


def glossy_of(world: TracedScene) -> Glossy | None:
    """Where a flood laser lights polished surfaces, looked for once; None if nowhere.

    Glass and cut-outs on the way would need to be crossed from the other side, too.
    """
    if not world.has_glints or world.sees_through or world.scene.laser.mode != "flood":
        return None
    if world.glossy is None:
        world.glossy = _look_for(world)
    return Glossy(*world.glossy) if world.glossy else None


def _look_for(world: TracedScene) -> tuple[Any, ...]:
    """The parts of `Glossy`, none if nowhere: a plain tuple, which recordings take for an input."""
    camera, laser = world.scene.camera, world.scene.laser
    angle = min(math.acos(laser.cos_half_angle(camera)), math.radians(WIDEST_DEG))
    reach = camera.focal_px * math.tan(angle)
    left, up = (max(0, math.ceil(reach - side / 2)) for side in (camera.width, camera.height))
    width, height = camera.width + 2 * left, camera.height + 2 * up
    pixel = dr.arange(UInt32, width * height)
    dr.eval(pixel)
    numbers = [dr.opaque(UInt32, number) for number in (left, up, width, height)]
    polished = world.recordings.call(world, "glossy", _shows, pixel, *numbers).numpy().reshape(height, width)
    shares = polished.astype(np.float64)
    if not polished.any():
        return ()
    own = shares[up : up + camera.height, left : left + camera.width]
    own[own == 0] = ELSEWHERE
    return upload(Float, shares), *numbers


def _shows(world: TracedScene, pixel: Any, left: Any, up: Any, width: Any, height: Any) -> Any:
    shown = Bool(False)
    for place in range(SEEN_BY**2):
        x, y = ((part + 0.5) / SEEN_BY for part in (place % SEEN_BY, place // SEEN_BY))
        ray, _ = laser_rays(world, pixel, x, y, left, up, width)
        si, _, _, _ = first_opaque(world, ray, Bool(True))
        hit = si.is_valid()
        shown |= hit & is_glossy(world, si, hit)
    return shown


def laser_rays(world: TracedScene, pixel: Any, x: Any, y: Any, left: Any, up: Any, width: Any) -> tuple[Any, Any]:
    """`camera_rays` from the laser through places in pixels of its image."""
    column, row = Float(pixel % width) - Float(left), Float(pixel // width) - Float(up)
    return camera_rays(world, column + x, row + y, world.laser)


def is_glossy(world: TracedScene, si: Any, active: Any) -> Any:
    """Whether a point lies on a polished surface."""
    return active & (dr.gather(Float, world.peak, shape_index(si), active) > 0)


def mis_weight_camera_path(world: TracedScene, point: Any, direction: Any, end: Any, active: Any) -> Any:
    """1 - c: what a path from `point` in that direction to `end`, and on to the laser, keeps of its light.

    Rays start a little off their points, which tell the direction badly where these are close.
    """
    glossy = glossy_of(world)
    if glossy is None:
        return 1
    x, y, seen = raster_of(world, world.laser, end.p)
    column, row = dr.floor(x) + Float(glossy.left), dr.floor(y) + Float(glossy.up)
    seen &= (column >= 0) & (column < Float(glossy.width)) & (row >= 0) & (row < Float(glossy.height))
    seen &= is_glossy(world, end, active)
    pixel = UInt32(dr.select(seen, row, 0)) * glossy.width + UInt32(dr.select(seen, column, 0))
    odds = dr.gather(Float, glossy.shares, pixel, seen) * _odds(world, point, direction, end, seen)
    return dr.select(seen, 1 / (1 + odds), 1)


def mis_weight_light_path(world: TracedScene, pixel: Any, point: Any, direction: Any, end: Any, active: Any) -> Any:
    """c: what the path that begins in this pixel, on `end`, and goes to `point` has of that light; `direction` is the
    way back."""
    odds = dr.gather(Float, glossy_of(world).shares, pixel, active) * _odds(world, point, direction, end, active)
    return dr.select(active, odds / (1 + odds), 0)


def _odds(world: TracedScene, point: Any, direction: Any, end: Any, active: Any) -> Any:
    to_laser, way, normal = world.laser - end.p, -dr.normalize(direction), end.sh_frame.n
    light = dr.normalize(to_laser)
    cosine = dr.dot(normal, way)
    rough2 = dr.square(dr.gather(Float, world.roughness, shape_index(end), active))
    between = dr.square(dr.dot(normal, dr.normalize(light + way)))
    facets = rough2 / (math.pi * dr.square(between * (rough2 - 1) + 1))
    odds = RATIO * math.pi / 4 * facets / dr.maximum(dr.abs(cosine), MIN_COSINE)
    odds *= dr.squared_norm(point - world.eye) / dr.squared_norm(to_laser)
    return dr.select(dr.isfinite(odds) & (cosine * dr.dot(normal, light) > 0), odds, 0)
