"""Check the files that commands read and write, before any work is done."""

from __future__ import annotations

import mmap
import os
from pathlib import Path

from scenes.errors import InputError


def input_file(path: Path) -> Path:
    if not path.is_file():
        raise InputError(
            f"{path}: {'is a folder, expected a file' if path.is_dir() and path.name else 'file not found'}"
        )
    return path


def output_file(path: Path, suffix: str, kind: str) -> Path:
    """Return an output path that can be written later, with its picture: checked before the work, not after it.

    Results of the same kind may be written again; any other file is not overwritten.
    """
    if path.suffix.lower() != suffix:
        raise InputError(f"{path}: the output must end in {suffix}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: folder {path.parent} cannot be written to")
    for target in (path, picture(path, kind)):
        if target.is_dir():
            raise InputError(f"{target}: is a folder, expected a file name")
    if path.is_file() and not holds_kind(path, kind):
        raise InputError(f"{path}: exists and is no {kind} of scene2spad; choose another --out")
    return path


def holds_kind(path: Path, kind: str) -> bool:
    """Tell whether a file carries the seal of one of our kinds of file."""
    seal = f'"kind": "{kind}"'.encode()
    return _holds(path, seal) or _holds(path, seal.replace(b'"', b'\\"'))  # a checkpoint's is JSON within JSON


def _holds(path: Path, words: bytes) -> bool:
    if path.stat().st_size == 0:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as contents:
        return contents.find(words) >= 0


def picture(path: Path, kind: str) -> Path:
    """Return the picture's name beside a result: its own kind, so that it meets no texture and no other picture."""
    return path.with_name(f"{path.stem}.{kind}.png")
