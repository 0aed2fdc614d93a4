"""Training by Lightning: a run is a folder with one configuration, a log, the best weights, and what it resumes from.

    config.json         every number of the run, written before its first step
    log.csv             one row an epoch: step, learning rate, training loss, validation RMSE and MAE by both decoders,
                        participation rank of spatial codes
    model.safetensors   the weights that are kept, with the configuration in the header: those of the last epoch with
                        one cosine, whose rate ends near 0; else those of the lowest validation RMSE
    timings.jsonl       seconds of each epoch
    energy.csv          energy of a learned temporal code by groups of time bins, now and then from the start on
    last.safetensors    weights after the last step
    training-views.txt  short hashes of the views that it is trained on, by which `evaluate` knows them again
    training-scenes.txt  of what tells their scenes: other views of them are known, too
    ancestor-views.txt, ancestor-scenes.txt  those of the models that it began with, where they are known
    codes.npy           a copy of the file of own codes, where there is one
    resume.ckpt         Lightning's state after the last finished epoch: a run that was killed goes on from there

A run is on one device (`csph.training.hardware`). Its device and precision are Lightning's.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytorch_lightning as pl
import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric

from csph.codes.rank import coherence, participation_rank
from csph.codes.tensor import CodingTensor
from csph.networks.checkpoint import load_model, save_model, weights_sha256
from csph.networks.config import TrainConfig
from csph.networks.grid import on_published_grid, published_target
from csph.networks.model import DepthModel
from csph.networks.posterior import DECODERS
from csph.networks.published import soft_argmax
from csph.training.beginning import Beginning, NetworkOf, check_init, what_is_known
from csph.training.data import SetData, TrainBatch
from csph.training.hardware import ANY_HARDWARE, Hardware, fit, trainer_on
from csph.training.lineage import write_seen
from csph.training.loss import decoded_error, kl_divergence, total_variation
from csph.training.optimiser import make_optimiser
from csph.training.own_codes import own_codes_of
from csph.training.resume import check_resume, claim_run
from csph.training.schedule import rate_factor
from csph.training.snapshots import CodeEnergy
from csph.training.views import Views, check_direct, check_light, check_names, packed_sha256, path_of
from csph.weights.shipped import RESUME, TIMINGS
from render.backend.malloc import retain_freed_memory
from scenes.errors import require, require_kind
from scenes.files import append_line, write_csv
from scenes.json_types import JsonObject
from scenes.progress import Progress
from spad.detection.training_patches import PackedViews, pack_views

log = logging.getLogger("csph")

EXCESS_WEIGHT = 10.0  # of sums beyond 16 bits


def _strict_mean() -> MeanMetric:
    """Make a mean that is NaN where a value is: by default those are left out, and a warning is all that is said."""
    return MeanMetric(nan_strategy=math.nan)


def _mean(means: nn.ModuleDict, decoder: str) -> MeanMetric:
    found = means[decoder]
    assert isinstance(found, MeanMetric)
    return found


class DepthTraining(pl.LightningModule):
    """KL divergence to the pulse at the label, plus total variation and coherence where asked; Adam or Muon, and an
    average of the weights where asked."""

    def __init__(self, config: TrainConfig, init: Beginning | None = None, own: CodingTensor | None = None) -> None:
        super().__init__()
        self.config = config
        self.model = DepthModel(config.model, config.seed, own=own)
        if isinstance(init, NetworkOf):
            self.model.begin_with_network(init.model)
        elif init is not None:
            self.model.begin_with(what_is_known(init).model)
        self.averaged: DepthModel | None = None
        # a plain list: no part of the state, since a run that goes on begins with the same model
        self.begun = [part.detach().clone() for part in self.model.parameters()] if config.init_share else []
        if config.average:  # a module of its own: Lightning's checkpoint then holds it
            self.averaged = deepcopy(self.model).requires_grad_(False).eval()
        self.train_loss = _strict_mean()
        self.squared_m2 = nn.ModuleDict({name: _strict_mean() for name in DECODERS})
        self.absolute_m = nn.ModuleDict({name: _strict_mean() for name in DECODERS})

    @property
    def kept(self) -> DepthModel:
        """Return the model that is validated and kept: the one with averaged weights where there is one, else the
        trained one."""
        return self.model if self.averaged is None else self.averaged

    def loss(self, batch: TrainBatch) -> Tensor:
        config, sensor, depth = self.config, self.config.model.sensor, batch.depth_m
        if config.model.grid == "published":
            depth = published_target(depth, sensor)
        if config.window and bool((batch.first_bin >= 0).all()):
            logits = self.model.windowed(batch.counts, batch.first_bin, config.window)
            depth = depth - batch.first_bin.to(depth.device).view(-1, 1, 1) * sensor.bin_depth_m
            valid = batch.valid & (depth >= 0) & (depth < config.window * sensor.bin_depth_m)
            # gated: what of the pulse falls outside the window is left out
            sensor = replace(sensor, bins=config.window, pulse=sensor.response, jitter=None, tdc=None)
        else:
            logits, valid = self.model(batch.counts), batch.valid
        loss = kl_divergence(logits, depth, valid, sensor)
        if config.tv_weight and self.global_step >= config.tv_start:
            loss = loss + config.tv_weight * total_variation(soft_argmax(logits) / config.model.sensor.bins)
        if config.decoded_weight:
            loss = loss + config.decoded_weight * decoded_error(logits, depth / sensor.bin_depth_m, valid)
        layer = self.model.layer
        if config.coherence and layer is not None:
            loss = loss + config.coherence * coherence(layer.pixel_gram())
        if layer is not None and layer.options.int8:
            loss = loss + EXCESS_WEIGHT * layer.sum_excess(batch.counts)
        return loss

    def training_step(self, batch: TrainBatch, _: int) -> Tensor:
        loss = self.loss(batch)
        self.train_loss.update(loss.detach())
        return loss

    def optimizer_step(self, *args: object, **more: object) -> None:
        super().optimizer_step(*args, **more)
        if self.averaged is not None:
            # the first steps are forgotten sooner
            past = min(self.config.average, (1 + self.global_step) / (10 + self.global_step))
            with torch.no_grad():
                torch._foreach_lerp_(list(self.averaged.parameters()), list(self.model.parameters()), 1 - past)

    def on_train_batch_end(self, *_: object) -> None:
        if self.begun and self.global_step == self.config.steps:
            kept: list[Tensor] = list(self.kept.parameters())
            begun = [part.to(self.device) for part in self.begun]
            with torch.no_grad():
                torch._foreach_lerp_(kept, begun, self.config.init_share)

    def validation_step(self, batch: TrainBatch, _: int, dataloader_idx: int = 0) -> None:
        logits = self.kept(batch.counts)
        # pixels without a truth have weight 0
        weight = batch.valid.float()
        for decoder in DECODERS:
            depth = self.kept.position(logits, decoder) * self.config.model.sensor.bin_depth_m
            error = torch.where(batch.valid, depth - batch.depth_m, 0.0)
            _mean(self.squared_m2, decoder).update(error**2, weight)
            _mean(self.absolute_m, decoder).update(error.abs(), weight)

    def configure_optimizers(self) -> dict[str, object]:
        optimiser = make_optimiser(self.model, self.config)
        # a function of the step alone: nothing about it has to be restored
        steps = torch.optim.lr_scheduler.LambdaLR(optimiser, partial(rate_factor, config=self.config))
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": steps, "interval": "step"}}


class Record(pl.Callback):
    """At the end of each epoch: a row of the log, the weights that are kept, and what to resume from."""

    def __init__(self, folder: Path, progress: Progress) -> None:
        self.folder, self.progress = folder, progress
        self.rows: list[dict[str, float]] = []
        self.noted = (time.perf_counter(), time.process_time())

    def _note_time(self, epoch: int) -> None:
        """Append an epoch's seconds, for whom results are not to depend on."""
        now = (time.perf_counter(), time.process_time())
        wall, cpu = (round(end - start, 3) for end, start in zip(now, self.noted, strict=True))
        self.noted = now
        append_line(self.folder / TIMINGS, json.dumps({"epoch": epoch, "wall_s": wall, "cpu_s": cpu}))

    @property
    def best_mm(self) -> float:
        errors = (row["val_rmse_mm"] for row in self.rows)
        return min((error for error in errors if not math.isnan(error)), default=math.inf)

    def state_dict(self) -> dict[str, list[dict[str, float]]]:
        return {"rows": self.rows}

    def load_state_dict(self, state: dict[str, list[dict[str, float]]]) -> None:
        self.rows = state["rows"]

    def on_train_batch_end(self, trainer: pl.Trainer, module: DepthTraining, *_: object) -> None:
        step = trainer.global_step
        self.progress(f"step {step} of {module.config.steps}", step / module.config.steps)

    def on_train_epoch_end(self, trainer: pl.Trainer, module: DepthTraining) -> None:
        best = self.best_mm
        row = {
            "epoch": trainer.current_epoch + 1,
            "step": trainer.global_step,
            "rate": trainer.optimizers[0].param_groups[0]["lr"],
            "train_loss": float(module.train_loss.compute()),
            **_validation_mm(module),
        }
        layer = module.kept.layer
        if layer is not None and math.prod(layer.block[1:]) > 1:
            row["spatial_rank"] = participation_rank(layer.pixel_gram().detach())
        means = (module.squared_m2, module.absolute_m)
        for metric in (module.train_loss, *(_mean(mean, name) for mean in means for name in DECODERS)):
            metric.reset()
        _check_finite(module, row, self.folder)
        self.rows = [*self.rows, row]
        if trainer.is_global_zero:
            # the hardest photon levels rule the RMSE of a few frames, and hide what the end of a cosine gains elsewhere
            better = module.config.schedule == "cosine" or row["val_rmse_mm"] < best
            if better or not (self.folder / "model.safetensors").is_file():
                save_model(module.kept, module.config, row, self.folder / "model.safetensors")
            write_csv(self.rows, self.folder / "log.csv")
            log.info(
                "step %d of %d: loss %.4f, validation RMSE %.1f mm, MAE %.1f mm",
                *(row["step"], module.config.steps, row["train_loss"], row["val_rmse_mm"], row["val_mae_mm"]),
            )
        if trainer.is_global_zero:
            self._note_time(trainer.current_epoch + 1)
        trainer.save_checkpoint(self.folder / RESUME)  # on all devices


