"""Compare methods of which some have no estimate in some pixels: over the pixels of both."""

import numpy as np
import pytest

from csph.evaluation.methods import Evaluation, EvaluationPlan, evaluate
from csph.training.views import Views
from scene2spad.datasets.planes import wall
from scene2spad.networks.evaluating import by_level, results
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

GROUPS = {"all": ["all"], "some": ["some"]}


def off_by(errors_mm: list[float], histogram: Histogram) -> np.ndarray:
    """Return the truth of 2 x 2 pixels and these errors."""
    return histogram.depth_m + np.array(errors_mm).reshape(2, 2) / 1e3


@pytest.fixture(scope="module")
def found() -> Evaluation:
    """Return two views of walls: of the first, `some` has two of four pixels, and is right by 1 mm in both."""
    methods = {
        "all": lambda h: off_by([3, 3, 103, 103] if h.depth_m.max() < 3 else [2, 2, 2, 2], h),
        "some": lambda h: off_by([1, 1, np.nan, np.inf] if h.depth_m.max() < 3 else [4, 4, 4, 4], h),
    }
    return evaluate(
        methods, Views((wall(2.0, 2), wall(5.0, 2)), ("near", "far")), Sensor(), EvaluationPlan(((50, 50),))
    )


def test_a_difference_is_of_the_pixels_of_both(found):
    """By its own pixels `all` would be 52 mm worse in the first view, where it is 2 mm worse."""
    assert found.difference(["all"], ["some"]).mean == pytest.approx((2 - 2) / 2, abs=1e-3)
    assert found.difference(["some"], ["all"]).mean == pytest.approx(0, abs=1e-3)
    alone = Evaluation([row for row in found.rows if row.scene == "near"], {})
    assert alone.difference(["all"], ["some"]).mean == pytest.approx(52, abs=1e-3)  # no maps, no pixels
    assert found.interval(["all"]).mean == pytest.approx((53 + 2) / 2, abs=1e-3)


def test_shares_and_tables_count_what_is_missing(found):
    (near,) = (row for row in found.rows if (row.method, row.scene, row.group) == ("some", "near", "all"))
    assert (near.pixels, near.missing, near.within_5mm) == (2, 2, 0.5)
    table = results(found, GROUPS, "all", False)["table"]
    assert [line.split()[-1] for line in table] == ["missing", "0.0%", "25.0%"]
    full = results(found, GROUPS, "all", True)["methods"]["some"]["all"]["all"]
    assert (full["pixels"], full["missing"], full["within_10mm"]) == (6, 2, 0.75)
    every, some = by_level(found, GROUPS, True)
    assert (every["missing"], some["missing"], some["pixels"]) == (0, 2, 6)
    every, some = by_level(found, GROUPS, False)
    assert every.endswith("75.0% within 10 mm") and some.endswith("75.0% within 10 mm, 25.0% without an estimate")


def test_tables_of_whole_maps_are_as_they_were(found):
    whole = {"all": ["all"]}
    assert "missing" not in results(found, whole, "all", False)["table"][0]
    assert found.difference(["all"], ["all"]) == (0, 0, 0)
