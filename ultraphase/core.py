"""One core, instruction by instruction: for reading what a program does. For many cores at once see `array`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from scenes.errors import InputError, require
from ultraphase.chip import ChipSpec
from ultraphase.isa import ALU, BYTE_LIMIT, HALF_LIMITS, REGISTERS, Instruction, spelled
from ultraphase.program import KINDS, Program

PATIENCE = 1 << 14  # instructions without a timestamp read, a word out or an end, after which a core is stuck
_STOP = -1
_SHARED = ("HALT", "SEND", "RECV", "OUTB", "OUTH")  # what a core of an array does not do alone


@dataclass(frozen=True)
class Counters:
    """What a run cost. cycles = instructions x clocks per instruction (+ stalls on links, in an array)."""

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
        """Registers and RAM bytes that it changed, as `r3: 4 -> 5` and `[17]: 0 -> 1`."""
        registers = zip(self.before.registers, self.after.registers, strict=True)
        changed = [f"r{n}: {old} -> {new}" for n, (old, new) in enumerate(registers) if old != new]
        ram = zip(self.before.ram, self.after.ram, strict=True)
        return changed + [f"[{n}]: {old} -> {new}" for n, (old, new) in enumerate(ram) if old != new]

    def __str__(self) -> str:
        return f"{self.before.word:4d}  {spelled(self.instruction):28s} {', '.join(self.changes())}".rstrip()


class Core:
    """A core with its program and RAM; both stay from frame to frame.

    program   assembled source; it is checked against `chip`
    tables    contents of the program's tables by name
    place     (row, column) in an array, which instruction ID reads

    Raises InputError, naming place in the source and what was wrong, for RAM or alignment out of bounds, a timestamp
    read that is not there, links (a lone core has none), running behind the program, and for no progress.
    """

    def __init__(
        self,
        program: Program,
        tables: Mapping[str, np.ndarray] | None = None,
        *,
        chip: ChipSpec | None = None,
        place: tuple[int, int] = (0, 0),
    ) -> None:
        self.program, self.chip = program, chip or ChipSpec()
        program.check(self.chip)
        self.registers = [0] * REGISTERS
        self.ram = bytearray(self.chip.ram_bytes)
        image = program.image(tables or {})[0].tobytes()
        self.ram[: len(image)] = image
        self._halves = memoryview(self.ram).cast("h")
        self._visits = [0] * (len(program.instructions) + 1)  # the last for what lies behind the program
        self.out: list[int] = []
        self.word = 0
        self._place = (place[1] & 1) | (place[0] & 1) << 1
        self._port: list[int] = []
        self._read = self._photons = self._wraps = self._saturations = 0
        self._parks = self._lent = False
        self._stopped = True
        self._code = [self._compiled(word, one) for word, one in enumerate(program.instructions)] + [self._behind]

    def frame(self, timestamps: Iterable[int]) -> tuple[tuple[int, ...], Counters]:
        """One frame, to HALT: what left the sensor, and what it cost."""
        before = self.counters
        self.start(timestamps)
        self.run()
        return tuple(self.out), self.counters - before

    def start(self, timestamps: Iterable[int], *, park: bool = False) -> None:
        """Begin a frame of these timestamps at word 0. With `park` it does not end: the core stops where it would wait
        for another timestamp. Raises InputError for timestamps that the port has no bits for."""
        port = [int(t) for t in timestamps]
        most = (1 << 16) - 1
        require(not port or (min(port) >= 0 and max(port) <= most), f"timestamps are outside 0 to {most}")
        self._port, self._read, self._parks, self._stopped, self._lent = port, 0, park, False, False
        self.out.clear()
        self.word = 0

    def resume(self, word: int, registers: list[int], ram: bytes, timestamps: list[int], place: int) -> None:
        """Take over a core of an array in the middle of its frame; `run` brings it to where it needs the array again:
        no timestamp left, a link, a word that leaves the sensor, the end. `place` is what ID reads."""
        self.word, self.registers[:], self.ram[:], self._place = word, registers, ram, place
        self._port, self._read, self._parks, self._stopped, self._lent = timestamps, 0, True, False, True

    def step(self) -> Step:
        """One instruction. Raises InputError after the end of the frame."""
        require(not self._stopped, f"program {self.program.name}: the frame is over")
        before, word = self.state, self.word
        self._visits[word] += 1
        after = self._code[word]()
        if after < 0:
            self._stopped = True
        else:
            self.word = after
        return Step(before, self.state, self.program.instructions[word])

    def trace(self, most: int | None = None) -> Iterator[Step]:
        """Steps to the end of the frame, or the first `most` of them."""
        done = 0
        while not self._stopped and (most is None or done < most):
            yield self.step()
            done += 1

    def watch(self, region: str) -> Iterator[tuple[Step, tuple[int, ...]]]:
        """The steps that change a region of RAM, to the end of the frame, each with the region's contents after it."""
        part = self.program.region(region)
        for step in self.trace():
            if step.before.ram[part.address : part.end] != step.after.ram[part.address : part.end]:
                yield step, tuple(self.contents(region).tolist())

    def run(self) -> None:
        """To the end of the frame, at speed: no states in between."""
        require(not self._stopped, f"program {self.program.name}: no frame was started")
        visits, word = self._visits, self.word
        code = self._returning if self._lent else self._code
        while True:
            progress = (self._read, len(self.out))
            for _ in range(PATIENCE):
                visits[word] += 1
                after = code[word]()
                if after < 0:
                    self.word, self._stopped = word, True
                    return
                word = after
            if progress == (self._read, len(self.out)):
                raise InputError(f"{self.program.where(word)}: no progress in {PATIENCE} instructions")

    @cached_property
    def _returning(self) -> list[Callable[[], int]]:
        """The code of a core that was taken over: it stops in front of what needs the array."""
        code = list(self._code)
        for word, one in enumerate(self.program.instructions):
            if one.name in _SHARED:
                code[word] = partial(self._not_yet, word)
            elif one.name == "BFE":
                code[word] = partial(self._frame_not_over, word)
        return code

    def _not_yet(self, word: int) -> int:
        self._visits[word] -= 1
        return _STOP

    def _frame_not_over(self, word: int) -> int:
        return word + 1 if self._read < len(self._port) else self._not_yet(word)

    def contents(self, region: str) -> np.ndarray:
        """Numbers in a region of RAM."""
        return region_contents(self.program, np.frombuffer(bytes(self.ram), np.uint8)[None], region)[0]

    @property
    def visits(self) -> tuple[int, ...]:
        """How often each word was executed since the core was made."""
        return tuple(self._visits[:-1])

    @property
    def counters(self) -> Counters:
        """Since the core was made."""
        ops, visits = [one.op for one in self.program.instructions], self.visits
        total = sum(visits)
        return Counters(
            instructions=total,
            cycles=total * self.chip.clocks_per_instruction,
            photons=self._photons,
            ram_reads=sum(n * op.reads for n, op in zip(visits, ops, strict=True)),
            ram_writes=sum(n * op.writes for n, op in zip(visits, ops, strict=True)),
            wraps=self._wraps,
            saturations=self._saturations,
        )

    @property
    def state(self) -> State:
        return State(self.word, tuple(self.registers), bytes(self.ram), tuple(self.out), self.counters)

    def _behind(self) -> int:
        raise InputError(f"program {self.program.name}: runs behind its last instruction")

    def _compiled(self, word: int, one: Instruction) -> Callable[[], int]:
        """The instruction as a function that does it and returns the next word."""
        name = one.name
        if name in ALU:
            return self._alu(one, word + 1)
        if "m" in one.op.takes:
            return self._memory(one, word)
        if "l" in one.op.takes:
            return self._branch(one, word)
        return self._other(one, word)

    def _alu(self, one: Instruction, after: int) -> Callable[[], int]:
        r, d, s, v, does = self.registers, one.rd, one.rs, one.value, ALU[one.name]

        def with_constant() -> int:
            r[d] = does(r[s], v)
            return after

        def with_register() -> int:
            r[d] = does(r[s], r[v])
            return after

        return with_constant if one.constant or "n" in one.op.takes else with_register

    def _address(self, one: Instruction, word: int) -> Callable[[], int]:
        """The operand's cell, in its own size from the start of RAM."""
        r, s, offset, size = self.registers, one.rs, one.value, one.op.size
        last = self.program.ram_bytes - size

        def checked(at: int) -> int:
            if not 0 <= at <= last:
                raise InputError(f"{self.program.where(word)}: RAM address {at} is outside the declared 0 to {last}")
            if at % size:
                raise InputError(f"{self.program.where(word)}: address {at} of 16 bits is odd")
            return at // size

        if not one.constant:
            return lambda: checked(r[s] + offset)
        if 0 <= offset <= last and offset % size == 0:
            return lambda: offset // size
        return lambda: checked(offset)

    def _memory(self, one: Instruction, word: int) -> Callable[[], int]:
        r, d, after, at = self.registers, one.rd, word + 1, self._address(one, word)
        cells = self.ram if one.op.size == 1 else self._halves
        low, high = HALF_LIMITS

        def load() -> int:
            r[d] = cells[at()]
            return after

        def load_signed() -> int:
            value = cells[at()]
            r[d] = value - (value >> 7 << 8)
            return after

        def store_byte() -> int:
            self._wraps += not -128 <= r[d] <= BYTE_LIMIT
            cells[at()] = r[d] & BYTE_LIMIT
            return after

        def store_half() -> int:
            self._wraps += not low <= r[d] <= 2 * high + 1
            cells[at()] = (r[d] + high + 1 & 0xFFFF) - high - 1
            return after

        def add(sign: int) -> int:
            cell = at()
            value = cells[cell] + sign * r[d]
            if not low <= value <= high:
                self._wraps += 1
                value = (value + high + 1 & 0xFFFF) - high - 1
            cells[cell] = value
            return after

        names = ("LDB", "LDBS", "LDH", "STB", "STH", "ADDM", "SUBM")
        does = (load, load_signed, load, store_byte, store_half, lambda: add(1), lambda: add(-1))
        return dict(zip(names, does, strict=True))[one.name]

    def _branch(self, one: Instruction, word: int) -> Callable[[], int]:
        r, a, b, bit, go, after = self.registers, one.rs, one.rd, one.bit, one.target, word + 1

        def no_timestamp() -> int:
            if self._read < len(self._port):
                return after
            # where it waits, it has not executed this
            return self._not_yet(word) if self._parks else go

        return {
            "BNT": no_timestamp,
            "BFE": lambda: go if self._read == len(self._port) and not self._parks else after,
            "JMP": lambda: go,
            "BZ": lambda: go if r[a] == 0 else after,
            "BNZ": lambda: go if r[a] else after,
            "BLT": lambda: go if r[a] < r[b] else after,
            "BBS": lambda: go if r[a] >> bit & 1 else after,
            "BBC": lambda: after if r[a] >> bit & 1 else go,
        }[one.name]

    def _other(self, one: Instruction, word: int) -> Callable[[], int]:
        r, d, s, v, after = self.registers, one.rd, one.rs, one.value, word + 1

        def put(value: int) -> int:
            r[d] = value
            return after

        def read() -> int:
            if self._read == len(self._port):
                raise InputError(f"{self.program.where(word)}: no timestamp is there")
            self._read += 1
            self._photons += 1
            return put(self._port[self._read - 1])

        def saturated(low: int, high: int) -> int:
            value = min(max(r[s], low), high)
            self._saturations += value != r[s]
            return put(value)

        def leave(low: int, high: int) -> int:
            self._wraps += not low <= r[s] <= high
            self.out.append((r[s] - low) % (high - low + 1) + low)
            return after

        def no_link() -> int:
            raise InputError(f"{self.program.where(word)}: a core alone has no neighbours; use a CoreArray")

        return {
            "HALT": lambda: _STOP,
            "RDT": read,
            "ID": lambda: put(self._place),
            "MOV": (lambda: put(v)) if one.constant else (lambda: put(r[v])),
            "SATB": lambda: saturated(0, BYTE_LIMIT),
            "SATH": lambda: saturated(*HALF_LIMITS),
            "OUTB": lambda: leave(0, BYTE_LIMIT),
            "OUTH": lambda: leave(*HALF_LIMITS),
            "SEND": no_link,
            "RECV": no_link,
        }[one.name]


def region_contents(program: Program, ram: np.ndarray, region: str) -> np.ndarray:
    """Numbers in a region, of RAM (lanes, bytes) uint8: (lanes, count)."""
    part = program.region(region)
    return np.ascontiguousarray(ram[:, part.address : part.end]).view(KINDS[part.kind])
