"""Render a scene set to a folder: one EXR a view, one index, on one process, several, or a Dask cluster.

Every view is a function of the set, the seed and its number: who renders it, when, and after what, changes no byte.
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from render.settings import FILTERED_AMBIENT_SPP, MIN_PIXEL_BYTES, Plan, RenderSettings
from scene2spad.datasets.set_folder import Done, SetFolder, file_name
from scene2spad.datasets.workers import Run, check_workers, executor
from scenes.errors import InputError, require, told_apart
from scenes.files import whole_file
from scenes.io.inputs import read_json_object
from scenes.library.sets import LARGEST, scene_set
from scenes.limits import require_memory
from scenes.model import MAX_IMAGE_SIDE, Scene
from scenes.offsets import OffsetMode, check_offset
from scenes.progress import Progress
from scenes.random_streams import Stream

if TYPE_CHECKING:
    from render.scene.traced_scene import TracedScene

log = logging.getLogger("scene2spad")

# Of path. Merged returns keep energy, centroid and variance, and the error estimate sees what merging changes.
DIRECT_TOLERANCE_M, INDIRECT_TOLERANCE_M, INDIRECT_GROWTH = 0.08, 0.08, 0.15
# Of the squared error target: a set's views are to meet it together, not each by itself. With indirect light plans do
# better than they promise: they take too little power for mixed pixels, and round paths up (measured).
AIM, INDIRECT_AIM = 0.95, 1.15
# Where there is indirect light, in rooms (measured, CPU seconds at one error): finer cells cost less than the paths
# that they spare, and even blocks need few paths, as a set's views meet their target together.
DIRECT_FRACTION, SET_MIN_SPP = 0.25, 8
PLANNED_PLACES, OF_A_PLACE = 8, 3  # views that tell how many rays an endless set takes
THINNED = 0.02  # of a pixel, the most that merging neighbouring direct returns changes after the reference pulse
# of the last place
_WORLDS: dict[tuple, TracedScene] = {}
_PLANS: dict[tuple[Job, str], Plan] = {}
_ONE_AT_A_TIME = Lock()  # Dr.Jit works on one scene at a time, but a Dask worker may have several threads


@dataclass(frozen=True)
class Job:
    """Everything that decides the bytes of a set's views, but for their number.

    merging     how much of a set's merging of returns is done: 1 as sets are written, 0.1 for references
    edge_threshold as of `RenderSettings`; what `grid.json` says, where a set plans its rays
    """

    set: str
    seed: int = 0
    width: int | None = None
    height: int | None = None
    bounces: int | None = None
    spp: int | None = None
    grid: int | None = None
    error: float | None = None
    offset_m: float = 0.0
    offset_mode: OffsetMode = "time"
    ambient: bool = True
    ambient_spp: int = FILTERED_AMBIENT_SPP
    merging: float = 1.0
    edge_threshold: float | None = None
    filter: bool = False

    def __post_init__(self) -> None:
        scene_set(self.set)
        check_offset(self.offset_m)
        self.settings()

    def settings(self) -> RenderSettings:
        return RenderSettings(
            bounces=self.bounces,
            spp=self.spp,
            filter=self.filter,
            grid=self.grid,
            edge_threshold=self.edge_threshold,
            error=self.error,
            min_spp=SET_MIN_SPP,
            direct_fraction=DIRECT_FRACTION,
            target_fraction=AIM if self.bounces == 1 else INDIRECT_AIM,
            ambient_spp=self.ambient_spp,
            ambient_filtered=True,
            direct_tolerance_m=self.merging * DIRECT_TOLERANCE_M,
            indirect_tolerance_m=self.merging * INDIRECT_TOLERANCE_M,
            indirect_growth=self.merging * INDIRECT_GROWTH,
        )

    def made(self) -> dict:
        """Return all that decides the bytes of its views, this version's choices included."""
        tolerances = [
            DIRECT_TOLERANCE_M,
            INDIRECT_TOLERANCE_M,
            INDIRECT_GROWTH,
            THINNED,
            self.settings().target_fraction,
            DIRECT_FRACTION,
            SET_MIN_SPP,
        ]
        mode = self.offset_mode if self.offset_m else "time"  # of a scene that stays where it is they are all one
        return asdict(self) | {"offset_mode": mode, "schema": 10, "tolerances": tolerances}


