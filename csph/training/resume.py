"""Claim a run's folder, write the state of a run as a whole file, and check both before an interrupted run goes on."""

from __future__ import annotations

import io
import json
from pathlib import Path

import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import nn

from csph.networks.config import TrainConfig
from csph.training.own_codes import FILE, keep_codes
from csph.weights.torch_files import load_torch_file
from scenes.errors import InputError, require
from scenes.files import is_unclaimed, whole_file
from scenes.io.inputs import read_json_object
from scenes.json_types import JsonObject

KEYS = ("state_dict", "optimizer_states", "lr_schedulers", "callbacks", "loops", "epoch", "global_step")
CURE = "delete it to begin the run again"
LONGEST_VALUE = 40  # characters of a value in a message


def claim_run(folder: Path, config: TrainConfig) -> None:
    """Write the configuration, or see that the folder holds the same one; keep the codes of a file there.

    Raises InputError for another run's folder, with what differs, and one that holds other files.
    """
    path = folder / "config.json"
    if path.is_file():
        check_same(folder, config)
    else:
        require_free(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as beside:
            beside.write_text(json.dumps(config.to_dict(), indent=1, sort_keys=True) + "\n")
    keep_codes(config, folder)


def require_free(folder: Path) -> None:
    """Raise InputError for a path that can hold no run: a file, or a folder with something else in it."""
    there = (folder / "config.json").is_file() or is_unclaimed(folder)
    require(there, f"{folder}: is not an empty folder and holds no run; choose another --out")


def check_same(folder: Path, config: TrainConfig, *, sets: bool = True) -> None:
    """Raise InputError where a run's folder was made by another configuration; `sets`: or with other sets and weights
    to begin with, whose hashes the configuration then has."""
    known = read_json_object(folder / "config.json", "configuration")
    refusal = f"{folder}: holds a run with other options or another set"
    try:  # compared as configurations: options that a file of an older version lacks have their defaults
        there = TrainConfig.from_dict(known).to_dict()
    except InputError:
        raise InputError(f"{refusal}; choose another --out") from None
    stood, asked = (json.loads(json.dumps(one)) for one in (there, config.to_dict()))
    # hashes tell what a run began with, and own codes; older versions wrote no ancestors, and files may move
    for one in (stood, asked):
        for name in ("ancestors", FILE) if sets else [*one["data"]]:
            one["data"].pop(name, None)
    differing = _differences(stood, asked)
    require(not differing, f"{refusal} ({'; '.join(differing[:3])}); choose another --out")


def _differences(there: JsonObject, asked: JsonObject, within: str = "") -> list[str]:
    """List what differs between two configurations, each as its name and both values."""
    found = []
    for name in sorted(there.keys() | asked.keys()):
        old, new = there.get(name), asked.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            found += _differences(old, new, f"{within}{name}.")
        elif old != new:
            found.append(f"{within}{name}: {_short(old)} there, {_short(new)} asked")
    return found


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


class WholeFileCheckpoints(TorchCheckpointIO):
    """Write checkpoints beside their place, flush them, and rename them.

    Lightning's own writer goes through TMPDIR: where that is another file system, its rename is a copy, and a kill in
    the middle of it leaves an empty file in place of the old state.
    """

    def save_checkpoint(self, checkpoint: dict[str, object], path: str | Path, storage_options: object = None) -> None:
        # by way of memory: torch would name the archive after the temporary file, and has no OSError for a full disk
        state = io.BytesIO()
        torch.save(checkpoint, state)
        with whole_file(Path(path)) as beside:
            beside.write_bytes(state.getbuffer())


def check_resume(path: Path, module: nn.Module) -> None:
    """Raise InputError in one line unless `path` is an undamaged state of this module.

    Every byte is compared with the archive's checksums, nothing but tensors and plain values is unpickled, and names
    and shapes of the weights are the module's.
    """
    try:
        state = load_torch_file(path)
    except InputError as error:
        raise InputError(f"{error}; {CURE}") from None
    missing = [key for key in KEYS if not isinstance(state, dict) or key not in state]
    if not isinstance(state, dict) or missing:
        raise InputError(f"{path}: is no state of an interrupted run, {', '.join(missing)} are missing; {CURE}")
    if not isinstance(state["state_dict"], dict):
        raise InputError(f"{path}: is no state of an interrupted run, its state_dict is none; {CURE}")
    expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    found = {name: tuple(getattr(value, "shape", ())) for name, value in state["state_dict"].items()}
    if expected != found:
        other = sorted(str(name) for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        raise InputError(f"{path}: holds another model's weights ({', '.join(other[:3])}); {CURE}")
