"""Jitter of detections: what delays a timestamp after a detector that may be blind has chosen among the photons.

Which photon a detector with a dead time detects is decided as photons arrive, blurred by the laser's pulse alone. The
avalanche's build-up, the read-out and the clock delay the timestamp of the detection afterwards. Where no detection
keeps another one from being made, the order does not matter, and all kernels are drawn at once.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import reduce

import numpy as np

from spad.detection.laws import Detections
from spad.sensor.model import Sensor
from spad.sensor.pulse import REACH_SIGMAS, AnyPulse, Pulse, convolved

STEPS_PER_SIGMA = 4  # of the pulse
MAX_BINS, FINEST_S = 65536, 1e-15  # of a sensor
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


def before_detection(sensor: Sensor) -> Sensor:
    """Return the sensor as photons reach it: without the jitter of the detector and of the clock."""
    clock = None if sensor.tdc is None else replace(sensor.tdc, jitter_s=0.0)
    return replace(sensor, jitter=None, tdc=clock)


def steps_per_bin(sensor: Sensor) -> int:
    """Return into how many steps a bin is divided before jitter: finer than the pulse rises, as the first photons of a
    cycle are not uniform within a bin. As many as a sensor's bins hold; 0 where not even the bins of a period do."""
    pulse = sensor.pulse
    rise_s = pulse.sigma_s if isinstance(pulse, Pulse) else pulse.std_s
    finest = max(1, int(sensor.bin_width_s / FINEST_S))
    wanted = math.ceil(min(STEPS_PER_SIGMA * sensor.bin_width_s / rise_s, finest))
    return min(wanted, MAX_BINS // sensor.bins_per_period)


def over_the_period(sensor: Sensor) -> Sensor:
    """Return a sensor `before_detection` whose bins, equal ones, are the steps of the whole period: jitter moves
    detections into the record from outside."""
    steps = steps_per_bin(sensor)
    bins, width = sensor.bins_per_period * steps, sensor.bin_width_s / steps
    return replace(before_detection(sensor), bins=bins, bin_width_s=width, period_s=bins * width, tdc=None)


def delayed(events: Detections, sensor: Sensor, rng: np.random.Generator) -> Detections:
    """Return detections, at times in bins, with the sensor's jitter; times are folded into the period."""
    position = events.position.astype(np.float64)
    for kernel in sensor.jitters:
        position += kernel.draw(rng, len(position)) / sensor.bin_width_s
    position %= sensor.bins_per_period
    position[position >= sensor.bins_per_period] = 0  # a tiny negative one rounds up to the period itself
    return events._replace(position=position)


def blurred(masses: np.ndarray, sensor: Sensor, converter: np.ndarray | None) -> np.ndarray:
    """Return the fractions of detections in the sensor's bins, (P, bins), of those in the steps of the period, (P, T).

    Detections are uniform within a step before jitter, and after it where converters have unequal bins. `converter`
    (P,) is a row of `Sensor.code_edges`, or None.
    """
    steps = steps_per_bin(sensor)
    kernel = _folded(reduce(convolved, sensor.jitters), sensor)
    spectrum = np.fft.rfft(masses) * np.fft.rfft(kernel)
    moved = np.clip(np.fft.irfft(spectrum, n=masses.shape[-1]), 0, None)
    edges = sensor.code_edges
    if edges is None or converter is None:
        return moved.reshape(len(moved), -1, steps).sum(axis=2)[:, : sensor.bins]
    arrived = np.concatenate((np.zeros((len(moved), 1)), np.cumsum(moved, axis=1)), axis=1)
    whole = np.arange(arrived.shape[1]) / steps
    at_edges = (
        np.interp(edges[row] % sensor.bins_per_period, whole, mine) + mine[-1] * (edges[row] // sensor.bins_per_period)
        for row, mine in zip(converter, arrived, strict=True)
    )
    return np.clip(np.diff(np.stack(list(at_edges)), axis=1), 0, None)


def _folded(jitter: AnyPulse, sensor: Sensor) -> np.ndarray:
    """Return fractions of detections that jitter moves by 0, 1, ... steps around the period, (T,)."""
    steps = steps_per_bin(sensor)
    period, width = sensor.bins_per_period * steps, sensor.bin_width_s / steps
    before, after = jitter.window_s(REACH_SIGMAS)
    moves = np.arange(-int(np.ceil(abs(before) / width)) - 1, int(np.ceil(abs(after) / width)) + 2)
    edges = np.append(moves, moves[-1] + 1)
    fractions = sum(
        w / 2 * jitter.bin_masses((edges - (1 + u) / 2) * width) for u, w in zip(_NODES, _WEIGHTS, strict=True)
    )
    kernel = np.zeros(period)
    np.add.at(kernel, moves % period, fractions)
    return kernel / kernel.sum()
