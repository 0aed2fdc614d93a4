"""Depth at the ends of a record shorter than the period, where a part of a wide pulse lies outside the bins."""

import numpy as np
import pytest
import torch

from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from spad.estimators.depth import estimate_depth
from spad.sensor.model import Pulse, Sensor
from spad.sensor.template import binned_pulse, binned_pulse_slope

BINS, WIDTH_S = 400, 100e-12
WIDE = Sensor(name="wide", bins=BINS, bin_width_s=WIDTH_S, pulse=Pulse(25 * WIDTH_S), period_s=1000 * WIDTH_S)
TAIL = Sensor(
    name="tail", bins=BINS, bin_width_s=WIDTH_S, pulse=Pulse(5 * WIDTH_S, 5 * WIDTH_S), period_s=1000 * WIDTH_S
)


def errors_in_bins(sensor: Sensor, arrival_s: torch.Tensor, counts: torch.Tensor) -> np.ndarray:
    depth_m = estimate_depth(counts, sensor).double()
    return ((depth_m - arrival_s * C / 2) / sensor.bin_depth_m).numpy()


def bound_in_bins(sensor: Sensor, arrival_s: float, signal: float, background: float) -> float:
    """Cramer-Rao bound of the arrival where neither signal nor background are known: of three numbers."""
    at = torch.tensor([arrival_s], dtype=torch.float64)
    pulse, slope = binned_pulse(at, sensor).numpy()[0], binned_pulse_slope(at, sensor).numpy()[0]
    by = np.stack((signal * slope * sensor.bin_width_s, pulse, np.ones_like(pulse)))
    return float(np.sqrt(np.linalg.inv((by / (signal * pulse + background)) @ by.T)[0, 0]))


@pytest.mark.parametrize("sensor", [WIDE, TAIL], ids=lambda sensor: sensor.name)
def test_noise_free_answer_is_the_truth_up_to_both_ends(sensor: Sensor) -> None:
    """With one signal and background a pixel, as of the first guess, it was up to 7 bins inwards."""
    places = torch.cat([torch.linspace(0.4, 60, 41, dtype=torch.float64) + start for start in (0.0, BINS - 60.4)])
    arrival_s = places * WIDTH_S
    error = errors_in_bins(sensor, arrival_s, 1e4 * binned_pulse(arrival_s, sensor) + 10)
    assert np.abs(error).max() < 0.05


@pytest.mark.parametrize("signal,background", [(300.0, 0.1), (2000.0, 2.0)])
@pytest.mark.parametrize("place", [12.5, 20.5, 379.5, 387.5])
def test_answers_half_a_pulse_from_an_end_keep_to_the_bound(place: float, signal: float, background: float) -> None:
    rng, pixels = np.random.default_rng(7), 400
    arrival_s = torch.from_numpy((place + rng.random(pixels) - 0.5) * WIDTH_S)
    counts = rng.poisson(signal * binned_pulse(arrival_s, WIDE).numpy() + background)
    error = errors_in_bins(WIDE, arrival_s, torch.from_numpy(counts))
    bound = bound_in_bins(WIDE, place * WIDTH_S, signal, background)
    assert abs(error.mean()) < 4 * bound / np.sqrt(pixels)
    assert error.std() < bound * (1 + 4 / np.sqrt(2 * pixels))
