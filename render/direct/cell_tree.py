"""A quadtree over the pixels' cells: cut where a footprint is not small, and along silhouettes and shadow edges."""

from __future__ import annotations

import math

import numpy as np

from render.direct.children import EdgePairs, Tree, child_edges
from render.direct.edges import (
    COLUMN,
    CUT,
    GLINT,
    HIGHLIGHT,
    LEVEL,
    MIXED,
    PIXEL,
    ROW,
    SURFACE,
    Cells,
    Table,
    first_edges,
)
from render.direct.footprints import CLIPPED, LARGE, Footprints, trace
from render.scene.traced_scene import TracedScene, aligned

# Refinement ends at this many cells a side of a pixel or more, however fine the grid it started from; at highlights of
# polished metal it goes on for so many levels, since all of a pixel's light may come from a hundredth of its width.
MAX_CELLS = 128
GLINT_LEVELS = 2
# A wire that runs through the image is followed by at most this many launches.
MAX_LAUNCHES = 256
# Passes end when few cells are left to cut: a pass takes as long as some thousand rays, and the last few edges are
# worth less. How few: as many as PASS_CELLS, but between these shares of what the first pass cut, times edge_threshold
# (measured in rooms: 4 % more error, 28 % less time).
PASS_CELLS = 400
LAST_FRACTIONS = 1 / 32, 1 / 8

RADIANCE = SURFACE.index("radiance")
# a cut cell's children, in the order of their rows: by how much level, column and row differ from twice the cell's
_CHILDREN = np.array([(0, 1, 0, 0), (0, 1, 1, 0), (0, 1, 0, 1), (0, 1, 1, 1)], np.int32)
_SPANS = ("path_m", "half_width_m", "minor_m")
_COLUMNS = (*_SPANS, "energy")


