"""Path suffixes: x2, the reconnection vertex, and what lies beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Generators, Interactions, LobeSamples, Masks, UInts, Vectors
from render.indirect.glossy import (
    camera_share,
    finite_ratio,
    has_light_paths,
    ratio_at_camera,
    ratio_at_laser,
    reversal,
    reversal_of_sample,
)
from render.indirect.light_vertices import (
    Arrival,
    Connection,
    JoinedVertex,
    LightVertices,
    Scattered,
    connect_to_light_vertex,
    connects_suffixes,
    density_of,
    light_vertex_index,
    lit_density,
    mis_weight_sampled,
    mis_weight_sampled_filtered,
)
from render.indirect.primary_vertices import PrimaryVertices, sampling_techniques
from render.indirect.retro_paths import ReachedVertex, connect_retro
from render.scene.rays import (
    first_opaque,
    interaction_from_parts,
    kept,
    laser_light,
    parts_of,
    sample_bsdf,
    shape_index,
    spawn,
)
from render.scene.rows import PLACE_ON_SURFACE, gather_rows, packed
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi
from render.specular.mirrors import mirrors_in_row, without_mirrored_light

MIN_REVERSAL = 1e-12  # of x2, by which is divided


class PathSuffixes(NamedTuple):
    """x2 and beyond.

    direction, diffuse  from x1 to x2, by a diffuse lobe or not
    irradiance, to_laser, laser_path, density  the laser's light at x2, and `light_vertices.density_of` there
    onward_direction    from x2 to x3
    reusable, onward    whether the block may use the laser's light at x2, and what lies beyond
    own_value           what the pixel itself gets of the laser's light at x2
    own_onward          factor of what lies beyond: `values` with their `paths` from x2 to the laser, `length` of them
    own_retro           q / p of `render.indirect.retro_paths` in the direction from x2 to x3; None without such paths
    own_ratio, ratios   where light paths are traced: factors that x1 with x2, and what lies beyond, have in the ratio
                        of densities that decides what these take of such a value (`render.indirect.glossy`)
    soonest_m           the shortest of these paths and `laser_path` that carries light
    joined              None where x2 reflects light of its connection to every pixel alike, or has no connection
    """

    si: Interactions
    direction: Vectors
    diffuse: Masks
    leg: Floats
    irradiance: Floats
    to_laser: Vectors
    laser_path: Array
    density: Floats
    onward_direction: Vectors
    reusable: Masks
    onward: Masks
    own_transmission: Floats
    own_value: Floats
    own_onward: Floats
    own_ratio: Floats
    own_retro: Floats
    values: Floats
    paths: Floats
    ratios: Floats
    length: UInts
    soonest_m: Floats
    joined: JoinedVertex | None


class SharedSuffix(NamedTuple):
    """Hold what other pixels' x1 need of a suffix: parts of `PathSuffixes`, with the first four of a `JoinedVertex`."""

    own_transmission: Floats
    leg: Floats
    to_laser: Vectors
    irradiance: Floats
    onward: Masks
    onward_direction: Vectors
    reusable: Masks
    density: Floats
    joined: tuple[Array, ...] | None
    si: Interactions


# kinds of these parts but the last three, and of a joined vertex's
_SHARED = (Float, Float, mi.Vector3f, Float, Bool, mi.Vector3f, Bool)
_JOINED = (mi.Vector3f, Float, Float, Float)


def pack_suffixes(suffixes: PathSuffixes, chosen: UInts | None) -> tuple[Array, ...]:
    """Return what other pixels need of the chosen suffixes (None: of all), by row."""
    shared = [getattr(suffixes, name) for name in SharedSuffix._fields[: len(_SHARED)]]
    density = () if suffixes.density is None else (suffixes.density,)
    joined = () if suffixes.joined is None else suffixes.joined[: len(_JOINED)]
    return packed((*parts_of(suffixes.si)[:-1], *shared, *density, *joined), chosen)


def read_suffix(rows: Sequence[Array], index: UInts, *, connected: bool, joined: bool) -> SharedSuffix:
    """Read packed suffixes; `connected` with a density, and `joined` with a joined vertex."""
    kinds = PLACE_ON_SURFACE, _SHARED, (Float,) if connected else (), _JOINED if joined else ()
    columns = iter(gather_rows(rows, [kind for part in kinds for kind in part], index, True))
    place, shared, density, vertex = (tuple(next(columns) for _ in part) for part in kinds)
    known = (*shared, density[0] if density else None, vertex or None, interaction_from_parts(place))
    return SharedSuffix(*known)


