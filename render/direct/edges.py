"""Detect edges (depth, crease, shadow, albedo, highlight) between neighbouring cells of pixels, all at once, and fit
path intervals across cells without an edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.direct.footprints import HIT, LARGE, LIT
from render.scene.rows import gather_rows
from render.scene.traced_scene import Bool, Float, UInt32, dr, mi, recorded, upload

# Two neighbours lie on one surface if their planes explain the step between their distances up to this [m]: a sixth of
# the reference sensor's bin. A crease lies between them if their planes differ by more than CREASE_M over the step, or
# if the cosines toward the laser differ by more than CREASE_COSINE.
STEP_M = 0.0025
CREASE_M = 0.03
CREASE_COSINE = 0.05
# An edge of paint or of a glint lies between two neighbours on one surface whose radiances differ by more than this
# share of the brighter one.
TONE = 0.1
MIXED_GAP_M = 0.05
# A cell follows its neighbours if its tangent plane is off the mean step to them by no more than this share of its
# distance, a bent surface apart.
FOLLOWED = 3e-4
GLINT_WIDTH = 2.0  # of a highlight, in units of the roughness

CUT, MIXED, GLINT = 1, 2, 4
SURFACE = ("distance_m", "slope_x_m", "slope_y_m", "radiance", "facing", "flags")
HIGHLIGHT = ("tilt_x", "tilt_y", "peak")
SIDES = 4  # of a cut cell: at each two children meet one another and what lies beyond


class Cells(NamedTuple):
    """Columns by which cells are compared, (N,) each: see `render.direct.footprints.Footprints`."""

    distance_m: Floats
    slope_x_m: Floats
    slope_y_m: Floats
    radiance: Floats
    facing: Floats
    flags: UInts
    tilt_x: Floats = None
    tilt_y: Floats = None
    peak: Floats = None


class Place(NamedTuple):
    """Positions of cells: the flat index of their pixel, their level, and column and row in cells of that level."""

    pixel: UInts
    level: UInts
    column: UInts
    row: UInts


class Table(NamedTuple):
    """Cells by row: children are compared with cells from all over a tree, and a row lies in one place in memory.

    place      (N, 4) int32: `Place`
    surface    (N, 8) float32: SURFACE, the flags by their bits, and two spare columns
    highlight  (N, 4) float32: HIGHLIGHT and a spare column, in worlds with glints
    """

    place: np.ndarray
    surface: np.ndarray
    highlight: np.ndarray | None


class Tree(NamedTuple):
    """Lookup of cells, `grid` a pixel side, in an image `width` wide: `rank_of` each pixel from the `first` one on (-1:
    none), and the first `child` of each cell (-1: a leaf); both int32."""

    grid: int
    width: int
    first: int
    rank_of: np.ndarray
    child: np.ndarray


class _Between(NamedTuple):
    """Comparison of two neighbouring cells: whether an edge lies between them, whether their surfaces are too far from
    each other (or only one cell hits a surface), the share of the brighter one's radiance that misplacing the edge can
    change, whether both are hits on one surface, bent or not, and the mean radiance that a highlight between them may
    add to a cell."""

    differ: Array
    apart: Array
    contrast: Array
    joined: Array
    glint: Masks


def first_edges(
    cells: Cells, path_intervals: Sequence[np.ndarray], grid: int, width: int, least: float
) -> tuple[np.ndarray, ...]:
    """Compare all cells of whole pixels, grid x grid each, with their neighbours: CUT, MIXED, GLINT bits, and spans.

    `width` is the image's where the pixels are its whole rows; 0: neighbours in other pixels are not met. CUT is set
    where an edge could change radiance times a pixel's area by `least` or more, or where the cell is large; GLINT
    where a highlight between two cells could.

    `path_intervals` are path centres, half widths and smaller half spans [m]; all columns are `aligned`. Small cells
    are spread between their neighbours on the same surface instead of on the tangent plane. Along each axis
    p = p_0 + s x + c x^2 / 2 and r = r_0 + g x, with s, g the mean of the steps to both neighbours (the one step where
    the other neighbour lies across an edge) and c their difference. Then the half span is |s| / 2 (c adds c^2 / 720 to
    the variance), and the mean path p_0 + c / 24 + g s / (12 r_0), summed over the axes: second order in the cell's
    width where the tangent plane is first, and blind to facets of a curved surface. At a crease the tangent plane
    agrees with one of the steps instead of their mean, and is kept.
    """
    if len(cells.flags) < 2:  # arrays of one entry are scalars to Dr.Jit: another kernel
        return np.where(cells.flags & LARGE, np.uint32(CUT), np.uint32(0)), *path_intervals
    columns = tuple(Float(column) for column in path_intervals)
    lane = dr.arange(UInt32, len(cells.flags))
    dr.eval(lane)
    counts = tuple(dr.opaque(UInt32, value) for value in (grid, width, len(cells.flags) // grid**2))
    found = _first_edges(_seen(cells), columns, lane, counts, dr.opaque(Float, float(least)))
    dr.eval(found)
    return tuple(values.numpy() for values in found)


def child_edges(tree: Tree, table: Table, parents: np.ndarray, least: float) -> np.ndarray:
    """Compare the children of cells that were just cut with each other and with what lies beyond the cut cells' sides:
    a child of a cell of the same size, or a leaf.

    Returns CUT, MIXED and GLINT bits of every cell, children or what was met beside them, (N,) uint32. CUT is set of
    large children, too.
    """
    number = max(len(parents), 2)  # arrays of one entry are scalars to Dr.Jit: another kernel
    lane = dr.arange(UInt32, SIDES * number)
    dr.eval(lane)
    counts = tuple(dr.opaque(UInt32, value) for value in (tree.grid, tree.width, tree.first, len(tree.rank_of)))
    bits = dr.zeros(UInt32, len(tree.child))
    dr.eval(bits)
    found = _child_edges(
        tuple(mi.Int32(column) for column in (tree.rank_of, tree.child)),
        (UInt32(table.place.view(np.uint32).ravel()), *(Float(part.ravel()) for part in table[1:] if part is not None)),
        (lane, upload(UInt32, parents, number)),
        counts,
        dr.opaque(Float, float(least)),
        bits,
    )
    dr.eval(found)
    return found.numpy()


def _seen(cells: Cells) -> tuple[Array, ...]:
    """View the columns of cells as Dr.Jit arrays on the same memory."""
    return tuple((UInt32 if column.dtype == np.uint32 else Float)(column) for column in cells if column is not None)


@recorded
def _first_edges(cells: tuple, path_intervals: tuple, lane: UInts, counts: tuple, least: Floats) -> tuple[Array, ...]:
    cells, (path, half, minor), (grid, width, pixels) = Cells(*cells), path_intervals, counts
    per_pixel = grid * grid
    rank, place = _divided(lane, per_pixel)
    row, column = _divided(place, grid)
    whole = width > 0
    _, pixel_x = _divided(rank, dr.maximum(width, 1))
    # after and before along x, then y: whether the neighbour is of the same pixel, whether of another, and which it is
    sides = (
        (column + 1 < grid, whole & (pixel_x + 1 < width), lane + 1, lane + per_pixel + 1 - grid),
        (column > 0, whole & (pixel_x > 0), lane - 1, lane - per_pixel - 1 + grid),
        (row + 1 < grid, whole & (rank + width < pixels), lane + grid, lane + per_pixel * width + grid - per_pixel),
        (row > 0, whole & (rank >= width), lane - grid, lane - per_pixel * width - grid + per_pixel),
    )
    pitch = dr.rcp(Float(grid))
    follows = ((cells.flags & (HIT | LARGE)) == HIT) & (cells.radiance > 0)
    per_radiance = dr.select(follows, dr.rcp(cells.radiance), 0)
    cut, mixed, glint = (cells.flags & LARGE) != 0, Bool(False), Bool(False)
    mean, variance, halves = Float(path), Float(0), []  # a copy: += would change the path
    for axis in range(2):
        number, rise, rises, bend, run, bends = (Float(0) for _ in range(6))
        gain = Float(0)
        slope = cells[1 + axis] * pitch
        for (inside, across, near, far), way in zip(sides[2 * axis : 2 * axis + 2], (1, -1), strict=True):
            there = inside | across
            index = dr.select(inside, near, far)
            other = _at(cells, index, there)
            step = way * (other.distance_m - cells.distance_m)
            between = _between(cells, other, step, slope, other[1 + axis] * pitch)
            brighter = dr.maximum(cells.radiance, other.radiance)
            cut |= there & between.differ & (brighter * between.contrast * pitch * pitch >= least)
            glint |= there & (between.glint > 0) & (between.glint * pitch * pitch >= least)
            mixed |= inside & between.differ & between.apart
            joined = there & between.joined
            number += dr.select(joined, 1, 0)
            rise += dr.select(joined, step, 0)
            rises += dr.select(joined, way * step, 0)
            step = dr.select(joined, way * (dr.gather(Float, path, index, there) - path), 0)
            run, bends = run + step, bends + way * step
            gain += dr.select(joined, way * (other.radiance - cells.radiance), 0)
        fraction, two = dr.rcp(dr.maximum(number, 1)), dr.select(number == 2, Float(1), Float(0))
        off = dr.abs(slope - rise * fraction)
        follows &= (number > 0) & (off <= dr.maximum(dr.abs(rises) * two / 4, FOLLOWED * cells.distance_m))
        run, bend = run * fraction, bends * two
        gain = dr.clip(gain * fraction * per_radiance, -2, 2)
        mean += bend / 24 + gain * run / 12
        halves.append(dr.abs(run) / 2)
        variance += dr.square(run) / 4 + dr.square(bend) / 240
    return (
        _bits(cut, mixed, glint),
        dr.select(follows, mean, path),
        dr.select(follows, dr.sqrt(variance), half),
        dr.select(follows, dr.minimum(*halves), minor),
    )


@recorded
def _child_edges(tree: tuple, table: tuple, sides: tuple, counts: tuple, least: Floats, bits: UInts) -> UInts:
    (rank_of, child), (lane, parent), (grid, width, first, pixels) = tree, sides, counts
    side = lane & (SIDES - 1)  # left, right, above, below
    beyond, upright = side & 1, side < 2  # whether the way leads to higher columns or rows; along the columns
    of = dr.gather(UInt32, parent, lane // SIDES)
    pixel, level, column, row = dr.gather(mi.Vector4u, table[0], of)
    way = 2 * mi.Int32(beyond) - 1
    way_x, way_y = dr.select(upright, way, 0), dr.select(upright, 0, way)
    there = mi.Int32(column) + way_x, mi.Int32(row) + way_y
    found = _cell_at((rank_of, child, grid, width, first, pixels), level, *there)
    its_child = dr.gather(mi.Int32, child, found.cell, found.exists)
    cut = found.exists & (its_child >= 0)
    # the two children at this side, and what is beside each: children lie (0, 0), (1, 0), (0, 1), (1, 1) in columns
    # and rows
    next_one = dr.select(upright, UInt32(2), UInt32(1))
    near = dr.gather(UInt32, UInt32(child), of) + dr.select(upright, beyond, 2 * beyond)
    far = dr.select(cut, UInt32(its_child) + dr.select(upright, 1 - beyond, 2 * (1 - beyond)), found.cell)
    one = near, near + next_one
    other = far, dr.select(cut, far + next_one, far)
    here = tuple(_row(table, index) for index in one)
    beside = tuple(_row(table, index, found.exists) for index in other)
    # ways between centres, in halves of a child's width
    below = level - found.level
    leaf_x, leaf_y = (((2 * (to >> mi.Int32(below)) + 1) << mi.Int32(below + 1)) for to in there)
    half = 0.5 / Float(grid << (level + 1))
    narrow, wide = 2 * half, dr.select(cut, 2 * half, 4 * half * Float(UInt32(1) << below))
    # one by one: by its default mode Dr.Jit 1.5.0 wrote outside of `bits`, an input of the recording, on two threads
    marks = [dr.select((cell.flags & LARGE) != 0, CUT, UInt32(0)) for cell in here]
    for i in range(2):
        x = 4 * mi.Int32(column) + 1 + dr.select(upright, 2 * mi.Int32(beyond), 2 * i)
        y = 4 * mi.Int32(row) + 1 + dr.select(upright, 2 * i, 2 * mi.Int32(beyond))
        to_x, to_y = dr.select(cut, 2 * way_x, leaf_x - x), dr.select(cut, 2 * way_y, leaf_y - y)
        between = _compared(
            here[i], beside[i], Float(to_x) * half, Float(to_y) * half, wide, pixel == found.pixel, least
        )
        between = dr.select(found.exists, between, 0)
        marks[i] |= between
        dr.scatter_reduce(dr.ReduceOp.Or, bits, between, other[i], between != 0, dr.ReduceMode.Direct)
    down, right = dr.select(upright, narrow, 0), dr.select(upright, 0, narrow)
    siblings = _compared(here[0], here[1], right, down, narrow, Bool(True), least)
    for index, mark in zip(one, marks, strict=True):
        dr.scatter_reduce(dr.ReduceOp.Or, bits, mark | siblings, index, (mark | siblings) != 0, dr.ReduceMode.Direct)
    return bits


class _Found(NamedTuple):
    """Cell that was looked up: whether there is one, its number, level, and the flat index of its pixel."""

    exists: Masks
    cell: UInts
    level: UInts
    pixel: UInts


@dr.syntax
def _cell_at(tree: tuple, level: UInts, column: UInts, row: UInts) -> _Found:
    """Find the deepest cell, no deeper than `level`, that holds cell (column, row) of that level."""
    rank_of, child, grid, width, first, pixels = tree
    depth = mi.Int32(level)
    column_0, row_0 = column >> depth, row >> depth
    x, y = UInt32(dr.maximum(column_0, 0)), UInt32(dr.maximum(row_0, 0))
    (pixel_x, within_x), (pixel_y, within_y) = _divided(x, grid), _divided(y, grid)
    place = pixel_y * width + pixel_x - first  # wraps to a large number where it would be negative
    inside = (column_0 >= 0) & (row_0 >= 0) & (pixel_x < width) & (place < pixels)
    rank = dr.gather(mi.Int32, rank_of, place, inside)
    exists = inside & (rank >= 0)
    found = mi.Int32((UInt32(rank) * grid + within_y) * grid + within_x)
    found = dr.select(exists, found, 0)
    depth = dr.select(exists, depth, 0)
    reached = mi.Int32(0)
    while depth > 0:
        depth -= 1
        below = dr.gather(mi.Int32, child, found)
        down = below + 2 * ((row >> depth) & 1) + ((column >> depth) & 1)
        found = dr.select(below >= 0, down, found)
        reached = dr.select(below >= 0, reached + 1, reached)
        depth = dr.select(below >= 0, depth, 0)
    return _Found(exists, UInt32(found), UInt32(reached), place + first)


def _compared(
    one: Cells, other: Cells, way_x: Floats, way_y: Floats, wider: Floats, within: Masks, least: Floats
) -> Array:
    """Return CUT, MIXED and GLINT bits of pairs of cells of any size, side by side, as `first_edges` sets them of a
    cell.

    The ways lead from one's centre to the other's, `wider` is the larger cell's width, all in pixels; `within` is true
    where both are of one pixel.
    """
    rises = (cell.slope_x_m * way_x + cell.slope_y_m * way_y for cell in (one, other))
    between = _between(one, other, other.distance_m - one.distance_m, *rises)
    brighter = dr.maximum(one.radiance, other.radiance)
    cut = between.differ & (brighter * between.contrast * dr.square(wider) >= least)
    glint = (between.glint > 0) & (between.glint * dr.square(wider) >= least)
    return _bits(cut, between.differ & between.apart & within, glint)


def _divided(number: UInts, by: UInts) -> tuple[Array, Array]:
    """Divide whole numbers, with quotients below 2^22: quotient and rest.

    Processors divide whole numbers one by one: three divisions took a quarter of the time of `first_edges`.
    """
    quotient = mi.Int32(Float(number) * dr.rcp(Float(by)))
    rest = mi.Int32(number) - quotient * mi.Int32(by)
    quotient += dr.select(rest >= mi.Int32(by), 1, dr.select(rest < 0, -1, 0))
    return UInt32(quotient), UInt32(mi.Int32(number) - quotient * mi.Int32(by))


def _bits(cut: Masks, mixed: Masks, glint: Masks) -> Array:
    bits = ((cut, CUT), (mixed, MIXED), (glint, GLINT))
    return sum((dr.select(condition, bit, UInt32(0)) for condition, bit in bits), UInt32(0))


def _at(columns: Array, index: UInts, active: bool | Masks = True) -> Array:
    """Gather the columns of the cells `index`; zeros where not `active`."""
    gathered = (dr.gather(type(column), column, index, active) for column in columns if column is not None)
    return type(columns)(*gathered)


def _row(table: Array, index: UInts, active: bool | Masks = True) -> Cells:
    """Gather the cells `index` from a table; zeros where not `active`."""
    cells = Cells(*gather_rows(table[1:2], (*(Float,) * 5, UInt32), index, active))  # SURFACE, in order of their fields
    if len(table) == 2:
        return cells
    tilt_x, tilt_y, peak, _ = dr.gather(mi.Vector4f, table[2], index, active)
    return cells._replace(tilt_x=tilt_x, tilt_y=tilt_y, peak=peak)


def _between(one: Cells, other: Cells, step: UInts, rise: Floats, other_rise: Floats) -> _Between:
    """Compare cells with their neighbours.

    `step` is the difference of two hits' distances [m], the rises what each one's tangent plane predicts for it. Across
    a crease, or along a surface that bends one way, it lies between the two predictions; across a gap it does not.
    """
    least, most = dr.minimum(rise, other_rise), dr.maximum(rise, other_rise)
    both = (one.flags & other.flags & HIT) != 0
    unlike = one.flags ^ other.flags
    gap = dr.select(both, dr.maximum(step - most, least - step), 0)
    edge = (gap > STEP_M) | (both & (most - least > CREASE_M)) | ((unlike & (HIT | LIT)) != 0)
    bend = dr.abs(one.facing - other.facing)
    brighter = dr.maximum(one.radiance, other.radiance)
    tone = dr.select(brighter > 0, dr.abs(one.radiance - other.radiance) / brighter, 0)
    differ = edge | (both & ((bend > CREASE_COSINE) | (tone > TONE)))
    apart = (gap > MIXED_GAP_M) | ((unlike & HIT) != 0)
    joined = both & ~edge
    glint = Float(0) if one.peak is None else dr.select(joined, _highlight(one, other) - brighter, 0)
    return _Between(differ, apart, dr.select(edge, Float(1), dr.maximum(bend, tone)), joined, glint)


def _highlight(one: Cells, other: Cells) -> Array:
    """Estimate the mean radiance of a cell that holds the highlight between two neighbours on a surface that bends.

    Between them the tilt off its middle, in units of the roughness, runs from one's to the other's, and in the
    neighbouring rows as far to the side as half the step. GGX falls as 1 / (1 + t^2)^2 with the tilt t, Beckmann
    faster: its edges are followed where they need not be, none is missed. A highlight narrower than the step fills a
    part of the cell.
    """
    step_x, step_y = other.tilt_x - one.tilt_x, other.tilt_y - one.tilt_y
    step2 = dr.square(step_x) + dr.square(step_y)
    part = dr.clip(-(one.tilt_x * step_x + one.tilt_y * step_y) / dr.maximum(step2, 1e-12), 0, 1)
    off = dr.norm(mi.Vector2f(one.tilt_x + part * step_x, one.tilt_y + part * step_y))
    step = dr.sqrt(step2)
    off = dr.maximum(off - step / 2, 0)
    fraction = dr.minimum(GLINT_WIDTH / dr.maximum(step, GLINT_WIDTH), 1)
    return dr.minimum(one.peak, other.peak) / dr.square(1 + dr.square(off)) * fraction
