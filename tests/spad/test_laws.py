"""The laws of detection, by statistics whose tolerance comes from the sample size, and by a second route each."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from test_flux import transient_of

from spad.detection.detect import expected_in_pixel, sense
from spad.detection.laws import (
    Detections,
    add_crosstalk,
    crosstalk_events,
    first_of_each_cycle,
    first_photon_counts,
    first_photon_masses,
    live_detections,
)
from spad.estimators.pile_up import coates, free_running_flux, without_pile_up
from spad.sensor.model import PhotonBudget, Pulse, Sensor

REFERENCE = Sensor()
SMALL = Sensor(name="small", bins=64)


def sidak(alpha: float, tests: int) -> float:
    """Level of each of `tests` tests that are `alpha` together."""
    return 1 - (1 - alpha) ** (1 / tests)


def same(pixels: int, *returns: tuple[float, float, float]):
    """An image row whose pixels all see the same."""
    transient = transient_of(*[list(returns)] * pixels)
    return replace(transient, ambient=np.ones((1, pixels), np.float32))


# Poisson


@pytest.mark.parametrize("rate", [1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6])
@pytest.mark.parametrize("dense_from", [0.0, 4.0])
def test_poisson_dispersion(rate: float, dense_from: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """`rate` detections a bin in 4000 pixels, photon by photon and bin by bin: mean and variance are the rate."""
    monkeypatch.setattr("spad.detection.exposure.DENSE_FROM", dense_from)
    bins, pixels = (4, 4000) if rate < 1e5 else (1, 400)
    sensor = Sensor(bins=bins, bin_width_s=1e-9)
    counts = sense(same(pixels, (1.0, 1.0, 1.0)), sensor, PhotonBudget(0, rate * bins), seed=3, model="poisson").counts
    counts, number = counts.astype(float), counts.size
    # sum of n is Poisson(number rate): 1e-4 two-sided, exact; (n - rate)^2 has mean rate, variance rate + 2 rate^2
    total = counts.sum()
    low, high = stats.poisson.ppf([5e-5, 1 - 5e-5], number * rate)
    assert low <= total <= high
    spread = ((counts - rate) ** 2).sum() - number * rate
    assert abs(spread) < 4.5 * np.sqrt(number * (rate + 2 * rate**2)) + 1


def test_photon_by_photon_and_bin_by_bin_are_one_law(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two routes to the Poisson law: totals of 3000 pixels in every bin, chi-square of homogeneity."""
    pulse, jitter = Pulse(100e-12, 150e-12), Pulse(80e-12)
    sensor = Sensor(bins=64, pulse=pulse, jitter=jitter)
    scene, budget = same(3000, (0.3, 0.5, 1.0), (1.85, 1.85, 0.5)), PhotonBudget(8, 4)
    by_photon = sense(scene, sensor, budget, seed=1, model="poisson").counts[0].sum(axis=0)
    monkeypatch.setattr("spad.detection.exposure.DENSE_FROM", 0.0)
    by_bin = sense(scene, sensor, budget, seed=2, model="poisson").counts[0].sum(axis=0)
    both = np.stack([by_photon, by_bin])
    assert stats.chi2_contingency(both[:, both.sum(axis=0) > 20]).pvalue > 1e-3
    expected = 3000 * expected_in_pixel(scene, sensor, budget, 0, 0)
    for counts in both:
        assert stats.chisquare(counts, expected * counts.sum() / expected.sum()).pvalue > 1e-3
        assert abs(counts.sum() - expected.sum()) < 4 * np.sqrt(expected.sum())


# First photon


def by_hand(flux: np.ndarray, cycles: int, rng: np.random.Generator) -> np.ndarray:
    """Cycle after cycle: photons are drawn in every bin, the first bin that has one is counted."""
    counts = np.zeros(len(flux), dtype=int)
    for _ in range(cycles):
        fired = np.flatnonzero(rng.poisson(flux) > 0)
        if len(fired):
            counts[fired[0]] += 1
    return counts


