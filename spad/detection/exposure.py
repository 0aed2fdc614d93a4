"""One exposure of the sensor drawn, block of pixels after block, by the law that was chosen: counts or timestamps."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import TypeVar

import numpy as np

from render.transient import Transient
from scenes.errors import InputError
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from scenes.progress import Progress
from scenes.random_streams import Stream
from spad.detection.detectors import BlockLight, DetectionLaw
from spad.detection.jitter import before_detection, blurred, delayed, over_the_period, steps_per_bin
from spad.detection.laws import Detections, Moved, add_crosstalk, crosstalk_events
from spad.detection.photons import PixelFlux
from spad.detection.rates import Rates
from spad.measurements.timestamps import Timestamps
from spad.sensor.model import Sensor
from spad.sensor.tdc import time_codes

log = logging.getLogger(__name__)
Finished = TypeVar("Finished")
# One random stream for this many pixels: the counts do not depend on threads, nor on how the work is cut.
STREAM_PIXELS = 1024
# From this many primary detections a bin on, drawing every bin is cheaper than drawing every photon (measured).
DENSE_FROM = 4.0
STEPS_PER_BIN = 40  # before jitter, whose drawing costs as much as that of a bin (measured)
# Photons, or bins, that a thread holds at once: a block with more is drawn in parts. None of up to 4096 bins has more.
MAX_HELD = 1 << 24
MAX_CROSSTALK_EVENTS = 1 << 26
MANY_EVENTS = 1e7  # drawn one by one, from which on it is said before: some seconds of work on a core


@dataclass(frozen=True, eq=False)
class Exposure:
    """One exposure under one law."""

    transient: Transient
    sensor: Sensor
    rates: Rates
    whole: PixelFlux
    law: DetectionLaw
    seed: int

    @property
    def blocks(self) -> list[slice]:
        pixels = self.transient.height * self.transient.width
        return [slice(first, min(first + STREAM_PIXELS, pixels)) for first in range(0, pixels, STREAM_PIXELS)]

    def rng(self, stage: int, block: slice) -> np.random.Generator:
        seeds = np.random.SeedSequence(self.seed, spawn_key=(stage, 0, block.start // STREAM_PIXELS))
        return np.random.Generator(np.random.SFC64(seeds))

    @property
    def delays_detected(self) -> bool:
        """Return whether jitter delays what the law has chosen; else it is drawn with the pulse (`jitter`)."""
        return bool(self.sensor.jitters) and not self.law.independent

    @property
    def timed(self) -> bool:
        """Return whether detections are drawn at times, which jitter and a converter then put into bins, or in bins at
        once."""
        return self.sensor.tdc is not None or self.delays_detected

    def coded(self, events: Detections, first: int) -> Detections:
        """Return detections with the bins that their pixels' converters give them; pixels are counted from `first`."""
        edges, converter = self.sensor.code_edges, self.rates.converter
        if edges is None or converter is None:
            return events
        mine = converter.reshape(-1)[events.pixel + first]
        return events._replace(position=time_codes(events.position, mine, edges))

    def recorded(self, events: Detections) -> Detections:
        """Return the detections that find a bin: a detector blinds itself also in the part of the period without."""
        anywhere = self.law.whole_period or self.delays_detected
        if not anywhere or self.sensor.bins == self.sensor.bins_per_period:
            return events
        seen = events.position < self.sensor.bins
        return Detections(*(column[seen] for column in events))

    def finished(self, events: Detections, first: int, rng: np.random.Generator) -> Detections:
        """Return what the law detected as it is recorded: with jitter, in bins; pixels are counted from `first`."""
        return self.coded(self.recorded(delayed(events, self.sensor, rng) if self.delays_detected else events), first)

    @property
    def adds_crosstalk(self) -> bool:
        """Return whether crosstalk only adds to counts: no detection keeps another one from being made."""
        return bool(self.sensor.crosstalk) and self.law.independent and not self.timed

    def moved(self, block: slice) -> Moved | None:
        """Return what turns shares of detections in bins of the period into those with jitter; None without any."""
        if not self.delays_detected:
            return None
        converter = None if self.rates.converter is None else self.rates.converter.reshape(-1)[block]
        return partial(blurred, sensor=self.sensor, converter=converter)

    def light(self, block: slice) -> BlockLight:
        first, last = self.transient.offsets[block.start], self.transient.offsets[block.stop]
        owner, start, length, signal, background = self.whole
        part = slice(first, last)
        flux = PixelFlux(owner[part] - block.start, start[part], length[part], signal[part], background[block])
        return BlockLight(flux, before_detection(self.sensor) if self.delays_detected else self.sensor, self.timed)


