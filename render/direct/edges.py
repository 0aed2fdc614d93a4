"""Detect edges (depth, crease, shadow, albedo, highlight) between neighbouring cells of pixels, all at once, and fit
path intervals across cells without an edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.direct.footprints import HIT, LARGE, LIT
from render.scene.traced_scene import Bool, Float, UInt32, dr, mi, recorded

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
# A crease folds a cell where the planes' slopes differ by more than this share of the steeper one, and path lengths
# grow no more than this many times as fast as distances: twice as fast, if the laser is at the camera.
FOLD, FOLD_RATIO = 0.1, 2.5
# Of what an unresolved highlight may cost: a margin, and the share of the rise across a cell that counts (measured: 1
# to 1.5 and a quarter do best).
HIGHLIGHT_MARGIN, RISE_SHARE = 1.25, 0.25

CUT, MIXED, GLINT = 1, 2, 4
SURFACE = ("distance_m", "slope_x_m", "slope_y_m", "radiance", "facing", "flags")
HIGHLIGHT = ("tilt_x", "tilt_y", "peak")


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


PIXEL, LEVEL, COLUMN, ROW = range(len(Place._fields))


class Table(NamedTuple):
    """Cells by row: children are compared with cells from all over a tree, and a row lies in one place in memory.

    place      (N, 4) int32: `Place`
    surface    (N, 8) float32: SURFACE, the flags by their bits, and two spare columns
    highlight  (N, 4) float32: HIGHLIGHT and a spare column, in worlds with glints
    """

    place: np.ndarray
    surface: np.ndarray
    highlight: np.ndarray | None


class Between(NamedTuple):
    """Comparison of two neighbouring cells: whether a silhouette or the edge of a shadow lies between them (`severed`),
    whether an edge of any kind does (`differ`), whether their surfaces are too far from each other (or only one cell
    hits a surface), the share of the brighter one's radiance that misplacing the edge can change, whether both are hits
    on one surface, bent or not, and how wrong an unresolved highlight may make a cell's mean radiance."""

    severed: Masks
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
    agrees with one of the steps instead of their mean, and is kept up to where the neighbour's meets it. From there on
    the cell is on the neighbour's: paths turn back at an inner or outer corner, instead of going on beyond it.
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


def _seen(cells: Cells) -> tuple[Array, ...]:
    """View the columns of cells as Dr.Jit arrays on the same memory."""
    return tuple((UInt32 if column.dtype == np.uint32 else Float)(column) for column in cells if column is not None)


@recorded
def _first_edges(cells: tuple, path_intervals: tuple, lane: UInts, counts: tuple, least: Floats) -> tuple[Array, ...]:
    cells, (path, half, minor), (grid, width, pixels) = Cells(*cells), path_intervals, counts
    sides = _sides(lane, grid, width, pixels)
    pitch = dr.rcp(Float(grid))
    follows = ((cells.flags & (HIT | LARGE)) == HIT) & (cells.radiance > 0)
    per_radiance = dr.select(follows, dr.rcp(cells.radiance), 0)
    cut, mixed, glint = (cells.flags & LARGE) != 0, Bool(False), Bool(False)
    mean, variance, halves = Float(path), Float(0), []  # a copy: += would change the path
    folded, turned, turned_halves = Bool(False), Float(0), []
    for axis in range(2):
        number, rise, rises, bend, run, bends = (Float(0) for _ in range(6))
        gain = Float(0)
        slope = cells[1 + axis] * pitch
        shift, spread = Float(0), dr.square(slope) / 12
        for (inside, across, near, far), way in zip(sides[2 * axis : 2 * axis + 2], (1, -1), strict=True):
            there = inside | across
            index = dr.select(inside, near, far)
            other = _at(cells, index, there)
            step = way * (other.distance_m - cells.distance_m)
            between = compare(cells, other, step, slope, other[1 + axis] * pitch)
            brighter = dr.maximum(cells.radiance, other.radiance)
            cut |= there & between.differ & (brighter * between.contrast * pitch * pitch >= least)
            glint |= there & (between.glint > 0) & (between.glint * pitch * pitch >= least)
            mixed |= inside & between.differ & between.apart
            fold = _fold(way * slope, way * other[1 + axis] * pitch, way * step)
            crossed = there & ~between.severed & ((cells.flags & other.flags & HIT) != 0) & fold.exists
            shift, spread = dr.select(crossed, fold.shift, shift), dr.select(crossed, fold.variance, spread)
            folded |= crossed
            joined = there & between.joined
            follows &= ~(crossed & ~joined)
            number += dr.select(joined, 1, 0)
            rise += dr.select(joined, step, 0)
            rises += dr.select(joined, way * step, 0)
            step = dr.select(joined, way * (dr.gather(Float, path, index, there) - path), 0)
            run, bends = run + step, bends + way * step
            gain += dr.select(joined, way * (other.radiance - cells.radiance), 0)
        turned += shift
        turned_halves.append(dr.sqrt(3 * spread))
        fraction, two = dr.rcp(dr.maximum(number, 1)), dr.select(number == 2, Float(1), Float(0))
        off = dr.abs(slope - rise * fraction)
        follows &= (number > 0) & (off <= dr.maximum(dr.abs(rises) * two / 4, FOLLOWED * cells.distance_m))
        run, bend = run * fraction, bends * two
        gain = dr.clip(gain * fraction * per_radiance, -2, 2)
        mean += bend / 24 + gain * run / 12
        halves.append(dr.abs(run) / 2)
        variance += dr.square(run) / 4 + dr.square(bend) / 240
    path, half, minor = _folded(cells, folded, (path, half, minor), (turned, turned_halves), pitch)
    return (
        bits_of(cut, mixed, glint),
        dr.select(follows, mean, path),
        dr.select(follows, dr.sqrt(variance), half),
        dr.select(follows, dr.minimum(*halves), minor),
    )


