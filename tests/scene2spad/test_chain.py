"""The whole chain from geometry to depth, judged by the bound that photon statistics set."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from csph import CodingTensor, decode_depth, encode, encode_timestamps, truncated_fourier
from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scenes import InputError, Laser
from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.library.living_room import living_room
from spad.detection.detect import sense
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.estimators.depth import depth_errors, estimate_depth, histogram_depth_m
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor

SENSOR, BUDGET = Sensor(), PhotonBudget(50, 50)


@pytest.fixture(scope="module")
def scanned() -> tuple[Transient, Histogram]:
    """The default room under a scanning laser, direct light alone."""
    scene = replace(living_room(0, width=192, height=144), laser=Laser("scan"))
    transient = render(scene, RenderSettings(bounces=1))
    return transient, sense(transient, SENSOR, BUDGET, seed=1)


def cramer_rao_bound_m(transient: Transient) -> np.ndarray:
    """c/2 [sum_i (d lambda_i / d tau)^2 / lambda_i]^(-1/2) of every pixel's own expected counts, (H*W,).

    The derivative by central differences of the whole expected histogram, footprints and background included.
    """
    rates, pixels, step_m = rates_for(transient, SENSOR, BUDGET), slice(0, transient.depth_m.size), 2e-3
    rate, _ = expected_counts(transient, SENSOR, rates, pixels)
    later, _ = expected_counts(transient.delayed(step_m), SENSOR, rates, pixels)
    earlier, _ = expected_counts(transient.delayed(-step_m), SENSOR, rates, pixels)
    slope = (later - earlier) / (4 * step_m / C)
    information = (slope**2 / rate).sum(dim=1).numpy()
    with np.errstate(divide="ignore"):
        return C / 2 / np.sqrt(information)


def test_log_matched_filter_reaches_the_cramer_rao_bound(scanned, capsys):
    transient, histogram = scanned
    depth = estimate_depth(torch.from_numpy(histogram.counts.copy()), SENSOR).numpy().ravel()
    error = depth - transient.depth_m.ravel()
    # what an unmixed pixel of books and shelves holds (steps under 50 mm) is not all at its centre's depth
    from_mean_path = depth - transient.mean_path_m().ravel() / 2
    good = ~transient.mixed.ravel() & (histogram.expected_signal.ravel() >= 20)
    assert good.sum() > 15000
    bound = cramer_rao_bound_m(transient)[good]
    ratio = np.abs(error[good]) / bound
    outliers = (np.abs(error[good]) > 3 * SENSOR.pulse.sigma_s * C / 2).mean()
    with capsys.disabled():
        print(f"\nscan: median |error| / CRB {np.median(ratio):.3f} (Gaussian 0.674), median error "
              f"{1000 * np.median(error[good]):+.2f} mm, outliers {outliers:.2%} of {good.sum()} pixels")  # fmt: skip
    assert np.median(ratio) <= 1.15 * 0.6745
    assert np.median(np.abs(from_mean_path[good]) / bound) <= 1.05 * 0.6745
    assert abs(np.median(error[good])) < 1e-3
    assert outliers < 0.02


def test_estimators_rank_as_their_likelihoods_do(scanned):
    transient, histogram = scanned
    counts = torch.from_numpy(histogram.counts.copy())
    coding = CodingTensor("fourier-16", truncated_fourier(16, SENSOR.bins))
    depths = {name: estimate_depth(counts, SENSOR, name) for name in ("argmax", "matched", "log-matched")}
    depths["fourier"] = decode_depth(encode(counts, coding), coding, SENSOR)
    weak = (histogram.expected_signal < 20) | histogram.mixed
    median = {n: np.median(np.abs(d.numpy() - transient.depth_m)[~weak]) for n, d in depths.items()}
    assert median["log-matched"] < median["matched"] < median["argmax"]
    assert median["log-matched"] < median["fourier"] < 0.03
    errors = depth_errors(depths["log-matched"], histogram.depth_m, range_m=SENSOR.range_m, exclude=weak)
    assert errors["pixels"] == (~weak).sum() and errors["mae_mm"] < 6


def test_timestamps_and_histogram_give_the_same_codes(scanned):
    _, histogram = scanned
    coding = CodingTensor("fourier-16", truncated_fourier(16, SENSOR.bins))
    stamps, offsets = histogram.timestamps()
    sparse = encode_timestamps(torch.from_numpy(stamps.astype(np.int64)), torch.from_numpy(offsets), coding)
    dense = encode(torch.from_numpy(histogram.counts.reshape(-1, SENSOR.bins).copy()), coding)
    # float32 sums of up to thousands of unit terms
    assert (sparse - dense).abs().max() < 4e-6 * dense.abs().sum(-1).max()


def test_a_delayed_scene_is_estimated_the_same_amount_later(scanned):
    """A time offset leaves counts alone: the noise-free histogram of the delayed scene is the same, shifted."""
    transient, _ = scanned
    bins = 300
    later = transient.delayed(bins * SENSOR.bin_depth_m)
    rates, pixels = rates_for(transient, SENSOR, BUDGET), slice(0, 512)
    here, _ = expected_counts(transient, SENSOR, rates, pixels)
    there, _ = expected_counts(later, SENSOR, rates, pixels)
    assert (torch.roll(here, bins, dims=1) - there).abs().max() < 1e-4 * here.max()


def test_flood_light_is_reported_beside_the_scan(capsys):
    """Multipath is real: no bar, but the numbers must exist and multipath must bias depth away from the camera."""
    transient = render(living_room(0, width=64, height=48), RenderSettings(error=0.05))
    histogram = sense(transient, SENSOR, BUDGET, seed=1)
    depth = estimate_depth(torch.from_numpy(histogram.counts.copy()), SENSOR).numpy()
    good = ~transient.mixed & (histogram.expected_signal >= 20)
    bias = 1000 * np.median((depth - transient.depth_m)[good])
    with capsys.disabled():
        print(f"\nflood: median error {bias:+.2f} mm, {transient.indirect_fraction:.1%} of the light is indirect")
    assert transient.indirect_fraction > 0.05 and bias > 0


@pytest.mark.parametrize("baseline", [(0.5, 0.0, 0.0), (0.0, 0.2, -0.3)])
def test_displaced_laser_is_decoded_by_its_ellipsoid(baseline):
    from scenes.library.catalog import load_scene

    scene = replace(load_scene("plane", width=24, height=18), laser=Laser("flood", baseline, 120.0))
    transient = render(scene, RenderSettings(bounces=1))
    histogram = sense(transient, SENSOR, PhotonBudget(1e5, 0), seed=1, model="poisson")  # not pile-up: geometry
    assert np.abs(histogram_depth_m(histogram, "log-matched") - transient.depth_m).max() < 1e-3
    with pytest.raises(InputError, match="co-located"):
        transient.delayed(1.0)