def render_view(job: Job, view: int, again: int = 0) -> Done:
    """Render one view to EXR bytes. A view that cannot be rendered is a record with `failed`, not an exception.

    `again` from 1 on renders the same scene with other noise than the set's.
    """
    start = time.perf_counter()
    where = f"{os.uname().nodename}/{os.getpid()}"
    with _ONE_AT_A_TIME, quiet():
        try:
            record, exr = record_and_exr(job, view, again)
        except Exception as error:  # one odd scene of thousands must not end the run
            message = " ".join(str(error).split()) or type(error).__name__
            name = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            record, exr = {"view": view, "failed": f"{name}{message}"[:500]}, None
            forget_places()  # what was recorded may be half done
    return Done(record, exr, time.perf_counter() - start, where)


def render_views(job: Job, views: Sequence[int]) -> list[Done]:
    """Return views that one process renders in a row, since they show one place."""
    return [render_view(job, view) for view in views]


def _direct_errors(job: Job, grid: int, views: Sequence[int]) -> list[float]:
    """Return `direct_error` of some views; NaN of one that cannot be rendered, which its record will say."""
    from render.scene.traced_scene import TracedScene
    from render.set_planning import direct_error

    found = []
    for view in views:
        with _ONE_AT_A_TIME:
            try:
                scene = _scene(job, view)
                world = _world(job, view, scene) or TracedScene(scene)
                found.append(direct_error(world, job.settings(), _seed(job, view), grid))
            except Exception:  # as in `render_view`
                log.debug("view %d cannot be planned", view, exc_info=True)
                found.append(math.nan)
                forget_places()
    return found


def _lost(view: int, why: str) -> Done:
    return Done({"view": view, "failed": why}, None, 0.0, "")


@contextmanager
def quiet() -> Iterator[None]:
    """Plan and missed target of each of thousands of views go into the index, and one warning tells of all."""
    logger = logging.getLogger("render")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def record_and_exr(job: Job, view: int, again: int) -> tuple[dict, bytes]:
    """Render a view: its record in the set's index, and its file; `again` from 1 on with other noise."""
    # heavy imports only where a view is really rendered: the process that collects needs none of them
    from render.engine import render
    from render.transient.data import exr_bytes
    from render.transient.packs import rounded
    from render.transient.thinning import thinned

    inputs = scene_set(job.set).inputs_sha256(view)
    scene, seed = _scene(job, view), _seed(job, view, again)
    world = _world(job, view, scene)
    transient = render(scene, job.settings(), seed=seed, world=world, plan=_plan(job, view, world))
    if job.offset_m and job.offset_mode == "time":
        transient = transient.delayed(job.offset_m)
    require(transient.returns > 0, f"{scene.name}: nothing in view of the camera returns light")
    transient = rounded(thinned(transient, job.merging * THINNED))
    exr = exr_bytes(transient)
    depth = transient.depth_m[np.isfinite(transient.depth_m)]
    quantiles = np.quantile(depth, (0, 0.01, 0.5, 0.99, 1)) if depth.size else np.full(5, np.nan)
    plan = transient.meta["plan"]
    record = {
        "view": view,
        "scene": scene.name,
        "place": scene_set(job.set).place(view),
        "file": file_name(view),
        "bytes": len(exr),
        "seed": seed,
        "plan": {key: plan[key] for key in ("bounces", "spp", "grid", "edge_threshold", "ambient")},
        "error": transient.meta["relative_error"]["total"],
        "target": plan["target"],
        "target_met": transient.meta["target_met"],
        "depth_m": dict(zip(("min", "q01", "median", "q99", "max"), np.round(quantiles, 4).tolist(), strict=True)),
        "empty": round(1 - depth.size / transient.depth_m.size, 6),
        "returns": transient.returns,
        "indirect_fraction": round(transient.indirect_fraction, 6),
        "triangles": scene.triangles,
    }
    return record | ({"inputs_sha256": inputs} if inputs else {}), exr


