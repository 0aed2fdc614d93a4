"""Light of paths, added up: each pixel's own, and what the pixels of a block get by each other's suffixes.

Pixels near each other form a block of T, and every pixel of the block uses the path suffixes of all: it sees T samples
for the price of one path and T rays that test whether its x1 sees x2 (path reuse: Bekaert, Sbert, Halton 2002,
"Accelerating path tracing by re-using paths"). Weighted by the balance heuristic (Veach 1997, eq. 9.8) the estimate
stays unbiased: with F_i the integrand of pixel i over x2 and p_k the density, per area at x2, with which pixel k
samples x2 (0 where x2 is hidden from it),

    L_i = sum_j F_i(x2_j) / sum_k p_k(x2_j),

where suffix j goes on in a direction that was sampled as seen from x1_j, so that beyond x2 the densities have the
factor p(w3 | x1_k, x2). Paths that leave x1 (or x2) by a mirror-like lobe, or whose x1 or x2 lies on smooth plastic,
are disjoint from all others and stay their own.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.indirect.accumulators import IndirectAccumulator
from render.indirect.camera_paths import PathBatch
from render.indirect.glossy import (
    camera_share,
    finite_ratio,
    has_light_paths,
    ratio_at_camera,
    ratio_at_laser,
    reversal,
)
from render.indirect.launch_layout import BLOCK
from render.indirect.light_vertices import (
    JoinedFactors,
    SeenVertex,
    diffuse_fraction,
    fills_slots,
    joined_factors,
    lit_density,
    mis_weight_bsdf,
    mis_weight_filtered,
    slot_factors,
)
from render.indirect.path_space_filter import UNIT_WEIGHT, ArrivingLight, PathSpaceFilter
from render.indirect.path_suffixes import pack_suffixes, read_suffix
from render.indirect.primary_vertices import reuses_early_paths
from render.indirect.retro_paths import has_retro_paths, retro_ratio
from render.scene.rays import interaction_from_parts, parts_of, segment, spawn
from render.scene.rows import INTERACTION, gather_rows, packed
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi

# Of one launch, 30 and 75 MB in its course; 40 MB more under a lamp, where x2 is joined.
CONNECTIONS_PER_LAUNCH = 3 << 18  # connections
PATHS_PER_LAUNCH = 1 << 18
FILTERED_PATHS_PER_LAUNCH = 13 << 12  # which may have connections, too


def add_own_light(paths: PathBatch, sums: IndirectAccumulator, path_filter: PathSpaceFilter | None = None) -> None:
    """Add each path's light to its own pixel.

    With `path_filter` late light goes there instead, to be read when all paths are traced.
    """
    rows = None
    if path_filter is not None:
        assert paths.primary.point is not None
        rows = path_filter.count_paths(paths.primary.point, _weight(paths, sums))
    add_lanes(own_lanes(paths), paths, sums, path_filter, rows, own=True)
    if path_filter is not None:
        path_filter.evaluate()


def add_reused_light(
    world: TracedScene, paths: PathBatch, sums: IndirectAccumulator, *, reuses_paths: bool, filtered: bool
) -> None:
    """Add light that the pixels of a block get by each other's suffixes.

    Where late light is `filtered` they are reused for early light alone, where it matters (`reuses_early_paths`).
    """
    pairs = select_pairs(paths, reuses_paths=reuses_paths, early=filtered and reuses_early_paths(world))
    if pairs is not None:
        add_lanes(pair_lanes(world, paths, pairs), paths, sums, own=False)
    sums.evaluate()


def _weight(paths: PathBatch, sums: IndirectAccumulator) -> Array:
    """Compute the integer weight of a path in the regions' sums: all paths of a pixel count as much as those of
    another."""
    return UInt32(UNIT_WEIGHT * dr.gather(Float, sums.scale, paths.primary.receiver) + 0.5)


class _Pairs(NamedTuple):
    """Primary vertex and suffix of every pair, those of one suffix together, and which group of BLOCK that is; its
    number, and which suffixes were `chosen` (None: all)."""

    vertex: UInts
    suffix: UInts
    group: UInts
    number: UInts
    chosen: UInts = None


def _pairs_of(number: UInts, chosen: UInts = None) -> _Pairs:
    """Make the pairs of these numbers. Neighbours in a block are neighbours in the launch: rays are coherent."""
    group = number // BLOCK
    suffix = group if chosen is None else dr.gather(UInt32, chosen, group)
    return _Pairs(suffix // BLOCK * BLOCK + number % BLOCK, suffix, group, number, chosen)


def all_pairs(lanes: int) -> _Pairs:
    """Return the pairs of every primary vertex and every suffix of its block."""
    return _pairs_of(dr.arange(UInt32, lanes * BLOCK))


def select_pairs(paths: PathBatch, *, reuses_paths: bool, early: bool) -> _Pairs | None:
    """Select the pairs of primary vertex and suffix that may have light for each other; None where there are none.

    A suffix that carries no light adds nothing to any pixel: under a flash these are half of all or more.
    """
    if not reuses_paths and not early:
        return None
    suffixes = paths.suffixes
    chosen = dr.compress(suffixes.reusable & dr.isfinite(suffixes.soonest_m) if reuses_paths else _early(paths))
    if dr.width(chosen) == 0:
        return None
    return _pairs_of(dr.arange(UInt32, dr.width(chosen) * BLOCK), chosen)


def _early(paths: PathBatch) -> Array:
    """Return whether a suffix may carry light that is early to any primary vertex of its block."""
    primary, suffixes, pairs = paths.primary, paths.suffixes, all_pairs(dr.width(paths.batch))
    x1, x2 = (
        dr.gather(mi.Point3f, si.p, index) for si, index in ((primary.si, pairs.vertex), (suffixes.si, pairs.suffix))
    )
    left = dr.gather(Float, primary.early_m, pairs.vertex) - dr.gather(Float, suffixes.soonest_m, pairs.suffix)
    near = UInt32((left > 0) & (dr.squared_norm(x2 - x1) < dr.square(left)))
    return suffixes.reusable & (dr.block_reduce(dr.ReduceOp.Max, near, BLOCK) > 0)


class _Kinds(NamedTuple):
    """Tell apart recordings of pairs: whether late light is filtered, whether there are light vertices, and whether
    x2 is joined to them."""

    filtered: bool
    connected: bool
    joined: bool


class _Connections(NamedTuple):
    """Connections of every pair: leg x1 to x2 [m], pixel radiance of x2's laser light and factor of the light from
    beyond x2, both before division by a density; the ratio of x1 with x2, and `retro_ratio` of what follows, or None;
    `JoinedFactors` or None; and the sums of the sampling densities over each group."""

    leg: Floats
    value: Floats
    onward: Masks
    ratio: Floats
    retro: Floats
    joined: tuple | None
    density: Floats
    onward_density: Array
    joined_density: Floats


def _connect(
    world: TracedScene, number: UInts, chosen: UInts, vertices: tuple, suffixes: tuple, *, kinds: _Kinds
) -> tuple[Array, ...]:
    """Compute the fields of `_Connections` for pairs of primary vertex and suffix."""
    vertex, suffix, group, *_ = _pairs_of(number, chosen)
    *parts, transmission, allows_reuse = gather_rows(vertices, (*INTERACTION, Float, Bool), vertex, True)
    of_suffix = read_suffix(suffixes, group, connected=kinds.connected, joined=kinds.joined)
    si1, si2 = interaction_from_parts(parts), of_suffix.si
    reusable = of_suffix.reusable & allows_reuse
    # from where a ray to x2 begins, a little off x1: beside it, that is another direction than from x1
    offset = si2.p - spawn(si1, si2.p - si1.p).o
    distance2 = dr.squared_norm(offset)
    direction = offset * dr.rsqrt(distance2)
    context = mi.BSDFContext()
    value1, density1 = si1.bsdf().eval_pdf(context, si1, si1.to_local(direction), reusable)
    passed, leg = segment(world, si1, si2.p, reusable & (value1[0] > 0), spread=False)
    # a suffix is seen from where it came, whatever rounding says
    own = vertex == suffix
    passed = dr.select(own, of_suffix.own_transmission, passed)
    leg = dr.select(own, of_suffix.leg, leg)
    active = reusable & (value1[0] > 0) & (passed > 0) & (distance2 > 0)
    si2.wi = si2.to_local(-direction)
    value2 = si2.bsdf().eval(context, si2, si2.to_local(of_suffix.to_laser), active)[0]
    going = active & of_suffix.onward
    onward = si2.to_local(of_suffix.onward_direction)
    value3, density3 = si2.bsdf().eval_pdf(context, si2, onward, going)
    area = dr.abs(dr.dot(si2.n, direction)) / distance2
    reach = transmission * value1[0] * area * passed
    if of_suffix.density is not None:
        lit = lit_density(of_suffix.density, distance2, dr.dot(si2.n, direction))
        if kinds.filtered:
            diffuse = diffuse_fraction(world, si1, direction, value1[0], active)
            value2 *= mis_weight_filtered(diffuse, dr.dot(si1.sh_frame.n, direction), lit, BLOCK)
        else:
            value2 *= mis_weight_bsdf(BLOCK * density1, lit)
    at_x1, ratio, retro = None, None, None
    if has_retro_paths(world):
        retro = retro_ratio(world, si1, si2.p, si2.to_world(onward), density3, going)
    if has_light_paths(world):
        at_x1 = ratio_at_camera(world, si1, direction, active, density1)
        value2 *= camera_share(at_x1 * ratio_at_laser(world, si2, -direction, active))
        ratio = finite_ratio(at_x1 * reversal(si2, onward, density3, going))
    # where nothing is reflected Mitsuba's coated lobes state a density, but no sample goes there
    density = dr.select(active, density1 * area, 0)
    onward_density = dr.select(going & (value3[0] > 0), density * density3, 0)
    value = dr.select(active, reach * value2 * of_suffix.irradiance, 0)
    seen = SeenVertex(si2, reach, at_x1, density3, active, going)
    joined = None if of_suffix.joined is None else joined_factors(world, of_suffix.joined, seen)
    onward = dr.select(going, reach * value3[0], 0)
    joined_density = None if joined is None else dr.select(joined.value > 0, density, 0)
    dr.eval(leg, value, onward, ratio, retro, density, onward_density, joined and tuple(joined), joined_density)
    sums = (None if part is None else dr.block_sum(part, BLOCK) for part in (density, onward_density, joined_density))
    return leg, value, onward, ratio, retro, None if joined is None else tuple(joined), *sums


class _Weights(NamedTuple):
    """Weighted connections of every pair: leg from x1 to x2 [m], radiance of x2's laser light and factor of the light
    from beyond x2; the ratio of x1 with x2, `retro_ratio` of what follows, and factors of joined vertices, or None."""

    leg: Floats
    first: UInts
    onward: Masks
    ratio: Floats
    retro: Floats
    joined: JoinedFactors | None


def _weights(world: TracedScene, paths: PathBatch, pairs: _Pairs) -> _Weights:
    primary, suffixes = paths.primary, paths.suffixes
    kinds = _Kinds(primary.is_filtered, suffixes.density is not None, suffixes.joined is not None)
    dr.eval(pairs.number)
    vertices = packed((*parts_of(primary.si), primary.transmission, primary.allows_reuse))
    given = pairs.number, pairs.chosen, vertices, pack_suffixes(suffixes, pairs.chosen)
    made = _Connections(*world.recordings.call(world, ("pairs", kinds), partial(_connect, kinds=kinds), *given))

    def weighted(value: Floats, total: Floats) -> Array:
        density = dr.gather(Float, total, pairs.group)
        return dr.select(density > 0, value / density, 0)

    joined = None if made.joined is None else JoinedFactors(*made.joined)
    if joined is not None:
        joined = joined._replace(value=weighted(joined.value, made.joined_density))
    first, onward = weighted(made.value, made.density), weighted(made.onward, made.onward_density)
    return _Weights(made.leg, first, onward, made.ratio, made.retro, joined)


def pair_lanes(world: TracedScene, paths: PathBatch, pairs: _Pairs) -> _Lanes:
    """Return early light that every pixel of a block gets from every suffix of the block."""
    primary, weights = paths.primary, _weights(world, paths, pairs)
    return _Lanes(
        dr.gather(UInt32, primary.receiver, pairs.vertex),
        dr.gather(UInt32, paths.batch, pairs.suffix),
        pairs.suffix,
        dr.gather(Float, primary.path, pairs.vertex),
        weights.leg,
        dr.gather(Float, primary.early_m, pairs.vertex),
        weights.first,
        weights.onward,
        weights.ratio,
        weights.retro,
        weights.joined,
    )


def own_lanes(paths: PathBatch) -> _Lanes:
    """Return light that a pixel gets from its own path alone."""
    primary, suffixes = paths.primary, paths.suffixes
    suffix, joined = dr.arange(UInt32, dr.width(paths.batch)), suffixes.joined
    return _Lanes(
        primary.receiver,
        paths.batch,
        suffix,
        primary.path,
        suffixes.leg,
        primary.early_m,
        suffixes.own_value,
        suffixes.own_onward,
        suffixes.own_ratio,
        suffixes.own_retro,
        None if joined is None else JoinedFactors(joined.own_value, joined.own_ratio, joined.own_weight),
    )


class _Lanes(NamedTuple):
    """Contributions of lanes: pixel and batch; suffix; paths from camera to x1 and on to x2; path from the laser up to
    which light is reused; radiance of x2's laser light, factor of the light from beyond x2; the ratio of x1 with x2, or
    None without light paths, `retro_ratio` of what follows, or None without retro paths, and factors of joined
    vertices, or None without these."""

    receiver: UInts
    batch: UInts
    suffix: UInts
    path: Floats
    leg: Floats
    early_m: Floats
    first: UInts
    onward: Masks
    ratio: Floats
    retro: Floats
    joined: JoinedFactors | None


@dr.syntax
def add_lanes(
    lanes: _Lanes,
    paths: PathBatch,
    sums: IndirectAccumulator,
    path_filter: Array = None,
    rows: UInts = None,
    *,
    own: bool,
) -> None:
    """Add the light of lanes to sums; `own`: that of a pixel's own path, connected at its first vertices too."""
    receiver, batch, suffix, path1, leg, early_m, first, onward, ratio, retro, joined = lanes
    connections, suffixes = (*paths.connections, *paths.retro), paths.suffixes
    laser_path, last = (dr.gather(type(c), c, suffix) for c in (suffixes.laser_path, suffixes.length))
    stride = dr.opaque(UInt32, dr.width(paths.batch))
    step, total = dr.zeros(UInt32, dr.width(suffix)), dr.zeros(Float, dr.width(suffix))
    # x2's own light is the loop's first step: additions before a loop would cost a kernel of their own
    going, connection_count = (first > 0) | fills_slots(onward, joined, Bool(True)), UInt32(0)
    if dr.hint(own, mode="scalar"):
        going, connection_count = Bool(paths.primary.valid), UInt32(len(connections))
    while going:
        beyond = going & (step > connection_count)
        slot = (step - 1 - connection_count) * stride + suffix
        factor, with_ratio = slot_factors(onward, ratio, joined, step - connection_count)
        later = factor * dr.gather(Float, suffixes.values, slot, beyond)
        if dr.hint(ratio is not None, mode="scalar"):
            others = finite_ratio(with_ratio * dr.gather(Float, suffixes.ratios, slot, beyond))
            if dr.hint(retro is not None, mode="scalar"):
                others += dr.select(step == connection_count + 1, retro, 0)  # x3's light
            later *= camera_share(others)
        radiance = dr.select(beyond, later, first)
        path = leg + dr.select(beyond, dr.gather(Float, suffixes.paths, slot, beyond), laser_path)
        if dr.hint(own, mode="scalar"):
            towards, diffuse = suffixes.direction, suffixes.diffuse
            for number, light in enumerate(connections):
                near = step == 1 + number
                radiance, path = dr.select(near, light.value, radiance), dr.select(near, light.path, path)
                towards = dr.select(near, light.direction, towards)
                diffuse = dr.select(near, light.diffuse, diffuse)
            at_x2 = (step == 0) | ((step == connection_count + 1) & (joined is not None))
            handed_on = dr.select(at_x2, suffixes.reusable, beyond & suffixes.onward)
            adding = going & ~((path < early_m) & handed_on)
            radiance = sums.clamped(receiver, batch, path1 + path, radiance, going, adding)
            if dr.hint(path_filter is not None, mode="scalar"):
                sums.add_unfiltered(receiver, batch, path1 + path, radiance, going)
                primary, weight = paths.primary, _weight(paths, sums)
                arriving = ArrivingLight(primary.late_m, towards, diffuse, batch, path, radiance, weight)
                adding = path_filter.add(primary.point, rows, arriving, adding)
            else:
                radiance = sums.filtered(path1 + path, radiance, diffuse)
        else:
            adding = going & (path < early_m)
            radiance = sums.clamped(receiver, batch, path1 + path, radiance, going, adding)
        total += sums.add(receiver, batch, path1 + path, radiance, adding)
        more = fills_slots(onward, joined, step == connection_count)
        going &= (step < connection_count) | ((step < last + connection_count) & more)
        step += 1
    sums.add_total(receiver, batch, total)
