"""Pictures of what the chain makes: transients, depth maps, pulses. Units on every axis."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from render.transient import Transient
from scene2spad.plots.style import plt, save
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

DEPTH_COLOURS = matplotlib.colormaps["viridis_r"].with_extremes(bad="lightgrey")
ERROR_COLOURS = matplotlib.colormaps["magma"].with_extremes(bad="lightgrey")
# What lies further beyond these quantiles than so many times their distance does not decide a colour scale.
COMMON, FAR_BEYOND = (0.005, 0.995), 0.5
BAR = 0.04  # width of a colour bar, of its image's
LETTERS_PER_INCH = 12  # of a title
PANEL_INCHES = 3.6  # the longer side of an image in the pictures of `sense` and `depth`


def plain_log(axes: Axes, which: Literal["x", "y"] = "y") -> None:
    """Make an axis logarithmic, with plain numbers; over less than three decades at 2 and 5 of each decade too."""
    axis = axes.xaxis if which == "x" else axes.yaxis

    def label(value: float, _: int) -> str:
        low, high = sorted(axis.get_view_interval())
        leading = round(value / 10 ** np.floor(np.log10(value)), 6)
        return f"{value:,g}" if leading == 1 or (high < 1000 * low and leading in (2, 5)) else ""

    axes.set(**{f"{which}scale": "log"})
    axis.set_major_formatter(label)
    axis.set_minor_formatter(label)


def draw_image(axes: Axes, image: np.ndarray, title: str, unit: str, **options: object) -> None:
    """Show an image with its colour bar, whose ends are pointed where values lie beyond them."""
    shown = axes.imshow(image, interpolation="nearest", **options)
    axes.set_title(title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])
    beside = axes.inset_axes((1.02, 0.0, BAR, 1.0))  # as high as the image, whatever its shape
    bar = axes.figure.colorbar(shown, cax=beside, extend=_beyond(image, *shown.get_clim()))
    bar.set_label(unit, fontsize=8)
    bar.ax.tick_params(labelsize=8)


def draw_depth_row(
    row: Sequence[Axes], message: str, truth: np.ndarray, maps: Sequence[tuple[str, np.ndarray]]
) -> None:
    """Show the truth and labelled estimates of it beside each other, on the truth's colours, half a standard deviation
    wider than its depths; the ends of the colour bar are pointed where estimates lie beyond them."""
    known = truth[np.isfinite(truth)]
    margin = 0.5 * known.std()
    low, high = float(known.min() - margin), float(known.max() + margin)
    for axes, (label, depth) in zip(row, [("truth", truth), *maps], strict=True):
        shown = axes.imshow(depth, interpolation="nearest", cmap=DEPTH_COLOURS, vmin=low, vmax=high)
        axes.set(xticks=[], yticks=[])
        error = 1e3 * np.nanmean(np.abs(depth - truth))
        mae = f"MAE {error:,.{1 if error < 100 else 0}f} mm"
        axes.set_title(label if depth is truth else f"{label}\n{mae}".strip(), fontsize=7.5)
    row[0].set_ylabel(message, fontsize=8)
    every = np.concatenate([depth.ravel() for _, depth in maps])
    bar = row[-1].figure.colorbar(shown, ax=row[-1], fraction=0.06, pad=0.03, extend=_beyond(every, low, high))
    bar.set_label("depth [m]", fontsize=7)
    bar.ax.tick_params(labelsize=7)


def display(radiance: np.ndarray, white: float = 0.99) -> np.ndarray:
    """Return radiance for looking: relative to the quantile `white` of what is lit, display gamma."""
    top = np.quantile(radiance[radiance > 0], white) if (radiance > 0).any() else 1.0
    return np.clip(radiance / top, 0, 1) ** (1 / 2.2)


def _beyond(image: np.ndarray, low: float, high: float) -> str:
    """Return which ends of a colour scale are exceeded, in matplotlib's words."""
    known = image[np.isfinite(image)]
    below, above = bool((known < low).any()), bool((known > high).any())
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[below, above]


