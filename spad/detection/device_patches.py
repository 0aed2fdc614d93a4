"""Fresh detections for training, drawn on the device that trains: the law of `training_patches`, for a GPU's step.

    resident = DevicePatches(packed, sensor, "cuda")                 # once: returns and layers move to the device
    batch = resident.sense(patches, size=(32, 32), seed=(0, 17))     # every step

`training_patches.sense_patches` is the plain twin: it draws on the CPU, patch by patch, and gives the same bytes on
every machine. Here all patches of a batch are drawn together, photon by photon, and nothing but their requests
crosses to the device. One seed gives one batch on one kind of device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from scenes.errors import require
from scenes.random_streams import Stream
from spad.detection.laws import NEIGHBOURS
from spad.detection.photons import paths_in_bins
from spad.detection.rates import background_scales
from spad.detection.training_patches import Batch, PackedViews, Patch, check_patch
from spad.sensor.model import Sensor
from spad.sensor.pulse import AnyPulse, Pulse, pulse_table
from spad.sensor.tdc import rising_edges


class _Pixels(NamedTuple):
    """Pixels of a batch: index among all scenes' and within their frames, and 1 where they detect light, else 0."""

    flat: Tensor  # (P,) int64
    in_frame: Tensor  # (P,) int64
    alive: Tensor  # (P,) float32


class _Photons(NamedTuple):
    """Detections in no order: pixel of the batch (M,) int64, position (M,) in bins after the laser's emission."""

    pixel: Tensor
    position: Tensor


