"""Indirect light of an image: which pixels trace paths together, in which launches, and what they add up to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from render.backend.malloc import trim_memory
from render.indirect.accumulators import IndirectAccumulator
from render.indirect.launch_layout import BLOCK, LaunchLayout, make_launch
from render.indirect.light_tracing import LightPathSplats, trace_light_paths
from render.indirect.path_cells import Cells, MomentHistogram, cell_samples, coarsened, make_cells, quantum_for
from render.indirect.path_space_filter import GATHER_POINTS, Octaves, PathSpaceFilter
from render.indirect.reuse import FILTERED_PATHS, LANES, PATHS, add_paths, noise_of_filtered_paths, noise_of_paths
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, upload
from render.settings import BATCHES, FILTERED_BATCHES
from render.transient.samples import Samples, concatenate, no_samples, packed

MAX_CELLS = 700_000  # of one launch: 17 MB of accumulators
OVER = 0.3  # of a launch
# Seconds of one path with its tail in units of one connection, on 2 cores. Only the choice of who shares depends on it.
PATH_COST = 9.0


class Schedule(NamedTuple):
    """Who traces how many paths: blocks of flat pixels (-1: none), and per block its rounds and whether it shares.

    A round is one path in every pixel of a block. `batches` of rounds are kept apart for the error estimate. With
    `spans` no block shares, and late light is filtered over regions of these octaves.
    """

    pixels: np.ndarray
    rounds: np.ndarray
    shared: np.ndarray
    spans: Octaves | None = None

    @property
    def batches(self) -> int:
        most = BATCHES if self.spans is None else FILTERED_BATCHES
        return int(min(most, self.rounds.min(initial=most)))

    @property
    def paths(self) -> int:
        """Paths traced from the camera."""
        return int((self.rounds * (self.pixels.reshape(-1, BLOCK) >= 0).sum(axis=1)).sum())

    @property
    def connections(self) -> int:
        """Rays between pixels and their neighbours' paths."""
        return int(self.rounds[self.shared].sum()) * BLOCK**2

    def rays(self, bounces: int) -> int:
        """Rays of all paths, connections and points that read regions; glass and cut-outs on the way not counted."""
        points = 0 if self.spans is None else GATHER_POINTS * int((self.pixels >= 0).sum())
        return self.paths * (2 * bounces - 1) + self.connections + points

    @property
    def cost(self) -> float:
        """Work of the schedule in paths of its own for every pixel."""
        each = np.where(self.shared, 1 + BLOCK / PATH_COST, 1)
        return float((self.rounds * each).mean())


def uniform(blocks: np.ndarray, rounds: int, *, shared: bool) -> Schedule:
    """The same for every block."""
    count = len(blocks) // BLOCK
    return Schedule(blocks, np.full(count, rounds), np.full(count, shared))


