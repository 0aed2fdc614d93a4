"""The tails of paths: x2, the second surface, and what lies beyond it."""

from __future__ import annotations

from typing import Any, NamedTuple

from render.indirect.glossy import mis_weight_camera_path
from render.indirect.light_vertices import LightVertices, by_chance, density_of, is_wide, joined
from render.indirect.primary_vertices import PrimaryVertices, copies_of
from render.scene.rays import first_opaque, kept, laser_light, shape_index, spawn
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi


class PathSuffixes(NamedTuple):
    """x2 and beyond.

    direction, diffuse  from x1 to x2, by a diffuse lobe or not
    irradiance, to_laser, laser_path, density  the laser's light at x2, and `light_vertices.density_of` there
    onward_direction    from x2 to x3
    shared, onward      whether the block may use the laser's light at x2, and what lies beyond
    own_value           what the pixel itself gets of the laser's light at x2
    own_onward          factor of what lies beyond: `values` with their `paths` from x2 to the laser, `length` of them
    soonest_m           the shortest of these paths and `laser_path` that carries light
    """

    si: Any
    direction: Any
    diffuse: Any
    leg: Any
    irradiance: Any
    to_laser: Any
    laser_path: Any
    density: Any
    onward_direction: Any
    shared: Any
    onward: Any
    own_transmission: Any
    own_value: Any
    own_onward: Any
    values: Any
    paths: Any
    length: Any
    soonest_m: Any


class Slots(NamedTuple):
    """Where paths put the light of x3, x4, ...: lanes; memory for radiances and paths, slots x lanes; and how many of
    both there are, as arrays."""

    lane: Any
    values: Any
    paths: Any
    lanes: Any
    count: Any


def slots_for(world: TracedScene, lit: LightVertices | None, lanes: int, vertices: int) -> Slots:
    """Empty slots for so many vertices: a vertex has one of its own, and one before it if the last one was joined."""
    count = (2 if _joins(world, lit) else 1) * vertices
    lane, values, paths = dr.arange(UInt32, lanes), *(dr.zeros(Float, lanes * max(count, 1)) for _ in range(2))
    dr.make_opaque(lane, values, paths)  # of another length at every call
    return Slots(lane, values, paths, dr.opaque(UInt32, lanes), dr.opaque(UInt32, count))


def _joins(world: TracedScene, lit: LightVertices | None) -> bool:
    """Whether vertices after x1 are joined to lit points."""
    return lit is not None and is_wide(world)


def tails_of(
    world: TracedScene,
    heads: PrimaryVertices,
    sample: Any,
    weight: Any,
    pixel: Any,
    lit: LightVertices | None,
    joins: int,
    batch: Any,
    random: Any,
    slots: Slots,
    *,
    used: bool,
) -> PathSuffixes:
    """Tails in sampled directions. If neighbours may use them (`used`), x2 on a rough coat is not joined to lit points:
    what it reflects diffusely depends on where it is seen from, and joined light is handed on as one number."""
    context = mi.BSDFContext()
    x1, alive = heads.si, heads.valid & (weight > 0)
    direction = x1.to_world(sample.wo)
    si, passed, leg, _ = first_opaque(world, spawn(x1, direction), alive, x1.p)
    alive &= si.is_valid()
    own = dr.select(alive, heads.transmission * weight * passed, 0)
    to_laser, irradiance, laser_path = laser_light(world, si, pixel, alive, seen_by_camera=None)
    density = None if lit is None else density_of(world, si, to_laser) * joins
    value = si.bsdf().eval(context, si, si.to_local(to_laser), alive)[0] * irradiance
    if lit is not None:
        value *= by_chance(world, x1, sample, weight, si, density, copies_of(heads, leg + laser_path), alive)
    # what is reflected by a mirror in the first place cannot be read backwards
    readable = alive & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    value *= mis_weight_camera_path(world, x1, direction, si, readable)
    value = dr.select(alive & dr.isfinite(value), own * value, 0)
    onward, onward_weight = si.bsdf().sample(
        context, si, random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32()), alive
    )
    onward_weight = onward_weight[0]
    joinable = Bool(alive)
    if used and world.has_rough_coats:
        joinable &= dr.gather(Float, world.rough_coats, shape_index(si), alive) == 0
    scale = dr.select(onward_weight > 0, onward_weight, 1)
    way = _SuffixState(kept(si), onward, onward_weight, onward_weight / scale, 1 / scale, joinable, readable)
    soonest = dr.select(alive & (irradiance > 0), laser_path, dr.inf)
    light = _trace_suffix(world, lit, batch, slots, way, alive, pixel, random, soonest)
    shared = alive & (dr.gather(Float, world.shares, shape_index(si), alive) > 0)
    shared &= heads.shares & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return PathSuffixes(
        kept(si),
        direction,
        alive & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DiffuseReflection),
        leg,
        dr.select(alive, irradiance, 0),
        to_laser,
        laser_path,
        density,
        si.to_world(onward.wo),
        shared,
        shared & ~mi.has_flag(onward.sampled_type, mi.BSDFFlags.Delta) & (onward_weight > 0),
        dr.select(alive, passed, 0),
        value,
        own * scale,
        *light,
    )