def _scene(job: Job, view: int) -> Scene:
    """Return the scene of a view as it is rendered: moved, and without lamps, if the set is to be so."""
    from scene2spad.datasets.moving import moved

    scene = scene_set(job.set).view(view, seed=job.seed, width=job.width, height=job.height)
    scene = scene if job.ambient else scene.without_lights()
    return moved(scene, job.offset_m, job.offset_mode) if job.offset_m and job.offset_mode != "time" else scene


def _seed(job: Job, view: int, again: int = 0) -> int:
    key = (Stream.VIEW, view, *((again,) if again else ()))
    return int(np.random.SeedSequence(job.seed, spawn_key=key).generate_state(1)[0])


def _world(job: Job, view: int, scene: Scene) -> TracedScene | None:
    """Return the world of a place that several cameras look at, built once for all of them; None: the scene's own.

    Its origin is the place's, not a camera's, so a view's bytes are the same whether others were rendered before.
    """
    from render.scene.traced_scene import TracedScene

    chosen = scene_set(job.set)
    if chosen.views_per_place == 1 or (job.offset_m and job.offset_mode != "time"):
        return None
    place = job.set, job.seed, job.ambient, chosen.place(view)
    if place not in _WORLDS:
        plastics = {key: made for world in _WORLDS.values() for key, made in world.plastics.items()}
        forget_places()  # before the next is built: calls are compiled for all materials that are there
        _WORLDS[place] = TracedScene(scene, origin_in_scene=True, plastics=plastics)
    return _WORLDS[place].with_camera(scene.camera)


def _plan(job: Job, view: int, world: TracedScene | None) -> Plan | None:
    """Return the plan for the first camera of a place, which holds for the others too; None: the view's own."""
    from render.engine import planned

    if world is None:
        return None
    chosen = scene_set(job.set)
    first = view - view % chosen.views_per_place
    key = job, chosen.place(view)
    if key not in _PLANS:
        camera = chosen.view(first, seed=job.seed, width=job.width, height=job.height).camera
        _PLANS[key] = planned(world.with_camera(camera), job.settings(), _seed(job, first))
    return _PLANS[key]


def forget_places() -> None:
    """Forget traced worlds and plans of places that this process has rendered."""
    _WORLDS.clear()
    _PLANS.clear()


# --- Running ---------------------------------------------------------------------------------------------------------


