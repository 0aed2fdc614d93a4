"""Training data: patches of rendered sets, sensed on the fly, photon level, crop and noise new for every sample.

A sample is told apart by (seed, epoch, number), never by worker, so that the same run gives the same patches whatever
the number of workers, and one that goes on after an interruption the patches that it would have seen.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from csph.levels import PHOTON_LEVELS, dealt_levels, draw_level
from csph.networks.config import WINDOW_STEP, TrainConfig
from scenes.errors import require
from scenes.random_streams import Stream
from spad.detection.device_patches import DevicePatches
from spad.detection.training_patches import Batch, PackedViews, Patch, joined, sense_patches
from spad.sensor.model import Sensor

log = logging.getLogger("csph")

FULL_LENGTH_FRACTION = 0.1  # of a run with windows, its last, of whole epochs at least one: on all bins


class Request(NamedTuple):
    """A patch of one of several sets."""

    source: int
    patch: Patch


class TrainBatch(NamedTuple):
    """Sensed patches, their labels, and the first bin of each one's window (-1: all bins)."""

    counts: Tensor  # (B, 1, T, h, w) float32
    depth_m: Tensor  # (B, h, w) float32, NaN where nothing is
    valid: Tensor  # (B, h, w) bool
    first_bin: Tensor  # (B,) int64


class Samples(Dataset):
    """Requests for the patches of one epoch; drawing one is cheap, `sense` of a batch is the work."""

    def __init__(self, sets: Sequence[PackedViews], config: TrainConfig, epoch: int) -> None:
        self.shapes, self.config, self.epoch = [packed.depth_m.shape for packed in sets], config, epoch
        for shape in self.shapes:
            most = min(shape[1:])
            require(config.crop <= most, f"crops of {config.crop} pixels do not fit views of {most}")
        weights = config.weights or (1.0,) * len(sets)
        message = f"training: {len(weights)} set weights for {len(sets)} training sets"
        require(len(weights) == len(sets), message)
        self.edges = np.cumsum(weights)[:-1] / np.sum(weights)

    def __len__(self) -> int:
        return self.config.steps_per_epoch * self.config.batch

    def __getitem__(self, number: int) -> Request:
        config = self.config
        key = (config.seed, self.epoch, number)
        rng = np.random.default_rng(np.random.SeedSequence(key, spawn_key=(Stream.TRAIN,)))
        signal, background = draw_level(rng, config.levels)
        # of one set nothing is drawn: the samples are those of a tree that knew only one
        source = int(np.searchsorted(self.edges, rng.random(), side="right")) if len(self.shapes) > 1 else 0
        scenes, rows, columns = self.shapes[source]
        patch = Patch(
            scene=int(rng.integers(scenes)),
            row=int(rng.integers(rows - config.crop + 1)),
            column=int(rng.integers(columns - config.crop + 1)),
            signal=signal,
            background=background,
            seed=key,
            time_offset_m=config.time_offset_m * float(rng.random()),
        )
        return Request(source, patch)


