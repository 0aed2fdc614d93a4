"""Intervals of errors and of shares: Student's can reach where neither is."""

from __future__ import annotations

from collections.abc import Sequence

from csph.evaluation.methods import Evaluation
from csph.evaluation.metrics import Interval


def interval_of(
    evaluation: Evaluation, names: Sequence[str], *, pixels: str = "all", levels: str = "all", figure: str = "mae_mm"
) -> Interval | None:
    """Return the mean over scenes of an error or a share, with its interval ended at 0, and of a share at 1; None where
    there is no finite value."""
    found = evaluation.interval(names, pixels, levels, figure)
    return None if found is None else ended(found, figure)


def ended(interval: Interval, figure: str) -> Interval:
    """Return an interval of an error (`mae_mm`, `rmse_mm`) or a share (`within_10mm`), ended at 0, and at a share's
    1."""
    top = 1.0 if figure.startswith("within_") else float("inf")
    low, high = (min(max(end, 0.0), top) if end == end else end for end in (interval.low, interval.high))
    return Interval(interval.mean, low, high)
