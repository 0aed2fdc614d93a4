"""Error figures of depth maps take no value that is none: masked, negative, or a truth value."""

import numpy as np
import pytest

from scenes.errors import InputError
from spad.estimators.depth import depth_errors


def test_masked_pixels_have_no_depth() -> None:
    truth, estimate = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.01, 9.0, 3.01, 4.01])
    masked = np.ma.masked_equal(estimate, 9.0)
    figures = depth_errors(masked, truth, range_m=15.0)
    assert figures["missing"] == 1 and figures["pixels"] == 3 and figures["mae_mm"] == pytest.approx(10.0)
    whole = np.ma.array(np.array([1, 9]), mask=[False, True])
    figures = depth_errors(np.ones(2), whole, range_m=15.0)
    assert figures["empty"] == 1 and figures["pixels"] == 1 and figures["mae_mm"] == 0


@pytest.mark.parametrize(
    ("depth", "meant"),
    [
        (np.array([True, False]), "depth map: values are bool, expected real numbers"),
        (np.array([1.0, -2.5]), "depth map: a depth of -2.5 m, expected 0 or more, or none (NaN)"),
    ],
)
def test_what_is_no_depth_is_refused_in_one_line(depth, meant) -> None:
    for estimate, truth in ((depth, np.ones(2)), (np.ones(2), depth)):
        with pytest.raises(InputError) as refused:
            depth_errors(estimate, truth, range_m=15.0)
        assert str(refused.value) == meant


def test_the_median_of_the_absolute_error_is_over_the_pixels_of_the_mean() -> None:
    """A pixel beyond the range is in neither; of signed errors of 1, -3 and 5 mm the absolute median is 3."""
    truth = np.array([[1.0, 2.0], [3.0, 99.0]])
    found = depth_errors(truth + np.array([[0.001, -0.003], [0.005, 50.0]]), truth, range_m=15.0)
    assert found["pixels"] == 3 and found["mae_mm"] == pytest.approx(3)
    assert found["median_abs_mm"] == pytest.approx(3) and found["median_mm"] == pytest.approx(1)
