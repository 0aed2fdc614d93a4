"""Figures of `study real-data`: intensity, point clouds and depth images of captures, one row a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from scene2spad.plots.figures import DEPTH_COLOURS, plt, save
from spad.estimators.depth import depth_errors
from spad.sensor.model import Sensor

MAX_POINTS = 20000  # of a cloud: more make one colour
YAW_DEG, PITCH_DEG = -25.0, 20.0  # of the viewer of clouds
STRONG = 5.0  # standard deviations above a pixel's mean count a bin from which a bin is a point of the raw cloud


@dataclass(frozen=True, eq=False)
class View:
    """A capture as the methods see it.

    counts    (H, W, T) float32
    sensor    whose bins these are
    image     (h, w) intensity, None where the file has none
    fov_deg   full horizontal angle
    depth_m, mixed   (H, W) the truth, and where it is no single depth; None for captures without
    """

    name: str
    counts: np.ndarray
    sensor: Sensor
    image: np.ndarray | None
    fov_deg: float
    depth_m: np.ndarray | None = None
    mixed: np.ndarray | None = None


Depths = dict[tuple[str, str], np.ndarray]


def directions(height: int, width: int, fov_deg: float) -> np.ndarray:
    """Return unit vectors of the pixels of a pinhole camera, (H, W, 3): x right, y down, z forward."""
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def raw_cloud(view: View) -> np.ndarray:
    """Return points (N, 3) [m] of the histogram itself: bins that stand out of their pixel's mean count."""
    height, width, _ = view.counts.shape
    mean = view.counts.mean(axis=-1, keepdims=True)
    row, column, time_bin = np.nonzero(view.counts > mean + STRONG * np.sqrt(mean) + 1)
    rays = directions(height, width, view.fov_deg)[row, column]
    return rays * ((time_bin + 0.5) * view.sensor.bin_depth_m)[:, None]


def limits(view: View, depths: Depths) -> tuple[float, float]:
    """Return colour scale: where 96 % of the truth lies, or of the matched filter's depths where there is none."""
    shown = depths[view.name, "log-matched"] if view.depth_m is None else view.depth_m
    known = shown[np.isfinite(shown)]
    if not known.size:
        return 0.0, view.sensor.range_m
    low, high = np.quantile(known, (0.02, 0.98))
    margin = max(0.05 * (high - low), 0.02)
    return float(max(low - margin, 0)), float(high + margin)


def draw(views: list[View], labels: list[str], depths: Depths, title: str, path: Path) -> Path:
    """Draw a row a capture: intensity, the raw histogram as a cloud, the truth where it is known, depth by every
    method."""
    truth = any(view.depth_m is not None for view in views)
    columns = 2 + truth + len(labels)
    size = (2.7 * columns, 3.0 * len(views) + 0.7)
    figure, axes = plt.subplots(len(views), columns, figsize=size, layout="constrained", squeeze=False)
    for row, view in zip(axes, views, strict=True):
        scale = limits(view, depths)
        _intensity(row[0], view)
        _cloud(row[1], raw_cloud(view), scale, "raw histogram", _frame(view, depths))
        maps = ({"truth": view.depth_m} if truth else {}) | {label: depths[view.name, label] for label in labels}
        for one, (label, depth) in zip(row[2:], maps.items(), strict=True):
            shown = np.full(view.counts.shape[:2], np.nan) if depth is None else depth
            picture = one.imshow(shown, cmap=DEPTH_COLOURS, vmin=scale[0], vmax=scale[1], interpolation="nearest")
            one.set_title(_wrapped(label), fontsize=9)
            one.set_xlabel(_error(view, depth, label), fontsize=8)
            one.set(xticks=[], yticks=[])
        figure.colorbar(picture, ax=row[2:], fraction=0.02, pad=0.01).set_label("depth [m]")
    figure.get_layout_engine().set(hspace=0.06)
    figure.suptitle(title)
    return save(figure, path)


def draw_clouds(views: list[View], labels: list[str], depths: Depths, title: str, path: Path) -> Path:
    """Draw point clouds: the truth where it is known, then every method's depth."""
    truth = any(view.depth_m is not None for view in views)
    columns = truth + len(labels)
    size = (2.9 * columns, 3.1 * len(views) + 0.7)
    figure, axes = plt.subplots(len(views), columns, figsize=size, layout="constrained", squeeze=False)
    for row, view in zip(axes, views, strict=True):
        maps = ({"truth": view.depth_m} if truth else {}) | {label: depths[view.name, label] for label in labels}
        for one, (label, depth) in zip(row, maps.items(), strict=True):
            _cloud(
                one,
                _points(view, depth),
                limits(view, depths),
                f"{view.name}: " + _wrapped(label),
                _frame(view, depths),
            )
    figure.get_layout_engine().set(hspace=0.06)
    figure.suptitle(f"{title}. Orthographic, from above the camera's right shoulder; colour is depth")
    return save(figure, path)


