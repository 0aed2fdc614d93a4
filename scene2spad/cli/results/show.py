"""`show FILE`: a page to look into a file of ours, or a picture, an animation or a PDF of it."""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scene2spad.cli.opening import (
    BY_SUFFIX,
    kind_of,
    open_coding,
    open_depth,
    open_histogram,
    open_transient,
    transient_of,
)
from scene2spad.cli.paths import (
    PDF_FIGURE,
    PNG_FIGURE,
    Mark,
    beside_folder,
    check_target,
    holds_at_start,
    keep_foreign,
)
from scene2spad.options.common import Common, File, GivenFile, Positional, only_for
from scenes.errors import InputError, require
from scenes.files import read_csv
from scenes.io.inputs import read_text, read_whole_lines
from scenes.json_types import JsonObject
from scenes.progress import Progress

if TYPE_CHECKING:
    from scene2spad.viewer.content import Content, Cube

log = logging.getLogger("scene2spad")
ANIMATIONS = (".gif", ".mp4")
SUFFIXES = (".html", ".png", ".pdf", *ANIMATIONS)
MAX_TAPS = 65536  # bins of a pulse
MAX_SHEET = 24  # views of a set on its sheet
PAGE_MARK = b'content="scene2spad show"'
# Animations have no mark of ours: they are the encoders' alone.
MARKS = {
    ".html": Mark("page of `show`", lambda path: holds_at_start(path, PAGE_MARK)),
    ".png": PNG_FIGURE,
    ".pdf": PDF_FIGURE,
}


@dataclass(frozen=True, kw_only=True)
class Show(Common):
    """Make a page of a file: point at a pixel and see its returns, expected counts and detections, turn the point
    cloud, play the light. The page is one file and loads nothing. Or make a picture (.png, .pdf) or an
    animation (.gif, .mp4). FILE is anything that a command writes, or the name of a model of the package."""

    file: Positional[GivenFile]
    """The file, the folder of a set or of a run, or a model's name."""
    out: File = None
    """File to write: .html, .png, .pdf, .gif or .mp4 (default: room.histogram.html for a histogram room.h5)."""
    transient: File = None
    """The transient that a histogram was sensed from (default: the .exr beside it, if it is that one)."""
    view: int = 0
    """View of a pack, from 0."""
    frame: int = 0
    """Frame of a capture (.mat), from 0."""


def run(command: Show, progress: Progress) -> dict:
    """Open the file, and write its page or picture."""
    path = command.file
    kind = kind_of(path)
    out = command.out or page_of(path, kind)
    require(out.suffix.lower() in SUFFIXES, f"{out}: the output must end in {', '.join(SUFFIXES)}")
    drawn_with = kind == "histogram" and out.suffix.lower() not in ANIMATIONS
    purposes = {"transient": (drawn_with, "a histogram's page or picture"), "view": (kind == "pack", "a pack")}
    only_for(command, str(path), purposes | {"frame": (kind == "histogram", "captures (.mat)")})
    check_target(out, path)
    keep_foreign(out, MARKS.get(out.suffix.lower()))
    if out.suffix.lower() in (".png", ".pdf"):
        drawn = _picture(command, kind, out)
    elif out.suffix.lower() in ANIMATIONS:
        from scene2spad.viewer.animation import write_gif, write_mp4

        write = write_gif if out.suffix.lower() == ".gif" else write_mp4
        drawn = write(_cube(command, kind), out)
    else:
        from scene2spad.viewer.page import write_page

        drawn = write_page(_content(command, kind), out)
    return {"kind": kind, "bytes": drawn.stat().st_size, "out": str(drawn)}


def page_of(path: Path, kind: str) -> Path:
    """Name the page beside a file or a folder, so that no two sources have one page.

    With the kind, as pictures have it: a transient and its histogram have one name. Of endings that stand for one kind
    the first is left out, and all but it are in the name.
    """
    if path.is_dir():
        return beside_folder(path, f".{kind}.html")
    # a model's name has no ending
    usual = "" if kind == "network" else next((end for end, kinds in BY_SUFFIX.items() if kind in kinds), "")
    name = path.stem if usual and path.suffix == usual else path.name
    return path.with_name(f"{name}.{kind}.html")


def _content(command: Show, kind: str) -> Content:
    """Return what the page shows."""
    from scene2spad.viewer import sources
    from scene2spad.viewer.content import Content

    path = command.file
    if kind in ("transient", "pack"):
        title = path.name + (f", view {command.view}" if kind == "pack" else "")
        return sources.transient_content(open_transient(path, kind, command.view), title)
    if kind == "histogram":
        histogram = open_histogram(path, command.frame)
        title = path.name + (f", frame {command.frame}" if command.frame else "")
        return sources.histogram_content(histogram, title, transient_of(histogram, path, command.transient))
    if kind == "depth":
        found = open_depth(path)
        return sources.depth_content(found.depth_m, found.confidence, found.meta, path.name)
    if kind in ("dense", "cloud"):
        from scene2spad.viewer import exports

        return exports.dense_content(path) if kind == "dense" else exports.cloud_content(path)
    if kind in ("program", "text"):
        titles = {"program": "program of the in-pixel core", "text": "text: a program's listing, or codes"}
        return Content(path.name, {"kind": titles[kind]}, text=read_text(path))
    if kind == "table":
        rows = read_csv(path)
        require(bool(rows), f"{path}: an empty table")
        return Content(path.name, {"kind": "table", "rows": str(len(rows))}, tables=((path.name, rows),))
    figure = _as_png(command, kind)
    facts, tables = _facts(command, kind)
    return Content(path.name, {"kind": kind, **facts}, figures=((path.name, figure),), tables=tables)


