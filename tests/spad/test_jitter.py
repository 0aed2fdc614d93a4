"""Jitter of a detector that may be blind: arrivals decide what is detected, and timestamps are late afterwards.

Each case is simulated cycle by cycle, photon by photon, by a second route, and compared bin by bin and in its moments.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_laws import same

from spad.detection.detect import sense
from spad.detection.jitter import before_detection
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.tdc import Tdc

BINS, WIDTH_S, CYCLES = 128, 500e-12, 2000
PATH_M = 3.0
ARRIVAL = PATH_M / 299_792_458 / WIDTH_S  # bins
PULSE, JITTER = Pulse(100e-12), Pulse(1.5e-9, 1e-9)
SENSOR = Sensor(bins=BINS, bin_width_s=WIDTH_S, exposure_s=CYCLES * BINS * WIDTH_S, pulse=PULSE, jitter=JITTER)
SIGNAL, BACKGROUND = 3.0, 2.0  # photons a cycle


def simulated(sensor: Sensor, pixels: int, seed: int) -> np.ndarray:
    """Timestamps in bins of all detections: each photon of each cycle, one after the other, pixels side by side."""
    rng, period = np.random.default_rng(seed), sensor.bins_per_period
    dead = sensor.dead_time_s / sensor.bin_width_s
    ready, stamps = np.zeros(pixels), []
    for cycle in range(CYCLES):
        signal, steady = rng.poisson(SIGNAL, pixels), rng.poisson(BACKGROUND, pixels)
        most = int((signal + steady).max())
        times = np.full((pixels, most), np.inf)
        order = np.arange(most)
        arrival = ARRIVAL + rng.normal(0, PULSE.sigma_s / sensor.bin_width_s, times.shape)
        times = np.where(order < signal[:, None], arrival, times)
        uniform = rng.uniform(0, period, times.shape)
        times = np.where((order >= signal[:, None]) & (order < (signal + steady)[:, None]), uniform, times)
        times.sort(axis=1)
        if sensor.armed_every_cycle:
            ready[:] = cycle * period
        for at in times.T:
            absolute = cycle * period + at
            fires = np.isfinite(at) & (absolute >= ready)
            stamps.append(at[fires])
            ready[fires] = (cycle + 1) * period if sensor.armed_every_cycle else absolute[fires] + dead
    stamps = np.concatenate(stamps)
    late = rng.normal(0, JITTER.sigma_s, len(stamps)) + (rng.exponential(size=len(stamps)) - 1) * JITTER.tail_s
    return (stamps + late / sensor.bin_width_s) % period


CLOCK = Tdc(8e-9, codes=16, jitter_s=1e-12, dnl=0.3)
CASES = {
    "first photon, every bin at once": (SENSOR, 0.0),
    "first photon, photon by photon": (SENSOR, np.inf),
    "short record, every bin at once": (replace(SENSOR, bins=40, period_s=BINS * WIDTH_S), 0.0),
    "short record, photon by photon": (replace(SENSOR, bins=40, period_s=BINS * WIDTH_S), np.inf),
    "free-running": (replace(SENSOR, reset="free-running", dead_time_s=20e-9), np.inf),
    "converters, every bin at once": (replace(SENSOR, tdc=CLOCK), 0.0),
    "converters, photon by photon": (replace(SENSOR, tdc=CLOCK), np.inf),
}


@pytest.mark.parametrize(("sensor", "dense_from"), CASES.values(), ids=CASES.keys())
def test_arrivals_decide_and_timestamps_are_late(
    sensor: Sensor, dense_from: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spad.detection.exposure.DENSE_FROM", dense_from)
    pixels, budget = 24, PhotonBudget(SIGNAL * CYCLES, BACKGROUND * CYCLES)
    found = sense(same(pixels, (PATH_M, PATH_M, 1.0)), sensor, budget, seed=3)
    counts = found.counts[0]
    stamps = simulated(sensor, pixels, seed=4)
    edges = np.arange(sensor.bins + 1.0)[None] if sensor.code_edges is None else sensor.code_edges
    # a pixel has one of the converters; the second route's are as many of each
    rows = np.zeros(pixels, int) if found.sensor.tdc is None else sensor.converter_map(1, pixels, 3)[0]
    expected = np.mean([np.histogram(stamps, edges[row])[0] for row in rows], axis=0)
    if sensor.code_edges is not None:
        wrapped = [np.histogram(stamps - sensor.bins_per_period, edges[row])[0] for row in rows]
        expected += np.mean(wrapped, axis=0)
    both = np.stack([counts.sum(axis=0), np.round(expected)])
    seen = both.sum(axis=0) > 20
    assert stats.chi2_contingency(both[:, seen]).pvalue > 1e-4
    # as many detections: a sum of independent cycles of at most some has a variance below twice its mean
    assert abs(both[0].sum() - both[1].sum()) < 4 * np.sqrt(2 * both.sum())


def test_jitter_does_not_sharpen_what_a_bright_pixel_records() -> None:
    """Five photons a cycle: the first avalanche is early by the pulse's width, not by the jitter's."""
    sensor = Sensor(pulse=Pulse(20e-12), jitter=Pulse(1e-9))
    counts = sense(same(8, (3.0, 3.0, 1.0)), sensor, PhotonBudget(5 * sensor.cycles, 0), seed=1).counts.sum(axis=(0, 1))
    place = np.arange(sensor.bins) + 0.5
    mean = np.average(place, weights=counts)
    spread = np.sqrt(np.average((place - mean) ** 2, weights=counts))
    arrival, jitter = 3.0 / 299_792_458 / sensor.bin_width_s, 1e-9 / sensor.bin_width_s
    # the earliest of five Gaussians is 1.16 sigmas early; some cycles hold fewer: at most two sigmas of the pulse
    assert arrival - 2 * 20e-12 / sensor.bin_width_s < mean < arrival + 4 * jitter / np.sqrt(counts.sum())
    assert spread == pytest.approx(jitter, rel=0.01)


def test_a_sensor_before_detection_has_the_pulse_alone() -> None:
    sensor = replace(SENSOR, tdc=CLOCK)
    assert before_detection(sensor).kernels == (PULSE,) and len(sensor.kernels) == 3