@pytest.mark.parametrize("mean", [0.05, 1.0, 3.0])
def test_first_photon_is_the_event_by_event_simulation(mean: float) -> None:
    shape = np.full(64, 0.3 / 64)
    shape[20:24] += np.array([0.1, 0.3, 0.2, 0.1])
    flux, cycles = mean * shape / shape.sum(), 20000
    rng = np.random.default_rng(5)
    simulated = by_hand(flux, cycles, rng)
    counts = first_photon_counts(flux[None], cycles, rng)[0]
    fractions = first_photon_masses(flux[None])[0]
    assert fractions.sum() == pytest.approx(1, abs=1e-12) and fractions[-1] == pytest.approx(np.exp(-mean), rel=1e-12)
    for drawn in (simulated, counts):
        seen = np.append(drawn, cycles - drawn.sum())
        assert stats.chisquare(seen, cycles * fractions).pvalue > 1e-3
    # the joint law is multinomial: a bin's variance over pixels is N p (1 - p), no Poisson variance
    many = first_photon_counts(np.repeat(flux[None], 4000, axis=0), 200, rng)
    variance = (200 * fractions * (1 - fractions))[:-1]
    # a sample variance of n pixels has standard error sqrt((2 + kurtosis) / n), the bin's excess kurtosis 1 / (N p)
    error = variance * np.sqrt((2 + 1 / np.maximum(variance, 1e-12)) / 4000)
    assert (np.abs(many.var(axis=0) - variance) < stats.norm.isf(sidak(1e-3, 64) / 2) * error).all()


