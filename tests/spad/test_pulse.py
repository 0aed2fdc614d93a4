"""Pulses of every kind: unit area, centred, convolved with jitter; presets against the prototype's calibration."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from scenes.errors import InputError
from spad.estimators.depth import confidence, cramer_rao_m, estimate_depth
from spad.sensor.model import PRESETS, PhotonBudget, Sensor
from spad.sensor.presets import TRAIN_DARK_COUNTS, TRAIN_PULSE
from spad.sensor.pulse import Pulse, SampledPulse, convolved, read_pulse
from spad.sensor.template import binned_pulse, pulse_cdf, pulse_cdf_integral, pulse_density
from spad.sensor_names import sensor_by_name

WIDTH = Sensor().bin_width_s
C = 299_792_458.0
SHAPE = tuple(np.concatenate((np.zeros(3), np.hanning(9)[1:] + 0.1, 0.5 * np.exp(-np.arange(30) / 6))))
KINDS = {
    "gaussian": Pulse(),
    "tail": Pulse(60e-12, 200e-12),
    "short tail": Pulse(200e-12, 1e-12),
    "long tail": Pulse(1e-12, 400e-12),
    "measured": SampledPulse(SHAPE, 27e-12),
    "one step": SampledPulse((3.0,), 150e-12),
}
kinds = pytest.mark.parametrize("pulse", KINDS.values(), ids=KINDS)


@kinds
def test_area_centroid_and_integrals(pulse) -> None:
    before, after = pulse.window_s(8)
    t = torch.linspace(-1.2 * before - 1e-12, 1.2 * after + 1e-12, 400001, dtype=torch.float64)
    step = float(t[1] - t[0])
    density = pulse_density(pulse, t)
    assert density.min() >= 0
    assert float(density.sum()) * step == pytest.approx(1, abs=2e-4)
    assert float((density * t).sum()) * step == pytest.approx(0, abs=2e-4 * pulse.std_s)
    assert float((density * t**2).sum()) * step == pytest.approx(pulse.std_s**2, rel=2e-3)
    arrived, integral = pulse_cdf(pulse, t), pulse_cdf_integral(pulse, t)
    assert (arrived.diff() >= -1e-15).all() and arrived[0] < 1e-12 and arrived[-1] == pytest.approx(1, abs=1e-12)
    summed = torch.cumsum(density, 0) * step
    assert (summed - arrived).abs().max() < 2 * step * density.max()
    assert (torch.cumsum(arrived, 0) * step - integral).abs().max() < 2 * step
    assert (integral >= 0).all() and float(integral[-1]) == pytest.approx(float(t[-1]), abs=1e-15)


@kinds
def test_draws_follow_the_cdf(pulse) -> None:
    drawn = pulse.draw(np.random.default_rng(3), 20000)
    test = stats.kstest(drawn.astype(float), lambda t: pulse_cdf(pulse, torch.from_numpy(np.asarray(t))).numpy())
    assert test.pvalue > 1e-3


@kinds
@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_bins_hold_one_detection_for_any_width(pulse, scale) -> None:
    """From a hundredth of a bin to three periods."""
    factor = scale * WIDTH / pulse.std_s if scale != 300.0 else 3 * 1024 * WIDTH / pulse.std_s
    if isinstance(pulse, Pulse):
        pulse = Pulse(pulse.sigma_s * factor, pulse.tail_s * factor)
    else:
        pulse = replace(pulse, sample_s=pulse.sample_s * factor)
    fraction = binned_pulse(torch.linspace(0, 1, 7, dtype=torch.float64) * 99e-9, Sensor(pulse=pulse))
    assert fraction.min() >= 0 and (fraction.sum(-1) - 1).abs().max() < 1e-9


@pytest.mark.parametrize("kernel", [Pulse(50e-12), Pulse(40e-12, 90e-12), SampledPulse((1.0, 2.0, 4.0, 1.0), 40e-12)])
@kinds
def test_jitter_is_a_second_kernel(pulse, kernel) -> None:
    """Against the integral of one density times the other's CDF, at 9 points of the flanks."""
    both = convolved(pulse, kernel)
    assert both.std_s == pytest.approx(math.hypot(pulse.std_s, kernel.std_s), rel=2e-3)
    before, after = kernel.window_s(8)
    edges = np.linspace(-before, after, 40001)
    masses, middle = kernel.bin_masses(edges), (edges[1:] + edges[:-1]) / 2
    for point in np.linspace(-1.5, 2.5, 9) * both.std_s:
        expected = masses @ pulse_cdf(pulse, torch.from_numpy(point - middle)).numpy()
        assert float(pulse_cdf(both, torch.tensor(point))) == pytest.approx(expected, abs=3e-3)


