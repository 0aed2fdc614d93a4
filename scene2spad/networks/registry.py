"""Trained models as studies ask for them: found in a folder of runs or in the package, or trained; checked, loaded."""

from __future__ import annotations

import csv
import hashlib
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import torch

from csph.codes.design import Design
from csph.evaluation.methods import DepthEstimator
from csph.networks.checkpoint import load_model, weights_sha256
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from csph.weights.shipped import WEIGHTS, file_names, is_shipped, is_unfinished, ship, shipped_file
from scene2spad.networks.training import config_of, run_train
from scene2spad.options.networks import PLANES, Train, TrainingPreset
from scenes.errors import require
from scenes.progress import Progress

log = logging.getLogger("scene2spad")

TDC_SENSOR = "reference-tdc"
FINE_TUNE_STEPS, FINE_TUNE_RATE = 600, 5e-4


@dataclass(frozen=True)
class ModelSpec:
    """A model that a study needs: everything that its conclusions hang on, as `train` takes it.

    design         as of `train`, none and peak among them (block and compression then mean nothing)
    time_offset_m  random delays in training, 0 as published
    trained_on     rooms: direct light in rooms, the recipe of the offset study; mixed: rooms and clutter with indirect
                   light as well, levels over their whole range; published: rooms and clutter on the published grid, for
                   comparison with the paper
    int8           trained for the chip (`--layer int8`), beginning with `plain`
    tdc            trained further behind the real converters of `TDC_SENSOR`, beginning with `plain`
    """

    design: str = "learned"
    block: tuple[int, int, int] = (256, 4, 4)
    compression: int = 128
    seed: int = 0
    time_offset_m: float = 0.0
    full: bool = False
    trained_on: Literal["rooms", "mixed", "published"] = "rooms"
    int8: bool = False
    tdc: bool = False

    @property
    def plain(self) -> ModelSpec:
        """Return the same model in floating point, behind a perfect clock."""
        return replace(self, int8=False, tdc=False)

    @property
    def begun(self) -> bool:
        """Return whether its training begins with `plain`."""
        return self.int8 or self.tdc

    @property
    def coded(self) -> bool:
        return self.design not in ("none", "peak")

    @property
    def label(self) -> str:
        """Without compression and seed: what a line in a figure is called."""
        mixed = {"rooms": "", "mixed": ", mixed training", "published": ", published grid"}[self.trained_on]
        if not self.coded:
            return {"none": "no compression", "peak": "peak"}[self.design] + mixed
        sort = f"{'full ' if self.full else ''}{self.design}"
        moved = f", trained with offsets to {self.time_offset_m:g} m" if self.time_offset_m else ""
        chip = ", trained for the chip" if self.int8 else ", trained with the clock" if self.tdc else ""
        return f"{sort} {'x'.join(map(str, self.block))}{moved}{mixed}{chip}"

    @property
    def name(self) -> str:
        """Return the name of the run's folder and of the shipped one: learned-1024x4x4-128x-s0, none-mixed-s0,
        ...-t8-s0."""
        parts = [f"{'full-' if self.full else ''}{self.design.replace('+', '-')}"]
        if self.coded:
            parts += ["x".join(map(str, self.block)), f"{self.compression}x"]
        if self.time_offset_m:
            parts.append(f"t{self.time_offset_m:g}")
        if self.trained_on != "rooms":
            parts.append(self.trained_on)
        if self.int8:
            parts.append("int8")
        if self.tdc:
            parts.append("tdc")
        return "-".join([*parts, f"s{self.seed}"])

    def command(self, preset: TrainingPreset, training: Path, folder: Path) -> Train:
        """Return the `train` command that makes it in `folder/name`."""
        begun = folder / self.plain.name
        return Train(
            design=self.design,
            block=self.block if self.coded else Train.block,
            compression=self.compression if self.coded else None,
            full=self.full,
            network=None if preset == "paper" else "compact",  # one for all designs, which studies compare
            layer=("int8",) if self.int8 else (),
            init=(str(begun) if begun.is_dir() else begun.name) if self.begun else None,
            sensor=TDC_SENSOR if self.tdc else "reference",
            rate=FINE_TUNE_RATE if self.tdc else None,
            steps=FINE_TUNE_STEPS if self.tdc and preset != "smoke" else None,
            preset=preset,
            seed=self.seed,
            time_offset=self.time_offset_m or None,
            set=(training,),
            out=folder / self.name,
        )

    def training_command(self, preset: str, training: Path, folder: Path) -> str:
        """Return the same as one types it."""
        coded = f" --block {' '.join(map(str, self.block))} --compression {self.compression}" if self.coded else ""
        more = f"{' --full' if self.full else ''}"
        more += f" --time-offset {self.time_offset_m:g}" if self.time_offset_m else ""
        more += " --layer int8" if self.int8 else ""
        more += f" --init {self.plain.name}" if self.begun else ""
        tuned = f" --sensor {TDC_SENSOR} --rate {FINE_TUNE_RATE:g} --steps {FINE_TUNE_STEPS}"
        more += tuned if self.tdc else ""
        more += "" if preset == "paper" else " --network compact"
        made = f"--preset {preset} --seed {self.seed} --set {training} --out {folder / self.name}"
        return f"scene2spad train --design {self.design}{coded}{more} {made}"


