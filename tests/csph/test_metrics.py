"""Figures of merit against cases worked out by hand, intervals against what statistics say."""

import math

import numpy as np
import pytest

from csph.evaluation.metrics import (
    bias_by_depth,
    grouped_errors,
    image_errors,
    is_low_sbr,
    mean_over_scenes,
    paired_difference,
    ssim,
)
from csph.levels import PHOTON_LEVELS, TRAIN_LEVELS
from scenes import InputError


def test_levels_and_groups():
    assert len(PHOTON_LEVELS) == len(set(PHOTON_LEVELS)) == 16
    assert len(TRAIN_LEVELS) == 9 and max(TRAIN_LEVELS) == (10, 50)
    assert sum(is_low_sbr(*level) for level in PHOTON_LEVELS) == 7  # as published
    assert is_low_sbr(5, 50) and not is_low_sbr(10, 50) and not is_low_sbr(1, 0)


def test_errors_by_hand():
    truth = np.array([[1.0, 2.0, np.nan, 16.0], [3.0, 4.0, 5.0, 6.0]])
    estimate = np.array([[1.003, 1.99, 1.0, 3.0], [3.0, 4.05, np.nan, 6.0005]])
    errors = image_errors(estimate, truth, 15.0)
    assert errors["pixels"] == 5 and (errors["empty"], errors["beyond_range"], errors["missing"]) == (1, 1, 1)
    absolute = np.array([3, 10, 0, 50, 0.5])
    assert errors["mae_mm"] == pytest.approx(absolute.mean())
    assert errors["rmse_mm"] == pytest.approx(np.sqrt((absolute**2).mean()))
    fractions = [errors[f"within_{t}mm"] for t in (1, 5, 20)]
    assert fractions == pytest.approx([2 / 6, 3 / 6, 4 / 6])  # of six pixels, one of them without an estimate
    # 10 mm to within rounding: strictly under it or not, no other pixel is near
    assert errors["within_10mm"] in (3 / 6, 4 / 6)


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf])
def test_infinite_estimates_are_missing_as_nan_is(nothing):
    errors = image_errors(np.array([[1.004, nothing]]), np.array([[1.0, 2.0]]), 15.0)
    assert (errors["pixels"], errors["missing"]) == (1, 1)
    assert errors["mae_mm"] == pytest.approx(4) and errors["rmse_mm"] == pytest.approx(4)
    assert errors["within_5mm"] == errors["within_10mm"] == 0.5
    assert image_errors(np.array([[nothing]]), np.array([[1.0]]), 15.0)["within_20mm"] == 0


def test_groups_by_hand():
    truth = np.full((8, 8), 2.0)
    truth[0] = np.linspace(1, 3, 8)
    mixed = np.zeros((8, 8), bool)
    mixed[4:] = True
    estimate = truth + np.where(mixed, 0.1, 0.002)
    groups = grouped_errors(estimate, truth, mixed, 15.0)
    assert groups["mixed"]["mae_mm"] == pytest.approx(100) and groups["unmixed"]["mae_mm"] == pytest.approx(2)
    assert groups["all"]["mae_mm"] == pytest.approx(51) and groups["all"]["pixels"] == 64
    assert grouped_errors(estimate, truth, np.zeros_like(mixed), 15.0)["mixed"]["pixels"] == 0


