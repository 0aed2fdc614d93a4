"""Paths of indirect light: camera paths whose tails are shared by the pixels around them, each connected to the laser.

A camera path meets x1, the first surface of its pixel, then x2, x3, ... and is connected to the laser at each of them.
What follows x1 is its tail. Pixels near each other form a block of T, and every pixel of the block uses the tails of
all: it sees T samples for the price of one path and T rays that test whether its x1 sees x2 (path reuse: Bekaert,
Sbert, Halton 2002, "Accelerating path tracing by re-using paths"). Weighted by the balance heuristic (Veach 1997,
eq. 9.8) the estimate stays unbiased: with F_i the integrand of pixel i over x2 and p_k the density, per area at x2,
with which pixel k samples x2 (0 where x2 is hidden from it),

    L_i = sum_j F_i(x2_j) / sum_k p_k(x2_j),

where tail j goes on in a direction that was sampled as seen from x1_j, so that beyond x2 the densities have the factor
p(w3 | x1_k, x2). Paths that leave x1 (or x2) by a mirror-like lobe, or whose x1 or x2 lies on plastic, are disjoint
from all others and stay their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from render.lit import Lit, _diffuse, by_chance, densities, density_of, joined, kept, lit_points
from render.rays import camera_rays, first_opaque, laser_light, segment, shape_index, spawn
from render.regions import Late, Point, Regions, point_of
from render.sums import Sums
from render.turns import BLOCK, Turns, block_order, turns_of
from render.world import Bool, Float, UInt32, World, dr, mi, upload

# Of one launch, 40 and 75 MB in its course. Python records a launch for as long as some 2^16 connections take.
LANES = 1 << 20  # connections
PATHS = 1 << 18
# Bits of the generalised golden ratio in two dimensions (real root of x^3 = x + 1), in units of 2^-32
GOLDEN = (3242174889, 2447445414)


class _Heads(NamedTuple):
    """x1 of every path of a launch and where it belongs; as a `point` of `render.regions`, if that is asked for."""

    receiver: Any
    si: Any
    transmission: Any
    path: Any
    valid: Any
    shares: Any
    diffuse: Any
    point: Point | None


class _Tails(NamedTuple):
    """x2 and beyond: light of the laser at x2; direction to x3; light from there on per path vertex, `length` of them.

    `direction` leads from x1 to x2, by a `diffuse` lobe or not.

    `own_weight` leads from x2 to the pixel, `own_onward` from x3; `shared` and `onward` say whether the pool may use
    the light at x2, and the light beyond.
    """

    si: Any
    to_laser: Any
    irradiance: Any
    laser_path: Any
    density: Any
    onward_direction: Any
    shared: Any
    onward: Any
    leg: Any
    own_transmission: Any
    own_value: Any
    own_onward: Any
    joined_value: Any
    joined_path: Any
    values: Any
    paths: Any
    length: Any
    direction: Any
    diffuse: Any


def add_paths(
    world: World,
    pixels: np.ndarray,
    turns: Turns,
    bounces: int,
    seed: int,
    sums: Sums,
    batches: int,
    *,
    shared: bool,
    regions: Regions | None = None,
) -> None:
    """Trace paths of the given blocks of flat pixels (-1: none) and add their light to `sums`; `shared` by blocks.

    With `regions` late light goes there instead, to be read from them when all paths are traced.
    """
    heads, tails, batch = _trace(world, pixels, turns, bounces, seed, batches, shared=shared, points=bool(regions))
    if regions:
        regions.count_paths(heads.point)
        sums = Late(regions, sums, heads.point, tails.direction, tails.diffuse)
    _add_own(heads, tails, batch, sums, shared)
    if shared:
        head, tail = _pairs(dr.width(batch))
        _add_pairs(tails, head, tail, _weights(world, heads, tails, head, tail), heads, batch, sums)
    sums.evaluate()


def noise_of_paths(
    world: World, pixels: np.ndarray, turns: Turns, bounces: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sum of the squared contributions of one path to each pixel, own and shared; (turns, BLOCK) each.

    Histograms of paths that fall into different bins have this variance.
    """
    heads, tails, batch = _trace(world, pixels, turns, bounces, seed, 1, shared=True)
    lanes = dr.width(batch)
    values = tails.values.numpy().reshape(-1, lanes)[: 2 * (bounces - 2)].astype(np.float64)
    beyond = (values**2).sum(axis=0)
    first = tails.joined_value.numpy().astype(np.float64) ** 2
    own = first + tails.own_value.numpy().astype(np.float64) ** 2 + tails.own_onward.numpy().astype(np.float64) ** 2 * beyond
    head, tail = _pairs(lanes)
    _, value, weight = _weights(world, heads, tails, head, tail)
    power = value.numpy().astype(np.float64) ** 2
    power += weight.numpy().astype(np.float64) ** 2 * np.repeat(beyond, BLOCK)
    shared = np.nan_to_num(power.reshape(-1, BLOCK, BLOCK)).sum(axis=1) + first.reshape(-1, BLOCK)
    if world.has_own:
        alone, onward = ~tails.shared.numpy().astype(bool), ~tails.onward.numpy().astype(bool)
        mirrored = np.where(alone, tails.own_value.numpy(), 0).astype(np.float64) ** 2
        mirrored += np.where(onward, tails.own_onward.numpy(), 0).astype(np.float64) ** 2 * beyond
        shared += mirrored.reshape(-1, BLOCK)
    return np.nan_to_num(own).reshape(-1, BLOCK), shared


