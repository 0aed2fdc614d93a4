"""One ray per cell of a pixel, and the footprint of the cell on the face that the ray hits.

A cell is a square of a pixel, `pitch` pixels wide. Seen on the tangent plane of the point its ray hits, it spans
path lengths p(x, y) = rho + |p - L|. To first order p is linear over the cell, so its distribution is a trapezoid of
variance (a^2 + b^2) / 3 with half spans a = |dp/dx| pitch/2, b = |dp/dy| pitch/2; the cell's return is uniform over
p +- sqrt(a^2 + b^2), which has the same mean and variance. Its radiance is f cos I / d^2 (`laser_leg`), that of the
ray. Both hold while the cell is small: on a plane radiance goes with u^3 and distance with 1/u, u = n . l, so that a
cell over which u changes by a share D makes an energy error of D^2 / 4 and shifts the mean path by a share D^2 / 6.
SMALL bounds D: 1/32 means 2.5e-4 of energy, and a shift of 1 % of the standard deviation of a pixel of 2 x 2 cells.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Interactions, Masks, Rays, UInts, Vectors
from render.scene.rays import PLAIN_GOLDEN, camera_rays, first_opaque, laser_leg, shape_index, tangent_motion, to_camera
from render.scene.refraction import bundle_of, refracted_hit
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload

SMALL = 1 / 32
# beside a displaced laser: a cell's extent over its distance to the laser, second order in the laser leg
SMALL_FROM_LASER = 1 / 8
HIT, LIT, LARGE, CLIPPED = 1, 2, 4, 8
LEVEL_BIT = 24  # rows of cells stay below 2^24
# Rays move by at most half of this share of a cell's width: it does best over straight and round edges (measured). Rays
# of children move farther, since edges beside them are sought between rays, not between cells.
MOVED, MOVED_CUT = 0.75, 0.9
FINE = 8  # rows a pixel, from which on rays in the middle do as well where nothing is cut (measured)


class Footprints(NamedTuple):
    """Per cell, float32 (N,): path centre, half width, smaller half span b [m] (0: unknown), energy (radiance times the
    cell's share of its pixel), radial distance of the centre [m], its change per pixel along x and y [m], radiance,
    |cosine| of the shading normal and the way to the laser, and flags HIT, LIT, LARGE, CLIPPED (uint32).

    Of worlds with glints also how far the shading normal is from the middle of the highlight, n - h with h halfway
    between the ways to camera and laser, in camera-frame x and y over the surface's roughness; and the radiance in
    the middle (0: no glint)."""

    path_m: np.ndarray
    half_width_m: np.ndarray
    minor_m: np.ndarray
    energy: np.ndarray
    distance_m: np.ndarray
    slope_x_m: np.ndarray
    slope_y_m: np.ndarray
    radiance: np.ndarray
    facing: np.ndarray
    flags: np.ndarray
    tilt_x: np.ndarray | None = None
    tilt_y: np.ndarray | None = None
    peak: np.ndarray | None = None


def trace(
    world: TracedScene, column: np.ndarray, row: np.ndarray, level: np.ndarray, grid: int, *, clip: bool = False
) -> Footprints:
    """Return footprints of the cells in these columns and rows (N,) of an image of cells 1/(grid 2^level) pixels wide.

    With `clip` a footprint that is not small is cut to the path lengths that its face spans.
    """
    if len(column) == 0:
        nothing = np.empty(0, np.float32)
        return Footprints(*(nothing,) * 9, np.empty(0, np.uint32), *(nothing,) * (3 if world.has_glints else 0))
    packed = row.astype(np.uint32) | level.astype(np.uint32) << LEVEL_BIT
    count, lanes = len(column), _lanes(len(column))
    columns = [upload(UInt32, values, lanes) for values in (column, packed)]
    work = partial(_refracted_footprints if world.refracts else _footprints, clip=clip)
    found = world.recordings.call(world, ("footprints", clip, world.refracts), work, *columns, dr.opaque(UInt32, grid))
    dr.eval(found)
    return Footprints(*(values.numpy()[:count] for values in found))


def _lanes(count: int) -> int:
    """Find the next number of lanes that neither 2 nor 3 divides, from 5 on.

    Dr.Jit records anew where two inputs have one size that had not before. Coordinates of meshes and their textures
    come in twos and threes; and arrays of one entry are scalars to it.
    """
    lanes = max(count, 5)
    return next(more for more in range(lanes, lanes + 4) if more % 2 and more % 3)


class _Cell(NamedTuple):
    """Centre of a cell in pixels, its width in pixels and at z = 1, its pixel, and its ray's offset in cell widths."""

    x: Array
    y: Array
    pitch: Array
    step: Array
    pixel: Array
    aside: Array
    down: Array


def _cell(world: TracedScene, column: UInts, packed: UInts, grid: UInts) -> _Cell:
    level = packed >> LEVEL_BIT
    side = grid << level
    row = packed & ((1 << LEVEL_BIT) - 1)
    pitch = dr.rcp(Float(side))
    x, y = (Float(column) + 0.5) * pitch, (Float(row) + 0.5) * pitch
    # not by integer division: lanes that pad the last packet hold anything, and a division by their 0 is fatal
    pixel_column, pixel_row = UInt32(x), UInt32(y)
    aside = ray_offset(row, level, pixel_row, grid, 1)
    down = ray_offset(column, level, pixel_column, grid, -1)
    return _Cell(x, y, pitch, pitch / world.focal_px, pixel_row * world.width + pixel_column, aside, down)


def _footprints(world: TracedScene, column: UInts, packed: UInts, grid: UInts, *, clip: bool) -> tuple:
    x, y, pitch, step, pixel, aside, down = _cell(world, column, packed, grid)
    ray, aim = camera_rays(world, x + aside * pitch, y + down * pitch)
    si, transmission, optical, distance = first_opaque(world, ray, Bool(True))
    hit = si.is_valid()
    value, to_laser, irradiance, leg = laser_leg(world, si, pixel, hit, seen_by_camera=(transmission, optical))
    normal, point = to_camera(world, si.n), to_camera(world, si.p - world.eye)
    # what the ray through the centre sees on the tangent plane, where it sees any of it near by
    local = aim - mi.Vector3f(aside, down, 0) * step
    depth = dr.dot(normal, aim) / dr.dot(normal, local)
    local, depth = dr.select((depth > 0.5) & (depth < 2), local, aim), dr.select((depth > 0.5) & (depth < 2), depth, 1)
    centre = local * (point.z * depth)
    nearer = dr.norm(centre) - dr.norm(point)
    laser = to_camera(world, world.laser - world.eye)
    from_laser = dr.norm(point - laser), dr.norm(centre - laser)
    path = optical + leg + nearer + (from_laser[1] - from_laser[0])
    distance = distance + nearer
    # paint's f cos / d^2 goes with 1 / d^3 on a plane
    radiance = dr.select(hit, value * transmission * (from_laser[0] / from_laser[1]) ** 3, 0)
    slope, path_slope, extent = _slopes(local, normal, centre - laser, distance, world.scene.laser.is_colocated)
    half_x, half_y = dr.abs(path_slope.x) * step / 2, dr.abs(path_slope.y) * step / 2
    half = dr.sqrt(dr.square(half_x) + dr.square(half_y))
    # edge on, or on a face without a normal, there is no first order: the cell is large
    half = dr.select(dr.isfinite(half), half, path)
    slope = dr.select(dr.isfinite(slope.x) & dr.isfinite(slope.y), slope, 0)
    small = (half <= 0.5 * SMALL * path) & (dr.maximum(dr.abs(slope.x), dr.abs(slope.y)) * step <= SMALL * distance)
    lit = hit
    small &= hit
    if not world.scene.laser.is_colocated:
        small &= dr.square(extent * step) <= dr.square(SMALL_FROM_LASER) * dr.squared_norm(si.p - world.laser)
        # black paint is no shadow: where nothing could come back nothing is missing
        lit = hit & ((radiance > 0) | (albedo(world, si, hit) == 0))
    flags = dr.select(hit, HIT, UInt32(0)) | dr.select(lit, LIT, UInt32(0)) | dr.select(hit & ~small, LARGE, UInt32(0))
    if clip:
        path, half, clipped = _clip_to_face(world, si, optical + leg, path, half, hit & ~small)
        flags |= dr.select(clipped, CLIPPED, UInt32(0))
    facing = dr.abs(dr.dot(si.sh_frame.n, to_laser))
    zero = Float(0)
    per_pixel = dr.rcp(world.focal_px)
    return (
        dr.select(hit, path, zero),
        dr.select(hit, half, zero),
        dr.select(small, dr.minimum(half_x, half_y), zero),
        radiance * dr.square(pitch),
        dr.select(hit, distance, zero),
        dr.select(hit, slope.x * per_pixel, zero),
        dr.select(hit, slope.y * per_pixel, zero),
        radiance,
        dr.select(hit, facing, zero),
        flags,
        *(_glint(world, si, ray, to_laser, hit, irradiance * transmission) if world.has_glints else ()),
    )


def _refracted_footprints(world: TracedScene, column: UInts, packed: UInts, grid: UInts, *, clip: bool) -> tuple:
    """Footprints whose rays solid glass bends (`render.scene.refraction`); all others as they are without."""
    straight = _footprints(world, column, packed, grid, clip=clip)
    x, y, pitch, step, pixel, aside, down = _cell(world, column, packed, grid)
    ray, aim = camera_rays(world, x + aside * pitch, y + down * pitch)
    bent = refracted_hit(world, ray, Bool(True))
    si = bent.interaction
    glass = bent.interfaces > 0
    hit = glass & si.is_valid()
    bundle = bundle_of(world, bent, x + aside * pitch, y + down * pitch, step, hit)
    lit = hit
    if world.scene.laser.mode == "flood":
        lit &= dr.atan2(dr.norm(mi.Vector2f(aim.x, aim.y)), aim.z) <= world.half_angle
    si.wi = si.to_local(-bent.direction)
    intensity = dr.gather(Float, world.intensity, pixel, lit)
    irradiance = dr.select(lit, intensity * bent.transmission * bundle.irradiance, 0)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.wi, hit)[0] * irradiance
    # radiance over the square of the index is what glass does not change
    passed = bent.transmission / dr.square(bent.medium)
    radiance = dr.select(hit & dr.isfinite(value), value * passed, 0)
    # from where the ray is to the centre of the cell
    slope = mi.Vector2f(bundle.slope_x_m, bundle.slope_y_m)
    optical = bent.optical_m - (slope.x * aside + slope.y * down) * step
    half_x, half_y = dr.abs(slope.x) * step, dr.abs(slope.y) * step
    half = dr.sqrt(dr.square(half_x) + dr.square(half_y))
    small = hit & bundle.even & (half <= SMALL * optical)
    flags = dr.select(hit, HIT | LIT, UInt32(0)) | dr.select(hit & ~small, LARGE, UInt32(0))
    per_pixel = dr.rcp(world.focal_px)
    found = (
        2 * optical,
        half,
        dr.select(small, dr.minimum(half_x, half_y), 0),
        radiance * dr.square(pitch),
        optical,
        slope.x * per_pixel,
        slope.y * per_pixel,
        radiance,
        dr.abs(dr.dot(si.sh_frame.n, bent.direction)),
    )
    glints: tuple = ()
    if world.has_glints:
        glints = _glint(world, si, mi.Ray3f(si.p, bent.direction), -bent.direction, hit, irradiance * passed)
    by_glass = (*(dr.select(hit, part, 0) for part in found), flags, *glints)
    return tuple(dr.select(glass, new, old) for new, old in zip(by_glass, straight, strict=True))


