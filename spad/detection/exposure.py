"""One exposure of the sensor drawn, block of pixels after block, by the law that was chosen: counts or timestamps."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from render.transient import Transient
from scenes.errors import InputError
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from scenes.progress import Progress
from scenes.random_streams import Stream
from spad.detection.laws import (
    Detections,
    add_crosstalk,
    crosstalk_events,
    first_of_each_cycle,
    first_photon_counts,
    live_detections,
)
from spad.detection.photons import PixelFlux, draw_primaries
from spad.detection.rates import Rates
from spad.formats.timestamps import Timestamps
from spad.sensor.model import Sensor
from spad.sensor.tdc import time_codes

Finished = TypeVar("Finished")
# One random stream for this many pixels: the counts do not depend on threads, nor on how the work is cut.
STREAM_PIXELS = 1024
# From this many primary detections a bin on, drawing every bin is cheaper than drawing every photon (measured).
DENSE_FROM = 4.0
MAX_EVENTS = 1 << 22  # held at once by the event-by-event laws, about 200 MB
MAX_CROSSTALK_EVENTS = 1 << 26


@dataclass(frozen=True, eq=False)
class Exposure:
    """One exposure, or part `part` of `parts` equal ones in cycles, under one law."""

    transient: Transient
    sensor: Sensor
    rates: Rates
    whole: PixelFlux
    model: str
    seed: int
    part: int = 0
    parts: int = 1

    @property
    def cycles(self) -> tuple[int, int]:
        """Return the first and last + 1 laser cycle of this part; an exposure has a whole number."""
        total = round(self.sensor.cycles)
        return total * self.part // self.parts, total * (self.part + 1) // self.parts

    @property
    def fraction(self) -> float:
        first, last = self.cycles
        return (last - first) / round(self.sensor.cycles)

    @property
    def blocks(self) -> list[slice]:
        pixels = self.transient.height * self.transient.width
        return [slice(first, min(first + STREAM_PIXELS, pixels)) for first in range(0, pixels, STREAM_PIXELS)]

    def rng(self, stage: int, block: slice) -> np.random.Generator:
        seeds = np.random.SeedSequence(self.seed, spawn_key=(stage, self.part, block.start // STREAM_PIXELS))
        return np.random.Generator(np.random.SFC64(seeds))

    @property
    def timed(self) -> bool:
        """Return whether detections are drawn at times, which a converter then puts into bins, or in bins at once."""
        return self.sensor.tdc is not None

    def coded(self, events: Detections, first: int) -> Detections:
        """Return detections with the bins that their pixels' converters give them; pixels are counted from `first`."""
        edges, converter = self.sensor.code_edges, self.rates.converter
        if edges is None or converter is None:
            return events
        mine = converter.reshape(-1)[events.pixel + first]
        return events._replace(position=time_codes(events.position, mine, edges))

    def primaries(self, light: PixelFlux, rng: np.random.Generator) -> Detections:
        """Draw primary detections and their laser cycles: times where a converter is to make bins of them."""
        events = draw_primaries(light, self.sensor, rng, fraction=self.fraction, fractional=self.timed)
        return Detections(events.pixel, np.zeros(len(events.pixel), np.int8), events.position)

    def light(self, block: slice) -> PixelFlux:
        first, last = self.transient.offsets[block.start], self.transient.offsets[block.stop]
        owner, start, length, signal, background = self.whole
        part = slice(first, last)
        return PixelFlux(owner[part] - block.start, start[part], length[part], signal[part], background[block])


def counts_of(exposure: Exposure, progress: Progress | None) -> np.ndarray:
    """Return (H, W, T) int32."""
    height, width, bins = exposure.transient.height, exposure.transient.width, exposure.sensor.bins
    require_memory(4 * height * width * bins, f"a histogram of {width} x {height} pixels and {bins} bins")
    counts: np.ndarray = np.zeros((height * width, bins), dtype=np.int32)

    def fill(block: slice, drawn: np.ndarray) -> None:
        if drawn.ndim == 2:
            _fill(counts[block], drawn)
        else:
            # of other types than these it is thirty times slower
            np.add.at(counts[block].reshape(-1), drawn.astype(np.int64), np.int32(1))

    _draw(exposure, fill, progress, np.zeros(height * width))
    counts = counts.reshape(height, width, bins)
    if exposure.sensor.crosstalk and exposure.model == "poisson" and not exposure.timed:
        add_crosstalk(counts, exposure.sensor.crosstalk, exposure.rng(Stream.CROSSTALK, slice(0, 0)))
    return counts


