"""One core, instruction by instruction: for reading what a program does. For many cores at once see `array`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType
from typing import Any

import numpy as np

from scenes.errors import InputError, require, require_kind
from ultraphase.assembly.isa import REGISTERS, Instruction, format_instruction
from ultraphase.assembly.program import KINDS, Program
from ultraphase.assembly.translate import source
from ultraphase.chip import ChipSpec, chosen_chip, whole_pair
from ultraphase.port import port_timestamps

WATCHDOG_STEPS = 1 << 14  # instructions without a timestamp read, a word out or an end, after which a core is stuck
# Words that may leave a core in a frame, off the sensor or over a link, and more for each photon, as of programs that
# send photons on. Those of which more leave never end.
MAX_WORDS, WORDS_PER_PHOTON = 1 << 16, 16
_STOP = -1


@dataclass(frozen=True)
class Counters:
    """Cost of a run. cycles = instructions x clocks per instruction (+ stalls on links, in an array)."""

    instructions: int = 0
    cycles: int = 0
    photons: int = 0
    ram_reads: int = 0
    ram_writes: int = 0
    wraps: int = 0
    saturations: int = 0

    def __add__(self, other: Counters) -> Counters:
        return Counters(*(getattr(self, name) + getattr(other, name) for name in Counters.__dataclass_fields__))

    def __sub__(self, other: Counters) -> Counters:
        return Counters(*(getattr(self, name) - getattr(other, name) for name in Counters.__dataclass_fields__))


@dataclass(frozen=True)
class State:
    """A core between two instructions."""

    word: int
    registers: tuple[int, ...]
    ram: bytes
    out: tuple[int, ...]
    counters: Counters


@dataclass(frozen=True)
class Step:
    """One instruction: the core before and after it."""

    before: State
    after: State
    instruction: Instruction

    def changes(self) -> list[str]:
        """Return registers and RAM bytes that it changed, as `r3: 4 -> 5` and `[17]: 0 -> 1`."""
        registers = zip(self.before.registers, self.after.registers, strict=True)
        changed = [f"r{n}: {old} -> {new}" for n, (old, new) in enumerate(registers) if old != new]
        ram = zip(self.before.ram, self.after.ram, strict=True)
        return changed + [f"[{n}]: {old} -> {new}" for n, (old, new) in enumerate(ram) if old != new]

    def __str__(self) -> str:
        return f"{self.before.word:4d}  {format_instruction(self.instruction):28s} {', '.join(self.changes())}".rstrip()


@dataclass
class _BasicBlock:
    """Instructions that always follow each other, as one function that gives the next word (or stops); the last of
    them, and how often they ran."""

    does: Callable[[], int]
    end: int
    times: int = 0


class Core:
    """A core with its program and RAM; both stay from frame to frame.

    program   assembled source; it is checked against `chip`
    tables    contents of the program's tables by name
    place     (row, column) in an array, which instruction ID reads

    Raises InputError, naming place in the source and what was wrong, for RAM or alignment out of bounds, a timestamp
    read that is not there, links (a lone core has none), running behind the program, and for no progress.

    Examples
    --------
    A core counts the photons of a frame, and puts the number out at its end:

    >>> import scene2spad as s2s
    >>> source = '''
    ...         MOV  r1, #0
    ... wait:   BNT  none         ; no timestamp is there
    ...         RDT  r2
    ...         ADD  r1, r1, #1
    ...         JMP  wait
    ... none:   BFE  end          ; the frame is over
    ...         JMP  wait
    ... end:    OUTB r1
    ...         HALT
    ... '''
    >>> core = s2s.Core(s2s.assemble(source, name="count.s"))
    >>> out, cost = core.frame([17, 230, 1001])  # time bins of three photons
    >>> out, cost.photons, cost.cycles == 3 * cost.instructions
    ((3,), 3, True)
    """

    def __init__(
        self,
        program: Program,
        tables: Mapping[str, np.ndarray] | None = None,
        *,
        chip: ChipSpec | None = None,
        place: tuple[int, int] = (0, 0),
    ) -> None:
        require_loadable(program, tables, "Core")
        self.program, self.chip = program, chosen_chip(chip, "Core")
        program.check(self.chip)
        self.registers = [0] * REGISTERS
        self.ram = bytearray(self.chip.ram_bytes)
        image = program.image(tables or {})[0].tobytes()
        self.ram[: len(image)] = image
        self._halves = memoryview(self.ram).cast("h")
        self._visits = [0] * (len(program.instructions) + 1)  # the last for what lies behind the program
        self.out: list[int] = []
        self.word = 0
        row, column = whole_pair(place, "Core: place", 0)
        self._place = (column & 1) | (row & 1) << 1
        self._port: list[int] = []
        self._read = self._wraps = self._saturations = 0
        self._stop_at_wait = self._attached_to_array = False
        self._stopped = True
        self._stretches: dict[int, _BasicBlock] = {}  # by first word
        self._singles: dict[int, _BasicBlock] = {}

    def frame(self, timestamps: Iterable[int]) -> tuple[tuple[int, ...], Counters]:
        """Return one frame, to HALT: what left the sensor, and what it cost."""
        before = self.counters
        self.start(timestamps)
        self.run()
        return tuple(self.out), self.counters - before

    def start(self, timestamps: Iterable[int], *, park: bool = False) -> None:
        """Begin a frame of these timestamps at word 0. With `park` it does not end: the core stops where it would wait
        for another timestamp. Raises InputError for timestamps that the port has no bits for, or the program does not
        know. The port has 16 bits whatever the chip's `timestamp_bits`, those of its converters: programs for
        histograms of more bins than these have run, too."""
        port = port_timestamps(timestamps, self.program).tolist()
        self._port, self._read, self._stop_at_wait, self._stopped, self._attached_to_array = port, 0, park, False, False
        self.out.clear()
        self.word = 0

    def resume(self, word: int, registers: list[int], ram: bytes, timestamps: list[int], place: int) -> None:
        """Take over a core of an array in the middle of its frame; `run` brings it to where it needs the array again:
        no timestamp left, a link, a word that leaves the sensor, the end. `place` is what ID reads."""
        self.word, self.registers[:], self.ram[:], self._place = word, registers, ram, place
        self._port, self._read, self._stop_at_wait, self._stopped, self._attached_to_array = (
            timestamps,
            0,
            True,
            False,
            True,
        )

    def step(self) -> Step:
        """Return one instruction. Raises InputError after the end of the frame."""
        require(not self._stopped, f"program {self.program.name}: the frame is over")
        before, word = self.state, self.word
        self._visits[word] += 1
        if word not in self._singles:
            self._singles[word] = self._function(word, single=True)
        after = self._singles[word].does()
        if after < 0:
            self._stopped = True
        else:
            self.word = after
        return Step(before, self.state, self.program.instructions[word])

    def trace(self, most: int | None = None) -> Iterator[Step]:
        """Yield steps to the end of the frame, or the first `most` of them."""
        done = 0
        while not self._stopped and (most is None or done < most):
            yield self.step()
            done += 1

    def watch(self, region: str) -> Iterator[tuple[Step, tuple[int, ...]]]:
        """Yield the steps that change a region of RAM, to the end of the frame, each with the region's contents after
        it."""
        part = self.program.region(region)
        for step in self.trace():
            if step.before.ram[part.address : part.end] != step.after.ram[part.address : part.end]:
                yield step, tuple(self.contents(region).tolist())

    def run(self) -> None:
        """Run it: to the end of the frame, at speed: no states in between."""
        require(not self._stopped, f"program {self.program.name}: no frame was started")
        stretches, word = self._stretches, self.word
        try:
            while True:
                progress = (self._read, len(self.out))
                for _ in range(WATCHDOG_STEPS):
                    stretch = stretches.get(word)
                    if stretch is None:
                        stretch = stretches[word] = self._function(word)
                    stretch.times += 1
                    after = stretch.does()
                    if after < 0:
                        self.word, self._stopped = stretch.end, True
                        return
                    word = after
                patience, most = int(progress != (self._read, len(self.out))), most_words(1, len(self._port))
                if not patience or len(self.out) > most:
                    raise no_end(self.program, word, patience)
        finally:
            for first, stretch in stretches.items():
                for done in range(first, stretch.end + 1):
                    self._visits[done] += stretch.times
                stretch.times = 0

    def _function(self, word: int, *, single: bool = False) -> _BasicBlock:
        text, end = source(self.program, word, single=single)
        names: dict[str, Any] = {"core": self, "r": self.registers, "ram": self.ram, "halves": self._halves}
        exec(_compiled(text), names)
        return _BasicBlock(names["does"], end)

    def contents(self, region: str) -> np.ndarray:
        """Return numbers in a region of RAM, (count,)."""
        return region_contents(self.program, np.frombuffer(bytes(self.ram), np.uint8)[None], region)[0]

    @property
    def visits(self) -> tuple[int, ...]:
        """Return how often each word was executed since the core was made."""
        return tuple(self._visits[:-1])

    @property
    def counters(self) -> Counters:
        """Return the cost of all runs since the core was made."""
        ops, visits = [one.op for one in self.program.instructions], self.visits
        total = sum(visits)
        return Counters(
            instructions=total,
            cycles=total * self.chip.clocks_per_instruction,
            photons=sum(n for n, op in zip(visits, ops, strict=True) if op.name == "RDT"),
            ram_reads=sum(n * op.reads for n, op in zip(visits, ops, strict=True)),
            ram_writes=sum(n * op.writes for n, op in zip(visits, ops, strict=True)),
            wraps=self._wraps,
            saturations=self._saturations,
        )

    @property
    def state(self) -> State:
        """Return where the core is: its word, registers, RAM, what left the sensor, and the cost until here."""
        return State(self.word, tuple(self.registers), bytes(self.ram), tuple(self.out), self.counters)

    # What the compiled instructions call

    def _not_yet(self, word: int) -> int:
        """Stop the core in front of this instruction, which is not counted as executed."""
        self._visits[word] -= 1
        return _STOP

    def _halt(self, word: int) -> int:
        return self._not_yet(word) if self._attached_to_array else _STOP

    def _waits(self, word: int, target: int) -> int:
        return self._not_yet(word) if self._stop_at_wait else target

    def _over(self, word: int, target: int) -> int:
        if self._attached_to_array:
            return self._not_yet(word)
        return word + 1 if self._stop_at_wait else target

    def _link(self, word: int) -> int:
        if self._attached_to_array:
            return self._not_yet(word)
        raise InputError(f"{self.program.where(word)}: a core alone has no neighbours; use a CoreArray")

    def _no_timestamp(self, word: int) -> None:
        raise InputError(f"{self.program.where(word)}: no timestamp is there")

    def _outside(self, word: int, at: int, last: int) -> None:
        raise InputError(self.program.outside_ram(word, at, last))

    def _odd(self, word: int, at: int) -> None:
        raise InputError(f"{self.program.where(word)}: address {at} of 16 bits is odd")

    def _stuck(self, word: int) -> int:
        raise InputError(f"{self.program.where(word - 1)}: runs behind its last instruction")


def require_loadable(program: Program, tables: Mapping[str, np.ndarray] | None, where: str) -> None:
    """Raise InputError unless these are a program and its tables by name; `where` is the class that loads them."""
    require_kind(program, Program, where, " of `assemble`, `assemble_file` or `method(NAME).program()`")
    named = tables is None or isinstance(tables, Mapping)
    require(named, f"{where}: tables of type {type(tables).__name__}, expected contents by name")


def most_words(cores: int, photons: int) -> int:
    """Return how many words may leave cores in a frame of so many photons."""
    return MAX_WORDS * cores + WORDS_PER_PHOTON * photons


def no_end(program: Program, word: int, patience: int) -> InputError:
    """Return why a frame is given up at a word: without `patience` for want of progress, else for its many words."""
    limit = f"{MAX_WORDS} words a core, and {WORDS_PER_PHOTON} a photon, left cores"
    reason = f"the frame does not end: more than {limit}" if patience else f"no progress in {WATCHDOG_STEPS} branches"
    return InputError(f"{program.where(word)}: {reason}")


@lru_cache(maxsize=4096)
def _compiled(statements: str) -> CodeType:
    """Compile statements into a function `does`, for any core."""
    text = "def does():\n    " + statements.replace("\n", "\n    ")
    return compile(text, "<instructions>", "exec")


def region_contents(program: Program, ram: np.ndarray, region: str) -> np.ndarray:
    """Return numbers in a region, of RAM (lanes, bytes) uint8: (lanes, count)."""
    part = program.region(region)
    return np.ascontiguousarray(ram[:, part.address : part.end]).view(KINDS[part.kind])