class CellTree:
    """Cells of the pixels `pixels` (sorted flat indices), grid x grid each at level 0, half as wide with every level.

    Cells are the first `used` rows of arrays, children after their parents and four in a row. `child` is the first of a
    cell's four children, -1 for a leaf; the other columns are those of `render.direct.footprints.Footprints`, and
    `table` holds what cells are compared by. `mixed` (pixels,) is true where neighbouring cells of a pixel hold
    surfaces more than 50 mm apart, or a surface and nothing; `rays` counts.
    """

    path_m: np.ndarray
    half_width_m: np.ndarray
    minor_m: np.ndarray
    energy: np.ndarray
    child: np.ndarray
    table: Table

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
        self._pairs: list[EdgePairs] = []
        self._large: list[np.ndarray] = []
        rows = np.empty((0, 4), np.float32)
        self.table = Table(rows.astype(np.int32), np.empty((0, 8), np.float32), rows if world.has_glints else None)
        self.child = np.empty(0, np.int32)
        for name in _COLUMNS:
            setattr(self, name, np.empty(0, np.float32))
        cell_row, cell_column = np.divmod(np.arange(grid * grid, dtype=np.int32), grid)
        pixel_row, pixel_column = np.divmod(pixels.astype(np.int32), self.width)
        place = np.empty((len(pixels), grid * grid, 4), np.int32)
        place[..., PIXEL], place[..., LEVEL] = pixels[:, None], 0
        place[..., COLUMN] = pixel_column[:, None] * grid + cell_column
        place[..., ROW] = pixel_row[:, None] * grid + cell_row
        self._first_cells = self._add(place.reshape(-1, 4))

    def refine(self, levels: int, edge_threshold: float) -> np.ndarray:
        """Cut cells until none needs it or is `levels` deep; whether a cell of each pixel was, (pixels,) bool.

        An edge that could change less than `edge_threshold` of the root mean square of the pixels' radiance is left,
        and so are the last few (PASS_CELLS) where many were cut.
        """
        touched = np.zeros(len(self.pixels), bool)
        if len(self.pixels) == 0:
            return touched
        per_pixel = self.energy[: self.used].reshape(len(self.pixels), -1).sum(axis=1, dtype=np.float64)
        self.least = np.float32(edge_threshold * np.sqrt(np.square(per_pixel).mean()))
        pending = self._first_cuts()
        if levels == 0:
            return touched
        least, most = (edge_threshold * self.grid**2 * len(pending) * part for part in LAST_FRACTIONS)
        few = min(max(PASS_CELLS, least), most)
        for _ in range(MAX_LAUNCHES):
            if len(pending) <= few:
                break
            touched[self.rank(pending)] = True
            pending = self._cut(pending, levels)
        return touched

    def place_edges(self) -> None:
        """Let edges between leaves lie in the middle between their rays (`EdgePairs`), instead of where the cells meet.

        Pairs of cells of level 0 stay: what their edges change is not worth a ray.
        """
        if not self._pairs:
            return
        one, other, area = (np.concatenate(column) for column in zip(*self._pairs, strict=True))
        leaves = np.flatnonzero((self.child[one] < 0) & (self.child[other] < 0))
        one, other, area = one[leaves], other[leaves], area[leaves]
        radiance = self.table.surface[:, RADIANCE]
        np.add.at(self.energy, one, area * radiance[one])
        np.subtract.at(self.energy, other, area * radiance[other])
        for cells in (one, other):  # amid others a cell may be left with less than nothing
            self.energy[cells] = np.maximum(self.energy[cells], 0)

    def clip(self) -> int:
        """Clip the leaves that are still not small to their faces; the number that this changes."""
        large = np.concatenate(self._large)
        large = large[self.child[large] < 0]
        if len(large) == 0:
            return 0
        found = self._trace(self.table.place[large], clip=True)
        self.path_m[large], self.half_width_m[large] = found.path_m, found.half_width_m
        return int(np.count_nonzero(found.flags & CLIPPED))

    def rank(self, cells: np.ndarray) -> np.ndarray:
        """Look up the place in `pixels` of cells' pixels."""
        return self.rank_of.take(self.pixel(cells) - self.first)

    def pixel(self, cells: np.ndarray) -> np.ndarray:
        """Return the flat indices of cells' pixels."""
        return self.table.place.ravel().take(cells * self.table.place.shape[1] + PIXEL)

    def _trace(self, place: np.ndarray, *, clip: bool = False) -> Footprints:
        self.rays += len(place)
        return trace(self.world, place[:, COLUMN], place[:, ROW], place[:, LEVEL], self.grid, clip=clip)

    def _add(self, place: np.ndarray) -> Footprints:
        """Trace new cells and append them."""
        found = self._trace(place)
        new = slice(self.used, self.used + len(place))
        # by way of booleans, of which numpy skips those that are false
        self._large.append(self.used + np.flatnonzero((found.flags & LARGE) != 0))
        if new.stop > len(self.child):
            self._reserve(3 * new.stop)  # memory that is not written takes none
        self.child[new], self.table.place[new] = -1, place
        for name in _COLUMNS:
            getattr(self, name)[new] = getattr(found, name)
        for part, names in ((self.table.surface, SURFACE), (self.table.highlight, HIGHLIGHT)):
            if part is not None:
                for number, name in enumerate(names):
                    part[new, number] = getattr(found, name).view(np.float32)
        self.used = new.stop
        return found

    def _reserve(self, cells: int) -> None:
        """Make room for so many cells."""
        for name in ("child", *_COLUMNS):
            setattr(self, name, _grown(getattr(self, name), self.used, cells))
        place, surface, highlight = self.table
        highlight = None if highlight is None else _grown(highlight, self.used, cells)
        self.table = Table(_grown(place, self.used, cells), _grown(surface, self.used, cells), highlight)

    def _first_cuts(self) -> np.ndarray:
        """Compare the cells of level 0, which then follow their neighbours: those to cut, sorted."""
        found = self._first_cells
        del self._first_cells  # their memory is needed no more
        cells = Cells(*(getattr(found, name) for name in Cells._fields))
        of_image = self.width if self.whole_rows else 0
        intervals = found.path_m, found.half_width_m, found.minor_m
        bits, *spans = first_edges(cells, intervals, self.grid, of_image, float(self.least))
        for name, values in zip(_SPANS, spans, strict=True):
            getattr(self, name)[: self.used] = values
        return self._note(bits)[0]

    def _cut(self, parents: np.ndarray, levels: int) -> np.ndarray:
        """Cut cells in four; the cells (children, and older leaves beside them) that now need cutting, sorted."""
        self.child[parents] = np.arange(self.used, self.used + 4 * len(parents), 4, dtype=np.int32)
        at_twice = self.table.place.take(parents, axis=0) * np.array([1, 1, 2, 2], np.int32)
        place = np.repeat(at_twice, 4, axis=0).reshape(-1, *_CHILDREN.shape) + _CHILDREN
        self._add(place.reshape(-1, 4))
        tree = Tree(self.grid, self.width, self.first, self.rank_of, self.child)
        bits, pairs = child_edges(tree, self.table, parents, float(self.least))
        self._pairs.append(pairs)
        marked, why = self._note(bits[: self.used])
        deepest = np.where(why & GLINT, levels + GLINT_LEVELS, levels)
        return marked[(self.child[marked] < 0) & (self.table.place[marked, LEVEL] < deepest)]

    def _note(self, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Note which pixels are mixed; return the cells to cut, sorted, and their bits."""
        cells = np.flatnonzero(bits != 0)  # most have none, and one pass over all is enough
        found = bits[cells]
        self.mixed[self.rank(cells[(found & MIXED) != 0])] = True
        cut = (found & (CUT | GLINT)) != 0
        return cells[cut], found[cut]


def _grown(old: np.ndarray, used: int, rows: int) -> np.ndarray:
    """Return the `used` first rows of an array in aligned memory with room for `rows`."""
    grown = aligned(rows * math.prod(old.shape[1:]), old.dtype.type).reshape(rows, *old.shape[1:])
    grown[:used] = old[:used]
    return grown