def _validation_mm(module: DepthTraining) -> dict[str, float]:
    """Compute the validation RMSE and MAE [mm] as the model is decoded, and by each decoder."""
    squared, absolute = module.squared_m2, module.absolute_m
    errors = {
        name: (float(_mean(squared, name).compute()) ** 0.5 * 1e3, float(_mean(absolute, name).compute()) * 1e3)
        for name in DECODERS
    }
    own = errors[module.config.model.decoder]
    return {
        "val_rmse_mm": own[0],
        "val_mae_mm": own[1],
        **{f"val_mae_mm_{name}": absolute for name, (_, absolute) in errors.items()},
    }


def _check_finite(module: DepthTraining, row: Mapping[str, float], folder: Path) -> None:
    """Raise InputError for an epoch that diverged, before it takes the place of the last good one.

    In 16 bits a loss may overflow: the step is left out, and the run goes on.
    """
    names = ("val_rmse_mm",) if module.config.precision == "16-mixed" else ("train_loss", "val_rmse_mm")
    weights = [*module.model.parameters(), *module.kept.parameters()]
    finite = all(math.isfinite(row[name]) for name in names) and all(bool(part.isfinite().all()) for part in weights)
    last = f"what it was after epoch {row['epoch'] - 1} is kept" if row["epoch"] > 1 else "nothing is kept"
    found = f"training loss {row['train_loss']:.4g}, validation RMSE {row['val_rmse_mm']:.4g} mm"
    require(finite, f"{folder}: the run diverged in epoch {row['epoch']:g} ({found}), {last}; use a lower --rate")


