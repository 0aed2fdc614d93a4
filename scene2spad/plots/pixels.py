"""Pictures of what single pixels record: of a histogram, and of the demo from returns to detections."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from render.transient import Transient
from scene2spad.plots.figures import DEPTH_COLOURS, ERROR_COLOURS, depth_limits, draw_image, error_words, image_row
from scene2spad.plots.style import COLOURS, plt, save
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.detect import expected_in_pixel
from spad.estimators.bistatic import time_tells_depth, true_arrival_s
from spad.measurements.histogram import Histogram

SHOWN_RANKS = {"dark": 0.1, "median": 0.5, "bright": 0.9}  # among pixels of one known surface, where there are any
WINDOW_NS = (4.0, 12.0)  # before and after the true arrival


def draw_histogram(
    histogram: Histogram, path: Path, *, expected: Callable[[int, int], np.ndarray] | None = None
) -> Path:
    """Draw detections per pixel, expected signal to background, and three pixels around their true depths.

    `expected(row, column)` gives the rates (T,) that a pixel's counts were drawn from: a line over the counts, without
    which a pixel of few photons tells nothing. Of measured counts nobody knows signal from background: the ratio is
    left out, and the pixels are chosen by their detections.
    """
    known = histogram.signal_known
    figure, images, right = image_row(histogram.depth_m.shape, 2 if known else 1, right=4.4)
    pixels = dict(zip(SHOWN_RANKS, right, strict=True))
    counts = histogram.counts.sum(axis=2, dtype=np.int64)
    bright = max(np.quantile(counts, 0.995), 1)
    draw_image(images[0], counts, "detections per pixel", "photons", cmap="gray", vmin=0, vmax=bright)
    if known:
        _signal_to_background(images[1], histogram)
    arrival_ns = 1e9 * true_arrival_s(histogram)
    shown = shown_pixels(histogram)
    for name in SHOWN_RANKS.keys() - shown.keys():
        pixels[name].remove()
    for number, (name, (row, column)) in enumerate(shown.items()):
        for image in images:
            image.plot(column, row, "o", mfc="none", mec=f"C{number + 1}", ms=8, mew=1.5)
        rate = None if expected is None else expected(row, column)
        _pixel_counts(pixels[name], histogram, (row, column), float(arrival_ns[row, column]), rate, f"C{number + 1}")
        photons = f"{counts[row, column]:,} detections"
        if known:
            signal, background = (v[row, column] for v in (histogram.expected_signal, histogram.expected_background))
            photons = f"{_short(signal)} + {_short(background)} photons expected"
        pixels[name].set_title(f"{name} pixel ({row}, {column}): {photons}", fontsize=9)
    pixels[[*shown][-1]].set_xlabel("time since the laser's emission [ns]", fontsize=9)
    if known:
        photons = f"{histogram.budget.signal:g} + {histogram.budget.background:g} photons per pixel on average;"
        ranked = "right: pixels whose expected signal is above that of 10, 50 and 90 % of pixels"
    else:  # one image alone: there is less room
        photons = f"{counts.mean():.4g} detections per pixel on average\n"
        ranked = "right: pixels with more detections than 10, 50 and 90 % of pixels"
    figure.suptitle(f"{histogram.sensor.name} sensor, {photons} {ranked}", fontsize=11)
    return save(figure, path)


def expected_name(histogram: Histogram) -> str:
    """Name the rates that detections are drawn from: where a detector misses photons, more are expected than seen."""
    lossless = histogram.meta.get("model", "poisson") == "poisson"
    return "expected" if lossless else "expected, before pile-up"


def _short(photons: float) -> str:
    return f"{photons:.3g}" if photons < 1000 else f"{photons:,.0f}"


def _signal_to_background(axes: Axes, histogram: Histogram) -> None:
    ratio = histogram.expected_signal / np.maximum(histogram.expected_background, 1e-12)
    decibels = 10 * np.log10(np.maximum(ratio, 1e-12))
    low, high = np.quantile(decibels[ratio > 0], (0.01, 0.99)) if (ratio > 0).any() else (0, 1)
    draw_image(axes, decibels, "expected signal to background", "dB", cmap=ERROR_COLOURS, vmin=low, vmax=high)


def shown_pixels(histogram: Histogram) -> dict[str, tuple[int, int]]:
    """Return row and column of the pixels at SHOWN_RANKS of expected signal, or of detections where no signal is known.

    Ranked are pixels of one surface whose true depth is known and recorded, all pixels where there is none. Of one
    pixel the last of its names is returned.
    """
    ranked_by = histogram.expected_signal if histogram.signal_known else histogram.counts.sum(axis=2, dtype=np.int64)
    recorded = true_arrival_s(histogram) < histogram.sensor.bins * histogram.sensor.bin_width_s
    candidates = np.flatnonzero(recorded & ~histogram.mixed & (ranked_by > 0))
    if not candidates.size:
        candidates = np.arange(histogram.depth_m.size)
    ranked = candidates[np.argsort(ranked_by.ravel()[candidates], kind="stable")]
    places = {int(ranked[round(rank * (ranked.size - 1))]): name for name, rank in SHOWN_RANKS.items()}
    return {name: divmod(place, histogram.depth_m.shape[1]) for place, name in places.items()}


def _pixel_counts(
    axes: Axes,
    histogram: Histogram,
    place: tuple[int, int],
    arrival_ns: float,
    rate: np.ndarray | None,
    colour: str,
) -> None:
    """Draw counts of one pixel as bars, the expected rate as a line over them, its true arrival dotted."""
    edges_ns = np.arange(histogram.sensor.bins + 1) * histogram.sensor.bin_width_s * 1e9
    shown = slice(0, histogram.sensor.bins)
    recorded = arrival_ns < edges_ns[-1]
    if recorded:
        window_ns = (max(arrival_ns - WINDOW_NS[0], 0), min(arrival_ns + WINDOW_NS[1], edges_ns[-1]))
        first, last = np.searchsorted(edges_ns, window_ns)
        shown = slice(max(int(first) - 1, 0), int(last))  # bins outside would take most of the figure's time
        axes.set_xlim(*window_ns)
    bins_ns = edges_ns[shown.start : shown.stop + 1]
    axes.stairs(histogram.counts[*place, shown], bins_ns, fill=True, color="0.7", label="detections")
    if rate is not None:
        axes.stairs(rate[shown], bins_ns, color=colour, lw=1.4, label=expected_name(histogram))
    if recorded:
        axes.axvline(arrival_ns, color="k", lw=0.8, ls=":", label="true depth")
    elif np.isfinite(arrival_ns):
        axes.plot([], [], " ", label=f"true depth: {arrival_ns:.1f} ns, after the record")
    axes.set_ylabel("per bin", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=7, loc="upper right")


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
        draw_image(panels[key], depth, f"{name}\n{error_words(errors[name])}", "m", cmap=DEPTH_COLOURS, **limits)
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
    centre = 0.5 * (transient.path_near_m + transient.path_far_m)[mine] / SPEED_OF_LIGHT_M_PER_S % sensor.period_s * ns
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
    below.stairs(expected, edges_ns, color=COLOURS["blue"], label=expected_name(histogram))
    arrival_ns = ns * float(true_arrival_s(histogram)[row, column])
    recorded = arrival_ns < edges_ns[-1]  # not so where the depth is unknown
    first_ns = arrival_ns if recorded else min(float(centre.min()), edges_ns[-1] - 1)
    for axes in (above, below):
        axes.set_xlim(max(first_ns - 3, 0), min(first_ns + 18, edges_ns[-1]))
    if recorded:
        below.axvline(arrival_ns, color="k", lw=0.8, ls=":")
        below.annotate("true depth", (arrival_ns, 0.92), xycoords=("data", "axes fraction"), xytext=(-4, 0),
                       textcoords="offset points", fontsize=8, ha="right", va="top")  # fmt: skip
    below.set(xlabel="time since the laser's emission [ns]", ylabel="photons per bin")
    below.legend(fontsize=8, loc="upper right")
    if time_tells_depth(histogram):
        metres_per_ns = SPEED_OF_LIGHT_M_PER_S / ns / 2
        depth_axis = below.secondary_xaxis("top", functions=(lambda t: t * metres_per_ns, lambda d: d / metres_per_ns))
        depth_axis.set_xlabel("depth [m]", fontsize=8)
        depth_axis.tick_params(labelsize=8)
