"""The one style of all figures: colours that colour-blind readers tell apart (Okabe and Ito), sizes, fonts."""

from __future__ import annotations

from collections.abc import Iterable

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

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
COLUMN_INCHES, PAGE_INCHES = 3.5, 7.16  # of a two-column paper

plt.rcParams["axes.prop_cycle"] = plt.cycler(color=[*COLOURS.values()])
plt.rcParams["pdf.fonttype"] = 42  # text in a PDF stays text
plt.rcParams["svg.fonttype"] = "none"


def letter_panels(panels: Iterable[Axes]) -> None:
    """Letter panels a, b, c at their upper left."""
    for number, panel in enumerate(panels):
        panel.set_title(chr(ord("a") + number), loc="left", fontsize=10, fontweight="bold")
