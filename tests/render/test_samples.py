"""Merging keeps what it says it keeps, for any samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from render.indirect import integrator
from render.indirect.path_cells import make_cells
from render.transient.samples import Samples, merge, packed, to_returns


def random_samples(seed: int, count: int, pixels: int = 5) -> Samples:
    rng = np.random.default_rng(seed)
    return Samples(
        rng.integers(0, pixels, count),
        rng.uniform(0, 3, count),
        rng.uniform(0, 0.05, count),
        rng.exponential(1, count) * (rng.random(count) > 0.1),
        rng.integers(1, 4, count).astype(np.uint8),
    )


def moments(samples: Samples, pixels: int = 5) -> np.ndarray:
    """Energy, first and second moment of each pixel's direct and indirect light."""
    key = samples.pixel * 2 + (samples.bounces > 1)
    second = samples.path_m.astype(float) ** 2 + samples.half_width_m.astype(float) ** 2 / 3
    weights = (np.ones(len(key)), samples.path_m.astype(float), second)
    return np.array([np.bincount(key, weights=samples.radiance * w, minlength=2 * pixels) for w in weights])


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(0, 400), st.sampled_from([1e-4, 0.01, 0.3, 10.0]))
def test_merging_keeps_energy_centroid_and_variance(seed, count, tolerance):
    samples = random_samples(seed, count)
    merged = merge(samples, tolerance)
    # a return of float32 is off by 6e-8 of its own energy, path and width: a pixel's second moment by a few times that
    assert np.allclose(moments(merged), moments(samples), rtol=5e-7, atol=1e-9)
    assert len(merged.pixel) <= len(samples.pixel)
    again = merge(merged, tolerance)
    assert np.allclose(moments(again), moments(merged), rtol=5e-7, atol=1e-9)


def test_merging_depends_on_the_cell_alone():
    samples = Samples(
        np.zeros(4, int),
        np.array([1.001, 1.009, 1.011, 1.005]),
        np.zeros(4),
        np.ones(4),
        np.array([1, 1, 1, 2], np.uint8),
    )
    merged = merge(samples, 0.01)
    assert merged.radiance.tolist() == [2, 1, 1]
    assert merged.path_m[0] == pytest.approx(1.005) and merged.half_width_m[0] == pytest.approx(0.004 * np.sqrt(3))
    assert merged.bounces.tolist() == [1, 1, 2]


def test_returns_are_sorted_and_ragged():
    samples = random_samples(1, 300)
    returns = to_returns(merge(samples, 0.01), 7)
    assert returns.offsets.tolist()[-2:] == [len(returns.radiance)] * 2 and returns.offsets[0] == 0
    for first, last in zip(returns.offsets[:-1], returns.offsets[1:], strict=True):
        assert (np.diff(returns.path_near_m[first:last]) >= 0).all()
    assert (returns.path_far_m >= returns.path_near_m).all() and (returns.path_near_m >= 0).all()
    assert returns.radiance.dtype == np.float32 and returns.bounces.dtype == np.uint8


def test_no_samples_give_no_returns():
    empty = Samples(np.empty(0, int), np.empty(0), np.empty(0), np.empty(0), np.empty(0, np.uint8))
    assert to_returns(merge(empty, 0.01), 3).offsets.tolist() == [0, 0, 0, 0]


def test_far_apart_in_float32_stays_apart():
    # cells are counted from far below zero: in float32 that number would swallow the path
    path = np.array([3.0, 3.05, 3.1, 900.0, 900.05])
    one = packed(np.zeros(5, int), path, np.zeros(5), np.ones(5), np.ones(5, int))
    assert merge(one, 0.01).path_m == pytest.approx(path, rel=1e-6)
    assert len(merge(one, 0.5).path_m) == 2


def test_far_paths_in_narrow_cells_stay_apart():
    """Cells of 0.1 mm are numbered up to 107 km; beyond, where float32 tells 8 mm apart, they are wider."""
    for near, far in ((15000.0, 15800.0), (2e6, 2e6 + 1)):
        both = packed(np.zeros(2, int), np.array([near, far]), np.zeros(2), np.ones(2), np.ones(2, int))
        assert merge(both, 1e-4).path_m.tolist() == [near, far]
    pixels = packed(np.array([2**31 - 1, 2**31 - 2]), np.full(2, 1e5), np.zeros(2), np.ones(2), np.full(2, 2))
    assert sorted(merge(pixels, 1e-4).pixel.tolist()) == [2**31 - 2, 2**31 - 1]


@pytest.mark.parametrize("at_a_time", [1, 100])
def test_two_estimates_merge_alike_in_parts_and_at_once(monkeypatch, at_a_time):
    """To the last bit: each pixel's samples are in one part, in their order."""
    rng = np.random.default_rng(0)
    one, other = (packed(*random_samples(seed, 2000, 50)) for seed in (1, 2))
    fraction, origin_m = rng.random(50), rng.random(50)
    cells = make_cells(0.03, 0.05, -1.0, 20.0)
    whole = integrator.combined_samples(one, other, fraction, cells, origin_m)
    monkeypatch.setattr(integrator, "COMBINED", at_a_time)
    parts = integrator.combined_samples(one, other, fraction, cells, origin_m)
    assert 50 < len(whole.pixel) < 4000
    for first, second in zip(whole, parts, strict=True):
        assert first.dtype == second.dtype and np.array_equal(first, second)