def _fill(counts: np.ndarray, drawn: np.ndarray) -> None:
    most = drawn.max(initial=0)
    if most > np.iinfo(np.int32).max:
        raise InputError(f"a bin holds {most} counts, the limit is {np.iinfo(np.int32).max}")
    counts[:] = drawn


def timestamps_of(
    exposure: Exposure, meta: JsonObject, progress: Progress | None, ready: np.ndarray | None = None
) -> Timestamps:
    height, width, bins = exposure.transient.height, exposure.transient.width, exposure.sensor.bins
    if exposure.sensor.crosstalk and exposure.model == "poisson" and not exposure.timed:
        return Timestamps.of_counts(counts_of(exposure, progress), meta)
    ready = np.zeros(height * width) if ready is None else ready

    def sorted_stamps(block: slice, drawn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places = np.repeat(np.arange(drawn.size, dtype=np.int32), drawn.ravel()) if drawn.ndim == 2 else np.sort(drawn)
        starts = np.arange(block.stop - block.start + 1, dtype=np.int32) * np.int32(bins)
        number = np.diff(np.searchsorted(places, starts))
        return (places - np.repeat(starts[:-1], number)).astype(np.uint16), number

    stamps, numbers = zip(*_draw(exposure, sorted_stamps, progress, ready), strict=True)
    offsets = np.cumsum(np.concatenate(([0], *numbers)), dtype=np.int64)
    return Timestamps(height, width, bins, np.concatenate(stamps), offsets, meta)


def thread_count() -> int:
    """Return how many threads torch uses where it is loaded, else OMP_NUM_THREADS, or the processors there are."""
    if "torch" in sys.modules:
        return int(sys.modules["torch"].get_num_threads())
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(asked)) if asked.isdecimal() else len(os.sched_getaffinity(0))


def _draw(
    exposure: Exposure, finish: Callable[[slice, np.ndarray], Finished], progress: Progress | None, ready: np.ndarray
) -> list[Finished]:
    """Call finish(block, detected) for every block, on `thread_count()` threads.

    What was detected: counts (P, T), or places pixel x T + bin (N,) int32 in no order, pixels counted from the block's.
    """
    if exposure.sensor.crosstalk and (exposure.timed or exposure.model != "poisson"):
        return [finish(block, places) for block, places in _with_crosstalk(exposure, ready)]
    blocks, workers = exposure.blocks, thread_count()
    finished: list[Finished] = []
    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(blocks), 4 * workers):  # no more at once than a few
            if progress is not None:
                progress("sense", start / len(blocks))
            group = blocks[start : start + 4 * workers]
            finished += pool.map(lambda block: finish(block, _block(exposure, block, ready[block])), group)
    return finished


def _block(exposure: Exposure, block: slice, ready: np.ndarray) -> np.ndarray:
    sensor, rng, light = exposure.sensor, exposure.rng(Stream.SENSE, block), exposure.light(block)
    if exposure.model == "free-running":
        parts = _free_running(exposure, light, rng, ready)
        places = [_places(exposure.coded(part, block.start), sensor) for part in parts]
        return np.concatenate(places)
    primaries = float(light.signal.sum() + light.background.sum()) * exposure.fraction
    if primaries > DENSE_FROM * sensor.bins * light.pixels:
        return _dense(exposure, block, rng)
    events = exposure.coded(exposure.primaries(light, rng), block.start)
    if exposure.model == "poisson":
        return _places(events, sensor)
    # codes rise with time: the first photon is the one of the lowest code
    return _places(_first_photons(exposure, events, rng), sensor)


def _dense(exposure: Exposure, block: slice, rng: np.random.Generator) -> np.ndarray:
    """Draw every bin from its rate, (P, T)."""
    from spad.detection.flux import expected_counts  # with torch, whose import takes a second

    rate = expected_counts(exposure.transient, exposure.sensor, exposure.rates, block)[0].numpy()
    if exposure.model == "poisson":
        return rng.poisson(rate * exposure.fraction)
    first, last = exposure.cycles
    return first_photon_counts(rate / round(exposure.sensor.cycles), last - first, rng)


