"""Files of torch.save (.ckpt, .pt): checked against their own checksums, and read as tensors alone."""

from __future__ import annotations

import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

from scenes.errors import InputError, require
from scenes.io.inputs import regular_file


class _EmptyInstead:
    """Stands for a class or function of another library: whatever is made with it is an empty dictionary."""

    def __new__(cls, *_: object) -> OrderedDict:  # type: ignore[misc]
        return OrderedDict()


class _NothingInstead:
    """Stands for a class or function of NumPy, whose state is no dictionary: made of anything, it keeps nothing."""

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        pass


def load_torch_file(path: Path, *, foreign: bool = False) -> object:
    """Return what torch.save wrote, tensors and plain values alone, on the CPU.

    `foreign`: objects of other libraries, such as the settings that a trainer keeps beside its weights, are replaced by
    empty ones; none of those libraries is imported or called. Raises InputError in one line for a missing or foreign
    file, one whose checksums do not fit (torch does not look at them), and one that holds other objects, which could
    run code.
    """
    import torch
    from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

    path = regular_file(path, "checkpoint")
    check_torch_file(path)
    try:
        with warnings.catch_warnings(action="ignore"):
            names = get_unsafe_globals_in_checkpoint(path) if foreign else []
            empty: list[Callable[..., object] | tuple[Callable[..., object], str]] = [
                (_NothingInstead if name.startswith("numpy.") else _EmptyInstead, name) for name in names
            ]
            with safe_globals(empty):
                found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpickling raises whatever the pickle asks for
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: no checkpoint of tensors alone ({reason})") from None
    _check_sizes(found, path)
    return found


def _check_sizes(contents: object, path: Path) -> None:
    """Raise InputError where a tensor states more elements than its file holds: strides of 0 repeat a few for ever."""
    import torch

    size, left = path.stat().st_size, [contents]
    known: set[int] = set()
    while left:
        part = left.pop()
        if isinstance(part, torch.Tensor):
            stated = part.numel() * part.element_size()
            require(stated <= size, f"{path}: a tensor of shape {tuple(part.shape)} is larger than the file")
        elif isinstance(part, (dict, list, tuple, set)) and id(part) not in known:
            known.add(id(part))
            left.extend(part.values() if isinstance(part, dict) else part)


def check_torch_file(path: Path) -> None:
    """Raise InputError unless a file is a whole archive of torch.save: every entry stored as it is, its CRC-32
    fitting."""
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
