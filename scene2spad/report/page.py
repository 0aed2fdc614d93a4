"""`report`: one self-contained HTML page of everything that benches and studies have left in a folder.

What is expected stands in `report_plan`; files are found by their names, wherever they lie in the folder. A file that
is absent or cannot be read costs a line in the page, never the page.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from scene2spad.options.experiments import Report
from scene2spad.report import html
from scene2spad.report import published as beside_print
from scene2spad.report.evaluations import read_summary
from scene2spad.report.files import CONFIGURATIONS, Found, gather, read_png, read_rows, rows_in
from scene2spad.report.plan import NEVER, SECTIONS, Item, Picture, Table
from scenes.errors import InputError, require
from scenes.files import whole_file
from scenes.io.inputs import read_json_object
from scenes.io.set_index import read_set_index
from scenes.io.versions import installed_versions
from scenes.json_types import JsonObject
from scenes.progress import Progress

TITLE = "scene2spad: results"
PACKAGES = ("scene2spad", "mitsuba", "drjit", "torch", "pytorch-lightning", "numpy", "scipy", "OpenEXR", "matplotlib")
MAX_CONFIGURATIONS = 200


def run(command: Report, progress: Progress) -> dict:
    """Gather, compose, write; says what is in the page and what is not."""
    out = command.out
    require(out.suffix.lower() in (".html", ".htm"), f"{out}: the report must end in .html")
    foreign = out.is_file() and html.GENERATOR not in out.read_text(encoding="utf-8", errors="replace")[:4000]
    if foreign:
        raise InputError(f"{out}: exists and is no report of scene2spad; choose another --out")
    progress("gather", 0.1)
    found = gather(command.results)
    progress("compose", 0.4)
    text = compose(found)
    with whole_file(out) as beside:
        # names of files may hold bytes that are no text
        beside.write_text(text, encoding="utf-8", errors="backslashreplace")
    missing: list[Any] = [{"command": made, "files": names} for made, names in found.missing.items()]
    if not command.json:
        missing = [f"{made}: {', '.join(names)}" for made, names in found.missing.items()]
    common = {"bytes": out.stat().st_size, "figures": len(found.shown), "tables": found.tables}
    return {"out": str(out), **common, "problems": found.problems, "missing": missing}


def compose(found: Found) -> str:
    """Return the page."""
    body: list[str] = []
    contents: list[html.Entry] = []
    for part in SECTIONS:
        items = [(item, text) for item in part.items if (text := _item(item, found))]
        if items:
            body.append(html.section(part.anchor, part.title, [text for _, text in items]))
            contents.append((part.anchor, part.title, [(item.anchor, item.title) for item, _ in items]))
    configurations, more, toys = list(_configurations(found)), _others(found), _smoke(found)
    ends = (
        ("others", "Other results", more) if more else None,
        ("smoke", "Smoke runs: toy sizes, no results", toys) if toys else None,
        ("configurations", "Configurations and versions", configurations),
        ("not-measured", "What was not measured", list(_not_measured(found))),
    )
    for anchor, title, lines in filter(None, ends):
        body.append(html.section(anchor, title, lines))
        contents.append((anchor, title, ()))
    size = sum(map(len, body)) / 2**20
    lead = [
        html.paragraph(
            f"{len(found.shown)} figures and {found.tables} tables from {found.root.name or 'results'}, "
            f"{size:.1f} MiB. The page holds everything it shows and loads nothing."
        ),
    ]
    return html.page(TITLE, lead, contents, body)


# Items


def _item(item: Item, found: Found) -> str:
    """Format what was measured of an item; nothing where that is nothing. What is missing goes into the list at the
    end."""
    absent: dict[str, list[str]] = {}
    parts = beside_print.published_tables(item.published, lambda name: _rows_of(Table(name, ""), found)[0])
    found.tables += sum("<table>" in part for part in parts)
    parts += [_picture(one, item, found, absent) for one in item.pictures]
    parts += [_table(one, item, found, absent) for one in item.tables]
    parts += [_named(name, item, found, absent) for name in item.data]
    for command, names in absent.items():
        found.missing.setdefault(command, []).extend(n for n in names if n not in found.missing.get(command, []))
    measured = [part for part in parts if part]
    if not measured:
        return ""
    lines = [html.paragraph(text) for text in (item.text, *_notes(item, found)) if text]
    return html.section(item.anchor, item.title, [*lines, *measured], level=3)


def _notes(item: Item, found: Found) -> Iterator[str]:
    """Describe the models that a study rests on, as its own JSON states them."""
    for name in dict.fromkeys(one.file for one in item.tables if one.file.endswith(".json")):
        path = found.newest(name)
        numbers = (None if path is None else found.read(path, read_json_object)) or {}
        models = rows_in(numbers.get("models"))
        kinds = dict.fromkeys(f"{m.get('preset')}, {m.get('steps')} steps on {m.get('trained_on')}" for m in models)
        if kinds:
            yield f"{len(models)} trained models: {'; '.join(kinds)}."
        if numbers.get("absent"):
            yield f"Models that were absent: {html.format_value(numbers['absent'])}."


def _absent(file: str, command: str, path: Path | None, absent: dict[str, list[str]]) -> str:
    """One line for a file that could not be read; one that is not there is put down by the command that makes it."""
    if path is not None:
        return html.paragraph(f"{file} was found, but what should stand here cannot be read from it.", "problem")
    names = absent.setdefault(command, [])
    if file not in names:
        names.append(file)
    return ""


def _picture(one: Picture, item: Item, found: Found, absent: dict[str, list[str]]) -> str:
    path = found.newest(one.file)
    read = None if path is None else found.read(path, read_png)
    if path is None or read is None:
        return _absent(one.file, one.command or item.command, path, absent)
    return _figure(read, f"{one.shows}.", f"{one.shows}. ({found.caption(path)})", found)


def _figure(read: tuple[bytes, tuple[int, int]], alt: str, caption: str, found: Found) -> str:
    """Return the picture, or where the same stands already, a link to it."""
    data, size = read
    anchor = f"picture-{hashlib.sha256(data).hexdigest()[:16]}"
    if anchor in found.shown:
        return f"<p>{html.link(anchor, caption)}: shown above.</p>"
    found.shown.add(anchor)
    return html.picture(anchor, data, size, alt, caption)


def _rows_of(one: Table, found: Found) -> tuple[list[dict] | None, Path | None]:
    path = found.newest(one.file)
    reader: Callable[[Path], object] = read_json_object if one.file.endswith(".json") else read_rows
    read = None if path is None else found.read(path, reader)
    if path is None or read is None:
        return None, path
    rows = read.get(one.key) if isinstance(read, dict) else read
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        found.problem(f"{path.relative_to(found.root)}: has no table {one.key}")
        return None, path
    if one.columns:
        rows = [{name: row.get(name) for name in one.columns} for row in rows if row.get("chief", True)]
    return rows, path


def _table(one: Table, item: Item, found: Found, absent: dict[str, list[str]]) -> str:
    if one.evaluation:
        return _evaluations(one, item, found, absent)
    rows, path = _rows_of(one, found)
    if path is None or rows is None:
        return _absent(one.file, item.command, path, absent)
    if not rows:
        return html.paragraph(f"{one.shows}: none in {found.caption(path)}.")
    found.tables += 1
    return html.table(rows, f"{one.shows} ({found.caption(path)})")


def _evaluations(one: Table, item: Item, found: Found, absent: dict[str, list[str]]) -> str:
    """Return the means of every evaluation, a table for each folder, in the order of their names."""
    newest = found.newest(one.file)
    tables = []
    for path in sorted(found.files.get(one.file, [])):
        summary = found.read(path, read_summary)
        if summary is not None and summary.rows:
            views, levels = (
                f"{count} {noun}{'s' * (count != 1)}"
                for count, noun in ((summary.views, "view"), (summary.levels, "photon level"))
            )
            beside = path.with_suffix(".json")
            of = found.read(beside, read_json_object) if beside.is_file() else None
            words = f"; {html.format_value(of)}" if of else ""
            tables.append(html.table(summary.rows, f"{one.shows}: {views} at {levels}{words} ({found.place(path)})"))
    found.newest(Path(one.file).with_suffix(".json").name)
    found.tables += len(tables)
    return "\n".join(tables) or _absent(one.file, item.command, newest, absent)


def _named(name: str, item: Item, found: Found, absent: dict[str, list[str]]) -> str:
    """Name a table too long to show: its name and length."""
    path = found.newest(name)
    rows = None if path is None else found.read(path, read_rows)
    if path is None or rows is None:
        return _absent(name, item.command, path, absent)
    return f"<p>In full: {html.code(found.caption(path))}, {len(rows)} rows.</p>"


# The rest


def _others(found: Found) -> list[str]:
    """Pictures and tables that no item expects; JSON and tables beside a study's are named alone."""
    parts, names = [], []
    for path in [paths[0] for _, paths in sorted(found.files.items())]:
        if path in found.used:
            continue
        if path.suffix == ".png":
            read = found.read(path, read_png)
            if read is not None:
                shows = path.stem.replace("-", " ").replace(".", ", ")
                parts.append(_figure(read, f"{shows}.", found.caption(path), found))
        else:
            names.append(html.code(found.caption(path)))
    return [*parts, *([html.paragraph("Named alone:"), html.bullets(names)] if names else [])]


