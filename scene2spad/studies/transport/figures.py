"""Figures of `study transport`: errors step by step, the gaps between codes, planned beside full renders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter, SymmetricalLogLocator

from csph.evaluation.methods import Evaluation, Row
from scene2spad.plots.figures import plain_log, plt, save
from scene2spad.plots.style import COLOURS, look
from scene2spad.studies.transport.plan import KEPT, LASERS, LATER, LEVELS, LIMIT, OPEN, REVERSED, STEPS
from scene2spad.studies.transport.tables import part_saved
from scenes.json_types import JsonObject

LABELS = [label.replace(", ", ",\n") for label in STEPS.values()]
VERDICTS = {KEPT: (COLOURS["blue"], "o"), REVERSED: (COLOURS["vermilion"], "s"), OPEN: ("0.6", "^")}
MAX_PAIRS = 24  # of a panel
LINEAR_MM = 10  # gaps up to here are drawn on a linear scale, larger ones on a logarithmic one


def draw_steps(summary: Sequence[JsonObject], rows: Mapping[tuple[str, str], Sequence[Row]], path: Path) -> Path:
    """Draw MAE of every design at each step, a row a laser and a column a photon level; bars: 95 % over scenes."""
    designs = list(dict.fromkeys(line["design"] for line in summary))
    figure, panels = plt.subplots(
        len(LASERS), len(LEVELS), figsize=(5.2 * len(LEVELS), 4.2 * len(LASERS)), layout="constrained", squeeze=False,
        sharex=True, sharey="col",
    )  # fmt: skip
    for line, laser in zip(panels, LASERS, strict=True):
        for axes, (signal, background) in zip(line, LEVELS, strict=True):
            for number, design in enumerate(designs):
                mine = [_at_level(rows[laser, step], design, signal, background) for step in STEPS]
                _curve(axes, [m for m in mine if m], number, design, len(designs))
            axes.set_title(f"{laser} laser, {signal:g} signal + {background:g} background photons", fontsize=10)
            plain_log(axes)
            axes.grid(alpha=0.3, which="both")
        line[0].set_ylabel("mean absolute depth error [mm]")
    for axes in panels[-1]:
        axes.set_xticks(range(len(STEPS)), LABELS, fontsize=8, rotation=25)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(labels)), fontsize=8)
    scenes = len({row.scene for row in rows[LASERS[0], next(iter(STEPS))]})
    figure.suptitle(f"What each step of the simulation adds: the same {scenes} scenes and the same mean counts")
    return save(figure, path)


def _at_level(rows: Sequence[Row], design: str, signal: float, background: float) -> tuple[float, float, float] | None:
    chosen = [row for row in rows if (row.signal, row.background) == (signal, background)]
    return Evaluation(chosen).interval([design])


def _curve(axes: Axes, intervals: Sequence[tuple[float, float, float]], number: int, label: str, of: int) -> None:
    mean, low, high = np.array(intervals).T
    place = np.arange(len(mean)) + 0.3 * ((number + 0.5) / of - 0.5)  # side by side, so that bars do not hide bars
    reach = np.nan_to_num([mean - low, high - mean]).clip(0)
    axes.errorbar(place, mean, reach, ms=4.5, lw=1, capsize=2, elinewidth=0.8, label=label, **look(number))


def draw_ranking(ranked: Sequence[JsonObject], path: Path) -> Path:
    """Draw gap of each pair of codes with RGB-D rates (hollow) and at each later step (filled), all levels together."""
    mine = [r for r in ranked if r["levels"] == "all"]
    pairs = list(dict.fromkeys((r["first"], r["second"]) for r in mine))[:MAX_PAIRS]
    size = (3.4 * len(LATER) + 1.5, len(LASERS) * (1.4 + 0.27 * len(pairs)))
    figure, panels = plt.subplots(
        len(LASERS), len(LATER), figsize=size, layout="constrained", squeeze=False, sharey=True, sharex=True
    )
    for line, laser in zip(panels, LASERS, strict=True):
        for axes, step in zip(line, LATER, strict=True):
            for r in mine:
                if (r["laser"], r["step"]) == (laser, step) and (r["first"], r["second"]) in pairs:
                    _gap(axes, r, pairs.index((r["first"], r["second"])))
            axes.axvline(0, color="k", lw=0.8)
            axes.set_xscale("symlog", linthresh=LINEAR_MM)
            axes.grid(alpha=0.3, axis="x")
            axes.set_title(f"{laser}: {STEPS[step]}", fontsize=9)
        line[0].set_yticks(range(len(pairs)), [f"{a} - {b}" for a, b in pairs], fontsize=8)
    panels[0, 0].invert_yaxis()
    for axes in panels[-1]:
        axes.xaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=LINEAR_MM))
        axes.xaxis.get_major_locator().set_params(numticks=5)  # a tick a decade overlaps in a paper's column
        axes.set_xlabel("difference of MAE [mm]", fontsize=9)
        axes.tick_params(axis="x", labelsize=8)
    handles = [plt.Line2D([], [], color=c, marker=m, label=f"order {what}") for what, (c, m) in VERDICTS.items()]
    handles.append(plt.Line2D([], [], color="k", marker="o", mfc="white", lw=0.8, label="with RGB-D rates"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    asked = "Does the ranking of codes change? Paired differences, 95 % intervals over scenes"
    figure.suptitle(f"{asked}; below 0 the first is better", fontsize=10)
    return save(figure, path)


def _gap(axes: Axes, r: JsonObject, place: int) -> None:
    colour, mark = VERDICTS[r["verdict"]]
    for name, shift, style in (
        ("rgbd", -0.16, {"color": "k", "marker": "o", "mfc": "white", "lw": 0.8}),
        ("here", 0.16, {"color": colour, "marker": mark, "lw": 1.4}),
    ):
        axes.plot([r[f"{name}_low"], r[f"{name}_high"]], [place + shift] * 2, color=style["color"], lw=style["lw"])
        axes.plot(r[f"{name}_mm"], place + shift, ms=4, **style)


def draw_planned(planned: Sequence[JsonObject], scenes: Sequence[JsonObject], path: Path) -> Path:
    """Draw relative difference of the MAE on planned renders from that on full ones, and the rays that plans saved."""
    names = [(one["scene"], one["laser"]) for one in scenes]
    designs = list(dict.fromkeys(row["design"] for row in planned))
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(12, 1.8 + 0.3 * len(names)), layout="constrained", sharey=True, width_ratios=(1.6, 1)
    )
    left.axvspan(-LIMIT, LIMIT, color=COLOURS["green"], alpha=0.12, label=f"under {LIMIT:.0%}")
    left.axvline(0, color="k", lw=0.6)
    for number, design in enumerate(designs):
        mine = [row for row in planned if row["design"] == design]
        place = np.array([names.index((row["scene"], row["laser"])) for row in mine])
        off = place + 0.5 * ((number + 0.5) / len(designs) - 0.5)
        reach = np.nan_to_num([row["uncertain"] for row in mine])
        fraction = [row["difference"] for row in mine]
        left.errorbar(fraction, off, xerr=reach, ms=4, lw=1, capsize=2, label=design, **look(number) | {"ls": ""})
    left.set_yticks(range(len(names)), [f"{scene}, {laser}" for scene, laser in names], fontsize=8)
    left.invert_yaxis()
    left.set_xlabel("MAE on the planned render over that on the full one, - 1")
    left.set_title("error: bars are 95 % over draws of photons, most of which both renders share", fontsize=9)
    place = np.arange(len(names))
    right.barh(place - 0.18, [one["full_rays"] for one in scenes], 0.34, color="0.7", label="rays of the full render")
    bars = right.barh(
        place + 0.18, [one["planned_rays"] for one in scenes], 0.34, color=COLOURS["blue"], label="of the planned one"
    )
    right.bar_label(bars, [f"{part_saved(one['rays_saved'])} saved" for one in scenes], fontsize=7, padding=2)
    right.set_xscale("log")
    right.set_xlim(0.3 * min(one["planned_rays"] for one in scenes), 4 * max(one["full_rays"] for one in scenes))
    right.set_xlabel("rays of laser light (ambient light apart)")
    right.set_title("work", fontsize=9)
    figure.legend(loc="outside lower center", ncols=6, fontsize=8)
    left.xaxis.set_major_formatter(PercentFormatter(1.0))
    for axes in (left, right):
        axes.grid(alpha=0.3, axis="x")
    figure.suptitle("What the planner left out: a planned render beside one with everything forced")
    return save(figure, path)
