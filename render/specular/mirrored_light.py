"""Mirrored light: what the camera sees by way of mirrors, and what it sees lit by way of mirrors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from render.backend.drjit_types import Array, Floats, Rays, UInts, Vectors
from render.scene.rays import (
    camera_rays,
    first_opaque,
    glass_ahead,
    glass_faces,
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


class Ways(NamedTuple):
    """Ways of light: the planes (k,) by which the laser's light comes, from what they light to the laser; the flat
    pixels looked at, sorted; the most surfaces met; and the number of the face of glass, from 0 on, that the camera
    looks by (None: it looks straight, or by mirrors)."""

    planes: np.ndarray
    pixels: np.ndarray
    bounces: int
    face: int | None = None


def faces_of_glass(world: TracedScene, grid: int) -> np.ndarray:
    """Count the faces of glass before what each pixel shows, the most over its cells, (pixels,)."""
    camera = world.scene.camera
    pixels = camera.height * camera.width
    if not world.has_glass:
        return np.zeros(pixels, np.uint32)
    found, per_chunk = [], max(1, CELLS_PER_LAUNCH // grid**2)
    for first in range(0, pixels, per_chunk):
        chunk = np.arange(first, min(first + per_chunk, pixels))
        faces = world.recordings.call(world, "faces of glass", _faces, *_launch(chunk, grid))
        dr.eval(faces)
        found.append(faces.numpy().reshape(-1, grid * grid).max(axis=1))
    return np.concatenate(found)


def _faces(world: TracedScene, lane: UInts, pixels: UInts, side: UInts) -> Array:
    _, x, y, _ = _places(world, lane, pixels, side)
    return glass_faces(world, camera_rays(world, x, y)[0])


def _places(world: TracedScene, lane: UInts, pixels: UInts, side: UInts) -> tuple[Array, ...]:
    """Return pixel, position and pitch of side x side cells of each of the pixels, a lane a cell."""
    cells = side * side
    pixel, cell = dr.gather(UInt32, pixels, lane // cells), lane % cells
    pitch = 1 / Float(side)
    x = Float(pixel % world.width) + (Float(cell % side) + 0.5) * pitch
    y = Float(pixel // world.width) + (Float(cell // side) + 0.5) * pitch
    return pixel, x, y, pitch


def _launch(pixels: np.ndarray, grid: int) -> tuple[Array, Array, Array]:
    """Return lanes of grid x grid cells of pixels, the pixels, and the grid, as Dr.Jit arrays."""
    lane = dr.arange(UInt32, len(pixels) * grid * grid)
    dr.eval(lane)
    # one more: an array of a single value would compile other kernels
    return lane, upload(UInt32, np.append(pixels, 0)), dr.opaque(UInt32, grid)


def mirrored_light(
    world: TracedScene,
    tables: MirrorTables,
    mirrors: Mirrors,
    ways: Ways,
    grid: int,
    allowed: tuple[float, float],
) -> list[Samples]:
    """Trace what the camera sees by these ways: directly or by way of up to MAX_ORDER mirrors, of which a face of glass
    may be the first; without planes only by way of mirrors or such a face.

    Pixels whose cells are uneven get FINER ones, until the root sum square of what the others' means may be off by is
    within `allowed`: such a fraction (0: not asked) of that of this light and of other light together.
    """
    fraction, other = allowed
    camera, laser = world.scene.camera, world.scene.laser
    image = image_of(mirrors, ways.planes[None], laser.position(camera) - camera.origin)[0]
    target = mi.Point3f(*(dr.opaque(Float, float(v)) for v in image + world.eye_m))
    numbers = ways.planes, [] if ways.face is None else [ways.face]
    looked_up = tuple(tables), target, *(tuple(dr.opaque(UInt32, int(one)) for one in part) for part in numbers)
    uneven, parts = np.zeros(camera.height * camera.width, bool), list[Samples]()
    uneven[ways.pixels] = True
    sides = (grid, *(side for side in FINER if side > grid and fraction > 0))
    for side in sides:
        found, narrow = _of_pixels(world, looked_up, np.flatnonzero(uneven), side, ways)
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
    world: TracedScene, looked_up: tuple[Array, ...], pixels: np.ndarray, grid: int, ways: Ways
) -> tuple[list[Samples], np.ndarray]:
    """Return mirrored light of some pixels, a sample a lit cell, launch by launch; and which pixels may have a
    highlight between their cells. `looked_up` is what `_cells` looks up.
    """
    cells, parts, narrow = grid * grid, [], []
    per_chunk = max(1, CELLS_PER_LAUNCH // cells)
    for first in range(0, len(pixels), per_chunk):
        chunk = pixels[first : first + per_chunk]
        key = "mirrored light", len(ways.planes), ways.face is None
        found = world.recordings.call(world, key, _cells, _launch(chunk, grid), *looked_up)
        path, half_width, radiance, met, polished, off_peak = found
        dr.eval(path, half_width, radiance, met, polished, off_peak)
        narrow.append(chunk[_may_miss_highlights(np.array(polished), np.array(off_peak), grid)])
        radiance, bounces = np.array(radiance, dtype=np.float64), np.array(met) + 1 + len(ways.planes)
        lit = (radiance > 0) & (bounces <= ways.bounces)
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
    world: TracedScene,
    launch: tuple[Array, Array, Array],
    columns: tuple[Array, ...],
    target: Vectors,
    planes: tuple[UInts, ...],
    face: tuple[UInts, ...],
) -> tuple[Array, ...]:
    """Trace cells of pixels; return path, half width [m], radiance / cells, mirrors met, and if polished (and
    lit by a flood).

    And how far each is from the middle of a highlight: the half vector beside the normal, in units of the roughness.
    """
    tables, (pixel, x, y, pitch) = MirrorTables(*columns), _places(world, *launch)
    ray, local = camera_rays(world, x, y)
    si, weight, optical, distance, axes, met = _seen(world, tables, ray, face)
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
    radiance = weight * value * passed * intensity * spreading(length, shortening) / dr.square(length)
    radiance *= dr.square(pitch)
    path = optical + length + delay
    half_width = _half_width(local, axes, si.n, -direction, distance, pitch / world.focal_px)
    half_width = dr.minimum(half_width, WIDEST_SPREAD * path)
    half = dr.normalize(si.to_local(direction) + si.wi)
    off_peak = si.to_world(half * dr.sign(half.z)) - si.sh_frame.n
    off_peak /= dr.maximum(dr.gather(Float, world.roughness, shape_index(si), polished), 1e-6)
    return path, half_width, dr.select(lit & dr.isfinite(radiance), radiance, 0), met, polished, off_peak


@dr.syntax
def _seen(world: TracedScene, tables: MirrorTables, ray: Rays, face: tuple[UInts, ...]) -> tuple[Array, ...]:
    """Find the first surface that is no mirror: interaction, weight of the way, optical and geometric length [m].

    With a `face` the ray is mirrored by the face of glass of this number; where there is none its weight is 0.

    Also the camera's axes as the mirrors show them (the unfolded camera's frame; curved mirrors as their tangent
    planes) and the number of mirrors met.
    """
    lanes = dr.width(ray.d)
    si, weight, optical, distance, mirror = _first_met(world, ray, face)
    weight, mirror = weight + dr.zeros(Float, lanes), mirror | dr.full(Bool, False, lanes)
    right, down, forward = (axis + dr.zeros(mi.Vector3f, lanes) for axis in world.axes)
    direction = mi.Vector3f(ray.d)
    met = dr.zeros(UInt32, lanes)
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


def _first_met(world: TracedScene, ray: Rays, face: tuple[UInts, ...]) -> tuple[Array, ...]:
    """Return what `first_opaque` does, and whether that is a mirror; with a `face` the same of that face of glass."""
    if face:
        si, weight, optical, distance, mirror = glass_ahead(world, ray, *face)
        return si, dr.select(mirror, weight, 0), optical, distance, mirror
    si, weight, optical, distance = first_opaque(world, ray, Bool(True))
    mirror = si.is_valid()
    return si, weight, optical, distance, mirror & (dr.gather(Float, world.mirrors, shape_index(si), mirror) > 0)


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
