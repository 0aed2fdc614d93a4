"""Training data: patches of a rendered set, sensed on the fly, photon level, crop and noise new for every sample.

A sample is told apart by (seed, epoch, number), never by worker, so that the same run gives the same patches whatever
the number of workers, and one that goes on after an interruption the patches that it would have seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader, Dataset

from csph.config import TrainConfig
from scenes.errors import require
from spad.fly import Batch, PackedTransients, Patch, sense_patches
from spad.sensor import Sensor

STAGE_TRAIN, STAGE_VALIDATE = 31, 32


class Samples(Dataset):
    """Requests for the patches of one epoch; drawing one is cheap, `sense` of a batch is the work."""

    def __init__(self, packed: PackedTransients, config: TrainConfig, epoch: int) -> None:
        self.shape, self.config, self.epoch = packed.depth_m.shape, config, epoch
        most = min(self.shape[1:])
        require(config.crop <= most, f"crops of {config.crop} pixels do not fit views of {most}")

    def __len__(self) -> int:
        return self.config.steps_per_epoch * self.config.batch

    def __getitem__(self, number: int) -> Patch:
        config, (scenes, rows, columns) = self.config, self.shape
        key = (config.seed, self.epoch, number)
        rng = np.random.default_rng(np.random.SeedSequence(key, spawn_key=(STAGE_TRAIN,)))
        signal, background = config.levels[rng.integers(len(config.levels))]
        return Patch(
            scene=int(rng.integers(scenes)),
            row=int(rng.integers(rows - config.crop + 1)),
            column=int(rng.integers(columns - config.crop + 1)),
            signal=signal,
            background=background,
            seed=key,
            time_offset_m=config.time_offset_m * float(rng.random()),
        )


class Frames(Dataset):
    """Whole validation frames, as far as blocks tile them: view after view, each at one level, levels in turn."""

    def __init__(self, packed: PackedTransients, config: TrainConfig) -> None:
        scenes, rows, columns = packed.depth_m.shape
        _, height, width = config.model.block
        self.size = (rows // height * height, columns // width * width)
        fits = min(self.size) > 0
        require(fits, f"validation views of {columns} x {rows} pixels are smaller than a block of {width} x {height}")
        # spread over the scenes, so that a few views are not all of the first
        count = min(config.validation_views, scenes * len(config.levels))
        self.chosen = [round(i * scenes * len(config.levels) / count) for i in range(count)]
        self.config, self.scenes = config, scenes

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, number: int) -> Patch:
        scene, turn = divmod(self.chosen[number], len(self.config.levels))
        signal, background = self.config.levels[(number + turn) % len(self.config.levels)]
        return Patch(scene, 0, 0, signal, background, (self.config.seed, STAGE_VALIDATE, number))


def _sensed(packed: PackedTransients, sensor: Sensor, size: tuple[int, int], patches: Sequence[Patch]) -> Batch:
    return sense_patches(packed, sensor, patches, size=size)


class SetData(pl.LightningDataModule):
    """Loaders over a training and a validation set; `workers` processes sense ahead (0: in this one)."""

    def __init__(
        self, training: PackedTransients, validation: PackedTransients, config: TrainConfig, workers: int = 0
    ) -> None:
        super().__init__()
        self.training, self.validation, self.config, self.workers = training, validation, config, workers
        Samples(training, config, 0)
        self.frames = Frames(validation, config)

    def train_dataloader(self) -> DataLoader:
        # made anew each epoch (`reload_dataloaders_every_n_epochs`), which decides the samples
        epoch = 0 if self.trainer is None else self.trainer.current_epoch
        size = (self.config.crop, self.config.crop)
        return self._loader(Samples(self.training, self.config, epoch), self.training, self.config.batch, size)

    def val_dataloader(self) -> DataLoader:
        return self._loader(self.frames, self.validation, 1, self.frames.size)

    def _loader(self, samples: Dataset, packed: PackedTransients, batch: int, size: tuple[int, int]) -> DataLoader:
        collate = partial(_sensed, packed, self.config.model.sensor, size)
        return DataLoader(
            samples,
            batch_size=batch,
            num_workers=self.workers,
            collate_fn=collate,
            pin_memory=torch.cuda.is_available(),
        )
