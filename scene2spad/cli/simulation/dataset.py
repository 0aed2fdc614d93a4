"""Render a scene set to a folder, and pack it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from render.settings import FILTERED_AMBIENT_SPP
from scene2spad.cli.paths import file_stem, output_file, output_folder
from scene2spad.options.common import (
    Count,
    File,
    Long,
    Number,
    Offset,
    Pixels,
    Positional,
    check_indirect,
    may_stay_open,
    only_for,
    word,
)
from scenes.library.sets import scene_set
from scenes.progress import Progress


@dataclass(frozen=True, kw_only=True)
class Dataset(Long):
    """Render a scene set to a folder of EXR files with an index; stopped at any moment, it goes on where it was."""

    set: Positional[Annotated[str, word("[SET]")]] = "rooms"
    """rooms, clutter (both also as in rooms/val and rooms/test), tabletop, middlebury or hard-cases."""
    count: Count = None
    """Views (default: all of a finite set, 100 of rooms and clutter)."""
    out: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder of the set (default: out/ and the set's name)."""
    workers: int = 1
    """Processes on this machine."""
    scheduler: Annotated[str | None, may_stay_open("ADDRESS")] = None
    """Address of a running Dask scheduler, tcp://HOST:PORT, instead of processes here."""
    pack: File = None
    """Make one .h5 file of the finished set, which training reads without a renderer."""
    width: Pixels = None
    """Image width, pixels (default: 64 of rooms and clutter, the scenes' own of others). One side alone makes images of
    rooms and clutter square, and keeps the proportions of others."""
    height: Pixels = None
    """Image height, pixels."""
    bounces: Count = None
    """Surfaces light may meet, 1 = direct only (default: planned for each view)."""
    spp: Count = None
    """Indirect light paths per pixel (default: planned for each view)."""
    filter: bool = False
    """Average late indirect light over small regions of surfaces, as `render` does: biased, and in sets of small views
    slower."""
    grid: Count = None
    """Direct rays per pixel side (default: planned, one for all views of an endless set)."""
    error: Number = None
    """Target of the relative error (default: 0.01 with 1 bounce, 0.03 with more)."""
    ambient: bool = True
    """Render ambient light."""
    ambient_spp: int = FILTERED_AMBIENT_SPP
    """Paths per pixel of ambient light, which neighbouring pixels share."""
    offset: float = 0.0
    """Move every scene this many metres away."""
    offset_mode: Offset = "time"
    """Offset mode, as in `render`: time, ray or rigid."""


def run(command: Dataset, progress: Progress) -> dict:
    """Run the command: A scene set -> a folder of .exr files, and one .h5 of them all."""
    from scene2spad.datasets.packing import check_one_size, pack_set
    from scene2spad.datasets.rendering import Job, make_set
    from scene2spad.datasets.workers import check_address

    if command.scheduler is not None:
        check_address(command.scheduler)
    check_indirect(command, "dataset", command.bounces, ("spp", "filter"))
    purposes = {"ambient_spp": (command.ambient, "ambient light (no --no-ambient)")}
    purposes |= {"offset_mode": (command.offset != 0, "scenes that are moved (--offset)")}
    purposes |= {"workers": (command.scheduler is None, "processes of this machine (no --scheduler)")}
    only_for(command, "dataset", purposes)
    of = scene_set(command.set)
    error = (0.01 if command.bounces == 1 else 0.03) if command.error is None else command.error
    job = Job(
        of.name, command.seed, command.width, command.height, command.bounces, command.spp, command.grid, error,
        command.offset, command.offset_mode, command.ambient, command.ambient_spp, filter=command.filter,
    )  # fmt: skip
    out = command.out or Path("out") / file_stem(of.name)
    if command.pack is not None:
        output_file(command.pack, ".h5", "pack", made=out)
    output_folder(out, "the set")
    count = command.count if command.count is not None else of.size or 100
    if command.pack is not None:
        check_one_size(job, count, command.pack)
    if command.dry_run:
        from scene2spad.dry_runs.sets import dry_run

        return dry_run(job, count, out, command.workers)
    result = make_set(job, count, out, workers=command.workers, scheduler=command.scheduler, progress=progress)
    if command.pack is not None:
        views = pack_set(out, command.pack, progress, count=count)
        result |= {"pack_views": views, "pack_bytes": command.pack.stat().st_size, "pack": str(command.pack)}
    return result