def _clip_to_face(
    world: TracedScene, si: Interactions, at_hit: Floats, path: Floats, half: Floats, active: Masks
) -> tuple[Array, Array, Array]:
    """Clip intervals of path length, path +- half, to the face that they lie on, from the path at the point that was
    hit; middle, half width and whether that changes them. An interval beside the face becomes the nearest end of it."""
    near, far = _face_span(world, si, at_hit, active)
    low, high = dr.clip(path - half, near, far), dr.clip(path + half, near, far)
    cut = active & ~((near <= path - half) & (far >= path + half))
    return dr.select(cut, 0.5 * (low + high), path), dr.select(cut, 0.5 * (high - low), half), cut


def ray_offset(number: UInts, level: UInts, pixel_number: UInts, grid: UInts, way: Floats | int) -> Array:
    """Compute how far off their cells' centres the rays of row `number` are moved along it, in cell widths; or those of
    a column along the column.

    Edges of rooms run along rows or columns: with rays in the middle all cells of a row would round to the same side.
    Multiples of the golden ratio modulo 1 cut any stretch of neighbours evenly. In pixels that are not cut they count
    from the pixel's middle, and are rounded to the nearest: then rows that face each other move in opposite ways, and
    the mean over a radiance that rises evenly stays exact. Rows and columns move in opposite `way`s there, as if the
    rays of a pixel were turned: then a radiance that is twisted, as x y, keeps its mean, too.
    """
    cut = (Float(number * UInt32(PLAIN_GOLDEN) >> 8) - 2.0**23) * 2.0**-24
    from_middle = Float(number) - dr.fma(Float(pixel_number) + 0.5, Float(grid), -0.5)
    turns = from_middle * (way * PLAIN_GOLDEN * 2.0**-32)
    uncut = dr.select(grid < FINE, turns - dr.round(turns), 0)
    return dr.select(level > 0, cut * MOVED_CUT, uncut * MOVED)


