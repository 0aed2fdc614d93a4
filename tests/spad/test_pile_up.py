"""Pile-up is undone by the law that made the counts, whichever detector the sensor has."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_laws import same

from scenes.errors import InputError
from spad.detection.detect import choose_model, sense
from spad.detection.laws import first_photon_masses
from spad.estimators.depth import confidence, confidence_map, detection_law, estimate_depth, histogram_depth_m
from spad.estimators.pile_up import coates, free_running_flux, warn_of_saturation, without_pile_up
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.template import binned_pulse

CYCLES, PIXELS, PER_CYCLE = 2000, 200, 3.5
SENSOR = Sensor(exposure_s=CYCLES * Sensor().period_s)
WALL_M = 6.0
WALL = same(PIXELS, (2 * WALL_M, 2 * WALL_M, 1.0))
BUDGET = PhotonBudget(1.5 * CYCLES, 2.0 * CYCLES)


def recovered(histogram: Histogram, law: str | None = None) -> float:
    """Primary detections a pixel and cycle, after pile-up is undone."""
    counts = torch.from_numpy(histogram.counts)
    return float(without_pile_up(counts, histogram.sensor, law).sum()) / (CYCLES * PIXELS)


@pytest.mark.parametrize("dead_s", [150e-9, 250e-9])
def test_a_synchronous_detector_that_misses_cycles_is_not_corrected_as_one_that_does_not(dead_s: float) -> None:
    """Undo the free-running law, which `sense` takes where the dead time outlasts the period."""
    sensor = replace(SENSOR, dead_time_s=dead_s)
    histogram = sense(WALL, sensor, BUDGET, seed=1)
    assert histogram.meta["model"] == "free-running" and not sensor.armed_every_cycle
    # n detections tell a rate within 1 / sqrt(n); 2 % for photons that are not uniform within their bin
    tolerance = 4.5 / np.sqrt(histogram.counts.sum()) + 0.02
    assert recovered(histogram) == pytest.approx(PER_CYCLE, rel=tolerance)
    counts = torch.from_numpy(histogram.counts)
    assert float(coates(counts, CYCLES).sum()) / PIXELS < PER_CYCLE / 3, "the other law's inverse is far off"
    free = replace(sensor, reset="free-running")
    assert torch.equal(without_pile_up(counts, sensor), without_pile_up(counts, free))
    # one pixel is off by 1.3 mm (standard deviation), the mean of 200 by 0.1 mm
    error_m = estimate_depth(counts, sensor, "coates").numpy() - WALL_M
    assert abs(error_m.mean()) < 1e-3 < 5e-3 < abs(estimate_depth(counts, sensor).numpy() - WALL_M).mean()


@pytest.mark.parametrize(
    ("sensor", "law"),
    [
        (replace(SENSOR, reset="free-running", dead_time_s=10e-9), "first-photon"),
        (replace(SENSOR, reset="free-running"), "first-photon"),
        (replace(SENSOR, dead_time_s=30e-9), "free-running"),
        (replace(SENSOR, dead_time_s=30e-9), "poisson"),
    ],
    ids=["first of free-running", "first without dead time", "free of synchronous", "poisson of synchronous"],
)
def test_a_law_that_was_asked_for_is_undone_by_its_own_inverse(sensor: Sensor, law: str) -> None:
    histogram = sense(WALL, sensor, BUDGET, seed=2, model=law)
    assert detection_law(histogram) == law
    tolerance = 4.5 / np.sqrt(histogram.counts.sum()) + 0.02
    assert recovered(histogram, law) == pytest.approx(PER_CYCLE, rel=tolerance)
    assert abs((histogram_depth_m(histogram, "coates") - WALL_M).mean()) < 1e-3


@pytest.mark.parametrize("cycles", [10.4, 99.6, 1000.4])
def test_pile_up_of_a_broken_number_of_cycles_is_that_of_the_whole_ones_drawn(cycles: float) -> None:
    sensor = Sensor(bins=64, bin_width_s=1e-10, exposure_s=cycles * 6.4e-9, pulse=Pulse(130e-12))
    flux = binned_pulse(torch.tensor([2e-9], dtype=torch.float64), sensor) + 0.5 / 64  # photons a cycle and bin
    detected = sensor.whole_cycles * torch.from_numpy(first_photon_masses(flux.numpy())[:, :-1])
    restored = without_pile_up(detected, sensor, "first-photon")
    torch.testing.assert_close(restored, sensor.whole_cycles * flux, rtol=1e-9, atol=0)


def test_without_a_stated_law_it_is_the_detectors() -> None:
    """Measured counts, files of others, and pile-up too small to matter."""
    counts = np.random.default_rng(3).integers(0, 3, (2, 3, 64)).astype(np.int32)
    sensor = Sensor(bins=64, exposure_s=100 * Sensor(bins=64).period_s)
    assert detection_law(Histogram.from_counts(counts, sensor)) is None
    assert detection_law(Histogram.from_counts(counts, sensor, {"model": "zones"})) is None
    assert detection_law(sense(WALL, SENSOR, PhotonBudget(5, 5))) is None
    rows = torch.from_numpy(counts)
    assert torch.equal(without_pile_up(rows, sensor), coates(rows, 100) * 100)
    free = replace(sensor, reset="free-running", dead_time_s=2e-9)
    assert torch.equal(without_pile_up(rows, free), free_running_flux(rows, 100, free) * 100)


def test_an_unknown_law_or_method_is_refused() -> None:
    """A misspelt law would be undone as another one, and a misspelt method's confidence be that of raw counts."""
    counts = torch.ones((1, 64))
    sensor = Sensor(bins=64, exposure_s=100 * Sensor(bins=64).period_s)
    depth_m = estimate_depth(counts, sensor, "coates", law="first-photon")
    known = "poisson, first-photon, free-running"
    for refused in (
        lambda: without_pile_up(counts, sensor, "first_photon"),
        lambda: estimate_depth(counts, sensor, "coates", law=""),
        lambda: confidence(counts, depth_m, sensor, "coates", law="first_photon"),
    ):
        with pytest.raises(InputError, match=rf"^detection law '\w*' is unknown, expected one of {known}$"):
            refused()
    with pytest.raises(InputError, match="depth method 'Coates' is unknown"):
        confidence(counts, depth_m, sensor, "Coates")


