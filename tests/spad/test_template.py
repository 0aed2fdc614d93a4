"""The pulse on the time axis: its integrals belong together, and its bins hold one detection."""

import math

import pytest
import torch

from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from spad.estimators.depth import estimate_depth
from spad.sensor.model import Pulse, Sensor
from spad.sensor.pulse import AnyPulse, SampledPulse
from spad.sensor.template import (
    binned_pulse,
    binned_pulse_slope,
    pulse_cdf,
    pulse_cdf_integral,
    pulse_density,
    pulse_mass,
    pulse_taps,
)

REFERENCE = Sensor()
WIDTH = REFERENCE.bin_width_s
SMALL = Sensor(name="small", bins=64)
GATED = Sensor(name="gated", bins=512, period_s=REFERENCE.period_s)
NARROW = Sensor(name="narrow", pulse=Pulse(0.25 * WIDTH))
WIDE = Sensor(name="wide", pulse=Pulse(30 * WIDTH))


@pytest.mark.parametrize("sigma_bins", [0.01, 0.3, 1.38, 20.0, 0.1 * 1024, 0.3 * 1024])
def test_binned_pulse_holds_one_detection_a_period_at_its_centroid(sigma_bins: float) -> None:
    sensor = Sensor(pulse=Pulse(sigma_bins * WIDTH))
    arrival = torch.linspace(-1.3, 2.7, 41, dtype=torch.float64) * sensor.period_s
    fraction = binned_pulse(arrival, sensor)
    assert fraction.shape == (41, 1024) and fraction.min() >= 0
    assert (fraction.sum(-1) - 1).abs().max() < 1e-12
    # The first circular moment of a wrapped Gaussian is exp(-(2 pi sigma / P)^2 / 2) at the arrival's phase; the bins
    # multiply it by sin(x) / x, x = pi / T. Aliases are below 1e-9 for a pulse over a bin wide.
    if sigma_bins > 1:
        centres = (torch.arange(1024, dtype=torch.float64) + 0.5) / 1024 * 2 * math.pi
        moment = (fraction * torch.exp(1j * centres)).sum(-1)
        sinc = math.sin(math.pi / 1024) / (math.pi / 1024)
        expected = math.exp(-0.5 * (2 * math.pi * sigma_bins / 1024) ** 2) * sinc
        phase = torch.exp(2j * math.pi * arrival / sensor.period_s)
        assert (moment - expected * phase).abs().max() < 1e-8


def test_pulse_outside_the_bins_is_lost() -> None:
    inside, edge, outside = binned_pulse(torch.tensor([100.0, 512.0, 700.0], dtype=torch.float64) * WIDTH, GATED).sum(
        -1
    )
    assert inside == pytest.approx(1, abs=1e-12)
    assert edge == pytest.approx(0.5, abs=1e-12)
    assert outside < 1e-12


@pytest.mark.parametrize("sensor", [REFERENCE, NARROW, WIDE, GATED], ids=lambda sensor: sensor.name)
def test_slope_is_the_derivative_of_the_binned_pulse(sensor: Sensor) -> None:
    arrival = torch.tensor([0.1, 17.0, 300.37, 511.9], dtype=torch.float64) * WIDTH
    step = 1e-5 * sensor.pulse.sigma_s
    difference = (binned_pulse(arrival + step, sensor) - binned_pulse(arrival - step, sensor)) / (2 * step)
    # Rounding 1e-16 / 1e-5 and truncation 1e-10 of a slope of order 1 / sigma.
    assert (binned_pulse_slope(arrival, sensor) - difference).abs().max() < 1e-9 / sensor.pulse.sigma_s