def _check_kept(folder: Path, rows: Sequence[dict[str, float]], kept: Mapping[str, float]) -> None:
    """Raise InputError for a run that diverged; say where an epoch's validation RMSE was lower than that of the weights
    kept, which with one cosine are the last."""
    diverged = f"{folder}: the run diverged, its validation error is no number; use a lower --rate"
    require(math.isfinite(kept["val_rmse_mm"]), diverged)
    better = [row for row in rows if row["val_rmse_mm"] < kept["val_rmse_mm"]]
    if better:
        best = min(better, key=lambda row: row["val_rmse_mm"])
        message = "the weights kept are of step %d, with a validation RMSE of %.1f mm; step %d had %.1f mm"
        log.warning(message, kept["step"], kept["val_rmse_mm"], best["step"], best["val_rmse_mm"])


def _listed(views: Views | Sequence[Views], which: str) -> list[Views]:
    """Return one set or several as a list. Raises InputError for none, sets without a view, and other objects."""
    several = [views] if isinstance(views, Views) else views
    good = isinstance(several, list | tuple) and len(several) > 0
    require(good, f"train: {which} {several!r}, expected Views of one set or a list of several (`read_views`)")
    for one in several:
        require_kind(one, Views, f"train: {which}", " of `read_views`")
        check_names(one, f"train: {which}")
        require(len(one.transients) > 0, f"train: {which}: a set has no view")
    return list(several)