def test_gaussians_convolve_exactly() -> None:
    assert convolved(Pulse(3e-12), Pulse(4e-12)) == Pulse(5e-12)
    assert convolved(Pulse(3e-12), None) == Pulse(3e-12)
    assert Sensor(jitter=Pulse(1e-11)).response.sigma_s == math.hypot(Pulse().sigma_s, 1e-11)


def test_tail_against_quadrature() -> None:
    pulse = Pulse(60e-12, 200e-12)
    for t in (-150e-12, 0.0, 100e-12, 900e-12):
        density = lambda u, t=t: (  # noqa: E731
            math.exp(-0.5 * ((t + 200e-12 - u) / 60e-12) ** 2) * math.exp(-u / 200e-12) / (60e-12 * 200e-12)
        )
        expected = integrate.quad(density, 0, 4e-9, points=[max(t + 2e-10, 0)], limit=200)[0] / math.sqrt(2 * math.pi)
        assert float(pulse_density(pulse, torch.tensor(t))) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("tail_s", [1e-15, 2e-12, 4.2e-12, 4.3e-12, 4.4e-12, 10e-12])
def test_tails_far_shorter_than_the_gaussian(tail_s: float) -> None:
    """Both ways to the bins agree: numpy's and torch's. At 4.2 ps numpy's was off by half of the peak."""
    pulse, edges = Pulse(135e-12, tail_s), np.linspace(-1.4e-9, 1.4e-9, 401)
    masses = pulse.bin_masses(edges)
    assert np.abs(masses - np.diff(pulse_cdf(pulse, torch.from_numpy(edges)).numpy())).max() < 1e-11 * masses.max()
    assert masses.sum() == pytest.approx(1, abs=1e-11)
    assert abs(masses @ (edges[1:] + edges[:-1]) / 2) < 1e-16


def test_a_sensor_survives_json() -> None:
    import json

    for sensor in (*PRESETS.values(), Sensor(jitter=Pulse(1e-11, 2e-11), pulse=KINDS["measured"], dead_time_s=1e-8)):
        again = Sensor.from_dict(json.loads(json.dumps(sensor.to_dict())))
        assert again == sensor and hash(again) == hash(sensor)


def test_preset_constants_are_the_calibration(shared_data) -> None:
    """`iccv2023-train`: the mean of 64 rows' pulses, and the dark image's mean line by line."""
    from scipy.io import loadmat

    bright = loadmat(shared_data / "calibration" / "bright_img.mat")["bright_img"]
    dark = loadmat(shared_data / "calibration" / "dark_img.mat")["dark_img"]
    pulses = np.stack([np.roll(column, 9 - column.argmax())[:16][::-1] for column in bright[:, :64].T])
    pulses /= pulses.sum(axis=1, keepdims=True)
    assert np.abs(pulses.mean(axis=0) - TRAIN_PULSE).max() < 1e-6
    assert np.abs(dark.mean(axis=0) - TRAIN_DARK_COUNTS).max() < 0.005 + 1e-9
    sensor = sensor_by_name("iccv2023-train")
    rates = sensor.dark_rate_map_hz(64, 3) * sensor.exposure_s
    assert np.allclose(rates, np.array(TRAIN_DARK_COUNTS)[:, None]) and rates.mean() == pytest.approx(31.87, abs=0.01)
    assert sensor.period_s == pytest.approx(81.92e-9) and sensor.pulse.sample_s == sensor.bin_width_s


