"""Light that smooth surfaces send back in one exact direction: neither direct light nor path tracing can find it.

The image method gives it all. Light that reaches a point by way of plane mirrors 1 ... k (1 nearest the point) runs
along the unfolded straight line to the laser's image L' = S_1 S_2 ... S_k L, where S_i reflects in plane i.

Glints: the laser seen in mirrors, in the smooth coat of plastic and in the faces of glass.
Mirrored light: what the camera sees, directly or by way of mirrors, lit by way of mirrors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, Rays, UInts, Vectors
from render.scene.rays import camera_rays, first_opaque, in_beam, passage, shape_index, spawn, spreading, tangent_motion
from render.scene.traced_scene import OPACITY, Bool, Float, TracedScene, UInt32, dr, mi, upload
from render.settings import MAX_BOUNCES
from render.specular.mirrors import (
    COATED,
    LOBE_RAD,
    LOBE_RAYS,
    MAX_ORDER,
    Mirrors,
    check_slabs,
    find_mirrors,
    glint_sequences,
    image_of,
    image_sequences,
    lit_mirrors,
    lobe_points,
    planes_of,
    specular_points,
)
from render.transient.samples import Samples, concatenate, merge, no_samples, select

CELLS_PER_LAUNCH = 1 << 20
FINER, FINER_M = (32, 128), 2e-3  # cells a side of polished pixels, of those uneven still; merged within so much
WIDEST_SPREAD = 0.25  # of the path: a footprint that spans more describes no mesh


class SpecularLight(NamedTuple):
    """Samples of specular light, and what was left out or is inexact, one line each."""

    samples: Samples
    notes: tuple[str, ...]


def specular_light(
    world: TracedScene, grid: int = 4, tolerance_m: float = 1e-4, allowed: float = 0.0, bounces: int = MAX_BOUNCES
) -> SpecularLight:
    """Return deterministic returns by way of smooth plane surfaces, as `Samples` merged within `tolerance_m`.

    Glints: pixel-mean radiance T R_1 ... R_k I(w) F^2 / (D^2 cos^3 a), with D the unfolded one-way length laser ->
    mirrors -> camera, F the focal length in pixels, a the angle off the optical axis (a pixel's mean is that over its
    square, of which a direction sees cos^3 a / F^2 of solid angle), T the transmission of glass on the way; path length
    D plus glass delay, `bounces` = k. Mirrored light is integrated over grid x grid cells of each pixel: f cos R_1 ...
    I(w) / D^2 with D the unfolded length from the laser to the surface, times the reflectances between surface and
    camera; `bounces` counts every surface met. Light of more surfaces than the `bounces` asked for is left out. Where
    the cells of a pixel are so uneven that its mean could be off by more than `allowed` (a radiance; 0: not asked), and
    on polished surfaces, whose highlights may be smaller than a cell, there are FINER ones. Paths without a mirror on
    the laser's side are not here: direct light and path tracing find them.

    Raises InputError where a displaced laser's straight path through a glass slab is off by more than 10 mm.
    """
    notes = check_slabs(world)
    if not any(surface.material.kind in COATED for surface in world.scene.surfaces):
        return SpecularLight(no_samples(), tuple(notes))
    mirrors, more = find_mirrors(world)
    notes += more
    tables = _Tables(world, mirrors, bounces)
    parts, lit = [no_samples()], lit_mirrors(world, mirrors)
    for sequences in glint_sequences(mirrors, notes):
        if sequences.shape[1] <= bounces:
            parts.append(_glints(world, tables, mirrors, sequences[lit[sequences[:, -1]]]))
    for sequence in image_sequences(mirrors, notes):
        if lit[sequence[-1]] and len(sequence) < bounces:  # and the surface that is lit
            parts += _mirrored(world, tables, mirrors, sequence, grid, allowed)
    return SpecularLight(merge(concatenate(parts), tolerance_m), tuple(notes))


# ---- tracing ----


class _Tables:
    """Planes and, per registered shape, what decides a smooth reflectance, as Dr.Jit arrays; the most `bounces`."""

    def __init__(self, world: TracedScene, mirrors: Mirrors, bounces: int) -> None:
        self.bounces = bounces
        # one row more: an array of a single value would compile other kernels
        columns = np.vstack((np.column_stack((mirrors.normal, mirrors.offset)), np.zeros(4)))
        self.normal = mi.Vector3f(*(upload(Float, column) for column in columns[:, :3].T))
        self.offset = upload(Float, columns[:, 3] + columns[:, :3] @ world.eye_m)
        self.shape = upload(UInt32, np.append(mirrors.shape, 0))
        materials = [group[0].material for group in world.groups]
        self.scale = world.table([m.specular if m.kind in ("conductor", "plastic") else 1 for m in materials])
        self.ior = world.table([m.ior for m in materials])
        self.eta, self.k = world.table([m.eta for m in materials]), world.table([m.k for m in materials])
        self.kind = world.table([COATED.index(m.kind) if m.kind in COATED else -1 for m in materials])
        # a metal mesh with a curved surface shows no flat image: what is seen in it is left out
        metal = [
            m.kind == "conductor" and all(s.normals is None or planes_of(s, s.vertices[0]) is not None for s in group)
            for m, group in zip(materials, world.groups, strict=True)
        ]
        self.mirrors = world.table([float(flag) for flag in metal])


def _reflectance(tables: _Tables, shape: Array, cosine: Floats, active: Masks) -> Array:
    """Compute the unpolarised Fresnel reflectance: a metal's, one interface's, or 2F / (1 + F) of a thin pane."""
    kind = dr.gather(Float, tables.kind, shape, active)
    cosine = dr.minimum(dr.abs(cosine), 1)
    index = mi.Complex2f(dr.gather(Float, tables.eta, shape, active), dr.gather(Float, tables.k, shape, active))
    metal = mi.fresnel_conductor(cosine, index)
    glass = mi.fresnel(cosine, dr.maximum(dr.gather(Float, tables.ior, shape, active), 1.0001))[0]
    glass = dr.select(kind == COATED.index("thindielectric"), 2 * glass / (1 + glass), glass)
    scale = dr.gather(Float, tables.scale, shape, active)
    return scale * dr.select(kind == COATED.index("conductor"), metal, glass)


def _connect(
    world: TracedScene,
    tables: _Tables,
    ends: tuple[Array, Array, Array],
    sequence: list[Array],
    active: Masks,
    in_air: bool,
) -> tuple[Array, Array, Array, Array]:
    """Follow the way from a start toward the laser's image, folded by the planes of `sequence`.

    Returns the product of reflectances and transmissions (0: the way does not exist or is blocked), the delay and the
    shortening of the spreading by glass [m], and the last mirror point, which the laser shines on. `ends` are
    the start, how far off its surface rays start, and the image.
    """
    start, lift, target = ends
    along = target - start
    left = dr.norm(along)
    direction = along / left
    scale = left + dr.norm(start - world.eye)
    position, lit = mi.Point3f(start), Bool(active)
    weight, delay, shortening = Float(1), Float(0), Float(0)
    for number, plane in enumerate((*sequence, None)):
        step = left
        if plane is not None:
            normal = dr.gather(mi.Vector3f, tables.normal, plane, lit)
            cosine = dr.dot(normal, direction)
            step = (dr.gather(Float, tables.offset, plane, lit) - dr.dot(normal, mi.Vector3f(position))) / cosine
            lit &= (step > 0) & (step < left)
        gap = dr.minimum(1e-5 * scale, 0.1 * step)
        # from a little off this surface to a little before the next one
        begin = position + lift + gap * direction
        way = position + (step - gap) * direction - begin
        limit = dr.norm(way)
        ray = mi.Ray3f(begin, way / limit)
        passed, optical, short = passage(world, ray, begin, limit, lit, in_air=in_air and number == 0)
        weight *= passed
        delay += optical - limit
        shortening += short
        if plane is None:
            break
        position = position + step * direction
        # is there a face at that point of its plane?
        probe = dr.minimum(1e-4 * scale, 0.3 * step)
        ray = mi.Ray3f(position - probe * direction, direction)
        ray.maxt = 2 * probe
        si = world.mi_scene.ray_intersect(ray, lit)
        shape = dr.gather(UInt32, tables.shape, plane, lit)
        lit &= si.is_valid() & (shape_index(si) == shape)
        if world.has_cutouts:
            lit &= si.shape.eval_attribute_1(OPACITY, si, lit) >= 0.5
        weight *= _reflectance(tables, shape, cosine, lit)
        lift = normal * dr.select(cosine > 0, -4e-6, 4e-6) * scale
        direction = direction - 2 * cosine * normal
        left -= step
    lit &= weight > 0
    return dr.select(lit, weight, 0), dr.select(lit, delay, 0), dr.select(lit, shortening, 0), position


# ---- glints ----


def _glints(world: TracedScene, tables: _Tables, mirrors: Mirrors, sequence: np.ndarray) -> Samples:
    """Find the glints of the laser itself in rows of (m, k) planes, from the camera on."""
    camera, laser = world.scene.camera, world.scene.laser
    laser_point = laser.position(camera) - camera.origin
    image = image_of(mirrors, sequence, laser_point)
    last, possible = specular_points(mirrors, sequence, image, 5 * LOBE_RAD)
    column, row = _raster(world, image)
    possible &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    possible &= _shines_on(world, last, laser_point, column, row)
    kept = np.flatnonzero(possible)
    if len(kept) == 0:
        return no_samples()
    sequence, image = sequence[kept], image[kept]
    row, column = row[kept].astype(np.int64), column[kept].astype(np.int64)
    distance = np.linalg.norm(image, axis=1)
    lanes = lobe_points(image).reshape(-1, 3)
    planes = [upload(UInt32, np.repeat(plane, LOBE_RAYS)) for plane in sequence.T]
    target = mi.Point3f(*(upload(Float, axis) for axis in (lanes + world.eye_m).T))
    start = mi.Point3f(world.eye) + dr.zeros(mi.Vector3f, len(lanes))
    active = dr.full(Bool, True, len(lanes))
    weight, delay, shortening, _ = _connect(world, tables, (start, mi.Vector3f(0), target), planes, active, True)
    dr.eval(weight, delay, shortening)
    weight, delay, shortening = (
        np.array(value, dtype=np.float64).reshape(-1, LOBE_RAYS) for value in (weight, delay, shortening)
    )
    spread = (distance[:, None] / np.maximum(distance[:, None] - shortening, 1e-3 * distance[:, None])) ** 2
    energy = (weight * spread).mean(axis=1) * _made_up(image, weight > 0)
    lit = energy > 0
    late = (weight * delay).sum(axis=1)[lit] / weight.sum(axis=1)[lit]
    row, column, distance, energy = row[lit], column[lit], distance[lit], energy[lit]
    axial = image[lit] @ camera.rotation[:, 2] / distance
    per_pixel = laser.intensity(camera)[row, column] * camera.focal_px**2 / axial**3
    return Samples(
        row * camera.width + column,
        np.round(distance + late, 9),  # the ways through a corner cube have one length, whatever rounding says
        np.zeros(len(row)),
        energy * per_pixel / distance**2,
        np.full(len(row), sequence.shape[1], np.uint8),
    )


def _made_up(image: np.ndarray, came_back: np.ndarray) -> np.ndarray:
    """Compute the factor (m,) that makes up for the one or two rays of a lobe (m, LOBE_RAYS) lost to rounding on a
    border of faces.

    In a corner cube the ways in different order share one image and divide its lobe among them.
    """
    _, group = np.unique(np.round(image, 6), axis=0, return_inverse=True)
    group = group.reshape(-1)
    covered = np.zeros((group.max() + 1, LOBE_RAYS))
    np.add.at(covered, group, came_back)
    count = (covered > 0).sum(axis=1)[group]
    return np.where(count >= LOBE_RAYS - 2, LOBE_RAYS / np.maximum(count, 1), 1.0)


def _raster(world: TracedScene, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute column and row (floored, -1: behind the camera) of the pixels that look in the given directions (m,
    3)."""
    camera = world.scene.camera
    x, y, z = (direction @ camera.rotation).T
    ahead = z > 0
    z = np.where(ahead, z, 1)
    column, row = camera.focal_px * x / z + camera.width / 2, camera.focal_px * y / z + camera.height / 2
    # a direction along the border of two pixels belongs to the later one, whatever rounding says
    return np.where(ahead, np.floor(column + 1e-9), -1), np.where(ahead, np.floor(row + 1e-9), -1)


