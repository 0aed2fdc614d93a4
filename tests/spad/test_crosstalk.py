"""Crosstalk of free-running detectors: what fires a neighbour also blinds it, as a simulation of each photon has it."""

from dataclasses import replace

import numpy as np
import pytest
from test_laws import same

from spad.detection.detect import sense
from spad.sensor.model import PhotonBudget, Sensor

SIDE, CYCLES, PHOTONS = 20, 150, 3.0


def square(side: int):
    """An image of equally bright pixels."""
    one = same(side * side, (0.3, 0.3, 1.0))
    layers = {
        name: np.zeros((side, side, *getattr(one, name).shape[2:]), getattr(one, name).dtype)
        for name in ("normal", "albedo", "mixed", "error", "depth_m")
    }
    return replace(one, height=side, width=side, ambient=np.ones((side, side), np.float32), **layers)


def simulated(dead: float, fraction: float, seed: int) -> int:
    """Detections of all pixels [times in periods]: photon after photon, each fires neighbours that are armed."""
    rng, armed, detected = np.random.default_rng(seed), np.zeros((SIDE, SIDE)), 0
    number = rng.poisson(PHOTONS * CYCLES * SIDE * SIDE)
    places, fires = rng.integers(SIDE, size=(number, 2)).tolist(), (rng.random((number, 4)) < fraction).tolist()
    armed = armed.tolist()
    for time, (row, column), around in zip(np.sort(rng.random(number) * CYCLES), places, fires, strict=True):
        if time < armed[row][column]:
            continue
        armed[row][column], detected = time + dead, detected + 1
        for fired, (down, right) in zip(around, ((0, 1), (0, -1), (1, 0), (-1, 0)), strict=True):
            i, j = row + down, column + right
            if fired and 0 <= i < SIDE and 0 <= j < SIDE and time >= armed[i][j]:
                armed[i][j], detected = time + dead, detected + 1
    return detected


@pytest.mark.parametrize("dead", [0.5, 1.3])
def test_a_photon_is_seen_that_only_a_detection_had_hidden_which_crosstalk_takes(dead: float) -> None:
    """Add about 3 % by crosstalk of 5 % to what half a period of dead time leaves of three photons a period."""
    fraction, bins = 0.05, 10
    sensor = Sensor(
        bins=bins, bin_width_s=1e-9, exposure_s=CYCLES * bins * 1e-9, crosstalk=fraction, dead_time_s=dead * bins * 1e-9
    )
    sensor, budget = replace(sensor, reset="free-running"), PhotonBudget(0, PHOTONS * CYCLES)
    drawn = [int(sense(square(SIDE), sensor, budget, seed=seed).counts.sum()) for seed in (1, 2, 3)]
    expected = simulated(dead, fraction, 4)
    spread = expected * (1 + 8 * fraction) / (1 + PHOTONS * dead) ** 2  # renewal theory: a dead time evens counts out
    assert abs(np.mean(drawn) - expected) < 4.5 * np.sqrt(spread * 4 / 3)


def test_an_exposure_of_a_few_bins_is_drawn() -> None:
    """Every pixel detects its first photon of 16 bins, and none later: the dead time outlasts them."""
    sensor = Sensor(bins=8, bin_width_s=1e-9, exposure_s=16e-9, reset="free-running", dead_time_s=20e-9)
    counts = sense(square(SIDE), sensor, PhotonBudget(0, 50), seed=2, model="free-running").counts.sum(axis=2)
    assert (counts == 1).all()