def _smoke(found: Found) -> list[str]:
    """Pictures of smoke runs, and the names of their tables: never beside printed numbers."""
    if not found.smoke:
        return []
    summary = "Made with --preset smoke, in a minute, to see that all runs. These numbers say nothing of the methods."
    parts, names = [html.paragraph(summary, "problem")], []
    for path in found.smoke:
        message = f"smoke: {path.relative_to(found.root)}"
        read = found.read(path, read_png) if path.suffix == ".png" else None
        if read is not None:
            parts.append(_figure(read, f"{message}.", message, found))
        elif path.suffix != ".png":
            names.append(html.code(str(path.relative_to(found.root))))
    return [*parts, html.bullets(names)] if names else parts


def _configurations(found: Found) -> Iterator[str]:
    versions = {"Python": platform.python_version(), **installed_versions(*PACKAGES)}
    found.tables += 1
    yield html.table(
        [{"what": name, "version": one} for name, one in versions.items()], "Versions that this page was made with"
    )
    for name in ("bench-render.json", "bench-encode.json"):
        path = found.newest(name)
        machine = ((found.read(path, read_json_object) if path else None) or {}).get("machine")
        if machine:
            yield html.paragraph(f"{name} was measured on: {html.format_value(machine)}.")
    models = list(_models(found))
    if models:
        found.tables += 1
        yield html.table(models, "Models that studies stood on", MAX_CONFIGURATIONS)
    for name, (title, columns) in CONFIGURATIONS.items():
        rows = [
            {
                "folder": str(path.parent.relative_to(found.root)),
                **(_views_of(path.parent, found) if name == "set.json" else {}),
                **_flat(numbers, columns),
            }
            for path in found.configurations[name]
            if (numbers := found.read(path, read_json_object)) is not None
        ]
        if rows:
            found.tables += 1
            yield html.table(rows, f"{title} ({name} of each)", MAX_CONFIGURATIONS)


