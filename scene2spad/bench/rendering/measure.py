"""Timing: every method of one scene, size and transport, interleaved, so that the machine's noise hits all alike."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field

import numpy as np

from render.scene.traced_scene import TracedScene, dr
from scene2spad.bench.rendering import ours
from scene2spad.bench.rendering.binning import binned
from scene2spad.bench.rendering.curves import Point, flattens, slopes
from scene2spad.bench.rendering.errors import Judge, Reference
from scene2spad.bench.rendering.peers import Peer
from scene2spad.bench.rendering.settings import BIN_M, BINS, BOUNCES, Method

DETERMINISTIC = "grid"


@dataclass(frozen=True)
class Row:
    """One method at one quality.

    seconds is the median of the warm `runs` to a dense (H, W, bins) float32 array, cold_seconds the first call
    of this quality in this process (kernels may come from Dr.Jit's cache on disk). Errors: see `errors.Errors`.
    slope_* is d log(error) / d log(seconds) from the next cheaper quality; flattens marks a bias. Memory is measured by
    `bench.memory` in fresh processes: in this one, each renderer finds what the other left.
    """

    scene: str
    size: int
    transport: str
    method: str
    unit: str
    quality: int
    seconds: float
    runs: int
    cold_seconds: float
    nrmse_raw: float
    nrmse_pulse: float
    pixel_median: float
    pixel_p95: float
    bias_raw: float
    bias_pulse: float
    energy_ratio: float
    resolution_raw: float
    resolution_pulse: float
    slope_raw: float = math.nan
    slope_pulse: float = math.nan
    flattens: bool = False

    def to_dict(self) -> dict:
        return asdict(self)


@dataclass
class Runner:
    """A method on one scene: `run(quality, seed)` gives the dense histogram, (pixels, bins) float32.

    What it gives is overwritten by its next run.
    """

    method: Method
    run: Callable[[int, int], np.ndarray]
    release: Callable[[], None] = field(default=lambda: None)


def our_runner(world: TracedScene, method: Method, transport: str) -> Runner:
    """Trace and bin.

    The last histogram is dropped right before the next is made, in its place. Tracing gives freed memory back to the
    system, and the peer does not: to map a histogram's pages anew can take as long as tracing.
    """
    camera = world.scene.camera
    kept: list[np.ndarray] = []

    def run(quality: int, seed: int) -> np.ndarray:
        samples = ours.trace(world, method, BOUNCES[transport], quality, seed)
        kept.clear()
        kept.append(binned(samples, camera.width * camera.height, BINS, BIN_M))
        return kept[0]

    return Runner(method, run, kept.clear)


def peer_runner(peer: Peer, method: Method) -> Runner:
    kept: list = []

    def run(quality: int, seed: int) -> np.ndarray:
        kept.clear()
        kept.append(peer.render(quality, seed))
        return peer.histogram(kept[0])

    return Runner(method, run, kept.clear)


def measure_level(
    level: list[tuple[Runner, int]], reference: Reference, repeats: int, seeds: int, first_seed: int = 1
) -> Iterator[tuple[Runner, int, dict]]:
    """Yield time and judge each (runner, quality): `repeats` warm runs of different seeds, `seeds` of them judged.

    The same method runs once untimed before every timed run, so that none pays for the memory that another left.
    """
    cold = [_first_call(runner, quality) for runner, quality in level]
    judges = [Judge(reference) for _ in level]
    seconds: list[list[float]] = [[] for _ in level]
    order = list(range(len(level)))
    for number in range(max(repeats, seeds)):
        for i in order:
            runner, quality = level[i]
            runner.run(quality, 0)
            start = time.perf_counter()
            histogram = runner.run(quality, first_seed + number)
            seconds[i].append(time.perf_counter() - start)
            if number < (1 if runner.method.unit == DETERMINISTIC else seeds):
                judges[i].add(histogram)
            del histogram
        order.reverse()
    for i, (runner, quality) in enumerate(level):
        errors = judges[i].errors()
        yield (
            runner,
            quality,
            {
                "seconds": statistics.median(seconds[i]),
                "runs": len(seconds[i]),
                "cold_seconds": cold[i],
                "nrmse_raw": errors.nrmse[0],
                "nrmse_pulse": errors.nrmse[1],
                "pixel_median": errors.pixel[0],
                "pixel_p95": errors.pixel[1],
                "bias_raw": errors.bias[0],
                "bias_pulse": errors.bias[1],
                "energy_ratio": errors.energy,
                "resolution_raw": reference.resolution[0],
                "resolution_pulse": reference.resolution[1],
            },
        )


def with_slopes(rows: list[Row]) -> list[Row]:
    """Return the rows of one method, cheapest quality first, with the slopes between them."""
    columns = {}
    for kind in ("raw", "pulse"):
        points = curve(rows, kind)
        columns[kind] = ([math.nan, *slopes(points)], flattens(points))
    marked = []
    for i, row in enumerate(rows):
        bent = i == len(rows) - 1 and (columns["raw"][1] or columns["pulse"][1])
        values = {**row.to_dict(), "slope_raw": columns["raw"][0][i], "slope_pulse": columns["pulse"][0][i]}
        marked.append(Row(**{**values, "flattens": bent}))
    return marked


def curve(rows: list[Row], kind: str) -> list[Point]:
    """Return the rows of one method as points; kind is raw or pulse. What the reference cannot resolve has error 0."""
    points = []
    for row in rows:
        error, resolution = getattr(row, f"nrmse_{kind}"), getattr(row, f"resolution_{kind}")
        points.append(Point(row.seconds, error if error > resolution else 0.0))
    return points


def _first_call(runner: Runner, quality: int) -> float:
    """Seconds of the first call at this quality, with memory that is not mapped yet."""
    runner.release()
    gc.collect()
    dr.flush_malloc_cache()
    start = time.perf_counter()
    runner.run(quality, 0)
    return time.perf_counter() - start
