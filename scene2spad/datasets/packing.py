"""Pack the finished views of a set's folder as one file (`render.transient.packs`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from scene2spad.datasets.rendering import Job
from scenes.errors import InputError, require
from scenes.io.set_index import read_set_index
from scenes.library.sets import scene_set
from scenes.progress import Progress


def check_one_size(job: Job, count: int, path: Path) -> None:
    """Raise InputError where the first `count` views of a set are of several sizes, which no pack holds, before any of
    them is rendered."""
    chosen = scene_set(job.set)
    if chosen.size is None or None not in (job.width, job.height):  # views of endless sets are of one size
        return
    some = range(min(count, chosen.size))
    cameras = [chosen.view(view, seed=job.seed, width=job.width, height=job.height).camera for view in some]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    several = ", ".join(f"{width} x {height}" for width, height in sizes)
    message = f"{path}: views of {job.set} are of several sizes ({several}), a pack holds one"
    require(len(sizes) <= 1, f"{message}; give --width and --height, or leave out --pack")


def pack_set(folder: Path, path: Path, progress: Progress | None = None, *, count: int | None = None) -> int:
    """Write the finished views of a set's folder as one file, and return how many there are.

    `count`: of the first so many views alone (default: of all). Raises InputError where there are none, or a view is
    damaged.
    """
    from render.transient import read_transient
    from render.transient.packs import write_pack

    records = [one for one in read_set_index(folder) if count is None or one["view"] < count]
    require(bool(records), f"{folder}: holds no finished view to pack")
    report = progress or (lambda what, fraction: None)

    def views() -> Iterator[tuple]:
        for i, record in enumerate(records):
            report("pack", i / len(records))
            try:
                transient = read_transient(folder / record["file"])
            except InputError as error:
                raise InputError(f"{error}; delete it, and `dataset` renders it again") from None
            kept = {key: transient.meta[key] for key in ("camera", "laser", "scene_sha256")}
            kept["notes"] = transient.meta.get("notes", [])  # they name the seed of the set
            yield transient, record | kept | {"time_offset_m": transient.meta.get("time_offset_m", 0.0)}

    return write_pack(views(), path)
