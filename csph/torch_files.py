"""Files of torch.save (.ckpt, .pt): checked against their own checksums, and read as tensors alone."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

from scenes.errors import InputError, require
from scenes.inputs import regular_file


def load_torch_file(path: Path) -> Any:
    """Return what torch.save wrote, tensors and plain values alone, on the CPU.

    Raises InputError in one line for a missing or foreign file, one whose checksums do not fit (torch does not look at
    them), and one that holds other objects, which could run code.
    """
    import torch

    path = regular_file(path, "checkpoint")
    check_torch_file(path)
    try:
        with warnings.catch_warnings(action="ignore"):
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpickling raises whatever the pickle asks for
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: no checkpoint of tensors alone ({reason})") from None


def check_torch_file(path: Path) -> None:
    """InputError unless a file is a whole archive of torch.save: every entry stored as it is, its CRC-32 fitting."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = path.stat().st_size
            for entry in archive.infolist():
                stored = entry.compress_type == zipfile.ZIP_STORED and entry.file_size <= size
                require(stored, f"{path}: entry {entry.filename!r} of {entry.file_size} bytes is not stored plainly")
            damaged = archive.testzip()
    except InputError:
        raise
    except Exception as error:  # what zipfile raises for damaged directories is of many types
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: no checkpoint, or a damaged one ({reason})") from None
    require(damaged is None, f"{path}: is damaged, entry {damaged!r} does not fit its checksum")
