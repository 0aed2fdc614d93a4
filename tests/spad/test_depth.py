"""Classical depth estimators against closed forms, the Cramer-Rao bound, and the laws that hold for each of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes import Camera
from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.errors import InputError
from spad.estimators.bistatic import radial_depth_m
from spad.estimators.depth import (
    ESTIMATORS,
    METHODS,
    by_pixels,
    cramer_rao_m,
    depth_errors,
    estimate_depth,
    histogram_depth_m,
    histogram_errors,
    noise_free_bias_m,
)
from spad.estimators.matching import correlation, normalised_correlation
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.template import binned_pulse, pulse_taps

REFERENCE = Sensor()
WIDTH = REFERENCE.bin_width_s
SMALL = Sensor(name="small", bins=64)
GATED = Sensor(name="gated", bins=512, period_s=REFERENCE.period_s)
NARROW = Sensor(name="narrow", pulse=Pulse(0.25 * WIDTH))
WIDE = Sensor(name="wide", pulse=Pulse(30 * WIDTH))
SUB_BIN = ("matched", "log-matched")
LINEAR = tuple(method for method in METHODS if method != "coates")  # which takes more counts for pile-up
# Half a bin where whole bins are searched; over whole bins with a parabola a share of a bin, measured 0.05.
WHOLE_BIN = {"argmax": 0.51, "lmf-published": 0.51, "correlation": 0.07}


def wrapped_error(depth: torch.Tensor, arrival_s: torch.Tensor, sensor: Sensor) -> torch.Tensor:
    half = sensor.range_m / 2
    return torch.remainder(depth.double() - arrival_s * C / 2 + half, 2 * half) - half


def drawn(signal: float, background: float, pixels: int, seed: int, sensor: Sensor = REFERENCE) -> tuple:
    """Poisson counts (P, T) int32 of lone pulses at uniform arrival times (P,) over the whole period."""
    rng = np.random.default_rng(seed)
    arrival = torch.from_numpy(rng.random(pixels) * sensor.period_s)
    rate = signal * binned_pulse(arrival, sensor) + background / sensor.bins
    return torch.from_numpy(rng.poisson(rate.numpy()).astype(np.int32)), arrival


# The noise-free answer


@pytest.mark.parametrize("sensor", [REFERENCE, NARROW, WIDE, GATED, SMALL], ids=lambda sensor: sensor.name)
@pytest.mark.parametrize("method", LINEAR)
def test_noise_free_answer_is_the_truth(method: str, sensor: Sensor) -> None:
    # Other phases and another place than the ones the subtraction is averaged over, same spacing: the mean is zero
    # as far as the answer repeats with the bin.
    phases = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
    arrival = (20 + phases) * WIDTH if sensor is SMALL else (200 + phases) * WIDTH
    error_mm = 1e3 * wrapped_error(estimate_depth(1e4 * binned_pulse(arrival, sensor), sensor, method), arrival, sensor)
    # Measured: 0.0006 mm on `reference` (parabola over eighths of a bin), float32 depth rounds to 0.0002 mm at 3 m.
    # A pulse of a quarter bin is searched in steps of 1/64 bin.
    limit = 0.1 if sensor is NARROW else 0.005
    if method in WHOLE_BIN and not (method == "correlation" and sensor is WIDE):
        limit = 1e3 * sensor.bin_depth_m * (0.51 if sensor is NARROW else WHOLE_BIN[method])
    assert error_mm.abs().max() < limit
    assert abs(error_mm.mean()) < (0.05 if method in WHOLE_BIN else limit / 2)


def test_subtracted_answer_of_a_method_and_of_a_function_agree() -> None:
    for method in LINEAR:
        assert abs(noise_free_bias_m(lambda counts, m=method: estimate_depth(counts, REFERENCE, m), REFERENCE)) < 1e-6
    # A function that is 7 mm off says so.
    shifted = noise_free_bias_m(lambda counts: estimate_depth(counts, REFERENCE) + 0.007, REFERENCE)
    assert shifted == pytest.approx(0.007, abs=1e-6)


def test_an_estimator_that_answers_late_is_put_right(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, _ = drawn(50, 5, 20, seed=2, sensor=SMALL)
    late = {name: lambda part, sensor, f=function: f(part, sensor) + 0.7 for name, function in ESTIMATORS.items()}
    other = Sensor(name="another", bins=64)  # its answer is not cached yet, and is not asked for again
    monkeypatch.setattr("spad.estimators.depth.ESTIMATORS", late)
    shifted = {method: estimate_depth(counts, other, method) for method in METHODS}
    monkeypatch.undo()
    for method in METHODS:
        assert torch.allclose(shifted[method], estimate_depth(counts, SMALL, method), atol=1e-6)


@pytest.mark.parametrize("method", SUB_BIN)
@pytest.mark.parametrize("arrival_bins", [0.0, 0.3, 1.9, 1022.1, 1023.5, 1023.99])
def test_pulse_over_the_edge_of_the_period(method: str, arrival_bins: float) -> None:
    arrival = torch.tensor([arrival_bins], dtype=torch.float64) * WIDTH
    depth = estimate_depth(500 * binned_pulse(arrival, REFERENCE), REFERENCE, method)
    assert 0 <= depth < REFERENCE.range_m
    assert wrapped_error(depth, arrival, REFERENCE).abs() < 1e-5


# Noise


# Relative standard error of a sample median of |N(0,1)| over n: sqrt(1/4n) / (density 0.636) / 0.6745 = 1.17 / sqrt(n),
# 1.9 % at 4000. 1.10 leaves four of them above the 0.98 to 1.02 that 8000 other pixels showed.
@pytest.mark.parametrize(("signal", "background"), [(50, 50), (20, 50), (1e4, 0)])
def test_log_matched_reaches_the_cramer_rao_bound(signal: float, background: float) -> None:
    counts, arrival = drawn(signal, background, 4000, seed=11)
    bound = cramer_rao_m(arrival, torch.tensor(signal), torch.tensor(background / 1024), REFERENCE)
    error = wrapped_error(estimate_depth(counts, REFERENCE), arrival, REFERENCE)
    assert (error.abs() / bound).median() < 1.10 * 0.6745
    # The median's standard error is 1.25 bound / sqrt(n): under 0.1 mm here.
    assert error.median().abs() < 5 * 1.25 * bound.mean() / math.sqrt(4000) < 1e-3
    assert (error.abs() > 6 * bound).double().mean() < 2e-3
    # The matched filter does not know that tails tell more where there is no background: measured 1.19 to 1.25.
    matched = wrapped_error(estimate_depth(counts, REFERENCE, "matched"), arrival, REFERENCE)
    assert (matched.abs() / bound).median() < 1.40 * 0.6745
    assert matched.median().abs() < 1e-3


@pytest.mark.parametrize("sensor", [REFERENCE, GATED, Sensor(name="odd", bins=150), WIDE], ids=lambda s: s.name)
def test_bins_before_pixels_are_correlated_as_pixels_before_bins_are(sensor: Sensor) -> None:
    """Blocks of bins, also where they do not fill the period, on two images; deep background does not cost digits."""
    generator = torch.Generator().manual_seed(11)
    counts = torch.poisson(torch.tensor([0.4, 3000.0])[:, None, None].expand(2, 5, sensor.bins), generator=generator)
    pulse = pulse_taps(sensor, "cpu").centred
    norm = ((pulse**2).sum() - pulse.sum() ** 2 / sensor.bins).sqrt()
    exact = counts.double().flatten(0, 1)
    spread = (exact - exact.mean(-1, keepdim=True)).norm(dim=-1, keepdim=True)
    expected = (correlation(exact, sensor) / (spread * norm)).view(counts.shape).mT
    found = normalised_correlation(counts.mT.contiguous(), sensor)
    # float32 rounds relative to the counts' level, which is 55 times their spread in the second image
    assert (found[0] - expected[0]).abs().max() < 1e-5 and (found[1] - expected[1]).abs().max() < 1e-4
    assert expected.abs().amax() > 0.05


def test_argmax_is_within_the_pulse() -> None:
    counts, arrival = drawn(1e6, 50, 500, seed=3)
    assert (
        wrapped_error(estimate_depth(counts, REFERENCE, "argmax"), arrival, REFERENCE).abs().max()
        < REFERENCE.bin_depth_m
    )


@pytest.mark.parametrize("sensor", [NARROW, WIDE, SMALL], ids=lambda sensor: sensor.name)
def test_log_matched_keeps_to_the_bound_on_other_sensors(sensor: Sensor) -> None:
    counts, arrival = drawn(100, 10, 2000, seed=5, sensor=sensor)
    bound = cramer_rao_m(arrival, torch.tensor(100.0), torch.tensor(10 / sensor.bins), sensor)
    error = wrapped_error(estimate_depth(counts, sensor), arrival, sensor)
    # Only where the bound says something: a quarter-bin pulse inside one bin has no information on its place.
    known = bound < sensor.bin_depth_m / 8 if sensor is NARROW else torch.ones_like(bound, dtype=torch.bool)
    assert known.double().mean() > 0.3
    assert (error.abs() / bound)[known].median() < 1.15 * 0.6745


def test_gated_sensor_sees_to_the_end_of_its_bins() -> None:
    rng = np.random.default_rng(9)
    arrival = torch.from_numpy(rng.uniform(5, 507, 1000)) * WIDTH
    rate = 50 * binned_pulse(arrival, GATED) + 25 / 512
    counts = torch.from_numpy(rng.poisson(rate.numpy()))
    bound = cramer_rao_m(arrival, torch.tensor(50.0), torch.tensor(25 / 512), GATED)
    depth = estimate_depth(counts, GATED)
    assert depth.min() >= 0 and depth.max() <= GATED.bins * GATED.bin_depth_m
    assert ((depth - arrival * C / 2).abs() / bound).median() < 1.15 * 0.6745


@pytest.mark.parametrize("position", [0.3, 1.0, 2.7, 509.2, 511.0, 511.8])
def test_gated_sensor_sees_half_a_pulse_at_its_edges(position: float) -> None:
    # The likelihood knows what falls outside the bins: without that it is pulled inwards by up to 8 mm, as the matched
    # filter is by up to 13 mm. Measured 0.016 mm.
    arrival = torch.tensor([position], dtype=torch.float64) * WIDTH
    pulse = 1e4 * binned_pulse(arrival, GATED)
    depth = estimate_depth(pulse, GATED)
    assert (depth - arrival * C / 2).abs() < 5e-5
    # Counts at the other end of the bins are no neighbours.
    other = torch.tensor([512.0 - position], dtype=torch.float64) * WIDTH
    alone, both = (estimate_depth(pulse + n * binned_pulse(other, GATED), GATED, "matched") for n in (0, 1000))
    assert (both - alone).abs() < 1e-5


# Odd pixels


@pytest.mark.parametrize("sensor", [REFERENCE, GATED, SMALL, Sensor(bins=1)], ids=lambda sensor: str(sensor.bins))
@pytest.mark.parametrize("method", METHODS)
def test_pixels_without_a_clear_answer_stay_finite_and_empty_ones_are_missing(method: str, sensor: Sensor) -> None:
    bins = sensor.bins
    counts = torch.zeros((4, bins), dtype=torch.int32)
    counts[1, bins // 3] = 1
    counts[2] = torch.from_numpy(np.random.default_rng(1).poisson(0.3, bins).astype(np.int32))
    counts[2, 0] += 1
    counts[3] = 7
    depth = estimate_depth(counts, sensor, method)
    assert depth.dtype == torch.float32 and depth.shape == (4,)
    assert depth.isnan().tolist() == [True, False, False, False]
    assert (depth[1:] >= 0).all() and (depth[1:] < sensor.range_m).all()
    assert abs(depth[1] - (bins // 3 + 0.5) * sensor.bin_depth_m) < 0.5 * sensor.bin_depth_m


def test_ten_million_detections_in_a_pixel() -> None:
    counts, arrival = drawn(1e7, 1e3, 50, seed=4)
    bound = cramer_rao_m(arrival, torch.tensor(1e7), torch.tensor(1e3 / 1024), REFERENCE)
    for method, factor in (("matched", 1.5), ("log-matched", 1.1)):
        error = wrapped_error(estimate_depth(counts, REFERENCE, method), arrival, REFERENCE)
        # 5 standard errors above the bound, plus half a unit in the last place of a float32 depth (0.5 um at 15 m).
        assert error.abs().max() < 5 * factor * bound.mean() + 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_chunks_shape_and_type_do_not_matter(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    counts, _ = drawn(20, 20, 60, seed=8, sensor=SMALL)
    depth = estimate_depth(counts, SMALL, method)
    assert torch.equal(estimate_depth(counts.reshape(3, 4, 5, 64), SMALL, method), depth.reshape(3, 4, 5))
    assert torch.equal(estimate_depth(counts.double(), SMALL, method), depth)
    assert torch.equal(estimate_depth(counts.to(torch.uint8), SMALL, method), depth)
    assert torch.equal(estimate_depth(counts[7], SMALL, method), depth[7])
    assert estimate_depth(counts[:0], SMALL, method).shape == (0,)
    monkeypatch.setattr("spad.estimators.depth._CHUNK", {"cpu": 7 * 64, "cuda": 7 * 64})
    assert [len(part) for part in _parts(counts)] == [7] * 8 + [4]
    assert torch.equal(estimate_depth(counts, SMALL, method), depth)


def _parts(counts: torch.Tensor) -> list[torch.Tensor]:
    seen: list[torch.Tensor] = []
    by_pixels(lambda part: seen.append(part) or part, counts)
    return seen


def test_bad_input_is_refused_in_one_line() -> None:
    counts = torch.ones((2, 1024))
    bad = {
        "last axis": (counts[:, :1000], "matched"),
        "0 or more": (-counts, "matched"),
        "nan": (counts * math.nan, "argmax"),
        "inf": (counts * math.inf, "argmax"),
        "argmax, matched, log-matched, correlation, lmf-published, coates": (counts, "median"),
    }
    for expected, (histogram, method) in bad.items():
        with pytest.raises(InputError, match=expected) as caught:
            estimate_depth(histogram, REFERENCE, method)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="last axis"):
        estimate_depth(torch.tensor(3), REFERENCE)
    with pytest.raises(InputError, match="unknown"):
        noise_free_bias_m("median", REFERENCE)


# Laws


@settings(deadline=None, max_examples=20)
@given(st.sampled_from(LINEAR), st.integers(-200, 200), st.integers(0, 2**32 - 1), st.integers(1, 50))
def test_shifting_the_histogram_shifts_the_depth(method: str, shift: int, seed: int, factor: int) -> None:
    counts, _ = drawn(300, 20, 4, seed=seed, sensor=SMALL)
    if method == "argmax":  # no two equal maxima: the first of them depends on where bin 0 is
        counts = counts * 64 + torch.arange(64, dtype=torch.int32).flip(0)
    depth = estimate_depth(counts, SMALL, method).double()
    moved = estimate_depth(counts.roll(shift, dims=-1), SMALL, method).double()
    expected = depth / C * 2 + shift * SMALL.bin_width_s
    assert wrapped_error(moved, expected, SMALL).abs().max() < 1e-6
    # A linear score does not change its peak when all counts are multiplied.
    if method != "log-matched":
        scaled = estimate_depth(counts * factor, SMALL, method).double()
        assert wrapped_error(scaled, depth / C * 2, SMALL).abs().max() < 1e-6


@settings(deadline=None, max_examples=15)
@given(st.sampled_from(SUB_BIN), st.integers(0, 2**32 - 1))
def test_a_mirrored_histogram_mirrors_the_depth(method: str, seed: int) -> None:
    counts, _ = drawn(300, 20, 4, seed=seed, sensor=SMALL)
    depth = estimate_depth(counts, SMALL, method).double()
    mirrored = estimate_depth(counts.flip(-1), SMALL, method).double()
    # A symmetric pulse has no preferred direction; the two scores add in another order (float32, 1e-7).
    assert wrapped_error(mirrored, SMALL.period_s - depth / C * 2, SMALL).abs().max() < 2e-6


# The bound


def test_cramer_rao_bound_from_finite_differences() -> None:
    arrival = torch.tensor([0.2, 100.5, 900.99], dtype=torch.float64) * WIDTH
    step = 1e-5 * REFERENCE.pulse.sigma_s
    rate = 50 * binned_pulse(arrival, REFERENCE) + 0.05
    slope = 50 * (binned_pulse(arrival + step, REFERENCE) - binned_pulse(arrival - step, REFERENCE)) / (2 * step)
    expected = C / 2 / (slope**2 / rate).sum(-1).sqrt()
    bound = cramer_rao_m(arrival, torch.tensor(50.0), torch.tensor(0.05), REFERENCE)
    assert torch.allclose(bound, expected, rtol=1e-7)


def test_cramer_rao_limits() -> None:
    # Without background and with fine bins: c sigma / (2 sqrt S). Bins of w lose w^2 / (12 sigma^2) of information.
    fine = Sensor(bins=4096, bin_width_s=WIDTH / 32)
    arrival = torch.tensor([2000.3], dtype=torch.float64) * fine.bin_width_s
    textbook = C / 2 * fine.pulse.sigma_s / math.sqrt(80)
    assert cramer_rao_m(arrival, torch.tensor(80.0), torch.tensor(0.0), fine) == pytest.approx(textbook, rel=1e-4)
    ladder = cramer_rao_m(arrival, torch.tensor(80.0), torch.tensor([0.0, 0.1, 1.0, 10.0]), fine)
    assert ladder.shape == (4,) and (ladder.diff() > 0).all()
    # Much background: (S f')^2 / b is left, the integral of f'^2 is 1 / (4 sqrt(pi) sigma^3), b in counts per second.
    heavy = 1e6
    information = 80**2 / (heavy / fine.bin_width_s) / (4 * math.sqrt(math.pi) * fine.pulse.sigma_s**3)
    bound = cramer_rao_m(arrival, torch.tensor(80.0), torch.tensor(heavy), fine)
    assert bound == pytest.approx(C / 2 / math.sqrt(information), rel=1e-3)
    assert cramer_rao_m(arrival, torch.tensor(0.0), torch.tensor(1.0), fine).isinf().all()


# Error figures


def test_depth_errors_counts_what_it_leaves_out() -> None:
    truth = np.array([[1.0, 2.0, np.nan, 20.0], [3.0, 4.0, 5.0, 6.0]])
    estimate = np.array([[1.010, 2.004, 1.0, 5.0], [np.nan, 3.992, 9.0, 6.02]])
    exclude = np.zeros((2, 4), bool)
    exclude[1, 2] = True
    figures = depth_errors(torch.from_numpy(estimate), truth, range_m=15.0, exclude=exclude)
    errors = np.array([10.0, 4.0, -8.0, 20.0])
    assert (figures["pixels"], figures["empty"], figures["beyond_range"], figures["missing"]) == (4, 1, 1, 1)
    assert figures["mae_mm"] == pytest.approx(np.abs(errors).mean())
    assert figures["rmse_mm"] == pytest.approx(np.sqrt((errors**2).mean()))
    assert figures["median_mm"] == pytest.approx(7.0)
    exact = depth_errors(np.array([0.0, 0.010]), np.zeros(2), range_m=1.0)
    assert exact["within_10mm"] == 0.5  # strictly under
    nothing = depth_errors(np.array([np.nan]), np.array([1.0]), range_m=15.0)
    assert nothing["pixels"] == 0 and nothing["missing"] == 1 and math.isnan(nothing["mae_mm"])
    with pytest.raises(InputError, match="alike"):
        depth_errors(np.zeros(3), np.zeros(4), range_m=1.0)


def beside_a_displaced_laser(baseline_m: tuple[float, float, float], sensor: Sensor = REFERENCE) -> Histogram:
    """Bright pixels of an oblique wall, lit from `baseline_m`: arrival times by the two legs, without any formula."""
    camera = Camera(np.eye(4), 60.0, 8, 6)
    rays = camera.rays() @ camera.rotation
    depth = 2.0 / (rays @ (0.3, 0.1, 0.95))
    path = depth + np.linalg.norm(depth[..., None] * rays - baseline_m, axis=-1)
    rate = 2e4 * binned_pulse(torch.from_numpy(path) / C, sensor)
    geometry = {
        "camera": {"pose": np.eye(4).tolist(), "fov_deg": 60.0, "width": 8, "height": 6},
        "laser": {"mode": "flood", "baseline_m": list(baseline_m), "cone_deg": None},
    }
    zeros = np.zeros((6, 8), np.float32)
    truth = (depth.astype(np.float32), zeros > 0, zeros.astype(np.float16), zeros, zeros)
    counts = rate.round().to(torch.int32).numpy()
    return Histogram(counts, sensor, PhotonBudget(1, 0), *truth, meta={"transient": geometry})


@pytest.mark.parametrize("baseline_m", [(0.0, 0.0, 0.0), (0.8, -0.3, 0.2)])
def test_depth_of_a_histogram_knows_where_the_laser_is(baseline_m):
    """The library's function, not the command alone, gives distances from the camera beside a displaced laser."""
    histogram = beside_a_displaced_laser(baseline_m)
    for estimator in ("log-matched", lambda counts, sensor: estimate_depth(counts, sensor, "matched")):
        assert np.abs(histogram_depth_m(histogram, estimator) - histogram.depth_m).max() < 2e-3
    half_path = estimate_depth(torch.from_numpy(histogram.counts), histogram.sensor).numpy()
    assert (np.abs(half_path - histogram.depth_m).max() > 0.03) == any(baseline_m)
    blind = replace(histogram, meta={})
    assert np.array_equal(histogram_depth_m(blind), half_path), "counts without a geometry stay half paths"


