"""Indirect light of an image: the loop of a render's camera paths, and what they add up to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from render.backend.malloc import trim_memory
from render.clamping import ClampedPixels, ClampSums, RemovedLight, clamped_splats, mean_removed
from render.indirect.accumulators import IndirectAccumulator
from render.indirect.camera_paths import PathTask, trace_paths
from render.indirect.launch_layout import BLOCK, LaunchLayout, make_launch, traced_members
from render.indirect.light_tracing import trace_light_paths
from render.indirect.path_cells import Cells, MomentHistogram, coarsened, make_cells, quantum_for, require_rows
from render.indirect.path_space_filter import PathSpaceFilter
from render.indirect.reuse import (
    CONNECTIONS_PER_LAUNCH,
    FILTERED_PATHS_PER_LAUNCH,
    PATHS_PER_LAUNCH,
    add_own_light,
    add_reused_light,
)
from render.indirect.schedule import Schedule
from render.probe import Probe, ProbePixels, make_probe, probe_splats, read_probe
from render.scene.traced_scene import TracedScene, dr
from render.transient.samples import Samples, concatenate, no_samples, packed, select

MAX_CELLS = 700_000  # of one launch: 17 MB of accumulators
OVER = 0.3  # of a launch
COMBINED = 1 << 21  # samples of two estimates that are merged at a time


class PathGrid(NamedTuple):
    """Cells of path length in which an image's indirect light is summed up.

    origin_m    path length of every flat pixel from which its cells widen: the direct return's
    cells       those of the result, counted from the origins
    fine        half as wide, those of the probe pixels
    brightest   direct radiance of the brightest pixel, which sets the fixed-point scale
    """

    origin_m: np.ndarray
    cells: Cells
    fine: Cells
    brightest: float


class IndirectTask(NamedTuple):
    """Light of 2 to `bounces` surfaces that is to be traced as a schedule says, and the grid that it is summed on."""

    world: TracedScene
    schedule: Schedule
    bounces: int
    seed: int
    grid: PathGrid


class IndirectLight(NamedTuple):
    """Standard error of each pixel's total; batches of the probe pixels, and what they would be without a filter;
    what a clamp took.

    Its samples are handed on as they come.
    """

    noise: np.ndarray
    probed: ProbePixels
    unfiltered: ProbePixels | None = None
    removed: RemovedLight | None = None


def combined(one: IndirectLight, other: IndirectLight, fraction: np.ndarray) -> IndirectLight:
    """Average two independent estimates but for their samples; `fraction` is the first one's weight in each pixel."""
    weight = fraction[one.probed.pixels][:, None, None]

    def mean(first: ProbePixels, second: ProbePixels) -> ProbePixels:
        both = (weight * a + (1 - weight) * b for a, b in zip(first[-3:], second[-3:], strict=True))
        return ProbePixels(*first[:-3], *both)

    noise = np.hypot(fraction * one.noise, (1 - fraction) * other.noise)
    unfiltered = None
    if one.unfiltered is not None and other.unfiltered is not None:
        unfiltered = mean(one.unfiltered, other.unfiltered)
    removed = mean_removed(one.removed, other.removed, fraction)
    return IndirectLight(noise, mean(one.probed, other.probed), unfiltered, removed)


def combined_samples(one: Samples, other: Samples, fraction: np.ndarray, cells: Cells, origin_m: np.ndarray) -> Samples:
    """Return the weighted mean of two estimates' samples in the same `cells`; `fraction` of the first, for every
    pixel.

    Pixels are merged some at a time: all at once, 17 million samples in each took 4 GB.
    """
    held = np.bincount(one.pixel, minlength=len(fraction)) + np.bincount(other.pixel, minlength=len(fraction))
    part_of = np.cumsum(held) // COMBINED
    merged = []
    for part in np.unique(part_of[held > 0]):
        first, end = np.searchsorted(part_of, (part, part + 1))
        weighed = []
        for samples, weight in ((one, fraction), (other, 1 - fraction)):
            some = select(samples, np.flatnonzero((samples.pixel >= first) & (samples.pixel < end)))
            weighed.append(some._replace(radiance=some.radiance * weight[some.pixel]))
        merged.append(coarsened(concatenate(weighed), cells, origin_m))
    return concatenate(merged) if merged else no_samples()