def _views_of(folder: Path, found: Found) -> dict[str, object]:
    """Count a set's views, and those that end above their error target; nothing where there is no index."""
    index = folder / "index.jsonl"
    records = found.read(index, lambda path: read_set_index(path.parent)) if index.is_file() else None
    if records is None:
        return {}
    missed = sum(record.get("target_met") is False for record in records)
    return {"views": len(records), "above the error target": f"{missed} (!)" if missed else missed}


def _models(found: Found) -> Iterator[dict]:
    seen = set()
    for name, paths in sorted(found.files.items()):
        numbers = found.read(paths[0], read_json_object) if name.endswith(".json") else None
        for model in rows_in((numbers or {}).get("models")):
            digest = str(model.get("sha256", ""))
            if digest not in seen:
                seen.add(digest)
                yield {**model, "sha256": digest[:12]}


def _flat(numbers: Mapping[str, object], columns: Sequence[str]) -> dict[str, object]:
    """Plain values, and those one level beneath by both names; where columns are named, these alone."""
    flat: JsonObject = {}
    for key, value in numbers.items():
        if isinstance(value, Mapping):
            flat |= {f"{key} {inner}": one for inner, one in value.items() if not isinstance(one, (Mapping, list))}
        else:
            flat[key] = value
    return {key: flat[key] for key in columns or flat if key in flat}


def _not_measured(found: Found) -> Iterator[str]:
    if found.missing:
        yield html.paragraph("Not found, and the command that makes it:")
        yield html.bullets(
            f"{html.code(command)}: {', '.join(map(html.code, names))}" for command, names in found.missing.items()
        )
    else:
        yield html.paragraph("Every result that belongs here was found.")
    if found.problems:
        yield html.paragraph("Found, but not readable:")
        yield html.bullets(html.code(line) for line in found.problems)
    open_ = list(_undecided(found))
    if open_:
        yield html.paragraph("Measured, but not decided:")
        yield html.bullets(map(escape, open_))
    yield html.paragraph("Not to be measured here at all:")
    yield html.bullets(map(escape, NEVER))


def _undecided(found: Found) -> Iterator[str]:
    """Conclusions whose interval leaves them open, by study."""
    for name, paths in sorted(found.files.items()):
        numbers = found.read(paths[0], read_json_object) if name.endswith(".json") else None
        for one in rows_in((numbers or {}).get("conclusions")):
            whole = "ranking" not in one or one.get("levels") == "all"
            if whole and "not decided" in (one.get("verdict"), one.get("ranking")):
                message = one.get("claim") or f"ranking of codes, {one.get('laser')} laser, step {one.get('step')}"
                yield f"{Path(name).stem}: {message}{f' ({why})' if (why := one.get('why')) else ''}"
