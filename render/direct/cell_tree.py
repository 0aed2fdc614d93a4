"""A quadtree over the pixels' cells: cut where a footprint is not small, and along silhouettes and shadow edges."""

from __future__ import annotations

import numpy as np

from render.direct.edges import CUT, GLINT, MIXED, Cells, Place, Tree, child_edges, first_edges
from render.direct.footprints import CLIPPED, LARGE, Footprints, trace
from render.scene.traced_scene import TracedScene, aligned

# Refinement ends at this many cells a side of a pixel or more, however fine the grid it started from; at highlights of
# polished metal it goes on for so many levels, since all of a pixel's light may come from a hundredth of its width.
MAX_CELLS = 128
GLINT_LEVELS = 2
# A wire that runs through the image is followed by at most this many launches.
MAX_LAUNCHES = 256
# Passes end when there is less to cut than edge_threshold times this share of what the first one cut: a pass takes as
# long as ten thousand rays, and the last few edges are worth less (measured in rooms: 4 % more error, 26 % less time).
LAST_FRACTION = 1 / 32

_TYPES: dict[str, type[np.generic]] = dict.fromkeys(("rank", "column", "row", "level", "child"), np.int32)
_TYPES |= dict.fromkeys(Footprints._fields, np.float32) | {"flags": np.uint32}
_GLINTS = tuple(Footprints._field_defaults)  # kept of worlds that have some
# a cut cell's children: (0, 0), (1, 0), (0, 1), (1, 1) in (column, row)
_CHILD_COLUMN, _CHILD_ROW = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])


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

    def __init__(self, world: TracedScene, pixels: np.ndarray, grid: int) -> None:
        self.world, self.pixels, self.grid = world, pixels, grid
        self.width = world.scene.camera.width
        self.first = int(pixels[0]) if len(pixels) else 0
        interval = int(pixels[-1]) - self.first + 1 if len(pixels) else 0
        self.rank_of = aligned(interval, np.int32)
        self.rank_of[:] = -1
        self.rank_of[pixels - self.first] = np.arange(len(pixels))
        self.whole_rows = self.first % self.width == 0 and interval == len(pixels) and interval % self.width == 0
        self.used = self.rays = 0
        self.least = np.float32(0)
        self.mixed = np.zeros(len(pixels), bool)
        for name, dtype in _TYPES.items():
            setattr(self, name, None if name in _GLINTS and not world.has_glints else np.empty(0, dtype))
        self._reserve(len(pixels) * grid * grid * 3 // 2)
        cell_row, cell_column = np.divmod(np.arange(grid * grid, dtype=np.int32), grid)
        pixel_row, pixel_column = np.divmod(pixels.astype(np.int32), self.width)
        column = (pixel_column[:, None] * grid + cell_column).ravel()
        row = (pixel_row[:, None] * grid + cell_row).ravel()
        self._add(np.repeat(np.arange(len(pixels), dtype=np.int32), grid * grid), column, row, 0)

    def refine(self, levels: int, edge_threshold: float) -> np.ndarray:
        """Cut cells until none needs it or is `levels` deep; whether a cell of each pixel was, (pixels,) bool.

        An edge that could change less than `edge_threshold` of the root mean square of the pixels' radiance is left,
        and so are the last few (LAST_FRACTION) where many were cut.
        """
        touched = np.zeros(len(self.pixels), bool)
        if len(self.pixels) == 0:
            return touched
        per_pixel = self.radiance[: self.used].reshape(len(self.pixels), -1).mean(axis=1, dtype=np.float64)
        self.least = np.float32(edge_threshold * np.sqrt(np.square(per_pixel).mean()))
        pending = self._first_cuts()
        if levels == 0:
            return touched
        few = LAST_FRACTION * edge_threshold * self.grid**2 * len(pending)
        for _ in range(MAX_LAUNCHES):
            if len(pending) <= few:
                break
            touched[self.rank[pending]] = True
            pending = self._cut(pending, levels)
        return touched

    def clip(self) -> int:
        """Clip the leaves that are still not small to their faces; the number that this changes."""
        large = _having(self.flags[: self.used], LARGE)
        large = large[self.child[large] < 0]
        found = self._trace(large, clip=True)
        self.path_m[large], self.half_width_m[large] = found.path_m, found.half_width_m
        return int(np.count_nonzero(found.flags & CLIPPED))

    def pitch(self, index: np.ndarray | slice) -> np.ndarray:
        """Return width of cells in pixels, float32."""
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
        path_intervals = [interval[: self.used] for interval in (self.path_m, self.half_width_m, self.minor_m)]
        columns = (getattr(self, name) for name in Cells._fields)
        cells = Cells(*(None if column is None else column[: self.used] for column in columns))
        of_image = self.width if self.whole_rows else 0
        bits, *found = first_edges(cells, path_intervals, self.grid, of_image, float(self.least))
        for interval, new in zip(path_intervals, found, strict=True):
            interval[:] = new
        return self._note(bits)[0]

    def _cut(self, parents: np.ndarray, levels: int) -> np.ndarray:
        """Cut cells in four; the cells (children, and older leaves beside them) that now need cutting, sorted."""
        start = self.used
        child = np.arange(start, start + 4 * len(parents), 4, dtype=np.int32)
        self.child[parents] = child
        self._add(
            np.repeat(self.rank[parents], 4),
            (2 * self.column[parents, None] + _CHILD_COLUMN).ravel(),
            (2 * self.row[parents, None] + _CHILD_ROW).ravel(),
            np.repeat(self.level[parents] + 1, 4),
        )
        places = Place(*(getattr(self, name) for name in Place._fields))
        cells = Cells(*(getattr(self, name) for name in Cells._fields))
        tree = Tree(self.grid, self.width, self.first, self.rank_of, self.child)
        bits = child_edges(tree, places, cells, parents, float(self.least))[: self.used]
        marked, why = self._note(bits)
        deepest = np.where(why & GLINT, levels + GLINT_LEVELS, levels)
        return marked[(self.child[marked] < 0) & (self.level[marked] < deepest)]

    def _note(self, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Note which pixels are mixed; return the cells to cut, sorted, and their bits."""
        cells = np.flatnonzero(bits != 0)  # most have none, and one pass over all is enough
        found = bits[cells]
        self.mixed[self.rank[cells[(found & MIXED) != 0]]] = True
        cut = (found & (CUT | GLINT)) != 0
        return cells[cut], found[cut]


def _having(bits: np.ndarray, wanted: int) -> np.ndarray:
    """Find the indices at which one of the `wanted` bits is set. By way of booleans, of which numpy skips those that
    are false fast."""
    return np.flatnonzero((bits & wanted) != 0)
