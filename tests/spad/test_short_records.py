"""Bins that cover a part of the laser's period: the rest of it blinds free-running detectors, and counts or not."""

from dataclasses import replace

import numpy as np
import pytest
from test_laws import SMALL, same

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from spad.detection.detect import sense, sense_timestamps
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.histogram import sense_zones, with_budget


@pytest.mark.parametrize("crosstalk", [0.0, 1e-9])
@pytest.mark.parametrize("tau_periods", [0.3, 2.5])
def test_dead_time_rate_of_a_record_shorter_than_the_period(tau_periods: float, crosstalk: float) -> None:
    """A quarter of the period has bins: they count a quarter of r / (1 + r tau), r over the whole period."""
    per_cycle, cycles, pixels, period_s = 0.8, 2000, 500, SMALL.period_s
    sensor = replace(SMALL, bins=16, period_s=period_s, reset="free-running", crosstalk=crosstalk)
    sensor = replace(sensor, dead_time_s=tau_periods * period_s, exposure_s=cycles * period_s)
    scene, budget = same(pixels, (0.5, 0.5, 1.0)), PhotonBudget(0, per_cycle * cycles)
    histogram = sense(scene, sensor, budget, seed=4)
    expected = pixels * cycles * per_cycle / (1 + per_cycle * tau_periods) / 4
    assert histogram.counts.sum() == pytest.approx(expected, abs=4.5 * np.sqrt(expected) + 1e-3 * expected)
    assert histogram.meta["model"] == "free-running" and histogram.meta["pile_up"] == pytest.approx(per_cycle)
    assert np.array_equal(sense_timestamps(scene, sensor, budget, seed=4).counts(), histogram.counts)


def test_light_after_the_record_blinds_the_start_of_the_next_cycle() -> None:
    """A bright return at 0.9 periods is detected in every cycle; blind for 0.5 periods, the first quarter is empty."""
    cycles, period_s = 1000, SMALL.period_s
    sensor = replace(SMALL, bins=16, period_s=period_s, reset="free-running", exposure_s=cycles * period_s)
    sensor = replace(sensor, dead_time_s=0.5 * period_s, pulse=Pulse(1e-12))
    path_m = 0.9 * period_s * SPEED_OF_LIGHT_M_PER_S
    budget = PhotonBudget(30.0 * cycles, 0.004 * cycles)
    counts = sense(same(50, (path_m, path_m, 1.0)), sensor, budget, seed=2).counts
    # 50 were counted if only the record blinded; expected are 0.05 in the first cycles, and 0.1 where background after
    # 0.4 periods keeps the return from being detected
    assert counts.sum() <= 3


def test_photons_asked_for_are_within_the_record_of_zones_and_over_the_whole_period_of_pixels() -> None:
    """A wall's return lies in a record of half the period, the background in all of it."""
    plane = np.full((16, 16), 0.3)
    wall = transient_from_rgbd(plane, plane, plane, meta={"camera": {"fov_deg": 60.0}})
    sensor = Sensor(name="s", bins=64, bin_width_s=1e-10, period_s=128e-10, pulse=Pulse(1e-10))
    budget = PhotonBudget(200.0, 100.0)
    two = ZoneArray((-0.2, 0.2), (0.0, 0.0), (0.3, 0.3), (0.5, 0.5))
    zones = sense_zones(wall, sensor, with_budget(two, wall, sensor, budget))
    assert zones.expected_background.mean() == pytest.approx(100) and zones.budget.background == pytest.approx(100)
    pixels = sense(wall, sensor, budget, seed=1).counts.sum(axis=2)
    assert pixels.mean() == pytest.approx(200 + 100 / 2, abs=5 * np.sqrt(250 / 256))
    late = transient_from_rgbd(plane * 5, plane, plane, meta={"camera": {"fov_deg": 60.0}})  # after the record
    assert sense(late, sensor, budget, seed=1).counts.sum(axis=2).mean() == pytest.approx(50, abs=5 * np.sqrt(50 / 256))
    with pytest.raises(InputError, match=r"no light reaches a zone within the 6\.4 ns that s records"):
        with_budget(two, late, sensor, budget)
