"""Mirrored light: what the camera sees by way of mirrors, and what it sees lit by way of mirrors."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import binary_dilation

from render.backend.drjit_types import Array, Floats, Rays, UInts, Vectors
from render.scene.rays import (
    camera_rays,
    first_opaque,
    in_beam,
    shape_index,
    spawn,
    spreading,
    tangent_motion,
)
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload
from render.specular.mirrors import MAX_ORDER, Mirrors, image_of
from render.specular.unfolded_ways import MirrorTables, connect_to_image, reflectance
from render.transient.samples import Samples, merge, select

CELLS_PER_LAUNCH = 1 << 20
FINER, FINER_M = (32, 128), 2e-3  # cells a side of pixels with narrow highlights, of those uneven still; merged within
RESOLVED = 0.5  # of a lobe's width between neighbouring cells: those that are no farther apart miss no highlight
WIDEST_SPREAD = 0.25  # of the path: a footprint that spans more describes no mesh


def mirrored_light(
    world: TracedScene,
    tables: MirrorTables,
    mirrors: Mirrors,
    sequence: np.ndarray,
    grid: int,
    allowed: tuple[float, float],
) -> list[Samples]:
    """Trace what the camera sees, directly or by way of up to MAX_ORDER mirrors, lit by way of the mirror planes
    `sequence` (k,); of k = 0 what it sees by way of mirrors, which the laser lights directly.

    Pixels whose cells are uneven get FINER ones, until the root sum square of what the others' means may be off by is
    within `allowed`: such a fraction (0: not asked) of that of this light and of other light together.
    """
    fraction, other = allowed
    camera, laser = world.scene.camera, world.scene.laser
    image = image_of(mirrors, sequence[None], laser.position(camera) - camera.origin)[0]
    target = mi.Point3f(*(dr.opaque(Float, float(v)) for v in image + world.eye_m))
    planes = [dr.opaque(UInt32, int(plane)) for plane in sequence]
    uneven, parts = np.full(camera.height * camera.width, True), list[Samples]()
    sides = (grid, *(side for side in FINER if side > grid and fraction > 0))
    for side in sides:
        found, narrow = _of_pixels(world, tables, np.flatnonzero(uneven), side, target, planes)
        if side == grid:
            pixel, radiance = (np.concatenate([part[k] for part in found]) for k in (0, 3))
            own = np.bincount(pixel, radiance, uneven.size)
            most = fraction * math.hypot(other, float(np.linalg.norm(own)))
            # what a pixel shows may reach into its neighbours, between their cells
            beside = np.zeros((camera.height, camera.width), bool)
            beside.flat[narrow] = True
            beside = binary_dilation(beside, np.ones((3, 3))).ravel()
        uneven = _too_uneven(_unevenness(found, uneven.size, side), most) | (beside & (side == grid))
        uneven &= side < sides[-1]
        parts += (merge(select(part, ~uneven[part.pixel]), 0 if side == grid else FINER_M) for part in found)
        if not uneven.any():
            break
    return parts


def _of_pixels(
    world: TracedScene, tables: MirrorTables, pixels: np.ndarray, grid: int, target: UInts, planes: list[Array]
) -> tuple[list[Samples], np.ndarray]:
    """Return mirrored light of some pixels, a sample a lit cell, launch by launch; and which pixels may have a
    highlight between their cells."""
    cells, parts, narrow = grid * grid, [], []
    per_chunk = max(1, CELLS_PER_LAUNCH // cells)
    for first in range(0, len(pixels), per_chunk):
        chunk = pixels[first : first + per_chunk]
        path, half_width, radiance, met, polished, off_peak = _cells(world, tables, chunk, grid, target, planes)
        dr.eval(path, half_width, radiance, met, polished, off_peak)
        narrow.append(chunk[_may_miss_highlights(np.array(polished), np.array(off_peak), grid)])
        radiance, bounces = np.array(radiance, dtype=np.float64), np.array(met) + 1 + len(planes)
        lit = (radiance > 0) & (bounces <= tables.bounces)
        path, half_width = (np.array(value, dtype=np.float64)[lit] for value in (path, half_width))
        met_in_all = bounces[lit].astype(np.uint8)
        parts.append(Samples(np.repeat(chunk, cells)[lit], path, half_width, radiance[lit], met_in_all))
    return parts, np.concatenate(narrow)


def _may_miss_highlights(polished: np.ndarray, off_peak: np.ndarray, grid: int) -> np.ndarray:
    """Return which pixels have polished cells, and cells beside these that are not or lie farther from them than
    RESOLVED, (pixels,): a highlight may then fall between."""
    polished = polished.reshape(-1, grid * grid)
    wide = np.zeros(len(polished), bool)
    if grid > 1:
        places = off_peak.T.reshape(-1, grid, grid, 3)
        steps = (np.square(np.diff(places, axis=axis)).sum(axis=-1).max(axis=(1, 2)) for axis in (1, 2))
        wide = polished.all(axis=1) & (np.maximum(*steps) <= RESOLVED**2)
    return polished.any(axis=1) & ~wide


def _unevenness(parts: list[Samples], pixels: int, grid: int) -> np.ndarray:
    """Compute the standard error of each pixel's mean, as if its cells lay there by chance."""
    pixel, radiance = (np.concatenate([part[index] for part in parts]) for index in (0, 3))
    mean = np.bincount(pixel, weights=radiance, minlength=pixels)
    return np.sqrt(np.maximum(np.bincount(pixel, weights=radiance**2, minlength=pixels) - mean**2 / grid**2, 0))


