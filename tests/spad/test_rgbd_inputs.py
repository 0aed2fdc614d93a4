"""Refuse RGB-D images that hold no depth, and warn of depth that is hardly in metres."""

import numpy as np
import pytest

from scenes.errors import InputError
from spad.formats.rgbd import transient_from_rgbd


def test_a_negative_depth_is_refused():
    """Z axes that point backwards are common: such an image had no return, without a word."""
    depth, one = np.full((2, 3), 2.0), np.ones((2, 3))
    depth[1, 2] = -3.5
    with pytest.raises(InputError, match=r"RGB-D images: a depth of -3.5 m, expected 0 or more, or none \(NaN\)"):
        transient_from_rgbd(depth, one, one)
    depth[1, 1:] = np.nan, 0
    assert transient_from_rgbd(depth, one, one).returns == 4


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"depth_m": np.full((2, 3), 2 + 1j)}, r"not an array of numbers \(of complex128\)"),
        ({"depth_m": np.full((2, 3), "2")}, r"not an array of numbers \(of <U1\)"),
        ({"depth_m": np.ones((2, 3), bool)}, r"not an array of numbers \(of bool\)"),
        ({"albedo": np.full((2, 3), None)}, r"not an array of numbers \(of object\)"),
        ({"meta": [("scene", "x")]}, "meta: expected a dict, not list"),
        ({"meta": "x"}, "meta: expected a dict, not str"),
    ],
)
def test_images_without_numbers_are_refused(changed: dict, words: str) -> None:
    given = {name: np.ones((2, 3)) for name in ("depth_m", "albedo", "ambient")} | changed
    with pytest.raises(InputError, match=f"^RGB-D images: {words}"):
        transient_from_rgbd(**given)


@pytest.mark.parametrize("nothing", [0.0, np.inf, np.nan])
def test_images_that_show_nothing_are_warned_of(nothing: float, caplog: pytest.LogCaptureFixture) -> None:
    one = np.ones((2, 3))
    assert transient_from_rgbd(np.full((2, 3), nothing), one, one).returns == 0
    assert "no depth is finite and above 0" in caplog.text


def test_depth_in_millimetres_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    one = np.ones((2, 3))
    transient_from_rgbd(np.full((2, 3), 1000.0), one, one)
    assert not caplog.records
    transient_from_rgbd(np.full((2, 3), 2345, np.uint16), one, one)
    assert "depths of up to 2345 m: are they in millimetres?" in caplog.text


def test_masked_depth_is_none() -> None:
    depth = np.ma.masked_equal(np.array([[2, 3, 9]]), 9)
    assert transient_from_rgbd(depth, np.ones((1, 3)), np.ones((1, 3))).returns == 2