def _with_hashes(config: TrainConfig, sets: Sequence[Sequence[PackedViews]], init: Beginning | None) -> TrainConfig:
    """Return the configuration with the SHA-256 of its sets and of the weights it begins with: a run that goes on must
    have begun with the same. Beside them what those weights were trained on, as far as it is known."""
    data: JsonObject = {}
    for name, packs in zip(("training", "validation"), sets, strict=True):
        hashes = [packed_sha256(packed) for packed in packs]
        data[f"{name}_sha256"] = hashes[0] if len(hashes) == 1 else hashes
    if init is not None:
        data["init_sha256"] = weights_sha256(what_is_known(init).model)
        data["ancestors"] = [*what_is_known(init).ancestors] or [{"sha256": data["init_sha256"]}]
    return replace(config, data={**config.data, **data})


def train(
    config: TrainConfig,
    training: Views | Sequence[Views],
    validation: Views | Sequence[Views],
    folder: Path,
    *,
    init: Beginning | None = None,
    hardware: Hardware = ANY_HARDWARE,
    progress: Progress | None = None,
) -> JsonObject:
    """Run a configuration to its end in a folder, or go on where an interrupted run of the same configuration stopped.

    Sets are one or several; patches are drawn from the training sets by `config.weights`. `init` is a trained model of
    the same design to begin with (`WeightsOf`: with what it was trained on), or `NetworkOf` one of any design on the
    same sensor, whose codes begin anew. A run is on one device: where photons are drawn, and
    how sums are rounded, depends on it. Nothing else of `hardware` changes a result.
    Returns steps, seconds (of this call), val_rmse_mm of the weights kept, their checkpoint, and the number of
    parameters. Raises InputError for no set, sets or an `init` that do not fit, indirect light on the published grid,
    and another run's folder. `help(csph)` has an example.
    """
    require_kind(config, TrainConfig, "train", " of `preset`")
    given = [_listed(training, "training"), _listed(validation, "validation")]
    folder = path_of(folder, "train: folder")
    config.check_memory()
    check_init(init, config)
    sets = [[pack_views(one.transients) for one in some] for some in given]
    config = _with_hashes(config, sets, init)
    if config.model.grid == "published":
        check_direct([*given[0], *given[1]])
        sets = [[on_published_grid(packed, config.model.sensor) for packed in packs] for packs in sets]
    check_light(given, sets, config.model.sensor)
    module_data = SetData(sets[0], sets[1], config, hardware.workers)
    record = Record(folder, progress or (lambda what, fraction: None))
    runner = trainer_on(hardware, config, [CodeEnergy(folder), record])
    module = DepthTraining(config, init, own_codes_of(config, folder))
    claim_run(folder, config)  # once the model is known to be possible
    write_seen(folder, given[0], init)
    if config.threads:
        torch.set_num_threads(config.threads)
    retain_freed_memory()
    start = time.perf_counter()
    resume = folder / RESUME
    if resume.is_file():
        check_resume(resume, module)
    if not (folder / "last.safetensors").is_file():
        fit(runner, module, module_data, resume)
        save_model(module.kept, config, record.rows[-1], folder / "last.safetensors")
    kept, last = (load_model(path)[2] for path in (folder, folder / "last.safetensors"))
    _check_kept(folder, record.rows, kept)
    return {
        "steps": last["step"],
        "seconds": time.perf_counter() - start,
        "val_rmse_mm": kept["val_rmse_mm"],
        "val_mae_mm": kept["val_mae_mm"],
        "kept_step": kept["step"],
        "checkpoint": str(folder / "model.safetensors"),
        "parameters": module.model.parameters_count,
    }