def pilot_noise(
    world: TracedScene, blocks: np.ndarray, bounces: int, seed: int, from_m: float | None = None
) -> tuple[np.ndarray, ...]:
    """Squared contributions of one round summed over the pixels of every block, without and with sharing.

    With `from_m`, from which on light is filtered, there is one way alone. From a round or a few, smoothed along the
    Z-order curve: single bright paths must not rule.
    """
    count = len(blocks) // BLOCK
    rounds = int(np.clip(256 // max(count, 1), 1, 16))
    per_launch = max(1, LANES // BLOCK**2 // rounds)
    parts = []
    for first in range(0, count, per_launch):
        size = min(per_launch, count - first)
        block = np.arange(size)
        turns = make_launch(block, block + first, np.full(size, rounds))
        chosen = blocks[first * BLOCK : (first + size) * BLOCK]
        if from_m is None:
            found = noise_of_paths(world, chosen, turns, bounces, seed)
        else:
            found = (noise_of_filtered_paths(world, chosen, turns, bounces, seed, from_m),)
        parts.append([part.reshape(size, rounds).mean(axis=1) for part in found])
    kernel = np.array((1, 2, 3, 2, 1)) / 9
    totals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return tuple(np.convolve(np.pad(total, 2, mode="edge"), kernel, mode="valid") for total in totals)


def allocate(
    blocks: np.ndarray,
    own: np.ndarray,
    shared: np.ndarray | None = None,
    *,
    cost: float = np.inf,
    squared_error: float = 0.0,
    batches: int = BATCHES,
) -> Schedule:
    """Spend work where it lowers the summed squared error most, until the error is met or `cost` paths a pixel spent.

    R rounds with noise N and work c add N / R to the error and R c to the work, in one block and one way (own paths or
    shared ones); N / R + L R c is least at R = sqrt(N / (L c)), at least `batches` (Neyman 1934). L comes by bisection.
    A block's noise is at least 2 % of the mean, since a short pilot sees no rare path.
    """
    noise = np.stack((own,) if shared is None else (own, shared))
    each = np.array((1.0, 1 + BLOCK / PATH_COST))[: len(noise), None]
    least = noise.min(axis=0).mean()
    noise = np.maximum(noise, 0.02 * least) if least > 0 else np.ones_like(noise)
    most = max(batches, 256 * cost) if np.isfinite(cost) else np.inf

    def spent(price: float) -> tuple[np.ndarray, np.ndarray]:
        rounds = np.clip(np.sqrt(noise / (price * each)), batches, most)
        rounds = np.ceil(rounds / batches) * batches
        best = np.argmin(noise / rounds + price * rounds * each, axis=0)
        return best, np.take_along_axis(rounds, best[None], 0)[0]

    unit = noise.min(axis=0).mean()
    low, high = -60.0, 60.0  # logarithm of the price in units of the mean noise: the lower, the more is spent
    for _ in range(48):
        middle = 0.5 * (low + high)
        best, rounds = spent(np.exp(middle) * unit)
        left = (np.take_along_axis(noise, best[None], 0)[0] / rounds).sum()
        if (rounds * each[best, 0]).mean() > cost or left < squared_error:
            low = middle
        else:
            high = middle
    best, rounds = spent(np.exp(high) * unit)
    return Schedule(blocks, rounds.astype(np.int64), best == 1)


class ProbePixels(NamedTuple):
    """Light of a few flat `pixels` by independent batches, in cells half as wide: radiance and its two moments about
    the cell's beginning in the cell's width, (pixels, batches, cells) each.

    Every batch estimates the whole indirect light.
    """

    pixels: np.ndarray
    cells: Cells
    origin_m: np.ndarray
    radiance: np.ndarray
    moment: np.ndarray
    second: np.ndarray

    def samples(self, turns: slice = slice(None)) -> Samples:
        """The mean of some batches as samples, their pixel an index into `pixels`."""
        means = [values[:, turns].mean(axis=1) for values in self[-3:]]
        row, cell = np.nonzero(means[0])
        return cell_samples(self.cells, row, self.origin_m[row], cell, *(mean[row, cell] for mean in means))


class Chunk(NamedTuple):
    """Merged samples of some pixels, and each pixel's total radiance by batch, (pixels, batches)."""

    pixels: np.ndarray
    samples: Samples
    totals: np.ndarray


class IndirectLight(NamedTuple):
    """Standard error of each pixel's total; batches of the watched pixels, and what they would be without a filter.

    Its samples are handed on as they come.
    """

    noise: np.ndarray
    watched: ProbePixels
    plain: ProbePixels | None = None


def combined(one: IndirectLight, other: IndirectLight, share: np.ndarray) -> IndirectLight:
    """The weighted mean of two independent estimates but for their samples; `share` of the first, for every pixel."""
    weight = share[one.watched.pixels][:, None, None]

    def mean(first: ProbePixels | None, second: ProbePixels | None) -> ProbePixels | None:
        if first is None or second is None:
            return None
        both = (weight * a + (1 - weight) * b for a, b in zip(first[-3:], second[-3:], strict=True))
        return ProbePixels(*first[:-3], *both)

    noise = np.hypot(share * one.noise, (1 - share) * other.noise)
    return IndirectLight(noise, mean(one.watched, other.watched), mean(one.plain, other.plain))


def combined_samples(one: Samples, other: Samples, share: np.ndarray, cells: Cells, origin_m: np.ndarray) -> Samples:
    """The weighted mean of two estimates' samples in the same `cells`; `share` of the first, for every pixel."""
    parts = [
        samples._replace(radiance=samples.radiance * weight[samples.pixel])
        for samples, weight in ((one, share), (other, 1 - share))
    ]
    return coarsened(concatenate(parts), cells, origin_m)


def image_cells(world: TracedScene, width_m: float, growth: float, origin_m: np.ndarray, bounces: int) -> Cells:
    """Cells that hold every path of up to `bounces` surfaces, counted from the pixels' origins."""
    low, high = world.scene.bounds()
    ends = np.stack((low, high, world.scene.camera.origin, world.scene.laser.position(world.scene.camera)))
    diagonal = float(np.linalg.norm(np.ptp(ends, axis=0)))
    slowest = max((s.material.ior for s in world.scene.surfaces if s.material.is_glass), default=1.0)
    return make_cells(width_m, growth, -float(origin_m.max(initial=0)), (bounces + 1) * diagonal * slowest)


def collect(
    world: TracedScene,
    schedule: Schedule,
    origin_m: np.ndarray,
    cells: Cells,
    bounces: int,
    seed: int,
    brightest: float,
    *,
    watch: Probe | None = None,
    say: Callable[[float], None] = lambda share: None,
) -> Iterator[Chunk]:
    """Trace a schedule and hand out merged samples, some blocks at a time.

    `origin_m` belongs to flat pixels of the image.
    """
    per_chunk = max(1, MAX_CELLS // (cells.count * BLOCK))
    done = 0
    for shared in (False, True):
        numbers = np.flatnonzero(schedule.shared == shared)
        for chosen in np.array_split(numbers, math.ceil(len(numbers) / per_chunk)) if len(numbers) else ():
            say(done / len(schedule.rounds))
            done += len(chosen)
            pixels = schedule.pixels.reshape(-1, BLOCK)[chosen].ravel()
            rounds = schedule.rounds[chosen]
            rows = MomentHistogram(len(pixels), cells, quantum_for(brightest))
            sums = IndirectAccumulator(
                rows,
                origin_m[pixels],
                rounds=np.repeat(rounds, BLOCK),
                batches=schedule.batches,
                watched=None if watch is None else watch.rows,
                plain=None if watch is None else watch.plain,
                watch=None if watch is None else np.where(pixels >= 0, watch.row_of[pixels], -1),
            )
            regions = None
            if schedule.spans is not None:
                regions = PathSpaceFilter(world, pixels, schedule.spans, schedule.batches, rows.quantum, seed)
            most = LANES // BLOCK**2 if shared else (PATHS if regions is None else FILTERED_PATHS) // BLOCK
            launches = 0
            for turns in _launches(chosen, rounds, schedule.batches, most):
                dr.sync_thread()  # launches that wait hold memory of their own
                launches += 1
                add_paths(world, pixels, turns, bounces, seed, sums, schedule.batches, shared=shared, regions=regions)
            if regions is None or launches > 1:  # the next regions take the memory of the last
                trim_memory(world.scene.camera.height * world.scene.camera.width)  # what the launches took
            if regions is not None:
                regions.read(sums)
            totals = sums.totals.numpy().reshape(len(pixels), -1) * rows.quantum
            samples = rows.samples(pixels, origin_m[pixels])
            del rows, sums, regions  # before the next ones are there
            yield Chunk(pixels, samples, totals)


def _launches(streams: np.ndarray, rounds: np.ndarray, batches: int, most: int) -> Iterator[LaunchLayout]:
    """All rounds of some blocks in launches of one size: memory of another is not reused.

    A launch has at most `most` turns, or OVER more where that saves one.
    """
    count = int(rounds.sum())
    for turns in np.array_split(np.arange(count), max(1, math.ceil(count / most - OVER))):
        yield make_launch(np.arange(len(rounds)), streams, rounds, batches, turns)


class Probe(NamedTuple):
    """The watched row of every flat pixel of the image, or -1; rows by batch, and such without a filter."""

    row_of: np.ndarray
    rows: MomentHistogram
    plain: MomentHistogram | None


def _watch(pixels: np.ndarray, image_pixels: int, cells: Cells, schedule: Schedule, brightest: float) -> Probe | None:
    """What it takes to watch a sorted few of the image's pixels."""
    if len(pixels) == 0:
        return None
    row_of = np.full(image_pixels, -1)
    row_of[pixels] = np.arange(len(pixels))
    kinds = 1 if schedule.spans is None else 2
    rows = [MomentHistogram(len(pixels) * schedule.batches, cells, quantum_for(brightest)) for _ in range(kinds)]
    return Probe(row_of, rows[0], rows[1] if kinds == 2 else None)


def _caustics(
    world: TracedScene,
    schedule: Schedule,
    bounces: int,
    seed: int,
    origin_m: np.ndarray,
    cells: Cells,
    watch: Probe | None,
    add: Callable[[Samples], None],
) -> np.ndarray:
    """Give out light that polished surfaces throw; every pixel's total of it by batch, (pixels, batches)."""
    batches = schedule.batches
    totals, merged = np.zeros((len(origin_m), batches)), no_samples()
    for light in trace_light_paths(world, schedule.cost, batches, bounces, seed):
        np.add.at(totals, (light.pixel, light.batch), light.radiance)
        if watch is not None:
            _watch_thrown(watch, light, origin_m, batches)
        few = np.full(len(light.pixel), 2, np.uint8)
        found = packed(light.pixel, light.path_m, np.zeros(len(few)), light.radiance, few)
        merged = coarsened(concatenate([merged, found]), cells, origin_m)
    add(merged)
    return totals


def _watch_thrown(watch: Probe, light: LightPathSplats, origin_m: np.ndarray, batches: int) -> None:
    """Add what is thrown on watched pixels to their rows."""
    seen = np.flatnonzero(watch.row_of[light.pixel] >= 0)
    if len(seen) == 0:
        return
    pixel = light.pixel[seen]
    row = upload(UInt32, watch.row_of[pixel] * batches + light.batch[seen])
    x = upload(Float, light.path_m[seen] - origin_m[pixel])
    radiance = upload(Float, light.radiance[seen] * batches)
    for rows in (watch.rows, watch.plain):
        if rows is not None:
            rows.add(row, x, radiance, Bool(True))


def indirect_light(
    world: TracedScene,
    schedule: Schedule,
    bounces: int,
    seed: int,
    origin_m: np.ndarray,
    brightest: float,
    watched: np.ndarray,
    add: Callable[[Samples], None],
    *,
    width_m: float,
    growth: float,
    say: Callable[[float], None] = lambda share: None,
) -> IndirectLight:
    """Light of 2 to `bounces` surfaces in the scheduled pixels; `add` is given its samples, part by part.

    Unbiased, unless the schedule asks for a filter.

    `origin_m`, for every pixel of the image, is the path length from which cells widen: the direct return's.
    `brightest` sets the fixed-point scale. The `watched` pixels, sorted, must be among the scheduled.
    """
    image_pixels, batches = len(origin_m), schedule.batches
    cells = image_cells(world, width_m, growth, origin_m, bounces)
    fine = image_cells(world, width_m / 2, growth / 2, origin_m, bounces)
    watch = _watch(watched, image_pixels, fine, schedule, brightest)
    thrown = _caustics(world, schedule, bounces, seed, origin_m, cells, watch, add)
    noise = thrown.std(axis=1, ddof=1) * np.sqrt(batches) if batches > 1 else np.zeros(image_pixels)
    for chunk in collect(world, schedule, origin_m, cells, bounces, seed, brightest, watch=watch, say=say):
        real = chunk.pixels >= 0
        add(chunk.samples)
        if batches > 1:
            totals = chunk.totals[real] + thrown[chunk.pixels[real]]
            noise[chunk.pixels[real]] = totals.std(axis=1, ddof=1) * np.sqrt(batches)

    def seen(rows: MomentHistogram | None) -> ProbePixels:
        sums = (np.zeros(0),) * 3 if rows is None else rows.sums()
        shape = len(watched), batches, fine.count
        return ProbePixels(watched, fine, origin_m[watched], *(values.reshape(shape) for values in sums))

    rows, plain = (None, None) if watch is None else watch[1:]
    return IndirectLight(noise, seen(rows), None if plain is None else seen(plain))
