"""Refuse captures that say nothing of a sensor: other distances, too few of them, and fits without a result."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.zone_array import ZoneArray
from spad.zones.calibration import Calibration
from spad.zones.evidence import POISSON_DEVIANCE, check_distances, check_fit, light_speeds, return_speeds
from spad.zones.expected_counts import PulseBasis

ZONES = ZoneArray((-0.3, 0.0, 0.3), (0.0, 0.0, 0.0), (0.1,) * 3, (0.1,) * 3)
SENSOR = Sensor(name="s", bins=64, bin_width_s=1e-10, pulse=Pulse(1e-10))
DISTANCE_M = np.linspace(0.1, 0.5, 20)
TIMED = ("delay", "clock", "background")


def counts_at(distance_m: np.ndarray, *, signal: float = 300.0, leak: float = 0.0) -> np.ndarray:
    """Draw Gaussian returns (N, Z, T) before a background of 20, and a reflection that stands still in bin 5."""
    slant = np.sqrt(1 + np.square(ZONES.centre_x))
    path = 2 * distance_m[:, None] * slant / (SPEED_OF_LIGHT_M_PER_S * SENSOR.bin_width_s) + 8
    bins = np.arange(SENSOR.bins) + 0.5
    shape = np.exp(-((bins - path[..., None]) ** 2) / 2)
    return np.random.default_rng(1).poisson(20 + signal * shape + leak * np.exp(-((bins - 5) ** 2) / 2))


@pytest.mark.parametrize("leak", [0.0, 3000.0])
@pytest.mark.parametrize("signal", [100.0, 1e5])
def test_returns_move_as_light_does(signal, leak):
    """Within a quarter: two places of a return are each known to a bin, and half of all pairs are farther apart than
    0.3 of the 27 bins that are spanned, so that the median pair is right to 2 of 8 bins at the worst."""
    counts = counts_at(DISTANCE_M, signal=signal, leak=leak)
    assert return_speeds(DISTANCE_M, counts) == pytest.approx(light_speeds(SENSOR, ZONES), rel=0.25)
    check_distances(DISTANCE_M, counts, SENSOR, ZONES, TIMED)


def test_a_few_captures_without_their_return_are_borne():
    counts = counts_at(DISTANCE_M)
    counts[3:6] = 20
    check_distances(DISTANCE_M, counts, SENSOR, ZONES, TIMED)


@pytest.mark.parametrize(
    "distance_m",
    [DISTANCE_M[::-1], np.random.default_rng(0).permutation(DISTANCE_M), 2 * DISTANCE_M, DISTANCE_M / 2],
    ids=["reversed", "shuffled", "paths", "halves"],
)
@pytest.mark.parametrize("free", [TIMED, ()])
def test_distances_of_other_captures_are_refused(distance_m, free):
    with pytest.raises(InputError, match=r"distance_m does not belong to counts: in 3 of 3 zones the return moves"):
        check_distances(distance_m, counts_at(DISTANCE_M), SENSOR, ZONES, free)


def test_most_zones_decide():
    counts = counts_at(DISTANCE_M)
    counts[:, 0] = counts[::-1, 0]
    check_distances(DISTANCE_M, counts, SENSOR, ZONES, TIMED)
    counts[:, 1] = counts[::-1, 1]
    with pytest.raises(InputError, match="in 2 of 3 zones"):
        check_distances(DISTANCE_M, counts, SENSOR, ZONES, TIMED)


@pytest.mark.parametrize(
    ("distance_m", "words"),
    [
        (
            np.full(20, 0.3),
            "distinct distances in distance_m of the captures fitted: 1, which do not tell delay, clock",
        ),
        (np.repeat([0.1, 0.3, 0.5], 7), "of the captures fitted: 3, which do not tell delay, clock: expected 4 or"),
        (
            np.linspace(0.1, 0.15, 20),
            r"distance_m spans 0.1 to 0.15 m, 3.3 bins, which do not tell .*: expected 4 bins",
        ),
    ],
)
def test_effects_of_time_need_distances(distance_m, words):
    counts = counts_at(distance_m)
    with pytest.raises(InputError, match=words):
        check_distances(distance_m, counts, SENSOR, ZONES, TIMED)
    check_distances(distance_m, counts, SENSOR, ZONES, ("background",))


def fitted(**changes) -> Calibration:
    """A calibration that knows its gains to a hundredth, of deviance 1."""
    zones = replace(ZONES, gain=(1.0, 2.0, 3.0))
    found = Calibration(SENSOR, zones, {"gain": np.array([0.01, 0.02, 0.03])}, 1.0, {}, PulseBasis.made(0, 2, 2), TIMED)
    return replace(found, **changes)


def test_a_fit_that_says_nothing_is_refused():
    counts = np.full((4, 3, 64), 100)
    check_fit(fitted(), counts)
    check_fit(fitted(errors={"gain": np.array([9.0, 0.02, 0.03])}), counts)  # one zone alone
    for unknown in ([9.0, 9.0, 0.03], [np.nan, np.inf, 0.03]):
        with pytest.raises(InputError, match="the fit knows the gain of 1 of 3 zones"):
            check_fit(fitted(errors={"gain": np.array(unknown)}), counts)
    check_fit(fitted(deviance=2 + 100 * 0.69**2), counts)
    for deviance, size in ((2 + 100 * 0.71**2, "71%"), (np.inf, "inf%"), (np.nan, "inf%")):
        with pytest.raises(InputError, match=f"the fit is wrong by {size} of a bin's counts"):
            check_fit(fitted(deviance=deviance), counts)
        check_fit(fitted(deviance=deviance, free=("delay",)), counts)  # all bins beside the return are wrong


def test_poisson_noise_alone_is_no_misfit():
    """The deviance of a bin of mean n from its own mean is 2 sum_k P(k) (k log(k / n) - k + n)."""
    counts = np.arange(1, 200)
    for mean in np.geomspace(0.01, 50, 60):
        mass = stats.poisson.pmf(counts, mean)
        deviance = 2 * (mass @ (counts * np.log(counts / mean) - counts + mean) + np.exp(-mean) * mean)
        assert deviance < 1.2 < POISSON_DEVIANCE
