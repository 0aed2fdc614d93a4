"""Detection laws: what a detector that is blind for a while makes of its primary detections, and how to undo it.

Two exact routes for a synchronous detector: the multinomial of all cycles at once, p_k = exp(-sum_(j<k) mu_j)
(1 - exp(-mu_k)) (Gupta 2019, Heide 2018), whose cost follows bins; and the first of the primary detections of each
cycle, whose cost follows photons. A free-running detector goes event by event, all pixels side by side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from scenes.errors import InputError
from spad.sensor.model import Sensor

# Below 1 % detections per cycle dead time and pile-up change nothing that counts could show.
LOW_FLUX = 0.01


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


def first_photon_counts(flux: np.ndarray, cycles: int, rng: np.random.Generator) -> np.ndarray:
    """Return counts of a synchronous detector, (n_1 .. n_T, none) ~ Multinomial(cycles, p): (P, T) int64."""
    return rng.multinomial(cycles, first_photon_masses(flux))[:, :-1]


class Detections(NamedTuple):
    """Detections of an event-by-event law: pixel, laser cycle and position in bins within the period, (M,) each."""

    pixel: np.ndarray
    cycle: np.ndarray
    position: np.ndarray


def first_of_each_cycle(events: Detections, sensor: Sensor) -> Detections:
    """Return those that are the first in their pixel and cycle, by pixel and cycle; positions are whole bins, or times
    within the period."""
    if events.position.dtype.kind == "f":
        order = np.lexsort((events.position, events.cycle, events.pixel))
        pixel, cycle = events.pixel[order], events.cycle[order]
        new = (pixel[1:] != pixel[:-1]) | (cycle[1:] != cycle[:-1])
        first_ones = order[np.concatenate((np.ones(min(1, len(order)), bool), new))]
        return Detections(*(column[first_ones] for column in events))
    cycles, bins = int(events.cycle.max(initial=0)) + 1, sensor.bins
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
    """
    early = time < ready[pixel]
    order = np.flatnonzero(~early)
    order = order[np.lexsort((time[order], pixel[order]))]
    if not len(order):
        return order
    where, when = pixel[order], time[order]
    new_pixel = np.concatenate(([True], where[1:] != where[:-1]))
    # one increasing axis for all pixels, more than a dead time apart
    span = float(when.max()) + 2 * dead + 1
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
    last = np.flatnonzero(detected)
    ready[where[last]] = np.maximum(ready[where[last]], when[last] + dead)  # ascending: the last one stays
    return order[last]


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
    neighbour."""
    rows, columns, bins = np.nonzero(counts)
    number = counts[rows, columns, bins]
    for down, right in NEIGHBOURS:
        fired = rng.binomial(number, fraction)
        row, column = rows + down, columns + right
        inside = (fired > 0) & (row >= 0) & (row < counts.shape[0]) & (column >= 0) & (column < counts.shape[1])
        counts[row[inside], column[inside], bins[inside]] += fired[inside].astype(counts.dtype)


# Inverses


def coates(counts: Tensor, cycles: float) -> Tensor:
    """Return flux per cycle from a synchronous detector's counts (Coates 1968), the maximum-likelihood estimate:

    mu_k = ln[(N - sum_(j<k) n_j) / (N - sum_(j<=k) n_j)], (..., T) -> (..., T) float64. Where no cycle is left after
    bin k, its count is taken half a count lower; where none is left before, nothing is known and mu_k is 0. Raises
    InputError for more counts than cycles.
    """
    arrived = counts.double().cumsum(-1)
    if arrived.numel() and float(arrived[..., -1].max()) > cycles * (1 + 1e-9) + 0.5:
        raise InputError(
            f"a pixel has {float(arrived[..., -1].max()):g} detections in {cycles:g} cycles: "
            "not a synchronous detector's histogram of first photons"
        )
    after = cycles - arrived
    before = after + counts.double()
    return torch.where(before > 0.5, torch.log(before.clamp(min=0.5) / after.clamp(min=0.5)), 0.0).clamp(min=0)


def free_running_flux(counts: Tensor, cycles: float, sensor: Sensor) -> Tensor:
    """Return flux per cycle from a free-running detector's counts: each bin's count over the cycles that were live in
    it.

    In the steady state the detector is blind in bin k of those cycles in which it detected something less than a dead
    time earlier: blind_k = sum_j a_j n_(k-j) over the bins of one dead time before, whole periods of it counting
    every detection (Rapp 2019). mu_k = -ln(1 - n_k / (N - blind_k)) where the dead time is longer than a bin, as only
    one detection a cycle fits; n_k / (N - blind_k) below. (..., T) -> (..., T) float64. A sensor whose bins do not
    cover its period is refused by InputError.
    """
    if sensor.bins != sensor.bins_per_period:
        raise InputError(f"sensor {sensor.name}: the dead-time correction needs bins that cover the period")
    counts = counts.double()
    dead = sensor.dead_time_s / sensor.bin_width_s
    if dead == 0:
        return counts / cycles
    # A detection is at a uniform place in its bin, and so is the photon: the share of pairs at a distance under the
    # dead time is the integral of a triangle. It is 1 up to `whole`, of which each period holds one of every bin: a
    # dead time of many periods takes no more memory than a short one. Bin k itself is the logarithm's part.
    whole = max(int(dead - 1), 0)
    bins = torch.arange(sensor.bins, device=counts.device)
    kernel = ((whole - bins) // sensor.bins + (bins > 0)).double()
    for distance in range(whole + 1, int(dead) + 2):
        near = dead - distance
        kernel[distance % sensor.bins] += 1 - (1 - near) ** 2 / 2 if near >= 0 else (1 + near) ** 2 / 2
    if dead < 1:
        kernel[0] += dead - dead**2 / 2
    spectrum = torch.fft.rfft(counts) * torch.fft.rfft(kernel)
    blind = torch.fft.irfft(spectrum, n=sensor.bins)
    live = (cycles - blind).clamp(min=0.5)
    ratio = counts / live
    if dead < 1:
        return ratio
    return -torch.log1p(-ratio.clamp(max=1 - 0.5 / cycles))


def linearised(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return counts as they would be without pile-up, (..., T) float64: `coates`, or `free_running_flux`, times the
    cycles.

    Pixels with at most 1 % detections per cycle (or dead time, if longer) keep their counts: what would change is a
    hundredth of one, which does nothing but decide between equal maxima.
    """
    counts = counts.double()
    if sensor.reset == "synchronous":
        corrected = coates(counts, sensor.cycles) * sensor.cycles
    else:
        corrected = free_running_flux(counts, sensor.cycles, sensor) * sensor.cycles
    blind = max(1.0, sensor.dead_time_s / sensor.period_s)
    few = counts.sum(-1, keepdim=True) * blind <= LOW_FLUX * sensor.cycles
    return torch.where(few, counts, corrected)
