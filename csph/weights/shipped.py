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

from csph.networks.model import checkpoint_file, load_model, save_model
from scenes.errors import require
from scenes.files import whole_file
from scenes.io.inputs import read_whole_lines

WEIGHTS = Path(__file__).parent
RUN_WEIGHTS = ("model", "last")  # files of a run; shipped ones have the models' names
RESUME = "resume.ckpt"  # of a run: what it goes on from
TIMINGS = "timings.jsonl"  # of a run: seconds of each epoch, wall clock and CPU
_BESIDE = {"log.csv": ".csv", "energy.csv": ".energy.csv"}


def shipped_file(name: str, folder: Path = WEIGHTS) -> Path:
    """Return where the shipped model of that name lies, if it does."""
    return folder / f"{name}.safetensors"


def file_names(paths: str | Sequence[str]) -> str | list[str]:
    """Return names of a set's file, or of several sets' files, without their folders."""
    return Path(paths).name if isinstance(paths, str) else [Path(path).name for path in paths]


def ship(run: Path, name: str, folder: Path = WEIGHTS, *, errors: dict[str, dict[str, float]] | None = None) -> Path:
    """Make the shipped form of a finished run's best weights; returns the file.

    Its card (`csph.weights.cards`) gets the CPU-minutes of the run's timings and `errors`, MAE [mm] by set and level.

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
        card = {"config": config.to_dict(), "state": state, "cpu_minutes": cpu_minutes(log.parent)}
        card |= {"errors": errors} if errors else {}
        beside.write_text(json.dumps(card, indent=1, sort_keys=True) + "\n")
    path = shipped_file(name, folder)
    save_model(model, config, state, path, half=True)
    return path


def cpu_minutes(run: Path) -> float | None:
    """Return CPU-minutes of a run's epochs as far as `timings.jsonl` tells them; None without that file.

    An epoch that was done again after a kill counts once.
    """
    path = run / TIMINGS
    if not path.is_file():
        return None
    seconds = {}
    for line in read_whole_lines(path):
        match line:
            case {"epoch": int(epoch), "cpu_s": float(cpu) | int(cpu)}:
                seconds[epoch] = cpu
    return round(sum(seconds.values()) / 60, 1)


def beside(checkpoint: Path, kind: str) -> Path:
    """Return `log.csv` or `energy.csv` of a checkpoint, in its run's folder or as shipped; it need not exist."""
    return checkpoint.with_name(kind if checkpoint.stem in RUN_WEIGHTS else f"{checkpoint.stem}{_BESIDE[kind]}")
