"""Figures of `study depth-offset`: 1, 2, 3 and 17 of the supplement, the sweep of offsets, the end of the range, cause
and cure, energies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.patches import Patch

from csph import CodingTensor, Design, make_coding
from csph.evaluation.metrics import is_low_sbr
from scene2spad.networks.registry import ModelSpec, Trained
from scene2spad.plots.figures import draw_depth_row, plain_log, plt, save
from scene2spad.plots.style import COLOURS as OKABE_ITO
from scene2spad.plots.style import MARKERS, look
from scene2spad.studies import tensors as tensor_figures
from scene2spad.studies.depth_offset.tables import (
    ENERGY_BAR,
    LEAST,
    RATIO_COMPRESSIONS,
    boundary_bin,
    energy_history,
    energy_ratio,
)
from spad.sensor.model import Sensor

# as in the paper: truncated Fourier blue, learned 1024 orange, 1024x4x4 green, 256x4x4 red
COLOURS = {
    "fourier 1024x1x1": OKABE_ITO["blue"],
    "learned 1024x1x1": OKABE_ITO["orange"],
    "learned 1024x4x4": OKABE_ITO["green"],
    "learned 256x4x4": OKABE_ITO["vermilion"],
    "no compression": "black",
    "peak": OKABE_ITO["grey"],
}
MARKS = dict(zip(COLOURS, MARKERS, strict=False))  # where designs are lines
BY_COMPRESSION = {128: "o", 64: "s", 32: "^", 256: "v"}
MARK_NAMES = {"o": "circles", "s": "squares", "^": "triangles", "v": "triangles on their tips"}
PAPER_FIGURE = {128: "1", 64: "17"}
NO_OFFSETS = ", trained with offsets"


def colour_of(label: str) -> str:
    return COLOURS.get(label.split(NO_OFFSETS)[0], OKABE_ITO["purple"])


def mark_of(label: str) -> str:
    return MARKS.get(label.split(NO_OFFSETS)[0], "X")


def tensors(models: Sequence[Trained], compressions: Sequence[int], out: Path) -> list[Path]:
    """Return figures 1 and 17: trained codes of seed 0 beside the fixed ones, at each compression."""
    drawn = []
    for ratio in compressions:
        fixed = [Design.named(code, (1024, 1, 1), compression=ratio) for code in ("fourier", "gray") if ratio <= 256]
        codings: list[CodingTensor] = [make_coding(design) for design in fixed]
        codings += [
            _on_cpu(t.model.codes_layer.coding())
            for t in models
            if t.wanted.coded and t.wanted.compression == ratio and t.wanted.seed == 0 and t.wanted.design == "learned"
        ]
        name = f"depth-offset-{PAPER_FIGURE.get(ratio, 'tensors')}-{ratio}x.png"
        drawn.append(tensor_figures.draw(codings, out / name))
    return drawn


def every_seed(ratios: Sequence[dict], bars: Sequence[dict], path: Path) -> Path:
    """Return far error over near error of every seed, the geometric means that the bars are about, and the bars; at
    the compressions that these means are over alone."""
    ratios = [row for row in ratios if row["compression"] in RATIO_COMPRESSIONS]
    labels = list(dict.fromkeys(row["design"] for row in ratios))
    figure, panel = plt.subplots(figsize=(max(5.0, 1.6 * len(labels) + 1.5), 4.6), layout="constrained")
    for at, label in enumerate(labels):
        for row in (row for row in ratios if row["design"] == label):
            shift = 0.16 * (np.log2(row["compression"]) - 6.5) + 0.05 * (row["seed"] - 1)
            marker = BY_COMPRESSION[row["compression"]]
            panel.plot(at + shift, row["ratio"], marker, color=colour_of(label), ms=6, alpha=0.8)
        bar = next((b for b in bars if b["design"] == label), None)
        if bar is not None:
            limit = float(bar["bar"].split()[-1])
            panel.hlines(limit, at - 0.4, at + 0.4, color="black", ls=":", lw=1.2)
            panel.annotate("≥" if bar["bar"].startswith(LEAST) else "<", (at + 0.42, limit), fontsize=9, va="center")
            panel.hlines(bar["geometric_mean"], at - 0.3, at + 0.3, color=colour_of(label), lw=2)
    panel.axhline(1, color="0.6", lw=0.8)
    plain_log(panel)
    panel.set_xticks(range(len(labels)), [label.replace(" ", "\n", 1) for label in labels], fontsize=8.5)
    panel.set_ylabel("MAE 7 m farther in time / MAE as it is")
    marks = marks_in_words([row["compression"] for row in ratios])
    message = f"Every seed: {marks}; circles without codes\nlines: geometric means, dotted: bars set beforehand"
    panel.set_title(message, fontsize=9)
    panel.grid(alpha=0.3, axis="y", which="both")
    return save(figure, path)


def marks_in_words(compressions: Iterable[int]) -> str:
    """Say which marks stand for which compressions: "circles 128x, squares 64x"."""
    drawn = {*compressions}
    return ", ".join(f"{MARK_NAMES[mark]} {ratio}x" for ratio, mark in BY_COMPRESSION.items() if ratio in drawn)


def _on_cpu(coding: CodingTensor) -> CodingTensor:
    spatial = None if coding.spatial is None else coding.spatial.cpu()
    return replace(coding, temporal=coding.temporal.cpu(), spatial=spatial)


def against_compression(
    summary: Sequence[dict], levels: Sequence[tuple[float, float]], offset_m: float, path: Path
) -> Path:
    """Return figure 2: MAE and share within 10 mm against compression, a row for the set as it is and one for it far
    away."""
    figure, axes = plt.subplots(2, 4, figsize=(15, 7.5), layout="constrained", sharex=True, sharey="col")
    groups = {"low_sbr": "SBR <= 0.1", "high_sbr": "SBR > 0.1"}
    names = {g: [f"{s:g} + {b:g}" for s, b in levels if is_low_sbr(s, b) == (g == "low_sbr")] for g in groups}
    for row, moved in zip(axes, (0.0, offset_m), strict=True):
        for panel, (figure_of, group) in zip(
            row, [(f, g) for f in ("mae_mm", "within_10mm") for g in groups], strict=True
        ):
            mine = [r for r in summary if r["offset_m"] == moved and r["levels"] == group]
            _lines(panel, mine, figure_of, sorted({r["compression"] for r in summary} - {1}))
            held = ", ".join(names[group]) if len(names[group]) <= 4 else f"{len(names[group])} levels"
            place = f"{moved:g} m farther" if moved else "as it is"
            panel.set_title(f"{place}, {groups[group]}: {held}", fontsize=9)
            if figure_of == "mae_mm":
                plain_log(panel)
        row[0].set_ylabel("mean absolute depth error [mm]")
        row[2].set_ylabel("share of pixels within 10 mm")
    for panel in axes[1]:
        panel.set_xlabel("compression ratio")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9)
    figure.suptitle("Error against compression; bars: 95 % intervals over scenes and seeds")
    return save(figure, path)


def _lines(panel: Axes, rows: Sequence[dict], figure_of: str, compressions: Sequence[int]) -> None:
    designs = list(dict.fromkeys(row["design"] for row in rows))
    for number, design in enumerate(designs):
        mine = sorted((r for r in rows if r["design"] == design), key=lambda r: r["compression"])
        values = np.array([[r[figure_of], r[f"{figure_of}_low"], r[f"{figure_of}_high"]] for r in mine])
        if mine[0]["compression"] == 1:
            panel.axhline(values[0, 0], color=colour_of(design), ls="--", lw=1.2, label=design)
            continue
        # a little beside each other, so that intervals do not hide one another
        place = np.array([r["compression"] for r in mine]) * 1.03 ** (number - (len(designs) - 1) / 2)
        spread = np.nan_to_num(np.abs(values[:, 1:] - values[:, :1]).T)
        options = {"color": colour_of(design), "marker": mark_of(design), "ms": 5, "capsize": 3, "label": design}
        panel.errorbar(place, values[:, 0], spread, **options)
    panel.set_xscale("log", base=2)
    panel.set_xticks(compressions, [f"{ratio}x" for ratio in compressions])
    if compressions:
        panel.set_xlim(compressions[0] / 1.5, compressions[-1] * 1.5)
    panel.grid(alpha=0.3, which="both")


def depth_images(
    lines: Sequence[tuple[str, np.ndarray, Mapping[str, np.ndarray]]], compression: int, path: Path
) -> Path:
    """Return figure 3: a line for each scene, offset and level: truth and estimates on the truth's colours, half a
    standard deviation of the truth wider than its depths."""
    designs = list(lines[0][2])
    size = (2.1 * (len(designs) + 1) + 1.4, 1.75 * len(lines) + 0.6)
    figure, axes = plt.subplots(len(lines), len(designs) + 1, figsize=size, layout="constrained", squeeze=False)
    for row, (message, truth, maps) in zip(axes, lines, strict=True):
        draw_depth_row(row, message, truth, [*maps.items()])
    gap = "\n" if len(designs) < 3 else ", "
    message = f"Depth at {compression}x: as it is{gap}and 7 m farther in time{gap}[signal, background] photons"
    figure.suptitle(message, fontsize=11)
    return save(figure, path)


def sweep(found: dict, path: Path) -> Path:
    """Return MAE against a delay in metres; the band is where the test set's depths leave those of training."""
    figure, panel = plt.subplots(figsize=(8.5, 5.5), layout="constrained")
    for curve in found["curves"]:
        cured = NO_OFFSETS in curve["label"]
        options = {"color": colour_of(curve["label"]), "ls": "--" if cured else "-", "ms": 5}
        options |= {"marker": mark_of(curve["label"]), "mfc": "white" if cured else colour_of(curve["label"])}
        panel.plot(found["offsets_m"], curve["mae_mm"], label=curve["label"], **options)
    reach, (low, middle, high) = found["training_reach_m"], found["test_depths_m"]
    first, last = found["offsets_m"][0] - 0.2, found["offsets_m"][-1] + 0.2
    if reach is not None:  # only what lies on the axis has its line in the legend
        leave = f"leave the training's 99.9 % ({reach:.1f} m)"
        if reach - high < last and reach - low > first:
            label = f"test depths {leave}"
            panel.axvspan(reach - high, reach - low, color="0.9", zorder=0, label=label)
        if first < reach - middle < last:
            label = f"half of the test depths {leave}"
            panel.axvline(reach - middle, color="0.5", lw=1, zorder=0, label=label)
    plain_log(panel)
    panel.set_xlim(first, last)
    levels = _levels([found])
    panel.set(xlabel="offset of the scenes in time [m]", ylabel="mean absolute depth error [mm]")
    scenes = f"{found['scenes']} scene{'s' if found['scenes'] != 1 else ''}"
    panel.set_title(f"Error against offset, 128x, seed 0, {scenes}, photons {levels}", fontsize=10)
    panel.grid(alpha=0.3, which="both")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return save(figure, path)


