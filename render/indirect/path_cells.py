"""Path-length cells in which indirect light accumulates: fine near the direct return, wide far behind it.

Sums run in UInt64 fixed point, so that their result does not depend on the order in which threads add.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.scene.traced_scene import Float, UInt32, dr, mi
from render.transient.samples import Samples, merge_by, no_samples, packed, with_energy
from scenes.errors import require
from scenes.limits import require_memory

UInt64 = mi.UInt64
# One quantum is 2^-43 of the brightest pixel's direct radiance: 2^26 samples of a tenth of it keep 13 bits each, and a
# cell overflows only beyond 2^21 times that radiance. A single sample above 2^17 times is clipped.
QUANTA_PER_BRIGHTEST = 2.0**43
MAX_QUANTA = 2.0**60
READ = 1 << 16  # cells read at a time
MOMENTS = 3  # of a cell: entries of its accumulator
ENTRY_BYTES = 8 + 8  # in fixed point, and read as float64
MAX_ENTRIES = (1 << 32) - 1  # of one array of Dr.Jit
MAKING_BYTES = 5 * 8  # a cell, of the arrays in which edges are worked out


class Cells(NamedTuple):
    """Edges of the cells of x = path - origin [m], rising; `behind` cells lie below x = 0.

    Cell k >= 0 begins at expm1(growth k) width / growth: it is `width_m` wide plus `growth` times its distance.
    """

    width_m: float
    growth: float
    behind: int
    edges_m: np.ndarray

    @property
    def size(self) -> int:
        return len(self.edges_m) - 1

    @property
    def width_of_m(self) -> np.ndarray:
        """Return the width of every cell [m]."""
        return np.diff(self.edges_m)


def make_cells(width_m: float, growth: float, nearest_m: float, farthest_m: float) -> Cells:
    """Return cells that cover x from `nearest_m` (negative) to `farthest_m`."""
    behind, ahead = (math.ceil(float(_cell_number(abs(x), width_m, growth))) + 1 for x in (nearest_m, farthest_m))
    require_memory(MAKING_BYTES * (behind + ahead), _what(1, behind + ahead))
    number = np.arange(-behind, ahead + 1, dtype=np.float64)
    far = np.expm1(growth * np.abs(number)) / growth if growth > 0 else np.abs(number)
    return Cells(width_m, growth, behind, np.sign(number) * far * width_m)


def require_rows(rows: int, cells: Cells) -> None:
    """Raise InputError where accumulators of so many rows of cells take more memory than there may be, or have more
    entries than Dr.Jit numbers."""
    what, entries = _what(rows, cells.size), MOMENTS * rows * cells.size
    require_memory(ENTRY_BYTES * entries, what)
    require(entries <= MAX_ENTRIES, f"{what}: {entries} entries, the limit is {MAX_ENTRIES}")


def _what(rows: int, cells: int) -> str:
    """Name cells for a message, with what makes them fewer."""
    return f"{rows} x {cells} cells of indirect light (widen indirect_tolerance_m or indirect_growth)"


def _cell_number(x: Floats, width_m: float, growth: float) -> Array:
    return np.log1p(growth * x / width_m) / growth if growth > 0 else x / width_m


def scatter_add_fixed_point(target: UInts, amount: Floats, index: UInts, active: Masks) -> None:
    """Add an amount, in quanta and rounded to whole ones, to a fixed-point sum."""
    whole = UInt64(dr.minimum(amount, MAX_QUANTA) + 0.5)
    dr.scatter_add(target, whole, index, active, mode=dr.ReduceMode.Direct)


class MomentHistogram:
    """Accumulators of several rows (a pixel, or a pixel and batch, each).

    Of each cell there are its energy and its first and second moment about the cell's beginning in the cell's width,
    side by side, as they are needed together.

    `quantum` is the radiance of one unit. Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(self, rows: int, cells: Cells, quantum: float) -> None:
        self.rows, self.cells, self.quantum = rows, cells, quantum
        require_rows(rows, cells)
        self.moments = dr.zeros(UInt64, int(rows * cells.size) * MOMENTS)
        self._edges = Float(cells.edges_m)
        self._growth, self._width = dr.opaque(Float, cells.growth), dr.opaque(Float, cells.width_m)
        self._behind, self._count = dr.opaque(UInt32, cells.behind), dr.opaque(UInt32, cells.size)
        self.per_quantum = dr.opaque(Float, 1 / quantum)

    def _cell(self, x_m: Floats) -> Array:
        ratio = dr.abs(x_m) / self._width
        number = dr.log(1 + self._growth * ratio) / self._growth if self.cells.growth > 0 else ratio
        signed = dr.floor(dr.mulsign(number, x_m)) + Float(self._behind)
        return UInt32(dr.clip(signed, 0, Float(self._count) - 1))

    def add(self, row: UInts, x_m: Floats, radiance: Floats, active: Masks, half_m: Floats = 0.0) -> None:
        """Add samples of radiance at x = path - origin, or even between x - half and x + half, to their rows' cells."""
        cell = self._cell(x_m)
        low, high = (
            dr.gather(Float, self._edges, cell, active),
            dr.gather(Float, self._edges, cell + 1, active),
        )
        fraction = dr.clip((x_m - low) / (high - low), 0, 1)
        second = dr.square(fraction) + dr.square(half_m / (high - low)) / 3
        for number, factor in enumerate((1, fraction, second)):
            index = (row * self._count + cell) * 3 + number
            scatter_add_fixed_point(self.moments, radiance * factor * self.per_quantum, index, active)

    def add_between(self, row: UInts, low_m: Floats, high_m: Floats, radiance: Floats, active: Masks) -> None:
        """Add radiance that is even between two values of x, no farther apart than cells are wide there, or little."""
        edge = dr.gather(Float, self._edges, self._cell(low_m) + 1, active)
        # beyond the last cell its end lies below both
        fraction = dr.clip((edge - low_m) / (high_m - low_m), 0, 1)
        below = dr.select(high_m > edge, fraction, 1)
        end_m = dr.minimum(high_m, edge)
        self.add(row, 0.5 * (low_m + end_m), radiance * below, active, 0.5 * (end_m - low_m))
        self.add(row, 0.5 * (edge + high_m), radiance * (1 - below), active & (below < 1), 0.5 * (high_m - edge))

    def samples(self, pixels: np.ndarray, origin_m: np.ndarray) -> Samples:
        """Return merged samples, one for every cell that holds energy, of rows that belong to `pixels`."""
        moments = self.moments.numpy().reshape(-1, 3)
        energy = moments[:, 0]
        found, done = no_samples(int(np.count_nonzero(energy))), 0
        for first in range(0, len(energy), READ):
            filled = np.flatnonzero(energy[first : first + READ]) + first
            values = (moments[filled] * self.quantum).T
            row, cell = np.divmod(filled, self.cells.size)
            part = cell_samples(self.cells, pixels[row], origin_m[row], cell, *values)
            for column, values in zip(found, part, strict=True):
                column[done : done + len(filled)] = values
            done += len(filled)
        return found

    def sums(self) -> tuple[np.ndarray, ...]:
        """Return radiance of every cell, and its two moments, (rows, cells) float64."""
        shape = self.rows, self.cells.size, 3
        return tuple(np.moveaxis(self.moments.numpy().reshape(shape) * self.quantum, -1, 0))


