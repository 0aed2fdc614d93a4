"""Captures of a multi-zone sensor before a plane: the file, and the plane rendered as the sensor saw it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from render.engine import render
from render.settings import RenderSettings
from render.transient import Transient
from scene2spad.datasets.rendering import quiet
from scenes.errors import require
from scenes.files import read_arrays
from scenes.model import Camera, Laser, Material, Scene, Surface
from spad.sensor.model import Sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.expected_counts import ZoneCapture
from spad.zones.simulation import zone_returns

PIXELS = 28  # side of the image that the zones' fields of view are cut from
CONE_DEG = 80.0
PLANE_SIZE = 1.5  # half its side, in its distances: beyond what the zones see, and free to tilt
DIRECT = RenderSettings(bounces=1, grid=2)
MAX_VALUE = 1 << 40  # of counts and millimetres: sums stay exact
# Bins of the reference channel around its pulse, whose centroid follows the laser as it warms up.
REFERENCE_REACH = (-4, 16)


@dataclass(frozen=True, eq=False)
class PlaneCaptures:
    """Captures in order of distance: distance_m (N,), counts (N, Z, T), drift_bins (N,) of the reference channel, and
    what the chip itself says, chip_m (N, Z), NaN where the file has none."""

    distance_m: np.ndarray
    counts: np.ndarray
    drift_bins: np.ndarray
    chip_m: np.ndarray

    def chosen(self, which: np.ndarray) -> PlaneCaptures:
        """Return some of the captures, by a mask or indices."""
        return PlaneCaptures(*(getattr(self, name)[which] for name in ("distance_m", "counts", "drift_bins", "chip_m")))


def shipped_captures() -> Path:
    """Return the captures of a TMF8820 that come with the package."""
    return Path(str(files("scene2spad.datasets") / "captures" / "tmf8820-plane.npz"))


def read_plane_captures(path: Path) -> PlaneCaptures:
    """Read captures (.npz): `distance_m` (N,), `counts` (N, Z, T), and if any `reference_counts` (N, T) of the channel
    that sees the laser itself, and `chip_depth_1_mm` (N, Z).

    Raises InputError in one line that names the file and what is missing, of another shape, negative or not finite.
    """
    path = Path(path)
    require(path.suffix.lower() == ".npz", f"{path}: captures are a .npz file")
    dimensions = {"distance_m": 1, "counts": 3, "reference_counts": 2, "chip_depth_1_mm": 2}
    held = read_arrays(path, "capture file", dimensions)
    for name, dims in dimensions.items():
        if dims == 2 and name not in held:
            continue
        require(
            name in held, f"{path}: holds no {name}, expected captures: distance_m (N,) and counts (N, zones, bins)"
        )
        good = held[name].ndim == dims and held[name].dtype.kind in "iuf" and held[name].size > 0
        require(good, f"{path}: {name} is {held[name].dtype}{held[name].shape}, expected {dims} dimensions of numbers")
        known = np.nan_to_num(held[name], nan=0.0) if name == "chip_depth_1_mm" else held[name]
        good = bool((known >= 0).all() and (known <= MAX_VALUE).all())
        require(good, f"{path}: {name} holds values that are not finite, negative or above {MAX_VALUE:g}")
    whole = bool((held["counts"] == np.floor(held["counts"])).all())
    require(whole, f"{path}: counts are no whole numbers")
    distance, counts = held["distance_m"].astype(np.float64), held["counts"].astype(np.int64)
    require(len(distance) == len(counts) > 0, f"{path}: {len(distance)} distances for {len(counts)} captures")
    require(bool((distance > 0).all()), f"{path}: a distance is 0")
    number, zones, bins = counts.shape
    reference = held.get("reference_counts", np.zeros((number, bins)))
    good = reference.shape == (number, bins)
    require(good, f"{path}: reference_counts is {reference.shape}, expected {(number, bins)}")
    chip = held.get("chip_depth_1_mm", np.full((number, zones), np.nan)).astype(np.float64)
    require(chip.shape == (number, zones), f"{path}: chip_depth_1_mm is {chip.shape}, expected {(number, zones)}")
    order = np.argsort(distance, kind="stable")
    found = PlaneCaptures(
        distance, counts, _drift_bins(reference.astype(np.float64)), np.where(chip > 0, chip, np.nan) / 1e3
    )
    return found.chosen(order)


def _drift_bins(reference: np.ndarray) -> np.ndarray:
    """Compute how late the reference channel's pulse is in each capture, bins after its mean; 0 without such a
    channel, and in captures where it counted nothing."""
    if not reference.any():
        return np.zeros(len(reference))
    peak = int(reference.sum(axis=0).argmax())
    first, last = max(0, peak + REFERENCE_REACH[0]), min(reference.shape[1], peak + REFERENCE_REACH[1])
    window = reference[:, first:last]
    lit = window.sum(axis=1) > 0
    centroid = window @ np.arange(first, last) / np.maximum(window.sum(axis=1), 1)
    return np.where(lit, centroid - centroid[lit].mean(), 0.0)


def plane_scene(
    distance_m: float, zones: ZoneArray, tilt_rad: tuple[float, float] = (0.0, 0.0), pixels: int = PIXELS
) -> Scene:
    """Return a white plane that a sensor at the origin, looking along z, sees; `distance_m` along its axis.

    tilt_rad: the plane turned about the sensor's y axis (its right side farther), then about its x axis (lower side
    farther). The image holds all zones.
    """
    reach = max(
        np.abs(np.asarray(centre)).max() + np.asarray(size).max() / 2
        for centre, size in ((zones.centre_x, zones.width), (zones.centre_y, zones.height))
    )
    camera = Camera(np.eye(4), 2 * math.degrees(math.atan(1.05 * reach)), pixels, pixels)
    side = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=np.float64) * PLANE_SIZE * distance_m
    depth = distance_m + side @ np.tan(tilt_rad)
    require(bool((depth > 0).all()), f"plane at {distance_m:g} m: its tilt brings it behind the sensor")
    wall = Surface(np.column_stack((side, depth)), np.array([[0, 1, 2], [0, 2, 3]]), Material(albedo=0.5))
    across, down, forward = zones.baseline_m
    return Scene("plane", (wall,), camera, Laser("flood", (across, down, forward), cone_deg=CONE_DEG))


def render_plane(
    distance_m: float, zones: ZoneArray, tilt_rad: tuple[float, float] = (0.0, 0.0), pixels: int = PIXELS
) -> Transient:
    """Render the plane's direct light, deterministic."""
    with quiet():
        return render(plane_scene(distance_m, zones, tilt_rad, pixels), DIRECT)


