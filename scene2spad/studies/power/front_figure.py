"""Draw the front of S.2: error against both readings of power, bytes and clocks; lost photons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from scene2spad.plots import figures
from scene2spad.plots.figures import plt
from scene2spad.plots.style import look
from scene2spad.studies.power.front import HEADLINE, LOST_LIMIT, Design, lost
from scenes.json_types import JsonObject
from ultraphase.catalog import SPADS

PUBLISHED = ("processing_uw_published", "readout_uw")
ENERGY = ("processing_uw_energy", "frame_end_uw_energy", "readout_uw")


def draw_front(
    found: Sequence[Design],
    rows: Sequence[JsonObject],
    losses: Sequence[JsonObject],
    printed: Sequence[JsonObject],
    path: Path,
) -> Path:
    """Draw six panels: MAE against both readings of power, bytes a pixel, clocks a photon and photons; lost photons."""
    figure, axes = plt.subplots(2, 3, figsize=(17, 10.5), layout="constrained")
    at = [row for row in rows if (row["photons"], row["frames_per_s"]) == HEADLINE]
    styles = {one.name: look(n) for n, one in enumerate(found)}
    ended = "photons, frame end and readout of a pixel [µW]\n(the paper's: without frame end)"
    readings = (
        (axes[0, 0], ENERGY, ended, "energy x rate (94.6 GOPS/W; inferred)"),
        (axes[0, 1], PUBLISHED, "photons and readout of a pixel [µW]", "as published (Joules x duty, called Watts)"),
    )
    for one, fields, label, title in readings:
        _points(one, at, styles, partial(power_uw, fields), printed)
        one.set(xlabel=label, title=f"power, {title}")
    for one, field, label in (
        (axes[0, 2], "bytes_per_pixel", "bytes a pixel and frame"),
        (axes[1, 0], "clocks_per_photon", "clocks a photon"),
    ):
        _points(one, at, styles, itemgetter(field), printed)
        one.set(xlabel=label, title=label)
    _by_photons(axes[1, 1], rows, styles)
    _losses(axes[1, 2], found, losses, styles)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    photons, frames = HEADLINE
    figure.suptitle(
        f"{photons:g} photons a pixel and frame (50 of them signal), {frames:g} frames a second, one SPAD a core; "
        "grey: the front"
    )
    return figures.save(figure, path)


def power_uw(fields: Sequence[str], row: JsonObject) -> float:
    """Return the sum of a row's powers [uW]. Of the published points, which have no frame end, that counts as 0."""
    return sum(row.get(field, 0.0) for field in fields)


def _points(
    axes: Axes,
    rows: Sequence[JsonObject],
    styles: dict,
    measure: Callable[[JsonObject], float],
    printed: Sequence[JsonObject],
) -> None:
    places = np.array([[measure(row), row["mae_mm"]] for row in rows])
    best = front(places)
    axes.plot(*best.T, color="0.6", zorder=0)
    for row, (x, y) in zip(rows, places, strict=True):
        axes.plot(x, y, markersize=9, label=row["name"], **styles[row["name"]] | {"ls": ""})
    for row in printed:
        label = "paper: its clocks, MAE of 8 pairs at 16 levels" if row is printed[0] else None
        axes.plot(measure(row), row["mae_mm"], "k*", markerfacecolor="none", markersize=11, label=label)
        axes.annotate(row["name"], (measure(row), row["mae_mm"]), (4, 4), textcoords="offset points", fontsize=7)
    axes.set(xscale="log", yscale="log", ylabel="MAE [mm]")
    _plain(axes)


def _plain(axes: Axes) -> None:
    """Plain numbers at 1, 2 and 5 of each decade, and a grid."""

    def label(value: float, _: int) -> str:
        leading = round(value / 10 ** np.floor(np.log10(value)), 6)
        return f"{value:,g}" if leading in (1, 2, 5) else ""

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(label)
        axis.set_minor_formatter(label)
    axes.tick_params(which="minor", labelsize=8)
    axes.grid(alpha=0.3, which="both")


def front(places: np.ndarray) -> np.ndarray:
    """Return points (n, 2) that no other is below in both, by rising first coordinate."""
    order = places[np.lexsort((places[:, 1], places[:, 0]))]
    lowest = np.minimum.accumulate(np.concatenate([[np.inf], order[:-1, 1]]))
    return order[order[:, 1] < lowest]


def _by_photons(axes: Axes, rows: Sequence[dict], styles: dict) -> None:
    for name, style in styles.items():
        mine = [row for row in rows if row["name"] == name and row["frames_per_s"] == HEADLINE[1]]
        axes.plot([row["photons"] for row in mine], [row["mae_mm"] for row in mine], **style)
    axes.set(xscale="log", yscale="log", xlabel="photons a pixel and frame, 1 of 11 signal", ylabel="MAE [mm]")
    axes.set_title("error against photons (16-bit sums wrap)")
    _plain(axes)


def _losses(axes: Axes, found: Sequence[Design], losses: Sequence[dict], styles: dict) -> None:
    photons = np.geomspace(20, 2e5, 120)
    rate = HEADLINE[1]
    for one, row in zip(found, losses, strict=True):
        axes.plot(photons, [lost(one.clocks, n * rate) for n in photons], **styles[one.name] | {"marker": ""})
        for spads, name in ((1, "one_spad"), (SPADS, "16_spads")):
            fraction = row[f"emulated_{name}"]
            if fraction > 0:
                axes.plot(HEADLINE[0] * spads, fraction, markersize=7, **styles[one.name] | {"ls": ""})
    axes.axhline(LOST_LIMIT, color="0.6", linestyle="--")
    for spads, text in ((1, "S.2: one SPAD"), (SPADS, "S.2: 4 x 4 SPADs")):
        axes.axvline(HEADLINE[0] * spads, color="0.8", zorder=0)
        axes.text(HEADLINE[0] * spads, 2e-6, f" {text}", fontsize=8, rotation=90, va="bottom")
    axes.set(xscale="log", yscale="log", ylim=(1e-6, 1), xlabel=f"photons a core and frame, {rate:g} frames a second")
    axes.set(ylabel="share of photons lost", title="a busy core: closed form (lines), emulated (marks)")
    axes.grid(alpha=0.3, which="both")