def image_cells(world: TracedScene, width_m: float, growth: float, origin_m: np.ndarray, bounces: int) -> Cells:
    """Return cells that hold every path of up to `bounces` surfaces, counted from the pixels' origins."""
    low, high = world.scene.bounds()
    ends = np.stack((low, high, world.scene.camera.origin, world.scene.laser.position(world.scene.camera)))
    diagonal = float(np.linalg.norm(np.ptp(ends, axis=0)))
    slowest = max((s.material.ior for s in world.scene.surfaces if s.material.is_glass), default=1.0)
    return make_cells(width_m, growth, -float(origin_m.max(initial=0)), (bounces + 1) * diagonal * slowest)


def path_grid(
    world: TracedScene, origin_m: np.ndarray, brightest: float, bounces: int, width_m: float, growth: float
) -> PathGrid:
    """Lay out cells `width_m` wide at the origin, which grow by the fraction `growth` of their distance."""
    cells, fine = (image_cells(world, width_m / part, growth / part, origin_m, bounces) for part in (1, 2))
    return PathGrid(origin_m, cells, fine, brightest)


def indirect_light(
    task: IndirectTask,
    probed: np.ndarray,
    add: Callable[[Samples], None],
    report: Callable[[float], None] = lambda fraction: None,
) -> IndirectLight:
    """Trace indirect light of the scheduled pixels; `add` is given its samples, part by part.

    Unbiased, unless the schedule filters or clamps. The `probed` pixels, sorted, must be among the scheduled.
    """
    (origin_m, _, fine, brightest), schedule = task.grid, task.schedule
    batches, filtered = schedule.batches, schedule.filter_octaves is not None
    # asked at once: each alone may fit
    regions = 0 if schedule.clamp is None else schedule.clamp.regions
    require_rows(len(probed) * batches * (2 if filtered else 1) + 2 * regions, fine)
    probe = make_probe(probed, origin_m, fine, batches, brightest, filtered=filtered)
    clamp = None
    if schedule.clamp is not None:
        clamp = ClampSums(schedule.clamp, fine, quantum_for(brightest), batches)
    splats = _trace_light(task, probe, clamp, add)
    noise = _standard_error(splats)
    for fraction, blocks in _groups(task):
        report(fraction)
        pixels, samples, totals = _trace_camera(task, blocks, probe, clamp)
        add(samples)
        real = pixels >= 0
        noise[pixels[real]] = _standard_error(totals[real] + splats[pixels[real]])
    rows, unfiltered = (None, None) if probe is None else (probe.rows, probe.unfiltered)
    plain = None if unfiltered is None else read_probe(unfiltered, probed, origin_m, fine, batches)
    removed = None if clamp is None else clamp.removed()
    return IndirectLight(noise, read_probe(rows, probed, origin_m, fine, batches), plain, removed)


def _standard_error(totals: np.ndarray) -> np.ndarray:
    """Compute the standard error of the sum of batches, (pixels, batches) -> (pixels,); 0 for one batch."""
    batches = totals.shape[1]
    return totals.std(axis=1, ddof=1) * np.sqrt(batches) if batches > 1 else np.zeros(len(totals))


def _trace_light(
    task: IndirectTask, probe: Probe | None, clamp: ClampSums | None, add: Callable[[Samples], None]
) -> np.ndarray:
    """Trace light paths from glossy surfaces and hand out their light; return its totals, (pixels, batches)."""
    origin_m, batches = task.grid.origin_m, task.schedule.batches
    totals, merged = np.zeros((len(origin_m), batches)), no_samples()
    for light in trace_light_paths(task.world, task.schedule.cost, batches, task.bounces, task.seed):
        if clamp is not None:
            light = clamped_splats(clamp, light, task.schedule.cost, origin_m)
        np.add.at(totals, (light.pixel, light.batch), light.radiance)
        if probe is not None:
            probe_splats(probe, light, origin_m, batches)
        few = np.full(len(light.pixel), 2, np.uint8)
        found = packed(light.pixel, light.path_m, np.zeros(len(few)), light.radiance, few)
        merged = coarsened(concatenate([merged, found]), task.grid.cells, origin_m)
    add(merged)
    return totals


