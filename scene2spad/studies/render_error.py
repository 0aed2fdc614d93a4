"""`study render-error`: how much the error of a rendered set matters to the depth that is found on it.

The same views are rendered at several qualities, twice each with other noise, and once very finely; the same methods
find depth on all of them at the same photon levels. Two questions: from which error on does the mean absolute error
(MAE) depart from what the fine render gives, and is a network that was trained on one of these renders better on it
than on the same scenes with other noise? It would have learned frozen noise. (`dataset SET --grid G --spp S --bounces
4` with this command's seed and size renders just what is run 0 here.)

Errors are nRMSE of the expected counts on the reference sensor: the render's own estimate, and the measured one

    sum over pixels and bins of (x - A)(x - B) / sum of A B

its root, A and B two fine renders whose own noise is independent and so leaves no trace (their common bias does).
"""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csph.evaluation.methods import EvaluationPlan, Method, evaluate
from csph.networks.checkpoint import load_model
from csph.networks.model import DepthModel
from csph.training.views import Views
from csph.weights.cards import checkpoint_of
from render.transient import Transient, read_transient
from scene2spad.bench.rendering.references import default_folder, key_of
from scene2spad.datasets.rendering import Job, render_view
from scene2spad.networks.training import baseline, common_tile, network_method
from scene2spad.options.experiments import Study
from scenes.errors import InputError, require
from scenes.files import whole_file, write_csv
from scenes.library.sets import scene_set
from scenes.progress import Progress
from spad.detection.flux import signal_per_bin
from spad.sensor.model import Sensor

log = logging.getLogger("scene2spad")

BOUNCES = 4  # the same for all, so that nothing but accuracy differs
QUALITIES = ((1, 16), (2, 64), (4, 256), (8, 1024))  # direct rays a pixel side, indirect paths a pixel
FINE, FINE_MERGING = (16, 4096), 0.1  # and returns hardly merged, which is most of a set's own error at this quality
RUNS = 2  # renders of each quality, with other noise
DRAWS = 3  # of photons, for every render
LEVELS = ((10.0, 10.0), (10.0, 200.0), (50.0, 50.0))
# `smoke` shows that it runs
SMOKE_QUALITIES, SMOKE_FINE, SMOKE_DRAWS, SMOKE_LEVELS, SMOKE_VIEWS = ((1, 16), (2, 32)), (4, 128), 2, LEVELS[:1], 1
BASELINE = "log-matched"
PIXEL_BLOCK = 1024  # pixels whose expected counts are held at once


class Plan(NamedTuple):
    """Extent of the study: qualities, the fine one beside them, draws of photons, photon levels, and views at most."""

    qualities: tuple[tuple[int, int], ...]
    fine: tuple[int, int]
    draws: int
    levels: tuple[tuple[float, float], ...]
    views: int


def plan_of(command: Study) -> Plan:
    """Return the extent of a command's preset: of `smoke` a minute on two cores, of the others what the page shows."""
    if command.preset == "smoke":
        views = min(command.views, SMOKE_VIEWS)
        return Plan(SMOKE_QUALITIES, SMOKE_FINE, SMOKE_DRAWS, SMOKE_LEVELS, views)
    return Plan(QUALITIES, FINE, DRAWS, LEVELS, command.views)


@dataclass(frozen=True)
class Row:
    """One method on one render of all views; errors are means over the views.

    run             which noise: 0 is the set's own, as `dataset` renders it
    error           that the renders estimated of themselves; 0 where they had no more than one path to judge by
    measured        against the fine renders; NaN for these, which the table shows as "-"
    mae_mm          mean over views, photon levels and draws
    mae_std_mm      standard error of that mean, from the draws of photons alone
    """

    grid: int
    spp: int
    run: int
    error: float
    measured: float
    method: str
    mae_mm: float
    mae_std_mm: float


def run(command: Study, progress: Progress) -> dict:
    """Render what is not yet in the cache, evaluate, write render-error.csv, and return its rows."""
    of = scene_set(command.scene_set)
    most = of.size or 100
    require(1 <= command.views <= most, f"views {command.views} is outside 1 to {most} of set {of.name}")
    models = {str(path): load_model(checkpoint_of(path))[0] for path in command.checkpoints}
    sensor = _sensor_of(models)
    methods = {BASELINE: baseline(BASELINE), **{path: network_method(model) for path, model in models.items()}}
    tile = common_tile([*models.values()])
    extent, cache = plan_of(command), command.cache or default_folder()
    sets = [*((q, r) for q in extent.qualities for r in range(RUNS)), (extent.fine, 0)]
    fine = [_views(command, extent.fine, run, cache, progress) for run in range(2)]
    rows: list[Row] = []
    for number, (quality, again) in enumerate(sets):
        progress(f"grid {quality[0]}, {quality[1]} paths", 0.2 + 0.8 * number / len(sets))
        is_fine = quality == extent.fine
        views = fine[0] if is_fine else _views(command, quality, again, cache, progress)
        own = statistics.fmean(t.meta["relative_error"]["total"] for t in views.transients)
        measured = math.nan if is_fine else measured_error(views.transients, *(v.transients for v in fine))
        plans = [EvaluationPlan(extent.levels, tile, seed=seed) for seed in photon_seeds(command.seed, extent.draws)]
        for method, found in errors_of(methods, views, sensor, plans).items():
            rows.append(Row(*quality, again, own, measured, method, *found))
    command.out.mkdir(parents=True, exist_ok=True)
    table = write_csv([asdict(row) for row in rows], command.out / "render-error.csv")
    shown: list[Any] = [asdict(row) for row in rows] if command.json else _lines(rows, list(methods))
    photons = [list(level) for level in extent.levels]
    return {"preset": command.preset, "views": extent.views, "photons": photons, "rows": shown, "csv": str(table)}