def views_by_place(job: Job, views: Iterable[int]) -> Iterator[tuple[int, ...]]:
    """Render views of one place together, in order."""
    chosen = scene_set(job.set)
    return (tuple(run) for _, run in groupby(views, key=lambda view: view // chosen.views_per_place))


def check_asked(job: Job, count: int, workers: int) -> None:
    """Raise InputError for a set that is too large, or views that do not fit in memory, before anything is made."""
    size = scene_set(job.set).size
    most = LARGEST if size is None else size
    require(1 <= count <= most, f"set {job.set}: count {count} is outside 1 to {most}")
    check_workers(workers)
    sides = [side for side in (job.width, job.height) if side is not None]
    check_sides(sides)
    if sides:
        width, height = sides[0], sides[-1]
        message = f"views of {width} x {height} pixels on {workers} process{'es' * (workers > 1)}"
        require_memory(workers * MIN_PIXEL_BYTES * width * height, message)


def check_sides(sides: Iterable[int]) -> None:
    """Raise InputError for a width or a height that no image has."""
    for side in sides:
        require(1 <= side <= MAX_IMAGE_SIDE, f"image side {side} is outside 1 to {MAX_IMAGE_SIDE} pixels")


def _with_grid(job: Job, folder: SetFolder, run: Run, report: Progress) -> Job:
    """Give all views as many rays as the errors of some of the first places ask for, however many views are asked."""
    from render.set_planning import measured_rays_for_all

    path = folder.path / "grid.json"
    if not path.is_file():
        report("plan", 0.0)
        each = scene_set(job.set).views_per_place
        some = range(0, each, -(-each // OF_A_PLACE))
        places = [tuple(place * each + view for view in some) for place in range(PLANNED_PLACES)]

        def errors_at(grid: int) -> list[float]:
            found = run(partial(_direct_errors, job, grid), places, lambda view, why: math.nan)
            return sorted(error for error in found if math.isfinite(error))

        grid, edge_threshold, errors = measured_rays_for_all(errors_at, job.settings())  # None: each place by itself
        with whole_file(path) as beside:
            beside.write_text(json.dumps({"grid": grid, "edge_threshold": edge_threshold, "errors": errors}) + "\n")
    try:
        planned = read_json_object(path)
        threshold = planned["edge_threshold"] if "edge_threshold" in planned else planned["least_share"]  # its old name
        return replace(job, grid=planned["grid"], edge_threshold=threshold)
    except (InputError, KeyError, TypeError):
        raise InputError(f"{path}: is damaged; delete it, and it is made again") from None


def check_scenes(job: Job, folder: SetFolder) -> None:
    """Raise InputError where views are of other scenes than the set, of those found beside the project, has now, or of
    other files of the same names."""
    chosen = scene_set(job.set)
    for view, record in sorted(folder.records.items()):
        now = chosen.place(view) if chosen.size is None or view < chosen.size else "nothing"
        message = f"{folder.path}: view {view} is of {record.get('place')}, the set has {now} there now"
        require(record.get("place", now) == now, f"{message}; choose another --out")
        inputs = chosen.inputs_sha256(view)
        kept = record.get("inputs_sha256", inputs)
        changed = [name for name in inputs if not isinstance(kept, dict) or kept.get(name) != inputs[name]]
        message = f"{folder.path}: view {view} is of another {', '.join(changed)} than {now} has now"
        require(not changed, f"{message}; choose another --out")


def _verdict(together: float, records: Sequence[dict]) -> tuple[str, str]:
    """Say the root mean square of the views' errors, and whether that is within the one of their targets."""
    target = math.sqrt(np.mean([record["target"] ** 2 for record in records]))
    error, limit = told_apart(together, target, digits=4)
    return error, f"within {limit}" if together <= target else f"above {limit}"


def make_set(
    job: Job, count: int, out: Path, *, workers: int = 1, scheduler: str | None = None, progress: Progress | None = None
) -> dict:
    """Render views 0 to count - 1 of a set into a folder; what is there already stays.

    workers: processes on this machine; scheduler: address of a running Dask scheduler instead, whose workers send the
    files back, so that no file system need be shared. Returns numbers for the command line.
    """
    check_asked(job, count, workers)
    folder = SetFolder(out, job.made())
    check_scenes(job, folder)
    report = progress or (lambda what, fraction: None)
    start = time.perf_counter()
    todo = folder.missing(count)
    with executor(workers if todo else 1, scheduler) as run:
        if todo or not folder.closed:
            with folder.held():  # not before a scheduler has answered: a mistyped address leaves no folder
                todo = folder.missing(count)
                endless = scene_set(job.set).size is None
                job = _with_grid(job, folder, run, report) if todo and endless and job.grid is None else job
                work = run(partial(render_views, job), views_by_place(job, todo), _lost)
                for number, done in enumerate(work, 1 + count - len(todo)):
                    folder.add(done)
                    if "failed" in done.record:
                        log.warning("view %d failed: %s", done.record["view"], done.record["failed"])
                    report(f"view {number} of {count}", number / count)
                folder.close()
    seconds = time.perf_counter() - start
    records = [folder.records[view] for view in range(count)]
    good = [record for record in records if "failed" not in record]
    require(bool(good), f"{out}: none of {count} views could be rendered; view 0: {records[0].get('failed')}")
    missed = [record for record in good if not record["target_met"]]
    together = math.sqrt(np.mean([record["error"] ** 2 for record in good]))
    if missed:
        worst = max(missed, key=lambda record: record["error"] / record["target"])
        error, target = told_apart(worst["error"], worst["target"], digits=4)
        log.warning(
            "warning: %d of %d views end above their error target of %s, the worst, view %d, at %s; all together "
            "(root mean square) are at %s, %s, which is what a set is planned for",
            *(len(missed), len(good), target, worst["view"], error, *_verdict(together, good)),
        )
    return {
        "scenes": len(good),
        "failed": [record["view"] for record in records if "failed" in record],
        "rendered_now": len(todo),
        "seconds": seconds,
        "scenes_per_second": len(todo) / seconds,
        "bytes_per_scene": sum(record["bytes"] for record in good) / len(good),
        "target_missed": len(missed),
        "error_together": together,
        "error_median": float(np.median([record["error"] for record in good])),
        "out": str(out),
    }
