"""Proof that a program is an integer matrix, and the tabulated form that follows: frame = histogram @ D."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from scenes.errors import InputError, require
from ultraphase.array import CoreArray, Frame
from ultraphase.assembly.program import KINDS, Program
from ultraphase.chip import ChipSpec
from ultraphase.products import photon_sums


@dataclass(frozen=True, eq=False)
class Tabulated:
    """A program whose photons each add a row of `table` to the numbers in its RAM, whatever these are.

    table      (timestamps, numbers) int64: what a photon of that timestamp adds
    low, high  range of the numbers, (numbers,)
    saturates  (numbers,) bool: stays at `high` (then nothing is ever subtracted); otherwise wraps around
    clocks     (timestamps,) int64: clocks that the photon takes
    states     from how many different contents of RAM and registers each timestamp was run
    """

    program: str
    table: np.ndarray
    low: np.ndarray
    high: np.ndarray
    saturates: np.ndarray
    clocks: np.ndarray
    states: int

    def sums(self, histograms: np.ndarray) -> np.ndarray:
        """Add the photons of every pixel without a limit: counts (pixels, timestamps) of any integer type -> (pixels,
        numbers) int64, exact. Raises InputError for other bins, and negative counts."""
        bins = histograms.shape[1]
        require(bins == len(self.table), f"histograms of {bins} bins, {self.program} has {len(self.table)} timestamps")
        return photon_sums(histograms, self.table)

    def frame(self, histograms: np.ndarray) -> np.ndarray:
        """Return numbers in RAM at the end of a frame that began with zeros, (pixels, timestamps) -> (pixels, numbers)
        int64: what the core holds after the same photons in any order."""
        return self.limited(self.sums(histograms))

    def limited(self, sums: np.ndarray) -> np.ndarray:
        """Return sums as the RAM holds them: saturated or wrapped."""
        if not self.overflowed(sums):
            return sums
        wrapped = (sums - self.low) % (self.high - self.low + 1) + self.low
        return np.where(self.saturates, np.minimum(sums, self.high), wrapped)

    def overflowed(self, sums: np.ndarray) -> int:
        """Return how many sums the RAM cannot hold."""
        return int(np.count_nonzero((sums < self.low) | (sums > self.high)))


def verify(
    program: Program,
    matrix: np.ndarray | None = None,
    tables: Mapping[str, np.ndarray] | None = None,
    *,
    chip: ChipSpec | None = None,
    timestamps: int | None = None,
    seed: int = 0,
) -> Tabulated:
    """Run every timestamp from different contents of RAM and registers, and compare what it adds with the matrix.

    program      with `tables` for its RAM
    matrix       (numbers in RAM, timestamps) integers; None skips the comparison
    timestamps   how many there are (the matrix' columns, else the chip's)
    States: all zero, all at the top, all at the bottom, random; of 8-bit counters every uniform value. Registers are
    random.

    Raises InputError if what a photon adds, or how long it takes, depends on the state; if it changes a table or lets
    words out; and where the program differs from the matrix, saying at which timestamp and number.
    """
    chip = chip or ChipSpec()
    count = timestamps or (chip.timestamps if matrix is None else matrix.shape[1])
    require(bool(program.state), f"program {program.name}: declares no .space, there is nothing to verify")
    array = CoreArray(program, (1, count), tables, chip=chip)
    kinds = np.concatenate([np.full(region.count, region.kind) for region in program.state])
    low, high = (np.array([getattr(np.iinfo(KINDS[kind]), end) for kind in kinds], np.int64) for end in ("min", "max"))
    tables_before = _table_bytes(program, array)
    random = np.random.default_rng(seed)
    added = clocks = None
    wraps = np.ones(len(kinds), bool)
    states = 0
    for before in _states(low, high, random):
        after, frame = _run(program, array, before, random)
        require(not frame.out.size, f"program {program.name}: words leave the sensor before the frame is over")
        same_tables = np.array_equal(_table_bytes(program, array), tables_before)
        require(same_tables, f"program {program.name}: a photon changes a table")
        if added is None:
            added, clocks, saturates = after, frame.cycles[0], (after >= 0).all(axis=0)
        exact = before + added
        if wraps.any():
            wraps = wraps & (after == (exact - low) % (high - low + 1) + low).all(axis=0)
        if saturates.any():
            saturates = saturates & (after == np.minimum(exact, high)).all(axis=0)
        slow, bad = frame.cycles[0] != clocks, ~(wraps | saturates)
        if bad.any() or slow.any():
            raise InputError(_not_additive(program, bad, before, after, added, slow))
        states += 1
    assert added is not None and clocks is not None, "a program that was run on no state"
    if matrix is not None:
        _compare(program, added, np.asarray(matrix))
    return Tabulated(program.name, added, low, high, saturates & ~wraps, clocks, states)


def _states(low: np.ndarray, high: np.ndarray, random: np.random.Generator) -> Iterator[np.ndarray]:
    yield np.zeros(len(low), np.int64)
    yield high
    yield low
    for _ in range(4):
        yield random.integers(low, high, endpoint=True)
    if (high - low == 255).all():
        for value in range(256):
            yield low + value


def _run(
    program: Program, array: CoreArray, before: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, Frame]:
    """Run one photon of every timestamp, each on a core in the state `before`; return the numbers in RAM after it, and
    the frame."""
    at = 0
    for region in program.state:
        part = before[at : at + region.count].astype(KINDS[region.kind])
        array.ram[:, region.address : region.end] = part.view(np.uint8)
        at += region.count
    array.registers[:] = random.integers(-(1 << 31), 1 << 31, array.registers.shape)
    lanes = array.shape[1]
    frame = array.frame(np.arange(lanes), np.arange(lanes + 1), park=True)
    after = np.concatenate([array.contents(region.name) for region in program.state], axis=1)
    return after.astype(np.int64), frame


def _table_bytes(program: Program, array: CoreArray) -> np.ndarray:
    parts = [array.ram[:, region.address : region.end] for region in program.regions if region.table]
    return np.concatenate([array.ram[:, :0], *parts], axis=1)


def _not_additive(
    program: Program,
    bad: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    added: np.ndarray,
    slow: np.ndarray,
) -> str:
    names = [f"{region.name}[{n}]" for region in program.state for n in range(region.count)]
    if bad.any():
        number = int(np.flatnonzero(bad)[0])
        t = int(np.argmax(after[:, number] != before[number] + added[:, number]))
        return (
            f"program {program.name} is not additive: timestamp {t} takes {names[number]} from {before[number]} to "
            f"{after[t, number]}, from 0 to {added[t, number]}"
        )
    return f"program {program.name}: how long timestamp {int(np.flatnonzero(slow)[0])} takes depends on RAM"


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