class DevicePatches:
    """Packed transients that live on a device, and patches sensed there.

    packed   transients of one size
    sensor   whose bins, period, pulse, jitter, dark counts, dead pixels and crosstalk the detections have
    device   torch's name of the device, "cpu" among them

    Positions are in float32: 6e-5 of a bin at bin 1,024.
    """

    def __init__(self, packed: PackedViews, sensor: Sensor, device: str | torch.device) -> None:
        self.sensor, self.device, self.shape = sensor, torch.device(device), packed.depth_m.shape
        start, length = paths_in_bins(packed.path_near_m, packed.path_far_m, sensor)
        self.offsets = torch.from_numpy(packed.offsets).to(self.device)
        self.start, self.length, self.radiance = map(self._moved, (start, length, packed.radiance))
        self.spreads = bool((length > 0).any())
        self.depth_m = self._moved(packed.depth_m).flatten()
        self.mixed = torch.from_numpy(packed.mixed).to(self.device).flatten()
        rows, columns = self.shape[1:]
        dark = sensor.dark_rate_map_hz(rows, columns) * sensor.exposure_s
        self.mean_radiance, self.mean_ambient, self.mean_dark = packed.mean_radiance, packed.mean_ambient, dark.mean()
        self.dark = self._moved(dark).flatten()
        self.alive = self._moved(~sensor.dead_pixels(rows, columns)).flatten()
        edges, converter = sensor.code_edges, sensor.converter_map(rows, columns)
        self.edges = None if edges is None else torch.from_numpy(rising_edges(edges)).to(self.device)
        self.converter = None if converter is None else torch.from_numpy(converter).to(self.device).flatten()
        # uniform where a scene has no ambient light, as in `rates.fill_background`
        unlit = packed.mean_ambient <= 0
        self.mean_ambient = np.where(unlit, 1.0, packed.mean_ambient)
        self.ambient = self._moved(np.where(unlit[:, None, None], 1.0, packed.ambient)).flatten()

    def _moved(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self.device)

    def sense(self, patches: Sequence[Patch], *, size: tuple[int, int], seed: int | Sequence[int]) -> Batch:
        """Return counts and labels of patches (h, w); their own seeds are not asked, `seed` decides the whole batch.

        Mean signal and background are fixed on each scene's full frame before the crop. Raises InputError for a patch
        outside its scene, and a scene without light to scale.
        """
        (height, width), bins = size, self.sensor.bins
        shape = (len(patches), height, width)
        if not patches:  # a batch of none, as the plain twin gives
            empty = torch.empty(shape, device=self.device)
            counts = torch.empty((0, 1, bins, height, width), device=self.device)
            return Batch(counts, empty, empty.bool(), empty.bool())
        pixels = self._pixels(patches, size, 0)
        # crosstalk comes from the pixels around a patch, too
        lit = self._pixels(patches, size, 1) if self.sensor.crosstalk else pixels
        lit_per_patch = len(lit.flat) // len(patches)
        signal, ambient, dark = self._scales(patches, lit_per_patch)
        number = np.random.SeedSequence(seed, spawn_key=(Stream.DEVICE_PATCH,)).generate_state(1, np.uint64)[0]
        draw = torch.Generator(self.device).manual_seed(int(number >> np.uint64(1)))
        offset = torch.tensor([p.time_offset_m for p in patches], device=self.device)
        moved = offset.repeat_interleave(lit_per_patch)
        light = self._signal_photons(lit.flat, signal * lit.alive, moved / self.sensor.bin_depth_m, draw)
        expected = self.ambient[lit.flat] * ambient + self.dark[lit.in_frame] * dark
        steady = self._background_photons(expected * lit.alive, draw)
        counts = torch.zeros(len(patches) * bins * height * width, device=self.device)
        for photons in (light, steady):
            if self.sensor.crosstalk:
                photons = self._with_crosstalk(photons, pixels.alive, size, draw)
            self._count(photons, pixels.in_frame, height * width, counts)
        depth = (self.depth_m[pixels.flat] + offset.repeat_interleave(height * width)).view(shape)
        return Batch(
            counts.view(len(patches), 1, bins, height, width),
            depth,
            self.mixed[pixels.flat].view(shape),
            depth < self.sensor.recorded_range_m,
        )

    def _pixels(self, patches: Sequence[Patch], size: tuple[int, int], margin: int) -> _Pixels:
        """Return the patches' pixels and so many on all sides; those outside of the frame detect nothing."""
        (height, width), (_, rows, columns) = size, self.shape
        for one in patches:
            check_patch(one, size, self.shape)
        scene, row, column = (
            np.array([getattr(one, name) for one in patches])[:, None, None] for name in ("scene", "row", "column")
        )
        row, column = row + np.arange(-margin, height + margin)[:, None], column + np.arange(-margin, width + margin)
        outside = (row < 0) | (row >= rows) | (column < 0) | (column >= columns)
        in_frame = row.clip(0, rows - 1) * columns + column.clip(0, columns - 1)
        flat = scene * rows * columns + in_frame
        there, place, out = (torch.from_numpy(values.ravel()).to(self.device) for values in (flat, in_frame, outside))
        return _Pixels(there, place, self.alive[place] * ~out)

    def _scales(self, patches: Sequence[Patch], pixels: int) -> Sequence[Tensor]:
        """Return factors of radiance, ambient light and dark counts that bring each scene to its photon level, one for
        every pixel of the batch."""
        rows = []
        for one in patches:
            mean = float(self.mean_radiance[one.scene])
            lit = mean > 0 or one.signal == 0
            require(lit, f"scene {one.scene}: no light returns, {one.signal:g} signal photons cannot be had")
            steady = background_scales(float(self.mean_ambient[one.scene]), float(self.mean_dark), one.background)
            rows.append((one.signal / mean if mean > 0 else 0.0, *steady))
        return torch.tensor(rows, device=self.device).repeat_interleave(pixels, 0).unbind(1)

    def _signal_photons(self, pixel: Tensor, scale: Tensor, moved: Tensor, draw: torch.Generator) -> _Photons:
        """Draw N ~ Poisson(S) detections of each return, each at start + U length + pulse + jitter."""
        first = self.offsets[pixel]
        number = self.offsets[pixel + 1] - first
        owner = torch.repeat_interleave(number)
        # each pixel's returns are a run: start of its run minus where the run goes, plus a running index
        index = (first - number.cumsum(0) + number)[owner] + torch.arange(len(owner), device=self.device)
        photons = torch.poisson(self.radiance[index] * scale[owner], generator=draw).long()
        each = torch.repeat_interleave(photons)
        index, owner = index[each], owner[each]
        position = self.start[index] + moved[owner]
        if self.spreads:
            position += self.length[index] * torch.rand(len(each), generator=draw, device=self.device)
        for kernel in self.sensor.kernels:
            position += _delays(kernel, len(each), draw) / self.sensor.bin_width_s
        return _Photons(owner, position)

    def _background_photons(self, expected: Tensor, draw: torch.Generator) -> _Photons:
        """Draw detections that are uniform over the period."""
        owner = torch.repeat_interleave(torch.poisson(expected, generator=draw).long())
        return _Photons(
            owner,
            torch.rand(len(owner), generator=draw, device=self.device) * self.sensor.bins_per_period,
        )

    def _with_crosstalk(
        self, photons: _Photons, alive: Tensor, size: tuple[int, int], draw: torch.Generator
    ) -> _Photons:
        """Add what detections fire in their neighbours, as `laws.crosstalk_events`.

        The detections are of patches with a margin of one pixel, the result is of patches without it.
        """
        (height, width), (tall, wide) = size, (size[0] + 2, size[1] + 2)
        pixel, positions = photons.pixel, [photons.position]
        rows, columns, patches = [pixel // wide % tall - 1], [pixel % wide - 1], [pixel // (tall * wide)]
        for down, right in NEIGHBOURS:
            fired = torch.rand(len(pixel), generator=draw, device=self.device) < self.sensor.crosstalk
            rows.append(rows[0][fired] + down)
            columns.append(columns[0][fired] + right)
            patches.append(patches[0][fired])
            positions.append(photons.position[fired])
        row, column, patch, position = (torch.cat(parts) for parts in (rows, columns, patches, positions))
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        place = ((patch * height + row) * width + column)[inside]
        seen = alive[place] > 0
        return _Photons(place[seen], position[inside][seen])

    def _count(self, photons: _Photons, in_frame: Tensor, pixels: int, counts: Tensor) -> None:
        """Add detections to flat counts (B T P); whole numbers, so that no order of additions shows."""
        period, bins = self.sensor.bins_per_period, self.sensor.bins
        if self.edges is None or self.converter is None:
            place = photons.position.floor().long() % period
        else:
            first = self.converter[in_frame[photons.pixel]] * bins
            # as `time_codes`
            place = torch.searchsorted(self.edges, photons.position.double() % period + first, right=True) - 1 - first
            place = place.clamp(0, bins - 1)
        patch = photons.pixel // pixels
        index = (patch * bins + place) * pixels + photons.pixel % pixels
        if bins < period:  # the rest of the period has no bins: nothing is detected there
            index = index[place < bins]
        counts.scatter_add_(0, index, torch.ones((), device=self.device).expand(len(index)))


def _delays(kernel: AnyPulse, size: int, draw: torch.Generator) -> Tensor:
    """Draw delays of detections after their arrival [s], (size,) float32."""
    device = draw.device
    if isinstance(kernel, Pulse):
        delay = torch.randn(size, generator=draw, device=device) * kernel.sigma_s
        if kernel.tail_s:
            decay = torch.empty(size, device=device).exponential_(generator=draw)
            delay += (decay - 1) * kernel.tail_s
        return delay
    table = pulse_table(kernel)
    arrived, edges = (torch.from_numpy(values).to(device) for values in (table.arrived, table.edges_s))
    chance = torch.rand(size, generator=draw, device=device, dtype=torch.float64)
    step = (torch.searchsorted(arrived, chance, right=True) - 1).clamp(0, len(arrived) - 2)
    mass = (arrived[step + 1] - arrived[step]).clamp(min=1e-300)
    return (edges[step] + (chance - arrived[step]) / mass * (edges[step + 1] - edges[step])).float()