def _glint(
    world: TracedScene, si: Interactions, ray: Rays, to_laser: Vectors, hit: Masks, irradiance: Floats
) -> tuple[Array, Array, Array]:
    """Compute the tilt off the highlight's middle, and the radiance there: see `Footprints`."""
    index = shape_index(si)
    peak = dr.gather(Float, world.peak, index, hit) * irradiance
    glossy = hit & (peak > 0)
    middle = dr.normalize(to_laser - ray.d)
    normal = dr.mulsign(mi.Vector3f(si.sh_frame.n), dr.dot(si.sh_frame.n, middle))
    tilt = to_camera(world, normal - middle) / dr.gather(Float, world.roughness, index, glossy)
    return dr.select(glossy, tilt.x, 0), dr.select(glossy, tilt.y, 0), dr.select(glossy, peak, 0)


def _slopes(
    local: Vectors, normal: Vectors, from_laser: Vectors, distance: Floats, colocated: bool
) -> tuple[Array, Array, Array]:
    """Change of distance and of path length per unit of camera-frame x and y (z = 1), (2,) each, and of the point [m],
    on the tangent plane."""
    to_point = dr.normalize(local) if colocated else dr.normalize(from_laser)
    slopes, path_slopes, extent2 = [], [], Float(0)
    for slope, moved in tangent_motion(local, normal, distance):
        slopes.append(slope)
        path_slopes.append(slope + dr.dot(to_point, moved))
        extent2 += dr.squared_norm(moved)
    return mi.Vector2f(*slopes), mi.Vector2f(*path_slopes), dr.sqrt(extent2)


