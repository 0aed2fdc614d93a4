"""Paths of indirect light: from the camera over surfaces, every vertex of them connected to the laser.

A camera path meets x1, the first surface of its pixel, then x2, x3, ... What the laser does at each of them is added to
the pixel, and so is what one point lit by the laser does there (`render.lit`). What follows x1 is the path's tail: the
pixels around it may use it, too (`render.sharing`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from render.glossy import glossy_of, left_to_paths
from render.lit import Lit, by_chance, density_of, is_wide, joined, joins_of, kept, lit_points, of_parts, parts_of
from render.rays import camera_rays, first_opaque, laser_light, shape_index, spawn
from render.regions import Point, late_from, point_of
from render.turns import BLOCK, Turns, block_order, turns_of
from render.world import Bool, Float, UInt32, World, dr, mi, upload

# Bits of the generalised golden ratio in two dimensions (real root of x^3 = x + 1), in units of 2^-32; and of the plain
GOLDEN = (3242174889, 2447445414)
PLAIN_GOLDEN = 2654435769


class Heads(NamedTuple):
    """x1 of every path of a launch and where it belongs; as a `point` of `render.regions`, if that is asked for.

    `late_m` is the path from the laser to x1 [m] up to which light comes by the tails of the whole block, where the
    head `shares`, and not by the path alone: infinite where blocks share all, 0 where they share nothing.
    """

    receiver: Any
    si: Any
    transmission: Any
    path: Any
    valid: Any
    shares: Any
    late_m: Any
    point: Point | None

    @property
    def early_m(self) -> Any:
        """`late_m` of those that share, 0 for others."""
        return dr.select(self.shares, self.late_m, 0)


class Joined(NamedTuple):
    """What x1 reflects of a lit point: radiance, path to the laser, and direction to the point."""

    value: Any
    path: Any
    direction: Any


class Tails(NamedTuple):
    """x2 and beyond.

    direction, diffuse  from x1 to x2, by a diffuse lobe or not
    irradiance, to_laser, laser_path, density  the laser's light at x2, and `render.lit.density_of` there
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


class Traced(NamedTuple):
    """Paths of a launch, the lit points that they were joined to, and the batch that each path belongs to."""

    heads: Heads
    joined: tuple[Joined, ...]
    tails: Tails
    lit: Lit | None
    batch: Any


def trace_paths(
    world: World,
    pixels: np.ndarray,
    turns: Turns,
    bounces: int,
    seed: int,
    batches: int,
    *,
    shared: bool,
    from_m: Any = None,
) -> Traced:
    """Trace a path for every member of every turn.

    Blocks share their tails if they are `shared`; for light less than `from_m` behind direct light if `shares_early`.
    """
    lanes, vertices = len(turns.block) * BLOCK, bounces - 2
    lane = dr.arange(UInt32, lanes)
    dr.eval(lane)
    seeds = np.random.SeedSequence(seed).generate_state(4)
    joins = joins_of(world, shared=shared)
    lit = _lit(world, turns, lanes, batches, joins, seeds[2:])
    slots = _slots(world, lit, vertices)
    values, paths = (dr.zeros(Float, lanes * max(slots, 1)) for _ in range(2))
    dr.make_opaque(values, paths)  # of another length at every call
    given = _Given(
        lane,
        upload(UInt32, np.append(np.stack(turns, axis=1), (0, 0))),
        upload(UInt32, np.append(pixels.astype(np.int64) & 0xFFFFFFFF, 0)),
        tuple(dr.opaque(UInt32, int(number)) for number in seeds[:2]),
        dr.opaque(UInt32, batches),
        dr.opaque(UInt32, lanes),
        dr.opaque(UInt32, slots),
        values,
        paths,
        None if lit is None else (parts_of(lit.si), *lit[1:]),
        from_m,
    )
    glossy_of(world)  # looked for before anything is recorded
    work = partial(_paths, shared=shared, joins=joins)
    heads, near, tails, batch = world.recordings.call(world, ("paths", shared, joins), work, *given)
    late_m = dr.full(Float, dr.inf if shared else 0, lanes) if from_m is None else heads[-2]
    point = None if from_m is None else Point(*heads[-1])
    return Traced(
        Heads(heads[0], of_parts(heads[1]), *heads[2:-2], late_m, point),
        tuple(Joined(*light) for light in near),
        Tails(of_parts(tails[0]), *tails[1:]),
        lit,
        batch,
    )


