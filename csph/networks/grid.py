"""Depth labels on the published grid: arrivals on whole bins, the label the pulse's fullest bin, decoded by i/(T - 1).

Ours are continuous and centred on the pulse. A model that is to be compared with print is trained on print's grid: the
published label stands 0.44 bins (6.5 mm) behind the pulse's centroid, and bin i of T is decoded as i/(T - 1) of the
range, k/(T - 1) bins too far at bin k. Neither is an error of a network.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from torch import Tensor

from spad.detection.training_patches import PackedViews
from spad.formats.rgbd import published_taps
from spad.sensor.model import Sensor

Grid = Literal["continuous", "published"]
GRIDS: tuple[str, ...] = ("continuous", "published")


def published_centroid_bins(sensor: Sensor) -> float:
    """Return centroid of the published test pulse in bins after its fullest bin (-0.44 on the reference sensor)."""
    taps = published_taps(sensor)
    return float(taps @ np.arange(len(taps)) - taps.argmax())


def on_published_grid(packed: PackedViews, sensor: Sensor) -> PackedViews:
    """Return one return a pixel as in the published simulation: all its light arrives so that the pulse's fullest bin
    is round(depth / bin) - 1, and the label is that bin's centre. Pixels without a depth within the range are dark."""
    depth = packed.depth_m.astype(np.float64)
    known = np.isfinite(depth) & (depth < sensor.range_m)
    fullest = np.maximum(np.rint(np.where(known, depth, 0.0) / sensor.bin_depth_m), 1) - 1
    total = np.concatenate([[0.0], np.cumsum(packed.radiance, dtype=np.float64)])
    radiance = np.diff(total[packed.offsets]).reshape(depth.shape)
    kept = known & (radiance > 0)
    # a pulse that begins before the first bin has gone round
    arrival = (fullest + 0.5 + published_centroid_bins(sensor)) % sensor.bins_per_period
    path = (2 * sensor.bin_depth_m * arrival)[kept].astype(np.float32)
    return PackedViews(
        offsets=np.concatenate([[0], np.cumsum(kept.ravel(), dtype=np.int64)]),
        path_near_m=path,
        path_far_m=path,
        radiance=radiance[kept].astype(np.float32),
        depth_m=np.where(known, (fullest + 0.5) * sensor.bin_depth_m, np.nan).astype(np.float32),
        ambient=packed.ambient,
        mixed=packed.mixed,
    )


def published_position(position: Tensor, bins: int) -> Tensor:
    """Return where the published decoding puts an answer, in bins: weights i/(T - 1) of the range instead of bin
    centres."""
    return (position - 0.5) * (bins / (bins - 1)) + 0.5


def published_target(depth: Tensor, sensor: Sensor) -> Tensor:
    """Return the depth [m] whose published decoding is `depth`: where a network's pulse is to stand."""
    half = 0.5 * sensor.bin_depth_m
    return (depth - half) * ((sensor.bins - 1) / sensor.bins) + half
