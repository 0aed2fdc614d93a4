"""Render the sets that trained models are tested on, and trained on where none is given: once, into a study's
folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from csph.evaluation.methods import EvaluationPlan, Method, Row, as_dicts, evaluate
from csph.levels import PHOTON_LEVELS
from csph.training.views import Views, read_views
from scene2spad.datasets.packing import pack_set
from scene2spad.datasets.rendering import Job, make_set
from scene2spad.networks.registry import EvaluatedModel
from scene2spad.networks.results import Store
from scene2spad.networks.training import network_method
from scenes.errors import InputError, require
from scenes.files import read_array
from scenes.json_types import JsonObject
from scenes.library.sets import scene_set
from scenes.offsets import OffsetMode
from scenes.progress import Progress
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

TILE = (4, 4)  # pixels that images are cut to whole numbers of, for every model alike
ROOMS = 2000  # views that `laptop` models are trained on


@dataclass(frozen=True, eq=False)
class TestSet:
    """Views under a name.

    `offset_m` and `mode` say how they were moved before they were rendered; `delay_m` moves them when they are sensed,
    in time alone, with the counts of every pixel as they were.
    """

    __test__ = False  # no test of pytest's

    name: str
    views: Views
    offset_m: float = 0.0
    mode: OffsetMode = "time"
    delay_m: float = 0.0

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 of each view: results are kept by it, so that parts of a set share what was computed."""
        return tuple(transient.sha256()[:32] for transient in self.views.transients)

    def first(self, count: int | None) -> TestSet:
        """Return its first views."""
        return replace(self, views=Views(self.views.transients[:count], self.views.scenes[:count]))

    def delayed(self, delay_m: float) -> TestSet:
        """Return the same views `delay_m` farther away in time."""
        return replace(self, delay_m=delay_m)

    def truth_m(self, view: int) -> np.ndarray:
        """Return depth of a view as it is evaluated, cut to TILE."""
        depth = self.views.transients[view].depth_m
        rows, columns = (side // part * part for side, part in zip(depth.shape, TILE, strict=True))
        return depth[:rows, :columns] + np.float32(self.delay_m)


def rendered(
    name: str,
    folder: Path,
    *,
    offset_m: float = 0.0,
    mode: OffsetMode = "time",
    count: int | None = None,
    size: tuple[int, int] | None = None,
    progress: Progress | None = None,
) -> TestSet:
    """Return a finite set with direct light alone, rendered into `folder` where it is not there; `size` is (width,
    height).

    Each size and offset has a folder of its own there, so that studies of different extent can share `folder`.
    Raises InputError where a view cannot be rendered.
    """
    width, height = size or (None, None)
    job = Job(name, width=width, height=height, bounces=1, grid=4, error=0.01, offset_m=offset_m, offset_mode=mode)
    of = scene_set(name)
    moved = f"-{mode}-{offset_m:g}m" if offset_m else ""
    sized = f"-{width}x{height}" if size else ""
    path = folder / f"{name.replace('/', '-')}{sized}{moved}"
    folder.mkdir(parents=True, exist_ok=True)
    number = of.size if count is None else count
    if number is None:
        raise InputError(f"{name}: has no end, say how many views")
    _require_whole(make_set(job, number, path, progress=progress), path)
    return TestSet(name, read_views(path), offset_m, mode).first(count)


def rooms(folder: Path, progress: Progress) -> Path:
    """Return the pack of ROOMS views of rooms, direct light alone, made where it is not there.

    Raises InputError where a view cannot be rendered: asked again, those alone are tried.
    """
    pack = folder / "rooms.h5"
    if not pack.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        job = Job("rooms/train", width=64, height=64, bounces=1, grid=4, error=0.01)
        _require_whole(make_set(job, ROOMS, folder / "rooms", workers=2, progress=progress), folder / "rooms")
        pack_set(folder / "rooms", pack, progress)
    return pack


def _require_whole(made: JsonObject, path: Path) -> None:
    require(not made["failed"], f"{path}: views {made['failed']} could not be rendered")


def evaluated(
    store: Store,
    subjects: Sequence[EvaluatedModel],
    test: TestSet,
    levels: Sequence[tuple[float, float]],
    *,
    maps: Sequence[int] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Row]:
    """Return rows of every model, view and level; what the store has is not computed again, the rest sees the same
    photons.

    Of the views in `maps` the depth maps are kept as well (`depth_map`).
    """
    report, rows = progress or (lambda what, fraction: None), []
    total = len(test.views.transients) * len(levels)
    for view, scene in enumerate(test.views.scenes):
        for number, level in enumerate(levels):
            report(f"{scene}, {level[0]:g} + {level[1]:g}, {test.delay_m:g} m", (view * len(levels) + number) / total)
            key = _key(test, view, level, seed)
            missing = [one for one in subjects if not _has(store, one, key, view in maps)]
            if missing:
                _evaluate(store, missing, test, view, level, seed, view in maps)
            for one in subjects:
                kept = store.get(one.digest, **key)
                rows += [Row(**{**row, "method": one.name, "view": view}) for row in kept]
    return rows


def depth_map(
    store: Store,
    subject: EvaluatedModel,
    test: TestSet,
    view: int,
    level: tuple[float, float],
    seed: int,
) -> np.ndarray:
    """Return (H, W) depth [m] that `evaluated` kept."""
    return read_array(store.map_file(subject.digest, **_key(test, view, level, seed)))


def _key(test: TestSet, view: int, level: tuple[float, float], seed: int) -> dict[str, object]:
    return {
        "view": f"{view}-{test.digests[view]}",
        "signal": float(level[0]),
        "background": float(level[1]),
        "delay_m": float(test.delay_m),
        "seed": seed,
    }


def _has(store: Store, one: EvaluatedModel, key: dict[str, object], with_map: bool) -> bool:
    there = store.get(one.digest, **key) is not None
    return there and (not with_map or store.map_file(one.digest, **key).is_file())


def _evaluate(
    store: Store,
    subjects: Sequence[EvaluatedModel],
    test: TestSet,
    view: int,
    level: tuple[float, float],
    seed: int,
    with_map: bool,
) -> None:
    key = _key(test, view, level, seed)
    one_view = Views(test.views.transients[view : view + 1], test.views.scenes[view : view + 1])
    estimates: dict[str, np.ndarray] = {}

    def method(subject: EvaluatedModel) -> Method:
        depth_of = network_method(subject.model)

        def kept(histogram: Histogram) -> np.ndarray:
            estimates[subject.digest] = depth_of(histogram)
            return estimates[subject.digest]

        return kept

    draw = _draw(seed, view, level)
    methods = {subject.digest: method(subject) for subject in subjects}
    found = evaluate(methods, one_view, Sensor(), EvaluationPlan((level,), TILE, test.delay_m, draw))
    for subject in subjects:
        if with_map:
            store.put_map(estimates[subject.digest], subject.digest, **key)
        rows = [row for row in as_dicts(found.rows) if row["method"] == subject.digest]
        store.put(subject.digest, rows, **key)


def _draw(seed: int, view: int, level: tuple[float, float]) -> int:
    """Seed of the photons of a view at a level: numbered where it is one of the paper's, by its photons elsewhere."""
    if level in PHOTON_LEVELS:
        return (seed * 1000 + view) * len(PHOTON_LEVELS) + PHOTON_LEVELS.index(level)
    milli = [round(1000 * photons) for photons in level]
    return int(np.random.SeedSequence((seed, view, *milli)).generate_state(1)[0])
