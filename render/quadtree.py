"""A quadtree over the pixels' cells: cut where a footprint is not small, and along silhouettes and shadow edges."""

from __future__ import annotations

import numpy as np

from render.edges import CUT, GLINT, MIXED, Cells, Place, first_edges, pair_edges
from render.footprint import CLIPPED, LARGE, Footprints, trace
from render.world import World, aligned

# Refinement ends at this many cells a side of a pixel, however fine the grid it started from; at highlights of polished
# metal it goes on for so many levels, since all of a pixel's light may come from a hundredth of its width.
MOST_CELLS = 64
GLINT_LEVELS = 2
# A wire that runs through the image is followed by at most this many launches.
MOST_LAUNCHES = 256
# Passes end when there is less to cut than least_share times this share of what the first one cut: a pass takes as long
# as ten thousand rays, and the last few edges are worth less (measured in rooms: 4 % more error, 26 % less time).
LAST_SHARE = 1 / 32

_TYPES = dict.fromkeys(("rank", "column", "row", "level", "child"), np.int32)
_TYPES |= dict.fromkeys(Footprints._fields, np.float32) | {"flags": np.uint32}
_GLINTS = tuple(Footprints._field_defaults)  # kept of worlds that have some
# a cut cell's children: (0, 0), (1, 0), (0, 1), (1, 1) in (column, row)
_CHILD_COLUMN, _CHILD_ROW = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
# per side of a cut cell: the way to the neighbour, the children on that side, and the neighbour's children facing them
_SIDES = (
    (-1, 0, (0, 2), (1, 3)),
    (1, 0, (1, 3), (0, 2)),
    (0, -1, (0, 1), (2, 3)),
    (0, 1, (2, 3), (0, 1)),
)
# pairs of siblings, side by side
_SIBLINGS = np.array([0, 2, 0, 1]), np.array([1, 3, 2, 3])

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
    tilt_x: np.ndarray | None
    tilt_y: np.ndarray | None
    peak: np.ndarray | None

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
        for name, dtype in _TYPES.items():
            setattr(self, name, None if name in _GLINTS and not world.has_glints else np.empty(0, dtype))
        self._reserve(len(pixels) * grid * grid)
        cell_row, cell_column = np.divmod(np.arange(grid * grid, dtype=np.int32), grid)
        pixel_row, pixel_column = np.divmod(pixels.astype(np.int32), self.width)
        column = (pixel_column[:, None] * grid + cell_column).ravel()
        row = (pixel_row[:, None] * grid + cell_row).ravel()
        self._add(np.repeat(np.arange(len(pixels), dtype=np.int32), grid * grid), column, row, 0)

    def refine(self, levels: int, least_share: float) -> np.ndarray:
        """Cut cells until none needs it or is `levels` deep; whether a cell of each pixel was, (pixels,) bool.

        An edge that could change less than `least_share` of the root mean square of the pixels' radiance is left, and
        so are the last few (LAST_SHARE) where many were cut.
        """
        touched = np.zeros(len(self.pixels), bool)
        if len(self.pixels) == 0:
            return touched
        per_pixel = self.radiance[: self.used].reshape(len(self.pixels), -1).mean(axis=1, dtype=np.float64)
        self.least = np.float32(least_share * np.sqrt(np.square(per_pixel).mean()))
        pending = self._first_cuts()
        if levels == 0:
            return touched
        few = LAST_SHARE * least_share * self.grid**2 * len(pending)
        for _ in range(MOST_LAUNCHES):
            if len(pending) <= few:
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
        return np.ldexp(np.float32(1 / self.grid), -self.level[index])

    def _trace(self, index: np.ndarray | slice, *, clip: bool = False) -> Footprints:
        column, row, level = self.column[index], self.row[index], self.level[index]
        self.rays += len(column)
        return trace(self.world, column, row, level, self.grid, clip=clip)

    def _add(self, rank: np.ndarray, column: np.ndarray, row: np.ndarray, level: np.ndarray | int) -> slice:
        """Trace new cells and append them."""
        new = slice(self.used, self.used + len(rank))
        if new.stop > len(self.rank):
            self._reserve(new.stop + new.stop // 2)
        self.rank[new], self.column[new], self.row[new], self.level[new], self.child[new] = rank, column, row, level, -1
        for name, values in self._trace(new)._asdict().items():
            if values is not None:
                getattr(self, name)[new] = values
        self.used = new.stop
        return new

    def _reserve(self, cells: int) -> None:
        """Make room for so many cells."""
        for name, dtype in _TYPES.items():
            old = getattr(self, name)
            if old is None:
                continue
            grown = aligned(cells, dtype)
            grown[: self.used] = old[: self.used]
            setattr(self, name, grown)

    def _first_cuts(self) -> np.ndarray:
        """Compare the cells of level 0, which then follow their neighbours: those to cut, sorted."""
        spans = [span[: self.used] for span in (self.path_m, self.half_width_m, self.minor_m)]
        columns = (getattr(self, name) for name in Cells._fields)
        cells = Cells(*(None if column is None else column[: self.used] for column in columns))
        of_image = self.width if self.whole_rows else 0
        bits, *found = first_edges(cells, spans, self.grid, of_image, self.least)
        for span, new in zip(spans, found, strict=True):
            span[:] = new
        self.mixed[self.rank[np.flatnonzero(bits & MIXED)]] = True
        return np.flatnonzero(bits & (CUT | GLINT))

    def _cut(self, parents: np.ndarray, levels: int) -> np.ndarray:
        """Cut cells in four; the cells (children, and older leaves beside them) that now need cutting, sorted."""
        start = self.used
        child = np.arange(start, start + 4 * len(parents), 4, dtype=np.int32)
        self.child[parents] = child
        new = self._add(
            np.repeat(self.rank[parents], 4),
            (2 * self.column[parents, None] + _CHILD_COLUMN).ravel(),
            (2 * self.row[parents, None] + _CHILD_ROW).ravel(),
            np.repeat(self.level[parents] + 1, 4),
        )
        most = np.zeros(self.used, np.int32)  # level down to which a cell is to be cut
        most[new] = np.where(self.flags[new] & LARGE, levels, 0)
        one, other = self._pairs_across(parents, child, start)
        siblings = ((child[:, None] + places).ravel() for places in _SIBLINGS)
        one, other = (np.concatenate(cells) for cells in zip((one, other), siblings, strict=True))
        bits = self._compare(one, other)
        for bit, deepest in ((CUT, levels), (GLINT, levels + GLINT_LEVELS)):
            worth = np.flatnonzero(bits & bit)
            most[one[worth]] = deepest
            most[other[worth]] = deepest
        cut = np.flatnonzero(most)
        return cut[(self.child[cut] < 0) & (self.level[cut] < most[cut])]

    def _pairs_across(self, parents: np.ndarray, child: np.ndarray, start: int) -> Two:
        """Children of cut cells with what lies beyond the cut cell's sides: a child of a cell of its size, or a leaf.

        Two cells cut in this pass, side by side, are met once.
        """
        level, column, row = self.level[parents], self.column[parents], self.row[parents]
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

    def _compare(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """What lies between pairs of cells, as `pair_edges` says; marks the `mixed` pixels among them."""
        places, cells = (kind(*(getattr(self, name) for name in kind._fields)) for kind in (Place, Cells))
        bits = pair_edges(places, cells, one, other, self.grid, self.least)
        self.mixed[self.rank[one[np.flatnonzero(bits & MIXED)]]] = True
        return bits
