"""Curves of error against seconds: time at equal error, and slopes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

MONTE_CARLO = -0.5  # log-log slope of error against seconds
FLATTENED = -0.25  # a slope above this is no Monte-Carlo convergence any more, but a bias
FARTHEST = 100  # times the longest time measured


@dataclass(frozen=True)
class Point:
    """One measured quality: seconds and relative error."""

    seconds: float
    error: float


@dataclass(frozen=True)
class Reached:
    """Seconds to reach an error, and how that is known.

    interpolated  between two measured points, log-log
    cheapest      the cheapest measured point is better already: an upper bound
    extrapolated  beyond the best measured point, see `seconds_at`
    flattened     not reached: the curve had flattened before, or is too far from it; seconds is inf
    """

    seconds: float
    how: str


def front(points: list[Point]) -> list[Point]:
    """Return the points that no cheaper point beats, by rising seconds and falling error; errors of 0 are below
    resolution."""
    kept: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.error)):
        if point.error > 0 and math.isfinite(point.error) and (not kept or point.error < kept[-1].error):
            kept.append(point)
    return kept


def slopes(points: list[Point]) -> list[float]:
    """Return d log(error) / d log(seconds) between consecutive qualities, in the order given; NaN where undefined."""
    found = []
    for left, right in pairwise(points):
        run = math.log(right.seconds / left.seconds)
        known = left.error > 0 and right.error > 0 and run != 0
        found.append(math.log(right.error / left.error) / run if known else math.nan)
    return found


def flattens(points: list[Point]) -> bool:
    """Return the last step, to a dearer quality, no longer lowers the error as Monte Carlo would."""
    last = slopes(points)[-1:]
    return bool(last) and points[-1].seconds > points[-2].seconds and last[0] > FLATTENED


def seconds_at(points: list[Point], error: float, *, kindly: bool = False) -> Reached:
    """Return seconds that a method needs for an error. `points` in the order of their quality.

    Beyond the best point error ~ seconds^-1/2 goes on, or the curve's own last slope where that is flatter; `kindly`,
    where that is steeper (stratified samples converge faster than plain ones), but no steeper than -1. Not farther than
    FARTHEST times the longest time measured: what fireflies make of a slope says nothing.
    """
    curve = front(points)
    if not curve:
        return Reached(math.inf, "flattened")
    if curve[0].error <= error:
        return Reached(curve[0].seconds, "cheapest")
    for left, right in pairwise(curve):
        if right.error <= error:
            fraction = math.log(left.error / error) / math.log(left.error / right.error)
            return Reached(left.seconds * (right.seconds / left.seconds) ** fraction, "interpolated")
    if flattens(points):
        return Reached(math.inf, "flattened")
    own = slopes(curve[-2:]) or [MONTE_CARLO]
    slope = max(min(own[0], MONTE_CARLO), -1.0) if kindly else max(own[0], MONTE_CARLO)
    best = curve[-1]
    times = -math.log(best.error / error) / slope  # in logarithms: next to no slope would overflow
    if times > math.log(FARTHEST * max(point.seconds for point in points) / best.seconds):
        return Reached(math.inf, "flattened")
    return Reached(best.seconds * math.exp(times), "extrapolated")


@dataclass(frozen=True)
class Ratio:
    """Speed-up of our renderer over the other one at one error.

    at_least: ours is better than asked at its cheapest, and could be cheaper still
    extrapolated: which curves were carried on beyond what was measured ("", "ours", "theirs", "both")
    """

    error: float
    ours_seconds: float
    theirs_seconds: float
    ratio: float
    at_least: bool
    extrapolated: str


def ratio_at(ours: list[Point], theirs: list[Point], error: float) -> Ratio:
    """Return time ratio at equal error; 0 where ours does not reach it, NaN where neither does, inf where only ours
    does.

    Where a curve must be carried on, the doubt is theirs to gain.
    """
    mine, other = seconds_at(ours, error), seconds_at(theirs, error, kindly=True)
    both = math.isinf(mine.seconds) and math.isinf(other.seconds)
    ratio = math.nan if both else other.seconds / mine.seconds
    carried = (mine.how == "extrapolated", other.how == "extrapolated")
    name = {(False, False): "", (True, False): "ours", (False, True): "theirs", (True, True): "both"}[carried]
    # where theirs is at its cheapest, too, its time is an upper bound: the ratio is of the two cheapest, and no bound
    at_least = mine.how == "cheapest" and other.how != "cheapest"
    return Ratio(error, mine.seconds, other.seconds, ratio, at_least, name)
