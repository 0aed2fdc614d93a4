"""The index of a rendered set's folder, `index.jsonl`: one JSON object a line, in the order of the views."""

from __future__ import annotations

from pathlib import Path

from scenes.errors import InputError, require
from scenes.io.inputs import file_inside, parse_json, read_text, read_whole_lines
from scenes.json_types import JsonObject


def read_set_index(folder: Path) -> list[JsonObject]:
    """Return the records of a set's finished views in order; those of failed views are left out.

    Every `file` of a record is a regular file inside the folder. Raises InputError in one line where there is no
    index, where a line of it is damaged, and where views were added since it was written: the set is not finished.
    """
    folder = Path(folder)
    index = folder / "index.jsonl"
    require(index.exists(), f"{folder}: no set of scene2spad (no index.jsonl); make one with scene2spad dataset")
    text = read_text(index, "index")
    require(not text or text.endswith("\n"), f"{index}: is damaged, its end is missing; run scene2spad dataset again")
    records, last = [], -1
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        try:
            last, record = _checked(folder, line, last)
        except InputError as error:
            raise InputError(f"{index}: is damaged, line {number} {error}; run scene2spad dataset again") from None
        if "failed" not in record:
            records.append(record)
    more = _added(folder) - {record["view"] for record in records}
    message = f"{folder}: was left unfinished, {len(more)} views more are in journal.jsonl than in its index"
    require(not more, f"{message}; run scene2spad dataset again")
    return records


def _added(folder: Path) -> set[int]:
    """Return the views that a run has finished whose end, the index, is not written yet."""
    lines = (line for line in read_whole_lines(folder / "journal.jsonl") if isinstance(line, dict))
    return {line["view"] for line in lines if "failed" not in line and isinstance(line.get("view"), int)}


def _checked(folder: Path, line: str, last: int) -> tuple[int, JsonObject]:
    """Return a line's view and record; InputError where it is none, or not of a later view than `last`."""
    record = parse_json(line)
    if not isinstance(record, dict):
        raise InputError("holds no JSON object")
    view, file = record.get("view"), record.get("file")
    if not isinstance(view, int) or isinstance(view, bool) or view <= last:
        raise InputError(f"is of view {view!r}, expected a whole number above {last}")
    if "failed" not in record:
        if not isinstance(file, str):
            raise InputError(f"names the file {file!r}, expected a path in the folder")
        file_inside(folder, file, "view", "the set's folder")
    return view, record