def test_ssim_by_hand():
    truth = np.tile(np.linspace(1, 2, 16), (16, 1))
    assert ssim(truth, truth, 15.0) == pytest.approx(1)
    # a constant shift: every window has the same variances and covariance, only the means differ
    shift, span = 0.2, 1.0
    c1 = (0.01 * span) ** 2
    means = np.stack([truth[0, i - 3 : i + 4].mean() for i in range(3, 13)])
    expected = (2 * means * (means + shift) + c1) / (means**2 + (means + shift) ** 2 + c1)
    inner = np.zeros((16, 16), bool)
    inner[3:13, 3:13] = True
    from skimage.metrics import structural_similarity

    _, local = structural_similarity(truth, truth + shift, win_size=7, data_range=span, full=True)
    np.testing.assert_allclose(local[inner].reshape(10, 10)[0], expected, rtol=1e-6)
    known = truth.copy()
    known[0, 0] = np.nan
    assert 0 < ssim(truth + shift, known, 15.0) < 1
    wild = truth.copy()
    wild[8, 8] = 14.0  # a wild pixel cannot widen the data range and so raise the score
    assert ssim(wild, truth, 15.0) < 0.9
    assert math.isnan(ssim(truth, np.ones((16, 16)), 15.0)) and math.isnan(ssim(truth[:3], truth[:3], 15.0))


def test_bias_by_depth_sees_a_pull_towards_mid_range():
    truth = np.linspace(0.5, 14.5, 1401)
    found = bias_by_depth(truth + 0.01 * (7.5 - truth), truth, range(16))
    assert sum(b.pixels for b in found) == truth.size and len(found) == 15
    for b in found:
        middle = truth[(truth >= b.near_m) & (truth < b.far_m)].mean()
        assert b.mean_mm == pytest.approx(10 * (7.5 - middle), abs=1e-6)
    assert bias_by_depth(truth, truth, [20, 30]) == []
    assert bias_by_depth(truth, truth, [0, 15], exclude=truth > 1)[0].pixels == 51


@pytest.mark.parametrize("scenes", [2, 4, 8])
def test_intervals_over_scenes_cover_the_mean_as_often_as_they_say(scenes):
    """Levels whose errors differ by a factor of 20 are fixed; scenes are drawn, and their errors go with the level."""
    rng, trials = np.random.default_rng(5), 1000
    levels = np.array([20.0, 25.0, 60.0, 150.0, 400.0])
    hard = rng.normal(1, 0.1, (2, trials, scenes, 1))
    first, second = (levels * h * (1 + 0.05 * rng.normal(size=(trials, scenes, 5))) for h in (hard[0], hard[1] * 1.05))
    mean, apart = levels.mean(), -0.05 * levels.mean()
    covered = np.zeros(2)
    for one, other in zip(first, second, strict=True):
        a, b = ({str(i): v for i, v in enumerate(values)} for values in (one, other))
        for number, (interval, truth) in enumerate(((mean_over_scenes(a), mean), (paired_difference(a, b), apart))):
            covered[number] += interval.low <= truth <= interval.high
    assert covered / trials == pytest.approx(0.95, abs=4 * (0.95 * 0.05 / trials) ** 0.5)


def test_intervals_hold_scenes_and_neither_levels_nor_pixels():
    alike = {str(i): [20.0, 25.0, 60.0, 150.0, 400.0] for i in range(8)}
    assert mean_over_scenes(alike) == (131, 131, 131)
    many = {str(i): [float(i % 2)] * 100 for i in range(8)}
    few = {str(i): [float(i % 2)] for i in range(8)}
    assert mean_over_scenes(many) == mean_over_scenes(few)  # a hundred copies say no more
    assert mean_over_scenes(few) == pytest.approx((0.5, 0.5 - 2.365 * 0.189, 0.5 + 2.365 * 0.189), abs=1e-3)
    assert math.isnan(mean_over_scenes({"one": [1.0, 2.0]}).low)
    assert mean_over_scenes({"a": [1.0, math.nan], "b": [3.0], "c": [math.nan]}).mean == 2
    with pytest.raises(InputError, match="no finite value"):
        mean_over_scenes({"a": [math.nan]})


def test_intervals_see_what_seeds_share():
    # three trainings, 1 mm apart in every scene: no number of scenes tells which is usual
    seeds = {str(i): [[0.0] * 16, [1.0] * 16, [2.0] * 16] for i in range(50)}
    assert mean_over_scenes({str(i): [0.5] * 16 for i in range(50)}) == (0.5, 0.5, 0.5)
    assert mean_over_scenes(seeds) == pytest.approx((1, 1 - 4.303 / 3**0.5, 1 + 4.303 / 3**0.5), abs=1e-3)
    with pytest.raises(InputError, match="different numbers of seeds"):
        mean_over_scenes({"a": [[1.0], [2.0]], "b": [[1.0]]})


@pytest.mark.parametrize("seeds", [2, 3, 5])
def test_intervals_over_scenes_and_seeds_cover_the_mean(seeds):
    """Scenes, trainings, and what they have together: the interval covers as often as it says, or a little more."""
    rng, trials, covered = np.random.default_rng(seeds), 1000, 0
    for _ in range(trials):
        values = rng.normal(0, 1, (8, 1)) + rng.normal(0, 0.5, (1, seeds)) + rng.normal(0, 0.3, (8, seeds))
        interval = mean_over_scenes({str(i): v[:, None] for i, v in enumerate(values)})
        covered += interval.low <= 0 <= interval.high
    assert 0.95 - 4 * (0.95 * 0.05 / trials) ** 0.5 < covered / trials < 0.995


@pytest.mark.parametrize("seeds", [(3, 1), (3, 2), (2, 5)])
def test_paired_differences_see_what_trainings_differ_by(seeds):
    """Other numbers of seeds in both: no number of scenes tells which training is usual, and intervals cover it."""
    scenes = {str(i): np.full((1, 4), float(i)) for i in range(50)}
    trained = {scene: np.concatenate([values, values + 2]) for scene, values in scenes.items()}
    reach = 12.706  # Student's, of one degree of freedom; the variance of the mean of 0 and 2 is 1
    assert paired_difference(trained, scenes) == pytest.approx((1, 1 - reach, 1 + reach), abs=1e-3)
    assert paired_difference(scenes, trained) == pytest.approx((-1, -1 - reach, -1 + reach), abs=1e-3)
    rng, trials, covered = np.random.default_rng(seeds), 1000, 0
    for _ in range(trials):
        hard = rng.normal(0, 1, (8, 1))
        both = []
        for count in seeds:
            apart = rng.normal(0, 1, (1, count)) if count > 1 else 0
            values = hard + apart + rng.normal(0, 0.3, (8, count))
            both.append({str(i): v[:, None] for i, v in enumerate(values)})
        interval = paired_difference(*both)
        covered += interval.low <= 0 <= interval.high
    # Welch's degrees of freedom are estimates: where few trainings rule, intervals cover a little less often
    assert 0.92 - 4 * (0.92 * 0.08 / trials) ** 0.5 < covered / trials < 0.995


def test_paired_differences_leave_out_values_that_are_not_known():
    second = {"a": np.array([[1.0, 2.0]]), "b": np.array([[3.0, 4.0]])}
    first = {scene: np.repeat(values + 1, 3, axis=0) for scene, values in second.items()}
    first["a"][0, 1] = np.nan  # of one training: the others' stand for it
    assert paired_difference(first, second).mean == pytest.approx(1)
    second["a"][0, 0] = np.nan
    assert paired_difference(first, second).mean == pytest.approx(1)


def test_paired_differences_cancel_what_scenes_share():
    rng = np.random.default_rng(0)
    second = {f"scene-{i}": rng.uniform(1, 100, 4) for i in range(8)}
    first = {scene: values + 1 for scene, values in second.items()}
    assert paired_difference(first, second) == pytest.approx((1, 1, 1))
    nothing = paired_difference({"a": [np.nan, 1.0], "b": [np.nan]}, {"a": [1.0, np.nan], "b": [2.0]})
    assert all(math.isnan(value) for value in nothing)  # no value of both: not known, and no mistake of the user's
    with pytest.raises(InputError, match="no scene in common"):
        paired_difference({"a": [1.0]}, {"b": [1.0]})
    with pytest.raises(InputError, match="scene a has other levels"):
        paired_difference({"a": [1.0, 2.0]}, {"a": [1.0]})