def _groups(task: IndirectTask) -> Iterator[tuple[float, np.ndarray]]:
    """Yield blocks whose accumulators fit in memory together, each with the fraction of blocks done before."""
    schedule, done = task.schedule, 0
    per_group = max(1, MAX_CELLS // (task.grid.cells.size * BLOCK))
    for reuses_paths in (False, True):
        numbers = np.flatnonzero(schedule.reuses_paths == reuses_paths)
        for blocks in np.array_split(numbers, math.ceil(len(numbers) / per_group)) if len(numbers) else ():
            yield done / len(schedule.spp), blocks
            done += len(blocks)


def _trace_camera(
    task: IndirectTask, blocks: np.ndarray, probe: Probe | None, clamp: ClampSums | None
) -> tuple[np.ndarray, Samples, np.ndarray]:
    """Trace the camera paths of some blocks, all of which reuse paths or none.

    Returns flat pixels (-1: none), their merged samples, and each one's total radiance by batch, (pixels, batches).
    """
    world, schedule, bounces, seed, grid = task
    pixels = schedule.pixels.reshape(-1, BLOCK)[blocks].ravel()
    reuses_paths = bool(schedule.reuses_paths[blocks[0]])
    sums, path_filter = _accumulators(task, blocks, pixels, probe, clamp)
    from_m = None if path_filter is None else path_filter.from_m
    launches = 0
    for launch in _launches(blocks, pixels, schedule, reuses_paths=reuses_paths):
        dr.sync_thread()  # launches that wait hold memory of their own
        launches += 1
        paths = trace_paths(
            PathTask(world, pixels, launch, bounces, seed, schedule.batches, reuses_paths=reuses_paths, from_m=from_m)
        )
        add_own_light(paths, sums, path_filter)
        add_reused_light(world, paths, sums, reuses_paths=reuses_paths, filtered=path_filter is not None)
    if path_filter is None or launches > 1:  # the next regions take the memory of the last
        trim_memory(world.scene.camera.height * world.scene.camera.width)  # what the launches took
    if path_filter is not None:
        path_filter.read(sums)
    totals = sums.totals.numpy().reshape(len(pixels), -1) * sums.rows.quantum
    return pixels, sums.rows.samples(pixels, grid.origin_m[pixels]), totals


def _accumulators(
    task: IndirectTask, blocks: np.ndarray, pixels: np.ndarray, probe: Probe | None, clamp: ClampSums | None
) -> tuple[IndirectAccumulator, PathSpaceFilter | None]:
    """Make empty sums for some blocks, and the filter that late light passes through, if the schedule asks for one."""
    schedule, grid = task.schedule, task.grid
    rows = MomentHistogram(len(pixels), grid.cells, quantum_for(grid.brightest))
    sums = IndirectAccumulator(
        rows,
        grid.origin_m[pixels],
        spp=np.repeat(schedule.spp[blocks], BLOCK),
        batches=schedule.batches,
        probed=None if probe is None else probe.rows,
        unfiltered=None if probe is None else probe.unfiltered,
        probe_row=None if probe is None else np.where(pixels >= 0, probe.row_of[pixels], -1),
    )
    if clamp is not None:
        sums.clamp = ClampedPixels(clamp, pixels)
    if schedule.filter_octaves is None:
        return sums, None
    return sums, PathSpaceFilter(task.world, pixels, schedule.filter_octaves, schedule.batches, rows.quantum, task.seed)


def _launches(
    blocks: np.ndarray, pixels: np.ndarray, schedule: Schedule, *, reuses_paths: bool
) -> Iterator[LaunchLayout]:
    """Yield all samples of some blocks, and of their pixels, in launches of one size: memory of another is not reused.

    A launch is OVER larger where that saves one.
    """
    spp = schedule.spp[blocks]
    filtered = schedule.filter_octaves is not None
    paths = FILTERED_PATHS_PER_LAUNCH if filtered else PATHS_PER_LAUNCH
    members = traced_members(pixels, shared=reuses_paths or filtered)
    most = CONNECTIONS_PER_LAUNCH // BLOCK**2 if reuses_paths else paths // members
    count = int(spp.sum())
    for indices in np.array_split(np.arange(count), max(1, math.ceil(count / most - OVER))):
        yield make_launch(np.arange(len(spp)), blocks, spp, schedule.batches, indices)
