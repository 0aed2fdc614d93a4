"""`study sim-to-real`: its measures by known answers, poses of simulated captures, and the whole study at toy size."""

import json
import math

import numpy as np
import pytest
from scipy.special import stdtrit

from scene2spad.cli import main
from scene2spad.studies.sim_to_real.measures import centroid, compare, randomised_pit
from scene2spad.studies.sim_to_real.pose import Pose, find_pose, model_covariance, nearest_start, render_counts
from scenes.errors import InputError
from spad.sensor.files import load_sensor
from spad.sensor.zone_array import ZoneArray


def histograms(captures: int = 100, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Expected counts (N, 2, 64) of a peak over a background, and Poisson draws of them."""
    bins = np.arange(64)
    shape = 40_000 * np.exp(-(((bins - 25.3) / 1.7) ** 2)) + 50
    expected = np.broadcast_to(np.stack([shape, shape / 2]), (captures, 2, 64)).copy()
    return np.random.default_rng(seed).poisson(expected), expected


def test_a_true_model_is_at_the_noise_floor_and_inside_its_intervals():
    counts, expected = histograms()
    told = compare(counts, expected, 1e-10)
    # each histogram's few full bins make the square a chi-square of about four
    assert ((told.shape / told.floor) ** 2).mean() == pytest.approx(1, abs=5 * math.sqrt(2 / 4 / told.shape.size))
    assert np.abs(told.amplitude).max() < 5 / math.sqrt(expected[0, 1].sum())
    assert np.abs(told.range_mm.mean(axis=0)).max() < 0.5
    judged = 100 * 2 * 60
    assert told.pit.mean() == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / judged))
    assert told.covered.mean() > 0.94 and told.deviance.mean() == pytest.approx(1, abs=0.1)
    assert told.model_error < 0.002


@pytest.mark.parametrize("error", [0.003, 0.01])
def test_errors_of_the_model_are_told_without_the_noise_of_photons(error):
    """Independent ones of every bin, as small as that noise and larger."""
    _, expected = histograms(1000)
    random = np.random.default_rng(3)
    counts = random.poisson(expected * (1 + error * random.standard_normal(expected.shape)))
    assert compare(counts, expected, 1e-10).model_error == pytest.approx(error, rel=0.12)


def test_known_errors_are_told():
    counts, expected = histograms()
    brighter = compare(counts, 1.05 * expected, 1e-10)
    assert brighter.amplitude.mean() == pytest.approx(0.05, abs=1e-3)
    assert brighter.model_error == pytest.approx(0.05 / 1.05, abs=2e-3)
    moved = compare(counts, np.roll(expected, 1, axis=2), 1e-10)
    assert moved.range_mm.mean() == pytest.approx(-14.99, abs=0.1)
    assert compare(counts, expected + 50, 1e-10).pit.mean() < 0.5


def test_randomised_transforms_of_poisson_counts_are_uniform():
    rng = np.random.default_rng(4)
    expected = rng.uniform(0.1, 30, 20_000)
    place = randomised_pit(rng.poisson(expected), expected, seed=2)
    assert np.abs(np.histogram(place, 10, (0, 1))[0] / 2000 - 1).max() < 5 / math.sqrt(2000)
    assert centroid(np.bincount([5, 6, 6, 7], minlength=64)[None]) == pytest.approx([6.5])


@pytest.fixture(scope="module")
def sensor():
    """Fewer photons than the real one, no saturation: nine zones of the preset."""
    file = load_sensor("tmf8820")
    values = {name: getattr(file.zones, name) for name in ("centre_x", "centre_y", "width", "height")}
    return file.sensor, ZoneArray(**values, gain=(1e5,) * 9, background=(5.0,) * 9, delay_s=(1e-9,) * 9)


@pytest.mark.slow
def test_the_pose_of_a_simulated_capture_is_found_within_its_own_errors(sensor):
    """Chi-square of the four numbers at 0.1 %, of three captures together."""
    truth, rng = np.array([0.21, 0.08, -0.05, 0.9]), np.random.default_rng(8)
    expected = render_counts(truth, *sensor, 0.0)
    known_m = np.array([0.15, 0.2, 0.25])
    known = np.array([render_counts(np.array([m, 0, 0, 1.0]), *sensor, 0.0) for m in known_m])
    total = 0.0
    for _ in range(3):
        counts = rng.poisson(expected).astype(float)
        start_m = nearest_start(counts, known_m, known)
        assert start_m == 0.2
        found = find_pose(counts, *sensor, start_m, model_error=0.0)
        error = found.values - truth
        assert abs(error[0]) < 2e-3 and np.abs(error[1:3]).max() < 0.05
        total += float(error @ np.linalg.solve(found.covariance, error))
    assert total < 32.9  # chi-square of 12 at 0.1 %


def test_intervals_hold_poses_whose_model_errs():
    """Errors of a common covariance beside the Fisher one: from 40 known poses, 95 % intervals hold 95 % of others."""
    rng = np.random.default_rng(5)
    fisher = np.diag([1e-10, 1e-6, 1e-6, 1e-5])
    factor = 1e-3 * rng.standard_normal((4, 4))
    errors = rng.standard_normal((4000, 4)) @ factor.T + rng.standard_normal((4000, 4)) * np.sqrt(np.diag(fisher))
    covered = []
    for known in np.split(errors[:2000], 50):
        model = model_covariance(known, np.repeat(fisher[None], len(known), axis=0))
        assert np.linalg.eigvalsh(model.covariance).min() > -1e-18
        _, half = model.interval(Pose(np.zeros(4), fisher))
        covered.append((np.abs(errors[2000:]) < half).mean(axis=0))
    # the mean of a rank's coverage is rank / (N + 1) = 39 / 41, up to what its own errors in sample take
    assert np.abs(np.mean(covered, axis=0) - 39 / 41).max() < 0.015
    few = model_covariance(errors[:10], np.repeat(fisher[None], 10, axis=0))
    assert np.allclose(few.factors, stdtrit(10, 0.975))
    # no model error: what the photons say stays, up to what 2,000 poses leave open
    exact = rng.standard_normal((2000, 4)) * np.sqrt(np.diag(fisher))
    small = model_covariance(exact, np.repeat(fisher[None], 2000, axis=0)).covariance
    assert (np.diag(small) < 0.2 * np.diag(fisher)).all()
    with pytest.raises(InputError, match="no capture of a known pose"):
        model_covariance(np.zeros((0, 4)), np.zeros((0, 4, 4)))


@pytest.mark.slow
def test_the_study_runs_at_toy_size(tmp_path, capfd):
    assert main(["study", "sim-to-real", "--preset", "smoke", "--out", str(tmp_path), "--json"]) == 0
    told = json.loads(capfd.readouterr().out.splitlines()[-1])
    near = [span for span in told["prediction"] if span["from_m"] == 0.2]
    assert near[0]["captures"] > 10 and max(near[0]["shape_median"]) < 0.2
    assert [row["effect"] for row in told["ablation"]] == ["none", "without background"]
    assert told["ablation"][1]["deviance"] > told["ablation"][0]["deviance"]
    assert told["pose"]["distance_mm"]["median_error"] < 5
    assert load_sensor(told["sensor"]).zones.count == 9
    assert all((tmp_path / f"sim-to-real-{name}.png").is_file() for name in ("histograms", "errors", "pose", "pile-up"))