class _SuffixState(NamedTuple):
    """Where paths stand and how they go on: a sample of the surface's lobes and its weight. `through` is the factor of
    light that comes from there, `here` that of light reflected on the spot, reflectance counted in that light, and
    `joinable` says whether there is such; `readable` whether other paths bring a part of it (`glossy`)."""

    si: Any
    sample: Any
    weight: Any
    through: Any
    here: Any
    joinable: Any
    readable: Any


@dr.syntax
def _trace_suffix(
    world: TracedScene,
    lit: LightVertices | None,
    batch: Any,
    slots: Slots,
    way: _SuffixState,
    active: Any,
    pixel: Any,
    random: Any,
    soonest: Any,
) -> tuple[Any, Any, Any, Any]:
    """Light of x3, x4, ... that goes to x2 along the way, divided by the density of the path after x2.

    Returns radiances and path lengths from x2 to the laser, in their slots; how many slots each lane has filled, and
    the shortest path.
    """
    lanes, joining = dr.width(pixel), _joins(world, lit)
    lane, values, paths, stride, last = slots
    slot, path = dr.zeros(UInt32, lanes), dr.zeros(Float, lanes)
    si, sample = mi.SurfaceInteraction3f(way.si), mi.BSDFSample3f(way.sample)
    weight, through, here, joinable = Float(way.weight), Float(way.through), Float(way.here), Bool(way.joinable)
    active = Bool(active) & (slot < last)
    while active:
        if dr.hint(joining, mode="scalar"):
            light, leg, _ = joined(world, si, lit, batch, random.next_uint32(), active & joinable)
            light *= here
            dr.scatter(paths, path + leg, slot * stride + lane, active)
            dr.scatter(values, light, slot * stride + lane, active)
            soonest = dr.select(light > 0, dr.minimum(soonest, path + leg), soonest)
            slot += 1
        active &= weight > 0
        before, towards = kept(si), spawn(si, si.to_world(sample.wo))
        si, passed, optical, _ = first_opaque(world, towards, active, before.p)
        path += optical
        active &= si.is_valid()
        to_laser, irradiance, leg = laser_light(world, si, pixel, active, seen_by_camera=None)
        light = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(to_laser), active)[0] * irradiance
        if dr.hint(joining, mode="scalar"):
            density = density_of(world, si, to_laser)
            light *= dr.select(joinable, by_chance(world, before, sample, weight, si, density, 1, active), 1)
        light *= mis_weight_camera_path(world, before, towards.d, si, active & way.readable)
        here = through * passed
        light = dr.select(dr.isfinite(light), here * light, 0)
        dr.scatter(paths, path + leg, slot * stride + lane, active)
        dr.scatter(values, light, slot * stride + lane, active)
        soonest = dr.select(active & (light > 0), dr.minimum(soonest, path + leg), soonest)
        slot += 1
        active &= slot < last
        sample, again = si.bsdf().sample(
            mi.BSDFContext(),
            si,
            random.next_float32(),
            mi.Point2f(random.next_float32(), random.next_float32()),
            active,
        )
        weight = again[0]
        through = here * weight
        # Russian roulette: paths that carry little end early, the others carry their energy on
        survive = dr.clip(dr.select(weight > 0, through, here), 0.05, 0.95)
        active &= (here > 0) & (random.next_float32() < survive)
        through /= survive
        here /= survive
        joinable = Bool(active)
    return values, paths, slot, soonest
