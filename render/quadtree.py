"""A quadtree over the pixels' cells: cut where a footprint is not small, and along silhouettes and shadow edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.footprint import CLIPPED, HIT, LARGE, LIT, Footprints, trace
from render.world import World

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
# Cells of level 0 are traced and compared with their neighbours so many at a time: 40 MB.
BAND = 1 << 18
# Refinement ends at this many cells a side of a pixel, however fine the grid it started from.
MOST_CELLS = 64
# A wire that runs through the image is followed by at most this many launches.
MOST_LAUNCHES = 256

_NAMES = ("rank", "column", "row", "level", "child", *Footprints._fields)
_TYPES = (np.int32, np.int32, np.int32, np.uint8, np.int32, *(np.float32,) * 8, np.uint32)
_COMPARED = ("distance_m", "slope_x_m", "slope_y_m", "facing", "radiance", "flags", "rank")
# a cut cell's children: (0, 0), (1, 0), (0, 1), (1, 1) in (column, row)
_CHILD_COLUMN, _CHILD_ROW = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
# per side of a cut cell: the way to the neighbour, the children on that side, and the neighbour's children facing them
_SIDES = (
    (-1, 0, (0, 2), (1, 3)),
    (1, 0, (1, 3), (0, 2)),
    (0, -1, (0, 1), (2, 3)),
    (0, 1, (2, 3), (0, 1)),
)
# cells before and after each other along the rows, and along the columns, of images (..., rows, columns)
_ALONG_X = (..., slice(None, -1)), (..., slice(1, None))
_ALONG_Y = (..., slice(None, -1), slice(None)), (..., slice(1, None), slice(None))

Two = tuple[np.ndarray, np.ndarray]


class CellTree:
    """Cells of the pixels `pixels` (sorted flat indices), grid x grid each at level 0, half as wide with every level.

    One array per property, `used` cells long, children after their parents and four in a row. `rank` is the place in
    `pixels`; `column`, `row` count cells of the same level from the image's corner; `child` is the first of a cell's
    four children, -1 for a leaf; the rest is the cell's `Footprints`. `mixed` (pixels,) is true where neighbouring
    cells of a pixel hold surfaces more than 50 mm apart, or a surface and nothing; `rays` counts.
    """

    rank: np.ndarray
    column: np.ndarray
    row: np.ndarray
    level: np.ndarray
    child: np.ndarray
    path_m: np.ndarray
    half_width_m: np.ndarray
    minor_m: np.ndarray
    radiance: np.ndarray
    distance_m: np.ndarray
    slope_x_m: np.ndarray
    slope_y_m: np.ndarray
    facing: np.ndarray
    flags: np.ndarray

    def __init__(self, world: World, pixels: np.ndarray, grid: int) -> None:
        self.world, self.pixels, self.grid = world, pixels, grid
        self.width = world.scene.camera.width
        self.first = int(pixels[0]) if len(pixels) else 0
        span = int(pixels[-1]) - self.first + 1 if len(pixels) else 0
        self.rank_of = np.full(span, -1, np.int32)
        self.rank_of[pixels - self.first] = np.arange(len(pixels))
        self.whole_rows = self.first % self.width == 0 and span == len(pixels) and span % self.width == 0
        self.used = self.rays = 0
        self.least = np.float32(0)
        self.mixed = np.zeros(len(pixels), bool)
        for name, dtype in zip(_NAMES, _TYPES, strict=True):
            setattr(self, name, np.empty(0, dtype))
        self._reserve(len(pixels) * grid * grid)
        cell_row, cell_column = np.divmod(np.arange(grid * grid, dtype=np.int32), grid)
        for band in self._bands():
            column = ((pixels[band] % self.width)[:, None] * grid + cell_column).ravel()
            row = ((pixels[band] // self.width)[:, None] * grid + cell_row).ravel()
            self._add(
                np.repeat(np.arange(band.start, band.stop, dtype=np.int32), grid * grid), column, row, np.uint8(0)
            )

    def refine(self, levels: int, least_share: float) -> np.ndarray:
        """Cut cells until none needs it or is `levels` deep; whether a cell of each pixel was, (pixels,) bool.

        An edge that could change less than `least_share` of the root mean square of the pixels' radiance is left.
        """
        touched = np.zeros(len(self.pixels), bool)
        if len(self.pixels) == 0:
            return touched
        per_pixel = self.radiance[: self.used].reshape(len(self.pixels), -1).mean(axis=1, dtype=np.float64)
        self.least = np.float32(least_share * np.sqrt(np.square(per_pixel).mean()))
        pending = np.flatnonzero(self._first_reasons())
        if levels == 0:
            return touched
        for _ in range(MOST_LAUNCHES):
            if len(pending) == 0:
                break
            touched[self.rank[pending]] = True
            pending = self._cut(pending, levels)
        return touched

    def clip(self) -> int:
        """Clip the leaves that are still not small to their faces; the number that this changes."""
        large = np.flatnonzero((self.flags[: self.used] & LARGE) != 0)
        large = large[self.child[large] < 0]
        found = self._trace(large, clip=True)
        self.path_m[large], self.half_width_m[large] = found.path_m, found.half_width_m
        return int(np.count_nonzero(found.flags & CLIPPED))

    def pitch(self, index: np.ndarray | slice) -> np.ndarray:
        """Width of cells in pixels, float32."""
        return np.ldexp(np.float32(1 / self.grid), -self.level[index].astype(np.int32))

    def _trace(self, index: np.ndarray | slice, *, clip: bool = False) -> Footprints:
        column, row, level = self.column[index], self.row[index], self.level[index]
        self.rays += len(column)
        return trace(self.world, column, row, level, self.grid, clip=clip)

    def _add(self, rank: np.ndarray, column: np.ndarray, row: np.ndarray, level: np.ndarray | np.uint8) -> slice:
        """Trace new cells and append them."""
        new = slice(self.used, self.used + len(rank))
        if new.stop > len(self.rank):
            self._reserve(new.stop + new.stop // 2)
        self.rank[new], self.column[new], self.row[new], self.level[new], self.child[new] = rank, column, row, level, -1
        for name, values in zip(Footprints._fields, self._trace(new), strict=True):
            getattr(self, name)[new] = values
        self.used = new.stop
        return new

    def _reserve(self, cells: int) -> None:
        """Make room for so many cells."""
        for name, dtype in zip(_NAMES, _TYPES, strict=True):
            old, grown = getattr(self, name), np.empty(cells, dtype)
            grown[: self.used] = old[: self.used]
            setattr(self, name, grown)

    def _bands(self) -> list[slice]:
        """The pixels in runs of about BAND cells, of whole rows where whole rows were asked for."""
        unit = self.width if self.whole_rows else 1
        size = max(1, BAND // (self.grid**2 * unit)) * unit
        return [slice(first, min(first + size, len(self.pixels))) for first in range(0, len(self.pixels), size)]

    def _first_reasons(self) -> np.ndarray:
        """Which cells of level 0 to cut, (cells,) bool.

        Raster images of the cells where whole rows were asked for, each band with a row of pixels more on either side;
        else one small image for each pixel.
        """
        cells = self.grid**2
        reasons = np.empty(len(self.pixels) * cells, bool)
        path_m = self.path_m[: len(reasons)].copy()  # cells are compared as they were before they follow others
        for band in self._bands():
            beside = self.width if self.whole_rows else 0
            wider = slice(max(band.start - beside, 0), min(band.stop + beside, len(self.pixels)))
            images = [self._image(getattr(self, name), wider) for name in _COMPARED]
            found = (images[-2] & LARGE) != 0
            joined = self._compare_images(images, np.float32(1 / self.grid), found)
            inner = slice((band.start - wider.start) * cells, (band.stop - wider.start) * cells)
            reasons[band.start * cells : band.stop * cells] = self._column(found)[inner]
            self._follow_neighbours(joined, images, self._image(path_m, wider), band.start * cells, inner)
        return reasons

    def _image(self, column: np.ndarray, pixels: slice) -> np.ndarray:
        """A property of the pixels' cells of level 0 as raster images (..., rows, columns): of whole rows, or of each
        pixel."""
        grid = self.grid
        image = column[pixels.start * grid**2 : pixels.stop * grid**2].reshape(-1, grid, grid)
        if self.whole_rows:
            image = image.reshape(-1, self.width, grid, grid).transpose(0, 2, 1, 3).reshape(-1, self.width * grid)
        return image

    def _column(self, image: np.ndarray) -> np.ndarray:
        """The inverse of `_image`."""
        if self.whole_rows:
            image = image.reshape(-1, self.grid, self.width, self.grid).transpose(0, 2, 1, 3)
        return image.reshape(-1)

    def _follow_neighbours(
        self, joined: list[np.ndarray], images: list[np.ndarray], path: np.ndarray, start: int, inner: slice
    ) -> None:
        """Spread small cells of level 0 between their neighbours on the same surface instead of on the tangent plane.

        Along each axis p = p_0 + s x + c x^2 / 2 and r = r_0 + g x, with s, g the mean of the steps to both neighbours
        (the one step where the other neighbour lies across an edge) and c their difference. Then the half span is
        |s| / 2 (c adds c^2 / 720 to the variance), and the mean path p_0 + c / 24 + g s / (12 r_0), summed over the
        axes: second order in the cell's width where the tangent plane is first, and blind to facets of a curved
        surface. At a crease the tangent plane agrees with one of the steps instead of their mean, and is kept.

        The images' cells `inner` are changed, which are the tree's from `start`.
        """
        distance, slope_x, slope_y, _, radiance, flags, _ = images
        pitch = np.float32(1 / self.grid)
        follows = ((flags & (HIT | LARGE)) == HIT) & (radiance > 0)
        per_radiance = np.divide(np.float32(1), radiance, out=np.zeros_like(radiance), where=follows)
        mean, halves, variance = path.copy(), [], np.zeros_like(path)
        for both, tangent, along in zip(joined, (slope_x, slope_y), (_ALONG_X, _ALONG_Y), strict=True):
            number = np.zeros(path.shape, np.float32)
            for side in along:
                number[side] += both
            share, two = 1 / np.maximum(number, 1), number == 2
            rise, bend = _steps(distance, both, along)
            off = np.abs(tangent * pitch - rise * share)
            follows &= (number > 0) & (off <= np.maximum(np.abs(bend) * two / 4, FOLLOWED * distance))
            slope, bend = _steps(path, both, along)
            slope, bend = slope * share, bend * two
            gain = np.clip(_steps(radiance, both, along)[0] * share * per_radiance, -2, 2)
            mean += bend / 24 + gain * slope / 12
            halves.append(np.abs(slope) / 2)
            variance += np.square(slope) / 4 + np.square(bend) / 240
        chosen = np.flatnonzero(self._column(follows)[inner])
        for column, image in (
            (self.path_m, mean),
            (self.half_width_m, np.sqrt(variance)),
            (self.minor_m, np.minimum(*halves)),
        ):
            column[start + chosen] = self._column(image)[inner][chosen]

    def _cut(self, parents: np.ndarray, levels: int) -> np.ndarray:
        """Cut cells in four; the cells (children, and older leaves beside them) that now need cutting, sorted."""
        start = self.used
        child = np.arange(start, start + 4 * len(parents), 4, dtype=np.int32)
        self.child[parents] = child
        new = self._add(
            np.repeat(self.rank[parents], 4),
            (2 * self.column[parents, None] + _CHILD_COLUMN).ravel(),
            (2 * self.row[parents, None] + _CHILD_ROW).ravel(),
            np.repeat(self.level[parents] + np.uint8(1), 4),
        )
        cut = np.zeros(self.used, bool)
        cut[new] = (self.flags[new] & LARGE) != 0
        siblings = [getattr(self, name)[new].reshape(-1, 2, 2) for name in _COMPARED]
        self._compare_images(siblings, self.pitch(new).reshape(-1, 2, 2), cut[new].reshape(-1, 2, 2))
        one, other = self._pairs_across(parents, child, start)
        worth = self._worth_cutting(one, other)
        cut[one[worth]] = True
        cut[other[worth]] = True
        cut = np.flatnonzero(cut)
        return cut[(self.child[cut] < 0) & (self.level[cut] < levels)]

    def _pairs_across(self, parents: np.ndarray, child: np.ndarray, start: int) -> Two:
        """Children of cut cells with what lies beyond the cut cell's sides: a child of a cell of its size, or a leaf.

        Two cells cut in this pass, side by side, are met once.
        """
        level, column, row = self.level[parents].astype(np.int32), self.column[parents], self.row[parents]
        one, other = [], []
        for way_x, way_y, near_side, far_side in _SIDES:
            beside = self._find(level, column + way_x, row + way_y)
            its_child = np.where(beside >= 0, self.child[beside], -1)
            met = beside >= 0 if way_x + way_y > 0 else (beside >= 0) & (its_child < start)
            beside, mine, its_child = beside[met], child[met], its_child[met]
            even = (its_child >= 0) & (self.level[beside] == level[met])
            for a, b in zip(near_side, far_side, strict=True):
                one.append(mine + a)
                other.append(np.where(even, its_child + b, beside))
        return np.concatenate(one), np.concatenate(other)

    def _find(self, level: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
        """The deepest cell, no deeper than `level`, that holds the cell (column, row) of that level; -1 where none."""
        column_0, row_0 = column >> level, row >> level
        pixel_x, pixel_y = column_0 // self.grid, row_0 // self.grid
        place = pixel_y * self.width + pixel_x - self.first
        inside = (pixel_x >= 0) & (pixel_x < self.width) & (place >= 0) & (place < len(self.rank_of))
        rank = np.where(inside, self.rank_of[np.where(inside, place, 0)], -1)
        found = (rank * self.grid + row_0 % self.grid) * self.grid + column_0 % self.grid
        found = np.where(rank >= 0, found, -1)
        for deeper in range(int(level.max(initial=0)) - 1, -1, -1):
            child = self.child[found]
            down = (child >= 0) & (deeper < level) & (found >= 0)
            found = np.where(down, child + 2 * (row >> deeper & 1) + (column >> deeper & 1), found)
        return found

    def _compare_images(
        self, images: list[np.ndarray], pitch: np.ndarray | np.float32, reasons: np.ndarray
    ) -> list[np.ndarray]:
        """Compare cells with their neighbours in images (..., rows, columns) of `_COMPARED`; adds to `reasons` to cut.

        Marks `mixed` pixels among them.
        """
        distance, slope_x, slope_y, facing, radiance, flags, rank = images
        joined = []
        energy = radiance * np.square(pitch)
        for slope, (before, after) in ((slope_x, _ALONG_X), (slope_y, _ALONG_Y)):
            rise = slope * pitch
            pairs = _compare(
                (flags[before], flags[after]),
                (facing[before], facing[after]),
                (radiance[before], radiance[after]),
                distance[after] - distance[before],
                (rise[before], rise[after]),
            )
            self._find_mixed(pairs, (rank[before], rank[after]), (flags[before], flags[after]))
            worth = pairs.differ & (np.maximum(energy[before], energy[after]) * pairs.contrast >= self.least)
            reasons[before] |= worth
            reasons[after] |= worth
            joined.append(pairs.joined)
        return joined

    def _worth_cutting(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """`_compare` pairs of cells of any size: which are worth cutting; marks the `mixed` pixels among them."""
        level = self.level.take(one), self.level.take(other)
        # half a cell's width, in the unit of the finer cell of the pair's half width; columns and rows at that unit
        finer = np.maximum(*level)
        unit = np.ldexp(np.float32(0.5 / self.grid), -finer.astype(np.int32))
        shift = finer - level[0], finer - level[1]
        way_x, way_y = (
            (((2 * place.take(other) + 1) << shift[1]) - ((2 * place.take(one) + 1) << shift[0])) * unit
            for place in (self.column, self.row)
        )
        flags = self.flags.take(one), self.flags.take(other)
        radiance = self.radiance.take(one), self.radiance.take(other)
        pairs = _compare(
            flags,
            (self.facing.take(one), self.facing.take(other)),
            radiance,
            self.distance_m.take(other) - self.distance_m.take(one),
            tuple(self.slope_x_m.take(cell) * way_x + self.slope_y_m.take(cell) * way_y for cell in (one, other)),
        )
        self._find_mixed(pairs, (self.rank.take(one), self.rank.take(other)), flags)
        brighter = np.maximum(*radiance)
        wider = 2 * np.ldexp(unit, np.maximum(*shift).astype(np.int32))
        return pairs.differ & (brighter * np.square(wider) * pairs.contrast >= self.least)

    def _find_mixed(self, pairs: _Pairs, rank: Two, flags: Two) -> None:
        """Mark pixels that hold both cells of a pair on surfaces too far apart, or on a surface and nothing."""
        chosen = np.nonzero(pairs.differ)
        apart = (pairs.gap_m[chosen] > MIXED_GAP_M) | (((flags[0][chosen] ^ flags[1][chosen]) & HIT) != 0)
        pixel = rank[0][chosen]
        self.mixed[pixel[apart & (pixel == rank[1][chosen])]] = True


def _steps(image: np.ndarray, both: np.ndarray, along: tuple) -> Two:
    """Sum and difference of each cell's steps to the cell after and from the cell before, where `both` are joined."""
    before, after = along
    step = np.where(both, image[after] - image[before], np.float32(0))
    total, change = np.zeros_like(image), np.zeros_like(image)
    total[before] = change[before] = step
    total[after] += step
    change[after] -= step
    return total, change


