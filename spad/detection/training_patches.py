"""Fresh detections for training, from transients in memory: photon level, crop and noise drawn anew for every patch.

    packed = pack_views(transients)                          # once; a read pack file serves as `transients`
    batch = sense_patches(packed, sensor, requests, size=(32, 32))  # every step
    batch.counts                                                    # (B, 1, T, h, w) float32, for the network

Detections follow the independent Poisson law (training levels lie far below 1 % detections a cycle), drawn photon by
photon on the CPU, so that a seed gives the same counts on every device; the histogram is summed on `device`. Dead
pixels are those of the view, as `sense` places them with seed 0. Crosstalk comes from all neighbours in the view, those
outside the patch included.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from render.transient import Transient
from scenes.errors import InputError, require
from scenes.random_streams import Stream
from spad.detection.laws import crosstalk_events
from spad.detection.photons import PhotonEvents, PixelFlux, draw_primaries, paths_in_bins
from spad.detection.rates import background_scales
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.tdc import time_codes


@dataclass(frozen=True, eq=False)
class PackedViews:
    """Views of one size, one after the other, as a pack file holds them (numpy, read only).

    offsets       (S*H*W + 1,) int64: pixel p = (s H + i) W + j has the returns [offsets[p], offsets[p + 1])
    path_near_m, path_far_m, radiance   (N,) float32, as in `Transient`
    depth_m       (S, H, W) float32 label, NaN for none
    ambient       (S, H, W) float32, any scale
    mixed         (S, H, W) bool
    mean_radiance, mean_ambient   (S,) float64, over all pixels of a scene: computed
    """

    offsets: np.ndarray
    path_near_m: np.ndarray
    path_far_m: np.ndarray
    radiance: np.ndarray
    depth_m: np.ndarray
    ambient: np.ndarray
    mixed: np.ndarray
    mean_radiance: np.ndarray = field(init=False, repr=False)
    mean_ambient: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shape, returns = self.depth_m.shape, len(self.radiance)
        good = len(shape) == 3 and self.ambient.shape == self.mixed.shape == shape
        good = good and self.offsets.shape == (self.depth_m.size + 1,) and int(self.offsets[-1]) == returns
        if not (good and len(self.path_near_m) == len(self.path_far_m) == returns):
            raise InputError(
                f"packed views: layers {shape}, {self.ambient.shape}, {self.mixed.shape}, {self.offsets.shape} "
                f"offsets and {returns} returns do not belong together"
            )
        sums = np.add.reduceat(np.append(self.radiance, 0), self.offsets[:: shape[1] * shape[2]][:-1], dtype=np.float64)
        pixels = self.offsets[:: shape[1] * shape[2]]
        sums[np.diff(pixels) == 0] = 0  # reduceat gives an empty scene its neighbour's first
        object.__setattr__(self, "mean_radiance", sums / (shape[1] * shape[2]))
        object.__setattr__(self, "mean_ambient", self.ambient.mean(axis=(1, 2), dtype=np.float64))

    @property
    def scenes(self) -> int:
        return self.depth_m.shape[0]


def pack_views(transients: Iterable[Transient]) -> PackedViews:
    """Return transients of one size in one; InputError for none, or of different sizes."""
    transients = list(transients)
    sizes = {(transient.height, transient.width) for transient in transients}
    if len(sizes) != 1:
        raise InputError(f"transients of sizes {sorted(sizes)} cannot be packed together")
    starts = np.cumsum([0, *(transient.returns for transient in transients)])
    offsets = [transient.offsets[:-1] + start for transient, start in zip(transients, starts[:-1], strict=True)]
    columns = {
        name: np.concatenate([getattr(transient, name) for transient in transients])
        for name in ("path_near_m", "path_far_m", "radiance")
    }
    layers = {
        name: np.stack([getattr(transient, name) for transient in transients])
        for name in ("depth_m", "ambient", "mixed")
    }
    return PackedViews(np.concatenate([*offsets, starts[-1:]]), **columns, **layers)


def joined(packs: Sequence[PackedViews]) -> PackedViews:
    """Return several packed sets in one, scene after scene; InputError for none, or views of different sizes."""
    sizes = {packed.depth_m.shape[1:] for packed in packs}
    if len(sizes) != 1:
        raise InputError(f"packed sets with views of sizes {sorted(sizes)} cannot be joined")
    firsts = np.cumsum([0, *(len(packed.radiance) for packed in packs)])
    offsets = [packed.offsets[:-1] + first for packed, first in zip(packs, firsts[:-1], strict=True)]
    layers = ("path_near_m", "path_far_m", "radiance", "depth_m", "ambient", "mixed")
    columns = {name: np.concatenate([getattr(packed, name) for packed in packs]) for name in layers}
    return PackedViews(np.concatenate([*offsets, firsts[-1:]]), **columns)


class Patch(NamedTuple):
    """One patch to sense. The seed is what the caller keys by (epoch, sample), never by worker."""

    scene: int
    row: int
    column: int
    signal: float
    background: float
    seed: int | Sequence[int]
    time_offset_m: float = 0.0  # moves the scene away in time alone; recorded by who asks for it


class Batch(NamedTuple):
    """Sensed patches and their labels, all on one device."""

    counts: Tensor  # (B, 1, T, h, w) float32
    depth_m: Tensor  # (B, h, w) float32, time offset included; NaN where nothing is
    mixed: Tensor  # (B, h, w) bool
    valid: Tensor  # (B, h, w) bool: there is a depth, and within the sensor's range


def sense_patches(
    packed: PackedViews,
    sensor: Sensor,
    patches: Sequence[Patch],
    *,
    size: tuple[int, int],
    device: str | torch.device = "cpu",
) -> Batch:
    """Return counts and labels of patches (h, w) of stored transients.

    Mean signal and background are fixed on the scene's full frame before the crop, by means as in `rates.rates_for`.
    Labels stay continuous. Raises InputError for a patch outside its scene, and a scene without light to scale.
    """
    height, width = size
    pixels, bins = height * width, sensor.bins
    counts = torch.empty((len(patches), bins * pixels), device=device)
    labels = np.empty((len(patches), height, width), np.float32)
    mixed = np.empty((len(patches), height, width), bool)
    edges, converter = sensor.code_edges, sensor.converter_map(*packed.depth_m.shape[1:])

    def draw(number: int) -> None:
        patch = patches[number]
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(patch.seed, spawn_key=(Stream.PATCH, 0, 0))))
        rows, columns = slice(patch.row, patch.row + height), slice(patch.column, patch.column + width)
        events = _detections(packed, sensor, patch, size, rng)
        if edges is not None and converter is not None:
            mine = converter[rows, columns].reshape(-1)[events.pixel]
            events = events._replace(position=time_codes(events.position, mine, edges))
        _count(events, counts[number].view(bins, pixels))
        labels[number] = packed.depth_m[patch.scene, rows, columns] + np.float32(patch.time_offset_m)
        mixed[number] = packed.mixed[patch.scene, rows, columns]

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(draw, range(len(patches))))
    depth = torch.from_numpy(labels).to(device)
    return Batch(
        counts.reshape(len(patches), 1, bins, height, width),
        depth,
        torch.from_numpy(mixed).to(device),
        depth < sensor.recorded_range_m,  # false for NaN
    )


def _count(events: PhotonEvents, counts: Tensor) -> None:
    """Count the detections of each bin and pixel, into `counts` (T, P); whole numbers, so that no order of additions
    shows.

    On a CPU in the narrowest type that holds the fullest pixel, so that a core's cache holds the patch, and then wide.
    """
    pixels = counts.shape[1]
    places = events.position * np.int64(pixels)
    places += events.pixel
    index = torch.from_numpy(places).to(counts.device)
    most = int(np.bincount(events.pixel, minlength=1).max())
    if counts.device.type != "cpu" or most >= 1 << 15:
        one = torch.from_numpy(np.ones(len(places), np.float32)).to(counts.device)
        counts.zero_().view(-1).scatter_add_(0, index, one)
        return
    # Filled, cleared and copied by numpy: torch would do it on threads of its own, which wait for each other here
    kind = np.uint8 if most < 1 << 8 else np.int16
    narrow = np.zeros(counts.shape, kind)
    torch.from_numpy(narrow).view(-1).scatter_add_(0, index, torch.from_numpy(np.ones(len(places), kind)))
    np.copyto(counts.numpy(), narrow)


def check_patch(patch: Patch, size: tuple[int, int], shape: tuple[int, ...]) -> None:
    """Raise InputError for a patch of a size (h, w) that is outside views of a shape (S, H, W)."""
    (height, width), (scenes, rows, columns) = size, shape
    inside = 0 <= patch.scene < scenes and 0 <= patch.row <= rows - height and 0 <= patch.column <= columns - width
    place = f"patch of {height} x {width} at scene {patch.scene}, row {patch.row}, column {patch.column}"
    require(inside, f"{place} is outside {scenes} scenes of {rows} x {columns}")


def _detections(
    packed: PackedViews, sensor: Sensor, patch: Patch, size: tuple[int, int], rng: np.random.Generator
) -> PhotonEvents:
    """Draw the detections of a patch, and what its pixels and those around it fire in it by crosstalk."""
    (height, width), (_, rows, columns) = size, packed.depth_m.shape
    check_patch(patch, size, packed.depth_m.shape)
    timed = sensor.tdc is not None
    if not sensor.crosstalk:
        return draw_primaries(_light_of_patch(packed, sensor, patch, height, width), sensor, rng, fractional=timed)
    top, left = max(0, patch.row - 1), max(0, patch.column - 1)
    tall, wide = min(rows, patch.row + height + 1) - top, min(columns, patch.column + width + 1) - left
    light = _light_of_patch(packed, sensor, patch._replace(row=top, column=left), tall, wide)
    events = draw_primaries(light, sensor, rng, fractional=timed)
    cause, fired = crosstalk_events(events.pixel, sensor.crosstalk, tall, wide, rng)
    pixel = np.concatenate((events.pixel, fired))
    position = np.concatenate((events.position, events.position[cause]))
    row, column = pixel // wide + top, pixel % wide + left
    seen = (row >= patch.row) & (row < patch.row + height) & (column >= patch.column) & (column < patch.column + width)
    seen &= ~_dead_pixels(sensor, rows, columns)[row, column]
    place = (row - patch.row) * width + column - patch.column
    return PhotonEvents(place[seen].astype(np.int32), position[seen])


def _light_of_patch(packed: PackedViews, sensor: Sensor, patch: Patch, height: int, width: int) -> PixelFlux:
    _, rows, columns = packed.depth_m.shape
    budget = PhotonBudget(patch.signal, patch.background)
    mean = float(packed.mean_radiance[patch.scene])
    if mean <= 0 and budget.signal > 0:
        raise InputError(f"scene {patch.scene}: no light returns, {budget.signal:g} signal photons cannot be had")
    crop = (slice(patch.row, patch.row + height), slice(patch.column, patch.column + width))
    dark, ambient = _dark_counts(sensor, rows, columns), packed.ambient[patch.scene][crop].astype(np.float64)
    mean_ambient = float(packed.mean_ambient[patch.scene])
    if mean_ambient <= 0:
        ambient, mean_ambient = np.ones_like(ambient), 1.0  # uniform, as in `rates.fill_background`
    ambient_scale, dark_scale = background_scales(mean_ambient, float(dark.mean()), budget.background)
    pixel = (patch.scene * rows + patch.row + np.arange(height)[:, None]) * columns + patch.column + np.arange(width)
    first = packed.offsets[pixel].ravel()
    number = packed.offsets[pixel + 1].ravel() - first
    # each pixel's returns are a run: start of its run minus where the run goes, plus a running index
    index = np.repeat(first - np.cumsum(number) + number, number) + np.arange(int(number.sum()))
    start, length = paths_in_bins(packed.path_near_m[index], packed.path_far_m[index], sensor)
    owner = np.repeat(np.arange(height * width, dtype=np.int32), number)
    alive = ~_dead_pixels(sensor, rows, columns)[crop].ravel()
    return PixelFlux(
        owner=owner,
        start=start + patch.time_offset_m / sensor.bin_depth_m,
        length=length,
        signal=packed.radiance[index] * (budget.signal / mean if mean > 0 else 0.0) * alive[owner],
        background=(dark[crop] * dark_scale + ambient * ambient_scale).ravel() * alive,
    )


@lru_cache(maxsize=16)
def _dark_counts(sensor: Sensor, rows: int, columns: int) -> np.ndarray:
    """Compute the expected dark counts of an exposure, (H, W) float64, read only."""
    dark = sensor.dark_rate_map_hz(rows, columns) * sensor.exposure_s
    dark.flags.writeable = False
    return dark


@lru_cache(maxsize=16)
def _dead_pixels(sensor: Sensor, rows: int, columns: int) -> np.ndarray:
    """Return the pixels of a view that detect nothing, (H, W) bool, read only."""
    dead = sensor.dead_pixels(rows, columns)
    dead.flags.writeable = False
    return dead
