"""Detection laws: what a detector that is blind for a while makes of its primary detections.

Two exact routes for a synchronous detector: the multinomial of all cycles at once, p_k = exp(-sum_(j<k) mu_j)
(1 - exp(-mu_k)) (Gupta 2019, Heide 2018), whose cost follows bins; and the first of the primary detections of each
cycle, whose cost follows photons. A free-running detector goes event by event, all pixels side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scenes.errors import require
from spad.sensor.model import Sensor

# Below 1 % detections per cycle dead time and pile-up change nothing that counts could show.
LOW_FLUX = 0.01
Moved = Callable[[np.ndarray], np.ndarray]


def first_photon_masses(flux: np.ndarray) -> np.ndarray:
    """Return p_k, the share of cycles whose first photon falls into bin k, and last the share without one.

    flux (P, T) expected primary detections per cycle and bin -> (P, T + 1) float64, rows sum to 1.
    """
    before = np.cumsum(flux, axis=-1)
    fractions = np.empty((len(flux), flux.shape[1] + 1))
    np.exp(-before, out=fractions[:, 1:])
    fractions[:, -1] = np.exp(-before[:, -1])
    np.exp(flux - before, out=fractions[:, :-1])
    fractions[:, :-1] *= -np.expm1(-flux)
    return fractions / fractions.sum(axis=-1, keepdims=True)  # a multinomial refuses a sum 1e-12 above 1


def first_photon_counts(
    flux: np.ndarray, cycles: int, rng: np.random.Generator, moved: Moved | None = None
) -> np.ndarray:
    """Return counts of a synchronous detector, (n_1 .. n_T, none) ~ Multinomial(cycles, p): (P, T) int64.

    `moved`, if given, maps the shares of the bins to those after jitter, which moves detections and makes none.
    """
    masses = first_photon_masses(flux)
    if moved is not None:
        seen = moved(masses[:, :-1])
        masses = np.append(seen, np.clip(1 - seen.sum(axis=1, keepdims=True), 0, None), axis=1)
        masses /= masses.sum(axis=1, keepdims=True)
    return rng.multinomial(cycles, masses)[:, :-1]


class Detections(NamedTuple):
    """Detections of an event-by-event law: pixel, laser cycle and position in bins within the period, (M,) each."""

    pixel: np.ndarray
    cycle: np.ndarray
    position: np.ndarray


def first_of_each_cycle(events: Detections, sensor: Sensor) -> Detections:
    """Return those that are the first in their pixel and cycle, by pixel and cycle; positions are whole bins, or times
    within the period."""
    cycles, bins = int(events.cycle.max(initial=0)) + 1, sensor.bins
    places = (int(events.pixel.max(initial=0)) + 1) * cycles * bins
    if events.position.dtype.kind == "f" or places >= 1 << 63:  # one number tells every bin of every cycle below that
        order = np.lexsort((events.position, events.cycle, events.pixel))
        pixel, cycle = events.pixel[order], events.cycle[order]
        new = (pixel[1:] != pixel[:-1]) | (cycle[1:] != cycle[:-1])
        first_ones = order[np.concatenate((np.ones(min(1, len(order)), bool), new))]
        return Detections(*(column[first_ones] for column in events))
    place = np.sort((events.pixel.astype(np.int64) * cycles + events.cycle) * bins + events.position)
    group = place // bins
    first = place[np.concatenate(([True], group[1:] != group[:-1]))] if len(place) else place
    pixel_cycle, position = np.divmod(first, bins)
    return Detections(*np.divmod(pixel_cycle, cycles), position)


def live_detections(pixel: np.ndarray, time: np.ndarray, dead: float, ready: np.ndarray) -> np.ndarray:
    """Return indices of the detections of a free-running detector with a non-paralysable dead time, by pixel and time.

    A photon is detected unless one was detected less than `dead` before; photons in the dead time do not prolong it.
    pixel, time (M,) of the primary detections in any order, time and dead in one unit; ready (P,) is when each pixel
    is armed first, and is moved on to when it is armed after the last detection.

    Events farther than `dead` from the one before are detected whatever came earlier. Chains of closer ones are
    followed from detection to detection, all chains side by side.

    Pixels lie one behind the other on one axis of time, as many of them as float64 resolves to 2^-16 of the unit.
    """
    early = time < ready[pixel]
    order = np.flatnonzero(~early)
    order = order[np.lexsort((time[order], pixel[order]))]
    if not len(order):
        return order
    where, when = pixel[order], time[order]
    span = float(when.max()) + 2 * dead + 1  # more than a dead time between pixels
    together = max(1, min(len(ready), int(2.0**37 / span)))  # pixels are counted in 32 bits
    cuts = [0, *(np.flatnonzero(np.diff(where // together)) + 1), len(where)]
    detected = np.concatenate([_live(where[a:b] % together, when[a:b], dead, span) for a, b in pairwise(cuts)])
    last = np.flatnonzero(detected)
    ready[where[last]] = np.maximum(ready[where[last]], when[last] + dead)  # ascending: the last one stays
    return order[last]


def _live(where: np.ndarray, when: np.ndarray, dead: float, span: float) -> np.ndarray:
    """Return which of some pixels' events, ascending by pixel and time, are detected; a pixel's axis is `span` long."""
    new_pixel = np.concatenate(([True], where[1:] != where[:-1]))
    axis = when + where * span
    sure = new_pixel | np.concatenate(([True], np.diff(axis) >= dead))
    following = np.maximum(np.searchsorted(axis, axis + dead), np.arange(1, len(axis) + 1))  # also without dead time
    detected = sure.copy()
    chain = np.flatnonzero(sure)
    ends = np.concatenate((chain[1:], [len(axis)]))
    while len(chain):
        chain = following[chain]
        going = chain < ends
        chain, ends = chain[going], ends[going]
        detected[chain] = True
    return detected


NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0))


def crosstalk_events(
    pixel: np.ndarray, fraction: float, height: int, width: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return detections that others fire in their neighbours: (index of the cause, pixel), each (M',) int64.

    Every detection fires each of its neighbours with probability `fraction`, independently; none beyond the array's
    edge.
    """
    causes, pixels = [], []
    for down, right in NEIGHBOURS:
        cause = np.flatnonzero(rng.random(len(pixel)) < fraction)
        row, column = pixel[cause] // width + down, pixel[cause] % width + right
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        causes.append(cause[inside])
        pixels.append(row[inside] * width + column[inside])
    return np.concatenate(causes), np.concatenate(pixels)


def add_crosstalk(counts: np.ndarray, fraction: float, rng: np.random.Generator) -> None:
    """Add crosstalk to counts (H, W, T), in place: Binomial(n, fraction) detections in the same bin of each
    neighbour. Raises InputError for more counts in a bin than the counts' type holds."""
    limit = np.iinfo(counts.dtype).max
    rows, columns, bins = np.nonzero(counts)
    number = counts[rows, columns, bins]
    for down, right in NEIGHBOURS:
        fired = rng.binomial(number, fraction)
        row, column = rows + down, columns + right
        inside = (fired > 0) & (row >= 0) & (row < counts.shape[0]) & (column >= 0) & (column < counts.shape[1])
        place = row[inside], column[inside], bins[inside]
        both = counts[place].astype(np.int64) + fired[inside]
        most = both.max(initial=0)
        require(most <= limit, f"a bin holds {most} counts, the limit is {limit}")
        counts[place] = both