def _shines_on(
    world: TracedScene, point: np.ndarray, laser_point: np.ndarray, column: np.ndarray, row: np.ndarray
) -> np.ndarray:
    """Return whether the laser shines on points (m, 3) while the pixel (column, row) is measured: `in_beam` in
    float64."""
    camera, laser = world.scene.camera, world.scene.laser
    if laser.mode == "flood":
        x, y, z = ((point - laser_point) @ camera.rotation).T
        return np.arctan2(np.hypot(x, y), z) <= laser.half_angle(camera) * (1 + 1e-5)
    lit_column, lit_row = _raster(world, point)
    in_image = (lit_column >= 0) & (lit_column < camera.width)
    return (lit_row == row) & (in_image if laser.mode == "line" else lit_column == column)


# ---- mirrored light ----


def _mirrored(
    world: TracedScene, tables: _Tables, mirrors: Mirrors, sequence: np.ndarray, grid: int, allowed: float
) -> list[Samples]:
    """Trace what the camera sees, directly or by way of up to MAX_ORDER mirrors, lit by way of the mirror planes
    `sequence` (k,)."""
    camera, laser = world.scene.camera, world.scene.laser
    image = image_of(mirrors, sequence[None], laser.position(camera) - camera.origin)[0]
    target = mi.Point3f(*(dr.opaque(Float, float(v)) for v in image + world.eye_m))
    planes = [dr.opaque(UInt32, int(plane)) for plane in sequence]
    uneven, parts = np.full(camera.height * camera.width, True), list[Samples]()
    sides = (grid, *(side for side in FINER if side > grid and allowed > 0))
    for side in sides:
        found, polished = _of_pixels(world, tables, np.flatnonzero(uneven), side, target, planes)
        uneven = _unevenness(found, uneven.size, side) > allowed
        uneven[polished] |= side == grid  # what is polished may have a highlight between its cells
        uneven &= side < sides[-1]
        parts += (merge(select(part, ~uneven[part.pixel]), 0 if side == grid else FINER_M) for part in found)
        if not uneven.any():
            break
    return parts


