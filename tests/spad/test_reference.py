"""The fast laws of detection against one photon after the other (`spad.reference`), by chi-square."""

import numpy as np
import pytest
from scipy import stats
from test_flux import transient_of

from spad.detection.detect import sense
from spad.detection.laws import first_photon_masses
from spad.measurements.histogram import Histogram
from spad.reference import arrivals, detect_free_running, detect_synchronous
from spad.sensor.model import PhotonBudget, Sensor

BINS, CYCLES = 8, 20000


def chi_square(one: np.ndarray, other: np.ndarray) -> float:
    """Probability of a difference as large between two histograms of the same law."""
    return stats.chi2_contingency(np.stack([one, other]) + 0.5).pvalue


def test_first_photons_of_a_synchronous_detector_follow_the_multinomial():
    rng = np.random.default_rng(1)
    flux = rng.uniform(0.02, 0.4, BINS)
    counts = detect_synchronous(arrivals(flux, CYCLES, rng), BINS)
    expected = first_photon_masses(flux[None])[0] * CYCLES
    assert stats.chisquare([*counts, CYCLES - counts.sum()], expected).pvalue > 1e-4


@pytest.mark.parametrize("dead_bins", [2.5, 11.0])
def test_a_free_running_detector_loses_what_the_plain_one_loses(dead_bins):
    """Counts of 64 pixels of uniform light, summed, against the plain detector's over as many cycles."""
    width, cycles, pixels, rate = 1e-9, 400, 64, 0.08
    sensor = Sensor(
        bins=BINS,
        bin_width_s=width,
        period_s=BINS * width,
        exposure_s=cycles * BINS * width,
        dead_time_s=dead_bins * width,
        reset="free-running",
    )
    transient = transient_of(*[[]] * pixels, ambient=[1.0] * pixels)
    sensed: Histogram = sense(transient, sensor, PhotonBudget(0, rate * BINS * cycles), seed=5, model="free-running")
    rng = np.random.default_rng(2)
    plain = [detect_free_running(arrivals([rate] * BINS, cycles, rng), BINS, dead_bins) for _ in range(pixels)]
    ours, theirs = sensed.counts.sum(), np.sum(plain)
    # dead time makes counts more regular than Poisson's: its deviation is an upper bound
    assert abs(float(ours) - theirs) < 4.5 * np.sqrt(float(ours) + theirs)
    assert chi_square(sensed.counts.reshape(-1, BINS).sum(0), np.sum(plain, axis=0)) > 1e-4
