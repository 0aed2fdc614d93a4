"""What notebooks show, and the one style of figures."""

import base64
import io
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import scene2spad as s2s
from scene2spad.plots.figures import save
from scene2spad.plots.style import COLOURS, MIN_POINTS, fit_column, look, marked, plt, with_pdf
from scenes.notebook import html_card


def test_objects_of_the_chain_show_themselves():
    scene = s2s.load_scene("plane", width=8, height=6)
    image = np.ones((6, 8))
    transient = s2s.transient_from_rgbd(2 * image, image, image)
    histogram = s2s.sense(transient, signal=5, background=5)
    assert "6 rows x 8 columns" in scene._repr_html_()
    for shown in (transient._repr_html_(), histogram._repr_html_()):
        png = base64.b64decode(re.search(r"base64,([^\"]+)", shown)[1])
        with Image.open(io.BytesIO(png)) as picture:
            assert picture.size == (8 * 32, 6 * 32)


def test_a_card_escapes_what_files_say():
    shown = html_card("<b>", {"a": "<script>"}, np.zeros((2, 2)))
    assert "<script>" not in shown and "&lt;script&gt;" in shown


def test_figures_take_colours_that_differ_in_lightness_too():
    """Okabe and Ito's, in the order of the style; no two neighbours of the first four are alike in grey."""
    cycle = plt.rcParams["axes.prop_cycle"].by_key()["color"]
    assert cycle == [*COLOURS.values()]
    rgb = [[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in cycle[:4]]
    grey = [float(np.dot(one, (0.2126, 0.7152, 0.0722))) for one in rgb]
    assert min(abs(a - b) for a, b in pairwise(grey)) > 0.02


def test_lines_differ_without_colour_too():
    looks = [look(number) for number in range(len(COLOURS) + 3)]
    assert len({(one["marker"], one["ls"]) for one in looks}) == len(looks)
    assert len({one["marker"] for one in looks[: len(COLOURS)]}) == len(COLOURS)


def test_several_panels_are_lettered_and_colour_bars_are_not(tmp_path):
    for count, letters in ((1, []), (3, ["a", "b", "c"])):
        figure, panels = plt.subplots(1, count, squeeze=False)
        figure.colorbar(panels[0, 0].imshow(np.zeros((2, 2))), ax=panels[0, 0])
        save(figure, tmp_path / "figure.png")
        assert [text.get_text() for panel in figure.axes for text in panel.texts] == letters


def test_a_mark_lies_across_what_is_saved_within(tmp_path):
    """And within the figure, whatever its shape."""
    for size in ((3, 5), (12, 4)):
        figure = plt.figure(figsize=size)
        with marked("smoke run"):
            save(figure, tmp_path / "figure.png")
        assert [text.get_text() for text in figure.texts] == ["smoke run"]
        drawn = plt.imread(tmp_path / "figure.png")[..., :3].min(axis=2) < 1
        rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
        edges = (rows[0], columns[0], drawn.shape[0] - rows[-1], drawn.shape[1] - columns[-1])
        assert min(edges) > 1 and max(np.ptp(rows) / drawn.shape[0], np.ptp(columns) / drawn.shape[1]) > 0.7
    figure = plt.figure()
    save(figure, tmp_path / "figure.png")
    assert not figure.texts


@pytest.mark.parametrize(("drawn", "inches"), [((6, 4), 3.5), ((14, 7), 7.16)])
def test_a_pdf_is_as_wide_as_a_column_or_a_page(drawn, inches, tmp_path):
    """The page's size is in the file, in points; the PNG beside it keeps the size for screens."""
    figure, panels = plt.subplots(1, 2, figsize=drawn, layout="constrained")
    panels[0].plot([1, 2], label="first")
    with with_pdf():
        save(figure, tmp_path / "figure.png")
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "figure.pdf").read_bytes())
    assert float(box[1]) == pytest.approx(72 * inches, abs=0.1)
    with Image.open(tmp_path / "figure.png") as picture:
        assert picture.size == (drawn[0] * 130, drawn[1] * 130)
    save(plt.figure(figsize=drawn), tmp_path / "alone.png")
    assert not (tmp_path / "alone.pdf").exists()


def test_in_a_column_text_can_be_read_and_legends_fit():
    """Ten long names do not fit beside each other: they stand in fewer columns, with the markers of their lines."""
    figure, panel = plt.subplots(figsize=(16, 8), layout="constrained")
    for number in range(10):
        panel.errorbar([0, 1], [number, 0], 0.1, label=f"a method with a long name {number}", **look(number))
    panel.set_title("a title", fontsize=6)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=10, fontsize=9)
    fit_column(figure)
    figure.canvas.draw()
    (legend,) = figure.legends
    assert legend.get_window_extent().width <= figure.bbox.width
    markers = [line.get_marker() for line in legend.findobj(plt.Line2D) if line.get_marker() not in ("", "None", None)]
    assert {*markers} >= {look(number)["marker"] for number in range(10)}
    shown = [text for text in figure.findobj(plt.Text) if text.get_text() and text.get_visible()]
    assert min(text.get_fontsize() for text in shown) >= MIN_POINTS - 1e-9
    assert panel.lines[0].get_linewidth() < 1
    plt.close(figure)


def test_no_figure_names_colours_of_another_palette():
    """Colours come from the style, or are black, white and greys."""
    other = re.compile(r"tab:|tab10|(?:color|mec|mfc|c)=\"(?:red|blue|green|orange|purple|brown|pink|cyan|yellow)\"")
    root = Path(__file__).parents[2] / "scene2spad"
    assert [str(path) for path in root.rglob("*.py") if other.search(path.read_text(encoding="utf-8"))] == []
