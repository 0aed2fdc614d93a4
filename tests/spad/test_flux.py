"""Expected counts: the pulse integrated over bins against each return's interval, energy, wrapping, photon budgets."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from render.transient import Transient
from scenes import InputError
from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from spad.detection.flux import expected_counts, recorded_fraction, signal_per_bin
from spad.detection.rates import rates_for
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.template import binned_pulse, pulse_cdf
from spad.sensor_names import sensor_by_name

REFERENCE = Sensor()


def transient_of(*pixels: list[tuple[float, float, float]], ambient: list[float] | None = None) -> Transient:
    """One image row; each pixel a list of (near, far, radiance)."""
    returns = [entry for pixel in pixels for entry in sorted(pixel)]
    near, far, radiance = (np.array([r[i] for r in returns], np.float32) for i in range(3))
    count = len(pixels)
    zeros = np.zeros((1, count), np.float32)
    return Transient(
        1,
        count,
        np.concatenate(([0], np.cumsum([len(p) for p in pixels]))).astype(np.int64),
        near,
        far,
        radiance,
        np.ones(len(near), np.uint8),
        depth_m=zeros + 1,
        normal=np.zeros((1, count, 3), np.float16),
        albedo=zeros.astype(np.float16),
        ambient=zeros if ambient is None else np.array([ambient], np.float32),
        mixed=zeros > 0,
        error=zeros,
        meta={"scene": "made up"},
    )


def binned(near: float, far: float, sensor: Sensor = REFERENCE) -> np.ndarray:
    return signal_per_bin(transient_of([(near, far, 1.0)]), sensor, slice(0, 1))[0][0].numpy()


@pytest.mark.parametrize("path_m", [0.0, 0.001, 3.21, 7.777, 29.97])
def test_point_return_is_the_binned_pulse(path_m):
    arrival = torch.tensor([float(np.float32(path_m)) / C], dtype=torch.float64)
    assert np.abs(binned(path_m, path_m) - binned_pulse(arrival, REFERENCE)[0].numpy()).max() < 3e-9


@pytest.mark.parametrize("length_m", [1e-6, 1e-4, 4.05e-5, 0.01, 0.3, 5.0, 40.0])
def test_interval_is_the_average_of_point_returns(length_m):
    """Second route: the pulse's CDF at 20,000 arrivals spread evenly over the interval."""
    near = np.float32(4.0)
    far = np.float32(near + np.float32(length_m))
    arrival = (float(near) + (float(far) - float(near)) * (np.arange(20000) + 0.5) / 20000) / C
    edges = torch.arange(2 * 1024 + 1, dtype=torch.float64) * REFERENCE.bin_width_s
    arrived = np.zeros(len(edges))
    for part in np.split(arrival, 20):
        arrived += pulse_cdf(REFERENCE.pulse, edges[:, None] - torch.from_numpy(part)).sum(1).numpy() / 20000
    expected = np.diff(arrived).reshape(2, 1024).sum(axis=0)
    assert np.abs(binned(near, far) - expected).max() < 2e-8


@settings(deadline=None, max_examples=40)
@given(
    st.floats(0, 60),
    st.floats(0, 40),
    st.sampled_from([0.01, 0.3, 1.38, 30.0, 300.0, 3000.0]),
    st.sampled_from([1024, 64, 7]),
)
def test_energy_is_kept_for_any_pulse_and_interval(near, length, sigma_bins, bins):
    sensor = Sensor(bins=bins, pulse=Pulse(sigma_bins * REFERENCE.bin_width_s))
    counts = binned(near, near + length, sensor)
    assert counts.min() >= 0 and counts.sum() == pytest.approx(1, abs=1e-9)


def test_bins_that_do_not_cover_the_period_lose_the_rest():
    gated = Sensor(bins=512, period_s=REFERENCE.period_s)
    assert binned(5.0, 5.0, gated).sum() == pytest.approx(1, abs=1e-9)
    assert binned(25.0, 25.0, gated).sum() == pytest.approx(0, abs=1e-9)


RECORDS = {
    "half a period": Sensor(bins=512, period_s=REFERENCE.period_s),
    "pulse wider than the record": Sensor(bins=64, period_s=REFERENCE.period_s, pulse=Pulse(9e-9)),
    "tail over periods": Sensor(bins=300, period_s=5e-8, pulse=Pulse(2e-10, tail_s=2e-8)),
    "measured pulse": replace(sensor_by_name("iccv2023-train"), period_s=1536 * 80e-12),
    "swissspad3": sensor_by_name("swissspad3"),
}