class Frames(Dataset):
    """Whole validation frames of one set, as far as blocks tile them: view after view, each at one level, which are
    dealt out (`dealt_levels`); the 16 test levels where training draws from a continuous range."""

    def __init__(self, packed: PackedViews, config: TrainConfig, views: int | None = None, source: int = 0) -> None:
        scenes, rows, columns = packed.depth_m.shape
        _, height, width = config.model.block
        self.size = (rows // height * height, columns // width * width)
        fits = min(self.size) > 0
        require(fits, f"validation views of {columns} x {rows} pixels are smaller than a block of {width} x {height}")
        levels = PHOTON_LEVELS if isinstance(config.levels, str) else config.levels
        # spread over the scenes, so that a few views are not all of the first
        count = min(views or config.validation_views, scenes * len(levels))
        self.chosen = [round(i * scenes * len(levels) / count) // len(levels) for i in range(count)]
        # a set goes on where the one before it ended, so that several of few views do not all leave out the same levels
        self.levels = dealt_levels(levels, count, source * count)
        self.config, self.scenes, self.source = config, scenes, source

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, number: int) -> Request:
        scene, (signal, background) = self.chosen[number], self.levels[number]
        # of four numbers: training has three, of which the second, the epoch, can be Stream.VALIDATE
        key = (self.config.seed, Stream.VALIDATE, number, self.source + 1)
        return Request(self.source, Patch(scene, 0, 0, signal, background, key))


def warn_of_unlabelled(training: Sequence[PackedViews], config: TrainConfig) -> None:
    """Warn of random delays that move all of a training set beyond the sensor's range: what is beyond it has no label,
    and such patches train nothing."""
    most_m, range_m = config.time_offset_m, config.model.sensor.recorded_range_m
    for number, packed in enumerate(training):
        nearest_m = float(np.min(packed.depth_m, initial=np.inf, where=np.isfinite(packed.depth_m)))
        beyond = min((most_m + nearest_m - range_m) / most_m, 1.0) if most_m else 0.0
        if beyond > 0:
            message = "time offset %.4g m: %.2g %% of the delays leave no label in training set %d (range %.4g m)"
            log.warning(message, most_m, 100 * beyond, number + 1, range_m)


def sensed_batch(
    sets: Sequence[PackedViews], sensor: Sensor, size: tuple[int, int], window: int, requests: Sequence[Request]
) -> TrainBatch:
    """Sense a batch of patches of `size` (rows, columns), in the order of their requests; those of one set together.

    `window` is the number of bins around the labels that training sees, 0 all.
    """
    sources = [request.source for request in requests]
    parts, order = [], []
    for source in sorted(set(sources)):
        mine = [i for i, one in enumerate(sources) if one == source]
        parts.append(sense_patches(sets[source], sensor, [requests[i].patch for i in mine], size=size))
        order += mine
    batch = parts[0]
    if len(parts) > 1:
        back = torch.from_numpy(np.argsort(order))
        batch = Batch(*(torch.cat(same)[back] for same in zip(*parts, strict=True)))
    starts = [
        _window_start(batch.depth_m[i][batch.valid[i]].numpy(), request.patch, sensor, window)
        for i, request in enumerate(requests)
    ]
    return TrainBatch(batch.counts, batch.depth_m, batch.valid, torch.tensor(starts))


def _window_start(labels: np.ndarray, patch: Patch, sensor: Sensor, window: int) -> int:
    """Draw the first bin of a window that holds one of a patch's labels (N,), with the patch's key; -1 without
    windows."""
    if not window:
        return -1
    rng = np.random.default_rng(np.random.SeedSequence(patch.seed, spawn_key=(Stream.WINDOW,)))
    label = float(labels[rng.integers(len(labels))]) if len(labels) else 0.0
    block = int(label / sensor.bin_depth_m) // WINDOW_STEP - int(rng.integers(window // WINDOW_STEP))
    return min(max(0, block * WINDOW_STEP), sensor.bins - window)


class Requests(NamedTuple):
    """A batch that is still to be sensed, on the device that trains."""

    requests: tuple[Request, ...]
    window: int


def _asked(window: int, requests: Sequence[Request]) -> Requests:
    return Requests(tuple(requests), window)


class DeviceSensing:
    """Senses the batches of several training sets on one device, all sets in one; validation stays on the CPU."""

    def __init__(self, sets: Sequence[PackedViews], config: TrainConfig, device: torch.device) -> None:
        self.config, self.packed = config, joined(sets)
        self.firsts = np.cumsum([0, *(packed.scenes for packed in sets)])
        self.resident = DevicePatches(self.packed, config.model.sensor, device)

    def sense(self, asked: Requests) -> TrainBatch:
        """Return a batch on the device; the first patch's key decides the noise of all."""
        sensor, side = self.config.model.sensor, self.config.crop
        patches = [one.patch._replace(scene=int(self.firsts[one.source]) + one.patch.scene) for one in asked.requests]
        batch = self.resident.sense(patches, size=(side, side), seed=patches[0].seed)
        starts = [_window_start(self._labels(one, side), one, sensor, asked.window) for one in patches]
        # on the CPU, where the windows are cut
        return TrainBatch(batch.counts, batch.depth_m, batch.valid, torch.tensor(starts))

    def _labels(self, patch: Patch, side: int) -> np.ndarray:
        rows, columns = slice(patch.row, patch.row + side), slice(patch.column, patch.column + side)
        depth = self.packed.depth_m[patch.scene, rows, columns]
        return depth[depth < self.config.model.sensor.recorded_range_m]


class SetData(pl.LightningDataModule):
    """Loaders over training and validation sets; `workers` processes sense ahead (0: in this one).

    Validation frames are shared out evenly over the validation sets. With `sense_on` = "device" training batches cross
    to the device as requests and are sensed there.
    """

    def __init__(
        self,
        training: Sequence[PackedViews],
        validation: Sequence[PackedViews],
        config: TrainConfig,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.training, self.validation, self.config, self.workers = training, validation, config, workers
        self.sensing: DeviceSensing | None = None
        Samples(training, config, 0)
        warn_of_unlabelled(training, config)
        views = -(-config.validation_views // len(validation))
        self.frames = [Frames(packed, config, views, source) for source, packed in enumerate(validation)]

    def train_dataloader(self) -> DataLoader:
        # made anew each epoch (`reload_dataloaders_every_n_epochs`), which decides the samples
        epoch = 0 if self.trainer is None else self.trainer.current_epoch
        config = self.config
        # at least the last epoch, which is more than a tenth of a short run
        late = epoch >= min(round((1 - FULL_LENGTH_FRACTION) * config.epochs), config.epochs - 1)
        window = 0 if late else config.window
        size = (config.crop, config.crop)
        return self._loader(Samples(self.training, config, epoch), self.training, config.batch, size, window)

    def transfer_batch_to_device(
        self, batch: TrainBatch | Requests, device: torch.device, dataloader_idx: int
    ) -> TrainBatch:
        """Move a sensed batch to the device, or sense there one that is only asked for."""
        if not isinstance(batch, Requests):
            return super().transfer_batch_to_device(batch, device, dataloader_idx)
        if self.sensing is None:
            self.sensing = DeviceSensing(self.training, self.config, device)
        return self.sensing.sense(batch)

    def val_dataloader(self) -> list[DataLoader]:
        return [self._loader(frames, self.validation, 1, frames.size, 0) for frames in self.frames]

    def _loader(
        self, samples: Dataset, sets: Sequence[PackedViews], batch: int, size: tuple[int, int], window: int
    ) -> DataLoader:
        collate = partial(sensed_batch, sets, self.config.model.sensor, size, window)
        if isinstance(samples, Samples) and self.config.sense_on == "device":
            return DataLoader(samples, batch_size=batch, collate_fn=partial(_asked, window))
        return DataLoader(
            samples,
            batch_size=batch,
            num_workers=self.workers,
            collate_fn=collate,
            pin_memory=torch.cuda.is_available(),
        )