class EvaluatedModel(NamedTuple):
    """A model to be evaluated, or what stands for one, under a name of its own."""

    name: str
    model: DepthEstimator
    digest: str


def subject_of(name: str, model: DepthModel) -> EvaluatedModel:
    """Return a model under a name, with the digest that its results are kept by: of its weights and its decoder, since
    the same weights read by another decoder give other results."""
    digest = f"{weights_sha256(model)} {model.config.decoder}"
    return EvaluatedModel(name, model, hashlib.sha256(digest.encode()).hexdigest())


@dataclass(frozen=True, eq=False)
class Trained:
    """A model that was found or made, and where."""

    wanted: ModelSpec
    model: DepthModel
    config: TrainConfig
    state: dict
    path: Path

    @cached_property
    def digest(self) -> str:
        return weights_sha256(self.model)

    @cached_property
    def subject(self) -> EvaluatedModel:
        return subject_of(self.wanted.name, self.model)

    @property
    def shipped(self) -> bool:
        return is_shipped(self.path)

    def table(self, kind: str) -> list[dict[str, float]]:
        """Return `log.csv` or `energy.csv` of its training; empty where there is none."""
        path = self.path.with_name(kind)
        if not path.is_file():
            return []
        with path.open(newline="") as lines:
            return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(lines)]

    def described(self) -> dict[str, object]:
        return {
            "name": self.wanted.name,
            "model": self.config.model.name,
            "preset": self.config.preset,
            "steps": self.config.steps,
            "kept_step": self.state.get("step"),
            "val_rmse_mm": self.state.get("val_rmse_mm"),
            "trained_on": file_names(self.config.data.get("training", "")),
            "shipped": self.shipped,
            "sha256": self.digest,
        }


def check(config: TrainConfig, wanted: ModelSpec, path: Path) -> None:
    """Raise InputError in one line for a checkpoint that is not what is wanted: other design, seed, sensor, time
    offsets.

    Models to compare with the paper are each trained by a recipe of its own: some were begun with a run of another
    seed, and some keep the mean over their codes. Periodic networks all keep it.
    """
    expected = config_of(wanted.command("laptop", PLANES, Path()))
    pairs = {
        "random time offsets [m]": (config.time_offset_m, wanted.time_offset_m),
        "seed": (config.seed, wanted.seed),
        "front": (config.model.front, expected.model.front),
        "design": (_design_name(config.model.design), _design_name(expected.model.design)),
        "layer": (config.model.layer, expected.model.layer),
        "grid": (config.model.grid, "published" if wanted.trained_on == "published" else "continuous"),
        "sensor": (_sensor(config.model), _sensor(expected.model)),
    }
    if wanted.trained_on == "published":
        del pairs["seed"]
    if wanted.trained_on == "published" or config.model.network == "periodic":
        del pairs["layer"]
    wrong = [f"{what} {has}, expected {should}" for what, (has, should) in pairs.items() if has != should]
    require(not wrong, f"{path}: is not the model {wanted.name}: {'; '.join(wrong)}")