def _places(detected: Detections, sensor: Sensor) -> np.ndarray:
    return detected.pixel.astype(np.int32) * np.int32(sensor.bins) + detected.position.astype(np.int32)


def _first_photons(exposure: Exposure, events: Detections, rng: np.random.Generator) -> Detections:
    cycle = rng.integers(*exposure.cycles, len(events.pixel))
    return first_of_each_cycle(events._replace(cycle=cycle), exposure.sensor)


def _free_running(
    exposure: Exposure, light: PixelFlux, rng: np.random.Generator, ready: np.ndarray
) -> Iterator[Detections]:
    """Yield the detections of as many cycles at a time as memory allows; `ready` (P,) in bins is carried on."""
    sensor, (first, last) = exposure.sensor, exposure.cycles
    primaries = float(light.signal.sum() + light.background.sum()) * exposure.fraction
    pieces = min(max(1, math.ceil(primaries / MAX_EVENTS)), last - first)
    edges = [first + (last - first) * piece // pieces for piece in range(pieces + 1)]
    for start, stop in pairwise(edges):
        fraction = (stop - start) / round(sensor.cycles)
        events = draw_primaries(light, sensor, rng, fraction=fraction, fractional=True)
        primary = Detections(events.pixel, rng.integers(start, stop, len(events.pixel)), events.position)
        yield _alive(primary, sensor, ready)


def _alive(events: Detections, sensor: Sensor, ready: np.ndarray) -> Detections:
    time = events.cycle * float(sensor.bins_per_period) + events.position
    kept = live_detections(events.pixel, time, sensor.dead_time_s / sensor.bin_width_s, ready)
    return Detections(*(column[kept] for column in events))


def _with_crosstalk(exposure: Exposure, ready: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Detect event by event over the whole image: detections fire neighbours, whose detector then decides between both.

    A detection that a neighbour's crosstalk makes impossible keeps what it fired itself, and crosstalk fires no
    further crosstalk: both are of second order in its probability. Raises InputError for more than 2^26 detections.
    """
    sensor, transient = exposure.sensor, exposure.transient
    everything, before = [], ready.copy()
    total = 0
    for block in exposure.blocks:
        rng, light = exposure.rng(Stream.SENSE, block), exposure.light(block)
        if exposure.model == "first-photon":
            parts = [_first_photons(exposure, exposure.primaries(light, rng), rng)]
        elif exposure.model == "poisson":
            parts = [exposure.primaries(light, rng)]
        else:
            parts = list(_free_running(exposure, light, rng, before[block]))
        everything += [part._replace(pixel=part.pixel + block.start) for part in parts]
        total += sum(len(part.pixel) for part in parts)
        if total > MAX_CROSSTALK_EVENTS:
            raise InputError(
                f"crosstalk event by event: over {MAX_CROSSTALK_EVENTS} detections; "
                "lower the photon budget or the exposure, or take model poisson"
            )
    events = Detections(*(np.concatenate(columns) for columns in zip(*everything, strict=True)))
    rng = exposure.rng(Stream.CROSSTALK, slice(0, 0))
    cause, pixel = crosstalk_events(events.pixel, sensor.crosstalk, transient.height, transient.width, rng)
    fired = Detections(pixel, events.cycle[cause], events.position[cause])
    both = Detections(*(np.concatenate(columns) for columns in zip(events, fired, strict=True)))
    detected = exposure.coded(_detected(exposure, both, ready), 0)
    places = np.sort(detected.pixel * np.int64(sensor.bins) + detected.position.astype(np.int64))
    edges = [block.start * sensor.bins for block in exposure.blocks]
    edges.append(exposure.rates.alive.size * sensor.bins)
    cuts = np.searchsorted(places, edges)
    for number, block in enumerate(exposure.blocks):
        yield block, (places[cuts[number] : cuts[number + 1]] - edges[number]).astype(np.int32)


def _detected(exposure: Exposure, both: Detections, ready: np.ndarray) -> Detections:
    """Decide by the exposure's law which of photons and crosstalk are detected."""
    if exposure.model == "poisson":
        return both
    return (
        first_of_each_cycle(both, exposure.sensor)
        if exposure.model == "first-photon"
        else _alive(both, exposure.sensor, ready)
    )