def range_end(found: dict, path: Path) -> Path:
    """Return up to the end of the range: MAE of truncated Fourier by what is changed (where measured), and bias at a
    wall."""
    count = 2 if found["arms"] else 1
    figure, panels = plt.subplots(1, count, figsize=(7 * count, 5.5), layout="constrained", squeeze=False)
    left, right = panels[0][0], panels[0][-1]
    for number, name in enumerate(dict.fromkeys(row["arm"] for row in found["arms"])):
        mine = [row for row in found["arms"] if row["arm"] == name]
        low, mean, high = ([row[key] for row in mine] for key in ("least_mm", "mae_mm", "largest_mm"))
        at = [row["offset_m"] for row in mine]
        left.plot(at, mean, ms=5, label=name, **look(number))
        left.fill_between(at, low, high, color=f"C{number}", alpha=0.15)
    if found["arms"]:
        plain_log(left)
        left.set(xlabel="offset of the scenes in time [m]", ylabel="mean absolute depth error [mm]")
        left.set_title(f"truncated Fourier, 128x, photons {_levels([found])}: mean and span of seeds", fontsize=10)
    for model in dict.fromkeys(row["model"] for row in found["walls"]):
        mine = [row for row in found["walls"] if row["model"] == model]
        name, _, changed = model.partition(", ")
        dashes = {"": "-", "mean kept": ":", "correlation": "-."}[changed]
        style = {"ls": dashes, "lw": 1.2, "color": _model_colour(name), "marker": _model_mark(name), "ms": 4}
        right.plot([r["depth_m"] for r in mine], [r["bias_mm"] for r in mine], label=model, **style)
    right.set_yscale("symlog", linthresh=10)
    right.set(xlabel="depth of the wall [m]", ylabel="mean signed error [mm], linear within 10 mm")
    right.set_title("a wall, photons {:g} + {:g}, seed 0".format(*found["wall_level"]), fontsize=10)
    for panel in panels[0]:
        panel.grid(alpha=0.3)
        panel.legend(fontsize=8)
    return save(figure, path)


