"""Paths of indirect light: from the camera over surfaces, every vertex of them connected to the laser.

A camera path meets x1, the first surface of its pixel, then x2, x3, ... What the laser does at each of them is added to
the pixel, and so is what one point lit by the laser does there (`render.indirect.light_vertices`). What follows x1 is
the path's tail: the pixels around it may use it, too (`render.indirect.reuse`).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from render.indirect.glossy import glossy_of
from render.indirect.launch_layout import BLOCK, LaunchLayout, block_order, make_launch
from render.indirect.light_vertices import (
    LightVertices,
    connections_per_vertex,
    is_wide,
    sample_light_vertices,
)
from render.indirect.path_space_filter import Point, late_from, point_of
from render.indirect.path_suffixes import PathSuffixes, Slots, slots_for, tails_of
from render.indirect.primary_vertices import Joined, PrimaryVertices, join_heads, shares_early
from render.scene.rays import camera_rays, first_opaque, kept, of_parts, parts_of, shape_index
from render.scene.traced_scene import Float, TracedScene, UInt32, dr, mi, upload

# Bits of the generalised golden ratio in two dimensions (real root of x^3 = x + 1), in units of 2^-32; and of the plain
GOLDEN = (3242174889, 2447445414)
PLAIN_GOLDEN = 2654435769


class PathBatch(NamedTuple):
    """Paths of a launch, the lit points that they were joined to, and the batch that each path belongs to."""

    heads: PrimaryVertices
    joined: tuple[Joined, ...]
    tails: PathSuffixes
    lit: LightVertices | None
    batch: Any


def trace_paths(
    world: TracedScene,
    pixels: np.ndarray,
    turns: LaunchLayout,
    bounces: int,
    seed: int,
    batches: int,
    *,
    shared: bool,
    from_m: Any = None,
) -> PathBatch:
    """Trace a path for every member of every turn.

    Blocks share their tails if they are `shared`; for light less than `from_m` behind direct light if `shares_early`.
    """
    glossy_of(world)  # looked for before anything is recorded
    lanes = len(turns.block) * BLOCK
    seeds = np.random.SeedSequence(seed).generate_state(4)
    joins = connections_per_vertex(world, shared=shared)
    lit = _lit(world, turns, lanes, batches, joins, seeds[2:])
    given = _Given(
        tuple(slots_for(world, lit, lanes, bounces - 2)),
        upload(UInt32, np.append(np.stack(turns, axis=1), (0, 0))),
        upload(UInt32, np.append(pixels.astype(np.int64) & 0xFFFFFFFF, 0)),
        tuple(dr.opaque(UInt32, int(number)) for number in seeds[:2]),
        dr.opaque(UInt32, batches),
        None if lit is None else (parts_of(lit.si), *lit[1:]),
        from_m,
    )
    work = partial(_paths, shared=shared, joins=joins)
    key = "paths", shared, joins, is_wide(world)
    heads, near, tails, batch = world.recordings.call(world, key, work, *given)
    late_m = dr.full(Float, dr.inf if shared else 0, lanes) if from_m is None else heads[-2]
    point = None if from_m is None else Point(*heads[-1])
    return PathBatch(
        PrimaryVertices(heads[0], of_parts(heads[1]), *heads[2:-2], late_m, point),
        tuple(Joined(*light) for light in near),
        PathSuffixes(of_parts(tails[0]), *tails[1:]),
        lit,
        batch,
    )


class _Given(NamedTuple):
    """What paths are traced from, as arrays: `Slots`; `LaunchLayout`, those of a turn together; flat pixels; keys of
    the random numbers; how many batches there are; the parts of `LightVertices`; and from where on light is filtered
    [m], or None.

    Dr.Jit records anew where two inputs have one size that had not before: there are 16 n lanes, 4 n + 2 numbers of
    turns, 16 n + 1 pixels and 2^n + 3 lit points.
    """

    slots: tuple
    turns: Any
    pixels: Any
    keys: tuple
    batches: Any
    lit: tuple | None
    from_m: Any


def _paths(world: TracedScene, *given: Any, shared: bool, joins: int) -> tuple[tuple, tuple, tuple, Any]:
    """The parts of `PathBatch`, in plain tuples, which recordings look into."""
    given = _Given(*given)
    slots, keys, from_m = Slots(*given.slots), given.keys, given.from_m
    lit = None if given.lit is None else LightVertices(of_parts(given.lit[0]), *given.lit[1:])
    turn, member = slots.lane // BLOCK, slots.lane % BLOCK
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
    heads = PrimaryVertices(receiver, kept(si), transmission, path, hit, shares, late_m, point)
    near = join_heads(world, heads, lit, batch, first, joins)
    used = shared or (from_m is not None and shares_early(world))
    tails = tails_of(world, heads, sample, weight[0], pixel, lit, joins, batch, random, slots, used=used)
    heads = receiver, parts_of(si), *map(_of_any_length, heads[2:-1]), None if point is None else tuple(point)
    tails = parts_of(tails.si), *map(_of_any_length, tails[1:])
    return heads, tuple(tuple(light) for light in near), tails, batch


def _of_any_length(values: Any) -> Any:
    """A constant as one entry: a recording would return it in the length of the launch that was recorded."""
    constant = dr.is_array_v(values) and values.state == dr.VarState.Literal
    return type(values)(values[0]) if constant else values


def _lit(
    world: TracedScene, turns: LaunchLayout, lanes: int, batches: int, joins: int, numbers: np.ndarray
) -> LightVertices | None:
    """Lit points of this launch alone."""
    if joins == 0:
        return None
    seeds = np.random.SeedSequence(numbers.tolist(), spawn_key=(int(turns.stream[0]), int(turns.round[0])))
    return sample_light_vertices(
        world, lanes, batches, tuple(dr.opaque(UInt32, int(key)) for key in seeds.generate_state(2))
    )


def energy_by_bounces(
    world: TracedScene, pixels: np.ndarray, rounds: int, bounces: int, seed: int
) -> tuple[np.ndarray, float]:
    """Mean radiance, summed over the pixels, of light that met exactly 0, 1, ..., `bounces` surfaces (0 below 2).

    And its noise: squared contributions of a path in every pixel, summed over the pixels.
    """
    blocks = block_order(pixels, world.scene.camera.width)
    block = np.arange(len(blocks) // BLOCK)
    turns = make_launch(block, block, np.full(len(block), rounds))
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
