"""Tell whether captures can calibrate a multi-zone sensor: their distances before the fit, its result after it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import require
from spad.sensor.model import Sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.calibration import Calibration, sees_return

# Effects that show in how a return moves with distance: one distance cannot tell a late zone from a slow clock.
OF_TIME = ("delay", "clock", "bin_width", "chirp")
MIN_DISTANCES = 4  # delay, clock and chirp are three numbers of a line and its bend; one more distance to check them
# Bins that a return has to move by. Its place is known to a bin at the worst, so a slope to a quarter.
MIN_SPAN_BINS = 4.0
# How far a return may move, over what it should. Bins are known to some per cent before they are fitted; the nearest
# mistake, a path for a distance, is a factor of 2, and this is half way to it.
SLOPE_LIMIT = math.sqrt(2)
ORDER = "are captures in another order, or are these paths?"
WRONG = "do distance_m and counts belong together, and the sensor to both?"
# Relative error of a model that says something of the sensor. Of a TMF8820 all effects leave 2 %, the background alone,
# without delays and saturation, 48 %; distances of other captures leave 110 % and more.
MISFIT_LIMIT = 0.7
POISSON_DEVIANCE = 2.0  # above what Poisson noise alone leaves a bin: 1 of many counts, at most 1.2 of few
MAX_PAIRED = 256  # captures whose pairs are looked at


def check_distances(
    distance_m: np.ndarray, counts: np.ndarray, sensor: Sensor, zones: ZoneArray, free: Sequence[str]
) -> None:
    """Raise InputError where distances (N,) cannot be those of counts (N, Z, T), or are too few for what is fitted.

    In most zones the return has to move with distance as light does, within SLOPE_LIMIT. Where effects of time are
    fitted there have to be MIN_DISTANCES distances over MIN_SPAN_BINS bins.
    """
    span_bins = float(np.ptp(distance_m)) / sensor.bin_depth_m
    timed = [name for name in OF_TIME if name in free]
    if timed:
        number = len(np.unique(distance_m))
        unknown = f"which do not tell {', '.join(timed)}: expected"
        held = f"distinct distances in distance_m of the captures fitted: {number}"
        require(number >= MIN_DISTANCES, f"{held}, {unknown} {MIN_DISTANCES} or more")
        span = f"{distance_m.min():g} to {distance_m.max():g} m, {span_bins:.2g} bins"
        require(span_bins >= MIN_SPAN_BINS, f"distance_m spans {span}, {unknown} {MIN_SPAN_BINS:g} bins or more")
    if span_bins < MIN_SPAN_BINS:
        return
    ratio = return_speeds(distance_m, counts) / light_speeds(sensor, zones)
    wrong = ~((ratio > 1 / SLOPE_LIMIT) & (ratio < SLOPE_LIMIT))
    limits = f"{1 / SLOPE_LIMIT:.2f} to {SLOPE_LIMIT:.2f}"
    message = f"distance_m does not belong to counts: in {wrong.sum()} of {zones.count} zones the return moves"
    message += (
        f" {np.nanmedian(ratio[wrong]):.2f} times as far as light does" if np.isfinite(ratio[wrong]).any() else ""
    )
    require(2 * int(wrong.sum()) <= zones.count, f"{message}, expected {limits} times: {ORDER}")


def light_speeds(sensor: Sensor, zones: ZoneArray) -> np.ndarray:
    """Return how far a return from a plane moves in each zone, bins a metre of the plane's distance, (Z,)."""
    slant = np.sqrt(1 + np.square(zones.centre_x) + np.square(zones.centre_y))
    return 2 * slant / (SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s)


def return_speeds(distance_m: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return how far a return moves in each zone, bins a metre, (Z,): the median over all pairs of captures.

    What stands still, as background and light inside the module, is in every capture; the return is where a capture
    is farthest above it, by its noise. The median bears a quarter of captures that are so elsewhere.
    """
    some = np.unique(np.linspace(0, len(counts) - 1, min(len(counts), MAX_PAIRED)).round().astype(int))
    distance_m, counts = distance_m[some], counts[some]
    still = counts.min(axis=0)
    place = ((counts - still) / np.sqrt(np.maximum(still, 1))).argmax(axis=-1)
    seen = sees_return(counts)
    found = np.full(counts.shape[1], np.nan)
    for zone, (at, known) in enumerate(zip(place.T, seen.T, strict=True)):
        first, second = np.triu_indices(int(known.sum()), 1)
        moved, apart = (values[known][second] - values[known][first] for values in (at, distance_m))
        if apart.any():
            found[zone] = np.median(moved[apart != 0] / apart[apart != 0])
    return found


def check_fit(fitted: Calibration, counts: np.ndarray) -> None:
    """Raise InputError for a calibration of counts (N, Z, T) that says nothing of the sensor.

    Gains have to be known better than to their own size in most zones. Where the background is fitted, the deviance of
    n counts a bin has to be below POISSON_DEVIANCE + MISFIT_LIMIT^2 n. Where it is not, bins beside the return are off
    by all of their counts, and the deviance says nothing of the distances.
    """
    gain, error = np.asarray(fitted.zones.gain), fitted.errors["gain"]
    known = int((np.isfinite(gain) & np.isfinite(error) & (error < gain)).sum())
    message = f"the fit knows the gain of {known} of {len(gain)} zones, of the others not its order of magnitude"
    require(2 * known > len(gain), f"{message}: {WRONG}")
    deviance = fitted.deviance if fitted.deviance < math.inf else math.inf  # NaN is no fit, either
    misfit = math.sqrt(max(0.0, deviance - POISSON_DEVIANCE) / float(counts.mean()))
    message = f"the fit is wrong by {misfit:.0%} of a bin's counts, deviance {fitted.deviance:.3g} a bin"
    good = "background" not in fitted.free or misfit < MISFIT_LIMIT
    require(good, f"{message}, expected below {MISFIT_LIMIT:.0%}: {WRONG}")
