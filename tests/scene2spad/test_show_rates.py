"""The expected counts that a page of `show` draws are the rates that detections are drawn from."""

from dataclasses import replace

import numpy as np
import pytest

from render.transient import Transient
from scene2spad.viewer.sources import expected_cube, spread
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.files import load_sensor
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.pulse import AnyPulse


def short(pulse: AnyPulse, bins: int = 64) -> Sensor:
    """64 bins in a period of 6.4 ns, of which some are recorded."""
    return Sensor(name="short", bins=bins, bin_width_s=1e-10, period_s=6.4e-9, exposure_s=1e-4, pulse=pulse)


SENSORS = {
    **{name: load_sensor(name).sensor for name in ("reference", "reference-tdc", "linospad2", "iccv2023-train")},
    "long tail": short(Pulse(1e-10, 5e-9)),
    "as wide as the period": short(Pulse(6e-9)),
    "gated": short(Pulse(1e-10, 5e-9), bins=40),
}


def walls(length_m: float) -> Transient:
    """16 pixels at many places, each one return of this length of path."""
    depth = 2 + np.random.default_rng(0).random((4, 4))
    wall = transient_from_rgbd(depth, np.ones((4, 4)), np.ones((4, 4)))
    return replace(wall, path_far_m=wall.path_near_m + np.float32(length_m))


@pytest.mark.parametrize("length_m", [0.0, 0.05, 0.7, 5.0])
@pytest.mark.parametrize("name", SENSORS)
def test_expected_counts_of_the_page_are_those_that_sense_draws_from(name, length_m):
    """Also of unequal bins, of pulses as long as the period, and of returns longer than it."""
    sensor, scene = SENSORS[name], walls(length_m)
    rates = rates_for(scene, sensor, PhotonBudget(50, 50))
    exact = expected_counts(scene, sensor, rates, slice(0, 16))[0].numpy()
    found = expected_cube(scene, sensor, rates).reshape(16, -1)
    assert (np.abs(found - exact) < 0.02 * exact.max(axis=1, keepdims=True)).all()
    assert found.sum(axis=1) == pytest.approx(exact.sum(axis=1), rel=1e-4)


def test_a_return_that_runs_past_the_end_leaves_its_part_there():
    cube = np.zeros((3, 8))
    near, far = np.array([6.0, 7.5, 9.0]), np.array([10.0, 8.5, 11.0])
    spread(cube, np.arange(3), near, far, np.array([4.0, 1.0, 2.0]))
    assert cube[:, -2:] == pytest.approx(np.array([[1, 1], [0, 0.5], [0, 0]])) and not cube[:, :6].any()