class Slots(NamedTuple):
    """Memory for the light of the path vertices x3, x4, ...: lanes; radiances, paths, and ratios or None, slots x
    lanes; and the numbers of lanes and slots, as arrays."""

    lane: UInts
    values: Floats
    paths: Floats
    ratios: Floats
    lanes: UInts
    count: UInts


def slots_for(world: TracedScene, light_vertices: LightVertices | None, lanes: int, vertices: int) -> Slots:
    """Return empty slots for so many vertices: a vertex has one of its own, and one before it if the last one was
    joined."""
    count = (2 if _connects_suffix(world, light_vertices) else 1) * vertices
    kinds = 3 if has_light_paths(world) else 2
    lane, *kept_of_each = dr.arange(UInt32, lanes), *(dr.zeros(Float, lanes * max(count, 1)) for _ in range(kinds))
    dr.make_opaque(lane, *kept_of_each)  # of another length at every call
    values, paths, ratios = (*kept_of_each, None)[:3]
    return Slots(lane, values, paths, ratios, dr.opaque(UInt32, lanes), dr.opaque(UInt32, count))


def _connects_suffix(world: TracedScene, light_vertices: LightVertices | None) -> bool:
    """Return whether path vertices after x1 are connected to light vertices."""
    return light_vertices is not None and connects_suffixes(world)


class SuffixTask(NamedTuple):
    """Inputs for tracing the path suffixes of a launch.

    light_vertices, connections  what vertices are connected to, and how many of them x1 is; None, 0: to none
    batch, pixel, random         batch, flat pixel and random numbers of every path
    slots                        memory for the light of later vertices
    reused                       whether other pixels of a block may use the suffixes
    """

    light_vertices: LightVertices | None
    connections: int
    batch: UInts
    pixel: UInts
    random: Generators
    slots: Slots
    reused: bool


def trace_suffixes(
    world: TracedScene, primary: PrimaryVertices, scattered: Scattered, task: SuffixTask
) -> tuple[PathSuffixes, tuple[Connection, ...]]:
    """Trace suffixes in sampled directions; return them, and light that comes back over x1 if there is any."""
    (sample, weight), (light_vertices, connections, _, pixel, random, _, reused) = scattered, task
    x1, alive, direction = primary.si, primary.valid & (weight > 0), primary.si.to_world(sample.wo)
    si, passed, leg, _ = first_opaque(world, spawn(x1, direction), alive, x1.p)
    alive &= si.is_valid()
    own = dr.select(alive, primary.transmission * weight * passed, 0)
    to_laser, irradiance, laser_path = laser_light(world, si, pixel, alive, seen_by_camera=None)
    density = None if light_vertices is None else density_of(world, si, to_laser) * connections
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(to_laser), alive)[0] * irradiance
    if light_vertices is not None:
        lit = _lit_density(si, density, x1, direction)
        value *= _mis_weight_at_x1(world, primary, scattered, lit, leg + laser_path, alive)
    readable = alive & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)  # a mirror cannot be read backwards
    onward, (onward_weight, *_) = sample_bsdf(si, random, alive)
    at_x1, at_x2 = None, Float(1)
    if has_light_paths(world):
        at_x1 = dr.select(readable, ratio_at_camera(world, x1, direction, readable, sample.pdf), 0)
        at_x2 = dr.maximum(finite_ratio(reversal_of_sample(si, onward, alive)), MIN_REVERSAL)
        value *= camera_share(at_x1 * ratio_at_laser(world, si, -direction, readable))
    mirrors = mirrors_in_row(world, x1, None, alive)
    value = without_mirrored_light(dr.select(alive & dr.isfinite(value), own * value, 0), mirrors)
    goes_on = alive & (task.slots.count > 0)  # x3 is a surface more
    reached = ReachedVertex(x1, sample, own, at_x1, leg, si, readable & goes_on)
    own_retro, back = connect_retro(world, reached, onward, pixel, random)
    scale = dr.select(onward_weight > 0, onward_weight, 1)
    soonest = dr.select(alive & (irradiance > 0), laser_path, dr.inf)
    joined = reused and world.has_rough_lobes and _connects_suffix(world, light_vertices)
    unit, at_sample = (Float(1), Float(1)) if joined else (1 / scale, at_x2)
    mirrors = mirrors_in_row(world, si, mirrors, alive)
    state = _SuffixState(kept(si), onward, onward_weight, onward_weight / scale, unit, at_sample, mirrors)
    *light, (towards, lit, reflected, turned), (onward_lit, own_weight) = _trace_suffix(
        world, task, state, goes_on, soonest, joined=joined
    )
    reusable = primary.allows_reuse & _shares(world, si, sample, alive)
    own_ratio = None if at_x1 is None else finite_ratio(at_x1 * turned)
    x2_joined = JoinedVertex(towards, lit, onward_lit, reflected, own * reflected, own_ratio, own_weight)
    suffixes = PathSuffixes(  # type: ignore[call-arg]
        kept(si),
        direction,
        alive & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DiffuseReflection),
        leg,
        dr.select(alive, irradiance, 0),
        to_laser,
        laser_path,
        density,
        si.to_world(onward.wo),
        reusable,
        reusable & ~mi.has_flag(onward.sampled_type, mi.BSDFFlags.Delta) & (onward_weight > 0),
        dr.select(alive, passed, 0),
        value,
        own * scale,
        None if at_x1 is None else finite_ratio(at_x1 * at_x2),
        own_retro,
        *light,
        x2_joined if joined else None,
    )
    return suffixes, back


