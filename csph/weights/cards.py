"""Cards of the models that come with the package: what each is, what made it, how far it errs, what it is not for.

A card is read from the model's `card.json`: configuration and state are always there, CPU-minutes and errors where
`ship` was told them.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from csph.codes.tensor import CodingTensor
from csph.levels import BACKGROUND, CONTINUOUS, SIGNAL
from csph.networks.checkpoint import load_model
from csph.networks.config import TrainConfig
from csph.weights.shipped import CARD, WEIGHTS, shipped_file, shipped_names
from scenes.errors import InputError, require
from scenes.json_types import JsonObject

LONG_BLOCK = 256  # bins; learned codes over more of them know the depths of their training set


@dataclass(frozen=True)
class Card:
    """Card of a shipped model: its training, its errors, and its limits.

    compression   counts of a block over its codes, a ratio; 1 without codes
    training, training_sha256   its sets' files and their SHA-256
    levels        photon levels of training, in words
    cpu_minutes   of its training; None where they were not recorded
    val_mae_mm    on its validation set, as the model was decoded then
    init          model whose weights, or network alone, its training began with; None: random weights
    errors        MAE [mm] by set and level, where `ship` was told; of the studies' models also by the page that states
                  them, named with the set; empty where none were recorded
    not_for       what it must not be used for: what follows from its training, and `limits` measured on it

    Examples
    --------
    A block of 256 bins x 4 x 4 pixels holds 4096 counts; 32 codes are 128 times fewer:

    >>> import scene2spad as s2s
    >>> (card,) = [card for card in s2s.models() if card.name == "learned-256x4x4-128x-s0"]
    >>> card.model, card.compression
    ('learned 256x4x4 K32, compact', 128.0)
    >>> card.levels  # mean photons a pixel in training
    'signal 2 to 10, background 2 to 50'
    """

    name: str
    model: str
    compression: float
    training: tuple[str, ...]
    training_sha256: tuple[str, ...]
    levels: str
    steps: int
    cpu_minutes: float | None
    val_mae_mm: float | None
    init: str | None
    errors: dict[str, dict[str, float]]
    not_for: tuple[str, ...]

    def to_dict(self) -> JsonObject:
        """Return the card as JSON holds it."""
        return asdict(self)


def read_card(path: Path) -> Card:
    """Return the card that a shipped model's card.json holds; InputError in one line where it cannot be read."""
    try:
        stored = json.loads(path.read_text())
        config, state = TrainConfig.from_dict(stored["config"]), stored["state"]
    except (OSError, ValueError, KeyError, TypeError, InputError) as error:
        raise InputError(f"{path}: is no card of a model ({' '.join(str(error).split())[:80]})") from None
    design = config.model.design
    return Card(
        name=path.absolute().parent.name,
        model=config.model.name,
        compression=1.0 if design is None else design.compression_ratio,
        training=_several(config.data.get("training", ())),
        training_sha256=_several(config.data.get("training_sha256", ())),
        levels=levels_in_words(config),
        steps=config.steps,
        cpu_minutes=stored.get("cpu_minutes"),
        val_mae_mm=state.get("val_mae_mm"),
        init=config.data.get("init", config.data.get("init_network")),
        errors=stored.get("errors", {}),
        not_for=(*limits(config), *stored.get("limits", ())),
    )


def cards(folder: Path = WEIGHTS) -> list[Card]:
    """Return cards of all models of a folder, by name."""
    return [read_card(folder / name / CARD) for name in shipped_names(folder)]


def _several(value: str | list[str] | tuple[str, ...]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def levels_in_words(config: TrainConfig) -> str:
    """Return as in "signal 2 to 10, background 2 to 50"."""
    listed = config.levels != CONTINUOUS
    columns = zip(*config.levels, strict=True) if listed else (SIGNAL, BACKGROUND)
    (low, high), (least, most) = ((min(column), max(column)) for column in columns)
    return f"signal {low:g} to {high:g}, background {least:g} to {most:g}"


def limits(config: TrainConfig) -> tuple[str, ...]:
    """Return what a model trained so must not be used for."""
    model, sensor = config.model, config.model.sensor
    found = [f"histograms of other than {sensor.bins} bins of {sensor.bin_width_s * 1e12:.4g} ps, or another pulse"]
    if sensor.tdc is not None:
        found.append(f"histograms of another clock than that of {sensor.name}")
    found.append(f"photon levels far from its training's ({levels_in_words(config)})")
    reach, design = config.data.get("training_reach_m"), model.design
    long = design is not None and "temporal" in design.learned and design.block[0] > LONG_BLOCK
    if long and reach and not config.time_offset_m:
        found.append(f"depths beyond those of its training set, {reach:g} m, or such as it rarely shows")
    if model.grid == "published":
        found.append("absolute depth: its labels are the published ones, for comparison with the paper")
    return tuple(found)


def shipped_model(name: str, folder: Path = WEIGHTS) -> Path:
    """Return the file of a shipped model by its name; InputError that names the nearest ones for another."""
    path = shipped_file(name, folder)
    if not path.is_file():
        import difflib

        near = difflib.get_close_matches(name, shipped_names(folder), 3, 0.4)
        require(False, f"model {name!r} is unknown{', like ' + ', '.join(near) if near else ''}; see scene2spad models")
    return path


def checkpoint_of(name_or_path: Path | str, folder: Path = WEIGHTS) -> Path:
    """Return a checkpoint's path as it is if something lies there, else the shipped model of that name. InputError,
    also for what is neither text nor a path."""
    named = isinstance(name_or_path, str | Path)
    require(named, f"model {name_or_path!r}: expected a name of `models`, or the path of a checkpoint")
    path = Path(name_or_path)
    if path.exists() or path.suffix or len(path.parts) > 1:
        require(path.exists(), f"{path}: file not found")
        return path
    try:
        return shipped_model(str(name_or_path), folder)
    except InputError as error:
        raise InputError(f"{path}: file not found, and {error}") from None


def model_coding(name_or_path: Path | str, folder: Path = WEIGHTS) -> CodingTensor:
    """Return the coding tensor of a trained model: a shipped name, a checkpoint or a run's folder. InputError where it
    has none."""
    model = load_model(checkpoint_of(name_or_path, folder))[0]
    if model.layer is None:
        raise InputError(f"{name_or_path}: a network without codes, it takes the counts themselves")
    return model.layer.coding()
