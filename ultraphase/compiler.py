"""From a trained int8 coding tensor to a core's program and tables, or to one line that says what does not fit.

A core keeps K sums of 16 bits for every block of Mt timestamps, and what the temporal codes come from: a quarter wave
where they are Fourier codes (Mt/4 bytes, whatever K), else the table itself (K Mt bytes). Over a block of Mr x Mc
cores each core holds its own spatial weights, a byte a code: sum_n w c(t_n) = w sum_n c(t_n), so that they are used
once a frame and not once a photon, and the cores' sums are added on their way to the core that puts them out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scenes.errors import InputError, require
from scenes.io.inputs import read_text
from ultraphase.assembly.assembler import assemble
from ultraphase.assembly.codegen import loop_order, source_of, turns_of
from ultraphase.assembly.program import Program
from ultraphase.catalog import FOLDER, Method
from ultraphase.chip import ChipSpec, chosen_chip
from ultraphase.integer_code import IntegerCode, folded_temporal
from ultraphase.tables import block_matrix, int8_codes, quarter_wave, wave_matrix

_MAX_OUTPUT_SHIFT = 16  # of a block's sum: products of more cores leave the 32 bits of a register
_EAST, _WEST, _SOUTH, _NORTH = 1, 2, 4, 8  # bits of a core's `ways`, as `sumblock.s` reads them


@dataclass(frozen=True)
class Layout:
    """Bytes of one core's RAM: `table` (quarter wave or temporal codes), `weights`, `ways`, `sums`."""

    table: int
    weights: int
    ways: int
    sums: int

    @property
    def total(self) -> int:
        return self.table + self.weights + self.ways + self.sums

    def __str__(self) -> str:
        parts = {"table": self.table, "spatial weights": self.weights, "ways": self.ways, "sums": self.sums}
        return ", ".join(f"{name} {size:,}" for name, size in parts.items() if size)


