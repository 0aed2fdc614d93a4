"""Paths of indirect light: from the camera over surfaces, every vertex of them connected to the laser.

A camera path meets x1, the first surface of its pixel, then x2, x3, ... What the laser does at each of them is added to
the pixel, and so is what one point lit by the laser does there (`render.indirect.light_vertices`). What follows x1 is
the path's suffix: the pixels around it may use it, too (`render.indirect.reuse`).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, UInts
from render.indirect.glossy import camera_share, finite_ratio, glossy_of
from render.indirect.launch_layout import (
    BLOCK,
    LaunchLayout,
    aligned_number,
    block_order,
    make_launch,
    own_directions,
    positions_in_pixel,
    sample_order,
    shared_directions,
    traced_members,
)
from render.indirect.light_vertices import (
    Connection,
    JoinedVertex,
    LightVertices,
    Scattered,
    connections_per_vertex,
    connects_suffixes,
    sample_light_vertices,
)
from render.indirect.path_space_filter import Point, late_from, point_of
from render.indirect.path_suffixes import PathSuffixes, Slots, SuffixTask, slots_for, trace_suffixes
from render.indirect.primary_vertices import PrimaryVertices, connect_primary_vertices, reuses_early_paths
from render.scene.rays import (
    PLAIN_GOLDEN,
    camera_rays,
    first_opaque,
    interaction_from_parts,
    kept,
    parts_of,
    shape_index,
)
from render.scene.traced_scene import Float, TracedScene, UInt32, dr, mi, upload


class PathBatch(NamedTuple):
    """Paths of a launch, the light vertices that they were connected to, and the batch that each path belongs to.

    `retro` is light that comes back over x1 (`render.indirect.retro_paths`), one connection or none.
    """

    primary: PrimaryVertices
    connections: tuple[Connection, ...]
    retro: tuple[Connection, ...]
    suffixes: PathSuffixes
    light_vertices: LightVertices | None
    batch: UInts


class PathTask(NamedTuple):
    """Configuration of one launch: a path in every pixel of every block.

    pixels        flat pixels, block by block (-1: none)
    launch        which block has which sample
    batches       sample s of a block belongs to batch s modulo this
    reuses_paths  whether the pixels of a block use each other's suffixes
    from_m        light so far behind direct light is filtered [m], None: none is; of earlier light, suffixes are reused
                  if `reuses_early_paths`
    """

    world: TracedScene
    pixels: np.ndarray
    launch: LaunchLayout
    bounces: int
    seed: int
    batches: int = 1
    reuses_paths: bool = False
    from_m: Floats = None


def trace_paths(task: PathTask) -> PathBatch:
    """Trace the camera paths of one launch, and connect their vertices to light vertices."""
    world, pixels, launch, bounces, seed, batches, reuses_paths, from_m = task
    glossy_of(world)  # looked for before anything is recorded
    members = traced_members(pixels, shared=reuses_paths or from_m is not None)
    lanes = len(launch.block) * members
    seeds = np.random.SeedSequence(seed).generate_state(4)
    connections = connections_per_vertex(world, reuses_paths=reuses_paths)
    light_vertices = _sample_light_vertices(world, launch, lanes, batches, connections, seeds[2:])
    given = _Given(
        tuple(slots_for(world, light_vertices, lanes, bounces - 2)),
        upload(UInt32, np.append(np.stack(launch, axis=1), (0, 0))),
        upload(UInt32, np.append(pixels.astype(np.int64) & 0xFFFFFFFF, 0)),
        tuple(dr.opaque(UInt32, int(number)) for number in seeds[:2]),
        dr.opaque(UInt32, batches),
        None if light_vertices is None else tuple(light_vertices),
        from_m,
    )
    work = partial(_paths, reuses_paths=reuses_paths, connections=connections, members=members)
    key = "paths", reuses_paths, connections, members, connects_suffixes(world)
    primary, near, retro, suffixes, batch = world.recordings.call(world, key, work, *given)
    late_m = dr.full(Float, dr.inf if reuses_paths else 0, lanes) if from_m is None else primary[-2]
    point = None if from_m is None else Point(*primary[-1])
    return PathBatch(
        PrimaryVertices(primary[0], interaction_from_parts(primary[1]), *primary[2:-2], late_m, point),  # type: ignore[call-arg]
        tuple(Connection(*light) for light in near),
        tuple(Connection(*light) for light in retro),
        PathSuffixes(  # type: ignore[call-arg]
            interaction_from_parts(suffixes[0]),
            *suffixes[1:-1],
            None if suffixes[-1] is None else JoinedVertex(*suffixes[-1]),
        ),
        light_vertices,
        batch,
    )


class _Given(NamedTuple):
    """Inputs of the path tracing kernel, as arrays: `Slots`; `LaunchLayout`, the numbers of a block's sample together;
    flat pixels; keys of the random numbers; the number of batches; the parts of `LightVertices`; and from where on
    light is filtered [m], or None.

    Dr.Jit records anew where two inputs have one size that had not before: there are 16 n lanes (of a single block as
    many as it has pixels), 4 n + 2 numbers of the layout, 16 n + 1 pixels and 2^n + 3 light vertices.
    """

    slots: tuple
    launch: UInts
    pixels: UInts
    keys: tuple
    batches: UInts
    light_vertices: tuple | None
    from_m: Floats


def _paths(
    world: TracedScene, *given: Array, reuses_paths: bool, connections: int, members: int
) -> tuple[tuple, tuple, tuple, tuple, Array]:
    """Trace the parts of `PathBatch`, in plain tuples, which recordings look into."""
    given = _Given(*given)
    slots, keys, from_m = Slots(*given.slots), given.keys, given.from_m
    light_vertices = None if given.light_vertices is None else LightVertices(*given.light_vertices)
    row, member = slots.lane // members, slots.lane % members
    block, stream, sample_index, per_batch = (dr.gather(UInt32, given.launch, 4 * row + part) for part in range(4))
    batch, order = sample_order(sample_index, given.batches, per_batch)
    # a hash of block, member and sample index numbers the streams, whichever launch they run in
    lane_key = mi.sample_tea_32(stream * BLOCK + member, sample_index ^ keys[1])
    random = mi.PCG32(initstate=mi.UInt64(lane_key[0]), initseq=mi.UInt64(lane_key[1]))
    if reuses_paths:
        spread = shared_directions(stream, member, order, keys[0])
        # the members share their light vertices: rays to these are neighbours
        first = mi.sample_tea_32(stream, sample_index ^ keys[1])[0]
    else:
        number = aligned_number(member, sample_index, given.batches, per_batch)
        spread = own_directions(stream, batch, number, keys[0])
        first = (number + stream * PLAIN_GOLDEN) * connections
    receiver = block * BLOCK + member
    pixel = dr.gather(UInt32, given.pixels, receiver)
    valid = pixel != 0xFFFFFFFF
    pixel = dr.select(valid, pixel, 0)
    column, line = positions_in_pixel(stream, member, order, keys[0])
    ray, _ = camera_rays(world, Float(pixel % world.width) + column, Float(pixel // world.width) + line)
    si, transmission, path, _ = first_opaque(world, ray, valid)
    hit = valid & si.is_valid()
    allows_reuse = hit & (dr.gather(Float, world.allows_reuse, shape_index(si), hit) > 0)
    late_m, point = Float(dr.inf if reuses_paths else 0), None
    if from_m is not None:
        point = point_of(si, ray, path, transmission, hit)
        late_m = late_from(world, point, from_m)
        allows_reuse &= reuses_early_paths(world)
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, random.next_float32(), mi.Point2f(*spread), hit)
    primary = PrimaryVertices(receiver, kept(si), transmission, path, hit, allows_reuse, late_m, point)
    near = connect_primary_vertices(world, primary, light_vertices, batch, first, connections)
    reused = reuses_paths or (from_m is not None and reuses_early_paths(world))
    task = SuffixTask(light_vertices, connections, batch, pixel, random, slots, reused)
    suffixes, retro = trace_suffixes(world, primary, Scattered(sample, weight[0]), task)
    of_primary = receiver, parts_of(si), *map(_of_any_length, primary[2:-1]), None if point is None else tuple(point)
    joined = None if suffixes.joined is None else tuple(map(_of_any_length, suffixes.joined))
    of_suffixes = parts_of(suffixes.si), *map(_of_any_length, suffixes[1:-1]), joined
    lights = (tuple(tuple(light) for light in connections) for connections in (near, retro))
    return of_primary, *lights, of_suffixes, batch


def _of_any_length(values: Floats) -> Array:
    """Shorten a constant to one entry: a recording would return it in the length of the launch that was recorded."""
    constant = dr.is_array_v(values) and values.state == dr.VarState.Literal
    return type(values)(values[0]) if constant else values


def _sample_light_vertices(
    world: TracedScene, launch: LaunchLayout, lanes: int, batches: int, connections: int, numbers: np.ndarray
) -> LightVertices | None:
    """Sample light vertices for this launch alone."""
    if connections == 0:
        return None
    seeds = np.random.SeedSequence(numbers.tolist(), spawn_key=(int(launch.stream[0]), int(launch.sample_index[0])))
    return sample_light_vertices(
        world, lanes, batches, tuple(dr.opaque(UInt32, int(key)) for key in seeds.generate_state(2))
    )


def energy_by_bounces(
    world: TracedScene, pixels: np.ndarray, spp: int, bounces: int, seed: int
) -> tuple[np.ndarray, float]:
    """Return mean radiance, summed over the pixels, of light that met exactly 0, 1, ..., `bounces` surfaces (0 below
    2).

    And its noise: squared contributions of a path in every pixel, summed over the pixels.
    """
    blocks = block_order(pixels, world.scene.camera.width)
    block = np.arange(len(blocks) // BLOCK)
    launch = make_launch(block, block, np.full(len(block), spp))
    traced = trace_paths(PathTask(world, blocks, launch, bounces, seed))
    suffixes, vertices = traced.suffixes, bounces - 2
    beyond = suffixes.own_onward.numpy() * suffixes.values.numpy().reshape(-1, dr.width(traced.batch))
    if suffixes.ratios is not None:
        lanes = dr.arange(UInt32, dr.width(suffixes.ratios)) % dr.width(traced.batch)
        ratio = finite_ratio(suffixes.ratios * dr.gather(Float, suffixes.own_ratio, lanes))
        if suffixes.own_retro is not None:
            first = dr.arange(UInt32, dr.width(suffixes.ratios)) < dr.width(traced.batch)
            ratio += dr.gather(Float, suffixes.own_retro, lanes, first)
        beyond *= camera_share(ratio).numpy().reshape(beyond.shape)
    energy = np.zeros(bounces + 1)
    near = [part.numpy() for part in (suffixes.own_value, *(n.value for n in traced.connections))]
    energy[2] = sum(part.sum(dtype=np.float64) for part in near)
    noise = sum(float(np.square(part, dtype=np.float64).sum()) for part in (*near, beyond))
    back = [light.value.numpy() for light in traced.retro]
    noise += sum(float(np.square(part, dtype=np.float64).sum()) for part in back)
    by_slot = beyond.sum(axis=1, dtype=np.float64)
    energy[3:] = by_slot.reshape(max(vertices, 1), -1).sum(axis=1)[:vertices]
    energy[3:4] += sum(part.sum(dtype=np.float64) for part in back)
    return energy / spp, noise / spp
