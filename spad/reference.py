"""Detection event by event, one photon after the other: read this first, then `spad.detection.laws`.

Slow and plain on purpose. Only tests and benches import this module.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def arrivals(flux: Sequence[float], cycles: int, rng: np.random.Generator) -> list[float]:
    """Draw the primary detections of one pixel, sorted in time.

    Parameters
    ----------
    flux : expected primary detections per laser cycle in each of T bins that cover the period
    cycles : laser cycles
    rng : source of randomness

    Returns
    -------
    times in bins since the first laser pulse; a photon is uniform within its bin
    """
    bins, times = len(flux), []
    for cycle in range(cycles):
        for place, mean in enumerate(flux):
            times += [cycle * bins + place + rng.random() for _ in range(rng.poisson(mean))]
    return sorted(times)


def detect_synchronous(times: Sequence[float], bins: int) -> np.ndarray:
    """Count the first photon of each laser cycle; all later ones of the cycle are lost: (T,) int64."""
    counts, last = np.zeros(bins, np.int64), -1
    for time in times:
        cycle = int(time // bins)
        if cycle != last:
            counts[int(time % bins)] += 1
            last = cycle
    return counts


def detect_free_running(times: Sequence[float], bins: int, dead_bins: float) -> np.ndarray:
    """Count photons of a detector that is blind for `dead_bins` after each detection, not prolonged: (T,) int64."""
    counts, ready = np.zeros(bins, np.int64), 0.0
    for time in times:
        if time >= ready:
            counts[int(time % bins)] += 1
            ready = time + dead_bins
    return counts


def time_bin(
    time_s: float, code_ends: Sequence[float], clock_period_s: float, bin_width_s: float, code_times: Sequence[float]
) -> int:
    """Return the bin that a time-to-digital converter puts a detection into.

    Parameters
    ----------
    time_s : true time after the laser's emission, within the laser's period
    code_ends : when each fine code ends, in clock periods after the clock's edge
    clock_period_s : period of the clock
    bin_width_s : width of the histogram's bins
    code_times : time that each fine code is taken for, in clock periods after the clock's edge

    Returns
    -------
    number of the bin
    """
    ticks = time_s / clock_period_s
    turn, within = int(ticks), ticks - int(ticks)
    code = 0
    while within >= code_ends[code]:
        code += 1
    return int((turn + code_times[code]) * clock_period_s / bin_width_s + 1e-9)


def code_overlap(edges: Sequence[float]) -> np.ndarray:
    """Return M[t, r], the share of a converter's bin r that lies in true bin t: edges (bins + 1,) -> (bins, bins).

    Parameters
    ----------
    edges : edges of the converter's bins in true time, in bins

    Returns
    -------
    columns that sum to 1, and are 0 for a bin that never comes
    """
    bins = len(edges) - 1
    overlap = np.zeros((bins, bins))
    for place in range(bins):
        width = edges[place + 1] - edges[place]
        for true in range(bins):
            common = min(edges[place + 1], true + 1) - max(edges[place], true)
            if width > 0 and common > 0:
                overlap[true, place] = common / width
    return overlap
