"""Light of paths, added up: each pixel's own, and what the pixels of a block get by each other's tails.

Pixels near each other form a block of T, and every pixel of the block uses the tails of all: it sees T samples for the
price of one path and T rays that test whether its x1 sees x2 (path reuse: Bekaert, Sbert, Halton 2002, "Accelerating
path tracing by re-using paths"). Weighted by the balance heuristic (Veach 1997, eq. 9.8) the estimate stays unbiased:
with F_i the integrand of pixel i over x2 and p_k the density, per area at x2, with which pixel k samples x2 (0 where x2
is hidden from it),

    L_i = sum_j F_i(x2_j) / sum_k p_k(x2_j),

where tail j goes on in a direction that was sampled as seen from x1_j, so that beyond x2 the densities have the factor
p(w3 | x1_k, x2). Paths that leave x1 (or x2) by a mirror-like lobe, or whose x1 or x2 lies on smooth plastic, are
disjoint from all others and stay their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from render.indirect.accumulators import IndirectAccumulator
from render.indirect.camera_paths import PathBatch, trace_paths
from render.indirect.glossy import mis_weight_camera_path
from render.indirect.launch_layout import BLOCK, LaunchLayout
from render.indirect.light_vertices import diffuse_share, share_by_chance
from render.indirect.path_space_filter import UNIT_WEIGHT, PathSpaceFilter
from render.indirect.primary_vertices import shares_early
from render.scene.rays import of_parts, parts_of, segment
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi

# Of one launch, 30 and 75 MB in its course.
LANES = 3 << 18  # connections
PATHS = 1 << 18
FILTERED_PATHS = 13 << 12  # which may have connections, too


def add_paths(
    world: TracedScene,
    pixels: np.ndarray,
    turns: LaunchLayout,
    bounces: int,
    seed: int,
    sums: IndirectAccumulator,
    batches: int,
    *,
    shared: bool,
    regions: PathSpaceFilter | None = None,
) -> None:
    """Trace paths of the given blocks of flat pixels (-1: none) and add their light to `sums`; `shared` by blocks.

    With `regions` late light goes there instead, to be read from them when all paths are traced, and early light alone
    is shared, where it matters (`shares_early`).
    """
    from_m = None if regions is None else regions.from_m
    traced = trace_paths(world, pixels, turns, bounces, seed, batches, shared=shared, from_m=from_m)
    rows = None
    if regions is not None:
        rows = regions.count_paths(traced.heads.point, _weight(traced, sums))
    _add(_own_lanes(traced), traced, sums, regions, rows, own=True)
    if regions is not None:
        regions.evaluate()
    pairs = _pairs(traced, shared=shared, early=regions is not None and shares_early(world))
    if pairs is not None:
        _add(_pair_lanes(world, traced, pairs), traced, sums, own=False)
    sums.evaluate()


def _weight(traced: PathBatch, sums: IndirectAccumulator) -> Any:
    """Of a path in the regions: all of a pixel count as much as those of another."""
    return UInt32(UNIT_WEIGHT * dr.gather(Float, sums.scale, traced.heads.receiver) + 0.5)


def noise_of_paths(
    world: TracedScene, pixels: np.ndarray, turns: LaunchLayout, bounces: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sum of the squared contributions of a turn's paths to the pixels of its block, own and shared.

    Histograms of paths that fall into different bins have this variance.
    """
    traced = trace_paths(world, pixels, turns, bounces, seed, 1, shared=True)
    own, alone, shared = _Squares(), _Squares(), _Squares()
    lanes = _own_lanes(traced)
    _add(lanes._replace(early_m=Float(0)), traced, own, own=True)
    _add(lanes, traced, alone, own=True)
    _add(_pair_lanes(world, traced, _all_pairs(dr.width(traced.batch))), traced, shared, own=False)
    return own.by_block(BLOCK), alone.by_block(BLOCK) + shared.by_block(BLOCK**2)