def _model_colour(name: str) -> str:
    """Colour of a model's design by its file's name; those trained with offsets are like no other."""
    if "-t" in name:
        return OKABE_ITO["purple"] if "1x1" in name else OKABE_ITO["brown"]
    designs = {label.replace(" ", "-"): colour for label, colour in COLOURS.items()}
    designs["none"] = COLOURS["no compression"]
    return next(colour for start, colour in designs.items() if name.startswith(start))


def _model_mark(name: str) -> str:
    if "-t" in name:
        return "X" if "1x1" in name else "P"
    return MARKS[next(label for label, colour in COLOURS.items() if colour == _model_colour(name))]


def bars_of(cure: Sequence[dict], swap: Sequence[dict], offset_m: float, path: Path) -> Path:
    """Return left, cures: random time offsets in training, and short blocks. Right, the cause: codes and networks
    swapped."""
    widths = [max(len(rows), 1) for rows in (cure, swap)]
    figure, axes = plt.subplots(1, 2, figsize=(14, 5.5), layout="constrained", sharey=True, width_ratios=widths)
    names = [row["model"].removesuffix("-s0").replace("-128x", "").replace("learned-", "") for row in cure]
    _pairs(axes[0], names, cure, offset_m)
    axes[0].set_title(f"the bias and two cures, photons {_levels(cure)}", fontsize=10)
    short = {"biased": "b", "unbiased": "t8"}
    names = [f"{r['design'].split(' ')[-1]}\n{short[r['codes']]} codes\n{short[r['network']]} network" for r in swap]
    _pairs(axes[1], names, swap, offset_m)
    axes[1].set_title(f"codes before another model's network, photons {_levels(swap)}", fontsize=10)
    axes[0].set_ylabel("mean absolute depth error [mm]")
    low, high = axes[0].get_ylim()
    axes[0].set_ylim(low / 2, 3 * high)
    axes[0].legend(fontsize=8, loc="upper left", ncols=2)
    message = "b: biased, trained as published; t8: trained with random time offsets to 8 m"
    figure.suptitle(f"Cure and cause at 128x, seed 0; {message}", fontsize=11)
    return save(figure, path)


