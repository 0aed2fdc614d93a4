"""Find polished surfaces that the laser shines on, and weight the paths of indirect light that are better begun on
them.

Polished metal throws a flash's light as caustics on what is around it. A path from a wall meets such metal by chance
where that sends the light of the laser on its way, once in ten thousand times, and is as bright then. A path from the
laser that begins on the metal, in a direction that its lobe sends light to, finds the wall
(`render.indirect.light_tracing`).

Both ways sample paths C, z1, ..., zk, L whose last point zk is such a surface. The one that begins on it keeps c, the
other 1 - c, with

    c = a / (a + b),   a / b = Z1 Z2 ... Zk,

a and b the densities per area with which the two ways sample all of these points: the balance heuristic over the whole
path (Veach 1997, eq. 9.8 and section 10.2). With p_m(v -> w) the density of all lobes of zm together, lengths d, and
cos(v) the cosine at zm towards v,

    Z1 = cos(z2) d(z1, C)^2 / (SERVED cos(C) p_1(C -> z2)),
    Zm = p_m(z(m+1) -> z(m-1)) cos(z(m+1)) / (p_m(z(m-1) -> z(m+1)) cos(z(m-1)))   between the two ends,
    Zk = RATIO cos(L) p_k(L -> z(k-1)) / (cos(z(k-1)) d(zk, L)^2).

Zm is 1 where a path leaves a mirror. A path from the camera counts SERVED times, since several pixels use it
(`render.indirect.reuse`, `render.indirect.path_space_filter`), and one from the laser once. Whatever c is, the sum of
both is right, as long as both take it from the same points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Interactions, LobeSamples, Masks, UInts, Vectors
from render.scene.rays import (
    camera_rays,
    first_opaque,
    in_beam,
    interaction_from_parts,
    parts_of,
    raster_of,
    shape_index,
    to_camera,
    to_world,
)
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload

RATIO = 1.0  # paths that begin in a polished pixel of the laser's image, for every path of others (1 to 2 do best)
# Pixels that use a path from the camera, as the weights count them. In a varnished hall 8 has half the squared error of
# 1, shared or filtered, and 4 and 16 do nearly as well; between narrow lobes, which few pixels share, 1 is better.
SERVED = 8.0
MAX_LIGHT_PATHS = 2.0  # for every path from the camera (1 to 4 do as well in a varnished hall under a lamp)
# Where SEEN_BY x SEEN_BY rays a pixel meet no polished surface there may be a sliver: the share that begins there.
SEEN_BY, ELSEWHERE = 2, 1 / 8
WIDEST_DEG = 60.0  # off the optical axis, which the image of a wider laser does not show as a plane
MAX_IMAGE = 1 << 25  # pixels of the laser's image: those of a telephoto camera under a wide laser would be without end
MAX_RATIO = 1e30  # of the densities of both ways


class Glossy(NamedTuple):
    """An image of what the laser lights, as an eye in its place has it: how many paths begin in each pixel, 1 where it
    shows polished surfaces. It is `width` x `height`; arrays of Dr.Jit.

    It looks as the camera does, and begins so much to the `left` of the camera's and `up` that it holds what the laser
    lights. Of a wider laser it is a panorama (`left` and `up` are None): its columns are angles about the vertical axis
    of the camera, its rows cosines to that, so that all pixels have one solid angle (Archimedes), that of the camera's
    on the axis or what MAX_IMAGE of them leave to each.
    """

    sampling_density: Array
    width: UInts
    height: UInts
    left: UInts = None
    up: UInts = None


def glossy_of(world: TracedScene) -> Glossy | None:
    """Return where a flood laser lights polished surfaces, looked for once; None if nowhere."""
    if not world.has_glossy or world.scene.laser.mode != "flood":
        return None
    if world.glossy is None:
        world.glossy = _look_for(world)
    return Glossy(*world.glossy) if world.glossy else None


def has_light_paths(world: TracedScene) -> bool:
    """Return whether paths begin at the laser, too."""
    return glossy_of(world) is not None


def _look_for(world: TracedScene) -> tuple[Array, ...]:
    """Find the parts of `Glossy`, none if no surface is glossy: a plain tuple, which recordings take for an input."""
    camera, cosine = world.scene.camera, world.scene.laser.cos_half_angle(world.scene.camera)
    reach = camera.focal_px * math.tan(min(math.acos(cosine), math.radians(WIDEST_DEG)))
    left, up = (max(0, math.ceil(reach - side / 2)) for side in (camera.width, camera.height))
    width, height = camera.width + 2 * left, camera.height + 2 * up
    if cosine < math.cos(math.radians(WIDEST_DEG)) or width * height > MAX_IMAGE:
        focal_px = min(camera.focal_px, math.sqrt(MAX_IMAGE / (4 * math.pi)))
        width, height = (math.ceil(turns * focal_px) for turns in (2 * math.pi, 2))
        image = [dr.opaque(UInt32, number) for number in (width, height)]
        own = _forward_cosines(width, height) >= cosine
    else:
        image = [dr.opaque(UInt32, number) for number in (width, height, left, up)]
        own = np.zeros((height, width), bool)
        own[up : up + camera.height, left : left + camera.width] = True
    pixel = dr.arange(UInt32, width * height)
    dr.eval(pixel)
    polished = world.recordings.call(world, "glossy", _shows, pixel, *image).numpy().reshape(height, width)
    if not polished.any():
        return ()
    sampling_density = np.where(own & ~polished, ELSEWHERE, polished)
    # what a wide laser lights beyond the view is large, and throws little of its light into it
    most = MAX_LIGHT_PATHS / RATIO * camera.width * camera.height
    sampling_density = sampling_density * min(1, most / sampling_density.sum())
    # of no launch's length, or Dr.Jit would record it anew (`render.indirect.camera_paths`)
    return upload(Float, sampling_density, 16 * (sampling_density.size // 16 + 1) + 5), *image


def _forward_cosines(width: int, height: int) -> np.ndarray:
    """Return cosines to the optical axis of the middles of a panorama's pixels, (height, width)."""
    turn = 2 * np.pi * (np.arange(width) + 0.5) / width
    down = 2 * (np.arange(height) + 0.5) / height - 1
    return np.sqrt(1 - down**2)[:, None] * np.cos(turn)