def counts_of(exposure: Exposure, progress: Progress | None) -> np.ndarray:
    """Return (H, W, T) int32."""
    height, width, bins = exposure.transient.height, exposure.transient.width, exposure.sensor.bins
    require_memory(4 * height * width * bins, f"a histogram of {width} x {height} pixels and {bins} bins")
    counts: np.ndarray = np.zeros((height * width, bins), dtype=np.int32)

    def fill(block: slice, drawn: np.ndarray) -> None:
        if drawn.ndim == 2:
            _fill(counts[block], drawn)
        else:
            # NumPy is twice as fast with int64 indices, and a hundred times with a one of the counts' own type
            np.add.at(counts[block].reshape(-1), drawn.astype(np.int64), np.int32(1))

    _draw(exposure, fill, progress)
    counts = counts.reshape(height, width, bins)
    if exposure.adds_crosstalk:
        add_crosstalk(counts, exposure.sensor.crosstalk, exposure.rng(Stream.CROSSTALK, slice(0, 0)))
        counts[exposure.rates.alive == 0] = 0  # dead pixels detect no crosstalk either
    return counts


def _fill(counts: np.ndarray, drawn: np.ndarray) -> None:
    most = drawn.max(initial=0)
    if most > np.iinfo(np.int32).max:
        raise InputError(f"a bin holds {most} counts, the limit is {np.iinfo(np.int32).max}")
    counts[:] = drawn


def timestamps_of(exposure: Exposure, meta: JsonObject, progress: Progress | None) -> Timestamps:
    height, width, bins = exposure.transient.height, exposure.transient.width, exposure.sensor.bins
    if exposure.adds_crosstalk:
        return Timestamps.of_counts(counts_of(exposure, progress), meta)

    def sorted_stamps(block: slice, drawn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places = np.repeat(np.arange(drawn.size, dtype=np.int32), drawn.ravel()) if drawn.ndim == 2 else np.sort(drawn)
        starts = np.arange(block.stop - block.start + 1, dtype=np.int32) * np.int32(bins)
        number = np.diff(np.searchsorted(places, starts))
        return (places - np.repeat(starts[:-1], number)).astype(np.uint16), number

    stamps, numbers = zip(*_draw(exposure, sorted_stamps, progress), strict=True)
    offsets = np.cumsum(np.concatenate(([0], *numbers)), dtype=np.int64)
    return Timestamps(height, width, bins, np.concatenate(stamps), offsets, meta)


def thread_count() -> int:
    """Return how many threads torch uses where it is loaded, else OMP_NUM_THREADS, or the processors there are."""
    if "torch" in sys.modules:
        return int(sys.modules["torch"].get_num_threads())
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(asked)) if asked.isdecimal() else len(os.sched_getaffinity(0))


