"""`Program`: words, RAM regions and where they came from; its listing, and the way back to source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenes.errors import require, require_kinds, tuple_of
from ultraphase.assembly.isa import Instruction, decode, encode, format_instruction
from ultraphase.chip import ChipSpec, chosen_chip

KINDS: dict[str, np.dtype[Any]] = {"u8": np.dtype("u1"), "s8": np.dtype("i1"), "s16": np.dtype("<i2")}


@dataclass(frozen=True)
class Region:
    """A named part of RAM: `count` numbers of one kind (u8, s8 or s16) from byte `address` on.

    table   it is filled before the program runs and stays; otherwise it is the program's to write, zero at first
    values  the table's contents where the source gives them, else empty: then they come at loading
    """

    name: str
    kind: str
    count: int
    address: int
    table: bool = False
    values: tuple[int, ...] = ()

    @property
    def bits(self) -> int:
        return self.count * KINDS[self.kind].itemsize * 8

    @property
    def end(self) -> int:
        """Return the first byte behind the region."""
        return self.address + self.bits // 8


@dataclass(frozen=True)
class Program:
    """Program of a core.

    lines    (file, line number) of every instruction, for messages
    labels   name -> word
    timestamps   how many it knows, from 0 on; larger ones are refused, as tables would fold them. None: all of 16 bits

    Raises InputError for fields of another kind; `assemble` makes one.

    Examples
    --------
    A coarse histogram has 16 counters of 8 bits in RAM. A photon adds 1 to one of them, each of which is 64 of the 1024
    time bins wide; `verify` proves it, timestamp by timestamp:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> from ultraphase import method
    >>> program = method("coarse-16").program()
    >>> isinstance(program, s2s.Program), program.ram_bits
    (True, 128)
    >>> gates = np.kron(np.eye(16, dtype=int), np.ones(64, dtype=int))  # (16, 1024)
    >>> bool((s2s.verify(program, gates).table.T == gates).all())
    True
    """

    name: str
    instructions: tuple[Instruction, ...]
    regions: tuple[Region, ...]
    labels: Mapping[str, int]
    lines: tuple[tuple[str, int], ...]
    timestamps: int | None = None

    def __post_init__(self) -> None:
        require_kinds(self, "program", name=str, labels=Mapping, lines=tuple)
        where = f"program {self.name}"
        object.__setattr__(self, "instructions", tuple_of(self.instructions, Instruction, f"{where}: instructions"))
        object.__setattr__(self, "regions", tuple_of(self.regions, Region, f"{where}: regions"))

    @property
    def words(self) -> tuple[int, ...]:
        """Return the 32-bit words of the program store."""
        return tuple(encode(instruction) for instruction in self.instructions)

    @property
    def ram_bits(self) -> int:
        """Count the bits of RAM that the program declares."""
        return sum(region.bits for region in self.regions)

    @property
    def ram_bytes(self) -> int:
        """Return the first byte behind the last region; the program may touch none from there on."""
        return max((region.end for region in self.regions), default=0)

    def region(self, name: str) -> Region:
        """Return the region of that name, or an InputError that lists the names."""
        found = [region for region in self.regions if region.name == name]
        names = ", ".join(region.name for region in self.regions)
        require(bool(found), f"program {self.name}: no region {name!r} in RAM, there are {names or 'none'}")
        return found[0]

    @property
    def state(self) -> tuple[Region, ...]:
        """Select the regions that the program writes."""
        return tuple(region for region in self.regions if not region.table)

    def where(self, word: int) -> str:
        """Return a word as a message names it: place in the source, and the instruction."""
        file, line = self.lines[word]
        return f"{file}:{line}, word {word} ({format_instruction(self.instructions[word], self._label)})"

    def outside_ram(self, word: int, address: int, last: int) -> str:
        """Return the message for a word that touched an address outside 0 to `last`, below 0 where none fits."""
        declared = f"0 to {last}" if last >= 0 else "1 byte"  # which holds no 16 bits
        within = (
            f"is outside the declared {declared}" if self.ram_bytes else "is not there: the program declares no RAM"
        )
        return f"{self.where(word)}: RAM address {address} {within}"

    def _label(self, word: int) -> str:
        return next((name for name, target in self.labels.items() if target == word), str(word))

    def check(self, chip: ChipSpec) -> None:
        """Raise InputError, with what is over, unless the program fits the chip."""
        over = len(self.instructions) - chip.program_words
        require(
            over <= 0,
            f"program {self.name}: {len(self.instructions)} words, {over} over the {chip.program_words} of the core",
        )
        last = self.ram_bytes * 8
        over = last - chip.ram_bits
        require(
            over <= 0, f"program {self.name}: {last} bits of RAM, {over} bits over the {chip.ram_bits} bits of the core"
        )
        require(len(self.instructions) > 0, f"program {self.name}: no instructions")
        for word, instruction in enumerate(self.instructions):
            if "n" in instruction.op.takes:
                shift, most = instruction.value, chip.max_shift
                require(1 <= shift <= most, f"{self.where(word)}: shift by {shift} is outside 1 to {most}")
            if "l" in instruction.op.takes:
                inside = instruction.target < len(self.instructions)
                require(inside, f"{self.where(word)}: branches to word {instruction.target}, behind the program")

    def image(self, tables: Mapping[str, np.ndarray], lanes: int = 1) -> np.ndarray:
        """Return RAM before the first frame, (lanes, bytes up to the last region's end) uint8.

        tables   contents by region name, (count,) for all cores alike or (lanes, count). Raises InputError for a table
                 without contents, contents of the wrong length or values, and names that are not tables.
        """
        ram = np.zeros((lanes, self.ram_bytes), np.uint8)
        unknown = set(tables) - {region.name for region in self.regions if region.table}
        require(not unknown, f"program {self.name}: no table {', '.join(sorted(unknown))} in its RAM")
        for region in self.regions:
            if region.table:
                ram[:, region.address : region.end] = self._contents(region, tables, lanes)
        return ram

    def _contents(self, region: Region, tables: Mapping[str, np.ndarray], lanes: int) -> np.ndarray:
        where = f"program {self.name}: table {region.name}"
        require(
            bool(region.values) or region.name in tables, f"{where} has no contents, {region.count} values expected"
        )
        given = np.asarray(tables.get(region.name, region.values))
        whole = given.dtype.kind in "iu"
        require(whole, f"{where}: values of type {given.dtype}, expected integers")
        fits = given.shape in ((region.count,), (lanes, region.count))
        require(fits, f"{where}: shape {given.shape}, expected ({region.count},), or one row for each of {lanes} cores")
        low, high = np.iinfo(KINDS[region.kind]).min, np.iinfo(KINDS[region.kind]).max
        inside = low <= given.min() and given.max() <= high
        require(bool(inside), f"{where}: values {given.min()} to {given.max()} are outside {low} to {high}")
        return np.ascontiguousarray(given.astype(KINDS[region.kind])).view(np.uint8)


def listing(program: Program, chip: ChipSpec | None = None) -> str:
    """Return address, word, clocks and source of every instruction, under the RAM map and the totals."""
    chip = chosen_chip(chip, "listing")
    lines = [f"; {program.name}: {len(program.instructions)} of {chip.program_words} words, "]
    lines[0] += f"{program.ram_bits} of {chip.ram_bits} bits of RAM"
    for r in program.regions:
        what = "table" if r.table else "space"
        lines.append(f"; RAM {r.address:3d} .. {r.end - 1:3d}  {what} {r.name}: {r.count} x {r.kind}, {r.bits} bits")
    names: dict[int, list[str]] = {}
    for name, target in program.labels.items():
        names.setdefault(target, []).append(name)
    for address, instruction in enumerate(program.instructions):
        lines += [f"{name}:" for name in names.get(address, ())]
        text = format_instruction(instruction, program._label)
        file, line = program.lines[address]
        clocks = chip.clocks_per_instruction
        lines.append(f"  {address:3d}  {encode(instruction):08x}  {clocks}  {text:32s}; {file}:{line}")
    lines += [f"{name}:" for name in names.get(len(program.instructions), ())]
    return "\n".join(lines) + "\n"


def disassemble(words: tuple[int, ...], regions: tuple[Region, ...] = ()) -> str:
    """Return source that assembles to the same words and regions. Raises InputError for a word that is no
    instruction."""
    instructions = [decode(word) for word in words]
    targets = sorted({i.target for i in instructions if "l" in i.op.takes})
    taken, start = {region.name for region in regions}, "L"
    while any(f"{start}{target}" in taken for target in targets):
        start += "_"
    lines = []
    for r in regions:
        values = "".join(f", {value}" for value in r.values)
        lines.append(f".{'table' if r.table else 'space'} {r.name}, {r.kind}, {r.count}{values}")
    for address, instruction in enumerate(instructions):
        if address in targets:
            lines.append(f"{start}{address}:")
        lines.append(f"        {format_instruction(instruction, lambda target: f'{start}{target}')}")
    lines += [f"{start}{target}:" for target in targets if target == len(instructions)]
    return "\n".join(lines) + "\n"


def block_ends(program: Program) -> list[int]:
    """Return for every word the first one behind its basic block."""
    starts = set(program.labels.values()) | {one.target for one in program.instructions if "l" in one.op.takes}
    ends = [0] * len(program.instructions)
    for word in reversed(range(len(ends))):
        one = program.instructions[word]
        parts = "l" in one.op.takes or one.name in ("HALT", "SEND", "RECV") or word + 1 in starts
        ends[word] = word + 1 if parts or word + 1 == len(ends) else ends[word + 1]
    return ends
