"""Trained models that come with the package, a folder each: `weights/NAME`, with what made them beside the weights.

model.safetensors   its weights in half precision
card.json           the run's configuration and seed, the state that its weights were kept in, its errors
log.csv             its training log
energy.csv          the energy of its temporal code while it was trained, where one is learned
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from csph.networks.checkpoint import checkpoint_file, load_model, save_model
from scenes.errors import require
from scenes.files import whole_file
from scenes.io.inputs import read_whole_lines

WEIGHTS = Path(__file__).parent
WEIGHTS_FILE, CARD = "model.safetensors", "card.json"
RUN_WEIGHTS = ("model", "last")  # files of a run, which is named after its folder
RESUME = "resume.ckpt"  # of a run: what it goes on from
TIMINGS = "timings.jsonl"  # of a run: seconds of each epoch, wall clock and CPU
_TABLES = ("log.csv", "energy.csv")


def shipped_file(name: str, folder: Path = WEIGHTS) -> Path:
    """Return where the shipped model of that name lies, if it does."""
    return folder / name / WEIGHTS_FILE


def shipped_names(folder: Path = WEIGHTS) -> list[str]:
    """Return names of the models that a folder of shipped ones holds, sorted."""
    return sorted(path.parent.name for path in folder.glob(f"*/{WEIGHTS_FILE}"))


def checkpoint_name(path: Path) -> str:
    """Return what a checkpoint is called: its folder's name for the files of a run or of a shipped model."""
    path = path.resolve()
    inside = path.suffix == ".safetensors" and path.stem in RUN_WEIGHTS
    return path.parent.name if inside else path.name if path.is_dir() else path.stem


def is_unfinished(checkpoint: Path) -> bool:
    """Return whether a checkpoint lies in a run's folder whose training was stopped, and can go on there."""
    folder = checkpoint_file(checkpoint).parent
    return (folder / RESUME).is_file() and not (folder / f"{RUN_WEIGHTS[1]}.safetensors").is_file()


def is_shipped(checkpoint: Path) -> bool:
    """Return whether a checkpoint lies as shipped ones do, its card beside it."""
    return checkpoint.with_name(CARD).is_file()


def file_names(paths: str | Sequence[str]) -> str | list[str]:
    """Return names of a set's file, or of several sets' files, without their folders."""
    return Path(paths).name if isinstance(paths, str) else [Path(path).name for path in paths]


def ship(run: Path, name: str, folder: Path = WEIGHTS, *, errors: dict[str, dict[str, float]] | None = None) -> Path:
    """Make the shipped form of a finished run's best weights, `folder`/NAME; returns the file of the weights.

    Its card (`csph.weights.cards`) gets the CPU-minutes of the run's timings and `errors`, MAE [mm] by set and level.

    What it was trained on is told by file name and SHA-256: folders of one machine mean nothing on another. Raises
    InputError for a folder without a checkpoint or a training log.
    """
    model, config, state = load_model(run)
    log = checkpoint_file(run).with_name("log.csv")
    require(log.is_file(), f"{log}: file not found, a shipped model needs its training log")
    paths = ("training", "validation", "codes_file")
    data = {key: file_names(v) if key in paths else v for key, v in config.data.items()}
    config = replace(config, data=data)
    path = shipped_file(name, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    for table in _TABLES:
        if log.with_name(table).is_file():
            with whole_file(path.with_name(table)) as beside:
                beside.write_bytes(log.with_name(table).read_bytes())
    with whole_file(path.with_name(CARD)) as beside:
        card = {"config": config.to_dict(), "state": state, "cpu_minutes": cpu_minutes(log.parent)}
        card |= {"errors": errors} if errors else {}
        beside.write_text(json.dumps(card, indent=1, sort_keys=True) + "\n")
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
