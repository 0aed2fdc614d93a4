"""Detection laws as objects: which of the light of a block of pixels a detector counts.

Each law draws the detections of a block from its light (`detect`), photon by photon; decides between photons and the
crosstalk of neighbours (`keep`); and, where it can, draws every bin at once (`counts`), which costs less where photons
are many. `LAWS` names them all.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np

from spad.detection.laws import Detections, Moved, first_of_each_cycle, first_photon_counts, live_detections
from spad.detection.photons import PixelFlux, draw_primaries
from spad.sensor.model import Sensor

MAX_EVENTS = 1 << 22  # held at once by the event-by-event laws, about 200 MB


class BlockLight(NamedTuple):
    """Light on a block of pixels during an exposure, and the sensor as light reaches it.

    `timed` says whether detections are drawn at times, over the whole period, which jitter delays or a converter puts
    into bins; else they are drawn in bins at once.
    """

    flux: PixelFlux
    sensor: Sensor
    timed: bool

    @property
    def primaries(self) -> float:
        """Return the expected primary detections of the block, before dead time takes its share."""
        return float(self.flux.signal.sum() + self.flux.background.sum())

    def drawn(self, rng: np.random.Generator) -> Detections:
        """Draw the primary detections, all in cycle 0."""
        events = draw_primaries(self.flux, self.sensor, rng, fractional=self.timed, whole_period=self.timed)
        return Detections(events.pixel, np.zeros(len(events.pixel), np.int8), events.position)


class DetectionLaw(ABC):
    """What a detector that may be blind for a while makes of its primary detections."""

    name: ClassVar[str]
    independent: ClassVar[bool] = False  # no detection keeps another one from being made
    by_bins: ClassVar[bool] = True  # whether `counts` draws every bin at once
    whole_period: ClassVar[bool] = False  # whether detections outside a shorter record blind the detector, too

    @abstractmethod
    def detect(self, light: BlockLight, rng: np.random.Generator, ready: np.ndarray) -> Iterator[Detections]:
        """Yield the detections of a block, a number of cycles at a time; those of a `whole_period` law may lie
        outside the record.

        ready (P,) is when each pixel is armed first, in bins; it is moved on to when it is armed after the last one.
        """

    def pieces(self, light: BlockLight) -> int:
        """Return how many times `detect` yields."""
        return 1

    @abstractmethod
    def keep(self, events: Detections, sensor: Sensor, ready: np.ndarray) -> Detections:
        """Return those of given events, photons and crosstalk, that are detected."""

    def expected(self, primaries: np.ndarray, sensor: Sensor) -> np.ndarray:
        """Return about how many of so many primary detections a pixel and exposure crosstalk is drawn beside, (P,) ->
        (P,): all, where crosstalk may let the detector see any of them."""
        return primaries

    def counts(self, rate: np.ndarray, cycles: int, rng: np.random.Generator, moved: Moved | None = None) -> np.ndarray:
        """Draw counts (P, T) from expected primary detections of an exposure of `cycles`.

        `moved` turns shares of detections in the bins of the period into those after jitter, in the sensor's bins.
        """
        raise NotImplementedError(f"{self.name} is drawn photon by photon")


class Poisson(DetectionLaw):
    """Every photon is detected: exact at low flux."""

    name, independent = "poisson", True

    def detect(self, light: BlockLight, rng: np.random.Generator, ready: np.ndarray) -> Iterator[Detections]:
        """Yield all primary detections."""
        yield light.drawn(rng)

    def keep(self, events: Detections, sensor: Sensor, ready: np.ndarray) -> Detections:
        """Return all events."""
        return events

    def counts(self, rate: np.ndarray, cycles: int, rng: np.random.Generator, moved: Moved | None = None) -> np.ndarray:
        """Draw n_i ~ Poisson(lambda_i) in every bin; the rates hold all jitter."""
        return rng.poisson(rate)


class FirstPhoton(DetectionLaw):
    """A synchronous detector, armed at every cycle, detects the first photon of each."""

    name = "first-photon"

    def detect(self, light: BlockLight, rng: np.random.Generator, ready: np.ndarray) -> Iterator[Detections]:
        """Yield the first of the primary detections of each cycle."""
        events = light.drawn(rng)
        events = events._replace(cycle=rng.integers(light.sensor.whole_cycles, size=len(events.pixel)))
        yield first_of_each_cycle(events, light.sensor)

    def keep(self, events: Detections, sensor: Sensor, ready: np.ndarray) -> Detections:
        """Return the first event of each pixel and cycle."""
        return first_of_each_cycle(events, sensor)

    def expected(self, primaries: np.ndarray, sensor: Sensor) -> np.ndarray:
        """Return the number of cycles that hold a photon."""
        return -sensor.whole_cycles * np.expm1(-primaries / sensor.whole_cycles)

    def counts(self, rate: np.ndarray, cycles: int, rng: np.random.Generator, moved: Moved | None = None) -> np.ndarray:
        """Draw the multinomial of all cycles (`first_photon_counts`)."""
        return first_photon_counts(rate / cycles, cycles, rng, moved)


class FreeRunning(DetectionLaw):
    """A detector that is blind for its dead time after each detection, and armed at once when that is over."""

    name, by_bins, whole_period = "free-running", False, True

    def pieces(self, light: BlockLight) -> int:
        """Return into how many stretches of cycles an exposure is cut, so that MAX_EVENTS are held at once."""
        return min(max(1, math.ceil(light.primaries / MAX_EVENTS)), light.sensor.whole_cycles)

    def detect(self, light: BlockLight, rng: np.random.Generator, ready: np.ndarray) -> Iterator[Detections]:
        """Yield the detections of as many cycles at a time as memory allows."""
        sensor, cycles, pieces = light.sensor, light.sensor.whole_cycles, self.pieces(light)
        edges = [cycles * piece // pieces for piece in range(pieces + 1)]
        for start, stop in pairwise(edges):
            fraction = (stop - start) / cycles
            events = draw_primaries(light.flux, sensor, rng, fraction=fraction, fractional=True, whole_period=True)
            cycle = rng.integers(start, stop, len(events.pixel))
            yield self.keep(Detections(events.pixel, cycle, events.position), sensor, ready)

    def keep(self, events: Detections, sensor: Sensor, ready: np.ndarray) -> Detections:
        """Return the events that find their pixel armed (`live_detections`)."""
        time = events.cycle * float(sensor.bins_per_period) + events.position
        kept = live_detections(events.pixel, time, sensor.dead_time_s / sensor.bin_width_s, ready)
        return Detections(*(column[kept] for column in events))


LAWS: dict[str, DetectionLaw] = {law.name: law for law in (Poisson(), FirstPhoton(), FreeRunning())}
