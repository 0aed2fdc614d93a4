"""The bench: its histogram, its error estimate, its curves, its cache, and the command on a few pixels."""

import csv
import importlib.util
import json
import math
from pathlib import Path

import numpy as np
import pytest

from render.transient.samples import Samples
from scene2spad.bench.rendering import references, settings
from scene2spad.bench.rendering.binning import binned
from scene2spad.bench.rendering.curves import Point, flattens, front, ratio_at, seconds_at, slopes
from scene2spad.bench.rendering.errors import Judge, Reference, crosswise, pulse_kernel, pulsed
from scene2spad.cli import main


def samples_of(pixel, path_m, half_width_m, radiance) -> Samples:
    columns = (np.asarray(c, dtype) for c, dtype in ((pixel, np.int64), (path_m, float), (half_width_m, float)))
    return Samples(*columns, np.asarray(radiance, float), np.ones(len(pixel), np.uint8))


def binned_by_hand(samples: Samples, pixels: int, bins: int, bin_m: float) -> np.ndarray:
    """One sample and one bin at a time."""
    result = np.zeros((pixels, bins))
    for pixel, path, half, energy, _ in zip(*samples, strict=True):
        for i in range(bins):
            low, high = i * bin_m, (i + 1) * bin_m
            if half == 0:
                result[pixel, i] += energy * (low <= path < high)
            else:
                overlap = min(high, path + half) - max(low, path - half)
                result[pixel, i] += energy * max(overlap, 0) / (2 * half)
    return result


def test_binned_is_the_overlap_of_every_interval_with_every_bin():
    random = np.random.default_rng(1)
    n, pixels, bins, bin_m = 600, 7, 20, 0.25
    half = random.choice([0, 0.01, 0.1, 0.3, 2.0, 9.0], n)
    samples = samples_of(random.integers(0, pixels, n), random.uniform(-1, 7, n), half, random.random(n))
    expected = binned_by_hand(samples, pixels, bins, bin_m)
    found = binned(samples, pixels, bins, bin_m)
    assert found.dtype == np.float32 and found.shape == (pixels, bins)
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("path", "half", "expected"),
    [
        (0.5, 0.0, [1, 0, 0, 0]),
        (1.0, 0.0, [0, 1, 0, 0]),  # an edge belongs to the bin above it
        (4.0, 0.0, [0, 0, 0, 0]),
        (-0.1, 0.0, [0, 0, 0, 0]),
        (1.5, 0.5, [0, 1, 0, 0]),
        (2.0, 2.0, [0.25, 0.25, 0.25, 0.25]),
        (0.0, 2.0, [0.25, 0.25, 0, 0]),
        (4.0, 2.0, [0, 0, 0.25, 0.25]),
        (2.0, 4.0, [0.125, 0.125, 0.125, 0.125]),
        (9.0, 1.0, [0, 0, 0, 0]),
    ],
)
def test_binned_at_edges(path, half, expected):
    found = binned(samples_of([0], [path], [half], [1.0]), 1, 4, 1.0)
    assert found[0] == pytest.approx(expected, abs=1e-7)


def test_binned_keeps_energy():
    random = np.random.default_rng(2)
    n = 5000
    samples = samples_of(
        random.integers(0, 50, n), random.uniform(5, 20, n), random.random(n) ** 4 * 3, random.random(n)
    )
    found = binned(samples, 50, 1024, 0.0293)
    assert found.sum(dtype=np.float64) == pytest.approx(samples.radiance.sum(), rel=1e-5)
    empty = binned(samples_of([], [], [], []), 50, 1024, 0.0293)
    assert not empty.any()


