"""The bench's picture: error against seconds, one panel a scene and size."""

from __future__ import annotations

from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator

from scene2spad.bench.rendering import settings
from scene2spad.bench.rendering.measure import Row
from scene2spad.plots.figures import save
from scene2spad.plots.style import COLOURS

STYLES = {
    settings.OURS_DIRECT: (COLOURS["blue"], "o"),
    settings.UNBIASED: (COLOURS["green"], "s"),
    settings.FILTERED: (COLOURS["vermilion"], "D"),
    settings.MULTIJITTER: ("black", "^"),
    settings.INDEPENDENT: ("0.55", "v"),
}
CODES = {method.name: style for method, style in STYLES.items()}


def draw(rows: list[Row], kind: str, path: Path) -> Path:
    """Draw seconds against error of a `kind` (raw or pulse), log-log.

    Dotted lines and open marks are direct light, solid ones full transport.
    """
    scenes = list(dict.fromkeys(row.scene for row in rows))
    sizes = sorted({row.size for row in rows})
    shape = (len(scenes), len(sizes))
    size = (max(8.5, 4.4 * shape[1]), 1.6 + 3.4 * shape[0])
    figure, grid = plt.subplots(*shape, figsize=size, squeeze=False, layout="constrained")
    lines: dict[str, object] = {}
    for axes_row, scene in zip(grid, scenes, strict=True):
        for axes, pixels in zip(axes_row, sizes, strict=True):
            mine = [row for row in rows if (row.scene, row.size) == (scene, pixels)]
            if mine:
                _panel(axes, mine, kind, lines)
            else:
                axes.set_axis_off()
    labels = {"raw": "nRMSE of raw bins", "pulse": "nRMSE after the pulse"}
    for axes in grid.flat:
        axes.set_xlabel("seconds to a dense (H, W, 1024) array, warm median", fontsize=8)
    for axes in grid[:, 0]:
        axes.set_ylabel(f"{labels[kind]} (1 = 100 %)", fontsize=8)
    figure.suptitle("Speed against error: lower left is better", fontsize=12)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=2 if shape[1] < 3 else 3, fontsize=9)
    return save(figure, path)


def _panel(axes: Axes, rows: list[Row], kind: str, lines: dict[str, object]) -> None:
    for transport in settings.METHODS:
        for method in dict.fromkeys(row.method for row in rows if row.transport == transport):
            group = [r for r in rows if (r.method, r.transport) == (method, transport)]
            group = [r for r in group if getattr(r, f"nrmse_{kind}") > getattr(r, f"resolution_{kind}")]
            if not group:
                continue
            colour, mark = CODES[method]
            full = transport == "full"
            (line,) = axes.plot(
                [r.seconds for r in group],
                [getattr(r, f"nrmse_{kind}") for r in group],
                color=colour,
                marker=mark,
                ms=5,
                lw=1.4,
                ls="-" if full else ":",
                mfc=colour if full else "white",
            )
            message = "full transport" if full else "direct light"
            lines.setdefault(f"{method}, {message}" if method != settings.OURS_DIRECT.name else method, line)
    first = rows[0]
    axes.set(xscale="log", yscale="log")
    axes.set_title(f"{first.scene}, {first.size} x {first.size}", fontsize=10)
    axes.grid(True, which="major", lw=0.4, color="0.85")
    axes.grid(True, which="minor", lw=0.2, color="0.92")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(LogLocator(subs=range(2, 10)))
    axes.tick_params(labelsize=8)