def noise_of_filtered_paths(
    world: TracedScene, pixels: np.ndarray, turns: LaunchLayout, bounces: int, seed: int, from_m: float
) -> np.ndarray:
    """The same of filtered light: what is later than `from_m` behind direct light is read from regions, whose area, and
    with it the number of paths in them, grows with the square of its excess path."""
    start = dr.opaque(Float, from_m)
    traced = trace_paths(world, pixels, turns, bounces, seed, 1, shared=False, from_m=start)
    heads = traced.heads
    late_m = heads.path + heads.late_m
    own = _Squares(late_m, start)
    _add(_own_lanes(traced), traced, own, own=True)
    noise = own.by_block(BLOCK)
    pairs = _pairs(traced, shared=False, early=shares_early(world))
    if pairs is not None:
        early = _Squares(dr.gather(Float, late_m, pairs.head), start)
        _add(_pair_lanes(world, traced, pairs), traced, early, own=False)
        block = dr.gather(UInt32, pairs.tail, dr.arange(UInt32, dr.width(pairs.tail) // BLOCK) * BLOCK) // BLOCK
        np.add.at(noise, block.numpy(), early.by_block(BLOCK))
    return noise


class _Squares:
    """In place of `IndirectAccumulator`: the sum of squares of what every lane adds, late light counted as little as
    its noise.

    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(self, late_m: Any = None, from_m: Any = None) -> None:
        self._late_m, self._from_m, self._lanes = late_m, from_m, None

    def add(self, pixel: Any, batch: Any, path: Any, radiance: Any, active: Any) -> Any:
        """The square of what is added."""
        square = dr.select(active & dr.isfinite(radiance), dr.square(radiance), 0)
        if self._late_m is None:
            return square
        behind_m = dr.maximum(path - self._late_m, 0)
        return square / dr.square(1 + behind_m / self._from_m)

    def add_total(self, pixel: Any, batch: Any, total: Any) -> None:
        """Keep every lane's sum."""
        self._lanes = total

    def by_block(self, size: int) -> np.ndarray:
        """Sums over so many lanes each."""
        return self._lanes.numpy().astype(np.float64).reshape(-1, size).sum(axis=1)


class _Pairs(NamedTuple):
    """Head and tail of every pair, those of one tail together, and which group of BLOCK that is; its number, and which
    tails were `chosen` (None: all)."""

    head: Any
    tail: Any
    group: Any
    number: Any
    chosen: Any = None


def _pairs_of(number: Any, chosen: Any = None) -> _Pairs:
    """Neighbours in a block are neighbours in the launch, which keeps rays coherent."""
    group = number // BLOCK
    tail = group if chosen is None else dr.gather(UInt32, chosen, group)
    return _Pairs(tail // BLOCK * BLOCK + number % BLOCK, tail, group, number, chosen)


def _all_pairs(lanes: int) -> _Pairs:
    return _pairs_of(dr.arange(UInt32, lanes * BLOCK))


def _pairs(traced: PathBatch, *, shared: bool, early: bool) -> _Pairs | None:
    """The pairs that may have light for each other."""
    if shared:
        return _all_pairs(dr.width(traced.batch))
    if not early:
        return None
    chosen = dr.compress(_early(traced))
    if dr.width(chosen) == 0:
        return None
    return _pairs_of(dr.arange(UInt32, dr.width(chosen) * BLOCK), chosen)


def _early(traced: PathBatch) -> Any:
    """Whether a tail may carry light that is early to any head of its block."""
    heads, tails, pairs = traced.heads, traced.tails, _all_pairs(dr.width(traced.batch))
    x1, x2 = (dr.gather(mi.Point3f, si.p, index) for si, index in ((heads.si, pairs.head), (tails.si, pairs.tail)))
    left = dr.gather(Float, heads.early_m, pairs.head) - dr.gather(Float, tails.soonest_m, pairs.tail)
    near = UInt32((left > 0) & (dr.squared_norm(x2 - x1) < dr.square(left)))
    return tails.shared & (dr.block_reduce(dr.ReduceOp.Max, near, BLOCK) > 0)


class _Ends(NamedTuple):
    """What pairs need of heads and tails, as arrays and plain tuples, which recordings look into: see
    `PrimaryVertices` and `PathSuffixes`."""

    si1: tuple
    transmission: Any
    shares: Any
    si2: tuple
    shared: Any
    own_transmission: Any
    leg: Any
    to_laser: Any
    irradiance: Any
    onward: Any
    onward_direction: Any
    density: Any


class _Connections(NamedTuple):
    """Of every pair: leg x1 to x2 [m], pixel radiance from x2's laser light and from beyond, times the densities; the
    sums of these over each group."""

    leg: Any
    value: Any
    onward: Any
    density: Any
    onward_density: Any


def _connect(world: TracedScene, number: Any, chosen: Any, *ends: Any) -> tuple[Any, ...]:
    """The parts of `_Connections`."""
    head, tail, _ = _pairs_of(number, chosen)[:3]
    ends = _Ends(*ends)
    shared = dr.gather(Bool, ends.shared, tail) & dr.gather(Bool, ends.shares, head)
    si1 = dr.gather(mi.SurfaceInteraction3f, of_parts(ends.si1), head, shared)
    si2 = dr.gather(mi.SurfaceInteraction3f, of_parts(ends.si2), tail, shared)
    offset = si2.p - si1.p
    distance2 = dr.squared_norm(offset)
    direction = offset * dr.rsqrt(distance2)
    passed, leg = segment(world, si1, si2.p, shared)
    # a tail is seen from where it came, whatever rounding says
    own = head == tail
    passed = dr.select(own, dr.gather(Float, ends.own_transmission, tail, shared), passed)
    leg = dr.select(own, dr.gather(Float, ends.leg, tail, shared), leg)
    active = shared & (passed > 0) & (distance2 > 0)
    context = mi.BSDFContext()
    value1, density1 = si1.bsdf().eval_pdf(context, si1, si1.to_local(direction), active)
    si2.wi = si2.to_local(-direction)
    to_laser = si2.to_local(_gather_vector(ends.to_laser, tail, active))
    value2 = si2.bsdf().eval(context, si2, to_laser, active)[0]
    irradiance = dr.gather(Float, ends.irradiance, tail, active)
    going = active & dr.gather(Bool, ends.onward, tail, active)
    onward = si2.to_local(_gather_vector(ends.onward_direction, tail, going))
    value3, density3 = si2.bsdf().eval_pdf(context, si2, onward, going)
    area = dr.abs(dr.dot(si2.n, direction)) / distance2
    reach = dr.gather(Float, ends.transmission, head, active) * value1[0] * area * passed
    if ends.density is not None:
        value2 *= share_by_chance(
            diffuse_share(world, si1, direction, value1[0], active),
            dr.dot(si1.sh_frame.n, direction),
            distance2,
            dr.dot(si2.n, direction),
            dr.gather(Float, ends.density, tail, active),
            BLOCK,
        )
    value2 *= mis_weight_camera_path(world, si1, direction, si2, active)
    # where nothing is reflected Mitsuba's coated lobes state a density, but no sample goes there
    density = dr.select(active & (value1[0] > 0), density1 * area, 0)
    onward_density = dr.select(going & (value3[0] > 0), density * density3, 0)
    value = dr.select(active, reach * value2 * irradiance, 0)
    onward = dr.select(going, reach * value3[0], 0)
    dr.eval(leg, value, onward, density, onward_density)
    return leg, value, onward, dr.block_sum(density, BLOCK), dr.block_sum(onward_density, BLOCK)


class _Weights(NamedTuple):
    """Of every pair: leg from x1 to x2 [m], radiance of x2's laser light, factor of what lies beyond x2."""

    leg: Any
    first: Any
    onward: Any


def _weights(world: TracedScene, traced: PathBatch, pairs: _Pairs) -> _Weights:
    heads, tails = traced.heads, traced.tails
    ends = _Ends(
        parts_of(heads.si),
        heads.transmission,
        heads.shares,
        parts_of(tails.si),
        *(getattr(tails, name) for name in _Ends._fields[4:]),
    )
    dr.eval(pairs.number)
    made = _Connections(*world.recordings.call(world, "pairs", _connect, pairs.number, pairs.chosen, *ends))
    density, onward_density = (dr.gather(Float, total, pairs.group) for total in made[3:])
    first = dr.select(density > 0, made.value / density, 0)
    return _Weights(made.leg, first, dr.select(onward_density > 0, made.onward / onward_density, 0))


def _pair_lanes(world: TracedScene, traced: PathBatch, pairs: _Pairs) -> _Lanes:
    """Early light that every pixel of a block gets from every tail of the block."""
    heads, weights = traced.heads, _weights(world, traced, pairs)
    return _Lanes(
        dr.gather(UInt32, heads.receiver, pairs.head),
        dr.gather(UInt32, traced.batch, pairs.tail),
        pairs.tail,
        dr.gather(Float, heads.path, pairs.head),
        weights.leg,
        dr.gather(Float, heads.early_m, pairs.head),
        weights.first,
        weights.onward,
    )


def _own_lanes(traced: PathBatch) -> _Lanes:
    """Light that a pixel gets from its own path alone."""
    heads, tails = traced.heads, traced.tails
    tail = dr.arange(UInt32, dr.width(traced.batch))
    return _Lanes(
        heads.receiver, traced.batch, tail, heads.path, tails.leg, heads.early_m, tails.own_value, tails.own_onward
    )


class _Lanes(NamedTuple):
    """What lanes add: pixel and batch; tail; paths from camera to x1 and on to x2; one from the laser up to which light
    is shared; radiance of x2's laser light, factor of light beyond."""

    receiver: Any
    batch: Any
    tail: Any
    path: Any
    leg: Any
    early_m: Any
    first: Any
    onward: Any


@dr.syntax
def _add(
    lanes: _Lanes,
    traced: PathBatch,
    sums: IndirectAccumulator,
    regions: PathSpaceFilter | None = None,
    rows: Any = None,
    *,
    own: bool,
) -> None:
    receiver, batch, tail, path1, leg, early_m, first, onward = lanes
    joined, tails = traced.joined, traced.tails
    laser_path, last = (dr.gather(type(c), c, tail) for c in (tails.laser_path, tails.length))
    stride = dr.opaque(UInt32, dr.width(traced.batch))
    turn, total = dr.zeros(UInt32, dr.width(tail)), dr.zeros(Float, dr.width(tail))
    # x2's own light is the loop's first turn: additions before a loop would cost a kernel of their own
    going, joins = (first > 0) | (onward > 0), UInt32(0)
    if dr.hint(own, mode="scalar"):
        going, joins = Bool(traced.heads.valid), UInt32(len(joined))
    while going:
        beyond = going & (turn > joins)
        slot = (turn - 1 - joins) * stride + tail
        radiance = dr.select(beyond, onward * dr.gather(Float, tails.values, slot, beyond), first)
        path = leg + dr.select(beyond, dr.gather(Float, tails.paths, slot, beyond), laser_path)
        if dr.hint(own, mode="scalar"):
            towards, diffuse = tails.direction, tails.diffuse
            for number, light in enumerate(joined):
                near = turn == 1 + number
                radiance, path = dr.select(near, light.value, radiance), dr.select(near, light.path, path)
                towards, diffuse = dr.select(near, light.direction, towards), near | diffuse
            adding = going & ~((path < early_m) & dr.select(beyond, tails.onward, tails.shared & (turn == 0)))
            if dr.hint(regions is not None, mode="scalar"):
                sums.add_plain(receiver, batch, path1 + path, radiance, going)
                heads, weight = traced.heads, _weight(traced, sums)
                adding = regions.add(
                    heads.point, rows, heads.late_m, towards, diffuse, batch, path, radiance, weight, adding
                )
        else:
            adding = going & (path < early_m)
        total += sums.add(receiver, batch, path1 + path, radiance, adding)
        going &= (turn < joins) | ((turn < last + joins) & (onward > 0))
        turn += 1
    sums.add_total(receiver, batch, total)


def _gather_vector(source: Any, index: Any, active: Any) -> Any:
    return mi.Vector3f(*(dr.gather(Float, component, index, active) for component in source))
