"""Where the light of paths is added: per pixel and cell, per watched pixel, batch and cell, per pixel and batch."""

from __future__ import annotations

from typing import Any

import numpy as np

from render.indirect.path_cells import MomentHistogram, scatter_add_fixed_point
from render.scene.traced_scene import Float, UInt32, dr, mi, upload

FINER = 3  # parts of what is spread over watched rows, whose cells are half as wide as the pixels'


class IndirectAccumulator:
    """Where connections are added: rows of the pixels' cells, finer rows of watched pixels by batch, totals by batch.

    origin_m   zero of every pixel's cells
    plain      rows like the watched ones, of all light without a filter
    watch      the watched row of every pixel, -1 for none
    batches    rounds take turns: round r belongs to batch r modulo this
    rounds     paths of every pixel: each counts one of them
    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(
        self,
        rows: MomentHistogram,
        origin_m: np.ndarray,
        *,
        rounds: np.ndarray,
        batches: int,
        watched: MomentHistogram | None = None,
        plain: MomentHistogram | None = None,
        watch: np.ndarray | None = None,
    ) -> None:
        self.rows, self.watched, self.plain = rows, watched, plain
        self.origin_m = upload(Float, origin_m)
        self.watch = None if watch is None else upload(mi.Int32, watch)
        self.totals = dr.zeros(mi.UInt64, rows.rows * batches)
        self.batches = dr.opaque(UInt32, batches)
        self.scale = upload(Float, 1 / rounds)

    def add(self, pixel: Any, batch: Any, path: Any, radiance: Any, active: Any) -> Any:
        """Add samples to the pixels' and the watched rows; returns what was added, for `add_total`."""
        x, radiance, active = self._given(pixel, path, radiance, active)
        self.rows.add(pixel, x, radiance, active)
        if self.watched is not None:
            row, watch = self._watched_row(pixel, batch, active)
            self.watched.add(row, x, radiance * Float(self.batches), watch)
        return radiance

    def add_plain(self, pixel: Any, batch: Any, path: Any, radiance: Any, active: Any) -> None:
        """Add samples to the rows of what is watched as it would be without a filter."""
        if self.plain is not None:
            x, radiance, active = self._given(pixel, path, radiance, active)
            row, watch = self._watched_row(pixel, batch, active)
            self.plain.add(row, x, radiance * Float(self.batches), watch)

    def spread(self, pixel: Any, low: Any, high: Any, radiance: Any, active: Any) -> None:
        """Add light that is even between two paths, and a mean over paths already, to the pixels' rows."""
        origin = dr.gather(Float, self.origin_m, pixel, active)
        self.rows.add_between(pixel, low - origin, high - origin, radiance, active)

    def spread_watched(self, pixel: Any, batch: Any, low: Any, high: Any, radiance: Any, active: Any) -> None:
        """Add one batch's part of such light to the watched rows."""
        origin = dr.gather(Float, self.origin_m, pixel, active)
        row, watch = self._watched_row(pixel, batch, active)
        radiance = radiance * Float(self.batches) / FINER
        for part in range(FINER):  # these rows' cells are narrower
            ends = (dr.lerp(low, high, (part + side) / FINER) - origin for side in (0, 1))
            self.watched.add_between(row, *ends, radiance, watch)

    def add_total(self, pixel: Any, batch: Any, radiance: Any) -> None:
        """Add to the pixels' totals by batch."""
        scatter_add_fixed_point(
            self.totals, radiance * self.rows.per_quantum, pixel * self.batches + batch, radiance > 0
        )

    def _given(self, pixel: Any, path: Any, radiance: Any, active: Any) -> tuple[Any, Any, Any]:
        """Place from the pixel's origin, share of the pixel's mean, and where there is any."""
        x = path - dr.gather(Float, self.origin_m, pixel, active)
        radiance = radiance * dr.gather(Float, self.scale, pixel, active)
        radiance = dr.select(active & dr.isfinite(radiance), radiance, 0)
        return x, radiance, active & (radiance > 0)

    def _watched_row(self, pixel: Any, batch: Any, active: Any) -> tuple[Any, Any]:
        watch = dr.gather(mi.Int32, self.watch, pixel, active)
        return UInt32(dr.maximum(watch, 0)) * self.batches + batch, active & (watch >= 0)

    def evaluate(self) -> None:
        """Run what was added so far."""
        kept = [rows for rows in (self.rows, self.watched, self.plain) if rows is not None]
        dr.eval(self.totals, [rows.moments for rows in kept])
