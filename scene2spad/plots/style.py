"""The one style of all figures: colours that colour-blind readers tell apart (Okabe and Ito), markers, letters."""

from __future__ import annotations

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

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
        panel.annotate(
            LETTERS[number], (0, 1), (-4, 3), xycoords="axes fraction", textcoords="offset points", ha="right",
            va="bottom", fontsize=10, fontweight="bold", annotation_clip=False,
        )  # fmt: skip
