"""Accumulators of indirect light: per pixel and cell, per probe pixel, batch and cell, per pixel and batch."""

from __future__ import annotations

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.clamping import ClampedPixels
from render.indirect.path_cells import MomentHistogram, scatter_add_fixed_point
from render.scene.traced_scene import Float, UInt32, dr, mi, upload

PROBE_PARTS = 3  # parts of what is spread over probe rows, whose cells are half as wide as the pixels'


class IndirectAccumulator:
    """Add up light of paths: rows of the pixels' cells, finer rows of probe pixels by batch, totals by batch.

    origin_m   zero of every pixel's cells
    unfiltered rows like the probe's, of all light without a filter
    probe_row  the probe row of every pixel, -1 for none
    batches    sample s of a pixel belongs to batch s modulo this
    spp        paths of every pixel: each counts one of them
    clamp      set afterwards: what one path may add at most, and where the rest is kept
    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(
        self,
        rows: MomentHistogram,
        origin_m: np.ndarray,
        *,
        spp: np.ndarray,
        batches: int,
        probed: MomentHistogram | None = None,
        unfiltered: MomentHistogram | None = None,
        probe_row: np.ndarray | None = None,
    ) -> None:
        self.rows, self.probed, self.unfiltered = rows, probed, unfiltered
        self.clamp: ClampedPixels | None = None
        self.origin_m = upload(Float, origin_m)
        self.probe_row = None if probe_row is None else upload(mi.Int32, probe_row)
        self.totals = dr.zeros(mi.UInt64, rows.rows * batches)
        self.batches = dr.opaque(UInt32, batches)
        self.scale = upload(Float, 1 / spp)

    def clamped(
        self, pixel: UInts, batch: UInts, path: Floats, radiance: Floats, active: Masks, adding: Masks
    ) -> Array:
        """Return radiance of one path, no more than it may add; the rest is kept where it would be `adding`."""
        if self.clamp is None:
            return radiance
        allowed = self.clamp.clamped(pixel, radiance, active)
        x, excess, over = self._given(pixel, path, radiance - allowed, adding)
        self.clamp.add(pixel, batch, x, excess, over)
        return allowed

    def filtered(self, path: Floats, radiance: Floats, diffuse: Masks) -> Array:
        """Return radiance of one path as it is: the filter itself takes what is its own."""
        return radiance

    def add(self, pixel: UInts, batch: UInts, path: Floats, radiance: Floats, active: Masks) -> Array:
        """Add samples to the pixels' and the probe rows; returns what was added, for `add_total`."""
        x, radiance, active = self._given(pixel, path, radiance, active)
        self.rows.add(pixel, x, radiance, active)
        if self.probed is not None:
            row, probe_row = self._probe_row_of(pixel, batch, active)
            self.probed.add(row, x, radiance * Float(self.batches), probe_row)
        return radiance

    def add_unfiltered(self, pixel: UInts, batch: UInts, path: Floats, radiance: Floats, active: Masks) -> None:
        """Add samples to the probe rows of light without a filter."""
        if self.unfiltered is not None:
            x, radiance, active = self._given(pixel, path, radiance, active)
            row, probe_row = self._probe_row_of(pixel, batch, active)
            self.unfiltered.add(row, x, radiance * Float(self.batches), probe_row)

    def spread(self, pixel: UInts, low: Floats, high: Floats, radiance: Floats, active: Masks) -> None:
        """Add light that is even between two paths, and a mean over paths already, to the pixels' rows."""
        origin = dr.gather(Float, self.origin_m, pixel, active)
        self.rows.add_between(pixel, low - origin, high - origin, radiance, active)

    def spread_probed(
        self, pixel: UInts, batch: UInts, low: Floats, high: Floats, radiance: Floats, active: Masks
    ) -> None:
        """Add one batch's part of such light to the probe rows."""
        assert self.probed is not None
        origin = dr.gather(Float, self.origin_m, pixel, active)
        row, probe_row = self._probe_row_of(pixel, batch, active)
        radiance = radiance * Float(self.batches) / PROBE_PARTS
        for part in range(PROBE_PARTS):  # these rows' cells are narrower
            begin, end = (dr.lerp(low, high, (part + side) / PROBE_PARTS) - origin for side in (0, 1))
            self.probed.add_between(row, begin, end, radiance, probe_row)

    def add_total(self, pixel: UInts, batch: UInts, radiance: Floats) -> None:
        """Add to the pixels' totals by batch."""
        scatter_add_fixed_point(
            self.totals, radiance * self.rows.per_quantum, pixel * self.batches + batch, radiance > 0
        )

    def _given(self, pixel: UInts, path: Floats, radiance: Floats, active: Masks) -> tuple[Array, Array, Array]:
        """Place from the pixel's origin, share of the pixel's mean, and where there is any."""
        x = path - dr.gather(Float, self.origin_m, pixel, active)
        radiance = radiance * dr.gather(Float, self.scale, pixel, active)
        radiance = dr.select(active & dr.isfinite(radiance), radiance, 0)
        return x, radiance, active & (radiance > 0)

    def _probe_row_of(self, pixel: UInts, batch: UInts, active: Masks) -> tuple[Array, Array]:
        probe_row = dr.gather(mi.Int32, self.probe_row, pixel, active)
        return UInt32(dr.maximum(probe_row, 0)) * self.batches + batch, active & (probe_row >= 0)

    def evaluate(self) -> None:
        """Run what was added so far."""
        kept = [rows for rows in (self.rows, self.probed, self.unfiltered) if rows is not None]
        dr.eval(self.totals, [rows.moments for rows in kept])
        if self.clamp is not None:
            self.clamp.sums.evaluate()