def _shows(world: TracedScene, pixel: UInts, *image: Array) -> Array:
    shown = Bool(False)
    for place in range(SEEN_BY**2):
        x, y = ((part + 0.5) / SEEN_BY for part in (place % SEEN_BY, place // SEEN_BY))
        ray, _ = laser_rays(world, pixel, x, y, Glossy(None, *image))
        si, _, _, _ = first_opaque(world, ray, Bool(True))
        hit = si.is_valid()
        shown |= hit & is_glossy(world, si, hit) & in_beam(world, si.p, pixel)
    return shown


def laser_rays(world: TracedScene, pixel: UInts, x: Floats, y: Floats, image: Glossy) -> tuple[Array, Array]:
    """Return rays from the laser through places in pixels of its image, and the solid angle of each pixel there, in
    that of a camera's pixel on the optical axis."""
    column, row = Float(pixel % image.width) + x, Float(pixel // image.width) + y
    if image.left is not None:
        ray, aim = camera_rays(world, column - Float(image.left), row - Float(image.up), world.laser)
        return ray, dr.rcp(dr.norm(aim)) ** 3  # |aim| = 1 / cos a
    down = 2 * row / Float(image.height) - 1
    ring = dr.sqrt(dr.maximum(1 - dr.square(down), 0))
    sine, cosine = dr.sincos(2 * math.pi * column / Float(image.width))
    towards = to_world(world, mi.Vector3f(ring * sine, down, ring * cosine))
    solid_angle = 4 * math.pi * dr.square(world.focal_px) / Float(image.width * image.height)
    return mi.Ray3f(mi.Point3f(world.laser) + 0 * towards, towards), solid_angle + 0 * down


def laser_pixel_of(world: TracedScene, point: Array, image: Glossy) -> tuple[Array, Array]:
    """Return the pixel of the laser's image that shows a point, and whether there is one."""
    if image.left is not None:
        column, row, seen = raster_of(world, world.laser, point)
        column, row = column + Float(image.left), row + Float(image.up)
    else:
        aim = dr.normalize(to_camera(world, mi.Vector3f(point) - world.laser))
        turn = dr.atan2(aim.x, aim.z) / (2 * math.pi)
        column = dr.minimum((turn - dr.floor(turn)) * Float(image.width), Float(image.width) - 0.5)
        row, seen = dr.minimum((aim.y + 1) / 2 * Float(image.height), Float(image.height) - 0.5), dr.isfinite(aim.y)
    column, row = dr.floor(column), dr.floor(row)
    seen &= (column >= 0) & (column < Float(image.width)) & (row >= 0) & (row < Float(image.height))
    return UInt32(dr.select(seen, row, 0)) * image.width + UInt32(dr.select(seen, column, 0)), seen


def is_glossy(world: TracedScene, si: Interactions, active: Masks) -> Array:
    """Return whether a point lies on a polished surface."""
    return active & (dr.gather(Float, world.glossy_materials, shape_index(si), active) > 0)


def camera_share(ratio: Floats) -> Array:
    """Return 1 - c, which paths from the camera keep, of a path whose two densities have the ratio a / b."""
    return dr.rcp(1 + finite_ratio(ratio))


def light_share(ratio: Floats, other: Floats = 0) -> Array:
    """Return c, which paths from the laser keep, of a path whose two densities have the ratio a / b; `other` is the
    density of a third way over b."""
    return finite_ratio(ratio) * camera_share(finite_ratio(ratio) + other)


def finite_ratio(ratio: Floats) -> Array:
    """Return a ratio of densities, or a part of one, as a number that is neither infinite nor undefined."""
    return dr.select(dr.isnan(ratio), 0, dr.clip(ratio, 0, MAX_RATIO))


def ratio_at_laser(world: TracedScene, x: Interactions, towards: Vectors, active: Masks) -> Array:
    """Compute the factor of a / b that the last surface `x` before the laser has; 0 where no path from the laser begins
    on it. `towards` is the direction in which it sends the laser's light."""
    glossy = glossy_of(world)
    assert glossy is not None
    pixel, seen = laser_pixel_of(world, x.p, glossy)
    return ratio_of_light_path(world, pixel, x, towards, seen & is_glossy(world, x, active))


def ratio_of_light_path(world: TracedScene, pixel: UInts, x: Interactions, towards: Vectors, active: Masks) -> Array:
    """Compute `ratio_at_laser` of a path that began in this pixel of the laser's image."""
    glossy = glossy_of(world)
    assert glossy is not None
    to_laser = world.laser - x.p
    light = dr.normalize(to_laser)
    begun = dr.gather(Float, glossy.sampling_density, pixel, active) * RATIO * dr.abs(dr.dot(x.n, light))
    begun *= lobe_density(x, x.to_local(light), x.to_local(towards), active)
    return dr.select(active, begun / (dr.abs(dr.dot(x.n, towards)) * dr.squared_norm(to_laser)), 0)


def ratio_at_camera(
    world: TracedScene, y: Interactions, towards: Vectors, active: Masks, density: Floats = None
) -> Array:
    """Compute the factor of a / b that the camera's own surface `y` has, from which a path goes on `towards` there.
    `density` is that of this direction as the camera's paths sample it, if it is known."""
    to_eye = world.eye - y.p
    eye = dr.normalize(to_eye)
    if density is None:
        density = lobe_density(y, y.to_local(eye), y.to_local(towards), active)
    return dr.abs(dr.dot(y.n, towards)) * dr.squared_norm(to_eye) / (SERVED * dr.abs(dr.dot(y.n, eye)) * density)


def reversal(si: Interactions, out: Vectors, density: Floats, active: Masks) -> Array:
    """Compute the density of the way back over that of the way out, both per projected solid angle: the factor of a / b
    that a surface between the two ends has on a path from the camera; on one from the laser it divides.

    The way came from `si.wi` and goes `out`, which was sampled with that `density`; both in the shading frame. 1 for
    diffuse surfaces.
    """
    return lobe_density(si, out, si.wi, active) * dr.abs(out.z) / (density * dr.abs(si.wi.z))


def reversal_of_sample(si: Interactions, sample: LobeSamples, active: Masks) -> Array:
    """Compute `reversal` of a sampled direction; 1 of a mirror-like lobe, which no density tells."""
    smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return dr.select(smooth, 1, reversal(si, sample.wo, sample.pdf, active & ~smooth))


def lobe_density(si: Interactions, seen_from: Vectors, towards: Vectors, active: Masks) -> Array:
    """Compute the density per solid angle with which the lobes of a surface, seen from one direction, sample
    another; both in its shading frame."""
    seen = interaction_from_parts(parts_of(si))
    seen.wi = seen_from
    return si.bsdf().pdf(mi.BSDFContext(), seen, towards, active)
