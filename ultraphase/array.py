"""Many cores in step, as NumPy arrays: an image's worth of cores, 2 x 2 cores with links, or one timestamp a core.

Every turn takes the lowest word that a runnable core stands at, and does its instruction on all cores that stand there.
Cores that branched apart meet again. The few with many timestamps left at the end go on as a `Core` each: faster.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from scenes.errors import InputError, require
from ultraphase.assembly.isa import ALU, BYTE_LIMIT, DIRECTIONS, HALF_LIMITS, REGISTERS, STEPS, Instruction
from ultraphase.assembly.program import Program, block_ends
from ultraphase.chip import ChipSpec, array_shape, chosen_chip
from ultraphase.core import WATCHDOG_STEPS, Core, Counters, most_words, no_end, region_contents, require_loadable
from ultraphase.port import core_offsets, port_timestamps

_RUNS, _HALTED, _PARKED, _BLOCKED = range(4)
# In step, a turn costs about as much for one core as for hundreds: so few finish their timestamps one after the other.
_FEW = 256
_MANY_TIMESTAMPS = 64
_LOOK_EVERY = 16  # timestamps


@dataclass(frozen=True)
class Frame:
    """One frame of an array.

    out        (cores that put anything out, words) int64, in row-major order of the cores
    out_cores  (row, column) of these cores
    out_sizes  bits of each word of `out`
    out_bits   (rows, columns): bits that left each core of the array
    cycles     (rows, columns): clocks of each core, waiting on links included
    stalls     (rows, columns): clocks of them spent waiting on links
    counters   sums over the cores
    """

    out: np.ndarray
    out_cores: np.ndarray
    out_sizes: np.ndarray
    out_bits: np.ndarray
    cycles: np.ndarray
    stalls: np.ndarray
    counters: Counters


class CoreArray:
    """rows x columns cores that run one program, each with RAM, timestamps and tables of its own.

    tables   contents by name, one row (count,) for all cores or (rows, columns, count)

    RAM and registers stay from frame to frame and may be set: `ram` (cores, bytes) uint8, `registers` (16, cores).
    `words` (cores,) are where the cores of the last frame wait for another timestamp, -1 where they do not.
    Raises InputError as `Core` does, and for cores that wait for each other, saying who waits where for whom.
    `assemble` has an example.
    """

    def __init__(
        self,
        program: Program,
        shape: tuple[int, int] = (2, 2),
        tables: Mapping[str, np.ndarray] | None = None,
        *,
        chip: ChipSpec | None = None,
    ) -> None:
        require_loadable(program, tables, "CoreArray")
        self.program, self.chip = program, chosen_chip(chip, "CoreArray")
        self.shape = shape = array_shape(shape, self.chip)
        program.check(self.chip)
        lanes = shape[0] * shape[1]
        flat = {n: np.asarray(t) for n, t in (tables or {}).items()}
        flat = {n: t.reshape(lanes, -1) if t.shape[:-1] == shape else t for n, t in flat.items()}
        self.ram = np.zeros((lanes, self.chip.ram_bytes), np.uint8)
        image = program.image(flat, lanes)
        self.ram[:, : image.shape[1]] = image
        self.registers = np.zeros((REGISTERS, lanes), np.int64)
        self.words = np.full(lanes, -1)
        self._lane = np.arange(lanes)
        self._first_byte = self._lane * self.chip.ram_bytes
        row, column = np.divmod(self._lane, shape[1])
        self.place = (column & 1) | (row & 1) << 1
        self._neighbour = [_neighbours(row + down, column + right, shape) for down, right in STEPS]

    def frame(self, timestamps: np.ndarray, offsets: np.ndarray, *, park: bool = False, resume: bool = False) -> Frame:
        """Return one frame to HALT on every core; with `park` to where a core would wait for another timestamp.

        timestamps (N,) core after core, in the order of detection; offsets (cores + 1,) where each core's begin.
        `resume` goes on where the cores were parked, not at word 0: with what the frame before left, and its cost.
        """
        port = port_timestamps(timestamps, self.program)
        run = ArrayRun(self, port, core_offsets(offsets, len(self._lane), len(port)), park)
        if resume:
            waits = bool((self.words >= 0).all())
            require(waits, f"program {self.program.name}: no photon is waited for (BNT) where the frame would go on")
            run.word[:] = self.words
        frame = run.to_end()
        self.words = np.where(run.status == _PARKED, run.word, -1)
        return frame

    def contents(self, region: str) -> np.ndarray:
        """Return numbers in a region of every core's RAM, (cores, count)."""
        return region_contents(self.program, self.ram, region)


