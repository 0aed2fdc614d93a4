"""Jitter after the choice of a detector that may be blind: closed forms, by every route that draws it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_laws import same

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.random_streams import Stream
from spad.detection.detect import sense
from spad.detection.photons import draw_primaries, light_of
from spad.detection.rates import rates_for
from spad.sensor.model import PhotonBudget, Pulse, Sensor

PERIOD_S = 100e-9
WIDTH_S = PERIOD_S / 1024
FAST = Sensor(name="fast", bins=1024, bin_width_s=WIDTH_S, pulse=Pulse(20e-12), exposure_s=500 * PERIOD_S)
PLACE = np.arange(1024) + 0.5


def first_arrival(mean: float, sigma: float) -> tuple[float, float]:
    """Mean and standard deviation of the first of Poisson(mean) Gaussian times, where there is one."""
    x = np.linspace(-9, 9, 200_001)
    density = stats.norm.pdf(x) * np.exp(-mean * stats.norm.cdf(x))
    density /= density.sum()
    middle = float(density @ x)
    return middle * sigma, float(np.sqrt(density @ (x - middle) ** 2)) * sigma


@pytest.mark.parametrize("within", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("jitter_s", [1e-10, 1e-9])
@pytest.mark.parametrize(
    ("law", "dense_from"), [("first-photon", np.inf), ("first-photon", 0.0), ("free-running", np.inf)], ids=str
)
def test_the_first_photon_is_detected_and_then_late(law, dense_from, jitter_s, within, monkeypatch) -> None:
    """5 photons a cycle from a point that arrive anywhere within a bin five times as wide as the pulse."""
    monkeypatch.setattr("spad.detection.exposure.DENSE_FROM", dense_from)
    free = law == "free-running"
    sensor = replace(FAST, jitter=Pulse(jitter_s), reset="free-running" if free else "synchronous")
    sensor = replace(sensor, dead_time_s=20e-9 * free)
    path = (100 + within) * WIDTH_S * SPEED_OF_LIGHT_M_PER_S
    light = same(100, (path, path, 1.0))
    counts = sense(light, sensor, PhotonBudget(5 * sensor.cycles, 0), seed=4, model=law).counts.sum(axis=(0, 1))
    number = counts.sum()
    mean = counts @ PLACE / number
    spread = np.sqrt(counts @ (PLACE - mean) ** 2 / number)
    early, pulse = first_arrival(5, 20e-12)
    # a bin's centre stands for its times: a Gaussian of a bin or more is off by 1e-4 of its width at most
    deviation = np.sqrt((jitter_s**2 + pulse**2) / WIDTH_S**2 + 1 / 12)
    assert abs(mean - (100 + within + early / WIDTH_S)) < 4.5 * deviation / np.sqrt(number) + 2e-3
    assert abs(spread - deviation) < 4.5 * deviation / np.sqrt(2 * number) + 2e-3
    cycles = 100 * 500 * -np.expm1(-5)
    assert abs(number - cycles) < 4.5 * np.sqrt(cycles * np.exp(-5)) + 1


@pytest.mark.parametrize("beyond_s", [-20e-12, 0.0, 30e-12])
@pytest.mark.parametrize("dense_from", [0.0, np.inf])
@pytest.mark.parametrize("pulse", [Pulse(10e-12), Pulse(10e-12, 150e-12)], ids=["Gaussian", "tail"])
def test_a_return_beside_the_edge_of_a_bin_far_wider_than_its_rise(pulse, dense_from, beyond_s, monkeypatch) -> None:
    """First photons of a return about the edge of two bins of 1.25 ns: their shares, after a jitter of 30 ps."""
    monkeypatch.setattr("spad.detection.exposure.DENSE_FROM", dense_from)
    width_s, cycles, mean, jitter_s = 1.25e-9, 2000, 1.0, 30e-12
    sensor = Sensor(bins=24, bin_width_s=width_s, pulse=pulse, jitter=Pulse(jitter_s), exposure_s=cycles * 24 * width_s)
    path = (12 * width_s + beyond_s) * SPEED_OF_LIGHT_M_PER_S
    counts = sense(same(100, (path, path, 1.0)), sensor, PhotonBudget(mean * cycles, 0), seed=4, model="first-photon")
    time_s = np.linspace(-1e-10, 4e-9, 400_001) - pulse.tail_s + beyond_s
    arrived = np.concatenate(([0.0], np.cumsum(pulse.bin_masses(time_s - beyond_s))))
    first = -np.diff(np.exp(-mean * arrived))  # share of the cycles whose first photon comes in each step
    before = first @ stats.norm.cdf(-(time_s[1:] + time_s[:-1]) / 2 / jitter_s)
    number = 100 * cycles
    found = counts.counts[..., :12].sum()
    assert abs(found - number * before) < 4.5 * np.sqrt(number * before) + 1e-3 * number
    every = number * -np.expm1(-mean)
    assert abs(counts.counts.sum() - every) < 4.5 * np.sqrt(every)


def test_a_period_of_more_bins_than_a_sensor_has_is_drawn_photon_by_photon() -> None:
    """A gate of 100 ns in a period of 100 us, with as much background as drawing every bin at once pays off for."""
    sensor = Sensor(bins=100, bin_width_s=1e-9, period_s=1e-4, pulse=Pulse(1e-9), exposure_s=500 * 1e-4)
    light, budget = same(4, (3.0, 3.0, 1.0)), PhotonBudget(500, 500_000)
    for jitter in (None, Pulse(1e-9)):
        total = sense(light, replace(sensor, jitter=jitter), budget, seed=1, model="first-photon").counts.sum()
        seen = 1 - np.exp(-1 - 1)  # of a cycle's signal and the background in the gate, one photon each
        assert abs(total - 2000 * seen) < 4.5 * np.sqrt(2000 * seen * (1 - seen)) + 1


def test_without_memory_the_draws_are_those_of_all_kernels_at_once() -> None:
    sensor = replace(FAST, jitter=Pulse(1e-9))
    light, budget = same(8, (3.0, 3.2, 1.0)), PhotonBudget(40, 60)
    drawn = sense(light, sensor, budget, seed=5, model="poisson").counts
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(5, spawn_key=(Stream.SENSE, 0, 0))))
    rates = rates_for(light, sensor, budget, seed=5)
    events = draw_primaries(light_of(light, sensor, rates, slice(0, 8)), sensor, rng)
    plain = np.zeros((8, 1024), int)
    np.add.at(plain, (events.pixel, events.position), 1)
    np.testing.assert_array_equal(drawn[0], plain)


def test_crosstalk_of_a_detector_with_memory_is_late_too() -> None:
    """One lit pixel beside a dark one: what it fires has jitter of its own, and no less of it."""
    sensor = replace(FAST, jitter=Pulse(1e-9), crosstalk=0.05, exposure_s=20_000 * PERIOD_S)
    light = replace(same(2, (3.0, 3.0, 1.0)), radiance=np.array([1.0, 0.0], np.float32))
    counts = sense(light, sensor, PhotonBudget(2.5 * sensor.cycles, 0), seed=4, model="first-photon").counts[0]
    deviation = np.hypot(np.hypot(1e-9, first_arrival(5, 20e-12)[1]) / WIDTH_S, 12**-0.5)
    for one in counts:
        spread = np.sqrt(one @ (PLACE - one @ PLACE / one.sum()) ** 2 / one.sum())
        assert abs(spread - deviation) < 4.5 * deviation / np.sqrt(2 * one.sum())