@pytest.mark.parametrize("dense_from", [0.0, 1e9])
def test_sense_draws_first_photons_by_either_route(dense_from: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spad.detection.exposure.DENSE_FROM", dense_from)
    cycles = 500
    sensor = replace(SMALL, exposure_s=cycles * SMALL.period_s)
    scene, budget = same(600, (0.6, 0.7, 1.0)), PhotonBudget(600, 300)  # 1.8 detections a cycle
    histogram = sense(scene, sensor, budget, seed=9)
    assert histogram.meta["model"] == "first-photon" and "pile-up" in " ".join(histogram.meta["plan"])
    fractions = first_photon_masses(expected_in_pixel(scene, sensor, budget, 0, 0)[None] / cycles)[0]
    counts = histogram.counts[0]
    assert counts.sum(axis=1).max() <= cycles
    totals = np.append(counts.sum(axis=0), 600 * cycles - counts.sum())
    assert stats.chisquare(totals, 600 * cycles * fractions / fractions.sum()).pvalue > 1e-3
    detected = 1 - fractions[-1]
    # binomial over cycles, not Poisson: the relative error of a variance over 600 pixels is sqrt(2 / 600)
    assert counts.sum(axis=1).var() == pytest.approx(cycles * detected * (1 - detected), rel=4.5 * np.sqrt(2 / 600))


@pytest.mark.parametrize("mean", [0.1, 1.0, 3.0])
def test_coates_recovers_the_flux(mean: float) -> None:
    """Within 4 standard errors, Sidak-corrected over the bins with at least 25 expected counts."""
    shape = np.full(128, 0.5 / 128)
    shape[40:48] += 0.5 / 8
    flux, cycles, pixels = mean * shape, 200000, 40
    counts = first_photon_counts(np.repeat(flux[None], pixels, axis=0), cycles, np.random.default_rng(8))
    recovered = coates(torch.from_numpy(counts), cycles).numpy()
    armed = cycles * np.exp(-(np.cumsum(flux) - flux))
    kept = armed * (1 - np.exp(-flux)) >= 25
    assert kept.sum() > 100
    # mu = -ln(1 - q), q binomial over the armed cycles: var mu = q / ((1 - q) armed) = expm1(mu) / armed
    error = np.sqrt(np.expm1(flux) / armed)
    score = np.abs(recovered - flux)[:, kept] / error[kept]
    together = 1 - (1 - 2 * stats.norm.sf(4)) ** kept.sum()  # what 4 standard errors leave in one pixel's bins
    assert (score.max(axis=1) > 4).mean() <= together + 4 * np.sqrt(together / pixels)
    assert score.max() < stats.norm.isf(sidak(1e-3, score.size) / 2) + 0.5
    assert (score**2).mean() == pytest.approx(1, abs=5 * np.sqrt(2 / score.size))


def test_coates_undoes_no_pile_up_at_low_flux_and_full_cycles() -> None:
    counts = torch.tensor([[3.0, 0.0, 5.0]])
    assert torch.allclose(coates(counts, 1e9), counts.double() / 1e9, rtol=1e-6)
    full = coates(torch.tensor([[60.0, 40.0, 0.0]]), 100)
    assert full[0, 0] == pytest.approx(np.log(100 / 40)) and full[0, 1] == pytest.approx(np.log(40 / 0.5))
    assert full[0, 2] == 0


def test_few_detections_are_left_as_they_are() -> None:
    counts = torch.zeros((2, 64))
    counts[0, [3, 50]] = 1
    counts[1] = 10
    sensor = replace(SMALL, exposure_s=1000 * SMALL.period_s)
    kept = without_pile_up(counts, sensor)
    assert torch.equal(kept[0], counts[0].double())
    assert torch.allclose(kept[1], coates(counts[1], 1000) * 1000) and kept[1, 60] > 20


# Dead time


def slowly(times: np.ndarray, dead: float) -> np.ndarray:
    """One photon after the other, the definition."""
    kept, ready = [], -np.inf
    for index in np.argsort(times, kind="stable"):
        if times[index] >= ready:
            kept.append(index)
            ready = times[index] + dead
    return np.array(kept, dtype=int)


@pytest.mark.parametrize("dead", [0.0, 0.3, 5.0, 300.0])
def test_dead_time_photon_by_photon(dead: float) -> None:
    rng = np.random.default_rng(2)
    pixel, time = rng.integers(0, 7, 3000), rng.uniform(0, 1000, 3000)
    ready = np.zeros(7)
    kept = live_detections(pixel, time, dead, ready)
    for number in range(7):
        own = np.flatnonzero(pixel == number)
        assert (np.sort(kept[pixel[kept] == number]) == np.sort(own[slowly(time[own], dead)])).all()
        assert ready[number] == time[kept[pixel[kept] == number]].max() + dead
    # in two parts, the second armed when the first says
    ready, parts = np.zeros(7), []
    for part in (np.flatnonzero(time < 500), np.flatnonzero(time >= 500)):
        parts.append(part[live_detections(pixel[part], time[part], dead, ready)])
    assert (np.sort(np.concatenate(parts)) == np.sort(kept)).all()


def test_dead_time_is_the_same_in_the_last_pixel_of_a_large_image() -> None:
    """Millions of pixels, each over hundreds of millions of bins: one float64 axis of all would resolve 0.2 bins."""
    time = 3e8 + np.random.default_rng(3).uniform(0, 300, 600)
    first = live_detections(np.zeros(600, int), time, 0.4, np.zeros(1))
    for other in (1_000, 3_999_999):
        there = live_detections(np.full(600, other), time, 0.4, np.zeros(4_000_000))
        assert np.array_equal(there, first)
    both = live_detections(np.repeat([5, 3_999_999], 600), np.tile(time, 2), 0.4, np.zeros(4_000_000))
    assert np.array_equal(both, np.concatenate((first, first + 600)))


@pytest.mark.parametrize("tau_periods", [0.05, 0.7, 2.5])
def test_dead_time_rate(tau_periods: float) -> None:
    """m = r / (1 + r tau) within 0.5 % at homogeneous flux and 1e6 detections."""
    per_cycle, cycles, pixels = 0.8, 4000, 1000
    sensor = Sensor(
        bins=64, reset="free-running", dead_time_s=tau_periods * SMALL.period_s, exposure_s=cycles * SMALL.period_s
    )
    histogram = sense(same(pixels, (0.5, 0.5, 1.0)), sensor, PhotonBudget(0, per_cycle * cycles), seed=4)
    assert histogram.meta["model"] == "free-running"
    expected = per_cycle / (1 + per_cycle * tau_periods)
    detected = histogram.counts.sum() / (pixels * cycles)
    assert histogram.counts.sum() > 1e6
    # armed at the start of each pixel's exposure: (r tau)^2 / 2 (1 + r tau)^2 detections more a pixel, 1e-4 here
    assert detected == pytest.approx(expected, rel=5e-3)
    # a renewal process: the count's variance is m / (1 + r tau)^2 a unit of time
    variance = expected * cycles / (1 + per_cycle * tau_periods) ** 2
    assert histogram.counts.sum(axis=(0, 2)).var() == pytest.approx(variance, rel=5 * np.sqrt(2 / pixels))


@pytest.mark.parametrize("tau_periods", [0.004, 0.3, 1.7])
def test_free_running_correction_recovers_the_flux(tau_periods: float) -> None:
    cycles, pixels = 3000, 500
    sensor = Sensor(
        bins=64, reset="free-running", dead_time_s=tau_periods * SMALL.period_s, exposure_s=cycles * SMALL.period_s
    )
    scene, budget = same(pixels, (0.6, 0.7, 1.0)), PhotonBudget(0.6 * cycles, 0.3 * cycles)
    counts = sense(scene, sensor, budget, seed=6, model="free-running").counts[0].sum(axis=0)
    flux = expected_in_pixel(scene, sensor, budget, 0, 0) / cycles
    recovered = free_running_flux(torch.from_numpy(counts), cycles * pixels, sensor).numpy()
    fullest = counts > 0.2 * counts.max()
    # counting errors, and 0.5 % for photons that are not uniform within their bin
    error = np.sqrt(1 / counts[fullest]) * 4.5 + 5e-3
    assert (np.abs(recovered[fullest] / flux[fullest] - 1) < error).all()
    raw = counts[fullest] / (cycles * pixels)
    if tau_periods > 0.1:
        assert np.abs(raw / flux[fullest] - 1).max() > 0.2, "there was something to correct"


def test_a_dead_time_of_seconds_takes_no_more_memory_than_one_of_nanoseconds():
    """1 s is 1e10 bins: the kernel of whole periods is a number per bin, not an entry per bin of the dead time."""
    sensor = Sensor(reset="free-running", dead_time_s=1.0, exposure_s=1000.0)
    flux = free_running_flux(torch.full((1, sensor.bins), 0.5), sensor.cycles, sensor)
    # each of 512 detections blinds 1e7 of the 1e10 cycles
    live = sensor.cycles - 512 * sensor.dead_time_s / sensor.period_s
    assert torch.allclose(flux, torch.full_like(flux, 0.5 / live), rtol=1e-6)
    short = Sensor(reset="free-running", dead_time_s=250e-9)
    counts = torch.arange(short.bins).double()[None] % 7
    dead = short.dead_time_s / short.bin_width_s
    far = torch.arange(1, int(dead) + 2).double()
    within = torch.where(
        far <= dead - 1, 1.0, torch.where(far <= dead, 1 - (1 - dead + far) ** 2 / 2, (1 + dead - far) ** 2 / 2)
    )
    blind = sum(fraction * counts.roll(int(d), -1) for fraction, d in zip(within, far, strict=True))
    plain = -torch.log1p(-counts / (short.cycles - blind))
    assert torch.allclose(free_running_flux(counts, short.cycles, short), plain, rtol=1e-9)


# Crosstalk


def test_crosstalk_rate_and_where_it_goes() -> None:
    rng = np.random.default_rng(1)
    fraction, height, width = 0.02, 40, 50
    pixel = rng.integers(0, height * width, 200000)
    cause, fired = crosstalk_events(pixel, fraction, height, width, rng)
    rows, columns = np.divmod(pixel, width)
    neighbours = 4 - (rows == 0) - (rows == height - 1) - (columns == 0) - (columns == width - 1)
    expected = fraction * neighbours.sum()
    assert abs(len(fired) - expected) < 4 * np.sqrt(expected)
    apart = np.abs(np.stack(np.divmod(fired, width)) - np.stack(np.divmod(pixel[cause], width))).sum(axis=0)
    assert (apart == 1).all()


@pytest.mark.parametrize("model", ["poisson", "first-photon", "free-running"])
def test_crosstalk_correlates_neighbours_only(model: str) -> None:
    fraction, cycles = 0.05, 2000
    sensor = Sensor(bins=4, bin_width_s=1e-9, crosstalk=fraction, exposure_s=cycles * 4e-9, dead_time_s=1e-9)
    side = 64
    flat = replace(
        same(side * side, (0.3, 0.3, 1.0)),
        height=side,
        width=side,
        **{
            name: np.zeros((side, side, *tail), dtype)
            for name, tail, dtype in (
                ("normal", (3,), np.float16),
                ("albedo", (), np.float16),
                ("mixed", (), bool),
                ("error", (), np.float32),
                ("depth_m", (), np.float32),
            )
        },
        ambient=np.ones((side, side), np.float32),
    )
    counts = sense(flat, sensor, PhotonBudget(0, 20), seed=3, model=model).counts.sum(axis=2).astype(float)
    inner = counts[1:-1, 1:-1]
    mean = 20 * (1 + 4 * fraction)
    assert inner.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(mean * (1 + 8 * fraction) / inner.size) + 0.15)
    spread = counts - counts.mean()
    near, far = (spread[:, :-1] * spread[:, 1:]).mean(), (spread[:, :-5] * spread[:, 5:]).mean()
    # each detection adds p to either neighbour: covariance 2 p n to first order
    error = 4.5 * mean / np.sqrt(counts.size)
    assert near == pytest.approx(2 * fraction * 20, abs=error + 0.2) and abs(far) < error and near > error


