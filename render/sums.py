"""Where the light of paths is added: per pixel and cell, per watched pixel, batch and cell, per pixel and batch."""

from __future__ import annotations

from typing import Any

import numpy as np

from render.cells import Rows
from render.world import Float, UInt32, dr, mi, upload


class Sums:
    """Where connections are added: rows of the pixels' cells, finer rows of watched pixels by batch, totals by batch.

    origin_m   zero of every pixel's cells
    watch      the watched row of every pixel, -1 for none
    batches    rounds take turns: round r belongs to batch r modulo this
    rounds     paths of every pixel: each counts one of them
    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(
        self,
        rows: Rows,
        origin_m: np.ndarray,
        *,
        rounds: np.ndarray,
        batches: int,
        watched: Rows | None = None,
        watch: np.ndarray | None = None,
    ) -> None:
        self.rows, self.watched = rows, watched
        self.origin_m = upload(Float, origin_m)
        self.watch = None if watch is None else upload(mi.Int32, watch)
        self.totals = dr.zeros(mi.UInt64, rows.rows * batches)
        self.batches = dr.opaque(UInt32, batches)
        self._scale = upload(Float, 1 / rounds)

    def add(self, pixel: Any, batch: Any, path: Any, radiance: Any, active: Any) -> Any:
        """Add samples to the pixels' and the watched rows; returns what was added, for `add_total`."""
        x = path - dr.gather(Float, self.origin_m, pixel, active)
        radiance *= dr.gather(Float, self._scale, pixel, active)
        radiance = dr.select(active & dr.isfinite(radiance), radiance, 0)
        active = active & (radiance > 0)  # not in place: the caller goes on with its own
        self.rows.add(pixel, x, radiance, active)
        if self.watched is not None:
            watch = dr.gather(mi.Int32, self.watch, pixel, active)
            row = UInt32(dr.maximum(watch, 0)) * self.batches + batch
            self.watched.add(row, x, radiance * Float(self.batches), active & (watch >= 0))
        return radiance

    def add_total(self, pixel: Any, batch: Any, radiance: Any) -> None:
        dr.scatter_add(
            self.totals,
            self.rows.quanta(radiance),
            pixel * self.batches + batch,
            radiance > 0,
            mode=dr.ReduceMode.Direct,
        )

    def evaluate(self) -> None:
        """Run what was added so far."""
        watched = [] if self.watched is None else [self.watched.energy, self.watched.moment]
        dr.eval(self.rows.energy, self.rows.moment, self.totals, *watched)
