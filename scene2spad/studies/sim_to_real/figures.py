"""Figures of `study sim-to-real`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scene2spad.plots.figures import plt, save
from scene2spad.plots.style import look
from scene2spad.studies.sim_to_real.measures import Comparison


def draw_histograms(
    distances_m: np.ndarray, counts: np.ndarray, expected: np.ndarray, order: np.ndarray, columns: int, path: Path
) -> Path:
    """Draw measured counts (N, Z, T) as marks and predicted ones as lines: a panel a zone, as the chip sees them."""
    rows = -(-len(order) // columns)
    figure, panels = plt.subplots(
        rows, columns, figsize=(4 * columns, 2.6 * rows), sharex=True, layout="constrained", squeeze=False
    )
    for panel, zone in zip(panels.ravel(), order, strict=False):
        for number, distance in enumerate(distances_m):
            style, peak = look(number), int(expected[number, zone].argmax())
            shown = slice(max(0, peak - 6), peak + 30)
            bins = np.arange(counts.shape[2])[shown] + 0.5
            panel.semilogy(bins, np.maximum(expected[number, zone, shown], 1), color=style["color"], lw=1)
            measured = np.maximum(counts[number, zone, shown], 1)
            panel.semilogy(bins, measured, **style | {"ls": ""}, ms=3, label=f"{1e3 * distance:g} mm")
        panel.set_title(f"zone {zone}", fontsize=9)
        panel.grid(alpha=0.3)
    for panel in panels[-1]:
        panel.set_xlabel("time bin")
    for panel in panels[:, 0]:
        panel.set_ylabel("counts per bin")
    panels[0, 0].legend(fontsize=8)
    figure.suptitle("Captures held out of the calibration: measured (marks) and predicted (lines)", fontsize=11)
    return save(figure, path)


def draw_errors(distance_m: np.ndarray, held: np.ndarray, of: Comparison, path: Path) -> Path:
    """Draw shape, amplitude and range errors against distance, a line a zone; crosses: captures calibrated on."""
    figure, panels = plt.subplots(3, 1, figsize=(8, 8), sharex=True, layout="constrained")
    shown = (
        (of.shape, "nRMSE of the shape"),
        (100 * of.amplitude, "amplitude error [%]"),
        (of.range_mm, "range, measured - predicted [mm]"),
    )
    far = distance_m >= 0.05  # below, a zone can be empty
    for panel, (values, label) in zip(panels, shown, strict=True):
        for zone in range(values.shape[1]):
            colour = f"C{zone}"
            panel.plot(
                1e3 * distance_m[far & held], values[far & held, zone], "-", color=colour, lw=0.8, label=f"{zone}"
            )
            panel.plot(1e3 * distance_m[far & ~held], values[far & ~held, zone], "x", color=colour, ms=3)
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    panels[0].plot(1e3 * distance_m[far], np.median(of.floor[far], axis=1), "k:", lw=1, label="photon noise")
    panels[0].set_yscale("log")
    panels[0].legend(fontsize=7, ncols=5, title="zone", title_fontsize=7)
    panels[-1].set_xlabel("distance [mm]")
    figure.suptitle("Errors of the prediction; lines: held out, crosses: calibrated on", fontsize=11)
    return save(figure, path)


def draw_poses(rows: Sequence[dict], path: Path) -> Path:
    """Draw errors of distance and tilt against distance, with 95 % intervals."""
    figure, panels = plt.subplots(3, 1, figsize=(8, 7), sharex=True, layout="constrained")
    distance = [1e3 * row["distance_m"] for row in rows]
    for panel, (key, label) in zip(
        panels,
        (
            ("distance_mm", "distance [mm]"),
            ("about_y_deg", "tilt about y [deg]"),
            ("about_x_deg", "tilt about x [deg]"),
        ),
        strict=True,
    ):
        error = np.array([row[f"{key}_error"] for row in rows])
        panel.errorbar(distance, error, yerr=[row[f"{key}_interval"] for row in rows], fmt="o", ms=3, lw=0.8)
        panel.axhline(0, color="0.4", lw=0.8)
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    panels[-1].set_xlabel("distance of the arm [mm]")
    figure.suptitle("Pose of the plane from one capture, less the arm's; bars: 95 %, photons and model", fontsize=11)
    return save(figure, path)
