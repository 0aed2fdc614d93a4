"""Contact sheets: many views of a scene set side by side, each as a photograph by flash and as its depth."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scene2spad.datasets.rendering import quiet
from scene2spad.plots.figures import DEPTH_COLOURS, display, plt, save
from scenes.model import Scene
from scenes.progress import Progress

DRAFT = RenderSettings(bounces=1, grid=2)
DEPTH_SHOWN_M = (0.5, 7.0)
VIEW_INCHES = 1.5  # width of a view
LABEL = "depth [m]; above it laser light, its falloff with distance mostly removed"
LETTERS_PER_INCH, LINE_INCHES = 15, 0.14  # of the label's letters


def draw_sheet(scenes: Sequence[Scene], path: Path, *, columns: int = 8, progress: Progress | None = None) -> Path:
    """Render every scene's direct light, coarsely, and draw photograph above depth (0.5 to 7 m) for each."""
    report = progress or (lambda what, fraction: None)
    views = []
    for i, scene in enumerate(scenes):
        report(scene.name, i / len(scenes))
        with quiet():
            views.append(render(scene.without_lights(), DRAFT))
    return draw_views(views, path, columns=columns)


def draw_views(views: Sequence[Transient], path: Path, *, columns: int = 8) -> Path:
    """Draw the sheet of views that are rendered already."""
    columns = min(columns, len(views))
    rows = math.ceil(len(views) / columns)
    shape = views[0].height / views[0].width
    wide = VIEW_INCHES * columns
    label = textwrap.wrap(LABEL, int(LETTERS_PER_INCH * wide))  # one view is narrower than the label
    high = rows * (2 * VIEW_INCHES * shape + 0.25) + 0.3 + LINE_INCHES * (len(label) - 1)
    figure, axes = plt.subplots(2 * rows, columns, figsize=(wide, high), squeeze=False, layout="compressed")
    figure.get_layout_engine().set(w_pad=0.01, h_pad=0.03, wspace=0.01, hspace=0.01)
    for axis in axes.ravel():
        axis.set_axis_off()
    shown = None
    for i, view in enumerate(views):
        above, below = axes[2 * (i // columns), i % columns], axes[2 * (i // columns) + 1, i % columns]
        above.imshow(photograph(view), cmap="gray", vmin=0, vmax=1)
        above.set_title(str(view.meta.get("scene", "")), fontsize=6, pad=2)
        shown = below.imshow(view.depth_m, cmap=DEPTH_COLOURS, vmin=DEPTH_SHOWN_M[0], vmax=DEPTH_SHOWN_M[1])
    bar = figure.colorbar(shown, ax=axes, location="bottom", fraction=0.02, aspect=min(60, 15 * columns), pad=0.005)
    bar.set_label("\n".join(label), fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return save(figure, path)


def photograph(view: Transient) -> np.ndarray:
    """Return (H, W) in [0, 1] for looking: the laser's light without its fall-off with distance."""
    return display(view.total_radiance() * np.nan_to_num(view.depth_m) ** 1.5)