def _design_name(design: Design | None) -> str:
    return "none" if design is None else f"{design.name}{'' if design.zero_mean else ' without zero mean'}"


def _sensor(model: ModelConfig) -> str:
    sensor = model.sensor
    clock = "" if sensor.tdc is None else f", {sensor.tdc}"
    return f"{sensor.bins} bins of {sensor.bin_width_s * 1e12:.4g} ps, {sensor.response}{clock}"


@dataclass(frozen=True)
class ModelRegistry:
    """Registry of trained models: `folder/NAME` as `train --out` fills it, then those that come with the package
    (`shipped`; None: not there)."""

    folder: Path
    shipped: Path | None = WEIGHTS

    def find(self, wanted: ModelSpec) -> Trained | None:
        """Return the model if it is there and its training came to its end. Raises InputError for another under its
        name."""
        run = self._run_of(wanted)
        if run.is_file():
            found = _loaded(wanted, run)
            if _finished(found):
                return found
            log.warning("%s: its training has not come to its end; left out", run.parent)
            return None
        packaged = self._packaged(wanted)
        return None if packaged is None else _loaded(wanted, packaged)

    def has(self, wanted: ModelSpec) -> bool:
        """Return whether `find` returns a model; those of the package are not loaded for it. Raises InputError as
        `find` does."""
        if self._run_of(wanted).is_file():
            return self.find(wanted) is not None
        return self._packaged(wanted) is not None

    def _run_of(self, wanted: ModelSpec) -> Path:
        return self.folder / wanted.name / "model.safetensors"

    def _packaged(self, wanted: ModelSpec) -> Path | None:
        path = None if self.shipped is None else shipped_file(wanted.name, self.shipped)
        return path if path is not None and path.is_file() else None

    def gather(self, wanted: Sequence[ModelSpec]) -> dict[ModelSpec, Trained]:
        """Return those that are there, in the order asked for."""
        found = {one: self.find(one) for one in wanted}
        return {one: model for one, model in found.items() if model is not None}

    def train(self, wanted: Sequence[ModelSpec], preset: TrainingPreset, training: Path, progress: Progress) -> None:
        """Train what is not finished in the folder; interrupted runs go on. Says how long it takes."""
        todo = [one for one in wanted if self.find(one) is None]
        start = time.perf_counter()
        for number, one in enumerate(todo):
            command = one.command(preset, training, self.folder)
            steps = config_of(command).steps
            log.info("model %d of %d: %s, %d steps", number + 1, len(todo), one.name, steps)
            result = run_train(command, _share(progress, one.name, number, len(todo)))
            taken = time.perf_counter() - start
            rest = taken / (number + 1) * (len(todo) - number - 1)
            message = "%s: validation RMSE %.1f mm; %.0f s so far, about %.0f s to go"
            log.info(message, one.name, result["val_rmse_mm"], taken, rest)


def _share(progress: Progress, name: str, number: int, of: int) -> Progress:
    return lambda what, fraction: progress(f"{name}: {what}", (number + fraction) / of)


def _loaded(wanted: ModelSpec, path: Path) -> Trained:
    model, config, state = load_model(path)
    check(config, wanted, path)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return Trained(wanted, model.to(device), config, state, path)


def _finished(found: Trained) -> bool:
    """Return whether a run came to its end; one that was killed between its log and its last weights did not."""
    if is_unfinished(found.path):
        return False
    if found.path.with_name("last.safetensors").is_file():
        return True
    rows = found.table("log.csv")
    return bool(rows) and rows[-1]["step"] >= found.config.steps


def ship_all(models: Sequence[Trained], folder: Path = WEIGHTS) -> list[str]:
    """Put models into the package in half precision; those that came from there stay. Returns the files."""
    return [str(ship(one.path.parent, one.wanted.name, folder)) for one in models if not one.shipped]
