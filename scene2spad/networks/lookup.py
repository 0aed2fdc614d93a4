"""The trained models of one study: found where its command says, or trained; the absent ones are told."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from csph.training.views import read_views, training_parts
from csph.weights.shipped import WEIGHTS
from scene2spad.networks.registry import ModelRegistry, ModelSpec, Trained
from scene2spad.networks.test_sets import rooms
from scene2spad.options.experiments import Study, trains_models
from scene2spad.options.networks import PLANES
from scenes.errors import InputError, require
from scenes.progress import Progress

OTHER_SEEDS = (1, 2)
log = logging.getLogger("scene2spad")


class ModelLookup(NamedTuple):
    """Models that are there, in the order asked for, and those that are not."""

    found: dict[ModelSpec, Trained]
    absent: list[ModelSpec]

    def described(self) -> dict[str, list]:
        return {
            "models": [one.described() for one in self.found.values()],
            "absent": [one.name for one in self.absent],
        }


def obtain(wanted: Sequence[ModelSpec], command: Study, progress: Progress) -> ModelLookup:
    """Return models of --models (else of --out), then of the package; with --retrain, and in `smoke`, all trained
    there.

    Absent ones are named, with the command that makes each. Raises InputError where none is found, for a model of
    another configuration under a wanted name, and for a finished one that is not what is to be trained.
    """
    folder, library = command.out / command.preset, _library(command)
    training = command.set or (PLANES if command.preset == "smoke" else None)
    found = library.gather(wanted)
    todo = [one for one in wanted if one not in found]
    if library.shipped is None:
        _check_as_asked(found.values(), command)
        if todo:
            training = training or rooms(folder / "sets", progress)
            library.train(todo, command.preset, training, progress)
            found = library.gather(wanted)
    if not found:
        message = f"holds none of the {len(wanted)} models, nor does the package; give --models FOLDER or --retrain"
        raise InputError(f"{library.folder}: {message}")
    absent = [one for one in wanted if one not in found]
    pack = training or Path("rooms.h5")
    if absent and training is None:
        log.warning("%s below: scene2spad dataset rooms --count 2000 --bounces 1 --pack %s", pack, pack)
    for one in absent:
        log.warning("absent: %s; made by: %s", one.name, one.training_command(command.preset, pack, library.folder))
    _warn_if_unlike(found.values())
    return ModelLookup(found, absent)


def found_only(wanted: Sequence[ModelSpec], command: Study) -> ModelLookup:
    """Return models of --models (else of --out), then of the package, for a study that trains none and can do without
    them.

    Absent ones are named in one line. Raises InputError for a model of another configuration under a wanted name.
    """
    found = ModelRegistry(models_folder(command)).gather(wanted)
    absent = [one for one in wanted if one not in found]
    if absent:
        log.warning("no trained %s: left out", ", ".join(one.name for one in absent))
    _warn_if_unlike(found.values())
    return ModelLookup(found, absent)


def models_folder(command: Study) -> Path:
    """Return the folder of runs that a study looks in before the package."""
    return command.models or command.out / command.preset / "models"


def other_seeds(wanted: Iterable[ModelSpec], command: Study) -> dict[ModelSpec, Trained]:
    """Look up the same models trained with OTHER_SEEDS. Missing ones are skipped, not trained or reported."""
    return where_trained([replace(one, seed=seed) for one in wanted for seed in OTHER_SEEDS], command)


def where_trained(wanted: Sequence[ModelSpec], command: Study) -> dict[ModelSpec, Trained]:
    """Look up models that a study can do without. Missing ones are skipped, not trained or reported."""
    return _library(command).gather(wanted)


def _library(command: Study) -> ModelRegistry:
    return ModelRegistry(models_folder(command), None if trains_models(command.name, command) else WEIGHTS)


def _check_as_asked(finished: Iterable[Trained], command: Study) -> None:
    """Raise InputError for a finished run of another preset than --retrain asks for, or of another set than --set."""
    parts: dict[str, int] | None = None
    for one in finished:
        run, preset = one.path.parent, one.config.preset
        asked = not command.retrain or preset == command.preset
        require(asked, f"{run}: was trained with --preset {preset}, not {command.preset}; give that, or other --models")
        if command.set in (None, PLANES):
            continue
        parts = parts or training_parts(read_views(command.set))
        same = str(one.config.data.get("training_sha256")) in parts
        require(same, f"{run}: was not trained on --set {command.set}; give its set, or other --models")


def _warn_if_unlike(found: Iterable[Trained]) -> None:
    """Say so where models are compared that were not trained alike."""
    kinds = set()
    for one in found:
        config, on = one.config, str(one.config.data.get("training_sha256", "unknown"))[:8]
        kinds.add(f"{config.preset}, {config.steps} steps, {config.model.network} network, set {on}")
    if len(kinds) > 1:
        log.warning("models of different trainings are compared: %s", "; ".join(sorted(kinds)))