def _of_pixels(
    world: TracedScene, tables: _Tables, pixels: np.ndarray, grid: int, target: UInts, planes: list[Array]
) -> tuple[list[Samples], np.ndarray]:
    """Return mirrored light of some pixels, a sample a lit cell, launch by launch; and which show polished surfaces."""
    cells, parts, shown = grid * grid, [], []
    per_chunk = max(1, CELLS_PER_LAUNCH // cells)
    for first in range(0, len(pixels), per_chunk):
        chunk = pixels[first : first + per_chunk]
        path, half_width, radiance, met, polished = _cells(world, tables, chunk, grid, target, planes)
        dr.eval(path, half_width, radiance, met, polished)
        shown.append(chunk[np.array(polished).reshape(-1, cells).any(axis=1)])
        radiance, bounces = np.array(radiance, dtype=np.float64), np.array(met) + 1 + len(planes)
        lit = (radiance > 0) & (bounces <= tables.bounces)
        path, half_width = (np.array(value, dtype=np.float64)[lit] for value in (path, half_width))
        met_in_all = bounces[lit].astype(np.uint8)
        parts.append(Samples(np.repeat(chunk, cells)[lit], path, half_width, radiance[lit], met_in_all))
    return parts, np.concatenate(shown)


def _unevenness(parts: list[Samples], pixels: int, grid: int) -> np.ndarray:
    """Compute the standard error of each pixel's mean, as if its cells lay there by chance."""
    pixel, radiance = (np.concatenate([part[index] for part in parts]) for index in (0, 3))
    mean = np.bincount(pixel, weights=radiance, minlength=pixels)
    return np.sqrt(np.maximum(np.bincount(pixel, weights=radiance**2, minlength=pixels) - mean**2 / grid**2, 0))


def _cells(
    world: TracedScene, tables: _Tables, pixels: np.ndarray, grid: int, target: UInts, planes: list[Array]
) -> tuple[Array, Array, Array, Array, Array]:
    """Trace cells of pixels; return path, half width [m], radiance / cells, mirrors met, and if polished and lit."""
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
    active &= dr.gather(Float, tables.mirrors, shape_index(si), active) == 0

    along = target - si.p
    length = dr.norm(along)
    direction = along / length
    lift = si.n * dr.select(dr.dot(si.n, direction) > 0, 1e-5, -1e-5) * (length + dr.norm(si.p - world.eye))
    passed, delay, shortening, last = _connect(world, tables, (si.p, lift, target), planes, active, False)
    active &= in_beam(world, last, pixel)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(direction), active)[0]
    intensity = dr.gather(Float, world.intensity, pixel, active)
    radiance = weight * value * passed * intensity * spreading(length, shortening) / dr.square(length) / Float(cells)
    path = optical + length + delay
    half_width = _half_width(local, axes, si.n, -direction, distance, pitch / world.focal_px)
    half_width = dr.minimum(half_width, WIDEST_SPREAD * path)
    polished = active & (passed > 0) & (dr.gather(Float, world.glossy_materials, shape_index(si), active) > 0)
    return path, half_width, dr.select(active & dr.isfinite(radiance), radiance, 0), met, polished


@dr.syntax
def _seen(world: TracedScene, tables: _Tables, ray: Rays, lanes: int) -> tuple[Array, ...]:
    """Find the first surface that is no plane mirror: interaction, weight of the way, optical and geometric length [m].

    Also the camera's axes as the mirrors show them (the unfolded camera's frame) and the number of mirrors met.
    """
    si, weight, optical, distance = first_opaque(world, ray, Bool(True))
    weight = weight + dr.zeros(Float, lanes)
    right, down, forward = (axis + dr.zeros(mi.Vector3f, lanes) for axis in world.axes)
    direction = mi.Vector3f(ray.d)
    met = dr.zeros(UInt32, lanes)
    mirror = si.is_valid()
    mirror &= dr.gather(Float, tables.mirrors, shape_index(si), mirror) > 0
    while mirror & (met < MAX_ORDER):
        normal = mi.Vector3f(si.n)
        weight *= _reflectance(tables, shape_index(si), dr.dot(normal, direction), mirror)
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
        mirror &= dr.gather(Float, tables.mirrors, shape_index(si), mirror) > 0
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