@pytest.mark.parametrize("name", RECORDS)
def test_light_within_a_record_is_the_sum_over_its_bins(name):
    """By the record's ends alone, which is some hundred times faster than by its bins."""
    sensor, random = RECORDS[name], np.random.default_rng(4)
    near = random.uniform(0, 3 * C * sensor.period_s, 200)
    near[:4] = C * np.array([0, sensor.bins * sensor.bin_width_s, sensor.period_s, 1e-12])
    far = near + np.where(random.random(200) < 0.5, 0, random.gamma(0.5, 0.4 * C * sensor.period_s, 200))
    pixels = [[(a, b, r)] for a, b, r in zip(near, far, random.uniform(0.5, 2, 200), strict=True)]
    transient = transient_of(*pixels)
    by_bins = signal_per_bin(transient, sensor, slice(0, 200))[0].sum(dim=1)
    near_s, far_s = (torch.from_numpy(p.astype(float) / C) for p in (transient.path_near_m, transient.path_far_m))
    found = recorded_fraction(near_s, far_s - near_s, sensor) * torch.from_numpy(transient.radiance.astype(float))
    assert (found - by_bins).abs().max() < 1e-9 and 0.05 < float(found.sum() / transient.radiance.sum()) < 0.95


def test_time_wraps_at_the_period_and_what_wraps_is_counted():
    range_path = 2 * REFERENCE.range_m
    transient = transient_of([(5.0, 5.0, 3.0), (range_path + 5.0, range_path + 5.0, 1.0)])
    signal, wrapped = signal_per_bin(transient, REFERENCE, slice(0, 1))
    assert wrapped == pytest.approx(1.0, abs=1e-9)
    once = signal_per_bin(transient_of([(5.0, 5.0, 4.0)]), REFERENCE, slice(0, 1))[0]
    assert (signal - once).abs().max() < 1e-4
    straddling, wrapped = signal_per_bin(transient_of([(range_path, range_path, 1.0)]), REFERENCE, slice(0, 1))
    assert wrapped == pytest.approx(0.5, abs=1e-4)
    assert straddling[0, 0] == pytest.approx(float(straddling[0, -1]), abs=1e-4)


def test_mean_signal_and_background_are_what_was_asked():
    transient = transient_of([(2, 2, 1.0)], [(4, 4.1, 3.0), (6, 6, 1.0)], [], ambient=[1.0, 2.0, 3.0])
    rates = rates_for(transient, REFERENCE, PhotonBudget(30, 60))
    counts, _ = expected_counts(transient, REFERENCE, rates, slice(0, 3))
    assert counts.sum().item() / 3 == pytest.approx(90, rel=1e-9)
    assert rates.background.tolist() == [pytest.approx([30, 60, 90])]
    assert (counts.sum(1).numpy() - rates.background[0]).tolist() == pytest.approx([18, 72, 0], abs=1e-9)


def test_no_ambient_light_gives_a_uniform_background_and_says_so():
    rates = rates_for(transient_of([(2, 2, 1.0)], [(2, 2, 1.0)]), REFERENCE, PhotonBudget(1, 8))
    assert rates.background.tolist() == [[8, 8]] and "uniform" in rates.reasons[0] and rates.dark_fraction == 0


@pytest.mark.parametrize(("dark_counts", "fraction"), [(2.0, 0.25), (8.0, 1.0), (100.0, 1.0)])
def test_dark_counts_come_first_and_never_exceed_the_background(dark_counts, fraction):
    sensor = replace(REFERENCE, dark_count_rate_hz=dark_counts * 30)
    rates = rates_for(transient_of([(2, 2, 1.0)], [(2, 2, 1.0)], ambient=[1.0, 3.0]), sensor, PhotonBudget(1, 8))
    assert rates.dark_fraction == pytest.approx(fraction) and rates.background.mean() == pytest.approx(8)
    assert np.ptp(rates.background) == pytest.approx(8 * (1 - fraction))


def test_nothing_to_scale_is_refused_in_one_line():
    with pytest.raises(InputError, match="no light returns"):
        rates_for(transient_of([], []), REFERENCE, PhotonBudget(1, 1))
    assert rates_for(transient_of([], []), REFERENCE, PhotonBudget(0, 1)).signal_scale == 0


@pytest.mark.parametrize(
    "bad",
    [
        {"bins": 0}, {"bins": 70000}, {"bins": 1.5}, {"bin_width_s": 0.0}, {"bin_width_s": float("nan")},
        {"period_s": 1e-9}, {"period_s": 100.03e-9}, {"exposure_s": 1e-9}, {"dark_count_rate_hz": -1.0},
        {"dark_count_rate_hz": float("inf")}, {"pulse": None}, {"jitter": 1e-10},
    ],
)  # fmt: skip
def test_bad_sensors_are_refused_in_one_line(bad):
    with pytest.raises(InputError) as refused:
        Sensor(**bad)
    assert "\n" not in str(refused.value) and "sensor reference" in str(refused.value)


@pytest.mark.parametrize("bad", [(-1, 5), (5, -1), (float("nan"), 1), (1, float("inf")), (1e10, 1)])
def test_bad_budgets_are_refused_in_one_line(bad):
    with pytest.raises(InputError, match="photon budget"):
        PhotonBudget(*bad)
    with pytest.raises(InputError, match="pulse sigma"):
        Pulse(0.0)


def test_reference_sensor_is_the_papers():
    assert REFERENCE.range_m == pytest.approx(14.98962, abs=1e-5) and REFERENCE.cycles == pytest.approx(
        333333.3, abs=0.1
    )
    assert REFERENCE.pulse.fwhm_s == pytest.approx(318e-12, rel=1e-3)
    assert Sensor.from_dict(REFERENCE.to_dict()) == REFERENCE