def test_cdf_density_and_integral_belong_together() -> None:
    pulse = REFERENCE.pulse
    t = torch.linspace(-9, 9, 181, dtype=torch.float64) * pulse.sigma_s
    step = 1e-4 * pulse.sigma_s
    slope = (pulse_cdf_integral(pulse, t + step) - pulse_cdf_integral(pulse, t - step)) / (2 * step)
    assert (slope - pulse_cdf(pulse, t)).abs().max() < 1e-8
    slope = (pulse_cdf(pulse, t + step) - pulse_cdf(pulse, t - step)) / (2 * step)
    assert (slope - pulse_density(pulse, t)).abs().max() < 1e-8 / pulse.sigma_s
    # H(0) = s / sqrt(2 pi); far left 0 and never below; far right t itself.
    assert pulse_cdf_integral(pulse, torch.zeros(1)) == pytest.approx(pulse.sigma_s / math.sqrt(2 * math.pi), rel=1e-14)
    far = torch.logspace(-9, 3, 200, dtype=torch.float64)
    left, right = pulse_cdf_integral(pulse, -far), pulse_cdf_integral(pulse, far)
    assert (left >= 0).all() and left[-1] == 0 and (left.diff() <= 0).all()
    assert torch.allclose(right, far, rtol=1e-12, atol=0)
    # Against the asymptotic series of the tail, s phi(a) (1/a^2 - 3/a^4 + 15/a^6): the direct form has no digit here.
    a = torch.tensor(20.0, dtype=torch.float64)
    series = math.exp(-200) / math.sqrt(2 * math.pi) * (1 / a**2 - 3 / a**4 + 15 / a**6 - 105 / a**8)
    assert pulse_cdf_integral(pulse, -a * pulse.sigma_s) / pulse.sigma_s == pytest.approx(float(series), rel=1e-4)


def test_mass_keeps_its_digits_in_both_tails() -> None:
    t = torch.tensor([3.0, 10.0, 30.0], dtype=torch.float64) * REFERENCE.pulse.sigma_s
    # The density integrated by Simpson's rule over 2000 steps.
    steps = torch.linspace(-0.5, 0.5, 2001, dtype=torch.float64) * WIDTH
    simpson = torch.tensor([1.0, *([4.0, 2.0] * 999), 4.0, 1.0]).double() * WIDTH / 6000
    expected = (pulse_density(REFERENCE.pulse, t.unsqueeze(-1) + steps) @ simpson).numpy()
    left, right = pulse_mass(REFERENCE.pulse, -t, WIDTH), pulse_mass(REFERENCE.pulse, t, WIDTH)
    assert torch.equal(left, right)
    assert right.numpy() == pytest.approx(expected, rel=1e-9)


def test_taps_hold_the_pulse_once() -> None:
    for sensor in (REFERENCE, NARROW, SMALL, Sensor(bins=5), Sensor(bins=1), Sensor(pulse=Pulse(300 * WIDTH))):
        taps = pulse_taps(sensor, "cpu")
        assert len(taps.shifts) <= sensor.bins_per_period and taps.steps[0] == -1 and taps.steps[-1] == 1
        assert (taps.fine.sum(-1) - 1).abs().max() < 1e-8
        assert torch.equal(taps.centred, taps.fine[taps.steps == 0][0])


@pytest.mark.parametrize(
    "pulse",
    [Pulse(0.1 * WIDTH, 3 * WIDTH), Pulse(0.02 * WIDTH, 5 * WIDTH), SampledPulse((1.0, 1.0, 1.0), WIDTH)],
    ids=["tail of 3 bins", "tail of 5 bins", "three even bins"],
)
@pytest.mark.parametrize("method", ["matched", "log-matched"])
def test_a_rise_narrower_than_a_bin_is_found_within_the_bin(method: str, pulse: AnyPulse) -> None:
    """No bin holds much of the pulse, but its rise tells the place: noise-free answers were up to 0.09 bins off."""
    sensor = Sensor(bins=256, pulse=pulse)
    arrival_s = (100 + (torch.arange(160, dtype=torch.float64) + 0.5) / 160) * WIDTH
    depth_m = estimate_depth(1e4 * binned_pulse(arrival_s, sensor) + 1, sensor, method).double()
    assert (depth_m - arrival_s * C / 2).abs().max() < 0.015 * sensor.bin_depth_m