def test_pulse_keeps_energy_and_has_its_width():
    histogram = np.zeros((1, 200), np.float32)
    histogram[0, 90] = 1
    found = pulsed(histogram)[0].astype(float)
    kernel = pulse_kernel()
    assert found.sum() == pytest.approx(1, abs=1e-6) and np.argmax(found) == 90
    assert found[90 : 90 + len(kernel)] == pytest.approx(kernel, abs=1e-7)
    # a bin's width adds 1/12 to the variance of what is integrated over it
    bins = np.arange(200) - 90
    assert (found * bins**2).sum() == pytest.approx((135 * 1.024 / 100) ** 2 + 1 / 12, rel=1e-3)


@pytest.mark.parametrize(("pixels", "bins"), [(3, 40), (700, 64), (2, 130)])
def test_pulse_is_a_convolution_with_nothing_outside(pixels, bins):
    histogram = np.random.default_rng(3).random((pixels, bins)).astype(np.float32)
    kernel = pulse_kernel()
    both = np.concatenate((kernel[:0:-1], kernel))
    reach = len(kernel) - 1
    expected = np.stack([np.convolve(row, both)[reach : reach + bins] for row in histogram])
    assert np.allclose(pulsed(histogram), expected, atol=1e-6)
    sums = crosswise(histogram, 2 * histogram)
    assert sums[0] == pytest.approx(2 * (histogram**2).sum(axis=1), rel=1e-5)
    assert sums[1] == pytest.approx(2 * (expected**2).sum(axis=1), rel=1e-5)


def noisy(truth: np.ndarray, sigma: float, random: np.random.Generator) -> np.ndarray:
    return (truth + sigma * random.standard_normal(truth.shape)).astype(np.float32)


def test_the_references_noise_cancels():
    """A method 5 times better than the reference is judged right, and an exact one is below the resolution."""
    random = np.random.default_rng(4)
    truth = random.random((400, 64)) ** 4
    power = (truth**2).sum()
    halves, sigma, trials = 0.05, 0.01, 60
    found = []
    for _ in range(trials):
        judge = Judge(Reference(noisy(truth, halves, random), noisy(truth, halves, random), "noise"))
        judge.add(noisy(truth, sigma, random))
        found.append((judge.squared / judge.reference.power.sum(axis=1)[:, None]).sum(axis=1))
    expected = truth.size * sigma**2 / power
    mean, deviation = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / math.sqrt(trials)
    assert abs(mean[0] - expected) < 4 * deviation[0] and deviation[0] < 0.1 * expected
    # after the pulse white noise keeps the sum of the squared kernel; a few bins at the rim keep less
    kernel = pulse_kernel()
    kept = kernel[0] ** 2 + 2 * (kernel[1:] ** 2).sum()
    pulse_power = (pulsed(truth.astype(np.float32)) ** 2).sum()
    assert abs(mean[1] - kept * truth.size * sigma**2 / pulse_power) < 4 * deviation[1] + 0.03 * mean[1]


def test_resolution_is_two_standard_deviations_of_an_exact_result():
    random = np.random.default_rng(5)
    truth = random.random((300, 64)) ** 4
    squares, stated = [], []
    for _ in range(80):
        reference = Reference(noisy(truth, 0.05, random), noisy(truth, 0.05, random), "noise")
        judge = Judge(reference)
        judge.add(truth.astype(np.float32))
        squares.append(judge.squared.sum(axis=1) / reference.power.sum(axis=1))
        stated.append(np.square(reference.resolution))
    measured, stated = 2 * np.std(squares, axis=0), np.mean(stated, axis=0)
    # a standard deviation from 80 trials is known to 8 %
    assert stated == pytest.approx(measured, rel=0.35)
    assert reference.noise[0] == pytest.approx(0.05 * math.sqrt(truth.size / 2 / (truth**2).sum()), rel=0.05)


def test_a_pixel_with_a_firefly_is_left_out_and_counted():
    random = np.random.default_rng(7)
    truth = random.random((400, 64)) ** 4
    a, b = noisy(truth, 0.01, random), noisy(truth, 0.01, random)
    assert Reference(a, b, "noise").left_out == 0
    a[3, 5] += 30
    reference = Reference(a, b, "noise")
    assert reference.left_out == 1 and reference.noise[0] < 0.05
    judge = Judge(reference)
    judge.add(truth.astype(np.float32))
    assert judge.errors().nrmse[0] <= 2 * reference.resolution[0]
    assert judge.errors().energy == pytest.approx(1, abs=1e-2)