@pytest.mark.parametrize(
    "samples", [[np.nan, 1, 2], [np.inf, 1, 2], [1, np.nan, 2], [-1, 2, 3], [0, 0], [], [[1, 2], [3, 4]], [1e308] * 9]
)
def test_samples_that_are_no_pulse_are_refused_in_one_line(tmp_path, samples) -> None:
    np.save(tmp_path / "p.npy", np.array(samples, float))
    with pytest.raises(InputError, match=r"^[^\n]*p\.npy: [^\n]*$"):
        read_pulse(tmp_path / "p.npy", 1e-11)


@pytest.mark.parametrize(
    "values", ["text", [1], {"sigma_s": "a"}, {"sigma_s": np.nan}, {"width": 1}, {"samples": ["a"], "sample_s": 1e-11}]
)
def test_what_is_no_pulse_in_a_file_of_ours_is_refused(values) -> None:
    with pytest.raises(InputError):
        Sensor.from_dict({**Sensor().to_dict(), "pulse": values})


def test_measured_pulse_from_a_file(tmp_path, shared_data) -> None:
    """Recorded around the laser's period, with its peak at sample 0: rolled, and narrow as the file says."""
    pulse = read_pulse(shared_data / "irf" / "irf_8ps_10ns_unimodal.npy", 8e-12)
    assert pulse.std_s < 200e-12 and len(pulse.samples) == 1250
    assert np.argmax(pulse.samples) > 100
    for contents, words in ((np.zeros(5), "not all 0"), (np.ones((2, 2)), "one dimension"), (-np.ones(4), "0 or more")):
        np.save(tmp_path / "p.npy", contents)
        with pytest.raises(InputError, match=words):
            read_pulse(tmp_path / "p.npy", 8e-12)
    (tmp_path / "p.npy").write_text("words")
    with pytest.raises(InputError, match="readable"):
        read_pulse(tmp_path / "p.npy", 8e-12)


def bias_mm(sensor: Sensor, method: str) -> np.ndarray:
    arrival = torch.from_numpy(np.random.default_rng(0).uniform(100, 900, 100)) * sensor.bin_width_s
    return (
        1e3 * (estimate_depth(1e4 * binned_pulse(arrival, sensor), sensor, method).double() - arrival * C / 2).numpy()
    )


@pytest.mark.parametrize("method", ["matched", "log-matched"])
@pytest.mark.parametrize("kind", ["gaussian", "tail", "measured", "iccv2023-train"])
def test_bias_at_100_sub_bin_depths(kind: str, method: str) -> None:
    sensor = sensor_by_name(kind) if kind in PRESETS else Sensor(pulse=KINDS[kind])
    assert np.abs(bias_mm(sensor, method)).max() < 0.5


@pytest.mark.parametrize("name", ["unimodal", "multilobe"])
def test_bias_with_the_measured_asymmetric_pulse(name: str, shared_data) -> None:
    sensor = Sensor(pulse=read_pulse(shared_data / "irf" / f"irf_8ps_10ns_{name}.npy", 8e-12))
    assert np.abs(bias_mm(sensor, "log-matched")).max() < 0.5
    # and with noise: the mean error of 2000 pixels at 1000 + 100 photons
    rng = np.random.default_rng(1)
    arrival = torch.from_numpy(rng.uniform(100, 900, 2000)) * sensor.bin_width_s
    counts = torch.from_numpy(rng.poisson((1000 * binned_pulse(arrival, sensor) + 100 / 1024).numpy()))
    error = estimate_depth(counts, sensor).double() - arrival * C / 2
    assert abs(1e3 * error.mean()) < 0.5