def _neighbours(row: np.ndarray, column: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the lane at (row, column), -1 where there is none."""
    there = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    return np.where(there, row * shape[1] + column, -1)


def _outside(value: np.ndarray, low: int, high: int) -> int:
    """Count the values outside low .. high; one pass where none is: below low is huge as an unsigned number."""
    raised = (value - low).view(np.uint64)
    return int(np.count_nonzero(raised > high - low)) if int(raised.max(initial=0)) > high - low else 0


class ArrayRun:
    """One frame while it runs."""

    def __init__(self, array: CoreArray, port: np.ndarray, offsets: np.ndarray, park: bool) -> None:
        self.array, self.program, self.park = array, array.program, park
        self.registers, self.ram = array.registers, array.ram
        self.bytes, self.halves = self.ram.reshape(-1), self.ram.view("<i2").reshape(-1)
        lanes = self.ram.shape[0]
        self.port, self.next, self.first, self.last = port, offsets[:-1].copy(), offsets[:-1], offsets[1:]
        self.word = np.zeros(lanes, np.int64)
        self.status = np.zeros(lanes, np.int8)
        self.instructions = np.zeros(lanes, np.int64)
        self.stalled = np.zeros(lanes, np.int64)  # in instructions
        self.link = np.zeros((len(STEPS), lanes), np.int64)  # a core's inbox from each direction
        self.link_full = np.zeros((len(STEPS), lanes), bool)
        self.link_time = np.zeros((len(STEPS), lanes), np.int64)  # when it was last filled or emptied
        self.visits = np.zeros(len(self.program.instructions), np.int64)
        self.wraps = self.saturations = self.events = self.words = 0
        self.out: list[np.ndarray] = []  # (core, word, bits) of those that left at one instruction
        self.ram_bytes, self.most_words = self.program.ram_bytes, most_words(lanes, port.size)
        self.changed = True  # the status of some core
        self.code = [self._kind(one) for one in self.program.instructions]
        self.block_end = block_ends(self.program)

    def to_end(self) -> Frame:
        patience, events, look, live = WATCHDOG_STEPS, 0, 0, self.array._lane
        while True:
            if self.changed:
                live, self.changed = np.flatnonzero(self.status == _RUNS), False
                if not live.size:
                    break
            if self.events >= look:  # cores that are done wait at the frame's end: all are live until the last is there
                look = self.events + _LOOK_EVERY
                many = live[self.last[live] - self.next[live] >= _MANY_TIMESTAMPS]
                if 0 < many.size <= _FEW:
                    self.one_by_one(many)
            words = self.word[live]
            word = int(words.min())
            index = live[words == word]
            if word >= len(self.code):
                raise InputError(f"{self.program.where(word - 1)}: runs behind its last instruction")
            self._block(word, slice(None) if index.size == self.status.size else index, index)
            patience = WATCHDOG_STEPS if self.events != events else patience - 1
            events = self.events
            if patience == 0 or self.words > self.most_words:
                raise no_end(self.program, word, patience)
        self._explain_waiting()
        return self._result()

    def _block(self, first: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        """Run the instructions up to a branch or a label: only there do cores part or meet."""
        end = self.block_end[first]
        for word in range(first, end - 1):
            self.code[word](self.program.instructions[word], word, lanes, index)
        self.visits[first : end - 1] += index.size
        self.instructions[lanes] += end - 1 - first
        self.word[lanes] = end
        held = self.code[end - 1](self.program.instructions[end - 1], end - 1, lanes, index)
        went = lanes if held is None else np.setdiff1d(index, held, assume_unique=True)
        self.visits[end - 1] += index.size - (0 if held is None else held.size)
        self.instructions[went] += 1

    def one_by_one(self, lanes: np.ndarray) -> None:
        """Run each core alone through its timestamps, to where it needs the array again."""
        blank = {region.name: np.zeros(region.count, np.int64) for region in self.program.regions if region.table}
        core = Core(self.program, blank, chip=self.array.chip)
        for lane in lanes:
            before = core.counters
            port = self.port[self.next[lane] : self.last[lane]].tolist()
            state = int(self.word[lane]), self.registers[:, lane].tolist(), self.ram[lane].tobytes()
            core.resume(*state, port, int(self.array.place[lane]))
            core.run()
            self.word[lane], self.registers[:, lane] = core.word, core.registers
            self.ram[lane] = np.frombuffer(core.ram, np.uint8)
            spent = core.counters - before
            self.instructions[lane] += spent.instructions
            self.next[lane] += spent.photons
        self.visits += core.visits
        self.wraps += core.counters.wraps
        self.saturations += core.counters.saturations
        self.events += core.counters.photons

    def _kind(self, one: Instruction) -> Callable[..., np.ndarray | None]:
        """Select what executes an instruction, of (instruction, word, cores, indices); it returns cores it holds."""
        if one.name in ALU:
            return self._alu
        if "m" in one.op.takes:
            return self._memory
        if "l" in one.op.takes:
            return self._branch
        return getattr(self, f"_{one.name.lower()}")

    def _value(self, one: Instruction, lanes: slice | np.ndarray) -> np.ndarray | int:
        fixed = one.constant or "n" in one.op.takes
        return one.value if fixed else self.registers[one.value][lanes]

    def _alu(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self.registers[one.rd][lanes] = ALU[one.name](self.registers[one.rs][lanes], self._value(one, lanes))

    def _mov(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self.registers[one.rd][lanes] = self._value(one, lanes)

    def _id(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self.registers[one.rd][lanes] = self.array.place[lanes]

    def _memory(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        cells, place = self._cells(one, word, lanes, index)
        if one.op.reads and not one.op.writes:
            loaded = cells[place].astype(np.int64)
            self.registers[one.rd][lanes] = loaded - (loaded >> 7 << 8) if one.name == "LDBS" else loaded
            return
        value = self.registers[one.rd][lanes]
        low, high = (-128, BYTE_LIMIT) if one.op.size == 1 else (HALF_LIMITS[0], 2 * HALF_LIMITS[1] + 1)
        if one.op.reads:
            value = cells[place] + (value if one.name == "ADDM" else -value)
            high = HALF_LIMITS[1]
        self.wraps += _outside(value, low, high)
        cells[place] = value.astype(cells.dtype)

    def _cells(
        self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | int]:
        """Return the RAM in cells of the operand's size, and the cell of every core: (cells, index)."""
        last = self.ram_bytes - one.op.size
        at = one.value if one.constant else self.registers[one.rs][lanes] + one.value
        if not 0 <= at <= last if one.constant else _outside(at, 0, last):  # type: ignore[arg-type]
            wrong = np.atleast_1d(at)
            wrong = wrong[(wrong < 0) | (wrong > last)][0]
            raise InputError(self.program.outside_ram(word, int(wrong), last))
        if one.op.size == 1:
            return self.bytes, self.array._first_byte[lanes] + at
        if np.any(at & 1):
            odd = np.atleast_1d(at)
            raise InputError(f"{self.program.where(word)}: address {odd[odd % 2 == 1][0]} of 16 bits is odd")
        return self.halves, (self.array._first_byte[lanes] + at) >> 1

    def _branch(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> np.ndarray | None:
        a = self.registers[one.rs][lanes]
        if one.name in ("BNT", "BFE"):
            empty = self.next[lanes] == self.last[lanes]
            if one.name == "BNT" and self.park and empty.any():
                self.status[index[empty]], self.changed = _PARKED, True
                self.word[index[empty]] = word
                return index[empty]
            taken = empty & (one.name == "BNT" or not self.park)
        elif one.name in ("BBS", "BBC"):
            taken = (a >> one.bit & 1) == (one.name == "BBS")
        elif one.name == "BLT":
            taken = a < self.registers[one.rd][lanes]
        else:
            taken = {"JMP": np.ones(index.size, bool), "BZ": a == 0, "BNZ": a != 0}[one.name]
        self.word[index[taken]] = one.target
        return None

    def _halt(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self.status[lanes], self.changed = _HALTED, True

    def _rdt(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        if not (self.next[lanes] < self.last[lanes]).all():
            raise InputError(f"{self.program.where(word)}: no timestamp is there")
        self.registers[one.rd][lanes] = self.port[self.next[lanes]]
        self.next[lanes] += 1
        self.events += 1

    def _saturate(self, one: Instruction, lanes: slice | np.ndarray, low: int, high: int) -> None:
        value = self.registers[one.rs][lanes]
        self.saturations += _outside(value, low, high)
        self.registers[one.rd][lanes] = value.clip(low, high)

    def _satb(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self._saturate(one, lanes, 0, BYTE_LIMIT)

    def _sath(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self._saturate(one, lanes, *HALF_LIMITS)

    def _leave(self, one: Instruction, lanes: slice | np.ndarray, index: np.ndarray, low: int, high: int) -> None:
        value, size = self.registers[one.rs][lanes], high - low + 1
        self.wraps += _outside(value, low, high)
        self.out.append(np.stack(np.broadcast_arrays(index, (value - low) % size + low, size.bit_length() - 1)))
        self.events, self.words = self.events + 1, self.words + index.size

    def _outb(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self._leave(one, lanes, index, 0, BYTE_LIMIT)

    def _outh(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> None:
        self._leave(one, lanes, index, *HALF_LIMITS)

    def _send(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> np.ndarray:
        to = self._linked(one, word, index)
        side = (one.value + 2) % len(STEPS)  # the receiver sees it come from the other side
        full = self.link_full[side, to]
        go, to = index[~full], to[~full]
        self._wait(go, self.link_time[side, to])
        self.link[side, to] = self.registers[one.rs][go]
        self.link_full[side, to] = True
        self.link_time[side, to] = self.instructions[go] + self.stalled[go] + 1
        return self._hold(index[full], word, to)

    def _recv(self, one: Instruction, word: int, lanes: slice | np.ndarray, index: np.ndarray) -> np.ndarray:
        self._linked(one, word, index)
        full = self.link_full[one.value, index]
        go = index[full]
        self._wait(go, self.link_time[one.value, go])
        self.registers[one.rd][go] = self.link[one.value, go]
        self.link_full[one.value, go] = False
        self.link_time[one.value, go] = self.instructions[go] + self.stalled[go] + 1
        return self._hold(index[~full], word, self.array._neighbour[one.value][go])

    def _linked(self, one: Instruction, word: int, index: np.ndarray) -> np.ndarray:
        other = self.array._neighbour[one.value][index]
        alone = index[other < 0]
        if alone.size:
            raise InputError(
                f"{self.program.where(word)}: core {self._name(alone[0])} has no {DIRECTIONS[one.value]} neighbour"
            )
        return other

    def _wait(self, lanes: np.ndarray, until: np.ndarray) -> None:
        """Stall cores whose clock is behind the time up to which they wait for a link."""
        now = self.instructions[lanes] + self.stalled[lanes]
        self.stalled[lanes] += np.maximum(until - now, 0)

    def _hold(self, lanes: np.ndarray, word: int, wake: np.ndarray) -> np.ndarray:
        """Hold cores that cannot go on at this instruction; those at the other end of a moved word try again."""
        self.status[lanes], self.word[lanes], self.changed = _BLOCKED, word, True
        self.status[wake[self.status[wake] == _BLOCKED]] = _RUNS
        self.events, self.words = self.events + bool(wake.size), self.words + wake.size
        return lanes

    def _name(self, lane: int) -> str:
        row, column = divmod(int(lane), self.array.shape[1])
        return f"({row}, {column})"

    def _explain_waiting(self) -> None:
        """Raise InputError if cores wait for links that nobody will serve any more."""
        blocked = np.flatnonzero(self.status == _BLOCKED)
        if not blocked.size:
            return
        lines = []
        for lane in blocked[:4]:
            one = self.program.instructions[self.word[lane]]
            other = self.array._neighbour[one.value][lane]
            verb = "to take a word" if one.name == "SEND" else "for a word"
            does = {_HALTED: "has halted", _PARKED: "waits for a timestamp", _BLOCKED: "waits itself"}
            lines.append(
                f"core {self._name(lane)} waits at {self.program.where(int(self.word[lane]))} for core "
                f"{self._name(other)} {verb}, which {does[int(self.status[other])]}"
            )
        raise InputError(f"{blocked.size} of {len(self.status)} cores are blocked: {'; '.join(lines)}")

    def _result(self) -> Frame:
        array, lanes = self.array, len(self.status)
        shape, clocks = array.shape, array.chip.clocks_per_instruction
        owner, words, bits = np.concatenate([np.zeros((3, 0), np.int64), *self.out], axis=1)
        cores, counts = np.unique(owner, return_counts=True)
        other = int(np.argmax(counts != counts[0])) if counts.size else 0
        if other:
            parts = (f"core {self._name(cores[n])} {counts[n]}" for n in (0, other))
            raise InputError(
                f"program {self.program.name}: cores put out different numbers of words: {', '.join(parts)}"
            )
        order, size = np.argsort(owner, kind="stable"), (len(cores), counts[0] if counts.size else 0)
        ops = [one.op for one in self.program.instructions]
        instructions = int(self.instructions.sum())
        return Frame(
            out=words[order].reshape(size),
            out_cores=np.stack(np.divmod(cores, shape[1]), axis=-1),
            out_sizes=bits[order].reshape(size),
            out_bits=np.bincount(owner, bits, lanes).astype(np.int64).reshape(shape),
            cycles=((self.instructions + self.stalled) * clocks).reshape(shape),
            stalls=(self.stalled * clocks).reshape(shape),
            counters=Counters(
                instructions=instructions,
                cycles=(instructions + int(self.stalled.sum())) * clocks,
                photons=int((self.next - self.first).sum()),
                ram_reads=int(sum(n * op.reads for n, op in zip(self.visits, ops, strict=True))),
                ram_writes=int(sum(n * op.writes for n, op in zip(self.visits, ops, strict=True))),
                wraps=self.wraps,
                saturations=self.saturations,
            ),
        )
