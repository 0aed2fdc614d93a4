"""Photons that come while a core is busy: emulation with arrival times, and the queue's closed form.

A core's port holds `port` timestamps; one that comes while it is full is lost. The core looks at its port when it is
done with a photon, and otherwise every few instructions of its idle loop. What follows, for a port of one timestamp and
Poisson arrivals of rate r: let D be the clocks from one look at a full port to the next, L those from a look at an
empty one to the next, and e those from the look to the instruction that reads, and so empties the port. A look finds
the port full with probability 1 - exp(-r (D - e)) after a full look and 1 - exp(-r L) after an empty one, so that

    f = (1 - q) / (1 - q + p),    p = mean of exp(-r (D - e)),    q = exp(-r L)

of the looks are full, each of which is a photon read, and the share of photons lost is

    1 - f / (r (f D + (1 - f) L)).

For L and e to 0 this is the queue M/D/1 with one place to wait, 1 - 1 / (rho + exp(-rho)), rho = r D; without the
place (M/D/1/1, Erlang's formula) it would be rho / (1 + rho).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from scenes.errors import InputError, require
from scenes.random_streams import Stream
from ultraphase.assembly.program import Program
from ultraphase.chip import ChipSpec
from ultraphase.core import WATCHDOG_STEPS, Core
from ultraphase.port import port_timestamps

# What the instructions up to the next branch do, how many they are, and which instruction asks the port
_Step: TypeAlias = tuple[Callable[[], int], int, str]
# The core at its last look at an empty port (word, registers, RAM), and when that was
_Idle: TypeAlias = tuple[tuple[int, tuple[int, ...], bytes], int]
_STREAM = Stream.PLAN  # arrivals share its number: it was given away twice, and results in files follow from it
_PORT_INSTRUCTIONS = ("BNT", "RDT", "BFE")


@dataclass(frozen=True)
class TimedFrame:
    """One frame with arrival times: photons that came, were read and were lost, what left, and clocks to its HALT."""

    arrived: int
    read: int
    lost: int
    out: tuple[int, ...]
    clocks: int

    @property
    def lost_fraction(self) -> float:
        return self.lost / self.arrived if self.arrived else 0.0


class TimedCore(Core):
    """A core whose timestamps come at their times: `timed_frame`. All else is `Core`'s.

    port   timestamps that wait at most; the assumed chip's port holds one
    """

    def __init__(
        self,
        program: Program,
        tables: Mapping[str, np.ndarray] | None = None,
        *,
        chip: ChipSpec | None = None,
        port: int = 1,
    ) -> None:
        super().__init__(program, tables, chip=chip)
        require(port >= 1, f"port of {port} timestamps, expected 1 or more")
        self.port = port
        self._frame_is_over, self._drains = False, True
        self._steps: dict[int, _Step] = {}  # by word

    def timed_frame(
        self, clocks: np.ndarray, timestamps: np.ndarray, frame_clocks: int, *, drain: bool = True
    ) -> TimedFrame:
        """Return one frame of `frame_clocks` clocks, to HALT; photons that come while it is drained belong to no frame.

        clocks (N,) when each photon comes, rising, 0 to frame_clocks; timestamps (N,) as the port tells them. Without
        `drain` it stops where the program would end the frame: there the cores of a block need each other.
        Raises InputError for other clocks, for timestamps that `start` refuses, and as `run` does.
        """
        times, port = np.asarray(clocks, np.float64), port_timestamps(timestamps, self.program)
        good = times.shape == port.shape and times.ndim == 1 and bool((np.diff(times) >= 0).all())
        good = good and (not times.size or (times[0] >= 0 and times[-1] < frame_clocks))
        require(good, f"arrivals: expected rising clocks from 0 to below {frame_clocks}, one for each timestamp")
        self.start([])
        self._frame_is_over, self._drains = False, drain
        waiting, stamps = times.tolist(), port.tolist()
        now = came = lost = steps = 0
        idle: _Idle | None = None
        per, word = self.chip.clocks_per_instruction, self.word
        while True:
            does, length, asks = self._step_at(word)
            if asks:
                while came < len(waiting) and waiting[came] <= now:
                    if len(self._port) - self._read < self.port:
                        self._port.append(stamps[came])
                    else:
                        lost += 1
                    came += 1
                self._frame_is_over = now >= frame_clocks
                if asks == "BNT" and self._read == len(self._port):
                    now, idle = self._idle(word, now, waiting[came] if came < len(waiting) else frame_clocks, idle)
                if asks == "RDT":
                    steps, idle = 0, None  # a turn with a photon in it is no idle one, whatever it leaves
            now += per * length
            word = does()
            if word < 0:
                return TimedFrame(len(waiting), self._read, lost, tuple(self.out), now)
            steps += 1
            if steps > WATCHDOG_STEPS:
                raise InputError(f"{self.program.where(word)}: no progress in {WATCHDOG_STEPS} branches")

    def _idle(self, word: int, now: int, until: float, before: _Idle | None) -> tuple[int, _Idle]:
        """Return the time of the last look at the port before `until`, when there is something to see: turns of an idle
        loop that leave the core as it was are counted, not run."""
        state = (word, tuple(self.registers), bytes(self.ram))
        if before is not None and before[0] == state and now > before[1]:
            turn = now - before[1]
            now += max(0, math.ceil((until - now) / turn) - 1) * turn
        return now, (state, now)

    def _step_at(self, word: int) -> _Step:
        """Compile the instructions from a word to the next branch, without one that asks the port unless it is the
        first."""
        if word not in self._steps:
            code = self.program.instructions
            asks = code[word].name if word < len(code) and code[word].name in _PORT_INSTRUCTIONS else ""
            stretch = self._function(word)
            inside = code[word + 1 : stretch.end + 1]
            if asks or any(one.name in _PORT_INSTRUCTIONS for one in inside):
                stretch = self._function(word, single=True)
            self._steps[word] = (stretch.does, stretch.end - word + 1, asks)
        return self._steps[word]

    def _over(self, word: int, target: int) -> int:
        if self._frame_is_over and not self._drains:
            return self._not_yet(word)
        return target if self._frame_is_over else word + 1


def lost_fraction(
    rate: float, service_clocks: np.ndarray | float, idle_clocks: float = 9, read_clocks: float = 3
) -> float:
    """Return share of Poisson photons that a core with a port of one timestamp loses (module docstring).

    rate            photons a clock
    service_clocks  D, from look to look, of every timestamp alike likely, or of all
    idle_clocks     L, of the idle loop: BNT, BFE, JMP
    read_clocks     e, from BNT to RDT
    """
    if rate <= 0:
        return 0.0
    service = np.asarray(service_clocks, np.float64)
    stays_empty = float(np.exp(-rate * (service - read_clocks)).mean())
    comes = -np.expm1(-rate * idle_clocks)
    full = comes / (comes + stays_empty)
    return float(1 - full / (rate * (full * float(service.mean()) + (1 - full) * idle_clocks)))


def poisson_arrivals(rate: float, frame_clocks: int, seed: int) -> np.ndarray:
    """Return rising clocks of a Poisson process of `rate` photons a clock. Raises InputError for a rate below 0, NaN or
    without end, and a frame below 0."""
    require(0 <= rate < np.inf, f"arrivals: a rate of {rate:g} photons a clock, expected a finite number of 0 or more")
    require(frame_clocks >= 0, f"arrivals: a frame of {frame_clocks} clocks, expected 0 or more")
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
    return np.sort(random.random(random.poisson(rate * frame_clocks))) * frame_clocks