def _mis_weight_at_x1(
    world: TracedScene, primary: PrimaryVertices, scattered: Scattered, lit: Floats, path: Floats, alive: Masks
) -> Array:
    """Return `mis_weight_bsdf` of x2's laser light, of this path from x1 to the laser."""
    copies = sampling_techniques(primary, path)
    if primary.is_filtered:
        return mis_weight_sampled_filtered(world, primary.si, scattered, lit, copies, alive)
    return mis_weight_sampled(scattered.sample, lit, copies)


def _shares(world: TracedScene, x2: Interactions, sample: LobeSamples, alive: Masks) -> Array:
    """Return whether other pixels may use x2, as far as it and the `sample` of x1 decide."""
    shared = alive & (dr.gather(Float, world.allows_reuse, shape_index(x2), alive) > 0)
    return shared & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)


class _SuffixState(NamedTuple):
    """Current vertices of paths and their continuation: a sample of the surface's lobes and its weight.

    `throughput` is the factor of light that comes from there, `throughput_at_vertex` that of light reflected on the
    spot, reflectance counted in that light. `reversal` is that of the sample, which is no part of the ratios beyond,
    and `mirrors` the number of `mirrors_in_row`.
    """

    si: Interactions
    sample: LobeSamples
    weight: Floats
    throughput: Floats
    throughput_at_vertex: Floats
    reversal: Floats
    mirrors: UInts


@dr.syntax
def _trace_suffix(
    world: TracedScene, task: SuffixTask, state: _SuffixState, active: Masks, soonest: Floats, *, joined: bool
) -> tuple[Array, ...]:
    """Light of x3, x4, ... that goes to x2 along the path, divided by the density of the path after x2.

    Returns radiances, path lengths from x2 to the laser, and ratios, in their slots; how many slots each lane has
    filled, and the shortest path. Then of x2, if it is `joined` as `JoinedVertex` has it: direction and density of
    light vertices, what it reflects and its reversal there; and of x3 the density, and the pixel's own weight.
    """
    batch, pixel, random = task.batch, task.pixel, task.random
    light_vertices: Array = task.light_vertices  # None where nothing is connected
    lanes, connecting = dr.width(pixel), _connects_suffix(world, light_vertices)
    lane, stride, last = task.slots.lane, task.slots.lanes, task.slots.count
    slot, path, mirrors = dr.zeros(UInt32, lanes), dr.zeros(Float, lanes), state.mirrors + dr.zeros(UInt32, lanes)
    si, sample, weight = mi.SurfaceInteraction3f(state.si), mi.BSDFSample3f(state.sample), Float(state.weight)
    throughput, throughput_at_vertex = Float(state.throughput), Float(state.throughput_at_vertex)
    active = Bool(active) & (slot < last)
    # factors of the vertices between x2 and the current one, of the current one, and what a connection leaves out
    ratio, step, given = dr.full(Float, 1, lanes), dr.full(Float, 1, lanes), state.reversal + dr.zeros(Float, lanes)
    x2, x3 = (dr.zeros(mi.Vector3f, lanes), *(dr.zeros(Float, lanes),) * 3), (dr.zeros(Float, lanes),) * 2
    while active:
        first = slot == 0
        if dr.hint(connecting, mode="scalar"):
            chosen = light_vertex_index(light_vertices, batch, random.next_uint32())
            arrival, reflected, turned = _join(world, si, light_vertices, chosen, active)
            light, leg = throughput_at_vertex * arrival.light * reflected, arrival.path
            met = _times(ratio / given * turned, arrival.ratio)
            if dr.hint(joined, mode="scalar"):
                x2 = _where(first, (arrival.direction, arrival.density, reflected, turned), x2)
                light, met = dr.select(first, arrival.light, light), _where(first, (arrival.ratio,), (met,))[0]
            soonest = _put(task.slots, slot * stride + lane, (light, path + leg, met), soonest, active)
            slot += 1
        active &= weight > 0
        before, towards = kept(si), spawn(si, si.to_world(sample.wo))
        si, passed, optical, _ = first_opaque(world, towards, active, before.p)
        path += optical
        active &= si.is_valid()
        to_laser, irradiance, leg = laser_light(world, si, pixel, active, seen_by_camera=None)
        light = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(to_laser), active)[0] * irradiance
        if dr.hint(connecting, mode="scalar"):
            lit = _lit_density(si, density_of(world, si, to_laser), before, towards.d)
            by_chance = mis_weight_sampled(sample, lit)
            if dr.hint(joined, mode="scalar"):
                x3, by_chance = _where(first, (lit, by_chance), x3), dr.select(first, 1, by_chance)
            light *= by_chance
        light, mirrors = without_mirrored_light(light, mirrors), mirrors_in_row(world, si, mirrors, active)
        throughput_at_vertex, ratio, given = throughput * passed, finite_ratio(ratio * step), Float(1)
        vertex = light * throughput_at_vertex, path + leg, _ratio_at_end(world, si, -towards.d, ratio, active)
        soonest = _put(task.slots, slot * stride + lane, vertex, soonest, active)
        slot += 1
        active &= slot < last
        sample, (weight, *_) = sample_bsdf(si, random, active)
        throughput = throughput_at_vertex * weight
        if dr.hint(has_light_paths(world), mode="scalar"):
            step = finite_ratio(reversal_of_sample(si, sample, active))
        # Russian roulette: paths that carry little end early, the others carry their energy on
        survive = dr.clip(dr.select(weight > 0, throughput, throughput_at_vertex), 0.05, 0.95)
        active &= (throughput_at_vertex > 0) & (random.next_float32() < survive)
        throughput, throughput_at_vertex = throughput / survive, throughput_at_vertex / survive
    return task.slots.values, task.slots.paths, task.slots.ratios, slot, soonest, x2, x3


