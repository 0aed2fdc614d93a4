"""Rates of one pixel for figures, and light after the period, against the closed form in torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_flux import transient_of

from spad.detection.detect import expected_in_pixel, sense
from spad.detection.flux import interval_cdf
from spad.detection.one_pixel import quadrature_in_pixel
from spad.detection.photons import PixelFlux, late_signal
from spad.sensor.files import load_sensor
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.pulse import SampledPulse

# a point, a short and a long return, one before the camera's first bin is over, one that wraps around the period
RETURNS = [(0.01, 0.01, 0.2), (4.0, 4.03, 1.0), (5.0, 7.5, 0.6), (29.97, 30.3, 0.4), (9.0, 9.0, 1e-3)]
# with the tolerance of light after the period: panels are as long as a pulse is wide with its tail, and the steps of a
# measured one have corners
SENSORS = {
    "reference": (Sensor(), 1e-6),
    "tail": (Sensor(pulse=Pulse(1e-10, 4e-10)), 1e-4),
    "gated": (Sensor(bins=700, period_s=Sensor().period_s), 1e-6),
    "iccv2023-train": (load_sensor("iccv2023-train").sensor, 1e-3),
    "linospad2": (load_sensor("linospad2").sensor, 1e-6),
    "reference-tdc": (load_sensor("reference-tdc").sensor, 1e-6),
}
# responses whose rise is far steeper than they are wide
STEEP = {
    "long tail": Sensor(pulse=Pulse(1e-11, 1e-9)),
    "coarse steps": Sensor(pulse=SampledPulse((1.0, 8.0, 0.0, 0.0, 0.0, 5.0, 3.0), 3e-10)),
}


@pytest.mark.parametrize("name", [*SENSORS, *STEEP])
def test_expected_rates_of_a_pixel_are_the_closed_form(name):
    sensor = STEEP[name] if name in STEEP else SENSORS[name][0]
    lengths = [(4.0, 4.0 + length, 1.0) for length in (0.05, 0.15, 0.3, 0.6)]
    transient, budget = transient_of(RETURNS, RETURNS[1:3], [], *([one] for one in lengths)), PhotonBudget(40, 25)
    for column in range(7):
        exact = expected_in_pixel(transient, sensor, budget, 0, column, seed=3)
        found = quadrature_in_pixel(transient, sensor, budget, 0, column, seed=3)
        assert found.shape == exact.shape and np.abs(found - exact).max() < 1e-6 * exact.max(), name


@pytest.mark.parametrize("law", ["poisson", "free-running"])
def test_a_short_record_of_a_very_long_period_needs_no_memory_of_the_period(law):
    """1e10 bins of 1 ps in 10 ms: 80 GB a pixel if each had its number, and more than 32 bits count."""
    sensor = Sensor(bins=4000, bin_width_s=1e-12, period_s=1e-2, exposure_s=10.0, pulse=Pulse(1e-10))
    transient, budget = transient_of([(0.6, 0.6, 1.0)]), PhotonBudget(4000, 2e5)
    exact, found = (f(transient, sensor, budget, 0, 0) for f in (expected_in_pixel, quadrature_in_pixel))
    assert exact.sum() == pytest.approx(4000 + 2e5 * 4000 / 1e10) and np.abs(found - exact).max() < 1e-6 * exact.max()
    counts = sense(transient, replace(sensor, reset="free-running"), budget, seed=1, model=law).counts[0, 0]
    assert abs(counts.sum() - 4000) < 4.5 * np.sqrt(4000)
    assert abs(np.average(np.arange(4000) + 0.5, weights=counts) - 0.6 / 299792458 * 1e12) < 4.5 * 100 / np.sqrt(4000)


@pytest.mark.parametrize("name", SENSORS)
def test_light_after_the_period_is_the_closed_forms(name):
    """Returns about the end of the period, before and behind it, points and long ones."""
    sensor, tolerance = SENSORS[name]
    random, count = np.random.default_rng(2), 400
    width, period = sensor.bin_width_s, sensor.bins_per_period
    start = period + random.normal(0, 3 * sensor.response.std_s / width, count)
    length = np.where(random.random(count) < 0.3, 0.0, random.exponential(20, count))
    signal = random.exponential(1, count)
    start[:3], length[:3] = (3.0, period + 500.0, period - 400.0), (0.0, 0.0, 800.0)
    light = PixelFlux(np.zeros(count, np.int32), start, length, signal, np.zeros(1))
    arrived = interval_cdf(
        sensor.response, torch.from_numpy(sensor.period_s - start * width), torch.from_numpy(length * width)
    ).numpy()
    assert late_signal(light, sensor) == pytest.approx(float(signal @ (1 - arrived)), rel=max(tolerance, 1e-6))