class _Pairs(NamedTuple):
    """What lies between neighbouring cells: whether an edge, the gap between their surfaces [m] (0 unless both hit),
    the share of the brighter one's radiance that misplacing the edge between them can change, and whether both are hits
    on one surface, bent or not."""

    differ: np.ndarray
    gap_m: np.ndarray
    contrast: np.ndarray
    joined: np.ndarray


def _compare(flags: Two, facing: Two, radiance: Two, step: np.ndarray, rise: Two) -> _Pairs:
    """Compare cells with their neighbours.

    `step` is the difference of two hits' distances [m], `rise` what each one's tangent plane predicts for it. Across a
    crease, or along a surface that bends one way, the step lies between the two predictions; across a gap it does not.
    """
    least, most = np.minimum(*rise), np.maximum(*rise)
    both = (flags[0] & flags[1] & HIT) != 0
    gap = np.where(both, np.maximum(step - most, least - step), np.float32(0))
    edge = (gap > STEP_M) | (both & (most - least > CREASE_M)) | (((flags[0] ^ flags[1]) & (HIT | LIT)) != 0)
    bend = np.abs(facing[0] - facing[1])
    brighter = np.maximum(*radiance)
    tone = np.divide(np.abs(radiance[0] - radiance[1]), brighter, out=np.zeros_like(brighter), where=brighter > 0)
    differ = edge | (both & ((bend > CREASE_COSINE) | (tone > TONE)))
    return _Pairs(differ, gap, np.where(edge, np.float32(1), np.maximum(bend, tone)), both & ~edge)
