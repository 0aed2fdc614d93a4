"""List the networks that come with the package, from their cards, and import published ones."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from scene2spad.cli.checks import CHECKPOINT
from scene2spad.cli.paths import output_folder
from scene2spad.options.common import Common, Positional, may_stay_open
from scenes.errors import InputError, require
from scenes.io.inputs import regular_file
from scenes.json_types import JsonObject
from scenes.progress import Progress

if TYPE_CHECKING:
    from csph.weights.cards import Card

log = logging.getLogger("scene2spad")
IMPORT = "import"
UNKNOWN = "not recorded"


@dataclass(frozen=True, kw_only=True)
class Models(Common):
    """List the models that come with the package: design, compression, training set, photon levels, error, limits; or
    make a model of a checkpoint of the published code: `import FILE.ckpt --out FOLDER`."""

    name: Positional[Annotated[str, may_stay_open("[NAME]")]] = ""
    """Show this one's whole card; or `import`."""
    file: Positional[Annotated[str, may_stay_open("[FILE.ckpt]")]] = ""
    """Checkpoint of the published code to import (.ckpt, written by Lightning)."""
    sensor: Annotated[str | None, may_stay_open("NAME")] = None
    """Sensor whose histograms an imported model is to take, a preset or a file (default: iccv2023-train, that of the
    published training set; the paper tests on reference)."""
    out: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder for an imported model (default: out/models and the checkpoint's name)."""


def run(command: Models, progress: Progress) -> dict:
    """Run the command: a table of the shipped models, or one's whole card; or a published checkpoint as a model."""
    if command.name == IMPORT:
        return _import(command)
    if command.file or command.sensor or command.out:
        raise InputError("models: FILE, --sensor and --out go with import, as in `models import FILE.ckpt`")
    from csph.weights.cards import cards, read_card, shipped_model
    from csph.weights.shipped import CARD

    if command.name:
        whole = read_card(shipped_model(command.name).with_name(CARD)).to_dict()
        return whole if command.json else _readable(whole)
    found = cards()
    if command.json:
        return {"models": [card.to_dict() for card in found]}
    note = (
        "their validation sets differ: `scene2spad evaluate` compares them; `scene2spad models NAME` shows a whole card"
    )
    return {"models": _table(found), "not for": _limits(found), "note": note}


def _table(found: list[Card]) -> list[str]:
    """Return the cards as aligned lines: what tells the models apart."""
    head = ("model", "compression", "network", "training sets", "photon levels of training", "validation MAE")
    rows = [
        (
            card.name,
            f"{card.compression:g}x",
            card.model.rpartition(", ")[2],
            " ".join(Path(name).stem for name in card.training),
            card.levels,
            UNKNOWN if card.val_mae_mm is None else f"{card.val_mae_mm:.1f} mm",
        )
        for card in found
    ]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return [
        "  ".join(f"{text:<{wide}}" for text, wide in zip(row, widths, strict=True)).rstrip() for row in (head, *rows)
    ]


def _limits(found: list[Card]) -> list[str]:
    """Return what models must not be used for, each limit once: first those of all, then others with their models."""
    names: dict[str, list[str]] = {}
    for card in found:
        for limit in card.not_for:
            names.setdefault(limit.replace(f" ({card.levels})", ""), []).append(card.name)
    ordered = sorted(names.items(), key=lambda item: -len(item[1]))
    return [f"{limit} ({'all' if len(which) == len(found) else ', '.join(which)})" for limit, which in ordered]


def _readable(card: JsonObject) -> JsonObject:
    """Return a card for the terminal, which says what was not recorded."""
    unknown = {name: UNKNOWN for name in ("errors", "cpu_minutes", "val_mae_mm") if card[name] in (None, {})}
    return card | unknown


def _import(command: Models) -> dict:
    if not command.file:
        raise InputError("models: import without a checkpoint, expected `models import FILE.ckpt`")
    source = Path(command.file)
    folder = output_folder(command.out or Path("out/models") / source.stem, "the model")
    target = folder / f"model{CHECKPOINT}"
    require(not target.exists(), f"{target}: exists; choose another folder")
    regular_file(source, "checkpoint")
    from csph.weights.published import TRAINED_ON, import_checkpoint
    from spad.sensor.files import load_sensor

    made = import_checkpoint(source, folder, load_sensor(command.sensor or TRAINED_ON).sensor)
    model, design = made.config.model, made.config.model.codes_design
    log.info("depths of this model are on the published grid: bin i of T is i/(T - 1) of the range, labels whole bins")
    return {
        "model": model.name,
        "compression": design.compression_ratio,
        "parameters": made.parameters,
        "sensor": model.sensor.name,
        "decoder": f"{model.decoder}, {model.grid} grid",
        "checkpoint": str(made.path),
    }
