"""Colour scales serve what is shown, not its one odd pixel."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from scene2spad import transient_from_rgbd
from scene2spad.plots import figures
from scene2spad.plots.figures import DEPTH_COLOURS, depth_limits, draw_depth_row, draw_image, draw_transient


def room(pixels: int = 64) -> np.ndarray:
    return np.linspace(2.0, 6.0, pixels * pixels).reshape(pixels, pixels)


def test_one_pixel_far_away_does_not_ruin_the_scale():
    depth = room()
    plain = depth_limits(depth)
    depth[3, 5], depth[7, 7] = 120.0, np.nan
    limits = depth_limits(depth)
    assert limits["vmin"] == pytest.approx(plain["vmin"], rel=0.02)
    assert limits["vmax"] == pytest.approx(plain["vmax"], rel=0.02)
    depth[3, 5] = np.inf
    assert depth_limits(depth)["vmax"] == pytest.approx(plain["vmax"], rel=1e-2)


def test_without_odd_pixels_nothing_is_cut_off():
    limits = depth_limits(room())
    assert limits["vmin"] < 2 and limits["vmax"] > 6
    two_walls = np.where(np.arange(4096) < 100, 12.0, 3.0)  # 2.4 % of the pixels are no oddity
    assert depth_limits(two_walls)["vmax"] > 12
    assert depth_limits(np.full((2, 2), 3.0)) == pytest.approx({"vmin": 2.99, "vmax": 3.01})
    assert depth_limits(np.full((2, 2), np.nan)) == pytest.approx({"vmin": 0.0, "vmax": 1.02})


@pytest.mark.parametrize(("odd", "extend"), [(3.0, "neither"), (120.0, "max"), (0.05, "min")])
def test_the_colour_bar_points_to_what_lies_beyond_it(odd, extend):
    depth = room() + 10 * (odd < 1)
    depth[3, 5] = odd
    figure, axes = plt.subplots()
    try:
        draw_image(axes, depth, "depth", "m", cmap=DEPTH_COLOURS, **depth_limits(depth))
        assert axes.images[0].colorbar.extend == extend
    finally:
        plt.close(figure)


@pytest.mark.parametrize(("odd", "extend"), [(3.0, "neither"), (120.0, "max")])
def test_the_colour_bar_of_a_row_points_to_estimates_beyond_it(odd, extend):
    truth, estimate = room(), room()
    estimate[3, 5] = odd
    figure, row = plt.subplots(1, 3)
    try:
        draw_depth_row(row, "10 + 10", truth, [("one", truth + 0.2), ("other", estimate)])
        assert row[2].images[0].colorbar.extend == extend
        assert row[0].get_title() == "truth" and row[1].get_title() == "one\nMAE 200 mm"
    finally:
        plt.close(figure)


@pytest.mark.parametrize(("ambient", "title"), [(0.0, "no ambient light"), (0.02, "ambient light")])
def test_a_black_panel_says_that_there_is_no_ambient_light(ambient, title, monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or path)
    image = np.ones((4, 4))
    draw_transient(transient_from_rgbd(2.0 * image, 0.5 * image, ambient * image), tmp_path / "a.png")
    assert title in [axes.get_title() for axes in drawn[0].get_axes()]
    plt.close(drawn[0])
