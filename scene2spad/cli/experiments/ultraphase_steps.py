"""Steps of one core as lines: `ultraphase run --trace` and `--watch`, also of a frame that failed."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice

import numpy as np

from scene2spad.cli.experiments.ultraphase_inputs import LINKS, Photons
from scene2spad.options.experiments import Ultraphase
from scenes.errors import InputError
from ultraphase import Core, CoreArray, Program
from ultraphase.core import Counters, Step

MAX_WATCHED = 100


class _Stepped(Core):
    """A core that does not add up its cost at every step, which takes most of a step's time."""

    counters = Counters()


def look_at_core(
    command: Ultraphase, array: CoreArray, tables: Mapping[str, np.ndarray], photons: Photons
) -> dict[str, str | list[str]]:
    """Return the trace and the watched changes of core (0, 0) alone; without its neighbours it goes as far as its first
    link."""
    shown: dict[str, str | list[str]] = {}
    stop: list[str] = []
    if command.trace:
        steps = _Lines(array, tables, photons, 0)
        shown["trace"] = [*islice(steps.traced(stop), command.trace), *stop]
    if command.watch:
        steps, stop = _Lines(array, tables, photons, 0), []
        lines = [*islice(steps.changes(command.watch, stop), MAX_WATCHED + 1), *stop]
        shown["watch"] = lines[:MAX_WATCHED]
        if len(lines) > MAX_WATCHED:
            read = f"after {steps.read} of {len(photons.of_core(0))} photons"
            shown["watch_cut"] = f"the first {MAX_WATCHED} changes; the next one is at clock {steps.clock}, {read}"
    return shown


def explain_failure(
    command: Ultraphase, array: CoreArray, tables: Mapping[str, np.ndarray], photons: Photons, error: str
) -> Iterator[str]:
    """Yield the last steps, and the last changes of the watched RAM, of the core that failed; where no core fails
    alone, of the one that the error names, or the first."""
    if not (command.trace or command.watch):
        return
    core, most = _failing(array, tables, photons, error)
    place = f"core ({core // array.shape[1]}, {core % array.shape[1]})"
    if command.trace:
        steps = _Lines(array, tables, photons, core)
        last = deque(islice(steps.traced([]), most), maxlen=command.trace)
        yield f"{place}, last {len(last)} of {steps.done} steps (clock, line, word, instruction, changes):"
        yield from last
    if command.watch:
        steps = _Lines(array, tables, photons, core)
        changes = steps.changes(command.watch, [], most)
        last = deque(changes, maxlen=MAX_WATCHED)
        yield f"{place}, last {len(last)} changes of {command.watch} (clock, line, word, contents):"
        yield from last


def _failing(array: CoreArray, tables: Mapping[str, np.ndarray], photons: Photons, error: str) -> tuple[int, int]:
    """Return the core to show, and how many of its steps at the most."""
    reasons: dict[int, tuple[str, int]] = {}
    for number in range(array.shape[0] * array.shape[1]):
        core = _core(Core, array, tables, number)
        try:
            core.start(photons.of_core(number))
            core.run()
        except InputError as reason:
            reasons[number] = (str(reason), sum(core.visits))
            if str(reason) == error:
                return number, reasons[number][1]
    named = re.search(r"core \((\d+), (\d+)\)", error)
    linked = any(one.name in LINKS for one in array.program.instructions)
    number = int(named[1]) * array.shape[1] + int(named[2]) if named else 0
    if reasons and not linked and not named:
        number = min(reasons)
    return number, reasons.get(number, ("", 1 << 20))[1]


def _core(kind: type[Core], array: CoreArray, tables: Mapping[str, np.ndarray], number: int) -> Core:
    """Make a core of its own with the tables and the place of one of the array."""
    own = {name: values.reshape(-1, values.shape[-1]) for name, values in tables.items()}
    own = {name: rows[number % len(rows)] for name, rows in own.items()}
    place = (number // array.shape[1], number % array.shape[1])
    return kind(array.program, own, chip=array.chip, place=place)


class _Lines:
    """Steps of one core of an array as lines, with clock and line of the source; counts what was done until then."""

    def __init__(self, array: CoreArray, tables: Mapping[str, np.ndarray], photons: Photons, number: int) -> None:
        self.program: Program = array.program
        self.core = _core(_Stepped, array, tables, number)
        self.stamps, self.clocks = photons.of_core(number), array.chip.clocks_per_instruction
        self.done = self.read = 0

    @property
    def clock(self) -> int:
        return self.done * self.clocks

    def _steps(self, stop: list[str]) -> Iterator[Step]:
        """Yield steps; where one fails, such as at a link, the reason goes into `stop`."""
        try:
            self.core.start(self.stamps)
            for step in self.core.trace():
                self.done += 1
                self.read += step.instruction.name == "RDT"
                yield step
        except InputError as reason:
            stop.append(f"stops: {reason}")

    def _where(self, step: Step) -> str:
        file, line = self.program.lines[step.before.word]
        return f"{self.clock:7d}  {f'{file}:{line}':16s}"

    def traced(self, stop: list[str]) -> Iterable[str]:
        """Yield a line for every step: clock after it, line of the source, word, instruction, what it changed."""
        return (f"{self._where(step)}  {step}" for step in self._steps(stop))

    def changes(self, region: str, stop: list[str], most: int | None = None) -> Iterator[str]:
        """Yield a line for every step that changes a region of RAM, with the region's contents after it."""
        part = self.program.region(region)
        for step in islice(self._steps(stop), most):
            if step.before.ram[part.address : part.end] != step.after.ram[part.address : part.end]:
                yield f"{self._where(step)}  {step.before.word:4d}  {self.core.contents(region).tolist()}"
