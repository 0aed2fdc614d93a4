"""Check plain values of commands before torch, a model or a render is loaded."""

from __future__ import annotations

from pathlib import Path

import csph.weights
from scene2spad.cli.paths import begins
from scenes.errors import require
from scenes.model import MAX_IMAGE_SIDE

CHECKPOINT = ".safetensors"


def check_image(where: str, **sides: int | None) -> None:
    """Raise InputError for an image's side, by its option, that no image has; `where`: the command."""
    for option, side in sides.items():
        good = side is None or 1 <= side <= MAX_IMAGE_SIDE
        require(good, f"{where}: --{option} {side} is outside 1 to {MAX_IMAGE_SIDE} pixels")


def is_checkpoint(path: Path) -> bool:
    """Tell by its first bytes whether a file is a checkpoint of `train`: the length of its header, which is JSON."""
    return begins(path, rb".{8}\{")


def check_model(path: Path) -> None:
    """Raise InputError for what is neither there nor the name of a shipped model.

    Torch is loaded for a misspelled name alone, for which the nearest ones are looked up.
    """
    shipped = Path(next(iter(csph.weights.__path__))) / path / f"model{CHECKPOINT}"
    named = not path.suffix and len(path.parts) == 1
    if path.exists() or (named and shipped.is_file()):
        return
    require(named, f"{path}: file not found")
    from csph.weights.cards import checkpoint_of

    checkpoint_of(path)
