"""Merged returns: what stays, and how little the pulse's response changes."""

import numpy as np
import pytest
from scipy.special import ndtr

from render.transient import Transient
from render.transient.thinning import PULSE_M, thinned


def lone(seed: int) -> Transient:
    """Pixels of none to three returns metres apart, direct and indirect."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 4, 60)
    returns = int(counts.sum())
    near = np.sort(rng.uniform(0.5, 30, returns))
    pixel = np.repeat(np.arange(60), counts)
    near = near[np.lexsort((near, pixel))]
    columns = near, near + rng.uniform(0, 0.3, returns), rng.uniform(0, 1, returns)
    return of_returns(counts, columns, rng.integers(1, 3, returns))


def of_returns(counts: np.ndarray, columns: tuple[np.ndarray, ...], bounces: np.ndarray) -> Transient:
    shape = (len(counts) // 6, 6)
    return Transient(
        *shape,
        np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        *(column.ravel().astype(np.float32) for column in columns),
        bounces.astype(np.uint8),
        depth_m=np.ones(shape, np.float32),
        normal=np.zeros((*shape, 3), np.float16),
        albedo=np.ones(shape, np.float16),
        ambient=np.zeros(shape, np.float32),
        mixed=np.zeros(shape, bool),
        error=np.zeros(shape, np.float32),
    )


def crowded(seed: int, pixels: int = 60, each: int = 6) -> Transient:
    """Pixels of several short returns within a decimetre or two, the first third of an even slope."""
    rng = np.random.default_rng(seed)
    near = np.sort(2 + rng.uniform(0, 0.2, (pixels, each)), axis=1)
    near[: pixels // 3] = 3 + 0.05 * np.arange(each)
    far = near + 0.02
    far[: pixels // 3] = near[: pixels // 3] + 0.05
    radiance = rng.uniform(0.1, 1, (pixels, each))
    radiance[: pixels // 3] = 1
    return of_returns(np.full(pixels, each), (near, far, radiance), np.ones(pixels * each))


def response(view: Transient) -> np.ndarray:
    """Light over path after a Gaussian pulse, (pixels, positions), exact for uniform returns."""
    x = np.arange(0, 40, PULSE_M / 4)
    near = view.path_near_m.astype(float)
    far = np.maximum(view.path_far_m, near + 1e-4)
    lit = ndtr((x - near[:, None]) / PULSE_M) - ndtr((x - far[:, None]) / PULSE_M)
    total = np.zeros((view.height * view.width, len(x)))
    np.add.at(total, view.return_pixel, lit * (view.radiance / (far - near))[:, None])
    return total


@pytest.mark.parametrize("view", [crowded(0), crowded(1), lone(2)])
def test_energy_and_centroid_stay_and_the_response_hardly_changes(view):
    before = response(view)
    size = np.maximum(np.linalg.norm(before, axis=1), 1e-30)
    for error in (0.01, 0.05):
        after = thinned(view, error)
        assert after.total_radiance() == pytest.approx(view.total_radiance(), rel=1e-5)
        assert after.mean_path_m() == pytest.approx(view.mean_path_m(), abs=1e-5, nan_ok=True)
        # each merged group of a pixel may change that much, few do
        change = np.linalg.norm(response(after) - before, axis=1) / size
        assert change.max() < 2.5 * error and after.returns <= view.returns
        assert (np.diff(after.path_near_m)[np.diff(after.return_pixel) == 0] >= 0).all()


def test_an_even_slope_becomes_one_return_and_indirect_ones_stay():
    view = crowded(0)
    after = thinned(view, 1e-4)
    assert (np.diff(after.offsets)[:20] == 1).all()
    assert after.path_near_m[:20] == pytest.approx(3, abs=1e-4) and after.path_far_m[:20] == pytest.approx(
        3.3, abs=1e-4
    )
    mixed = lone(5)
    kept = thinned(mixed, 0.5)
    for name in ("path_near_m", "path_far_m", "radiance"):
        assert (getattr(kept, name)[kept.bounces > 1] == getattr(mixed, name)[mixed.bounces > 1]).all()
    assert thinned(view, 0.0).returns >= 0.99 * view.returns - 20 * 5