def depth_limits(depth_m: np.ndarray) -> dict[str, float]:
    """Return the ends of a colour scale of depths [m]: all of them, but for a few that lie far from the others."""
    known = depth_m[np.isfinite(depth_m)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    if known.size:
        first, last = (float(value) for value in np.quantile(known, COMMON))
        far = max(FAR_BEYOND * (last - first), 0.1)
        low, high = low if low >= first - far else first, high if high <= last + far else last
    margin = max(0.02 * (high - low), 0.01)
    return {"vmin": max(low - margin, 0.0), "vmax": high + margin}


def draw_transient(transient: Transient, path: Path) -> Path:
    """Draw intensity, indirect share, depth, normals, ambient light, and the image's mean transient."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 7), layout="constrained")
    total = transient.total_radiance()
    later = transient.bounces > 1
    pixel = transient.return_pixel[later]
    indirect = np.bincount(pixel, weights=transient.radiance[later], minlength=total.size).reshape(total.shape)
    fraction = np.divide(indirect, total, out=np.full(total.shape, np.nan), where=total > 0)
    draw_image(axes[0, 0], display(total), "laser light, all paths", "relative, gamma 2.2", cmap="gray", vmin=0, vmax=1)
    draw_image(
        axes[0, 1],
        transient.depth_m,
        "depth at pixel centres",
        "m",
        cmap=DEPTH_COLOURS,
        **depth_limits(transient.depth_m),
    )
    # a scale from 0, also where there is no indirect light at all
    limits = {"vmin": 0, "vmax": max(float(np.nanmax(100 * fraction, initial=0)), 1.0)}
    draw_image(axes[0, 2], 100 * fraction, "indirect share of the laser light", "%", cmap=ERROR_COLOURS, **limits)
    axes[1, 0].imshow(np.abs(transient.normal.astype(float)))
    axes[1, 0].set(title="|normal|, world x y z as red green blue", xticks=[], yticks=[])
    axes[1, 0].title.set_fontsize(10)
    lit = "ambient light" if transient.ambient.any() else "no ambient light"
    draw_image(axes[1, 1], display(transient.ambient), lit, "relative, gamma 2.2", cmap="gray", vmin=0, vmax=1)
    _mean_transient(axes[1, 2], transient)
    error = transient.meta.get("relative_error", {}).get("total", float("nan"))
    figure.suptitle(f"{transient.meta.get('scene', '')}: {transient.returns:,} returns, estimated error {error:.2%}")
    return save(figure, path)


def _mean_transient(axes: Axes, transient: Transient) -> None:
    centre = 0.5 * (transient.path_near_m + transient.path_far_m)
    low, high = (0.98 * centre.min(), 1.02 * np.quantile(centre, 0.999)) if centre.size else (0.0, 1.0)
    edges = np.linspace(low, high, 200)
    pixels = transient.height * transient.width
    for label, kept in (("direct", transient.bounces == 1), ("indirect", transient.bounces > 1)):
        if kept.any():
            energy = np.histogram(centre[kept], edges, weights=transient.radiance[kept])[0]
            axes.stairs(energy / pixels / np.diff(edges), edges, label=label)
    axes.set_yscale("log")
    axes.set(xlabel="optical path length [m]", ylabel="mean radiance per path [1/(m$^3$ sr)]", title="image mean")
    axes.title.set_fontsize(10)
    axes.legend(fontsize=8)


def image_row(shape: tuple[int, ...], images: int, right: float = 0.0) -> tuple[Figure, list[Axes], list[Axes]]:
    """Make a figure of a row of images, and with `right` three panels of that width [inches] one below another.

    Places are computed here: matplotlib's layouts draw everything once more, half of what a picture costs.
    """
    high, wide = (max(PANEL_INCHES * side / max(shape), 0.4 * PANEL_INCHES) for side in shape)
    edge, bar, below, above = 0.25, 0.95, 0.45 if right else 0.2, 0.75
    size = (edge + images * (wide + bar) + (right + 0.7 if right else 0.0), below + high + above)
    figure = plt.figure(figsize=size)

    def place(left: float, bottom: float, width: float, height: float) -> Axes:
        return figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))

    row = [place(edge + number * (wide + bar), below, wide, high) for number in range(images)]
    left, gap = edge + images * (wide + bar) + 0.4, 0.5
    each = (high - 2 * gap) / 3
    column = [place(left, below + (2 - number) * (each + gap), right, each) for number in range(3)] if right else []
    return figure, row, column


def title_above(figure: Figure, words: str) -> None:
    """Write the longest words above all panels, in lines as wide as the figure: each panel of an upright image is
    narrow."""
    figure.suptitle(textwrap.fill(words, int(LETTERS_PER_INCH * figure.get_figwidth())), fontsize=10)


def error_words(errors: dict) -> str:
    """Say the error of a depth map, or why there is none, by its figures (`spad.estimators.depth.depth_errors`)."""
    from spad.estimators.depth import no_error_reason  # with torch, whose import takes a second

    why = no_error_reason(errors)
    return why or f"MAE {errors['mae_mm']:,.1f} mm, {errors['within_10mm']:.0%} within 10 mm"


def draw_depth(histogram: Histogram, depth_m: np.ndarray, method: str, errors: dict, path: Path) -> Path:
    """Draw truth, estimate and absolute error; the estimate alone where no truth is known."""
    if np.isnan(histogram.depth_m).all():
        figure, (only,), _ = image_row(depth_m.shape, 1)
        title_above(figure, method)
        draw_image(only, depth_m, "estimate (no true depth known)", "m", cmap=DEPTH_COLOURS, **depth_limits(depth_m))
        return save(figure, path)
    figure, axes, _ = image_row(depth_m.shape, 3)
    limits = depth_limits(histogram.depth_m)
    draw_image(axes[0], histogram.depth_m, "true depth", "m", cmap=DEPTH_COLOURS, **limits)
    title_above(figure, f"{method}: {error_words(errors)}")
    draw_image(axes[1], depth_m, "estimate", "m", cmap=DEPTH_COLOURS, **limits)
    error_mm = 1000 * np.abs(depth_m - histogram.depth_m)
    draw_image(axes[2], error_mm, "absolute error", "mm", cmap=ERROR_COLOURS, vmin=0, vmax=100)
    return save(figure, path)


def draw_depth_map(depth_m: np.ndarray, confidence: np.ndarray | None, title: str, path: Path) -> Path:
    """Draw a depth map on its own, and the confidence where its file states one."""
    columns = 1 if confidence is None else 2
    figure, axes = plt.subplots(1, columns, figsize=(6 * columns, 4.8), layout="constrained", squeeze=False)
    draw_image(axes[0, 0], depth_m, title, "m", cmap=DEPTH_COLOURS, **depth_limits(depth_m))
    if confidence is not None:
        draw_image(axes[0, 1], confidence, "confidence", "", cmap="gray", vmin=0, vmax=1)
    return save(figure, path)


def draw_comparison(
    histogram: Histogram, depths: dict[str, np.ndarray], errors: dict[str, dict], path: Path, *, columns: int = 4
) -> Path:
    """Draw depth of every method above its absolute error, on one scale; depth alone where no truth is known."""
    known = bool(np.isfinite(histogram.depth_m).any())
    panels = {"true depth": histogram.depth_m, **depths} if known else depths
    across = min(columns, len(panels))
    bands, rows = -(-len(panels) // across), 2 if known else 1
    size = (3.6 * across, bands * rows * 3.4 * histogram.depth_m.shape[0] / histogram.depth_m.shape[1] + 0.6 * bands)
    figure, axes = plt.subplots(rows * bands, across, figsize=size, layout="constrained", squeeze=False)
    for panel in axes.ravel():
        panel.set_axis_off()
    limits = depth_limits(histogram.depth_m if known else np.stack([*depths.values()]))
    for number, (name, depth) in enumerate(panels.items()):
        band, column = divmod(number, across)
        above = axes[rows * band, column]
        above.set_axis_on()
        figures = errors.get(name)
        message = f"{name}\n{error_words(figures)}" if figures and known else name
        draw_image(above, depth, message, "m", cmap=DEPTH_COLOURS, **limits)
        if known and figures:
            below = axes[rows * band + 1, column]
            below.set_axis_on()
            error_mm = 1000 * np.abs(depth - histogram.depth_m)
            draw_image(below, error_mm, "absolute error", "mm", cmap=ERROR_COLOURS, vmin=0, vmax=100)
    return save(figure, path)


def draw_pulse(sensor: Sensor, path: Path) -> Path:
    """Draw the pulse of a sensor with its jitter: what one photon's arrival time becomes, and the bins beneath."""
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    before, after = sensor.response.window_s(4)
    edges_s = np.linspace(-before, after, 401)
    density = sensor.response.bin_masses(edges_s) / np.diff(edges_s)
    axes.stairs(1e-9 * density, 1e9 * edges_s)
    width_ns = 1e9 * sensor.bin_width_s
    for edge in np.arange(np.ceil(-1e9 * before / width_ns), 1e9 * after / width_ns):
        axes.axvline(edge * width_ns, color="0.85", lw=0.6, zorder=0)
    unequal = "" if sensor.tdc is None else ", of which its converter makes unequal ones"
    title = f"{sensor.name}: pulse with jitter; grey: bins of {1000 * width_ns:.4g} ps{unequal}"
    axes.set(xlabel="time after arrival [ns]", ylabel="density [1/ns]", title=title)
    return save(figure, path)


def draw_taps(taps: np.ndarray, path: Path) -> Path:
    """Draw the pulse that lies beside a published frame: shares (n,) of a detection by bins."""
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    axes.stairs(taps, np.arange(len(taps) + 1))
    axes.set(xlabel="bin of the frame's pulse", ylabel="share of a detection", title=f"pulse of {len(taps)} taps")
    return save(figure, path)