def layout(
    codes: int, bins: int, cores: int, chip: ChipSpec, *, folded: bool, weighted: bool, shared: int = 1
) -> Layout:
    """Return RAM of one core for K codes over blocks of `bins` timestamps and `cores` cores; `shared`: cores that hold
    the table together. Sums begin at an even address, in front."""
    table = bins // 4 if folded else -(-codes * bins // shared)
    many = cores > 1
    return Layout(table, codes if many and weighted else 0, int(many), 2 * codes * (chip.timestamps // bins))


@dataclass(frozen=True, eq=False)
class Compiled:
    """A code's program, checked against the chip.

    source      the assembler text that it comes from
    loop_order  how a photon goes through the codes, in words
    matrix      (Mr, Mc, numbers, timestamps) integers that a photon adds to the numbers of each core of the block
    """

    code: IntegerCode
    program: Program
    source: str
    loop_order: str
    layout: Layout
    matrix: np.ndarray
    chip: ChipSpec

    @property
    def name(self) -> str:
        return self.code.name

    @property
    def block(self) -> tuple[int, int]:
        return self.code.block

    @cached_property
    def weights(self) -> np.ndarray | None:
        """Return the spatial weights of the cores of one block, (Mr, Mc, K); None where nothing is multiplied."""
        spatial = self.code.spatial
        return None if spatial is None or self.block == (1, 1) else np.moveaxis(spatial, 0, -1).astype(np.int64)

    @property
    def on_the_chip(self) -> bool:
        """Return whether the fabricated array has as many rows and columns of cores as the block; else a larger one is
        due."""
        return all(part <= whole for part, whole in zip(self.block, self.chip.cores, strict=True))

    def tables(self, shape: tuple[int, int]) -> dict[str, np.ndarray]:
        """Return contents of RAM for an array of rows x columns cores, as `CoreArray` takes them.

        Raises InputError for an array that blocks do not tile.
        """
        fits = all(whole % part == 0 for whole, part in zip(shape, self.block, strict=True))
        blocks = f"blocks of {self.block[1]} x {self.block[0]}"
        require(fits, f"array of {shape[1]} x {shape[0]} cores does not divide into {blocks}")
        repeats = (shape[0] // self.block[0], shape[1] // self.block[1], 1)
        found: dict[str, np.ndarray] = {}
        if self.code.counters:
            return found
        if self.code.harmonics:
            found["quarter"] = quarter_wave(self.code.temporal)
        elif self.code.temporal.ndim == 2:
            found["temporal"] = self.code.temporal.reshape(-1)
        else:
            own = self.code.temporal.transpose(2, 3, 0, 1).reshape(*self.block, -1)
            found["temporal"] = np.tile(own, repeats)
        if self.weights is not None:
            found["weight"] = np.tile(self.weights, repeats)
        if self.block != (1, 1):
            found["ways"] = np.tile(_ways(self.block)[..., None], repeats)
        return found


def _ways(block: tuple[int, int]) -> np.ndarray:
    """Return the directions in which each core of a block takes and gives sums at the frame's end: the tree of
    `sumblock.s`, (Mr, Mc)."""
    row, column = np.indices(block)
    first = column == 0
    return (
        _EAST * (column + 1 < block[1])
        + _WEST * ~first
        + _SOUTH * (first & (row + 1 < block[0]))
        + _NORTH * (first & (row > 0))
    )


def compile_code(code: IntegerCode, chip: ChipSpec | None = None) -> Compiled:
    """Return program and tables of a code. Raises InputError in one line that names the bytes needed and there, and
    what would fit: fewer codes, a shorter or longer block, or a table that the cores of a block share.

    Examples
    --------
    Two codes of blocks of 32 time bins, as a table. A photon adds to 2 of 64 sums, two for each block:

    >>> import numpy as np
    >>> import ultraphase
    >>> table = np.stack([np.arange(32), 31 - np.arange(32)])
    >>> compiled = ultraphase.compile_code(ultraphase.IntegerCode("ramps", table))
    >>> compiled.matrix.shape  # cores of the block, sums of a core, timestamps
    (1, 1, 64, 1024)
    >>> compiled.matrix[0, 0, :2, 3]
    array([ 3, 28])
    """
    chip = chosen_chip(chip, "compile_code")
    known = chip.timestamps % code.bins == 0 and code.bins & (code.bins - 1) == 0
    require(known, f"code {code.name}: blocks of {code.bins} bins, expected a power of two up to {chip.timestamps}")
    if code.counters:
        return _counters(code, chip)
    cores, folded = code.block[0] * code.block[1], bool(code.harmonics)
    weighted = code.spatial is not None
    most = 1 << _MAX_OUTPUT_SHIFT - (7 if weighted else 0)
    blocks = f"blocks of {code.block[0]} x {code.block[1]} cores"
    require(
        code.output_shift <= _MAX_OUTPUT_SHIFT,
        f"code {code.name}: {blocks}, the sum of more than {most:,} leaves 32 bits",
    )
    ram = layout(code.codes, code.bins, cores, chip, folded=folded, weighted=weighted)
    if ram.total > chip.ram_bytes:
        needs = f"needs {ram.total:,} bytes of RAM a core ({ram}), {chip.ram_bytes:,} are there"
        raise InputError(f"code {code.name} {needs}; {_what_fits(code, chip)}")
    source, order, program = _program(code, chip)
    program = replace(program, timestamps=chip.timestamps)
    return Compiled(code, program, source, order, ram, _matrix(code, chip), chip)


def _what_fits(code: IntegerCode, chip: ChipSpec) -> str:
    """Say which change of one thing would make the code fit into the core: its RAM, and its program store too."""
    cores, folded = code.block[0] * code.block[1], bool(code.harmonics)

    def fits(codes: int, bins: int, shared: int = 1) -> bool:
        weighted = code.spatial is not None
        found = layout(codes, bins, cores, chip, folded=folded, weighted=weighted, shared=shared)
        if found.total > chip.ram_bytes or codes > bins * cores:
            return False
        return shared > 1 or _assembles(_sized(code, codes, bins), chip)

    found = []
    fewer = next((k for k in range(code.codes - 1, 0, -1) if not (folded and k % 2) and fits(k, code.bins)), 0)
    if fewer:
        found.append(f"{fewer} code{'s' if fewer > 1 else ''} of {code.bins} bins")
    lengths = [1 << n for n in range(2, chip.timestamps.bit_length())]
    shorter = [bins for bins in lengths if bins < code.bins and fits(code.codes, bins)]
    longer = [bins for bins in lengths if bins > code.bins and fits(code.codes, bins)]
    for bins in (*shorter[-1:], *longer[:1]):
        found.append(f"{code.codes} code{'s' if code.codes > 1 else ''} of blocks of {bins} bins")
    if cores > 1 and not folded and fits(code.codes, code.bins, cores):
        found.append(f"its table shared by the {cores} cores of a block")
    if not folded and code.codes % 2 == 0 and _fourier_fits(code, cores, chip):
        found.append("a Fourier code of the same size")
    if found:
        return "would fit: " + ", or ".join(found)
    return "neither fewer codes nor another block nor a shared table nor a Fourier code of its size would fit"


def _sized(code: IntegerCode, codes: int, bins: int) -> IntegerCode | None:
    """Make a code of another size and of any values, as the sizes alone decide about its program; None where so few
    bins do not hold its harmonics."""
    spatial = None if code.spatial is None else np.ones((codes, *code.block), np.int64)
    if code.harmonics:
        harmonics = code.harmonics[: codes // 2]
        return _waves(code.name, harmonics, bins, spatial) if max(harmonics) < bins // 2 else None
    own = () if code.temporal.ndim == 2 else code.block
    return IntegerCode(code.name, np.ones((codes, bins, *own), np.int64), spatial)


def _waves(name: str, harmonics: tuple[int, ...], bins: int, spatial: np.ndarray | None) -> IntegerCode:
    quarter = int8_codes(np.cos(2 * np.pi * (np.arange(bins // 4) + 0.5) / bins))
    return IntegerCode(name, wave_matrix(quarter, harmonics), spatial, harmonics)


def _fourier_fits(code: IntegerCode, cores: int, chip: ChipSpec) -> bool:
    found = layout(code.codes, code.bins, cores, chip, folded=True, weighted=True)
    if code.codes > code.bins - 2 or found.total > chip.ram_bytes:
        return False
    spatial = None if cores == 1 else np.ones((code.codes, *code.block), np.int64)
    return _assembles(_waves(code.name, tuple(range(1, code.codes // 2 + 1)), code.bins, spatial), chip)


def _assembles(code: IntegerCode | None, chip: ChipSpec) -> bool:
    if code is None:
        return False
    try:
        _fastest(code, chip)
    except InputError:
        return False
    return True


def _counters(code: IntegerCode, chip: ChipSpec) -> Compiled:
    """Compile a coarse histogram: a program of the catalogue."""
    gates = f"{code.bins} bins, expected all {chip.timestamps} timestamps of the chip"
    require(code.bins == chip.timestamps, f"code {code.name}: counters over {gates}")
    chosen = Method("coarse", code.codes)
    program = chosen.program(chip)
    ram = Layout(0, 0, 0, program.ram_bytes)
    text = (FOLDER / "coarse.s").read_text()
    return Compiled(code, program, text, "one counter a photon", ram, chosen.matrix(chip=chip)[None, None], chip)


def _matrix(code: IntegerCode, chip: ChipSpec) -> np.ndarray:
    if code.temporal.ndim == 4:
        rows, columns = code.block
        parts = [block_matrix(code.temporal[:, :, r, c], chip.timestamps) for r in range(rows) for c in range(columns)]
        return np.stack(parts).reshape(rows, columns, -1, chip.timestamps)
    temporal = folded_temporal(code) if code.harmonics else code.temporal
    one = block_matrix(temporal, chip.timestamps)
    return np.broadcast_to(one, (*code.block, *one.shape))


def _program(code: IntegerCode, chip: ChipSpec) -> tuple[str, str, Program]:
    """Assemble a code's text. Raises InputError that says how many codes the program store would hold."""
    try:
        return _fastest(code, chip)
    except InputError as refused:
        raise InputError(f"{refused}; would fit: {_fewer_codes(code, chip)} codes") from None


def _fastest(code: IntegerCode, chip: ChipSpec) -> tuple[str, str, Program]:
    """Assemble the fastest text that the program store holds: all harmonics one after the other, else in a loop."""
    refused: InputError | None = None
    for turns in turns_of(code):
        source = source_of(code, chip, turns)
        try:
            return source, loop_order(code, turns), _assembled(source, code.name, chip)
        except InputError as error:
            refused = refused or error
    assert refused is not None, "a code without a text"
    raise refused


def _assembled(source: str, name: str, chip: ChipSpec) -> Program:
    return assemble(source, name=name, chip=chip, read=lambda file: read_text(FOLDER / file, "assembler source"))


def _fewer_codes(code: IntegerCode, chip: ChipSpec) -> int:
    """Find the most codes of a Fourier code whose program the store holds."""
    for codes in range(code.codes - 2, 0, -2):
        spatial = None if code.spatial is None else code.spatial[:codes]
        less = replace(code, temporal=code.temporal[:codes], spatial=spatial, harmonics=code.harmonics[: codes // 2])
        if _assembles(less, chip):
            return codes
    return 0
