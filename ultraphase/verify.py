"""Proof that a program is an integer matrix, and the tabulated form that follows: frame = histogram @ D."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from scenes.errors import InputError, listed, require
from ultraphase.array import CoreArray, Frame
from ultraphase.assembly.program import KINDS, Program
from ultraphase.chip import ChipSpec, chosen_chip
from ultraphase.core import require_loadable
from ultraphase.frame_end import require_idle, words_put_out
from ultraphase.products import Tabulated

# What a photon finds in the registers, in the order of the states (see `verify`); from then on what the one before left
_REGISTERS = ("new", "left", "uninitialised", "left", "zero", "random", "left")
_WORDS = {
    "new": "",
    "left": ", after another photon of the frame",
    "again": ", after another photon of the frame",
    "uninitialised": ", with random registers before the frame",
    "zero": ", with registers at 0 that photons change",
    "random": ", with random registers where photons change them",
}
_LONG_FRAME = 300  # photons
_CORES_TO_END = 1024  # at the most, of the frames that are run to their end


def verify(
    program: Program,
    matrix: np.ndarray | None = None,
    tables: Mapping[str, np.ndarray] | None = None,
    *,
    chip: ChipSpec | None = None,
    timestamps: int | None = None,
    saturates: bool | None = None,
    seed: int = 0,
) -> Tabulated:
    """Run every timestamp from different contents of RAM and registers, and compare what it adds with the matrix.

    program      with `tables` for its RAM
    matrix       (numbers in RAM, timestamps) integers; None skips the comparison
    timestamps   how many there are (the matrix' columns, else the program's or the chip's)
    saturates    True: all numbers must stay at their top; False: all must wrap around; None for either

    States: RAM all zero, all at the top, all at the bottom, random; of 8-bit counters every uniform value. Registers as
    a new frame has them up to its first photon, with zeros and with random numbers before it; as another photon left
    them; and 0 or random where any photon so far changed them. A photon goes on where the core waits for it, so that
    what comes before the loop runs once a frame, and its clocks are none of the photon's. Last, whole frames,
    frames to their end (`Tabulated.puts_out`), and one of photons far apart.

    Raises InputError if what a photon adds, or how long it takes, depends on the state, or on the wait before it; if
    the frame ends at a photon or while one is waited for;
    if the program changes a table, lets words out, or writes other than zeros before the first photon; if a frame puts
    out other words after another frame than at first; where a number saturates that should wrap around, or wraps around
    that should saturate; and where it differs from the matrix, saying at which timestamp and number, or puts out other
    than the matrix' numbers in their order and size. `Program` has an example.
    """
    require_loadable(program, tables, "verify")
    _require_one_core(tables)
    chip = chosen_chip(chip, "verify")
    count = timestamps or ((program.timestamps or chip.timestamps) if matrix is None else matrix.shape[1])
    require(bool(program.state), f"program {program.name}: declares no .space, there is nothing to verify")
    bench = _Bench(program, CoreArray(program, (1, count), tables, chip=chip), np.random.default_rng(seed))
    found = bench.additive(saturates)
    bench.whole_frames(found)
    if matrix is not None:
        _compare(program, found.table, np.asarray(matrix))
    array = CoreArray(program, (1, min(count, _CORES_TO_END)), tables, chip=chip)
    found = replace(found, puts_out=words_put_out(program, array, found, bench.random))
    if matrix is not None and found.puts_out not in (None, found.numbers):
        raise InputError(_other_words(found))
    require_idle(program, tables, chip, found, bench.random)
    return found


def _require_one_core(tables: Mapping[str, np.ndarray] | None) -> None:
    for name, values in (tables or {}).items():
        alone = np.ndim(values) == 1
        require(alone, f"verify: table {name} of shape {np.shape(values)}, expected (count,): one core is verified")


def _require_overflow(found: Tabulated, right: np.ndarray, saturates: bool) -> None:
    kinds = "wraps around, expected to saturate" if saturates else "saturates, expected to wrap around"
    require(bool(right.all()), f"program {found.program}: {found.numbers[int(right.argmin())]} {kinds}")


def _other_words(found: Tabulated) -> str:
    words = listed(f"{word or 'no number'} as word {n}" for n, word in enumerate(found.puts_out or ())) or "nothing"
    return f"program {found.program}: its frame puts out {words}, expected {listed(found.numbers)}"


def _states(low: np.ndarray, high: np.ndarray, random: np.random.Generator) -> Iterator[np.ndarray]:
    yield np.zeros(len(low), np.int64)
    yield high
    yield low
    for _ in range(4):
        yield random.integers(low, high, endpoint=True)
    if (high - low == 255).all():
        for value in range(256):
            yield low + value


class _Bench:
    """One core for every timestamp, and what is known of its program so far.

    changed   (16,) bool: registers that are other after a photon than before it, for any timestamp and state
    """

    def __init__(self, program: Program, array: CoreArray, random: np.random.Generator) -> None:
        self.program, self.array, self.random = program, array, random
        kinds = np.concatenate([np.full(region.count, region.kind) for region in program.state])
        self.low, self.high = (
            np.array([getattr(np.iinfo(KINDS[kind]), end) for kind in kinds], np.int64) for end in ("min", "max")
        )
        self.names = tuple(f"{region.name}[{n}]" for region in program.state for n in range(region.count))
        self.changed = np.zeros(len(array.registers), bool)
        self.tables = self._table_bytes()

    def additive(self, saturates: bool | None) -> Tabulated:
        """Return what every timestamp adds, from all states alike. Raises InputError as `verify` does."""
        low, high, program = self.low, self.high, self.program
        added = clocks = None
        wraps = np.ones(len(low), bool)
        states = 0
        for before in _states(low, high, self.random):
            registers = _REGISTERS[states] if states < len(_REGISTERS) else "again"
            after, taken = self.photon(before, registers)
            if added is None or clocks is None:
                added, clocks, stays = after, taken, (after >= 0).all(axis=0)
            exact = before + added
            if wraps.any():
                wraps = wraps & (after == (exact - low) % (high - low + 1) + low).all(axis=0)
            if stays.any():
                stays = stays & (after == np.minimum(exact, high)).all(axis=0)
            slow, bad = taken != clocks, ~(wraps | stays)
            if bad.any() or slow.any():
                raise InputError(self.not_additive(bad, before, after, added, slow) + _WORDS[registers])
            states += 1
        assert added is not None and clocks is not None, "a program that was run on no state"
        found = Tabulated(program.name, added, low, high, stays & ~wraps, clocks, states, numbers=self.names)
        if saturates is not None:
            _require_overflow(found, np.asarray(stays if saturates else wraps), saturates)
        return found

    def photon(self, before: np.ndarray, registers: str) -> tuple[np.ndarray, np.ndarray]:
        """Run one photon of every timestamp, each on a core with `before` in its RAM: (numbers after it, clocks)."""
        array, count = self.array, self.array.shape[1]
        order = np.arange(count)
        if registers in ("new", "uninitialised"):
            self._begin(random=registers == "uninitialised")
        elif registers != "again":
            order = self.random.permutation(count)  # not behind a photon of the same timestamp
        if registers == "zero":
            array.registers[self.changed] = 0
        elif registers == "random":
            array.registers[self.changed] = self._random_words()[self.changed]
        self._set(before)
        found = array.registers.copy()
        frame = array.frame(order, np.arange(count + 1), park=True, resume=True)
        self._check(frame, "a photon")
        require(bool((array.words >= 0).all()), f"program {self.program.name}: the frame ends at a photon")
        self.changed |= (array.registers != found).any(axis=1)
        after, clocks = self._numbers(), frame.cycles[0]
        back = np.argsort(order)
        return (after, clocks) if registers == "again" else (after[back], clocks[back])

    def whole_frames(self, found: Tabulated) -> None:
        """Raise InputError if frames of many photons leave other numbers than the table."""
        cores, count = min(4, self.array.shape[1]), self.array.shape[1]
        self._set(np.zeros(len(self.low), np.int64))
        self.array.registers[:] = 0
        stamps = self.random.integers(0, count, (cores, _LONG_FRAME))
        offsets = np.minimum(np.arange(count + 1), cores) * _LONG_FRAME
        self._check(self.array.frame(stamps.reshape(-1), offsets, park=True), "a photon")
        right = found.frame(np.stack([np.bincount(row, minlength=count) for row in stamps]))
        held = self._numbers()[:cores]
        if not np.array_equal(held, right):
            core, number = np.argwhere(held != right)[0]
            raise InputError(
                f"program {self.program.name} is not additive: {_LONG_FRAME} photons leave {held[core, number]} in "
                f"{self.names[number]}, what each adds alone is {right[core, number]}"
            )

    def _begin(self, *, random: bool) -> None:
        """Begin a frame with zeros in RAM on every core, up to where it waits for the first photon."""
        array, count = self.array, self.array.shape[1]
        self._set(np.zeros(len(self.low), np.int64))
        array.registers[:] = self._random_words() if random else 0
        frame = array.frame(np.zeros(0, np.int64), np.zeros(count + 1, np.int64), park=True)
        self._check(frame, "what comes before the first photon")
        waits = bool((array.words >= 0).all())
        require(waits, f"program {self.program.name}: ends without waiting for a photon (BNT)")
        held = self._numbers()
        if held.any():
            core, number = np.argwhere(held)[0]
            raise InputError(
                f"program {self.program.name}: {self.names[number]} is {held[core, number]} before the first photon of "
                "a frame that begins with zeros"
            )

    def _check(self, frame: Frame, what: str) -> None:
        require(not frame.out.size, f"program {self.program.name}: words leave the sensor before the frame is over")
        same = np.array_equal(self._table_bytes(), self.tables)
        require(same, f"program {self.program.name}: {what} changes a table")

    def _random_words(self) -> np.ndarray:
        return self.random.integers(-(1 << 31), 1 << 31, self.array.registers.shape)

    def _set(self, numbers: np.ndarray) -> None:
        at = 0
        for region in self.program.state:
            part = numbers[at : at + region.count].astype(KINDS[region.kind])
            self.array.ram[:, region.address : region.end] = part.view(np.uint8)
            at += region.count

    def _numbers(self) -> np.ndarray:
        parts = [self.array.contents(region.name) for region in self.program.state]
        return np.concatenate(parts, axis=1).astype(np.int64)

    def _table_bytes(self) -> np.ndarray:
        parts = [self.array.ram[:, region.address : region.end] for region in self.program.regions if region.table]
        return np.concatenate([self.array.ram[:, :0], *parts], axis=1)

    def not_additive(
        self, bad: np.ndarray, before: np.ndarray, after: np.ndarray, added: np.ndarray, slow: np.ndarray
    ) -> str:
        """Return which timestamp and number show it."""
        if not bad.any():
            t = int(np.flatnonzero(slow)[0])
            return f"program {self.program.name}: how long timestamp {t} takes depends on RAM or registers"
        number = int(np.flatnonzero(bad)[0])
        low, high = self.low[number], self.high[number]
        exact = before[number] + added[:, number]
        wrong = after[:, number] != exact
        neither = wrong & (after[:, number] != np.minimum(exact, high))
        neither &= after[:, number] != (exact - low) % (high - low + 1) + low
        t = int(np.argmax(neither if neither.any() else wrong))
        return (
            f"program {self.program.name} is not additive: timestamp {t} takes {self.names[number]} from "
            f"{before[number]} to {after[t, number]}, from 0 to {added[t, number]}"
        )


def _compare(program: Program, added: np.ndarray, matrix: np.ndarray) -> None:
    shape = added.T.shape
    require(
        matrix.shape == shape,
        f"program {program.name}: matrix of shape {matrix.shape}, the program has {shape} (numbers, timestamps)",
    )
    number, t = np.nonzero(matrix != added.T)
    if t.size:
        raise InputError(
            f"program {program.name} differs from the matrix in {t.size} of {matrix.size} entries, first at timestamp "
            f"{t[0]}, number {number[0]}: adds {added[t[0], number[0]]}, the matrix has {matrix[number[0], t[0]]}"
        )