def test_crosstalk_of_counts_is_binomial() -> None:
    counts = np.zeros((3, 3, 2), np.int32)
    counts[1, 1, 0] = 100000
    add_crosstalk(counts, 0.01, np.random.default_rng(2))
    around = counts[[0, 2, 1, 1], [1, 1, 0, 2], 0]
    assert (np.abs(around - 1000) < 4.5 * np.sqrt(990)).all()
    assert counts[1, 1, 0] == 100000 and counts[..., 1].sum() == 0 and counts[::2, ::2].sum() == 0


def test_first_of_each_cycle_keeps_the_earliest() -> None:
    events = Detections(np.array([1, 0, 1, 1, 0]), np.array([3, 0, 3, 4, 0]), np.array([9, 5, 2, 7, 5]))
    first = first_of_each_cycle(events, SMALL)
    assert [tuple(map(int, event)) for event in zip(*first, strict=True)] == [(0, 0, 5), (1, 3, 2), (1, 4, 7)]


def test_first_photons_of_months_are_all_photons() -> None:
    """In 9e14 cycles no two photons meet; the bins of all pixels and cycles together are more than 64 bits count."""
    sensor, budget = replace(SMALL, exposure_s=9e14 * SMALL.period_s), PhotonBudget(20, 20)
    row = same(2048, (0.3, 0.3, 1.0))
    first, every = (sense(row, sensor, budget, seed=5, model=model).counts for model in ("first-photon", "poisson"))
    assert (first == every).all()
