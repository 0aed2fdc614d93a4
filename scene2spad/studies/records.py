"""Keep a record of the last run of each study beside its results: what was asked, and its files with their SHA-256.

By it `study all` tells what is done, a later run removes what it does not make again, and `report` knows smoke runs.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from scene2spad.options.experiments import NO_PRESET, Study
from scenes.errors import InputError, require
from scenes.files import whole_file
from scenes.io.inputs import file_sha256, read_json_object
from scenes.io.versions import installed_version
from scenes.json_types import JsonObject

log = logging.getLogger("scene2spad")

ENDING = ".run.json"
_FILES = ("figures", "csv", "numbers", "sensor")  # of a study's result: paths of what it has written


@dataclass(frozen=True)
class StudyRecord:
    """The last finished run of a study into a folder.

    asked   all that decides its results, but for what it finds in folders
    smoke   whether it was at toy size
    files   SHA-256 of every figure and table by its name in that folder
    """

    study: str
    asked: JsonObject
    smoke: bool
    files: dict[str, str]

    def intact(self, folder: Path) -> list[str]:
        """Return the names of the files that are still there as they were written."""
        return [name for name in self.files if is_same(folder / name, self.files[name])]


def is_same(path: Path, sha256: str) -> bool:
    """Return whether a file is there and has these contents."""
    return path.is_file() and file_sha256(path) == sha256


def record_path(command: Study) -> Path:
    """Return where the record of a study lies."""
    return command.out / f"{command.name}{ENDING}"


def asked_of(command: Study) -> JsonObject:
    """Return all that decides a study's results, but for what it finds in folders, as JSON has it."""
    options = asdict(replace(command, json=False, dry_run=False, ship=False))
    return json.loads(json.dumps({**options, "version": installed_version("scene2spad")}, default=str))


def read_record(path: Path) -> StudyRecord:
    """Return a record. Raises InputError for a file that is none."""
    match read_json_object(path):
        case {"study": str(study), "asked": dict(asked), "smoke": bool(smoke), "files": dict(files)}:
            plain = all(isinstance(sha256, str) and Path(name).name == name for name, sha256 in files.items())
            require(plain, f"{path}: names files that do not lie beside it")
            return StudyRecord(study, asked, smoke, files)
    raise InputError(f"{path}: is no record of a study")


def last_record(command: Study) -> StudyRecord | None:
    """Return the record of the last run into the command's folder; None where there is none that can be read."""
    path = record_path(command)
    if not path.is_file():
        return None
    try:
        return read_record(path)
    except InputError as error:
        log.warning("%s", error)
        return None


def write_record(command: Study, result: Mapping[str, object], *, smoke: bool) -> StudyRecord:
    """Write the record of a run that has come to its end. Files of the run before it, which this one did not make, are
    removed; those that were changed since stay, and so do those of studies without presets, whose names say what was
    asked."""
    before = last_record(command)
    files = {path.name: file_sha256(path) for path in _written(command, result)}
    if before is not None and command.name not in NO_PRESET:
        for name in before.intact(command.out):
            if name not in files:
                log.info("%s: of an earlier run with other options, removed", command.out / name)
                (command.out / name).unlink()
    made = StudyRecord(command.name, asked_of(command), smoke, files)
    with whole_file(record_path(command)) as beside:
        beside.write_text(json.dumps(asdict(made), indent=1) + "\n")
    return made


def _written(command: Study, result: Mapping[str, object]) -> list[Path]:
    """Paths of all that a result names, with the PDF beside each figure where these were asked for."""
    found: list[Path] = []
    for key in _FILES:
        value = result.get(key, [])
        paths = [Path(str(one)) for one in (value if isinstance(value, list) else [value])]
        found += paths
        if key == "figures" and command.pdf:
            found += [path.with_suffix(".pdf") for path in paths]
    return found
