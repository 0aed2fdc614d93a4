"""Depth labels on the published grid: arrivals on whole bins, the label the pulse's fullest bin, decoded by i/(T - 1).

Ours are continuous and centred on the pulse. A model that is to be compared with the paper is trained on its grid: the
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
    """Return how far the centroid of the published test pulse lies behind its fullest bin, in bins.

    It is -0.44 on the reference sensor, where the centroid comes before the fullest bin.
    """
    taps = published_taps(sensor)
    return float(taps @ np.arange(len(taps)) - taps.argmax())


def on_published_grid(packed: PackedViews, sensor: Sensor) -> PackedViews:
    """Return one return a pixel as in the published simulation: all its light arrives so that the pulse's fullest bin
    is round(depth / bin) - 1, and the label is that bin's centre. Pixels without a depth within the range are dark.

    Depth is the mean over the pixel's returns, weighted by the area of the pixel that they fill times its reflectance
    (radiance times the squared path). At edges it lies between two surfaces, as in the published sets, whose depth maps
    are shrunk by an antialiased kernel. A pixel without returns is dark.
    """
    pixels, shape = packed.depth_m.size, packed.depth_m.shape
    owner = np.repeat(np.arange(pixels), np.diff(packed.offsets))
    path = (packed.path_near_m.astype(np.float64) + packed.path_far_m) / 2
    area = packed.radiance * path**2
    radiance, filled, moment = (
        np.bincount(owner, weights, pixels).reshape(shape) for weights in (packed.radiance, area, area * path / 2)
    )
    depth = np.divide(moment, filled, out=np.full(shape, np.nan), where=filled > 0)
    known = depth < sensor.recorded_range_m
    fullest = np.maximum(np.rint(np.where(known, depth, 0.0) / sensor.bin_depth_m), 1) - 1
    # a pulse that begins before the first bin has gone round
    arrival = (fullest + 0.5 + published_centroid_bins(sensor)) % sensor.bins_per_period
    path_m = (2 * sensor.bin_depth_m * arrival)[known].astype(np.float32)
    return PackedViews(
        offsets=np.concatenate([[0], np.cumsum(known.ravel(), dtype=np.int64)]),
        path_near_m=path_m,
        path_far_m=path_m,
        radiance=radiance[known].astype(np.float32),
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
