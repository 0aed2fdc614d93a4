"""Trained models that come with the package: `weights/NAME.safetensors` in half precision, with what made them beside.

NAME.json         the run's configuration and seed, and the state that its weights were kept in
NAME.csv          its training log
NAME.energy.csv   the energy of its temporal code while it was trained, where one is learned
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from csph.model import checkpoint_file, load_model, save_model
from scenes.errors import require
from scenes.files import whole_file

WEIGHTS = Path(__file__).parent / "weights"
RUN_WEIGHTS = ("model", "last")  # files of a run; shipped ones have the models' names
_BESIDE = {"log.csv": ".csv", "energy.csv": ".energy.csv"}


def shipped_file(name: str, folder: Path = WEIGHTS) -> Path:
    """Where the shipped model of that name lies, if it does."""
    return folder / f"{name}.safetensors"


def file_names(paths: str | Sequence[str]) -> str | list[str]:
    """Names of a set's file, or of several sets' files, without their folders."""
    return Path(paths).name if isinstance(paths, str) else [Path(path).name for path in paths]


def ship(run: Path, name: str, folder: Path = WEIGHTS) -> Path:
    """Make the shipped form of a finished run's best weights; returns the file.

    What it was trained on is told by file name and SHA-256: folders of one machine mean nothing on another. Raises
    InputError for a folder without a checkpoint or a training log.
    """
    model, config, state = load_model(run)
    log = checkpoint_file(run).with_name("log.csv")
    require(log.is_file(), f"{log}: file not found, a shipped model needs its training log")
    data = {key: file_names(v) if key in ("training", "validation") else v for key, v in config.data.items()}
    config = replace(config, data=data)
    folder.mkdir(parents=True, exist_ok=True)
    for source, suffix in _BESIDE.items():
        if log.with_name(source).is_file():
            with whole_file(folder / f"{name}{suffix}") as beside:
                beside.write_bytes(log.with_name(source).read_bytes())
    with whole_file(folder / f"{name}.json") as beside:
        beside.write_text(json.dumps({"config": config.to_dict(), "state": state}, indent=1, sort_keys=True) + "\n")
    path = shipped_file(name, folder)
    save_model(model, config, state, path, half=True)
    return path


def beside(checkpoint: Path, kind: str) -> Path:
    """`log.csv` or `energy.csv` of a checkpoint, in its run's folder or as shipped; it need not exist."""
    return checkpoint.with_name(kind if checkpoint.stem in RUN_WEIGHTS else f"{checkpoint.stem}{_BESIDE[kind]}")