@pytest.mark.parametrize(("signal", "background"), [(50, 50), (30, 1000), (1e4, 0)])
def test_log_matched_is_within_5_percent_of_the_bound(signal: float, background: float) -> None:
    """Root mean square over the bound; at 1000 background detections 30 is above the threshold, 10 is below it:
    S sqrt(sum h^2 / b) is 13, and 4.6, for the highest of 1024 chance peaks at about 3.2."""
    rng = np.random.default_rng(7)
    pixels = 6000
    sensor = Sensor(bins=256)  # the same background a bin
    arrival = torch.from_numpy(rng.uniform(30, 220, pixels)) * WIDTH
    counts = rng.poisson((signal * binned_pulse(arrival, sensor) + background / 1024).numpy())
    bound = cramer_rao_m(arrival, torch.tensor(float(signal)), torch.tensor(background / 1024), sensor)
    ratio = ((estimate_depth(torch.from_numpy(counts), sensor).double() - arrival * C / 2) / bound).numpy()
    assert (np.abs(ratio) > 6).mean() < 1e-3
    kept = ratio[np.abs(ratio) <= 6]
    # a sample's rms has the relative standard error 1 / sqrt(2 n), 0.8 %
    assert np.sqrt((kept**2).mean()) < 1.05 + 3 / np.sqrt(2 * pixels)


@pytest.mark.parametrize(("signal", "background"), [(2, 10), (3, 50), (10, 300)])
def test_confidence_is_the_share_of_right_answers(signal: float, background: float) -> None:
    rng = np.random.default_rng(2)
    arrival = torch.from_numpy(rng.uniform(50, 970, 4000)) * WIDTH
    counts = torch.from_numpy(rng.poisson((signal * binned_pulse(arrival, Sensor()) + background / 1024).numpy()))
    depth = estimate_depth(counts, Sensor())
    sure = confidence(counts, depth, Sensor()).numpy()
    right = ((depth.double() - arrival * C / 2).abs() < 3.5 * Sensor().bin_depth_m).numpy()
    assert sure.min() >= 0 and sure.max() <= 1
    # S and B are estimated at the very peak, which flatters it: by 0.1 to 0.25 where half the answers are wrong
    assert right.mean() - 0.03 < sure.mean() < right.mean() + 0.3
    assert sure[right].mean() > sure[~right].mean() + 0.1
    assert np.isnan(confidence(torch.zeros(1, 1024), torch.tensor([math.nan]), Sensor()).numpy()).all()


def test_confidence_is_that_of_each_pixel_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the chunks of pixels, the shape and the type of the counts."""
    counts = torch.from_numpy(np.random.default_rng(3).poisson(0.05, (3, 7, 1024))).to(torch.uint8)
    depth = estimate_depth(counts, Sensor())
    sure = confidence(counts, depth, Sensor())
    monkeypatch.setattr("spad.estimators.depth._CHUNK", {"cpu": 4 * 1024, "cuda": 4 * 1024})
    assert torch.equal(confidence(counts.int(), depth, Sensor()), sure)
    assert torch.equal(confidence(counts[1, 3], depth[1, 3], Sensor()), sure[1, 3])
    assert confidence(counts[:0], depth[:0], Sensor()).shape == (0, 7)


def test_budget_sbr() -> None:
    assert PhotonBudget(5, 0).sbr == math.inf and PhotonBudget(5, 10).sbr == 0.5


def test_kernels_that_differ_too_much_are_named_with_the_limit() -> None:
    words = (
        "of 1e-08 s and 1e-12 s differ too much in width: the wider takes .* steps of 6.25e-14 s, the limit is 65536"
    )
    with pytest.raises(InputError, match=words):
        convolved(Pulse(1e-8 / 2**0.5, 1e-8 / 2**0.5), Pulse(1e-12 / 2**0.5, 1e-12 / 2**0.5))