def cell_samples(
    cells: Cells,
    pixel: np.ndarray,
    origin_m: np.ndarray,
    cell: np.ndarray,
    radiance: np.ndarray,
    moment: np.ndarray,
    second: np.ndarray,
) -> Samples:
    """Return samples of filled cells from their radiance and its moments: of the same energy, centroid and spread.

    A sample is uniform over centroid +- sqrt(3 variance), as those of `merge_by`: one path stays a point, many that
    are even fill their cell, and the mean of many renders has the moments of the light itself.
    """
    low, width = cells.edges_m[cell], cells.width_of_m[cell]
    fraction = np.clip(moment / radiance, 0, 1)
    variance = np.clip(
        second / radiance - fraction**2, 0, fraction * (1 - fraction)
    )  # rounding aside, these are its limits
    return packed(
        pixel,
        origin_m + low + fraction * width,
        np.sqrt(3 * variance) * width,
        radiance,
        np.full(len(pixel), 2, dtype=np.uint8),
    )


def coarsened(samples: Samples, cells: Cells, origin_m: np.ndarray) -> Samples:
    """Return samples merged into cells counted from their pixels' origins, as `MomentHistogram` would."""
    samples = with_energy(samples)
    origin = origin_m[samples.pixel]
    cell = np.clip(np.searchsorted(cells.edges_m, samples.path_m - origin, side="right") - 1, 0, cells.size - 1)
    return merge_by(samples, samples.pixel * np.int64(cells.size) + cell, origin + cells.edges_m[cell])


def quantum_for(brightest: float) -> float:
    """Return the radiance of one unit of a fixed-point sum, from the brightest pixel's direct radiance."""
    return brightest / QUANTA_PER_BRIGHTEST
