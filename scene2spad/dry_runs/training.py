"""Dry run of `train`: the run's configuration, and its cost from recorded epochs or from some steps on noise."""

from __future__ import annotations

import logging
from pathlib import Path
from statistics import median
from typing import NamedTuple

import torch

from csph.codes.tensor import CodingTensor
from csph.networks.config import COUNT_BYTES, TrainConfig
from csph.networks.model import DepthModel
from csph.training.own_codes import own_codes_of
from csph.training.resume import check_same, require_free
from csph.weights.shipped import TIMINGS
from scene2spad.datasets.workers import check_workers
from scene2spad.dry_runs.resources import Cost, memory, timed
from scene2spad.networks.level_warnings import level_warnings
from scene2spad.networks.training import begun_with, check_sets, config_of, folder_of
from scene2spad.options.networks import Train
from scenes.errors import require
from scenes.io.inputs import read_whole_lines

log = logging.getLogger("scene2spad")

PILOT_STEPS = 3


class Recorded(NamedTuple):
    """Epochs of a run that are done, and the median seconds of one."""

    epochs: int
    seconds: float


def dry_run(command: Train) -> dict:
    """Return configuration, memory and estimated seconds of a training, and what these are based on."""
    config = config_of(command)
    config.check_memory()
    require(bool(command.set), "train: --set without a set")
    check_workers(command.workers, least=0)
    check_sets(command, config.crop)
    begun_with(command, config)
    for warning in level_warnings(config):
        log.warning("%s", warning)
    folder = folder_of(command)
    require_free(folder)
    if (folder / "config.json").is_file():
        check_same(folder, config, sets=False)
    done, own = recorded_epochs(folder), own_codes_of(config, folder)
    if done is None:
        seconds, parameters = step_seconds(config, own)
        steps = config.steps
        basis = (
            f"{PILOT_STEPS} steps of this network on random counts, after one that is not counted: without drawing "
            "patches, reading sets, and validation"
        )
    else:
        seconds = done.seconds / config.steps_per_epoch
        parameters = DepthModel(config.model, own=own).parameters_count
        steps = max(config.epochs - done.epochs, 0) * config.steps_per_epoch
        basis = f"the recorded seconds of {done.epochs} epochs in this folder"
    return {
        "dry_run": True,
        "model": config.model.name,
        "parameters": parameters,
        "plan": plan_of(config),
        "sets": [str(path) for path in command.set],
        "steps_left": steps,
        "memory": memory(COUNT_BYTES * config.batch * config.crop**2 * config.model.sensor.bins),
        "estimate": {"seconds": seconds * steps, "seconds_per_step": seconds},
        "basis": basis,
        "out": str(folder),
    }


def plan_of(config: TrainConfig) -> dict:
    """Return what a run consists of, in the words of `config.json`."""
    names = (
        "preset",
        "epochs",
        "steps_per_epoch",
        "batch",
        "crop",
        "optimiser",
        "rate",
        "schedule",
        "window",
        "precision",
    )
    return {name: getattr(config, name) for name in names} | {"steps": config.steps}


def recorded_epochs(folder: Path) -> Recorded | None:
    """Return what a run's folder has recorded of its epochs; None where there is nothing."""
    found = {}
    for line in read_whole_lines(folder / TIMINGS):
        match line:
            case {"epoch": int(epoch), "wall_s": float(wall) | int(wall)}:
                found[epoch] = float(wall)
    return Recorded(max(found), median(found.values())) if found else None


def step_seconds(config: TrainConfig, own: CodingTensor | None = None) -> tuple[float, int]:
    """Return seconds of a training step on this machine, on random counts, and the number of parameters; `own` are the
    codes of a design of own codes."""
    from csph.training.data import TrainBatch
    from csph.training.loop import DepthTraining  # and Lightning, which takes seconds to import
    from csph.training.optimiser import make_optimiser

    if config.threads:
        torch.set_num_threads(config.threads)
    module, sensor = DepthTraining(config, own=own), config.model.sensor
    bins, shape = config.window or sensor.bins, (config.batch, config.crop, config.crop)
    random = torch.Generator().manual_seed(0)
    counts = torch.poisson(torch.full((shape[0], 1, bins, *shape[1:]), 0.1), generator=random)
    depth = torch.full(shape, 0.4 * bins * sensor.bin_depth_m)
    first = torch.full(shape[:1], 0 if config.window else -1)
    batch = TrainBatch(counts, depth, torch.ones(shape, dtype=torch.bool), first)
    optimiser = make_optimiser(module.model, config)

    def step() -> None:
        optimiser.zero_grad()
        module.loss(batch).backward()
        optimiser.step()

    costs: list[Cost] = [timed(step)[1] for _ in range(1 + PILOT_STEPS)]
    return median(cost.wall_s for cost in costs[1:]), module.model.parameters_count