def zone_captures(captures: PlaneCaptures, sensor: Sensor, zones: ZoneArray) -> list[ZoneCapture]:
    """Render the plane at each capture's distance, and return its light beside the counts."""
    require_same_zones(captures, sensor, zones)
    found = []
    for distance, counts, drift in zip(captures.distance_m, captures.counts, captures.drift_bins, strict=True):
        returns = zone_returns(render_plane(float(distance), zones), zones)
        found.append(ZoneCapture(returns, counts, float(drift) * sensor.bin_width_s))
    return found


def require_same_zones(captures: PlaneCaptures, sensor: Sensor, zones: ZoneArray, where: str = "") -> None:
    """Raise InputError, which begins with `where`, for captures of other zones or bins than the sensor has."""
    _, count, bins = captures.counts.shape
    expected = f"sensor {sensor.name} has {zones.count} zones of {sensor.bins} bins"
    fits = count == zones.count and bins == sensor.bins
    require(fits, f"{where}captures of {count} zones and {bins} bins, {expected}")


def within(captures: PlaneCaptures, nearest_m: float, farthest_m: float = math.inf) -> PlaneCaptures:
    """Return the captures of a span of distances."""
    return captures.chosen((captures.distance_m >= nearest_m) & (captures.distance_m <= farthest_m))