def test_pile_up_of_zones_is_not_undone() -> None:
    """Zones saturate by a law of their own: none of a pixel's detector has acted on their counts."""
    sensor = Sensor(bins=64, exposure_s=100 * Sensor(bins=64).period_s)
    zones = Histogram.from_counts(np.full((1, 2, 64), 1, np.int32), sensor, {"model": "zones"})
    depth = histogram_depth_m(zones, "log-matched")
    for refused in (lambda: histogram_depth_m(zones, "coates"), lambda: confidence_map(zones, depth, "coates")):
        with pytest.raises(InputError, match=r"depth method coates: .* zones .*, use log-matched"):
            refused()


def test_a_saturated_free_running_detector_is_told_of_in_one_line(caplog) -> None:
    """Live for 2 dead times of 2000, where the rate is 1000 a dead time; and for 200, where it is 9."""
    sensor = replace(SENSOR, reset="free-running", dead_time_s=SENSOR.period_s)
    for detections, lines in ((1800, 0), (1998, 1)):
        caplog.clear()
        counts = torch.full((2, 3, sensor.bins), detections / sensor.bins)
        warn_of_saturation(counts, sensor)
        assert len(caplog.messages) == lines
        estimate_depth(counts, sensor, "coates")
        assert len(caplog.messages) == 2 * lines
    assert caplog.messages[0].startswith("pile-up: 6 of 6 pixels are saturated, live for less than 5 dead times")


@pytest.mark.parametrize("reset", ["synchronous", "free-running"])
@pytest.mark.parametrize("dead_s", [0.0, 50e-9, 100e-9, 101e-9])
def test_the_law_that_is_chosen_and_the_inverse_agree(reset: str, dead_s: float) -> None:
    sensor = replace(SENSOR, reset=reset, dead_time_s=dead_s)
    chosen, _ = choose_model("auto", PER_CYCLE, sensor)
    counts = torch.from_numpy(sense(WALL, sensor, PhotonBudget(1000, 1000), seed=4).counts[:, :4])
    assert torch.equal(without_pile_up(counts, sensor), without_pile_up(counts, sensor, chosen))


def test_a_dead_time_without_effect_is_told_in_the_plan() -> None:
    told = "the dead time of 5e-08 s has no effect, as the detector is armed at every cycle"
    short = replace(SENSOR, dead_time_s=50e-9)
    for asked, pile_up in (("auto", PER_CYCLE), ("auto", 1e-4), ("first-photon", PER_CYCLE)):
        assert told in choose_model(asked, pile_up, short)[1]
        for other in (SENSOR, replace(short, reset="free-running")):
            assert "no effect" not in choose_model(asked, pile_up, other)[1]
    assert "no effect" not in choose_model("free-running", PER_CYCLE, short)[1]
    assert "no effect" not in choose_model("auto", PER_CYCLE, replace(SENSOR, dead_time_s=101e-9))[1]


def test_confidence_of_corrected_depth_is_that_of_corrected_counts() -> None:
    """Counts as they are speak for the first bins where 4 background photons a cycle hide a pulse of 0.1."""
    histogram = sense(WALL, SENSOR, PhotonBudget(0.1 * CYCLES, 4 * CYCLES), seed=1)
    depth = histogram_depth_m(histogram, "coates")
    right = (np.abs(depth - WALL_M) < 0.05).mean()
    raw, corrected = (confidence_map(histogram, depth, method).mean() for method in ("log-matched", "coates"))
    # corrected counts scatter more than Poisson's, which flatters the confidence
    assert right > 0.8 and abs(corrected - right) < 0.15 < 0.5 < right - raw


@pytest.mark.parametrize("dead_bins", [1.0, 2.5, 6.0, 16.3, 40.3])
def test_even_light_is_found_as_high_as_is_said(dead_bins: float) -> None:
    """Detect r / (1 + r dead) of r photons a bin and cycle: the bins' mean live time gives 2 atanh(r / 2)."""
    sensor = Sensor(bins=16, bin_width_s=1e-9, dead_time_s=dead_bins * 1e-9, reset="free-running")
    for rate in (0.1, 0.5):
        counts = torch.full((16,), 1e6 * rate / (1 + rate * dead_bins), dtype=torch.float64)
        found = free_running_flux(counts, 1e6, sensor)
        assert torch.allclose(found, torch.full_like(found, 2 * np.arctanh(rate / 2)), rtol=1e-9)
