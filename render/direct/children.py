"""Compare the children of cut cells with what lies beside them: which are cut in turn, and where edges between lie."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.direct.edges import CUT, LEVEL, Cells, Table, bits_of, compare, divided
from render.direct.footprints import LARGE, ray_offset
from render.scene.rows import gather_rows
from render.scene.traced_scene import Bool, Float, UInt32, dr, mi, recorded, upload

SIDES = 4  # of a cut cell: at each two children meet one another and what lies beyond
# How much of the rays' offsets counts where the middle between two of them is sought (measured: in rooms all of it, or
# nothing, makes more error).
OFFSET_SHARE = 0.5
# Edges are placed where that moves more than this share of the energy that an edge must have to be worth its rays.
WORTH_PLACING = 1 / 32
# the first of the two children at each side, and how much later the other one comes
_NEAR, _NEXT = np.array([0, 1, 0, 2]), np.array([2, 2, 1, 1])


class Tree(NamedTuple):
    """Lookup of cells, `grid` a pixel side, in an image `width` wide: `rank_of` each pixel from the `first` one on (-1:
    none), and the first `child` of each cell (-1: a leaf); both int32."""

    grid: int
    width: int
    first: int
    rank_of: np.ndarray
    child: np.ndarray


class EdgePairs(NamedTuple):
    """Pairs of neighbouring cells of one pixel, `one` and `other` (N,) uint32, that a silhouette or a shadow's edge
    parts, and the `area` (N,) float32 [pixels] of the other's cell that lies on one's side of it; negative: of one's
    cell, on the other's side.

    As far as two rays tell, an edge between them lies in the middle between them, not where their cells meet. This
    matters where a fine cell is beside a coarse one. A cell is often cut for what else is on its surface, say a
    highlight. What a ray found on the other side then stays coarse, and its surface would come out too large.
    """

    one: np.ndarray
    other: np.ndarray
    area: np.ndarray


def child_edges(tree: Tree, table: Table, parents: np.ndarray, least: float) -> tuple[np.ndarray, EdgePairs]:
    """Compare the children of cells that were just cut with each other and with what lies beyond the cut cells' sides:
    a child of a cell of the same size, or a leaf.

    Returns CUT, MIXED and GLINT bits of every cell, children or what was met beside them, (N,) uint32, and the pairs
    whose edge is worth placing, each once. CUT is set of large children, too.
    """
    number = max(len(parents), 2)  # arrays of one entry are scalars to Dr.Jit: another kernel
    lane = dr.arange(UInt32, SIDES * number)
    dr.eval(lane)
    newest = tree.child[parents[0]]
    counts = tuple(dr.opaque(UInt32, int(n)) for n in (tree.grid, tree.width, tree.first, len(tree.rank_of), newest))
    bits = dr.zeros(UInt32, len(tree.child))
    dr.eval(bits)
    bits, far, *areas = _child_edges(
        tuple(mi.Int32(column) for column in (tree.rank_of, tree.child)),
        (UInt32(table.place.view(np.uint32).ravel()), *(Float(part.ravel()) for part in table[1:] if part is not None)),
        (lane, upload(UInt32, parents, number)),
        counts,
        dr.opaque(Float, float(least)),
        bits,
    )
    dr.eval(bits, far, areas)
    return bits.numpy(), _edge_pairs(tree, table, parents, far.numpy(), [area.numpy() for area in areas])


def _edge_pairs(tree: Tree, table: Table, parents: np.ndarray, far: np.ndarray, areas: list[np.ndarray]) -> EdgePairs:
    """Collect the pairs of the lanes of a recording that have an area: each child with what is beyond, and both."""
    columns = []
    for i, area in enumerate(areas):
        lanes = np.flatnonzero(area[: SIDES * len(parents)] != 0)  # of booleans it is six times as fast
        side, parent = lanes % SIDES, parents[lanes // SIDES]
        near = tree.child[parent] + _NEAR[side]
        next_one, beyond = near + _NEXT[side], far[lanes]
        if i == 1:  # beyond a side is one cell, or two as small as the children
            level = table.place[:, LEVEL]
            beyond = np.where(level[beyond] == level[near], beyond + _NEXT[side], beyond)
        columns.append((next_one if i == 1 else near, next_one if i == 2 else beyond, area[lanes]))
    return EdgePairs(*(np.concatenate(column) for column in zip(*columns, strict=True)))


@recorded
def _child_edges(
    tree: tuple, table: tuple, sides: tuple, counts: tuple, least: Floats, bits: UInts
) -> tuple[Array, ...]:
    (rank_of, child), (lane, parent), (grid, width, first, pixels, newest) = tree, sides, counts
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
    # two cells that were cut at once meet from both sides: once is enough
    met = found.exists & ((beyond == 1) | (far < newest)) & (pixel == found.pixel)
    along, outside = (dr.select(upright, *places) for places in ((row, column), (there[1], there[0])))
    offsets = _offsets(along, UInt32(outside) >> below, level, found.level, grid, upright, cut)
    # one by one: by its default mode Dr.Jit 1.5.0 wrote outside of `bits`, an input of the recording, on two threads
    marks = [dr.select((cell.flags & LARGE) != 0, CUT, UInt32(0)) for cell in here]
    areas = []
    for i in range(2):
        x = 4 * mi.Int32(column) + 1 + dr.select(upright, 2 * mi.Int32(beyond), 2 * i)
        y = 4 * mi.Int32(row) + 1 + dr.select(upright, 2 * i, 2 * mi.Int32(beyond))
        to_x, to_y = dr.select(cut, 2 * way_x, leaf_x - x), dr.select(cut, 2 * way_y, leaf_y - y)
        between, severed = _compared(
            here[i], beside[i], Float(to_x) * half, Float(to_y) * half, wide, pixel == found.pixel, least
        )
        between = dr.select(found.exists, between, 0)
        marks[i] |= between
        dr.scatter_reduce(dr.ReduceOp.Or, bits, between, other[i], between != 0, dr.ReduceMode.Direct)
        area = _area_beyond(narrow, wide, offsets[i], Float(way))
        areas.append(dr.select(met & severed & _is_worth_placing(here[i], beside[i], area, least), area, 0))
    down, right = dr.select(upright, narrow, 0), dr.select(upright, 0, narrow)
    siblings, severed = _compared(here[0], here[1], right, down, narrow, Bool(True), least)
    offset = ray_offset(2 * dr.select(upright, column, row) + beyond, level + 1, UInt32(0), grid, 1)
    area = _area_beyond(narrow, narrow, (offset, offset), Float(1))
    areas.append(dr.select(severed & _is_worth_placing(here[0], here[1], area, least), area, 0))
    for index, mark in zip(one, marks, strict=True):
        dr.scatter_reduce(dr.ReduceOp.Or, bits, mark | siblings, index, (mark | siblings) != 0, dr.ReduceMode.Direct)
    return bits, far, *areas


def _offsets(
    along: UInts, outside: UInts, level: UInts, outer_level: UInts, grid: UInts, upright: Masks, cut: Masks
) -> list[tuple[Array, Array]]:
    """Look up how far the rays of the two children at a side are moved, and those of what is beyond: along their row
    where it is beside them, along their column where it is above or below.

    `along` is the row or column of the cut cell, `outside` that of the cell beyond, unless that was `cut`, too.
    """
    way = dr.select(upright, Float(1), Float(-1))
    beyond = ray_offset(outside, outer_level, divided(outside, grid)[0], grid, way)
    moved = (ray_offset(2 * along + i, level + 1, UInt32(0), grid, way) for i in range(2))
    return [(offset, dr.select(cut, offset, beyond)) for offset in moved]


def _area_beyond(narrow: Floats, wide: Floats, offsets: tuple[Floats, Floats], way: Floats) -> Array:
    """Compute the area of a cell `wide` wide, beside one no wider, on the narrow cell's side of the middle between both
    rays; `offsets` of the rays are in cell widths, and the way to the wider cell is to higher coordinates (1) or lower
    ones (-1)."""
    to_narrow = (0.5 - OFFSET_SHARE * way * offsets[0]) * narrow
    to_wide = (0.5 + OFFSET_SHARE * way * offsets[1]) * wide
    return 0.5 * (to_wide - to_narrow) * narrow


def _is_worth_placing(one: Cells, other: Cells, area: Floats, least: Floats) -> Masks:
    return dr.maximum(one.radiance, other.radiance) * dr.abs(area) >= WORTH_PLACING * least


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
    (pixel_x, within_x), (pixel_y, within_y) = divided(x, grid), divided(y, grid)
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
) -> tuple[Array, Masks]:
    """Return CUT, MIXED and GLINT bits of pairs of cells of any size, side by side, as `first_edges` sets them of a
    cell, and whether a silhouette or the edge of a shadow lies between them.

    The ways lead from one's centre to the other's, `wider` is the larger cell's width, all in pixels; `within` is true
    where both are of one pixel.
    """
    rises = (cell.slope_x_m * way_x + cell.slope_y_m * way_y for cell in (one, other))
    between = compare(one, other, other.distance_m - one.distance_m, *rises)
    brighter = dr.maximum(one.radiance, other.radiance)
    cut = between.differ & (brighter * between.contrast * dr.square(wider) >= least)
    glint = (between.glint > 0) & (between.glint * dr.square(wider) >= least)
    return bits_of(cut, between.differ & between.apart & within, glint), between.severed


def _row(table: Array, index: UInts, active: bool | Masks = True) -> Cells:
    """Gather the cells `index` from a table; zeros where not `active`."""
    cells = Cells(*gather_rows(table[1:2], (*(Float,) * 5, UInt32), index, active))  # SURFACE, in order of their fields
    if len(table) == 2:
        return cells
    tilt_x, tilt_y, peak, _ = dr.gather(mi.Vector4f, table[2], index, active)
    return cells._replace(tilt_x=tilt_x, tilt_y=tilt_y, peak=peak)