def _levels(rows: Sequence[dict]) -> str:
    return ", ".join(f"{signal:g} + {background:g}" for signal, background in (rows[0]["levels"] if rows else ()))


def _pairs(panel: Axes, names: Sequence[str], rows: Sequence[dict], offset_m: float) -> None:
    at = np.arange(len(rows))
    for shift, key, label in ((-0.2, "near_mm", "as it is"), (0.2, "far_mm", f"{offset_m:g} m farther in time")):
        hatch = "//" if key == "far_mm" else None  # two bars that differ without colour, too
        shown = panel.bar(at + shift, [row[key] for row in rows], 0.4, label=label, hatch=hatch, edgecolor="white")
        panel.bar_label(shown, fmt="{:,.0f}", fontsize=7)
    panel.set_xticks(at, names, fontsize=7.5)
    plain_log(panel)
    panel.grid(alpha=0.3, axis="y")


def energy(models: Mapping[ModelSpec, Trained], ratios: Sequence[dict], path: Path) -> Path:
    """Return above, energy of a long code by depth and training step, one panel a design; below, the ratio against
    step."""
    first = [w for w in models if w.seed == 0 and w.compression == 128]
    shown = first or [*models][:1]
    figure = plt.figure(figsize=(max(8.0, 3.9 * len(shown)), 8), layout="constrained")
    above, below = figure.subfigures(2, 1)
    panels = above.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    histories = {w: energy_history(t) for w, t in models.items()}
    reach = ratios[0]["training_reach_m"]
    top = max(float(histories[w][1].max()) for w in shown)
    for panel, one in zip(panels, shown, strict=True):
        picture = _heat(panel, *histories[one], models[one].config.model.sensor, top)
        panel.axvline(reach, color="white", ls="--", lw=1.2)
        panel.set_title(one.label.replace(", ", ",\n"), fontsize=9)
        panel.set_xlabel("depth of the time bin [m]")
    panels[0].set_ylabel("training step")
    above.colorbar(picture, ax=list(panels), pad=0.01).set_label("mean square of the codes", fontsize=8)
    axes = below.subplots()
    for one, (steps, energies) in histories.items():
        sensor = models[one].config.model.sensor
        boundary = boundary_bin(reach, sensor)
        values = [energy_ratio(line, sensor.bins, boundary) for line in energies]
        style = {"color": colour_of(one.label), "ls": "--" if one.time_offset_m else "-"}
        marker = BY_COMPRESSION[one.compression]
        axes.plot(steps, values, lw=1, marker=marker, ms=3, **style)
    axes.axhline(ENERGY_BAR, color="0.5", lw=1, ls=":")
    plain_log(axes)
    axes.set(xlabel="training step", ylabel=f"energy per bin beyond {reach:.1f} m\nover that within")
    axes.grid(alpha=0.3, which="both")
    labels = {replace(w, seed=0, compression=128): w for w in models}
    handles = [Patch(color=colour_of(w.label), label=w.label, alpha=0.5 if w.time_offset_m else 1) for w in labels]
    axes.legend(
        handles=handles,
        fontsize=8,
        title=f"{marks_in_words(w.compression for w in histories)}; dashed: time offsets; every seed",
        title_fontsize=8,
    )
    figure.suptitle("Energy of learned codes over time bins in training\n(dashed: 99.9 % training depth)", fontsize=11)
    return save(figure, path)


def _heat(panel: Axes, steps: np.ndarray, energies: np.ndarray, sensor: Sensor, top: float) -> object:
    edges_m = np.linspace(0, sensor.bins * sensor.bin_depth_m, energies.shape[1] + 1)
    middles = (steps[1:] + steps[:-1]) / 2
    edges = np.concatenate(([0], middles, [max(steps[-1], 1)])) if len(steps) > 1 else np.array([0, 1])
    norm = LogNorm(vmin=top * 1e-3, vmax=top)
    return panel.pcolormesh(edges_m, edges, np.maximum(energies, top * 1e-3), norm=norm, cmap="magma")