def _face_span(world: TracedScene, si: Interactions, path: Floats, active: Masks) -> tuple[Array, Array]:
    """Bound the path length [m] over the hit triangle.

    p(x) = |x - C| + |x - L| is convex: it is largest at a vertex, and nowhere on the face below its linearisation at
    the hit point, p + g . (x - x_0) with g the sum of the two unit vectors, whose least value is at a vertex too.
    """
    mesh = mi.MeshPtr(si.shape)
    face = mesh.face_indices(si.prim_index, active)
    gradient = dr.normalize(si.p - world.eye) + dr.normalize(si.p - world.laser)
    near, far = Float(path), Float(path)
    for corner in range(3):
        vertex = mesh.vertex_position(face[corner], active)
        near = dr.minimum(near, path + dr.dot(gradient, vertex - si.p))
        straight = dr.norm(vertex - world.eye) + dr.norm(vertex - world.laser)
        # glass on the way adds the same delay everywhere, as far as a bound needs to know
        far = dr.maximum(far, path + straight - dr.norm(si.p - world.eye) - dr.norm(si.p - world.laser))
    return near, far


def albedo(world: TracedScene, si: Interactions, hit: Masks) -> Array:
    """Return diffuse reflectance, or a conductor's at normal incidence; 0 where nothing is hit."""
    diffuse = si.bsdf().eval_diffuse_reflectance(si, hit)[0]
    specular = dr.gather(Float, world.albedo, shape_index(si), hit)
    return dr.select(hit, dr.select(specular >= 0, specular, diffuse), 0)