class _Given(NamedTuple):
    """What paths are traced from, as arrays: of every lane its number; `Turns`, those of a turn together; flat pixels;
    keys of the random numbers; how many batches, lanes and slots of `_beyond` there are, and memory for these; parts of
    `Lit`; and from where on light is filtered [m], or None.

    Dr.Jit records anew where two inputs have one size that had not before: there are 16 n lanes, 4 n + 2 numbers of
    turns, 16 n + 1 pixels and 2^n + 3 lit points.
    """

    lane: Any
    turns: Any
    pixels: Any
    keys: tuple
    batches: Any
    lanes: Any
    slots: Any
    values: Any
    paths: Any
    lit: tuple | None
    from_m: Any


def _paths(world: World, *given: Any, shared: bool, joins: int) -> tuple[tuple, tuple, tuple, Any]:
    """The parts of `Traced`, in plain tuples, which recordings look into."""
    given = _Given(*given)
    lane, keys, from_m = given.lane, given.keys, given.from_m
    lit = None if given.lit is None else Lit(of_parts(given.lit[0]), *given.lit[1:])
    turn, member = lane // BLOCK, lane % BLOCK
    block, stream, round_index, stride = (dr.gather(UInt32, given.turns, 4 * turn + part) for part in range(4))
    batch = round_index % given.batches
    # a hash of block, member and round numbers the streams, whichever launch they run in
    lane_key = mi.sample_tea_32(stream * BLOCK + member, round_index ^ keys[1])
    random = mi.PCG32(initstate=mi.UInt64(lane_key[0]), initseq=mi.UInt64(lane_key[1]))
    if shared:
        # one random shift a block and round; the members share a low-discrepancy set of first directions, and their
        # lit points: rays to these are neighbours
        shift = mi.sample_tea_32(stream, round_index ^ keys[0])
        spread = [Float((s + member * g) >> 8) * 2.0**-24 for s, g in zip(shift, GOLDEN, strict=True)]
        first = mi.sample_tea_32(stream, round_index ^ keys[1])[0]
    else:
        # one randomised (0, 2)-sequence a block and batch (Sobol 1967): the rounds of each member are an aligned run of
        # it, and as even as those of all
        shift = mi.sample_tea_32(stream, batch ^ keys[0])
        number = member * stride + round_index // given.batches
        spread = mi.radical_inverse_2(number, shift[0]), mi.sobol_2(number, shift[1])
        first = (number + stream * PLAIN_GOLDEN) * joins
    receiver = block * BLOCK + member
    pixel = dr.gather(UInt32, given.pixels, receiver)
    valid = pixel != 0xFFFFFFFF
    pixel = dr.select(valid, pixel, 0)
    jitter = mi.Point2f(random.next_float32(), random.next_float32())
    ray, _ = camera_rays(world, Float(pixel % world.width) + jitter.x, Float(pixel // world.width) + jitter.y)
    si, transmission, path, _ = first_opaque(world, ray, valid)
    hit = valid & si.is_valid()
    shares = hit & (dr.gather(Float, world.shares, shape_index(si), hit) > 0)
    late_m, point = Float(dr.inf if shared else 0), None
    if from_m is not None:
        point = point_of(si, ray, path, transmission, hit)
        late_m = late_from(world, point, from_m)
        shares &= shares_early(world)
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, random.next_float32(), mi.Point2f(*spread), hit)
    heads = Heads(receiver, kept(si), transmission, path, hit, shares, late_m, point)
    near = _joined(world, heads, lit, batch, first, joins)
    used = shared or (from_m is not None and shares_early(world))
    beyond = partial(_beyond, world, lit, batch, given)
    tails = _tails(world, heads, sample, weight[0], pixel, lit, joins, random, beyond, used=used)
    heads = receiver, parts_of(si), *map(_of_any_length, heads[2:-1]), None if point is None else tuple(point)
    tails = parts_of(tails.si), *map(_of_any_length, tails[1:])
    return heads, tuple(tuple(light) for light in near), tails, batch


def _of_any_length(values: Any) -> Any:
    """A constant as one entry: a recording would return it in the length of the launch that was recorded."""
    constant = dr.is_array_v(values) and values.state == dr.VarState.Literal
    return type(values)(values[0]) if constant else values


def _slots(world: World, lit: Lit | None, vertices: int) -> int:
    """How many lights a lane of `_beyond` may find."""
    return (2 if lit is not None and is_wide(world) else 1) * vertices


def shares_early(world: World) -> bool:
    """Whether blocks share what comes too early to be filtered: under a lamp that is little of the light."""
    return not is_wide(world)


def _lit(world: World, turns: Turns, lanes: int, batches: int, joins: int, numbers: np.ndarray) -> Lit | None:
    """Lit points of this launch alone."""
    if joins == 0:
        return None
    seeds = np.random.SeedSequence(numbers.tolist(), spawn_key=(int(turns.stream[0]), int(turns.round[0])))
    return lit_points(world, lanes, batches, tuple(dr.opaque(UInt32, int(key)) for key in seeds.generate_state(2)))


def _joined(world: World, heads: Heads, lit: Lit | None, batch: Any, first: Any, joins: int) -> tuple[Joined, ...]:
    """x1 joined to lit points, each of which has a share of their light. No loop: one would be a kernel of its own."""
    found = []
    for join in range(joins):
        light, path, direction = joined(
            world, heads.si, lit, batch, first + join, heads.valid, lambda path: copies_of(heads, path), joins
        )
        found.append(Joined(light * heads.transmission, path, direction))
    return tuple(found)


def copies_of(heads: Heads, path: Any) -> Any:
    """How many lobes look for light that has come so far from the laser to x1: those of the whole block, or one."""
    return dr.select(path < heads.early_m, Float(BLOCK), Float(1))


def _tails(
    world: World,
    heads: Heads,
    sample: Any,
    weight: Any,
    pixel: Any,
    lit: Lit | None,
    joins: int,
    random: Any,
    beyond: Callable[..., tuple[Any, ...]],
    *,
    used: bool,
) -> Tails:
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
    value *= left_to_paths(world, x1.p, direction, si, readable)
    value = dr.select(alive & dr.isfinite(value), own * value, 0)
    onward, onward_weight = si.bsdf().sample(
        context, si, random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32()), alive
    )
    onward_weight = onward_weight[0]
    joinable = Bool(alive)
    if used and world.has_rough_coats:
        joinable &= dr.gather(Float, world.rough_coats, shape_index(si), alive) == 0
    scale = dr.select(onward_weight > 0, onward_weight, 1)
    way = _Way(kept(si), onward, onward_weight, onward_weight / scale, 1 / scale, joinable, readable)
    soonest = dr.select(alive & (irradiance > 0), laser_path, dr.inf)
    light = beyond(way, alive, pixel, random, soonest)
    shared = alive & (dr.gather(Float, world.shares, shape_index(si), alive) > 0)
    shared &= heads.shares & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    return Tails(
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


class _Way(NamedTuple):
    """Where paths stand and how they go on: a sample of the surface's lobes and its weight. `through` is the factor of
    light that comes from there, `here` that of light reflected on the spot, reflectance counted in that light, and
    `joinable` says whether there is such; `readable` whether other paths bring a part of it (`render.glossy`)."""

    si: Any
    sample: Any
    weight: Any
    through: Any
    here: Any
    joinable: Any
    readable: Any


@dr.syntax
def _beyond(
    world: World,
    lit: Lit | None,
    batch: Any,
    given: _Given,
    way: _Way,
    active: Any,
    pixel: Any,
    random: Any,
    soonest: Any,
) -> tuple[Any, Any, Any, Any]:
    """Light of x3, x4, ... that goes to x2 along the way, divided by the density of the path after x2.

    Returns radiances and path lengths from x2 to the laser, flat arrays of slots x lanes. A vertex has a slot of its
    own, and one before it if the last one was joined to a lit point. Then how many slots each lane has filled, and the
    shortest path.
    """
    lanes, joining = dr.width(pixel), lit is not None and is_wide(world)
    lane, stride, last, values, paths = given.lane, given.lanes, given.slots, given.values, given.paths
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
        light *= left_to_paths(world, before.p, towards.d, si, active & way.readable)
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


def energy_by_bounces(
    world: World, pixels: np.ndarray, rounds: int, bounces: int, seed: int
) -> tuple[np.ndarray, float]:
    """Mean radiance, summed over the pixels, of light that met exactly 0, 1, ..., `bounces` surfaces (0 below 2).

    And its noise: squared contributions of a path in every pixel, summed over the pixels.
    """
    blocks = block_order(pixels, world.scene.camera.width)
    block = np.arange(len(blocks) // BLOCK)
    turns = turns_of(block, block, np.full(len(block), rounds))
    traced = trace_paths(world, blocks, turns, bounces, seed, 1, shared=False)
    tails, vertices = traced.tails, bounces - 2
    beyond = tails.own_onward.numpy() * tails.values.numpy().reshape(-1, dr.width(traced.batch))
    energy = np.zeros(bounces + 1)
    near = [part.numpy() for part in (tails.own_value, *(n.value for n in traced.joined))]
    energy[2] = sum(part.sum(dtype=np.float64) for part in near)
    noise = sum(float(np.square(part, dtype=np.float64).sum()) for part in (*near, beyond))
    by_slot = beyond.sum(axis=1, dtype=np.float64)
    energy[3:] = by_slot.reshape(max(vertices, 1), -1).sum(axis=1)[:vertices]
    return energy / rounds, noise / rounds