def _sides(lane: UInts, grid: UInts, width: UInts, pixels: UInts) -> tuple[tuple, ...]:
    """Find the neighbours of first cells, after and before along x, then y: whether each is of the same pixel, whether
    of another, and which it is in either case."""
    per_pixel = grid * grid
    rank, place = divided(lane, per_pixel)
    row, column = divided(place, grid)
    whole = width > 0
    _, pixel_x = divided(rank, dr.maximum(width, 1))
    return (
        (column + 1 < grid, whole & (pixel_x + 1 < width), lane + 1, lane + per_pixel + 1 - grid),
        (column > 0, whole & (pixel_x > 0), lane - 1, lane - per_pixel - 1 + grid),
        (row + 1 < grid, whole & (rank + width < pixels), lane + grid, lane + per_pixel * width + grid - per_pixel),
        (row > 0, whole & (rank >= width), lane - grid, lane - per_pixel * width - grid + per_pixel),
    )


class _Fold(NamedTuple):
    """Distances along one way over a cell that a crease crosses: whether one does, how far their mean is off the one at
    the centre, and their variance [m^2]."""

    exists: Masks
    shift: Array
    variance: Array


def _fold(slope: Floats, other_slope: Floats, step: Floats) -> _Fold:
    """Follow a cell's tangent plane up to where a neighbour's crosses it, and from there on the neighbour's.

    All are [m] from one cell's centre to the next: the slopes of both planes and the step between both distances.
    """
    at = (step - other_slope) / (slope - other_slope)
    before, beyond = 0.5 + at, 0.5 - at
    start, crease = -0.5 * slope, at * slope
    end = crease + beyond * other_slope
    first, last = 0.5 * (start + crease), 0.5 * (crease + end)
    shift = before * first + beyond * last
    square = before * (dr.square(crease - start) / 12 + dr.square(first))
    square += beyond * (dr.square(end - crease) / 12 + dr.square(last))
    differ = dr.abs(slope - other_slope) > FOLD * dr.maximum(dr.abs(slope), dr.abs(other_slope))
    return _Fold(differ & (dr.abs(at) < 0.5), shift, dr.maximum(square - dr.square(shift), 0))


def _folded(cells: Cells, folded: Masks, spans: tuple, turned: tuple, pitch: Floats) -> tuple[Array, Array, Array]:
    """Return path centre, half width and smaller half span [m]: of `folded` cells by the shift of their mean distance
    and the half spans along both axes in `turned`, of others those in `spans`.

    Path lengths grow in proportion to distances: exactly so where the laser is at the camera. A cell keeps its spans
    where a laser that is aside makes them grow much faster.
    """
    path, half, minor = spans
    shift, halves = turned
    ratio = 2 * half / dr.maximum(dr.norm(mi.Vector2f(cells.slope_x_m, cells.slope_y_m)) * pitch, 1e-9)
    folded &= ((cells.flags & (HIT | LARGE)) == HIT) & (ratio < FOLD_RATIO)
    return (
        dr.select(folded, path + ratio * shift, path),
        dr.select(folded, ratio * dr.norm(mi.Vector2f(*halves)), half),
        dr.select(folded, ratio * dr.minimum(*halves), minor),
    )


def divided(number: UInts, by: UInts) -> tuple[Array, Array]:
    """Divide whole numbers, with quotients below 2^22: quotient and rest.

    Processors divide whole numbers one by one: three divisions took a quarter of the time of `first_edges`.
    """
    quotient = mi.Int32(Float(number) * dr.rcp(Float(by)))
    rest = mi.Int32(number) - quotient * mi.Int32(by)
    quotient += dr.select(rest >= mi.Int32(by), 1, dr.select(rest < 0, -1, 0))
    return UInt32(quotient), UInt32(mi.Int32(number) - quotient * mi.Int32(by))


