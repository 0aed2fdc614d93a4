"""Figures 6 to 12 of the supplement: the error of every test image as a scatter, and two depth images of each model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from csph.evaluation.methods import Row
from scene2spad.networks.registry import Trained
from scene2spad.plots.figures import draw_depth_row, plain_log, plt, save

LIMIT_MM = 50.0  # of the axis where errors are as small as the paper's; wider where half of a model's images are not
LOGARITHMIC = 3.0  # where models' medians lie so far apart a linear axis shows the worst alone
GENERATED = "**"  # marks parameters of codes that are computed
WIDTH = 0.36  # of a model's cloud of points


def label_of(trained: Trained) -> str:
    """Return design, block and parameters, as in the paper: Fourier codes by the quarter wave that generates them."""
    design = trained.config.model.codes_design
    kind = design.name.rsplit(" ", 2)[0]
    mark = GENERATED if design.computed is not None else ""
    return f"{kind}\n{design.block_name}, K = {design.codes}\n({design.storage:,} params{mark})"


def draw(
    title: str,
    labels: Sequence[str],
    names: Sequence[str],
    rows: Sequence[Row],
    lines: Sequence[tuple[str, np.ndarray, Sequence[np.ndarray]]],
    path: Path,
) -> Path:
    """Draw above, MAE of every image, coloured by SBR, with median, mean, quartiles and 1.5 times their range; below, a
    line of depth images a photon level, the truth first."""
    count = len(labels)
    figure = plt.figure(figsize=(max(6.5, 2.0 * (count + 1) + 1.2), 4.2 + 1.75 * len(lines)), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(4.2, 1.75 * len(lines)))
    panel = above.subplots()
    clouds = [[r for r in rows if r.method == name and r.group == "all"] for name in names]
    _scatter(panel, clouds)
    panel.set_xticks(range(count), labels, fontsize=8)
    points = panel.collections[-1]
    above.colorbar(points, ax=panel, pad=0.01).set_label("signal / background", fontsize=8)
    axes = below.subplots(len(lines), count + 1, squeeze=False)
    for row, (level, truth, maps) in zip(axes, lines, strict=True):
        draw_depth_row(row, level, truth, [("", depth) for depth in maps])
    marked = f"; {GENERATED} numbers that generate Fourier codes" if any(GENERATED in label for label in labels) else ""
    figure.suptitle(f"{title}\nwhite circle: mean, line: median{marked}", fontsize=10)
    return save(figure, path)


def _scatter(panel: Axes, clouds: Sequence[Sequence[Row]]) -> None:
    """Points, and boxes of all images, those beyond the axis included."""
    errors = [[row.mae_mm for row in cloud] for cloud in clouds]
    box = {"widths": 2 * WIDTH, "showfliers": False, "showmeans": True, "patch_artist": True}
    panel.boxplot(
        errors,
        positions=range(len(clouds)),
        boxprops={"facecolor": "0.93", "edgecolor": "0.6"},
        medianprops={"color": "black", "lw": 1.5},
        meanprops={"marker": "o", "markerfacecolor": "white", "markeredgecolor": "black"},
        **box,
    )
    ratios = np.array([row.signal / max(row.background, 1e-9) for cloud in clouds for row in cloud])
    rng = np.random.default_rng(0)  # places in the cloud alone
    place = np.concatenate([at + rng.uniform(-WIDTH, WIDTH, len(cloud)) for at, cloud in enumerate(clouds)])
    flat = np.concatenate(errors)
    norm = LogNorm(min(ratios.min(), 0.01), max(ratios.max(), 1.0))
    panel.scatter(place, flat, c=ratios, norm=norm, cmap="plasma", s=10, zorder=3, alpha=0.8, linewidths=0)
    bottom, top = 0.0, max(LIMIT_MM, 1.3 * max(float(np.quantile(values, 0.75)) for values in errors))
    medians = [float(np.median(values)) for values in errors]
    if max(medians) > LOGARITHMIC * min(medians) > 0:
        bottom, top = flat.min() / 1.3, 1.3 * flat.max()
        plain_log(panel)
    hidden = int((flat > top).sum())
    panel.set_ylim(bottom, top)
    panel.set_ylabel("mean absolute depth error [mm]")
    above = f"; {hidden} of {flat.size} lie above the axis and are counted" if hidden else ""
    panel.set_title(f"every test image{above}", fontsize=9)
    panel.grid(alpha=0.3, axis="y")