def _draw(
    exposure: Exposure, finish: Callable[[slice, np.ndarray], Finished], progress: Progress | None
) -> list[Finished]:
    """Call finish(pixels, detected) for every block or part of it, on `thread_count()` threads.

    What was detected: counts (P, T), or places pixel x T + bin (N,) int32 in no order, pixels counted from the block's.
    """
    _forecast(exposure)
    meter, ready = Meter(progress, exposure.whole.pixels), np.zeros(exposure.whole.pixels)
    if exposure.sensor.crosstalk and not exposure.adds_crosstalk:
        return [finish(block, places) for block, places in _with_crosstalk(exposure, ready, meter)]
    blocks, workers = exposure.blocks, thread_count()
    finished: list[Finished] = []
    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(blocks), 4 * workers):  # no more at once than a few
            group = blocks[start : start + 4 * workers]
            for drawn in pool.map(lambda block: _block(exposure, block, ready, finish, meter), group):
                finished += drawn
    return finished


class Meter:
    """Report how many of an exposure's pixels are drawn, from any thread."""

    def __init__(self, progress: Progress | None, pixels: int) -> None:
        self.progress, self.pixels, self.done, self.lock = progress, pixels, 0.0, Lock()
        self.add(0.0)

    def add(self, pixels: float) -> None:
        """Add pixels that are drawn, or parts of them: of a pixel drawn over half of the exposure a half."""
        with self.lock:
            self.done += pixels
            if self.progress is not None:
                self.progress("sense", min(1.0, self.done / self.pixels))

    def count(self, parts: Iterator[Detections], pieces: int, pixels: int) -> Iterator[Detections]:
        """Pass detections on, and add the pixels by as many pieces as there are."""
        for part in parts:
            yield part
            self.add(pixels / pieces)


def _forecast(exposure: Exposure) -> None:
    """Tell how many events a law that draws them one by one has before it, where they are many."""
    events = float(exposure.whole.signal.sum() + exposure.whole.background.sum())
    if exposure.law.by_bins or events < MANY_EVENTS:
        return
    message = "%s: %.3g photons are drawn one by one; fewer photons or a shorter exposure take less time"
    log.info(message, exposure.law.name, events)


def _block(
    exposure: Exposure,
    block: slice,
    ready: np.ndarray,
    finish: Callable[[slice, np.ndarray], Finished],
    meter: Meter,
) -> list[Finished]:
    """Draw the detections of a block, and call `finish` with as many of its pixels as can be held at once."""
    rng = exposure.rng(Stream.SENSE, block)
    return [finish(part, draw_part(exposure, part, ready[part], rng, meter)) for part in _parts(exposure, block)]


def _is_dense(exposure: Exposure, light: BlockLight) -> bool:
    by_bins = exposure.law.by_bins and not (exposure.delays_detected and steps_per_bin(exposure.sensor) == 0)
    bins = max(exposure.sensor.bins, _held_per_pixel(exposure) / STEPS_PER_BIN)
    return by_bins and light.primaries > DENSE_FROM * bins * light.flux.pixels


def _held_per_pixel(exposure: Exposure) -> int:
    """Return how many numbers drawing every bin of a pixel at once holds."""
    sensor = exposure.sensor
    return sensor.bins_per_period * steps_per_bin(sensor) if exposure.delays_detected else sensor.bins


def _parts(exposure: Exposure, block: slice) -> Iterator[slice]:
    """Yield a block's pixels in parts that hold at most MAX_HELD photons or bins each."""
    light, pixels = exposure.light(block), block.stop - block.start
    held = _held_per_pixel(exposure) * pixels if _is_dense(exposure, light) else light.primaries
    if held <= MAX_HELD or pixels == 1 or not exposure.law.by_bins:  # event by event it is cut into cycles
        yield block
        return
    middle = block.start + pixels // 2
    yield from _parts(exposure, slice(block.start, middle))
    yield from _parts(exposure, slice(middle, block.stop))