def _join(
    world: TracedScene, si: Interactions, light_vertices: LightVertices, chosen: UInts, active: Masks
) -> tuple[Arrival, Array, Array]:
    """Join a vertex to a light vertex: what arrives there, what the vertex makes of it, and its `reversal`, 1 without
    light paths."""
    arrival = connect_to_light_vertex(world, si, light_vertices, chosen, active)
    reflected = arrival.value / (arrival.lobes + arrival.density)
    reflected = dr.select(dr.isfinite(reflected), reflected, 0)
    if arrival.ratio is None:
        return arrival, reflected, Float(1)
    return arrival, reflected, reversal(si, si.to_local(arrival.direction), arrival.lobes, active)


def _where(chosen: Masks, new: tuple, old: tuple) -> tuple:
    """Return new parts in the chosen lanes, old ones in others; None where that is None."""
    return tuple(None if a is None else dr.select(chosen, a, b) for a, b in zip(new, old, strict=True))


def _times(factor: Floats, ratio: Floats) -> Array:
    """Return a finite ratio times a factor, None where it is None."""
    return None if ratio is None else finite_ratio(factor * ratio)


def _lit_density(end: Interactions, density: Floats, si: Interactions, direction: Vectors) -> Array:
    """Return `lit_density` of a point that was met from `si` in a direction, of its density per area."""
    return lit_density(density, dr.squared_norm(end.p - si.p), dr.dot(end.n, direction))


def _ratio_at_end(world: TracedScene, si: Interactions, back: Vectors, ratio: Floats, active: Masks) -> Array:
    """Return the ratio of a path that ends on a surface, from that of the points before; `back` leads to the last of
    these. None without light paths."""
    return finite_ratio(ratio * ratio_at_laser(world, si, back, active)) if has_light_paths(world) else None


def _put(slots: Slots, place: UInts, vertex: tuple[Floats, Floats, Floats], soonest: Floats, active: Masks) -> Array:
    """Write light of a vertex, its path and its ratio, if it has one, into their slots; return the shortest path so far
    that carries light."""
    light, path, ratio = vertex
    light = dr.select(dr.isfinite(light), light, 0)
    dr.scatter(slots.paths, path, place, active)
    dr.scatter(slots.values, light, place, active)
    if ratio is not None:
        dr.scatter(slots.ratios, ratio, place, active)
    return dr.select(active & (light > 0), dr.minimum(soonest, path), soonest)