def _pairs(lanes: int) -> tuple[Any, Any]:
    """Head and tail of every pair: neighbours in a block are neighbours in the launch, which keeps rays coherent."""
    pair = dr.arange(UInt32, lanes * BLOCK)
    tail = pair // BLOCK
    return tail // BLOCK * BLOCK + pair % BLOCK, tail


def _trace(
    world: World,
    pixels: np.ndarray,
    turns: Turns,
    bounces: int,
    seed: int,
    batches: int,
    *,
    shared: bool,
    points: bool = False,
) -> tuple[_Heads, _Tails, Any]:
    lanes = len(turns.block) * BLOCK
    lane = dr.arange(UInt32, lanes)
    turn, member = lane // BLOCK, lane % BLOCK
    block, stream, round_index, stride = (dr.gather(UInt32, upload(UInt32, column), turn) for column in turns)
    receiver = block * BLOCK + member
    pixels = upload(UInt32, pixels.astype(np.int64) & 0xFFFFFFFF)
    numbers = np.random.SeedSequence(seed).generate_state(4)
    keys = [dr.opaque(UInt32, int(key)) for key in numbers[:2]]
    first = np.random.SeedSequence(numbers[2:], spawn_key=(int(turns.stream[0]), int(turns.round[0])))
    lit = lit_points(world, lanes, batches, tuple(dr.opaque(UInt32, int(key)) for key in first.generate_state(2)))
    batches = dr.opaque(UInt32, batches)
    batch = round_index % batches
    if shared:
        # one random shift a block and round; the members share a low-discrepancy set of first directions
        shift = mi.sample_tea_32(stream, round_index ^ keys[0])
        spread = [Float((s + member * g) >> 8) * 2.0**-24 for s, g in zip(shift, GOLDEN, strict=True)]
    else:
        # one randomised (0, 2)-sequence a block and batch (Sobol 1967): the rounds of each member are an aligned run of
        # it, and as even as those of all
        shift = mi.sample_tea_32(stream, batch ^ keys[0])
        number = member * stride + round_index // batches
        spread = mi.radical_inverse_2(number, shift[0]), mi.sobol_2(number, shift[1])
    # a hash of block, member and round numbers the streams, whichever launch they run in
    lane_key = mi.sample_tea_32(stream * BLOCK + member, round_index ^ keys[1])
    random = mi.PCG32(initstate=mi.UInt64(lane_key[0]), initseq=mi.UInt64(lane_key[1]))
    pixel = dr.gather(UInt32, pixels, receiver)
    valid = pixel != 0xFFFFFFFF
    pixel = dr.select(valid, pixel, 0)
    jitter = mi.Point2f(random.next_float32(), random.next_float32())
    ray, _ = camera_rays(world, Float(pixel % world.width) + jitter.x, Float(pixel // world.width) + jitter.y)
    si, transmission, path, _ = first_opaque(world, ray, valid)
    hit = valid & si.is_valid()
    shares = hit & (dr.gather(Float, world.shares, shape_index(si), hit) > 0)
    context = mi.BSDFContext()
    sample, weight = si.bsdf().sample(context, si, random.next_float32(), mi.Point2f(*spread), hit)
    point = point_of(si, ray, path, transmission, hit) if points else None
    alive = hit & (weight[0] > 0)
    diffuse = alive & mi.has_flag(sample.sampled_type, mi.BSDFFlags.DiffuseReflection)
    heads = _Heads(receiver, kept(si), transmission + dr.zeros(Float, lanes), path, hit, shares, diffuse, point)
    # a head that shares has as many lobes as its block
    copies = dr.select(shares, BLOCK, 1) if shared else 1
    number = random.next_uint32() if shared else member * stride + round_index // batches + stream * 2654435769
    joined_value, joined_path = joined(world, si, lit, batch, number, hit, copies)
    before, start, towards = heads.si, mi.Point3f(si.p), si.to_world(sample.wo)
    si, passed, leg, _ = first_opaque(world, spawn(si, towards), alive, start)
    alive &= si.is_valid()
    own = dr.select(alive, transmission * weight[0] * passed, 0)
    to_laser, irradiance, laser_path = laser_light(world, si, pixel, alive, seen_by_camera=None)
    density = density_of(world, si, to_laser)
    value = si.bsdf().eval(context, si, si.to_local(to_laser), alive)[0] * irradiance
    value *= by_chance(world, before, sample, weight[0], si, density, copies, alive)
    shares = shares & (dr.gather(Float, world.shares, shape_index(si), alive) > 0)
    spread_lobe = ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    onward, onward_weight = si.bsdf().sample(
        context, si, random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32()), alive
    )
    spread_onward = ~mi.has_flag(onward.sampled_type, mi.BSDFFlags.Delta)
    direction = si.to_world(onward.wo)
    scale = dr.select(onward_weight[0] > 0, onward_weight[0], 1)
    may = Bool(True)
    if shared and world.has_rough_coats:
        may = dr.gather(Float, world.rough_coats, shape_index(si), alive) == 0
    way = _Way(kept(si), onward, onward_weight[0] / scale, 1 / scale, onward_weight[0], may & alive)
    values, paths, length = _beyond(world, lit, batch, way, alive, pixel, random, bounces - 2)
    tails = _Tails(
        si=kept(si),
        to_laser=to_laser,
        irradiance=dr.select(alive, irradiance, 0),
        laser_path=laser_path,
        density=density,
        onward_direction=direction,
        shared=alive & shares & spread_lobe,
        onward=alive & shares & spread_lobe & spread_onward & (onward_weight[0] > 0),
        leg=leg,
        own_transmission=dr.select(alive, passed, 0),
        own_value=dr.select(alive & dr.isfinite(value), own * value, 0),
        own_onward=own * scale,
        joined_value=joined_value * transmission,
        joined_path=joined_path,
        values=values,
        paths=paths,
        length=length,
        direction=towards if points else None,
        diffuse=diffuse if points else None,
    )
    dr.eval(*heads, *tails, batch)
    return heads, tails, batch


class _Way(NamedTuple):
    """Where paths stand and how they go on: a sample of direction and its weight; light that arrives so from there is
    to be multiplied by `throughput`, light that arrives otherwise, reflectance included, by `arrived`."""

    si: Any
    sample: Any
    throughput: Any
    arrived: Any
    weight: Any
    may: Any


@dr.syntax
def _beyond(
    world: World, lit: Lit, batch: Any, way: _Way, active: Any, pixel: Any, random: Any, vertices: int
) -> tuple[Any, Any, Any]:
    """Light of x3, x4, ... that goes to x2 along the way, divided by the density of the path after x2.

    Returns radiances and path lengths from x2 to the laser, flat arrays of 2 vertices x lanes: of each vertex, joined
    and by chance. And how many of these each lane has.
    """
    lanes = dr.width(pixel)
    slots = lanes * 2 * max(vertices, 1)
    values, paths = dr.zeros(Float, slots), dr.zeros(Float, slots)
    lane, stride = dr.arange(UInt32, lanes), dr.opaque(UInt32, lanes)
    last = dr.opaque(UInt32, 2 * vertices)
    slot, path = dr.zeros(UInt32, lanes), dr.zeros(Float, lanes)
    si, sample, throughput, arrived, weight, may = way
    sample, weight = mi.BSDFSample3f(sample), Float(weight)
    throughput, arrived, may = Float(throughput), Float(arrived), Bool(may)
    active = Bool(active) & (slot < last)
    while active:
        light, leg = joined(world, si, lit, batch, random.next_uint32(), active & may, 1)
        dr.scatter(paths, path + leg, slot * stride + lane, active)
        dr.scatter(values, arrived * light, slot * stride + lane, active)
        slot += 1
        going = active & (weight > 0)
        direction = si.to_world(sample.wo)
        ray, before = spawn(si, direction), kept(si)
        si, passed, optical, _ = first_opaque(world, ray, going, before.p)
        path += optical
        active = going & si.is_valid()
        to_laser, irradiance, leg = laser_light(world, si, pixel, active, seen_by_camera=None)
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(to_laser), active)[0] * irradiance
        density = density_of(world, si, to_laser)
        value *= dr.select(may, by_chance(world, before, sample, weight, si, density, 1, active), 1)
        may = Bool(True) | active
        dr.scatter(paths, path + leg, slot * stride + lane, active)
        dr.scatter(values, dr.select(dr.isfinite(value), throughput * passed * value, 0), slot * stride + lane, active)
        slot += 1
        active &= slot < last
        arrived = throughput * passed
        sample, onward = si.bsdf().sample(
            mi.BSDFContext(),
            si,
            random.next_float32(),
            mi.Point2f(random.next_float32(), random.next_float32()),
            active,
        )
        weight = onward[0]
        throughput = arrived * weight
        # Russian roulette: paths that carry little end early, the others carry their energy on
        survive = dr.clip(dr.select(weight > 0, throughput, arrived), 0.05, 0.95)
        active &= (arrived > 0) & (random.next_float32() < survive)
        throughput /= survive
        arrived /= survive
    return values, paths, slot


