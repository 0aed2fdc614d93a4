"""A multi-zone sensor's exposure as a `Histogram`: zones are its pixels, in rows and columns as they look."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from render.transient import Transient
from scenes.errors import require
from spad.formats.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor
from spad.zones.sensor import ZoneArray, draw_zone_counts, zone_returns, zone_signal


def zone_grid(zones: ZoneArray) -> tuple[int, int, np.ndarray]:
    """Return rows, columns, and the zone at each place from top left; one row where the centres form no grid."""
    x, y = np.asarray(zones.centre_x).round(9), np.asarray(zones.centre_y).round(9)
    rows, columns = len(np.unique(y)), len(np.unique(x))
    if rows * columns != zones.count:
        return 1, zones.count, np.arange(zones.count)
    return rows, columns, np.lexsort((x, y))


def with_budget(zones: ZoneArray, transient: Transient, sensor: Sensor, budget: PhotonBudget) -> ZoneArray:
    """Scale gains and set backgrounds so that their means over the zones are the budget's, before saturation.

    Raises InputError where no light reaches a zone.
    """
    signal = zone_signal(zone_returns(transient, zones), sensor, zones).sum(axis=1).mean()
    require(signal > 0 or budget.signal == 0, f"no light reaches a zone: {budget.signal:g} photons cannot be had")
    scale = budget.signal / signal if signal > 0 else 0.0
    background = (budget.background / sensor.bins,) * zones.count
    return replace(zones, gain=tuple(gain * scale for gain in zones.gain), background=background)


def sense_zones(transient: Transient, sensor: Sensor, zones: ZoneArray, *, seed: int = 0) -> Histogram:
    """Record one exposure of a multi-zone sensor: counts (rows, columns, T) of its zones.

    Depth, albedo and `mixed` are the transient's at each zone's centre. Raises InputError as `zone_returns` does, and
    for a zone whose centre is outside the image.
    """
    rows, columns, order = zone_grid(zones)
    returns = zone_returns(transient, zones)
    counts = draw_zone_counts(returns, sensor, zones, seed=seed)
    signal = zone_signal(returns, sensor, zones).sum(axis=1)
    background = np.asarray(zones.background) * sensor.bins
    lost = 1 - counts.sum() / max(1.0, float((signal + background).sum()))
    pixel, centres = _centre_pixels(transient, zones), (zones.centre_x, zones.centre_y)

    def laid(values: np.ndarray, kind: type) -> np.ndarray:
        return values[order].reshape(rows, columns, *values.shape[1:]).astype(kind)

    brightest = float(signal.max() / signal.sum()) if signal.any() else 0.0
    return Histogram(
        laid(counts, np.int32),
        sensor,
        PhotonBudget(float(signal.mean()), float(background.mean())),
        depth_m=laid(transient.depth_m[pixel], np.float32),
        mixed=laid(transient.mixed[pixel], np.bool_),
        albedo=laid(transient.albedo[pixel], np.float16),
        expected_signal=laid(signal, np.float32),
        expected_background=laid(background, np.float32),
        meta={
            "seed": seed,
            "model": "zones",
            "plan": [f"zones: {zones.count} fields of view, {max(0.0, lost):.1%} of the detections lost to saturation"],
            "pile_up": float((signal + background).max() / min(zones.trials)),
            "wrapped": 0.0,
            "dark_share": 1.0,
            "brightest_pixel": brightest,
            "brightest_thousandth": brightest,
            "median_signal": float(np.median(signal)),
            "transient": {**transient.meta, "sha256": transient.sha256()},
            # tangents as the zones are laid out: beside a displaced emitter the depth depends on them
            "zone_centres": {
                axis: laid(np.asarray(at), float).tolist() for axis, at in zip("xy", centres, strict=True)
            },
        },
    )


def _centre_pixels(transient: Transient, zones: ZoneArray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that each zone's centre falls into."""
    height, width = transient.height, transient.width
    focal = 0.5 * width / math.tan(math.radians(transient.meta["camera"]["fov_deg"]) / 2)
    row = np.floor(np.asarray(zones.centre_y) * focal + height / 2).astype(int)
    column = np.floor(np.asarray(zones.centre_x) * focal + width / 2).astype(int)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    require(bool(inside.all()), f"{int((~inside).sum())} of {zones.count} zones look beside the image: render wider")
    return row, column
