"""Check the files that commands read and write, before any work is done."""

from __future__ import annotations

import mmap
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from scenes.errors import InputError
from scenes.files import link_target, without_folder
from scenes.io.hdf5 import HDF5_SUFFIXES

HEAD_BYTES = 4096  # of a file, by which its format is told


class Mark(NamedTuple):
    """A kind of file that we write, and the test that tells such a file from those of other programs."""

    kind: str
    is_ours: Callable[[Path], bool]


# Of all our figures (`plots.style.save`): 130 dots per inch right after the header, and no name of a program.
PNG_FIGURE = Mark("figure", lambda path: begins(path, rb"\x89PNG.{29}\x00\x00\x00\tpHYs\x00\x00\x13\xfe"))
PDF_FIGURE = Mark("figure", lambda path: begins(path, rb"%PDF") and _is_undated_figure(path))


def input_file(path: Path) -> Path:
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder, expected a file' if path.is_dir() else 'file not found'}")
    return path


def output_file(path: Path, suffix: str, kind: str, made: Path | None = None, *, figure: bool = False) -> Path:
    """Return an output path that can be written later, with its picture: checked before the work, not after it.

    Results of the same kind may be written again; any other file is not overwritten.
    made     folder that the command makes first: the output may lie in it, or in one above it, that is not there yet
    figure   whether the picture is written, too: then one of another program is not overwritten either
    """
    if path.suffix.lower() not in (HDF5_SUFFIXES if suffix in HDF5_SUFFIXES else (suffix,)):
        raise InputError(f"{path}: the output must end in {suffix}")
    for target in (path, picture(path, kind)):
        check_target(target, made=made)
    keep_foreign(path, Mark(kind, lambda found: holds_kind(found, kind)))
    if figure:
        keep_foreign(picture(path, kind), PNG_FIGURE)
    return path


def check_target(path: Path, source: Path | None = None, made: Path | None = None) -> None:
    """Raise InputError for a file that cannot be written: no folder for it, a folder of its name, or the source.

    A link is checked as the file that it leads to. Whether the folder `made`, and those above it, can be made is for
    `output_folder` to check.
    """
    path = link_target(path)
    if made is not None and not path.parent.exists():
        folder = made.resolve()
        if path.parent.resolve() in (folder, *folder.parents):
            return
    if not path.parent.is_dir():
        raise InputError(without_folder(path))
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: folder {path.parent} cannot be written to")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file name")
    if source is not None and path.exists() and source.exists() and path.samefile(source):
        raise InputError(f"{path}: is the input itself; choose another --out")


def keep_foreign(path: Path, mark: Mark | None) -> None:
    """Raise InputError for an existing file of another program. `mark`: of our own; None where there is none.

    An empty file may be written over: it holds nothing that could be lost.
    """
    if mark is not None and path.is_file() and path.stat().st_size and not mark.is_ours(path):
        raise InputError(f"{path}: exists and is no {mark.kind} of scene2spad; choose another --out")


def output_folder(path: Path, contents: str) -> Path:
    """Return an output folder that can be made, or is there, and written to. Raises InputError for another."""
    if path.is_file():
        raise InputError(f"{path}: is a file, expected a folder for {contents}")
    there = next(one for one in (path, *path.absolute().parents) if one.exists())
    if not there.is_dir():
        raise InputError(f"{path}: {there} is a file, expected a folder")
    if not os.access(there, os.W_OK):
        raise InputError(f"{path}: folder {there} cannot be written to")
    return path


def beside_folder(folder: Path, ending: str) -> Path:
    """Return the path beside a folder, of its name and an ending, written as the folder is."""
    if folder.name in ("", ".."):  # "." has no name in its path
        return folder / ".." / f"{folder.resolve().name}{ending}"
    return folder.with_name(f"{folder.name}{ending}")


def file_stem(name: str) -> str:
    """Return the name of a scene or a set as a file's: - for /."""
    return name.replace("/", "-")


def begins(path: Path, pattern: bytes) -> bool:
    """Tell whether a file begins with a pattern, a regular expression."""
    return re.match(pattern, _head(path), re.S) is not None


def holds_at_start(path: Path, words: bytes) -> bool:
    """Tell whether the first bytes of a file hold these words."""
    return words in _head(path)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD_BYTES)


def _is_undated_figure(path: Path) -> bool:
    """Tell whether Matplotlib made a PDF without a date, as we do: it dates those of others."""
    return _holds(path, b"Matplotlib") and not _holds(path, b"/CreationDate")


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