def test_bias_is_told_from_noise():
    random = np.random.default_rng(6)
    truth = random.random((400, 64)) ** 4
    power = math.sqrt((truth**2).sum())
    reference = Reference(noisy(truth, 0.02, random), noisy(truth, 0.02, random), "noise")
    biased, fair = Judge(reference), Judge(reference)
    for _ in range(3):
        biased.add(noisy(1.05 * truth, 0.1, random))
        fair.add(noisy(truth, 0.1, random))
    noise = 0.1 * math.sqrt(truth.size) / power
    assert biased.errors().bias[0] == pytest.approx(0.05, rel=0.15)
    assert biased.errors().energy == pytest.approx(1.05, abs=0.01)
    assert biased.errors().nrmse[0] == pytest.approx(math.hypot(noise, 0.05), rel=0.05)
    # pairs of seeds leave the noise's own scatter: sqrt(2 / (n (n - 1) bins)) of the squared noise
    assert fair.errors().bias[0] < 2 * noise * (1 / (3 * truth.size)) ** 0.25
    alone = Judge(reference)
    alone.add(noisy(truth, 0.1, random))
    assert math.isnan(alone.errors().bias[0])
    low, high = alone.errors().pixel
    assert 0 < low < high


def law(scale: float, seconds: list[float]) -> list[Point]:
    """Monte Carlo: error = scale / sqrt(seconds)."""
    return [Point(t, scale / math.sqrt(t)) for t in seconds]


def test_ratio_at_equal_error_of_two_monte_carlo_curves():
    ours, theirs = law(0.01, [0.01, 0.1, 1]), law(0.03, [0.5, 2, 8])
    found = ratio_at(ours, theirs, 0.02)
    assert found.ratio == pytest.approx(9, rel=1e-9) and not found.at_least and found.extrapolated == ""
    beyond = ratio_at(ours, theirs, 0.005)
    assert beyond.ratio == pytest.approx(9, rel=1e-9) and beyond.extrapolated == "both"
    # next to no slope, as after a firefly: carried on it would take longer than any time
    stuck = [Point(0.1, 0.45), Point(1.0, 0.4499999)]
    assert ratio_at(stuck, theirs, 0.02).ratio == 0 and math.isinf(seconds_at(stuck, 1e-3).seconds)
    cheap = ratio_at(ours, theirs, 0.2)  # both are better already
    assert cheap.ratio == pytest.approx(0.5 / 0.01) and not cheap.at_least
    bound = ratio_at(law(0.001, [0.01, 0.1]), theirs, 0.02)
    assert bound.at_least and bound.ratio == pytest.approx(2.25 / 0.01)


def test_a_curve_is_carried_on_to_the_peers_advantage():
    steep = [Point(1, 0.1), Point(4, 0.1 / 4**0.8)]
    assert seconds_at(steep, 0.01, kindly=True).seconds == pytest.approx(10 ** (1 / 0.8))
    assert seconds_at(steep, 0.01).seconds == pytest.approx(4 * (10 / 4**0.8) ** 2)
    slow = [Point(1, 0.1), Point(4, 0.1 / 4**0.4)]
    assert seconds_at(slow, 0.01).seconds == pytest.approx(10 ** (1 / 0.4))
    assert seconds_at(slow, 0.01, kindly=True).seconds == pytest.approx(4 * (10 / 4**0.4) ** 2)


