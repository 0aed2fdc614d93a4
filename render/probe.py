"""Probe pixels: a few pixels whose indirect light is kept by independent batches, for the error estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.indirect.light_tracing import LightPathSplats
from render.indirect.path_cells import Cells, MomentHistogram, cell_samples, quantum_for
from render.scene.traced_scene import Bool, Float, UInt32, upload
from render.transient.samples import Samples


class ProbePixels(NamedTuple):
    """Light of a few flat `pixels` by independent batches, in cells half as wide: radiance and its two moments about
    the cell's beginning in the cell's width, (pixels, batches, cells) each.

    Every batch estimates the whole indirect light.
    """

    pixels: np.ndarray
    cells: Cells
    origin_m: np.ndarray
    radiance: np.ndarray
    moment: np.ndarray
    second: np.ndarray

    def samples(self, batches: slice = slice(None)) -> Samples:
        """Return the mean of some batches as samples, their pixel an index into `pixels`."""
        means = [values[:, batches].mean(axis=1) for values in self[-3:]]
        row, cell = np.nonzero(means[0])
        return cell_samples(self.cells, row, self.origin_m[row], cell, *(mean[row, cell] for mean in means))


class Probe(NamedTuple):
    """Probe row of every flat pixel of the image, or -1; rows by batch, and such without a filter."""

    row_of: np.ndarray
    rows: MomentHistogram
    unfiltered: MomentHistogram | None


def make_probe(
    pixels: np.ndarray, origin_m: np.ndarray, cells: Cells, batches: int, brightest: float, *, filtered: bool
) -> Probe | None:
    """Make the rows that probe a sorted few of the image's pixels; None for none."""
    if len(pixels) == 0:
        return None
    row_of = np.full(len(origin_m), -1)
    row_of[pixels] = np.arange(len(pixels))
    kinds = 2 if filtered else 1
    rows = [MomentHistogram(len(pixels) * batches, cells, quantum_for(brightest)) for _ in range(kinds)]
    return Probe(row_of, rows[0], rows[1] if filtered else None)


def read_probe(
    rows: MomentHistogram | None, pixels: np.ndarray, origin_m: np.ndarray, cells: Cells, batches: int
) -> ProbePixels:
    """Read what the rows of `pixels` hold, by batch."""
    sums = (np.zeros(0),) * 3 if rows is None else rows.sums()
    shape = len(pixels), batches, cells.size
    return ProbePixels(pixels, cells, origin_m[pixels], *(values.reshape(shape) for values in sums))


def probe_splats(probe: Probe, light: LightPathSplats, origin_m: np.ndarray, batches: int) -> None:
    """Add light-path splats on probe pixels to their rows."""
    seen = np.flatnonzero(probe.row_of[light.pixel] >= 0)
    if len(seen) == 0:
        return
    pixel = light.pixel[seen]
    row = upload(UInt32, probe.row_of[pixel] * batches + light.batch[seen])
    x = upload(Float, light.path_m[seen] - origin_m[pixel])
    radiance = upload(Float, light.radiance[seen] * batches)
    for rows in (probe.rows, probe.unfiltered):
        if rows is not None:
            rows.add(row, x, radiance, Bool(True))
