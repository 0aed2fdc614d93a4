"""Run a study by its name, or all of them one after the other; seconds and a record of each lie beside its results."""

from __future__ import annotations

import importlib
import json
import logging
import time
from dataclasses import replace
from importlib.util import find_spec
from types import ModuleType

from scene2spad.options.experiments import ABLATIONS, NO_PRESET, OPTIONS_OF, STUDIES, Study
from scene2spad.studies.records import asked_of, last_record, write_record
from scenes.errors import InputError
from scenes.files import append_line
from scenes.json_types import JsonObject
from scenes.progress import Progress

log = logging.getLogger("scene2spad")

TIMINGS = "timings.jsonl"
ALL = "all"
SMOKE_MARK = "smoke run: toy size or trained for seconds"


def run(command: Study, progress: Progress) -> dict:
    """Run one study, or with `all` every one; see `run_all`."""
    if command.name == ALL:
        return run_all(command, progress)
    return run_one(command, progress)


def module_of(name: str) -> ModuleType:
    """Return the module of a study, imported now."""
    room = f"scene2spad.studies.{'ablations' if name in ABLATIONS else name.replace('-', '_')}"
    spec = find_spec(room)
    return importlib.import_module(room if spec is None or spec.submodule_search_locations is None else f"{room}.study")


def run_one(command: Study, progress: Progress) -> dict:
    """Run the study of the command's name; its record is written, and its seconds are appended to TIMINGS."""
    start = time.perf_counter()
    from scene2spad.plots.style import marked  # with matplotlib, which a dry run does without

    mark = mark_of(command)
    with marked(mark):
        result = module_of(command.name).run(command, progress)
    write_record(command, result, smoke=bool(mark))
    took = {"study": command.name, "preset": command.preset, "seconds": round(time.perf_counter() - start, 3)}
    append_line(command.out / TIMINGS, json.dumps(took))
    return result


def mark_of(command: Study) -> str:
    """Return what is written across figures of a smoke run; nothing on those that the preset does not change."""
    given = command.name == "real-data" and command.capture  # `study all` gives captures to every study
    toy = command.preset == "smoke" and command.name not in NO_PRESET and not given
    return SMOKE_MARK if toy else ""


def run_all(command: Study, progress: Progress) -> dict:
    """Run every study with the same options; the data of some may be absent.

    A study whose last run here came to its end with these options is not run again, as long as its files are as it
    wrote them, and nothing is to be shipped. Returns a table of all: done, done before, or left out and why. Raises
    InputError where not one could be run.
    """
    rows: list[JsonObject] = []
    for number, name in enumerate(STUDIES):
        one = replace(command, name=name)
        row = _finished(one)
        if row is None:
            log.info("study %s (%d of %d)", name, number + 1, len(STUDIES))
            row = _attempt(one, _part(progress, name, number))
        rows.append(row)
    if all(row["status"] == "left out" for row in rows):
        raise InputError(f"study all: none could be run; {rows[0]['study']}: {rows[0]['why']}")
    left = [row["study"] for row in rows if row["status"] == "left out"]
    shown = rows if command.json else _table(rows)
    return {"studies": shown, "left_out": left, "preset": command.preset, "out": str(command.out)}


def _attempt(command: Study, progress: Progress) -> dict:
    start = time.perf_counter()
    try:
        result = run_one(command, progress)
    except InputError as error:
        why = " ".join(str(error).split())
        log.warning("study %s: left out, %s", command.name, why)
        return {"study": command.name, "status": "left out", "seconds": time.perf_counter() - start, "why": why}
    figures = [str(path) for path in result.get("figures", [])]
    seconds = time.perf_counter() - start
    return {"study": command.name, "status": "done", "seconds": seconds, "figures": figures}


def _finished(command: Study) -> dict | None:
    """Return the row of a study that has been run with these options; None where it is to be run."""
    if command.ship and command.name in OPTIONS_OF["ship"]:
        return None  # no record tells what was put into the package
    known = last_record(command)
    if known is None or known.asked != asked_of(command) or len(known.intact(command.out)) < len(known.files):
        return None
    figures = [str(command.out / name) for name in known.files if name.endswith(".png")]
    return {"study": command.name, "status": "done before", "seconds": 0.0, "figures": figures}


def _part(progress: Progress, name: str, number: int) -> Progress:
    return lambda what, fraction: progress(f"{name}: {what}", (number + fraction) / len(STUDIES))


def _table(rows: list[dict]) -> list[str]:
    return [
        f"{row['study']:<14} {row['status']:<12} {row['seconds']:8.1f} s  "
        + (row["why"] if "why" in row else f"{len(row['figures'])} figures")
        for row in rows
    ]