def test_slopes_and_a_curve_that_flattens():
    good = law(0.1, [1, 4, 16])
    assert slopes(good) == pytest.approx([-0.5, -0.5]) and not flattens(good)
    bent = [Point(1, 0.1), Point(4, 0.052), Point(16, 0.05)]
    assert flattens(bent) and slopes(bent)[1] > -0.05
    assert seconds_at(bent, 0.01).seconds == math.inf and seconds_at(bent, 0.06).how == "interpolated"
    assert ratio_at(bent, good, 0.01).ratio == 0 and ratio_at(good, bent, 0.01).ratio == math.inf
    assert math.isnan(ratio_at(bent, bent, 0.01).ratio)


def test_front_leaves_out_what_a_cheaper_point_beats():
    points = [Point(1, 0.1), Point(2, 0.2), Point(3, 0.05), Point(4, 0.0), Point(5, math.nan)]
    assert front(points) == [Point(1, 0.1), Point(3, 0.05)]
    assert seconds_at([], 0.1).seconds == math.inf


def test_references_are_kept_by_hash_and_go_on_where_they_stopped(tmp_path):
    calls = []

    def make(seed: int) -> np.ndarray:
        calls.append(seed)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return np.full((2, 8), float(len(calls)), np.float32)

    key = {"scene": "a", "spp": 4}
    with pytest.raises(KeyboardInterrupt):
        references.reference(tmp_path, "room", key, 2, make, "test")
    first = references.reference(tmp_path, "room", key, 2, make, "test")
    assert len(calls) == 5 and len(set(calls)) == 4  # the interrupted pass alone was made again
    assert (first.a == 1.5).all() and (first.b == 4).all()
    again = references.reference(tmp_path, "room", key, 2, make, "test")
    assert len(calls) == 5 and (again.a == first.a).all()
    references.reference(tmp_path, "room", {**key, "spp": 5}, 2, make, "test")
    assert len(calls) == 9 and len(list(tmp_path.glob("room-*.npz"))) == 4
    for path in tmp_path.glob("room-*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    references.reference(tmp_path, "room", key, 2, make, "test")
    assert len(calls) == 13
    assert references.key_of({"a": 1}) != references.key_of({"a": 2})


def test_scenes_hold_only_what_both_codes_share():
    for name in ("flash", "lamp", "groove", "hall", "hall-lamp", "washroom"):
        scene = settings.bench_scene(name, 8)
        assert not scene.has_ambient and (scene.camera.width, scene.camera.height) == (8, 8)
        assert not any(s.material.lets_light_through or s.material.kind == "conductor" for s in scene.surfaces)
        assert (scene.laser.cone_deg == 360) == name.endswith("lamp")
        assert (scene.camera.fov_deg == settings.FLASH_FOV_DEG) == (not name.endswith("lamp"))


def bench(capfd, tmp_path, *argv: str) -> tuple[int, dict, str]:
    status = main(
        ["bench", "render", "--cache", str(tmp_path / "cache"), "--out", str(tmp_path / "out"), "--json", *argv]
    )
    out, err = capfd.readouterr()
    return status, json.loads(out) if status == 0 else {}, err


@pytest.fixture
def few_qualities(monkeypatch):
    monkeypatch.setattr(settings, "qualities", lambda method, *_: (1, 2) if method.unit == "grid" else (4, 16))
    monkeypatch.setattr(settings, "reference_passes", lambda *_: (1, 64))


def test_bench_of_ours_alone(capfd, tmp_path, few_qualities):
    argv = ("--scenes", "groove", "--sizes", "8", "--peer", "none", "--repeats", "1", "--seeds", "2")
    status, result, err = bench(capfd, tmp_path, *argv)
    assert status == 0, err
    assert {"rows", "ratios", "figure", "csv"} <= result.keys() and result["ratios"] == []
    names = {row["method"] for row in result["rows"]}
    assert {"ours direct", "ours unbiased", "ours filtered"} <= names and all(
        row["seconds"] > 0 for row in result["rows"]
    )
    for key in ("figure", "figure_pulse"):
        assert (tmp_path / "out" / result[key].rsplit("/", 1)[1]).read_bytes()[:4] == b"\x89PNG"
    with Path(result["csv"]).open(newline="") as file:
        assert len(list(csv.DictReader(file))) == len(result["rows"])
    stored = json.loads((tmp_path / "out" / "bench-render.json").read_text(), parse_constant=lambda word: 1 / 0)
    assert stored["rows"] == result["rows"] and stored["machine"]["versions"]["drjit"]
    assert all("no independent check" in check["reference"] for check in result["checks"])


def test_memory_is_measured_in_processes_of_its_own(capfd, tmp_path):
    argv = ("--memory", "--scenes", "groove", "--sizes", "16", "--peer", "none")
    assert main(["bench", "render", *argv, "--json"]) == 0
    peaks = json.loads(capfd.readouterr().out)["peak_mb_above_imports"]
    assert peaks.keys() == {"ours unbiased", "ours filtered"} and all(0 < peak < 2000 for peak in peaks.values())


@pytest.mark.skipif(importlib.util.find_spec("mitransient") is None, reason="mitransient is not installed")
def test_bench_beside_mitransient_estimates_the_same_quantity(capfd, tmp_path, few_qualities):
    argv = ("--scenes", "groove", "--sizes", "8", "--repeats", "1", "--seeds", "2")
    status, result, err = bench(capfd, tmp_path, *argv)
    assert status == 0, err
    assert any("multijitter" in ratio["theirs"] for ratio in result["ratios"])
    # sizes and energies: one bounce of ours less, or their camera leg cut short, would show
    for check in result["checks"]:
        assert check["energy_ratio"] == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--sizes", "0"], "size 0"),
        (["--seeds", "0"], "seeds 0"),
        (["--repeats", "0"], "repeats 0"),
        (["--scenes", "artist", "--data", "nowhere", "--peer", "none"], "nowhere"),
        (["--scenes", "castle"], "castle"),
    ],
)
def test_mistakes_end_in_one_line(capfd, tmp_path, argv, message):
    status, _, err = bench(capfd, tmp_path, *argv)
    assert status == 2 and message in err and "Traceback" not in err


@pytest.mark.slow
def test_a_megapixel_is_timed_of_the_programs_that_are_asked_for(tmp_path, monkeypatch):
    timed = []
    monkeypatch.setattr("scene2spad.bench.emulate.time_megapixel", lambda chosen, *_: timed.append(chosen.name) or {})
    for name in ("fourier-8", "separable-16"):
        assert main(["bench", "emulate", "--only", name, "--repeats", "1", "--out", str(tmp_path)]) == 0
    assert timed == ["separable-16"]


def test_absent_mitransient_ends_in_one_line(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.bench.rendering.peers.available", lambda: False)
    status, _, err = bench(capfd, tmp_path, "--scenes", "groove", "--sizes", "8")
    assert status == 2 and "pip install 'scene2spad[bench]'" in err


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (["sense", "--sizes", "64"], "bench sense: --sizes 64 is for render"),
        (["encode", "--memory"], "bench encode: --memory is for render"),
        (["encode", "--quick"], "bench encode: --quick is for render and sense and network and emulate and hard-cases"),
        (["hard-cases", "--repeats", "5"], "bench hard-cases: --repeats 5 is for render and sense and encode"),
        (["render", "--memory", "--seeds", "5"], "bench render --memory: --seeds 5 is for the bench without --memory"),
        (["render", "--memory", "--out", "here"], "bench render --memory: --out here is for the bench without"),
        (["render", "--memory", "--sizes", "16", "32"], "bench render --memory: --sizes 16 32: expected one"),
        (["network", "--only", "fourier-16"], "bench network: --only fourier-16 is for hard-cases and emulate"),
    ],
)
def test_options_of_other_stages_are_refused(asked, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["bench", *asked]) == 2
    assert words in capfd.readouterr().err
    assert not any(tmp_path.iterdir())