def photon_seeds(seed: int, draws: int) -> range:
    """Return the seeds of the draws of photons; those of another seed of the command are all others."""
    return range(seed * draws, (seed + 1) * draws)


def _sensor_of(models: Mapping[str, DepthModel]) -> Sensor:
    """Return the networks' sensor, or the reference; InputError where they differ."""
    found = {model.config.sensor.name: model.config.sensor for model in models.values()}
    names = ", ".join(found)
    require(len(set(found.values())) <= 1, f"checkpoints of sensors {names} see other photons")
    return next(iter(found.values()), Sensor())


def _views(command: Study, quality: tuple[int, int], again: int, cache: Path, progress: Progress) -> Views:
    """All views at one quality, from the cache or rendered into it one by one."""
    (grid, spp), extent = quality, plan_of(command)
    merging = FINE_MERGING if quality == extent.fine else 1.0
    size = command.width, command.height
    name = scene_set(command.scene_set).name
    job = Job(name, command.seed, *size, bounces=BOUNCES, spp=spp, grid=grid, merging=merging)
    transients = [_view(job, view, again, cache, progress) for view in range(extent.views)]
    return Views(tuple(transients), tuple(str(t.meta["scene"]) for t in transients))


def _view(job: Job, view: int, again: int, cache: Path, progress: Progress) -> Transient:
    inputs = scene_set(job.set).inputs_sha256(view)
    key = key_of({**job.made(), "view": view, "again": again, "inputs_sha256": inputs})
    path = cache / f"render-error-{key}.exr"
    if path.is_file():
        try:
            return read_transient(path)
        except InputError:
            log.warning("%s: unreadable, made again", path)
    progress(f"{job.set} {view}: grid {job.grid}, {job.spp} paths", 0.0)
    done = render_view(job, view, again)
    if done.exr is None:
        raise InputError(f"view {view} of {job.set} cannot be rendered: {done.record.get('failed')}")
    cache.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as beside:
        beside.write_bytes(done.exr)
    return read_transient(path)


def measured_error(found: Sequence[Transient], a: Sequence[Transient], b: Sequence[Transient]) -> float:
    """Return mean over views of the nRMSE against two fine renders of each; a squared error below 0 counts as 0."""
    return statistics.fmean(_nrmse(*three) for three in zip(found, a, b, strict=True))


def _nrmse(found: Transient, a: Transient, b: Transient) -> float:
    square = power = 0.0
    for x, first, second in zip(*map(_expected, (found, a, b)), strict=True):
        square += float(((x - first) * (x - second)).sum())
        power += float((first * second).sum())
    require(power > 0, f"a view of {a.meta.get('scene')}: no light returns, a render of it has no error")
    return math.sqrt(max(square, 0.0) / power)


def _expected(transient: Transient) -> Iterator[np.ndarray]:
    """Compute the expected signal in every bin of the reference sensor, a block of pixels at a time."""
    pixels = transient.height * transient.width
    for start in range(0, pixels, PIXEL_BLOCK):
        yield signal_per_bin(transient, Sensor(), slice(start, min(start + PIXEL_BLOCK, pixels)))[0].numpy()


def errors_of(
    methods: Mapping[str, Method], views: Views, sensor: Sensor, plans: Sequence[EvaluationPlan]
) -> dict[str, tuple[float, float]]:
    """Return {method: (MAE [mm], its standard error from the draws of photons)}, the mean over views and levels; each
    of two plans or more is a draw.

    Raises InputError for a view without an error: nothing of it lies within the range, or a method estimates nothing.
    """
    draws: dict[str, list[float]] = {name: [] for name in methods}
    for plan in plans:
        found = [row for row in evaluate(methods, views, sensor, plan).rows if row.group == "all"]
        for row in found:
            scene, level = views.scenes[row.view], f"{row.signal:g} + {row.background:g} photons"
            why = f"no pixel has a true depth within {sensor.recorded_range_m:.4g} m"
            why = why if not row.pixels + row.missing else f"{row.method} estimates no depth at {level}"
            require(math.isfinite(row.mae_mm), f"view {row.view} ({scene}) has no error: {why}; choose other views")
        for name, values in draws.items():
            values.append(statistics.fmean(row.mae_mm for row in found if row.method == name))
    return {
        name: (statistics.fmean(values), statistics.stdev(values) / math.sqrt(len(plans)))
        for name, values in draws.items()
    }


def _lines(rows: Sequence[Row], methods: Sequence[str]) -> list[str]:
    lines = [f"{'grid':>4} {'paths':>6} {'run':>3} {'error':>8} {'measured':>8}  MAE [mm] of {', '.join(methods)}"]
    for first in range(0, len(rows), len(methods)):
        row, *_ = group = rows[first : first + len(methods)]
        errors = "  ".join(f"{r.mae_mm:8.2f} +- {r.mae_std_mm:.2f}" for r in group)
        # of the fine renders nothing is measured: the others are measured against them
        measured = f"{row.measured:.2%}" if math.isfinite(row.measured) else "-"
        lines.append(f"{row.grid:>4} {row.spp:>6} {row.run:>3} {row.error:>8.2%} {measured:>8}  {errors}")
    return lines