def _too_uneven(unevenness: np.ndarray, allowed: float) -> np.ndarray:
    """Return the fewest pixels without which the root sum square of the others' unevenness is within `allowed`."""
    order = np.argsort(unevenness, kind="stable")
    over = np.zeros(len(order), bool)
    over[order] = np.cumsum(np.square(unevenness[order])) > allowed**2
    return over


def _cells(
    world: TracedScene, tables: MirrorTables, pixels: np.ndarray, grid: int, target: UInts, planes: list[Array]
) -> tuple[Array, ...]:
    """Trace cells of pixels; return path, half width [m], radiance / cells, mirrors met, and if polished (and
    lit by a flood).

    And how far each is from the middle of a highlight: the half vector beside the normal, in units of the roughness.
    """
    side, lanes = dr.opaque(UInt32, grid), len(pixels) * grid * grid
    lane = dr.arange(UInt32, lanes)
    cells = side * side
    # one more: an array of a single value would compile other kernels
    pixel, cell = dr.gather(UInt32, upload(UInt32, np.append(pixels, 0)), lane // cells), lane % cells
    pitch = 1 / Float(side)
    x = Float(pixel % world.width) + (Float(cell % side) + 0.5) * pitch
    y = Float(pixel // world.width) + (Float(cell // side) + 0.5) * pitch
    ray, local = camera_rays(world, x, y)
    si, weight, optical, distance, axes, met = _seen(world, tables, ray, lanes)
    active = si.is_valid() & (weight > 0)
    active &= dr.gather(Float, world.mirrors, shape_index(si), active) == 0
    if not planes:
        active &= met > 0  # else it is direct light

    along = target - si.p
    length = dr.norm(along)
    direction = along / length
    lift = si.n * dr.select(dr.dot(si.n, direction) > 0, 1e-5, -1e-5) * (length + dr.norm(si.p - world.eye))
    passed, delay, shortening, last = connect_to_image(world, tables, (si.p, lift, target), planes, active, False)
    lit = active & in_beam(world, last, pixel)
    # between cells a narrow beam may meet what they show beside it
    polished = (lit if world.scene.laser.mode == "flood" else active) & (passed > 0)
    polished &= dr.gather(Float, world.glossy_materials, shape_index(si), polished) > 0
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(direction), lit)[0]
    intensity = dr.gather(Float, world.intensity, pixel, lit)
    radiance = weight * value * passed * intensity * spreading(length, shortening) / dr.square(length) / Float(cells)
    path = optical + length + delay
    half_width = _half_width(local, axes, si.n, -direction, distance, pitch / world.focal_px)
    half_width = dr.minimum(half_width, WIDEST_SPREAD * path)
    half = dr.normalize(si.to_local(direction) + si.wi)
    off_peak = si.to_world(half * dr.sign(half.z)) - si.sh_frame.n
    off_peak /= dr.maximum(dr.gather(Float, world.roughness, shape_index(si), polished), 1e-6)
    return path, half_width, dr.select(lit & dr.isfinite(radiance), radiance, 0), met, polished, off_peak


@dr.syntax
def _seen(world: TracedScene, tables: MirrorTables, ray: Rays, lanes: int) -> tuple[Array, ...]:
    """Find the first surface that is no mirror: interaction, weight of the way, optical and geometric length [m].

    Also the camera's axes as the mirrors show them (the unfolded camera's frame; curved mirrors as their tangent
    planes) and the number of mirrors met.
    """
    si, weight, optical, distance = first_opaque(world, ray, Bool(True))
    weight = weight + dr.zeros(Float, lanes)
    right, down, forward = (axis + dr.zeros(mi.Vector3f, lanes) for axis in world.axes)
    direction = mi.Vector3f(ray.d)
    met = dr.zeros(UInt32, lanes)
    mirror = si.is_valid()
    mirror &= dr.gather(Float, world.mirrors, shape_index(si), mirror) > 0
    while mirror & (met < MAX_ORDER):
        normal = mi.Vector3f(si.sh_frame.n)
        weight *= reflectance(tables, shape_index(si), dr.dot(normal, direction), mirror)
        direction = direction - 2 * dr.dot(normal, direction) * normal
        right = right - 2 * dr.dot(normal, right) * normal
        down = down - 2 * dr.dot(normal, down) * normal
        forward = forward - 2 * dr.dot(normal, forward) * normal
        onward, origin = spawn(si, direction), mi.Point3f(si.p)
        si, transmission, more, step = first_opaque(world, onward, mirror, origin)
        weight *= transmission
        optical += more
        distance += step
        met += 1
        mirror = mirror & si.is_valid()
        mirror &= dr.gather(Float, world.mirrors, shape_index(si), mirror) > 0
    return si, weight, optical, distance, (right, down, forward), met


def _half_width(
    local: Vectors, axes: tuple, normal: Vectors, from_laser: Vectors, distance: Floats, pitch: Floats
) -> Array:
    """Compute the half width [m] of the path lengths over a cell of angular size `pitch`, sqrt(a^2 + b^2), by the
    tangent plane.

    In the unfolded camera's frame the path's half span is a = |drho/dx + dp/dx . w| dx/2 (`tangent_motion`), with w the
    unit vector from the laser's image.
    """
    normal, from_laser = (mi.Vector3f(*(dr.dot(axis, v) for axis in axes)) for v in (normal, from_laser))
    total = Float(0)
    for slope, moved in tangent_motion(local, normal, distance):
        total += dr.square((slope + dr.dot(from_laser, moved)) * pitch / 2)
    return dr.sqrt(total)