def _points(view: View, depth: np.ndarray | None) -> np.ndarray:
    """Return a depth image as points (N, 3) [m]."""
    if depth is None:
        return np.zeros((0, 3))
    height, width = view.counts.shape[:2]
    return (directions(height, width, view.fov_deg) * depth[..., None])[np.isfinite(depth)]


def projected(points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) of the camera's frame turned to the viewer, (N, 3) [m]: across, upwards, away."""
    yaw, pitch = np.radians(YAW_DEG), np.radians(PITCH_DEG)
    x, up, z = points[:, 0], -points[:, 1], points[:, 2]
    across, behind = x * np.cos(yaw) - z * np.sin(yaw), x * np.sin(yaw) + z * np.cos(yaw)
    return np.stack(
        [across, up * np.cos(pitch) + behind * np.sin(pitch), behind * np.cos(pitch) - up * np.sin(pitch)], axis=1
    )


def _frame(view: View, depths: Depths) -> tuple[np.ndarray, np.ndarray]:
    """Find the part of the viewer's plane that all clouds of a capture are shown in: that of the truth, or of the
    matched filter where there is none."""
    low, high = limits(view, depths)
    points = _points(view, depths[view.name, "log-matched"] if view.depth_m is None else view.depth_m)
    distance = np.linalg.norm(points, axis=1)
    flat = projected(points[(distance >= low) & (distance <= high)])[:, :2]
    if not len(flat):
        return np.full(2, -high), np.full(2, high)
    margin = 0.05 * np.ptp(flat, axis=0).max() + 0.01
    return flat.min(axis=0) - margin, flat.max(axis=0) + margin


def _error(view: View, depth: np.ndarray | None, label: str) -> str:
    if view.depth_m is None or depth is None or label == "truth":
        return ""
    found = depth_errors(depth, view.depth_m, range_m=view.sensor.recorded_range_m, exclude=view.mixed)
    return error_words(found, depth.size, mixed=view.mixed is not None)


def error_words(found: dict, size: int, *, mixed: bool) -> str:
    """Write the errors of a map of `size` pixels, and over how many of them; nothing where there is none."""
    if not found["pixels"]:
        return ""
    over = f"over {found['pixels']:,} of {size:,} pixels" + ("\n(mixed ones left out)" if mixed else "")
    return f"MAE {found['mae_mm']:.0f} mm, {found['within_10mm']:.0%} < 10 mm\n{over}"


def _wrapped(label: str) -> str:
    """At two lines."""
    if not label.startswith("network "):
        return label
    front, _, rest = label.removeprefix("network ").partition(", ")
    return f"network ({rest})\n{front}"


def _intensity(axes: Axes, view: View) -> None:
    image = np.zeros((1, 1)) if view.image is None else view.image
    axes.imshow(image, cmap="gray")
    axes.set(xticks=[], yticks=[])
    axes.set_title(f"{view.name}: {'intensity' if view.image is not None else 'no image in the file'}", fontsize=9)
    axes.set_xlabel(f"{view.counts.sum(axis=-1).mean():.0f} photons a pixel", fontsize=8)


def _cloud(
    axes: Axes, points: np.ndarray, scale: tuple[float, float], title: str, frame: tuple[np.ndarray, np.ndarray]
) -> None:
    """Points (N, 3) in the camera's frame [m], the nearest drawn last; those off the depth scale are left out and
    counted."""
    depth = np.linalg.norm(points, axis=1)
    inside = (depth >= scale[0]) & (depth <= scale[1])
    off = 1 - inside.mean() if len(points) else 0.0
    step = -(-int(inside.sum()) // MAX_POINTS) or 1
    flat, depth = projected(points[inside][::step]), depth[inside][::step]
    order = np.argsort(-flat[:, 2])
    size = float(np.clip(9000 / max(len(flat), 1), 0.7, 12))
    colours = {"cmap": DEPTH_COLOURS, "vmin": scale[0], "vmax": scale[1]}
    axes.scatter(flat[order, 0], flat[order, 1], c=depth[order], s=size, linewidths=0, **colours)
    (left, low), (right, high) = frame
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal", facecolor="0.93")
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(f"m; {off:.1%} of the points off the scale", fontsize=8)
    axes.tick_params(labelsize=6)


def lines(rows: list[dict]) -> list[str]:
    """Return the table in words."""
    messages = [f"{'capture':<12} {'method':<44} {'MAE mm':>8} {'median mm':>10} {'< 10 mm':>8} {'pixels':>7}"]
    for row in rows:
        numbers = f"{row['mae_mm']:>8.1f} {row['median_mm']:>+10.1f} {row['within_10mm']:>8.1%} {row['pixels']:>7}"
        messages.append(f"{row['capture'][:12]:<12} {row['method'][-44:]:<44} {numbers}")
    return messages