@pytest.mark.parametrize("baseline_m", [(0.0, 0.0, 0.0), (0.8, -0.3, 0.2)])
def test_errors_are_of_the_pixels_whose_return_the_record_holds(baseline_m):
    """The period goes on after the last bin; beside a displaced laser the path decides, not the depth."""
    whole = beside_a_displaced_laser(baseline_m)
    rays = Camera(np.eye(4), 60.0, 8, 6).rays()
    path = whole.depth_m + np.linalg.norm(whole.depth_m[..., None] * rays - baseline_m, axis=-1)
    bins = int(np.median(path) / (2 * REFERENCE.bin_depth_m))
    gated = beside_a_displaced_laser(baseline_m, Sensor(bins=bins, period_s=REFERENCE.period_s))
    held = path < 2 * bins * REFERENCE.bin_depth_m
    errors = histogram_errors(whole.depth_m, gated)
    assert (errors["pixels"], errors["beyond_range"]) == (held.sum(), (~held).sum())
    assert 0 < errors["pixels"] < held.size and histogram_errors(whole.depth_m, whole)["pixels"] == held.size
    near = whole.depth_m < np.sort(whole.depth_m.ravel())[held.sum()]
    assert np.array_equal(near, held) != any(baseline_m)


def test_a_record_shorter_than_the_baseline_holds_no_return():
    histogram = beside_a_displaced_laser((0.8, -0.3, 0.2), Sensor(bins=16, period_s=REFERENCE.period_s))
    errors = histogram_errors(histogram.depth_m, histogram)
    assert errors["pixels"] == 0 and errors["beyond_range"] == histogram.depth_m.size


def test_paths_that_no_surface_gives_have_no_depth():
    """Light from a laser 0.3 m aside takes more than 0.3 m to the camera."""
    half_path = np.array([0.0, 0.05, 0.15, 0.1500001, 0.2, 1.0])
    ahead = np.tile([0.0, 0.0, 1.0], (6, 1))
    depth = radial_depth_m(half_path, ahead, (0.3, 0.0, 0.0))
    assert np.isnan(depth[:3]).all() and (depth[3:] >= 0).all()
    legs = depth[3:] + np.hypot(depth[3:], 0.3)
    assert legs == pytest.approx(2 * half_path[3:], rel=1e-5)
    aside = np.tile([0.6, 0.0, 0.8], (6, 1))  # 2 (p - r.b) is 0 at a path of 0.18 m
    assert np.isnan(radial_depth_m(np.array([0.05, 0.09, 0.1]), aside[:3], (0.3, 0.0, 0.0))).all()
