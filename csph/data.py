"""Training data: patches of a rendered set, sensed on the fly, photon level, crop and noise new for every sample.

A sample is told apart by (seed, epoch, number), never by worker, so that the same run gives the same patches whatever
the number of workers, and one that goes on after an interruption the patches that it would have seen.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader, Dataset

from csph.config import TrainConfig
from render.transient import Transient
from scenes.errors import InputError, require
from spad.fly import Batch, PackedTransients, Patch, pack, sense_patches
from spad.sensor import Sensor

STAGE_TRAIN, STAGE_VALIDATE = 31, 32
VALIDATION_SHARE = 0.1  # of a set's scenes, its last, where no validation set is given


class Views(NamedTuple):
    """Views of a rendered set and the names of the scenes that they show."""

    transients: tuple[Transient, ...]
    scenes: tuple[str, ...]


def read_views(path: Path) -> Views:
    """All views of a pack (.h5), or of the folder that `scene2spad dataset` filled.

    Raises InputError in one line for anything else, an empty set, and a laser that is not at the camera.
    """
    path = Path(path)
    if path.is_dir():
        transients, scenes = _from_folder(path)
    else:
        from render.pack import read_pack

        packed = read_pack(path)
        transients, scenes = list(packed), [_scene(meta, i) for i, meta in enumerate(packed.metas)]
    require(bool(transients), f"{path}: the set is empty")
    for transient, scene in zip(transients, scenes, strict=True):
        displaced = any(transient.meta.get("laser", {}).get("baseline_m", (0, 0, 0)))
        require(not displaced, f"{path}: the laser of {scene} is not at the camera, its path is not twice the depth")
    return Views(tuple(transients), tuple(scenes))


def _from_folder(path: Path) -> tuple[list[Transient], list[str]]:
    import json

    from render.transient import read_transient

    index = path / "index.jsonl"
    require(index.is_file(), f"{path}: no set of scene2spad (no index.jsonl); make one with scene2spad dataset")
    try:
        records = [json.loads(line) for line in index.read_text().splitlines()]
        good = [record for record in records if "failed" not in record]
        files = [record["file"] for record in good]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{index}: is damaged; run scene2spad dataset again") from None
    return [read_transient(path / file) for file in files], [_scene(record, i) for i, record in enumerate(good)]


def _scene(meta: dict, number: int) -> str:
    return str(meta.get("scene", number))


def split_views(views: Views, share: float = VALIDATION_SHARE) -> tuple[Views, Views]:
    """Training and validation views of different scenes: the last scenes are validation's. InputError for one scene."""
    names = list(dict.fromkeys(views.scenes))
    require(len(names) >= 2, f"a set of one scene ({names[0]}) has none left to validate on; give a validation set")
    held = set(names[-max(1, round(share * len(names))) :])
    parts = []
    for wanted in (False, True):
        kept = [i for i, name in enumerate(views.scenes) if (name in held) == wanted]
        parts.append(Views(tuple(views.transients[i] for i in kept), tuple(views.scenes[i] for i in kept)))
    return parts[0], parts[1]


def packed_sha256(packed: PackedTransients) -> str:
    """SHA-256 over what is sensed: a run that goes on must go on with the same set."""
    sha = hashlib.sha256(str(packed.depth_m.shape).encode())
    for name in ("offsets", "path_near_m", "path_far_m", "radiance", "depth_m", "ambient", "mixed"):
        sha.update(np.ascontiguousarray(getattr(packed, name)).tobytes())
    return sha.hexdigest()


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


def packed_views(views: Views) -> PackedTransients:
    """One packed set; InputError where views are of different sizes."""
    return pack(views.transients)
