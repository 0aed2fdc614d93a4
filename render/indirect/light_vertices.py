"""Points that the laser lights, to which paths of indirect light are joined.

A path that goes on by chance seldom meets what the laser lights most: what is near it, or the few places in its cone.
So every vertex is also joined to a point that was found from the laser's side (bidirectional path tracing with one
vertex of the laser's: Lafortune, Willems 1993; Veach 1997, chapter 10). Both ways sample the same light. Going on by
chance keeps the share

    w = B q / (B q + p d^2 / cos),

where q is the density per solid angle of what sends the path there, B the number of pixels that use it, p the density
of lit points per area, d the distance and cos the cosine at the far end: the balance heuristic (Veach, eq. 9.8).

After x1 q is the density of all lobes of the vertex, and joining has the rest of all that they reflect but mirror-like
lobes. What a filter reads from its regions is diffuse at x1, so there q is that of a diffuse lobe, cos / pi, for every
diffuse reflectance, coated or not; joining has the rest of diffuse light alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Interactions, LobeSamples, Masks, UInts, Vectors
from render.indirect.glossy import finite_ratio, has_light_paths, ratio_at_laser, reversal
from render.scene.rays import (
    TOUCHING,
    first_opaque,
    interaction_from_parts,
    laser_light,
    parts_of,
    segment,
    shape_index,
    spawn,
    to_world,
)
from render.scene.rows import PLACE_ON_SURFACE, WIDTH, gather_rows, packed
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi
from scenes.model import Laser

MAX_POINTS, POINTS_PER_PATH = 1 << 15, 1 / 8
MIN_FAR_COSINE = 1e-9
# Light vertices that x1 is connected to, of a path alone and of one that is reused: as many as lowered the noise of a
# second most. Under a lamp, whose paths seldom meet what is close to it, later vertices are joined to one, too. A flash
# lights what its pixels see, which paths meet often: there joining hardly pays.
WIDE_CONNECTIONS, NARROW_CONNECTIONS = (4, 8), (1, 0)
# Solid angle of a narrow cone, in that of the smallest one that holds the image: joining every vertex lowered the
# squared noise of a second 10 to 20 times at a sixth, and 500 to 80,000 times below a fiftieth.
NARROW = 0.25
# A laser aside may light a spot that is not in view, and then all light is indirect. Up to this full angle of its cone
# joining every vertex pays whatever the view: 45 to 85 times at 12 degrees in a room, at 25 as much as it costs.
NARROW_ASIDE_DEG = 20.0


def connections_per_vertex(world: TracedScene, *, reuses_paths: bool) -> int:
    """Return lit points that every x1 is joined to; none where the laser is no flood, and lights another place every
    time."""
    if world.scene.laser.mode != "flood":
        return 0
    return (WIDE_CONNECTIONS if connects_suffixes(world) else NARROW_CONNECTIONS)[reuses_paths]


def connects_suffixes(world: TracedScene) -> bool:
    """Return whether path vertices after x1 are connected to light vertices, too.

    They are where paths seldom meet what the laser lights most: it lights half the sphere or more, and with it what is
    close to it; or its cone is so narrow that the lit spot is a small part of what is seen, or may lie beside that.
    """
    camera, laser = world.scene.camera, world.scene.laser
    cos_half_angle = laser.cos_half_angle(camera)
    is_narrow = 1 - cos_half_angle < NARROW * (1 - Laser().cos_half_angle(camera))
    is_narrow |= not laser.is_colocated and 2 * laser.half_angle(camera) <= math.radians(NARROW_ASIDE_DEG)
    return cos_half_angle <= 0 or (laser.mode == "flood" and is_narrow)


class LightVertex(NamedTuple):
    """A lit point: direction and optical path to the laser, irradiance, and density of one point per area [1/m^2]."""

    si: Interactions
    to_laser: Vectors
    path: Floats
    irradiance: Floats
    density: Floats


class LightVertices(NamedTuple):
    """Points of a launch, by row, `each` for every batch; at the end are a few that belong to no batch."""

    rows: tuple[Array, ...]
    each: UInts

    def all(self) -> LightVertex:
        """Read all points."""
        return self.at(dr.arange(UInt32, dr.width(self.rows[0]) // WIDTH))

    def at(self, index: UInts, active: bool | Masks = True) -> LightVertex:
        """Read the points of these numbers."""
        columns = gather_rows(self.rows, (*PLACE_ON_SURFACE, mi.Vector3f, Float, Float, Float), index, active)
        parts, rest = columns[: len(PLACE_ON_SURFACE)], columns[len(PLACE_ON_SURFACE) :]
        return LightVertex(interaction_from_parts(parts), *rest)


class Connection(NamedTuple):
    """Light that x1 reflects of a lit point: radiance, path to the laser, direction to the point, and whether x1
    reflects it diffusely."""

    value: Floats
    path: Floats
    direction: Vectors
    diffuse: Masks


def sample_light_vertices(world: TracedScene, lanes: int, batches: int, key: tuple[UInts, UInts]) -> LightVertices:
    """Return points where uniform directions of the laser's cone meet a surface, for a launch of so many paths."""
    wanted = min(MAX_POINTS, max(int(lanes * POINTS_PER_PATH), 1))
    parts = 1 << (batches - 1).bit_length()
    each = max(1, (1 << (wanted - 1).bit_length()) // parts)
    count = each * parts
    opaque = dr.opaque(UInt32, each)
    index = dr.arange(UInt32, count + 3)  # of no other input's length (`render.indirect.camera_paths`)
    dr.eval(index)
    parts, *columns = world.recordings.call(world, "lit points", _sample_vertices, index, opaque, *key)
    return LightVertices(packed((*parts[:-1], *columns)), opaque)


def _sample_vertices(world: TracedScene, index: UInts, each: UInts, *key: UInts) -> tuple[Array, ...]:
    """Sample the parts of `LightVertex`, in plain tuples."""
    # each batch has a randomised (0, 2)-sequence of its own
    shift = mi.sample_tea_32(index // each + key[0], index * 0 + key[1])
    number = index % each
    u, v = mi.radical_inverse_2(number, shift[0]), mi.sobol_2(number, shift[1])
    height = u * _cap(world)
    ring = dr.sqrt(dr.maximum(height * (2 - height), 0))
    sine, cosine = dr.sincos(2 * math.pi * v)
    towards = to_world(world, mi.Vector3f(ring * cosine, ring * sine, 1 - height))
    ray = mi.Ray3f(mi.Point3f(world.laser) + 0 * towards, towards)
    si, _, _, distance = first_opaque(world, ray, Bool(True), scattered=True)
    # a lamp on a wall lights the room, not the wall: shadow rays end before it, too
    touching = si.is_valid() & (distance <= TOUCHING * dr.max(dr.abs(world.laser)))
    beyond, _, _, _ = first_opaque(world, spawn(si, towards), touching, ray.o)
    si = dr.select(touching, beyond, si)
    found = si.is_valid()
    to_laser, irradiance, path = laser_light(world, si, 0 * index, found, seen_by_camera=None)
    return parts_of(si), to_laser, path, irradiance, density_of(world, si, to_laser)


def density_of(world: TracedScene, si: Interactions, to_laser: Vectors) -> Array:
    """Return density per area [1/m^2] of a lit point at an interaction, if the laser lights it."""
    distance2 = dr.squared_norm(world.laser - si.p)
    return dr.abs(dr.dot(si.n, to_laser)) / (distance2 * 2 * math.pi * _cap(world))


def _cap(world: TracedScene) -> Array:
    """Compute the solid angle of the laser's cone over 2 pi: 1 - cos, without cancellation."""
    return 2 * dr.square(dr.sin(0.5 * world.half_angle))


def lit_density(density: Floats, distance2: Floats, far_cosine: Floats) -> Array:
    """Return the density per solid angle of light vertices that have this `density` per area, at that distance."""
    return density * distance2 / dr.maximum(dr.abs(far_cosine), MIN_FAR_COSINE)


def mis_weight_bsdf(lobes: Floats, lit: Floats) -> Array:
    """Return the share of a lit point's light that paths keep which go there by chance, from the densities per solid
    angle of the lobes that send them there and of light vertices."""
    return dr.select(lobes + lit > 0, lobes / (lobes + lit), 1)


def mis_weight_sampled(sample: LobeSamples, lit: Floats, copies: Floats = 1) -> Array:
    """Return `mis_weight_bsdf` of a point that was met in a sampled direction; 1 of mirror-like lobes."""
    smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return dr.select(smooth, 1, mis_weight_bsdf(copies * sample.pdf, lit))


def mis_weight_filtered(diffuse: Floats, cosine: Floats, lit: Floats, copies: Floats) -> Array:
    """Return `mis_weight_bsdf` at a surface that joins light vertices diffusely alone, as filters want it; `diffuse` is
    the fraction that it reflects so."""
    return 1 - diffuse * (1 - mis_weight_bsdf(copies / math.pi * dr.abs(cosine), lit))


def diffuse_fraction(world: TracedScene, si: Interactions, direction: Vectors, value: Floats, active: Masks) -> Array:
    """Return share of a surface's reflectance `value`, cosine included, that is diffuse; of what is not mirror-like."""
    if not world.has_mixed_lobes:
        return 1
    diffuse = si.bsdf().eval(_diffuse(), si, si.to_local(direction), active)[0]
    return dr.select(value > 0, dr.clip(diffuse / value, 0, 1), 0)


class Scattered(NamedTuple):
    """A direction that a surface's lobes were sampled for, and its weight: reflectance times cosine over density."""

    sample: LobeSamples
    weight: Floats


def mis_weight_sampled_filtered(
    world: TracedScene, si: Interactions, scattered: Scattered, lit: Floats, copies: Floats, active: Masks
) -> Array:
    """Return `mis_weight_filtered` in the direction scattered by `si`."""
    sample, weight = scattered
    diffuse = diffuse_fraction(world, si, si.to_world(sample.wo), weight * sample.pdf, active)
    diffuse = dr.select(mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta), 0, diffuse)
    return mis_weight_filtered(diffuse, sample.wo.z, lit, copies)


def _diffuse() -> Array:
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.DiffuseReflection
    return context


def light_vertex_index(light_vertices: LightVertices, batch: UInts, number: UInts) -> Array:
    """Return which light vertex a number chooses among those of its batch."""
    return batch * light_vertices.each + number % light_vertices.each


def reflect_diffusely(si: Interactions, local: Vectors, active: Masks) -> tuple[Array, Array]:
    """Return what a surface reflects diffusely in a direction of its shading frame, cosine counted in, and the density
    of a diffuse lobe there."""
    return si.bsdf().eval(_diffuse(), si, local, active)[0], dr.abs(local.z) / math.pi


def reflect(si: Interactions, local: Vectors, active: Masks) -> tuple[Array, Array]:
    """Return what a surface reflects in a direction of its shading frame, cosine counted in, and the density of its
    lobes there; mirror-like ones left out."""
    value, density = si.bsdf().eval_pdf(mi.BSDFContext(), si, local, active)
    return value[0], density


class Arrival(NamedTuple):
    """Light of one light vertex at a surface.

    light           what arrives there, cosine not counted in, over the density per area
    path            from the surface to the laser [m]
    direction       to the light vertex
    density         of light vertices per solid angle in that direction
    value, lobes    what the surface reflects of it, cosine counted in, and the density of its lobes
    ratio           `ratio_at_laser` of the light vertex, with whose share the light is still to be weighted; None
                    without light paths
    """

    light: Floats
    path: Floats
    direction: Vectors
    density: Floats
    value: Floats
    lobes: Floats
    ratio: Floats


def connect_to_light_vertex(
    world: TracedScene,
    si: Interactions,
    light_vertices: LightVertices,
    point: Array,
    active: Masks,
    reflected: Callable[[Interactions, Vectors, Masks], tuple[Array, Array]] = reflect,
) -> Arrival:
    """Connect a surface to one light vertex. What it makes of the light is `light` times `value` over the densities of
    all techniques together: its `lobes` and light vertices."""
    end, to_laser, laser_path, irradiance, density = light_vertices.at(point, active)
    offset = end.p - si.p
    distance2 = dr.squared_norm(offset)
    direction = offset * dr.rsqrt(distance2)
    active = active & (irradiance > 0) & (distance2 > 0)
    value, lobes = reflected(si, si.to_local(direction), active)
    active &= value > 0
    end.wi = end.to_local(-direction)
    light = end.bsdf().eval(mi.BSDFContext(), end, end.to_local(to_laser), active)[0] * irradiance
    active &= light > 0
    passed, leg = segment(world, si, end.p, active, spread=False)
    density = lit_density(density, distance2, dr.dot(end.n, direction))
    ratio = ratio_at_laser(world, end, -direction, active) if has_light_paths(world) else None
    light = dr.select(active & dr.isfinite(light * passed), light * passed, 0)
    return Arrival(light, leg + laser_path, direction, density, value, lobes, ratio)


class JoinedVertex(NamedTuple):
    """x2 joined to a light vertex, where what it reflects of that depends on where it is seen from.

    The first slot of `PathSuffixes` then holds what arrives at x2 from the light vertex, and every pixel reflects it
    as it sees x2; the second slot holds all of x3's laser light, which every pixel weights by `mis_weight_bsdf`.

    direction             from x2 to the light vertex
    density               of light vertices per solid angle in that direction
    onward_density        the same in the direction to x3
    reflected             what x2 makes of that light as the pixel itself sees it: what all do where x2 is diffuse
    own_value, own_ratio  the pixel's own factor of the first slot, and of the ratio there or None
    own_weight            the pixel's own weight of the second slot
    """

    direction: Vectors
    density: Floats
    onward_density: Floats
    reflected: Floats
    own_value: Floats
    own_ratio: Floats
    own_weight: Floats


class JoinedFactors(NamedTuple):
    """Factors of light that comes by `JoinedVertex`: of the first slot, of its ratio or None, and of the second slot
    beside the factor of all light from beyond x2."""

    value: Floats
    ratio: Floats
    weight: Floats


class SeenVertex(NamedTuple):
    """x2 as x1 of any pixel of the block sees it: factor of light from there, `ratio_at_camera` of x1 or None, density
    of the lobes of x2 towards x3; where it is seen, and where the path goes on."""

    si: Interactions
    reach: Floats
    at_x1: Floats
    onward_density: Floats
    active: Masks
    going: Masks


def joined_factors(world: TracedScene, joined: tuple[Array, ...], seen: SeenVertex) -> JoinedFactors:
    """Return the factors of suffixes, given the first four parts of their `JoinedVertex`, for the pixels that have
    `seen` x2; the value before division by a density."""
    direction, density, onward_density, reflected = joined
    rough = seen.active & (dr.gather(Float, world.rough_lobes, shape_index(seen.si), seen.active) > 0)
    towards = seen.si.to_local(direction)
    value, lobes = reflect(seen.si, towards, rough)
    value /= lobes + density
    value = seen.reach * dr.select(rough, value, reflected)
    turned = dr.select(rough, reversal(seen.si, towards, lobes, rough), 1) if seen.at_x1 is not None else None
    weight = mis_weight_bsdf(seen.onward_density, onward_density)
    value = dr.select(seen.active & dr.isfinite(value), value, 0)
    return JoinedFactors(value, None if turned is None else finite_ratio(seen.at_x1 * turned), weight)


def slot_factors(onward: Floats, ratio: Floats, joined: JoinedFactors | None, number: UInts) -> tuple[Array, Array]:
    """Return the factors of a slot's light and of its ratio, from those of all light from beyond x2; slots are numbered
    from 1."""
    if joined is None:
        return onward, ratio
    factor = dr.select(number == 1, joined.value, dr.select(number == 2, onward * joined.weight, onward))
    return factor, None if ratio is None else dr.select(number == 1, joined.ratio, ratio)


def fills_slots(onward: Floats, joined: JoinedFactors | None, before_first: Masks) -> Array:
    """Return whether a slot that follows has light: the first of a joined x2 has if nothing comes from beyond, too."""
    return onward > 0 if joined is None else (onward > 0) | (before_first & (joined.value > 0))