def draw_part(
    exposure: Exposure, block: slice, ready: np.ndarray, rng: np.random.Generator, meter: Meter
) -> np.ndarray:
    """Draw the detections of some pixels: places, or counts (P, T) where every bin is drawn at once."""
    law, light = exposure.law, exposure.light(block)
    if _is_dense(exposure, light):
        from spad.detection.flux import expected_counts  # with torch, whose import takes a second

        sensor = over_the_period(exposure.sensor) if exposure.delays_detected else exposure.sensor
        rate = expected_counts(exposure.transient, sensor, exposure.rates, block)[0].numpy()
        meter.add(light.flux.pixels)
        return law.counts(rate, sensor.whole_cycles, rng, exposure.moved(block))
    parts = meter.count(law.detect(light, rng, ready), law.pieces(light), light.flux.pixels)
    return np.concatenate([_places(exposure.finished(part, block.start, rng), exposure.sensor) for part in parts])


def _places(detected: Detections, sensor: Sensor) -> np.ndarray:
    return detected.pixel.astype(np.int32) * np.int32(sensor.bins) + detected.position.astype(np.int32)


def _check_crosstalk_events(exposure: Exposure) -> None:
    """Raise InputError where the photons that crosstalk is drawn from would be too many to hold.

    A law that draws a block's photons at once holds those too, detected or not.
    """
    primaries = exposure.whole.signal_per_pixel() + exposure.whole.background
    expected = float(exposure.law.expected(primaries, exposure.sensor).sum())
    if exposure.law.by_bins:
        expected = max(expected, *(float(primaries[block].sum()) for block in exposure.blocks))
    if expected > MAX_CROSSTALK_EVENTS:
        raise InputError(
            f"crosstalk event by event: {expected:.3g} events would be held at once, the limit is "
            f"{MAX_CROSSTALK_EVENTS}; lower the photon budget or the exposure, or take model poisson"
        )


def _with_crosstalk(exposure: Exposure, ready: np.ndarray, meter: Meter) -> Iterator[tuple[slice, np.ndarray]]:
    """Detect event by event over the whole image: detections fire neighbours, whose detector then decides between both.

    A detection that a neighbour's crosstalk makes impossible keeps what it fired itself, and crosstalk fires no
    further crosstalk: both are of second order in its probability. Raises InputError where over 2^26 are expected.
    """
    sensor, transient = exposure.sensor, exposure.transient
    _check_crosstalk_events(exposure)
    everything, before = [], ready.copy()
    for block in exposure.blocks:
        rng, light = exposure.rng(Stream.SENSE, block), exposure.light(block)
        # without dead time: a photon that it hides may be seen where crosstalk comes before what hides it
        light = light._replace(sensor=replace(light.sensor, dead_time_s=0.0))
        drawn, pieces = exposure.law.detect(light, rng, before[block]), exposure.law.pieces(light)
        parts = list(meter.count(drawn, pieces, light.flux.pixels))
        everything += [part._replace(pixel=part.pixel + block.start) for part in parts]
    events = Detections(*(np.concatenate(columns) for columns in zip(*everything, strict=True)))
    rng = exposure.rng(Stream.CROSSTALK, slice(0, 0))
    alone = exposure.law.keep(events, sensor, ready.copy())
    cause, pixel = crosstalk_events(alone.pixel, sensor.crosstalk, transient.height, transient.width, rng)
    seen = exposure.rates.alive.ravel()[pixel] > 0  # dead pixels detect no crosstalk either
    cause, pixel = cause[seen], pixel[seen]
    fired = Detections(pixel, alone.cycle[cause], alone.position[cause])
    both = Detections(*(np.concatenate(columns) for columns in zip(events, fired, strict=True)))
    detected = exposure.finished(exposure.law.keep(both, sensor, ready), 0, rng)
    places = np.sort(detected.pixel * np.int64(sensor.bins) + detected.position.astype(np.int64))
    edges = [block.start * sensor.bins for block in exposure.blocks]
    edges.append(exposure.rates.alive.size * sensor.bins)
    cuts = np.searchsorted(places, edges)
    for number, block in enumerate(exposure.blocks):
        yield block, (places[cuts[number] : cuts[number + 1]] - edges[number]).astype(np.int32)
