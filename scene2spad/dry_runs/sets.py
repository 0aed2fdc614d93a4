"""Dry run of `dataset`: which views are missing, and their cost from views of this set, recorded or tried."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from render.settings import MIN_PIXEL_BYTES
from scene2spad.datasets.rendering import Job, check_asked, check_scenes, render_view
from scene2spad.datasets.set_folder import Done, SetFolder
from scene2spad.dry_runs.resources import memory
from scenes.errors import InputError
from scenes.io.inputs import read_whole_lines
from scenes.library.sets import scene_set

TRIALS = 3  # the first compiles; the others tell what a view costs


def dry_run(job: Job, count: int, out: Path, workers: int) -> dict:
    """Return what `make_set` would do, with memory, bytes and seconds, and what these are based on."""
    check_asked(job, count, workers)
    folder = SetFolder(out, job.made())
    check_scenes(job, folder)
    records = folder.records
    missing = folder.missing(count)
    camera = scene_set(job.set).view(0, seed=job.seed, width=job.width, height=job.height).camera
    timings = _recorded(out, records)
    tried = [] if timings or not missing else _trials(job, missing)
    sizes = [record["bytes"] for record in records.values()] or [len(one.exr) for one in tried if one.exr]
    each = fmean(timings or [one.seconds for one in tried[1:]] or [0.0])
    first = tried[0].seconds if tried else 0.0
    return {
        "dry_run": True,
        "set": job.set,
        "views": count,
        "finished": count - len(missing),
        "missing": len(missing),
        "pixels": [camera.width, camera.height],
        "workers": workers,
        "memory": memory(workers * MIN_PIXEL_BYTES * camera.width * camera.height, workers),
        "estimate": {
            "seconds": first + each * len(missing) / workers if missing else 0.0,
            "seconds_per_view": each,
            "bytes": round(fmean(sizes) * count) if sizes else 0,
        },
        "basis": _basis(timings, tried, missing),
        "out": str(out),
    }


def _basis(timings: list[float], tried: list[Done], missing: list[int]) -> str:
    if not missing:
        return "every view is there"
    if timings:
        return f"the recorded seconds of {len(timings)} views in this folder"
    views = ", ".join(str(one.record["view"]) for one in tried)
    shared = "; the set's common plan of rays is not part of it" if len(tried) > 1 else ""
    return f"a trial of views {views} in this process, the first of which compiles{shared}"


def _recorded(out: Path, records: dict[int, dict]) -> list[float]:
    lines = (line for line in read_whole_lines(out / "timings.jsonl") if isinstance(line, dict))
    known = [line["seconds"] for line in lines if line.get("view") in records and "seconds" in line]
    return [float(seconds) for seconds in known if isinstance(seconds, (int, float))]


def _trials(job: Job, missing: list[int]) -> list[Done]:
    """Render some views, spread over those that are missing, into memory."""
    number = min(TRIALS, len(missing))
    spread = sorted({missing[i * (len(missing) - 1) // max(number - 1, 1)] for i in range(number)})
    tried = [render_view(job, view) for view in spread]
    failed = [str(one.record["failed"]) for one in tried if one.exr is None]
    if len(failed) == len(tried):
        raise InputError(f"set {job.set}: no view of the trial could be rendered ({failed[0]})")
    return tried
