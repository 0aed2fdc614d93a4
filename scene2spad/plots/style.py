"""The one style of all figures: colours that colour-blind readers tell apart (Okabe and Ito), markers, letters, and
sizes for the columns of a paper."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.collections import Collection, PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from scenes.files import whole_file

# Okabe and Ito, Color Universal Design (2008), in the order that lines take; a grey and a brown after them.
COLOURS = {
    "blue": "#0072b2",
    "orange": "#e69f00",
    "green": "#009e73",
    "vermilion": "#d55e00",
    "sky": "#56b4e9",
    "purple": "#cc79a7",
    "black": "#000000",
    "yellow": "#f0e442",
    "grey": "#999999",
    "brown": "#665544",
}
MARKERS = "os^DvP*X<>hdp"  # of lines, so that they differ without colour, too
LETTERS = "abcdefghijklmnopqrstuvwxyz"
COLUMN_INCHES, PAGE_INCHES = 3.5, 7.16  # one column and both, as most two-column journals have them
WIDEST_OF_COLUMN = 6.5  # drawn wider than this [inches], a figure takes both columns
MIN_POINTS = 5  # of text in a column, the least that journals print
MAX_GROWTH = 1.4
_PDF_TOO: ContextVar[bool] = ContextVar("pdf too", default=False)
_MARK: ContextVar[str] = ContextVar("mark", default="")
MARK_FILLS = 0.9  # of the figure's width and height

plt.rcParams["axes.prop_cycle"] = plt.cycler(color=[*COLOURS.values()])
plt.rcParams["pdf.fonttype"] = 42  # text in a PDF stays text
plt.rcParams["svg.fonttype"] = "none"


def look(number: int) -> dict[str, str]:
    """Return colour and marker of the line of that number; dashes once the colours have come round."""
    colour = [*COLOURS.values()][number % len(COLOURS)]
    return {"color": colour, "marker": MARKERS[number % len(MARKERS)], "ls": "--" if number >= len(COLOURS) else "-"}


def letter_panels(figure: Figure) -> None:
    """Letter the panels of a figure a, b, c left of their upper corners; colour bars and panels of text have none.

    A single panel stays without, and so do sheets of more pictures than letters.
    """
    panels = [one for one in figure.axes if one.axison and one.get_label() != "<colorbar>"]
    if not 1 < len(panels) <= len(LETTERS):
        return
    for number, panel in enumerate(panels):
        # a second axis, on top, may have a number over the corner
        left = -16 if any(hasattr(child, "set_functions") for child in panel.child_axes) else -4
        panel.annotate(
            LETTERS[number], (0, 1), (left, 3), xycoords="axes fraction", textcoords="offset points", ha="right",
            va="bottom", fontsize=10, fontweight="bold", annotation_clip=False,
        )  # fmt: skip


def fit_column(figure: Figure) -> None:
    """Make a figure as wide as a column of a paper, or as both where it was drawn wide: text, lines and marks too.

    Text gets no smaller than MIN_POINTS; the figure grows in height by as much as its text grows beside it.
    """
    width, height = figure.get_size_inches()
    target = COLUMN_INCHES if width <= WIDEST_OF_COLUMN else PAGE_INCHES
    scale = target / width
    figure.canvas.draw()  # ticks are made when they are first drawn
    texts = [text for text in figure.findobj(Text) if text.get_text()]
    smallest = min((scale * text.get_fontsize() for text in texts), default=MIN_POINTS)
    grown = float(np.clip(MIN_POINTS / smallest, 1, MAX_GROWTH))
    figure.set_size_inches(target, scale * height * grown)
    _fit_legends(figure, scale)
    for panel in figure.axes:
        for axis in (panel.xaxis, panel.yaxis):
            axis.labelpad *= scale
            for which in ("major", "minor"):
                labels = axis.get_ticklabels(which=which)
                size = max(scale * labels[0].get_fontsize(), MIN_POINTS) if labels else MIN_POINTS
                axis.set_tick_params(which=which, labelsize=size, length=3 * scale + 1, width=0.8 * scale + 0.2, pad=2)
    for text in texts:
        text.set_fontsize(max(scale * text.get_fontsize(), MIN_POINTS))
    for line in figure.findobj(Line2D):
        line.set_linewidth(scale * line.get_linewidth())
        line.set_markersize(scale * line.get_markersize())
        line.set_markeredgewidth(scale * line.get_markeredgewidth())
    for patch in figure.findobj(Patch):
        patch.set_linewidth(scale * patch.get_linewidth())
    for marks in figure.findobj(Collection):
        marks.set_linewidth(scale * marks.get_linewidth())
        if isinstance(marks, PathCollection):
            marks.set_sizes(scale**2 * marks.get_sizes())


def _fit_legends(figure: Figure, scale: float) -> None:
    """Lay the figure's legends out anew, in as many of their columns as fit beside each other."""
    drawn = {
        label: handle for panel in figure.axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    for legend in list(figure.legends):
        labels = [text.get_text() for text in legend.get_texts()]
        handles = [drawn.get(label, own) for label, own in zip(labels, legend.legend_handles, strict=True)]
        size = max(scale * legend.get_texts()[0].get_fontsize(), MIN_POINTS)
        place = getattr(legend, "_outside_loc", None) or "lower"
        legend.remove()
        for columns in range(getattr(legend, "_ncols", 1), 0, -1):
            fitted = figure.legend(handles, labels, loc=f"outside {place} center", ncols=columns, fontsize=size)
            figure.canvas.draw()
            if columns == 1 or fitted.get_window_extent().width <= figure.bbox.width:
                break
            fitted.remove()


def save(figure: Figure, path: Path) -> Path:
    """Letter a figure's panels and write it as PNG, or as PDF of a column's width where the path ends so, whole or not
    at all. Within `with_pdf` a PNG has its PDF beside it, and within `marked` words lie across it. The same figure has
    the same bytes.
    """
    letter_panels(figure)
    if _MARK.get():
        _write_across(figure, _MARK.get())
    pdf = path.suffix.lower() == ".pdf"
    if not pdf:
        with whole_file(path) as beside:
            figure.savefig(beside, dpi=130, format="png", metadata={"Software": None})
    if pdf or _PDF_TOO.get():
        fit_column(figure)
        with whole_file(path.with_suffix(".pdf")) as beside:
            figure.savefig(beside, format="pdf", dpi=300, metadata={"CreationDate": None})
    plt.close(figure)
    return path


@contextmanager
def with_pdf(wanted: bool = True) -> Iterator[None]:
    """Write every figure that is saved within as PDF, too."""
    before = _PDF_TOO.set(wanted)
    try:
        yield
    finally:
        _PDF_TOO.reset(before)


@contextmanager
def marked(words: str) -> Iterator[None]:
    """Write words across every figure that is saved within; none where they are empty."""
    before = _MARK.set(words)
    try:
        yield
    finally:
        _MARK.reset(before)


def _write_across(figure: Figure, words: str) -> None:
    """Write words from a figure's lower left to its upper right, so that all of it is marked."""
    angle = float(np.degrees(np.arctan2(*reversed(figure.get_size_inches()))))
    text = figure.text(0.5, 0.5, words, ha="center", va="center", rotation=angle, zorder=1000)
    text.set(color=COLOURS["vermilion"], alpha=0.3)
    for _ in range(2):  # letters do not grow quite as their size does
        box = text.get_window_extent()
        room = min(figure.bbox.width / box.width, figure.bbox.height / box.height)
        text.set_fontsize(MARK_FILLS * room * text.get_fontsize())
