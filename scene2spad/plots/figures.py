"""Pictures of what the chain makes: transients, histograms, depth maps, and the demo's figure. Units on every axis."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from render.transient import Transient
from scene2spad.plots.style import COLOURS, plt, save
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.detect import expected_in_pixel
from spad.formats.histogram import Histogram
from spad.sensor.model import Sensor

DEPTH_COLOURS = matplotlib.colormaps["viridis_r"].with_extremes(bad="lightgrey")
ERROR_COLOURS = matplotlib.colormaps["magma"].with_extremes(bad="lightgrey")
# What lies further beyond these quantiles than so many times their distance does not decide a colour scale.
COMMON, FAR_BEYOND = (0.005, 0.995), 0.5
BAR = 0.04  # width of a colour bar, of its image's
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
    draw_image(
        axes[1, 1], display(transient.ambient), "ambient light", "relative, gamma 2.2", cmap="gray", vmin=0, vmax=1
    )
    _mean_transient(axes[1, 2], transient)
    error = transient.meta.get("relative_error", {}).get("total", float("nan"))
    figure.suptitle(f"{transient.meta.get('scene', '')}: {transient.returns:,} returns, estimated error {error:.2%}")
    return save(figure, path)


def _mean_transient(axes: Axes, transient: Transient) -> None:
    centre = 0.5 * (transient.path_near_m + transient.path_far_m)
    edges = np.linspace(0.98 * centre.min(initial=0), 1.02 * np.quantile(centre, 0.999) if centre.size else 1, 200)
    pixels = transient.height * transient.width
    for label, kept in (("direct", transient.bounces == 1), ("indirect", transient.bounces > 1)):
        if kept.any():
            energy = np.histogram(centre[kept], edges, weights=transient.radiance[kept])[0]
            axes.stairs(energy / pixels / np.diff(edges), edges, label=label)
    axes.set_yscale("log")
    axes.set(xlabel="optical path length [m]", ylabel="mean radiance per path [1/(m$^3$ sr)]", title="image mean")
    axes.title.set_fontsize(10)
    axes.legend(fontsize=8)


SHOWN_RANKS = {"dark": 0.1, "median": 0.5, "bright": 0.9}  # of expected signal, among pixels of one known surface
WINDOW_NS = (4.0, 12.0)  # before and after the true arrival


def draw_histogram(
    histogram: Histogram, path: Path, *, expected: Callable[[int, int], np.ndarray] | None = None
) -> Path:
    """Draw detections per pixel, expected signal to background, and three pixels around their true depths.

    `expected(row, column)` gives the rates (T,) that a pixel's counts were drawn from: a line over the counts, without
    which a pixel of few photons tells nothing.
    """
    figure, images, right = _image_row(histogram.depth_m.shape, 2, right=4.4)
    panels = dict(zip("AB", images, strict=True)) | dict(zip(SHOWN_RANKS, right, strict=True))
    counts = histogram.counts.sum(axis=2, dtype=np.int64)
    ratio = histogram.expected_signal / np.maximum(histogram.expected_background, 1e-12)
    bright = max(np.quantile(counts, 0.995), 1)
    draw_image(panels["A"], counts, "detections per pixel", "photons", cmap="gray", vmin=0, vmax=bright)
    decibels = 10 * np.log10(np.maximum(ratio, 1e-12))
    low, high = np.quantile(decibels[ratio > 0], (0.01, 0.99)) if (ratio > 0).any() else (0, 1)
    draw_image(panels["B"], decibels, "expected signal to background", "dB", cmap=ERROR_COLOURS, vmin=low, vmax=high)
    for number, (name, (row, column)) in enumerate(shown_pixels(histogram).items()):
        for key in "AB":
            panels[key].plot(column, row, "o", mfc="none", mec=f"C{number + 1}", ms=8, mew=1.5)
        rate = None if expected is None else expected(row, column)
        _pixel_counts(panels[name], histogram, row, column, rate, f"C{number + 1}", name)
    panels[[*SHOWN_RANKS][-1]].set_xlabel("time since the laser's emission [ns]", fontsize=9)
    budget = histogram.budget
    figure.suptitle(
        f"{histogram.sensor.name} sensor, {budget.signal:g} + {budget.background:g} photons per pixel on average; "
        "right: pixels whose expected signal is above that of 10, 50 and 90 % of pixels",
        fontsize=11,
    )
    return save(figure, path)


def _image_row(shape: tuple[int, ...], images: int, right: float = 0.0) -> tuple[Figure, list[Axes], list[Axes]]:
    """Make a figure of a row of images, and with `right` three panels of that width [inches] one below another.

    Places are computed here: matplotlib's layouts draw everything once more, half of what a picture costs.
    """
    high, wide = (max(PANEL_INCHES * side / max(shape), 0.4 * PANEL_INCHES) for side in shape)
    edge, bar, below, above = 0.25, 0.95, 0.45 if right else 0.2, 0.75 if right else 0.4
    size = (edge + images * (wide + bar) + (right + 0.7 if right else 0.0), below + high + above)
    figure = plt.figure(figsize=size)

    def place(left: float, bottom: float, width: float, height: float) -> Axes:
        return figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))

    row = [place(edge + number * (wide + bar), below, wide, high) for number in range(images)]
    left, gap = edge + images * (wide + bar) + 0.4, 0.5
    each = (high - 2 * gap) / 3
    column = [place(left, below + (2 - number) * (each + gap), right, each) for number in range(3)] if right else []
    return figure, row, column


def shown_pixels(histogram: Histogram) -> dict[str, tuple[int, int]]:
    """Return row and column of the pixels at SHOWN_RANKS of expected signal, among those of one surface of known depth
    (all where there is none)."""
    candidates = np.flatnonzero(np.isfinite(histogram.depth_m) & ~histogram.mixed & (histogram.expected_signal > 0))
    if not candidates.size:
        candidates = np.arange(histogram.depth_m.size)
    ranked = candidates[np.argsort(histogram.expected_signal.ravel()[candidates], kind="stable")]
    places = {name: int(ranked[int(rank * (ranked.size - 1))]) for name, rank in SHOWN_RANKS.items()}
    return {name: divmod(place, histogram.depth_m.shape[1]) for name, place in places.items()}


def _pixel_counts(
    axes: Axes, histogram: Histogram, row: int, column: int, rate: np.ndarray | None, colour: str, name: str
) -> None:
    """Draw counts of one pixel as bars, the expected rate as a line over them, its true depth dotted."""
    edges_ns = np.arange(histogram.sensor.bins + 1) * histogram.sensor.bin_width_s * 1e9
    depth_m, shown = float(histogram.depth_m[row, column]), slice(0, histogram.sensor.bins)
    true_ns = 2e9 * depth_m / SPEED_OF_LIGHT_M_PER_S % edges_ns[-1]
    if np.isfinite(depth_m):
        window_ns = (max(true_ns - WINDOW_NS[0], 0), min(true_ns + WINDOW_NS[1], edges_ns[-1]))
        first, last = np.searchsorted(edges_ns, window_ns)
        shown = slice(max(int(first) - 1, 0), int(last))  # bins outside would take most of the figure's time
        axes.set_xlim(*window_ns)
    bins_ns = edges_ns[shown.start : shown.stop + 1]
    axes.stairs(histogram.counts[row, column, shown], bins_ns, fill=True, color="0.7", label="detections")
    if rate is not None:
        axes.stairs(rate[shown], bins_ns, color=colour, lw=1.4, label="expected")
    if np.isfinite(depth_m):
        axes.axvline(true_ns, color="k", lw=0.8, ls=":", label="true depth")
    signal, background = (float(v[row, column]) for v in (histogram.expected_signal, histogram.expected_background))
    axes.set_title(f"{name} pixel ({row}, {column}): {signal:.3g} + {background:.3g} photons expected", fontsize=9)
    axes.set_ylabel("per bin", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7, loc="upper right")


def draw_depth(histogram: Histogram, depth_m: np.ndarray, method: str, errors: dict, path: Path) -> Path:
    """Draw truth, estimate and absolute error; the estimate alone where no truth is known."""
    if np.isnan(histogram.depth_m).all():
        figure, (only,), _ = _image_row(depth_m.shape, 1)
        draw_image(only, depth_m, f"{method}, no truth known", "m", cmap=DEPTH_COLOURS, **depth_limits(depth_m))
        return save(figure, path)
    figure, axes, _ = _image_row(depth_m.shape, 3)
    limits = depth_limits(histogram.depth_m)
    draw_image(axes[0], histogram.depth_m, "true depth", "m", cmap=DEPTH_COLOURS, **limits)
    title = f"{method}: MAE {errors['mae_mm']:.1f} mm, {errors['within_10mm']:.0%} within 10 mm"
    draw_image(axes[1], depth_m, title, "m", cmap=DEPTH_COLOURS, **limits)
    error_mm = 1000 * np.abs(depth_m - histogram.depth_m)
    draw_image(axes[2], error_mm, "absolute error (colours end at 100 mm)", "mm", cmap=ERROR_COLOURS, vmin=0, vmax=100)
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
        message = f"{name}\nMAE {figures['mae_mm']:.0f} mm" if figures and known else name
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
    title = f"{sensor.name}: pulse with jitter; grey: bins of {1000 * width_ns:.4g} ps"
    axes.set(xlabel="time after arrival [ns]", ylabel="density [1/ns]", title=title)
    return save(figure, path)


def draw_taps(taps: np.ndarray, path: Path) -> Path:
    """Draw the pulse that lies beside a published frame: shares (n,) of a detection by bins."""
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    axes.stairs(taps, np.arange(len(taps) + 1))
    axes.set(xlabel="bin of the frame's pulse", ylabel="share of a detection", title=f"pulse of {len(taps)} taps")
    return save(figure, path)


def draw_demo(
    transient: Transient,
    histogram: Histogram,
    depths: dict[str, np.ndarray],
    errors: dict[str, dict],
    path: Path,
    chip: dict[str, str],
) -> Path:
    """Draw intensity, true depth, every estimate with its error, one pixel from returns to detections, and what codes
    cost in the pixel (`chip`, by model)."""
    figure = plt.figure(figsize=(14, 11.5), layout="constrained")
    panels = figure.subplot_mosaic("ABC;DEF;GGG;HHH", height_ratios=(1, 1, 0.45, 0.6))
    limits = depth_limits(histogram.depth_m)
    draw_image(panels["A"], histogram.expected_signal, "expected signal", "photons per pixel", cmap="gray", vmin=0,
           vmax=np.quantile(histogram.expected_signal, 0.98))  # fmt: skip
    draw_image(panels["B"], histogram.depth_m, "true depth", "m", cmap=DEPTH_COLOURS, **limits)
    for key, (name, depth) in zip("CDEF", depths.items(), strict=True):
        message = f"{name}\nMAE {errors[name]['mae_mm']:.0f} mm, {errors[name]['within_10mm']:.0%} within 10 mm"
        draw_image(panels[key], depth, message, "m", cmap=DEPTH_COLOURS, **limits)
    row, column = _telling_pixel(transient)
    for key in "ABCDEF":
        panels[key].plot(column, row, "o", mfc="none", mec=COLOURS["vermilion"], ms=9)
    _one_pixel(panels["G"], panels["H"], transient, histogram, row, column)
    costs = "\n".join(f"{model}: {cost}" for model, cost in chip.items())
    figure.supxlabel(f"The codes on emulated in-pixel cores\n{costs}", fontsize=8.5)
    budget = histogram.budget
    figure.suptitle(
        f"{transient.meta['scene']}: {budget.signal:g} signal + {budget.background:g} background photons per pixel, "
        f"{histogram.sensor.bins} bins of {histogram.sensor.bin_width_s * 1e12:.1f} ps, render error "
        f"{transient.meta['relative_error']['total']:.1%}"
    )
    return save(figure, path)


def _telling_pixel(transient: Transient) -> tuple[int, int]:
    """Pick an unmixed pixel of median brightness or more whose indirect share is the 90th percentile of such pixels."""
    total = transient.total_radiance()
    later = transient.bounces > 1
    indirect = np.bincount(transient.return_pixel[later], weights=transient.radiance[later], minlength=total.size)
    fraction = indirect / np.maximum(total.ravel(), 1e-30)
    known = np.isfinite(transient.depth_m) if np.isfinite(transient.depth_m).any() else total > 0
    bright = known & (total >= np.median(total[known])) & ~transient.mixed
    candidates = np.flatnonzero(bright if bright.any() else known)
    ranked = candidates[np.argsort(fraction[candidates], kind="stable")]
    row, column = np.unravel_index(int(ranked[int(0.9 * (len(ranked) - 1))]), total.shape)
    return int(row), int(column)


def _one_pixel(above: Axes, below: Axes, transient: Transient, histogram: Histogram, row: int, column: int) -> None:
    """One pixel from returns (above) to expected and detected photons (below), on one time axis."""
    sensor, ns = histogram.sensor, 1e9
    pixel = row * transient.width + column
    mine = slice(int(transient.offsets[pixel]), int(transient.offsets[pixel + 1]))
    centre = 0.5 * (transient.path_near_m + transient.path_far_m)[mine] / SPEED_OF_LIGHT_M_PER_S * ns
    fraction = transient.radiance[mine] / transient.radiance[mine].sum()
    for name, colour, kept in (
        ("direct", COLOURS["green"], transient.bounces[mine] == 1),
        ("indirect", COLOURS["vermilion"], transient.bounces[mine] > 1),
    ):
        if kept.any():
            above.vlines(centre[kept], 0, fraction[kept], color=colour, lw=1)
            above.plot(
                centre[kept],
                fraction[kept],
                "o",
                color=colour,
                ms=3,
                label=f"{name} returns ({fraction[kept].sum():.0%})",
            )
    above.set_yscale("log")
    above.set_ylabel("share of the\npixel's radiance")
    above.set_title(
        f"the circled pixel (row {row}, column {column}): its transient, and what the sensor makes of it", fontsize=10
    )
    above.legend(fontsize=8, loc="upper right")
    above.tick_params(labelbottom=False)

    edges_ns = np.arange(sensor.bins + 1) * sensor.bin_width_s * ns
    below.stairs(histogram.counts[row, column], edges_ns, fill=True, color="0.75", label="detections")
    expected = expected_in_pixel(transient, sensor, histogram.budget, row, column)
    below.stairs(expected, edges_ns, color=COLOURS["blue"], label="expected counts")
    first_ns = min(float(centre.min()), edges_ns[-1] - 1)
    for axes in (above, below):
        axes.set_xlim(max(first_ns - 3, 0), min(first_ns + 18, edges_ns[-1]))
    if np.isfinite(transient.depth_m[row, column]):
        true_ns = 2 * float(transient.depth_m[row, column]) / SPEED_OF_LIGHT_M_PER_S * ns
        below.axvline(true_ns, color="k", lw=0.8, ls=":")
        below.annotate("true depth", (true_ns, 0.92), xycoords=("data", "axes fraction"), xytext=(-4, 0),
                       textcoords="offset points", fontsize=8, ha="right", va="top")  # fmt: skip
    below.set(xlabel="time since the laser's emission [ns]", ylabel="photons per bin")
    below.legend(fontsize=8, loc="upper right")
    metres_per_ns = SPEED_OF_LIGHT_M_PER_S / ns / 2
    depth_axis = below.secondary_xaxis("top", functions=(lambda t: t * metres_per_ns, lambda d: d / metres_per_ns))
    depth_axis.set_xlabel("depth [m]", fontsize=8)
    depth_axis.tick_params(labelsize=8)
