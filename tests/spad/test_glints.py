"""Glints that take the photon budget are told, bright walls are not."""

from dataclasses import replace

import numpy as np
import pytest
from test_flux import transient_of

from scene2spad.cli.simulation.sensing import summary
from spad.detection.detect import sense
from spad.detection.glints import glint_warning, signal_fractions
from spad.sensor.model import PhotonBudget, Sensor

SENSOR = Sensor()


def wall(pixels: int, glint: float = 0.0):
    """A row of pixels that all see a wall at 2 m, and a pane before one of them."""
    rows = [[(4.0, 4.01, 1.0)] for _ in range(pixels)]
    if glint:
        rows[pixels // 3].append((3.0, 3.0, glint))
    return transient_of(*rows)


def warnings(histogram) -> list[str]:
    return [reason for reason in histogram.meta["plan"] if reason.startswith("warning:")]


def test_a_glint_that_takes_the_photon_budget_is_told():
    """One pane's glint as bright as 58 % of all: 50 photons are asked, the others get 21."""
    pixels = 768
    transient = wall(pixels, glint=0.58 / 0.42 * (pixels - 1) - 1)
    histogram = sense(transient, SENSOR, PhotonBudget(50, 50), seed=1)
    assert histogram.meta["brightest_pixel"] == pytest.approx(0.58, abs=1e-3)
    assert histogram.meta["median_signal"] == pytest.approx(21, abs=0.1)
    (output,) = warnings(histogram)
    assert "pixel holds 58.0% of the signal" in output and "of 50 asked photons the other pixels get 21.0" in output
    message = summary(histogram)
    assert message["brightest_pixel"] == message["brightest_thousandth"] == histogram.meta["brightest_pixel"]


def test_no_glint_no_word():
    histogram = sense(wall(64), SENSOR, PhotonBudget(50, 50), seed=1)
    assert not warnings(histogram)
    assert histogram.meta["brightest_pixel"] == pytest.approx(1 / 64)
    assert histogram.meta["median_signal"] == pytest.approx(50)


@pytest.mark.parametrize("pixels", [1, 2, 4, 1000, 4096])
def test_alike_pixels_lose_nothing_to_one_another_however_few(pixels):
    fractions = signal_fractions(np.full(pixels, 3.0))
    assert fractions.mean_of_others == pytest.approx(3) and glint_warning(fractions) is None


def test_a_bright_wall_over_a_tenth_of_the_image_is_no_glint():
    signal = np.ones((64, 64))
    signal[:7] = 50.0
    assert glint_warning(signal_fractions(signal)) is None


def test_it_matters_from_a_tenth_of_the_others_photons_on():
    for fraction, message in ((0.08, False), (0.12, True)):
        signal = np.ones(4096)
        signal[:4] = fraction / (1 - fraction) * 4092 / 4
        fractions = signal_fractions(signal)
        assert fractions.brightest_thousandth == pytest.approx(fraction) and fractions.few == 4
        assert (glint_warning(fractions) is not None) == message


def test_dark_images_and_pile_up_of_primaries():
    assert glint_warning(signal_fractions(np.zeros((2, 2)))) is None
    blind = replace(SENSOR, reset="free-running", dead_time_s=1e-6, exposure_s=1e-3)
    histogram = sense(wall(4), blind, PhotonBudget(5e3, 5e3), seed=1)
    message = summary(histogram)
    # 1 primary a cycle of 100 ns; blind for ten cycles after each detection, it counts one in eleven
    assert message["pile_up"] == pytest.approx(1.0)
    assert message["detections_per_cycle"] == pytest.approx(1 / 11, rel=0.05)
    assert "100.00% primary detections a cycle" in " ".join(histogram.meta["plan"])


@pytest.mark.parametrize(("bins", "warned"), [(100, True), (139, False), (200, False)])
def test_signal_that_arrives_after_the_record_is_told_and_is_no_glint(bins, warned):
    """Half of the pixels see 2 m, which arrives in bin 136.6, half 1 m: the glint's rule is of light, not of bins."""
    rows = [[(4.0, 4.0, 1.0)], [(2.0, 2.0, 0.2)]] * 64
    gated = Sensor(name="gated", bins=bins, period_s=SENSOR.period_s)
    histogram = sense(transient_of(*rows), gated, PhotonBudget(50, 50), seed=1)
    missed = 1 - float(histogram.expected_signal.mean()) / 50
    told = [reason for reason in histogram.meta["plan"] if "when there are no bins" in reason]
    assert bool(told) == (missed > 1e-3) == (bins < 200)
    if told:
        assert f"{missed:.1%} of the signal" in told[0] and told[0].startswith("warning:") == warned
    assert len(warnings(histogram)) == warned
