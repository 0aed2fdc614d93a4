"""The folder of a rendered scene set: what it holds, what may be added, and its index.

set.json      what was asked for; a folder is continued only with the same
grid.json     how many rays all views of an endless set take, and the errors of some that say so
views/*.exr   one transient a view, written beside and renamed, so that a file is whole or not there
journal.jsonl one line a view as it ends, in whatever order; gone once the index is written
index.jsonl   one line a view in the order of the views: scene, plan, error, depth statistics, or why it failed
timings.jsonl seconds and places, kept out of the index so that two runs are the same byte for byte
"""

from __future__ import annotations

import fcntl
import json
import logging
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from scenes.errors import InputError, require
from scenes.files import append_line, finite, is_unclaimed, sweep, whole_file
from scenes.io.inputs import read_text, read_whole_lines

log = logging.getLogger("scene2spad")


class Done(NamedTuple):
    """A finished view: its record for the index, the bytes of its EXR (None: it failed), seconds, and by whom."""

    record: dict
    exr: bytes | None
    seconds: float
    where: str


def file_name(view: int) -> str:
    return f"views/{view:06d}.exr"


def _as_text(made: dict) -> str:
    return json.dumps(made, sort_keys=True, indent=1) + "\n"


def _as_line(record: dict) -> str:
    """Return a record in one line; the depths of a view that shows no surface are null."""
    return json.dumps(finite(record), sort_keys=True)


def _check_ours(path: Path, made: dict) -> None:
    """Raise InputError where a folder holds anything else than views of this set."""
    config = path / "set.json"
    if not config.is_file():
        require(is_unclaimed(path), f"{path}: is not empty and holds no set; choose another --out")
    elif read_text(config) != _as_text(made):
        raise InputError(
            f"{path}: holds a set that was made with other options or another version; choose another --out"
        )


def _records(path: Path) -> dict[int, dict]:
    lines = [line for name in ("index.jsonl", "journal.jsonl") for line in read_whole_lines(path / name)]
    known = (line for line in lines if isinstance(line, dict) and isinstance(line.get("view"), int))
    return {record["view"]: record for record in known if _stands(path, record)}


def _stands(folder: Path, record: dict) -> bool:
    """Return whether the view of a record is there in full; failed ones are tried again."""
    if "failed" in record or record.get("file") != file_name(record["view"]):
        return False
    path = folder / record["file"]
    numbers = [record.get(key) for key in ("error", "target", "bytes")]
    if "target_met" not in record or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
        return False
    return path.is_file() and path.stat().st_size == record.get("bytes")


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder until the end, or that of the process."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            message = "another process adds views to this set; run it again when that one has ended"
            raise InputError(f"{folder}: {message}") from None
        except OSError:  # some network file systems lock no folders
            log.debug("%s: cannot be locked", folder, exc_info=True)
        yield
    finally:
        os.close(descriptor)


class SetFolder:
    """A set's folder: `records` of what is there already, and where finished views go.

    `made` is all that decides their bytes. Nothing is written before `held`. Raises InputError for the folder of
    something else.
    """

    def __init__(self, path: Path, made: dict) -> None:
        _check_ours(path, made)
        self.path = path
        self.records = _records(path)
        self._made = made

    @property
    def closed(self) -> bool:
        """Tell whether every record stands in the index."""
        return not (self.path / "journal.jsonl").exists()

    def missing(self, count: int) -> list[int]:
        """Return which of the first `count` views are not there."""
        return [view for view in range(count) if view not in self.records]

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder, alone: make it where it is not there, and remove what killed processes left half written.

        What others have added since this object was made is among `records`. Raises InputError while another process
        holds the folder: the index of one would lose the views of the other.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with _locked(self.path):
            _check_ours(self.path, self._made)
            if not (self.path / "set.json").is_file():
                with whole_file(self.path / "set.json") as beside:
                    beside.write_text(_as_text(self._made))
            (self.path / "views").mkdir(exist_ok=True)
            for folder in (self.path, self.path / "views"):
                sweep(folder)
            self.records = _records(self.path)
            yield

    def add(self, done: Done) -> None:
        """Write the file first, then the line that vouches for it."""
        view = done.record["view"]
        if done.exr is not None:
            with whole_file(self.path / file_name(view)) as beside:
                beside.write_bytes(done.exr)
        self.records[view] = done.record
        timing = {"view": view, "seconds": round(done.seconds, 4), "where": done.where}
        append_line(self.path / "journal.jsonl", _as_line(done.record))
        append_line(self.path / "timings.jsonl", json.dumps(timing, sort_keys=True))

    def close(self) -> None:
        """Write the index in the order of the views, then no journal."""
        with whole_file(self.path / "index.jsonl") as beside:
            beside.write_text("".join(_as_line(self.records[view]) + "\n" for view in sorted(self.records)))
        (self.path / "journal.jsonl").unlink(missing_ok=True)