def _add_own(heads: _Heads, tails: _Tails, batch: Any, sums: Sums, shared: bool) -> None:
    """Light that a pixel gets from its own path alone."""
    first, onward = Bool(heads.valid), Bool(heads.valid)
    if shared:
        first, onward = first & ~tails.shared, onward & ~tails.onward
    light = _Light(
        heads.receiver,
        batch,
        dr.arange(UInt32, dr.width(batch)),
        heads.path + tails.leg,
        dr.select(first, tails.own_value, 0),
        dr.select(onward, tails.own_onward, 0),
        tails.joined_value,
        heads.path + tails.joined_path,
    )
    _add(light, tails, sums)


def energy_by_bounces(world: World, pixels: np.ndarray, rounds: int, bounces: int, seed: int) -> np.ndarray:
    """Mean radiance, summed over the pixels, of light that met exactly 0, 1, ..., `bounces` surfaces (0 below 2)."""
    blocks = block_order(pixels, world.scene.camera.width)
    block = np.arange(len(blocks) // BLOCK)
    turns = turns_of(block, block, np.full(len(block), rounds))
    _, tails, batch = _trace(world, blocks, turns, bounces, seed, 1, shared=False)
    beyond = tails.own_onward.numpy() * tails.values.numpy().reshape(-1, dr.width(batch))
    energy = np.zeros(bounces + 1)
    energy[2] = tails.own_value.numpy().sum(dtype=np.float64)
    energy[2] += tails.joined_value.numpy().sum(dtype=np.float64)
    energy[3:] = beyond[: 2 * (bounces - 2)].sum(axis=1, dtype=np.float64).reshape(-1, 2).sum(axis=1)
    return energy / rounds


class _Connections(NamedTuple):
    """Of every pair: leg x1 to x2 [m], pixel radiance from x2's laser light and from beyond, and their densities."""

    leg: Any
    value: Any
    onward: Any
    density: Any
    onward_density: Any


def _connect(world: World, heads: _Heads, tails: _Tails, head: Any, tail: Any) -> _Connections:
    shared = dr.gather(Bool, tails.shared, tail) & dr.gather(Bool, heads.shares, head)
    si1 = dr.gather(mi.SurfaceInteraction3f, heads.si, head, shared)
    si2 = dr.gather(mi.SurfaceInteraction3f, tails.si, tail, shared)
    offset = si2.p - si1.p
    distance2 = dr.squared_norm(offset)
    direction = offset * dr.rsqrt(distance2)
    passed, leg = segment(world, si1, si2.p, shared)
    # a tail is seen from where it came, whatever rounding says
    own = head == tail
    passed = dr.select(own, dr.gather(Float, tails.own_transmission, tail, shared), passed)
    leg = dr.select(own, dr.gather(Float, tails.leg, tail, shared), leg)
    active = shared & (passed > 0) & (distance2 > 0)
    context = mi.BSDFContext()
    value1, density1 = si1.bsdf().eval_pdf(context, si1, si1.to_local(direction), active)
    si2.wi = si2.to_local(-direction)
    to_laser = si2.to_local(_gather_vector(tails.to_laser, tail, active))
    value2 = si2.bsdf().eval(context, si2, to_laser, active)[0]
    irradiance = dr.gather(Float, tails.irradiance, tail, active)
    going = active & dr.gather(Bool, tails.onward, tail, active)
    onward = si2.to_local(_gather_vector(tails.onward_direction, tail, going))
    value3, density3 = si2.bsdf().eval_pdf(context, si2, onward, going)
    area = dr.abs(dr.dot(si2.n, direction)) / distance2
    reach = dr.gather(Float, heads.transmission, head, active) * value1[0] * area * passed
    lit_density = dr.gather(Float, tails.density, tail, active)
    lobes, both = densities(
        dr.dot(si1.sh_frame.n, direction), distance2, dr.dot(si2.n, direction), lit_density, BLOCK
    )
    if world.has_rough_coats:
        diffuse = si1.bsdf().eval(_diffuse(), si1, si1.to_local(direction), active)[0] / value1[0]
        diffuse = dr.select(value1[0] > 0, dr.clip(diffuse, 0, 1), 0)
    else:
        diffuse = dr.select(dr.gather(Bool, heads.diffuse, head, active), Float(1), 0)
    kept_share = 1 - diffuse * dr.select(both > 0, 1 - lobes / both, 0)
    density = dr.select(active, density1 * area, 0)
    connections = _Connections(
        leg,
        dr.select(active, reach * value2 * irradiance * kept_share, 0),
        dr.select(going, reach * value3[0], 0),
        density,
        dr.select(going, density * density3, 0),
    )
    dr.eval(*connections)
    return connections


def _weights(world: World, heads: _Heads, tails: _Tails, head: Any, tail: Any) -> tuple[Any, Any, Any]:
    """Of every pair: leg from x1 to x2 [m], radiance of x2's laser light, factor of what lies beyond x2."""
    made = _connect(world, heads, tails, head, tail)
    density, onward_density = dr.block_sum(made.density, BLOCK), dr.block_sum(made.onward_density, BLOCK)
    dr.eval(density, onward_density)
    density, onward_density = dr.gather(Float, density, tail), dr.gather(Float, onward_density, tail)
    first = dr.select(density > 0, made.value / density, 0)
    weight = dr.select(onward_density > 0, made.onward / onward_density, 0)
    return made.leg, first, weight


def _add_pairs(
    tails: _Tails,
    head: Any,
    tail: Any,
    weights: tuple[Any, Any, Any],
    heads: _Heads,
    batch: Any,
    sums: Sums,
) -> None:
    """Light that every pixel of a block gets from every tail of the block."""
    leg, first, weight = weights
    base = dr.gather(Float, heads.path, head) + leg
    receiver, turn = dr.gather(UInt32, heads.receiver, head), dr.gather(UInt32, batch, tail)
    _add(_Light(receiver, turn, tail, base, first, weight), tails, sums)


class _Light(NamedTuple):
    """What lanes add to their pixels: path to x2, radiance of x2's laser light, factor of light beyond."""

    receiver: Any
    batch: Any
    tail: Any
    base: Any
    first: Any
    weight: Any
    joined: Any = None
    joined_path: Any = None


@dr.syntax
def _add(light: _Light, tails: _Tails, sums: Sums) -> None:
    receiver, batch, tail, base, first, weight, also, also_path = light
    laser_path = dr.gather(Float, tails.laser_path, tail)
    values, paths = tails.values, tails.paths
    stride, last = dr.opaque(UInt32, dr.width(tails.leg)), dr.gather(UInt32, tails.length, tail)
    turn, total = dr.zeros(UInt32, dr.width(tail)), dr.zeros(Float, dr.width(tail))
    going = (first > 0) | (weight > 0)
    if dr.hint(also is not None, mode="scalar"):
        going |= also > 0
    # x2's own light is the loop's first turn: additions before a loop would cost a kernel of their own
    while going:
        beyond = going & (turn > 0)
        slot = (turn - 1) * stride + tail
        if dr.hint(also is not None, mode="scalar"):
            beyond &= turn > 1
            slot -= stride
        radiance = dr.select(beyond, weight * dr.gather(Float, values, slot, beyond), first)
        path = base + dr.select(beyond, dr.gather(Float, paths, slot, beyond), laser_path)
        if dr.hint(also is not None, mode="scalar"):
            radiance = dr.select(turn == 1, also, radiance)
            path = dr.select(turn == 1, also_path, path)
        total += sums.add(receiver, batch, path, radiance, going)
        if dr.hint(also is not None, mode="scalar"):
            going &= (turn == 0) | ((turn < last + 1) & (weight > 0))
        else:
            going &= (turn < last) & (weight > 0)
        turn += 1
    sums.add_total(receiver, batch, total)


def _gather_vector(source: Any, index: Any, active: Any) -> Any:
    return mi.Vector3f(*(dr.gather(Float, component, index, active) for component in source))