def _facts(command: Show, kind: str) -> tuple[dict[str, str], tuple[tuple[str, list[dict[str, object]]], ...]]:
    """Read the facts that a sensor, a code, a model or a set states of itself: short facts, and tables."""
    path = command.file
    if kind == "sensor":
        from spad.sensor.files import read_sensor, sensor_tables

        contents = read_sensor(path)
        rows = [
            {"table": name, "key": key, "value": value, "source": contents.sources.get(f"{name}.{key}", "")}
            for name, table in sensor_tables(contents).items()
            if isinstance(table, dict) and name != "sources"
            for key, value in table.items()
        ]
        return {"sensor": contents.sensor.name}, (("What the file states", rows),)
    if kind == "set":
        records = _index(path)
        failed = sum("failed" in record for record in records)
        facts = {"views": str(len(records) - failed)} | ({"failed": str(failed)} if failed else {})
        return facts, (("Views", [_flat(record) for record in records]),)
    model: list[JsonObject] = []
    if kind == "network":
        from csph.weights.cards import checkpoint_of
        from csph.weights.shipped import CARD

        source = checkpoint_of(path)
        card = source / CARD if source.is_dir() else source.with_name(CARD)
        model = [{"key": k, "value": v} for k, v in _model_facts(source, card).items()]
    return {}, ((("What made it", model),) if model else ())


def _model_facts(source: Path, card: Path) -> dict[str, object]:
    if card.is_file():
        from csph.weights.cards import read_card

        return read_card(card).to_dict()
    from csph.networks.checkpoint import load_model

    model, config, state = load_model(source)
    return {"name": config.model.name, "parameters": model.parameters_count, **state, **_flat(config.to_dict())}


def _flat(record: Mapping[str, object]) -> dict[str, object]:
    return {key: json.dumps(value) if isinstance(value, (dict, list)) else value for key, value in record.items()}


def _index(folder: Path) -> list[JsonObject]:
    """Return the records of a set in the order of its views, those of one that is being rendered too. A view that was
    tried again, or whose line is in both files since a process was killed between them, has one."""
    lines = [line for name in ("index.jsonl", "journal.jsonl") for line in read_whole_lines(folder / name)]
    known = {line["view"]: line for line in lines if isinstance(line, dict) and isinstance(line.get("view"), int)}
    require(bool(known), f"{folder}: a set without a view")
    return [known[view] for view in sorted(known)]


def _as_png(command: Show, kind: str) -> bytes:
    with tempfile.TemporaryDirectory(prefix="scene2spad-") as folder:
        return _picture(command, kind, Path(folder) / "figure.png").read_bytes()


def _picture(command: Show, kind: str, out: Path) -> Path:
    """Draw the file's figure, as PNG or PDF."""
    from scene2spad.plots import figures

    path = command.file
    if kind in ("transient", "pack"):
        return figures.draw_transient(open_transient(path, kind, command.view), out)
    if kind == "histogram":
        return _histogram_figure(command, out)
    if kind == "depth":
        found = open_depth(path)
        return figures.draw_depth_map(found.depth_m, found.confidence, str(found.meta.get("method", "depth")), out)
    if kind == "sensor":
        from spad.sensor.files import read_sensor

        return figures.draw_pulse(read_sensor(path).sensor, out)
    if kind == "set":
        from render.transient import read_transient
        from scene2spad.datasets.contact_sheets import draw_views

        files = [path / record["file"] for record in _index(path) if record.get("file")][:MAX_SHEET]
        require(bool(files), f"{path}: a set without a view that was rendered")
        return draw_views([read_transient(file) for file in files], out, columns=min(8, len(files)))
    if kind == "pulse":
        from spad.formats.mat import read_taps

        return figures.draw_taps(read_taps(path, MAX_TAPS), out)
    if kind in ("network", "codes"):
        from scene2spad.studies.tensors import draw

        return draw([open_coding(path, kind)], out)
    raise InputError(f"{path}: is of kind {kind}, which has no picture; write a page (.html)")


def _histogram_figure(command: Show, out: Path) -> Path:
    from functools import partial

    from scene2spad.plots.pixels import draw_histogram
    from spad.detection.detect import expected_in_pixel

    histogram = open_histogram(command.file, command.frame)
    transient, rate = transient_of(histogram, command.file, command.transient), None
    if transient is not None:
        seed = int(histogram.meta.get("seed", 0))
        rate = partial(expected_in_pixel, transient, histogram.sensor, histogram.budget, seed=seed)
    return draw_histogram(histogram, out, expected=rate)


def _cube(command: Show, kind: str) -> Cube:
    """Return what an animation plays."""
    from scene2spad.viewer import sources

    path = command.file
    if kind in ("transient", "pack"):
        return sources.light_over_path(open_transient(path, kind, command.view))
    if kind == "histogram":
        return sources.detections(open_histogram(path, command.frame))
    raise InputError(f"{path}: is of kind {kind}, which has nothing to play; expected a transient, pack or histogram")