def bits_of(cut: Masks, mixed: Masks, glint: Masks) -> Array:
    bits = ((cut, CUT), (mixed, MIXED), (glint, GLINT))
    return sum((dr.select(condition, bit, UInt32(0)) for condition, bit in bits), UInt32(0))


def _at(columns: Array, index: UInts, active: bool | Masks = True) -> Array:
    """Gather the columns of the cells `index`; zeros where not `active`."""
    gathered = (dr.gather(type(column), column, index, active) for column in columns if column is not None)
    return type(columns)(*gathered)


def compare(one: Cells, other: Cells, step: UInts, rise: Floats, other_rise: Floats) -> Between:
    """Compare cells with their neighbours.

    `step` is the difference of two hits' distances [m], the rises what each one's tangent plane predicts for it. Across
    a crease, or along a surface that bends one way, it lies between the two predictions; across a gap it does not.
    """
    least, most = dr.minimum(rise, other_rise), dr.maximum(rise, other_rise)
    both = (one.flags & other.flags & HIT) != 0
    unlike = one.flags ^ other.flags
    gap = dr.select(both, dr.maximum(step - most, least - step), 0)
    severed = (gap > STEP_M) | ((unlike & (HIT | LIT)) != 0)
    edge = severed | (both & (most - least > CREASE_M))
    bend = dr.abs(one.facing - other.facing)
    brighter = dr.maximum(one.radiance, other.radiance)
    tone = dr.select(brighter > 0, dr.abs(one.radiance - other.radiance) / brighter, 0)
    differ = edge | (both & ((bend > CREASE_COSINE) | (tone > TONE)))
    apart = (gap > MIXED_GAP_M) | ((unlike & HIT) != 0)
    joined = both & ~edge
    glint = Float(0)
    if one.peak is not None:
        glint = dr.select(joined, _unresolved_highlight(one, other), 0)
        # what the highlight explains of a step is no paint
        paint = dr.abs((one.radiance - _highlight(one)) - (other.radiance - _highlight(other)))
        polished = joined & (dr.minimum(one.peak, other.peak) > 0) & (brighter > 0)
        tone = dr.select(polished, dr.minimum(tone, paint / brighter), tone)
    return Between(severed, differ, apart, dr.select(edge, Float(1), dr.maximum(bend, tone)), joined, glint)


def _highlight(cell: Cells) -> Array:
    """Compute the radiance of a GGX highlight at a cell's tilt off its middle."""
    return cell.peak / dr.square(1 + dr.square(cell.tilt_x) + dr.square(cell.tilt_y))


def _unresolved_highlight(one: Cells, other: Cells) -> Array:
    """Estimate the error of a cell's mean radiance where its highlight lies between two neighbours or right beside.

    Between them the tilt off the highlight's middle, in units of the roughness, runs from one's to the other's, and in
    the neighbouring rows as far to the side as half the step. GGX falls as 1 / (1 + t^2)^2 with the tilt t, Beckmann
    faster: its edges are followed where they need not be, none is missed.

    Samples of GGX that are a step s apart, in a row, miss its integral pi / 2 by a share of up to
    2 (1 + x) exp(-x), x = 2 pi / s (Poisson's summation formula): 3 % at s = 1, a third at s = 2, all at s = 4. Where
    the row ends, at an edge or with its pixel, a share of the rise across a cell is missed, too.

    The estimate does not depend on how near the middle a ray came. If it did, rows where rays gave too much would be
    cut, those where they gave too little would not, and all highlights would come out too dark.
    """
    step_x, step_y = other.tilt_x - one.tilt_x, other.tilt_y - one.tilt_y
    step2 = dr.square(step_x) + dr.square(step_y)
    part = dr.clip(-(one.tilt_x * step_x + one.tilt_y * step_y) / dr.maximum(step2, 1e-12), 0, 1)
    off = dr.norm(mi.Vector2f(one.tilt_x + part * step_x, one.tilt_y + part * step_y))
    step = dr.maximum(dr.sqrt(step2), 1e-3)
    off = dr.maximum(off - step / 2, 0)
    waves = 2 * dr.pi / step
    missed = HIGHLIGHT_MARGIN * dr.minimum(0.5 * dr.pi / step, 1) * 2 * (1 + waves) * dr.exp(-waves)
    missed = dr.maximum(missed, RISE_SHARE * dr.minimum(step, 1))
    return dr.minimum(one.peak, other.peak) / dr.square(1 + dr.square(off)) * missed
