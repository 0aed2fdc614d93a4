"""The files that `report` shows: found by name, read, and those of smoke runs set apart."""

from __future__ import annotations

import io
import re
import struct
import time
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from PIL import Image, UnidentifiedImageError

from scene2spad.studies.every import TIMINGS
from scene2spad.studies.records import ENDING, read_record
from scenes.errors import InputError, printable, require
from scenes.files import read_csv
from scenes.io.inputs import read_json_object

# What studies keep for themselves, in their folder or in their preset's: renders, sets, captures, kept results, models.
INSIDE = ("sets", "renders", "captures", "results", "maps", "models", "emulated")
ENDINGS = (".png", ".csv", ".json")
# Titles, and the columns that are shown, all where none is named.
CONFIGURATIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "config.json": (
        "Trainings",
        ("preset", "seed", "epochs", "steps_per_epoch", "batch", "crop", "rate", "tv_weight", "time_offset_m",
         "precision", "model network", "data training", "data training_reach_m"),
    ),
    "set.json": ("Rendered sets", ()),
}  # fmt: skip
# what readers of tables, JSON and pictures raise for damaged files
UNREADABLE = (
    OSError, ValueError, TypeError, KeyError, SyntaxError, RecursionError, struct.error, zlib.error,
    Image.DecompressionBombError,
)  # fmt: skip

_WHOLE = re.compile(r"-?(0|[1-9]\d*)", re.ASCII)
_REAL = re.compile(r"-?((0|[1-9]\d*)\.\d+(e[-+]\d+)?|\d+e[-+]\d+|inf)|nan", re.ASCII)

Content = TypeVar("Content")


@dataclass
class Found:
    """The results' files by name, the newest of each first, and what went wrong with them on the way."""

    root: Path
    files: dict[str, list[Path]]
    smoke: list[Path]
    configurations: dict[str, list[Path]]
    problems: list[str] = field(default_factory=list)
    missing: dict[str, list[str]] = field(default_factory=dict)  # by command
    used: set[Path] = field(default_factory=set)
    shown: set[str] = field(default_factory=set)  # anchors of pictures, by their contents
    tables: int = 0

    def newest(self, name: str) -> Path | None:
        """Return the file of that name; all of them count as used."""
        paths = self.files.get(name, [])
        self.used.update(paths)
        return paths[0] if paths else None

    def caption(self, path: Path) -> str:
        """Return its place in the folder and its day, and how many older ones of its name were passed over."""
        older = len(self.files.get(path.name, [])) - 1
        return f"{self.place(path)}{f'; {older} older of that name not shown' if older > 0 else ''}"

    def place(self, path: Path) -> str:
        """Return its place in the folder and its day."""
        return f"{path.relative_to(self.root)}, {time.strftime('%Y-%m-%d', time.gmtime(path.stat().st_mtime))}"

    def read(self, path: Path, reader: Callable[[Path], Content]) -> Content | None:
        """Return what a reader makes of a file; None, and a problem, where it cannot."""
        try:
            return reader(path)
        except UnidentifiedImageError:  # its message holds an address in memory, another one each time
            self.problem(f"{path.relative_to(self.root)}: is no picture")
            return None
        except UNREADABLE as error:
            of = "" if isinstance(error, InputError) else f"{type(error).__name__}: "  # one says why in plain words
            message = " ".join(str(error).split()).removeprefix(f"{path}: ")[:120]
            self.problem(f"{path.relative_to(self.root)}: cannot be read ({of}{message})")
            return None

    def problem(self, line: str) -> None:
        line = printable(line)
        if line not in self.problems:
            self.problems.append(line)


def gather(root: Path) -> Found:
    """Return all pictures, tables and configurations in a folder. Raises InputError where there is none."""
    require(root.is_dir(), f"{root}: no folder of results; benches and studies fill one")
    files: dict[str, list[Path]] = {}
    records: list[Path] = []
    configurations: dict[str, list[Path]] = {name: [] for name in CONFIGURATIONS}
    for path in sorted(path for path in root.rglob("*") if path.is_file()):
        if path.name in configurations:
            configurations[path.name].append(path)
        elif path.name.endswith(ENDING):
            records.append(path)
        elif path.suffix in ENDINGS and not path.name.startswith(".") and not _is_kept_by_study(path, root):
            files.setdefault(path.name, []).append(path)
    smoke = smoke_results(files, records)
    kept = {name: [path for path in paths if path not in smoke] for name, paths in files.items()}
    for paths in kept.values():
        paths.sort(key=lambda path: (-path.stat().st_mtime, path))
    return Found(root, {name: paths for name, paths in kept.items() if paths}, sorted(smoke), configurations)


def _is_kept_by_study(path: Path, root: Path) -> bool:
    """Return whether a file lies in a folder of INSIDE of a study. Folders of one's own may have these names, too."""
    own = (folder for folder in path.parents if folder.name in INSIDE and root in folder.parents)
    return any((above / TIMINGS).is_file() for folder in own for above in folder.parents[:2])


def smoke_results(files: Mapping[str, Sequence[Path]], records: Sequence[Path]) -> set[Path]:
    """Return the files of every study that ran at toy size: its record or its JSON says so, its files bear its name
    beside it, or are among those that either names."""
    every = [path for paths in files.values() for path in paths]
    found = {record.with_name(name) for record in records for name in _smoke_files(record)} & {*every}
    for numbers in (path for path in every if path.suffix == ".json"):
        figures = _smoke_figures(numbers)
        if figures is not None:
            beside = (path for path in every if path.parent == numbers.parent)
            mine = f"{numbers.stem}-"
            found |= {path for path in beside if f"{path.stem}-".startswith(mine) or path.name in figures}
    return found


def _smoke_files(path: Path) -> list[str]:
    """Return the files that a study's record names where it ran at toy size; none where not."""
    try:
        record = read_record(path)
    except InputError:
        return []  # the study warns of it when it is run again
    return [*record.files] if record.smoke else []


def _smoke_figures(path: Path) -> list[object] | None:
    """Return the figures that a study's numbers name where they are of the preset `smoke`, or rest on models of it;
    None where not."""
    try:
        numbers = read_json_object(path)
    except UNREADABLE:
        return None  # told where it is shown
    models, figures = rows_in(numbers.get("models")), numbers.get("figures")
    smoke = "smoke" in (numbers.get("preset"), *(model.get("preset") for model in models))
    return (figures if isinstance(figures, list) else []) if smoke else None


def read_png(path: Path) -> tuple[bytes, tuple[int, int]]:
    """Return a PNG's bytes and size; ValueError or OSError where it is none or cut."""
    data = path.read_bytes()
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        image.verify()
    if not data.rstrip(b"\0").endswith(b"IEND\xaeB`\x82"):
        raise ValueError("its end is missing")
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        return data, image.size


def read_rows(path: Path, texts: Collection[str] = ()) -> list[dict[str, int | float | str]]:
    """Return rows of a table, with its numbers as such but for the columns `texts`; InputError where it is none, or
    lines are cut."""
    return [{key: text if key in texts else _number(text) for key, text in row.items()} for row in read_csv(path)]


def _number(text: str) -> int | float | str:
    """Return a table's cell as the number that it spells as Python does; names such as 2026_11 and 007 are none."""
    if _WHOLE.fullmatch(text):
        return int(text)
    return float(text) if _REAL.fullmatch(text) else text


def rows_in(value: object) -> Sequence[dict[str, object]]:
    """Return the rows of a table in a JSON object; none where there is no table."""
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []
