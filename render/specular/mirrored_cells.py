"""Cells of pixels, traced: the surface that each shows by way of mirrors, and what lights it by way of others."""

from __future__ import annotations

import numpy as np

from render.backend.drjit_types import Array, Floats, Rays, UInts, Vectors
from render.scene.rays import (
    camera_rays,
    first_opaque,
    glass_ahead,
    glass_faces,
    in_beam,
    interaction_from_parts,
    parts_of,
    shape_index,
    spawn,
    spreading,
    tangent_motion,
)
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload
from render.specular.mirrors import MAX_ORDER
from render.specular.unfolded_ways import MirrorTables, connect_to_image, reflectance

CELLS_PER_LAUNCH = 1 << 18
WIDEST_SPREAD = 0.25  # of the path: a footprint that spans more describes no mesh


def seen_cells(
    world: TracedScene, tables: MirrorTables, pixels: np.ndarray, grid: int, face: int | None
) -> tuple[Array, ...]:
    """Trace grid x grid cells of each of the pixels to the first surface that is no mirror, once for all that lights
    it; `lit_cells` takes what this returns. With a `face` the face of glass of this number is the first mirror."""
    number = () if face is None else (dr.opaque(UInt32, face),)
    key = "seen in mirrors", face is None
    found = world.recordings.call(world, key, _seen_cells, _launch(pixels, grid), tuple(tables), number)
    dr.eval(found)
    return found


def lit_cells(
    world: TracedScene, tables: MirrorTables, seen: tuple[Array, ...], grid: int, image: np.ndarray, planes: np.ndarray
) -> tuple[Array, ...]:
    """Light cells from an `image` of the laser, at (3,) in the world, by way of the `planes` that make it (k,).

    Returns path, half width [m], radiance / cells, mirrors met by the camera, and if polished (and lit by a flood); and
    how far each is from the middle of a highlight: the half vector beside the normal, in units of the roughness.
    """
    target = mi.Point3f(*(dr.opaque(Float, float(v)) for v in image))
    numbers = tuple(dr.opaque(UInt32, int(plane)) for plane in planes)
    key, side = ("lit by mirrors", len(planes)), dr.opaque(UInt32, grid)
    found = world.recordings.call(world, key, _lit_cells, seen, tuple(tables), target, numbers, side)
    dr.eval(found)
    return found


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


def _seen_cells(
    world: TracedScene, launch: tuple[Array, Array, Array], columns: tuple[Array, ...], face: tuple[UInts, ...]
) -> tuple[Array, ...]:
    """Return parts of the interaction; weight of the way, its optical and geometric length; the camera's axes, the ray
    in its frame, mirrors met, and the pixel."""
    pixel, x, y, _ = _places(world, *launch)
    ray, local = camera_rays(world, x, y)
    si, weight, optical, distance, axes, met = _seen(world, MirrorTables(*columns), ray, face)
    active = si.is_valid() & (weight > 0)
    active &= dr.gather(Float, world.mirrors, shape_index(si), active) == 0
    return parts_of(si), dr.select(active, weight, 0), (optical, distance), axes, local, met, pixel


def _lit_cells(
    world: TracedScene,
    seen: tuple[Array, ...],
    columns: tuple[Array, ...],
    target: Vectors,
    planes: tuple[UInts, ...],
    side: UInts,
) -> tuple[Array, ...]:
    parts, weight, (optical, distance), axes, local, met, pixel = seen
    tables, si, active, pitch = MirrorTables(*columns), interaction_from_parts(parts), weight > 0, 1 / Float(side)
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
