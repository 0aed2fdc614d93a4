"""The programs that come with the package, by name, with what S.2 publishes about seven of them."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.errors import InputError, normalise_fields, require
from ultraphase.assembly.assembler import assemble_file
from ultraphase.assembly.program import Program
from ultraphase.chip import ChipSpec
from ultraphase.tables import INT8_SCALE, block_matrix, coarse_matrix, fourier_matrix, quarter_wave, require_waves

FOLDER = Path(__file__).parent / "programs"
SPATIAL_BLOCK = (2, 2)
TIMESTAMPS = 1024
TIME_BLOCK = 256
SPADS = 16  # that share a core of the chip, 4 x 4: `addressed` keeps their addresses


@dataclass(frozen=True)
class Published:
    """A row of Supplementary Figure 5 as printed: for 550 photons a frame, and 2 x 2 cores at 30 frames a second.

    unrounded_clocks   clocks a photon with which every printed figure follows to its last digit (inferred: S.2 prints
                       averages over photons, rounded)
    """

    clocks: int
    bytes_per_pixel: int
    frame_time_s: float
    rate_kb_per_s: float
    processing_uw: float
    readout_uw: float
    unrounded_clocks: float


PUBLISHED: dict[str, Published] = {
    "coarse-16": Published(30, 16, 3.93e-5, 1.92, 2.74e-4, 0.84, 30),
    "coarse-64": Published(24, 64, 3.14e-5, 7.68, 1.75e-4, 3.35, 24),
    "coarse-256": Published(24, 256, 3.14e-5, 30.72, 1.75e-4, 13.38, 24),
    "fourier-8": Published(210, 16, 2.74e-4, 1.92, 1.34e-2, 0.84, 209.6),
    "fourier-16": Published(330, 32, 4.32e-4, 3.84, 3.32e-2, 1.67, 330.2),
    "separable-8": Published(241, 16, 3.15e-4, 1.92, 1.76e-2, 0.84, 240.65),
    "separable-16": Published(361, 32, 4.73e-4, 3.84, 3.98e-2, 1.67, 361.45),
}
FAMILIES = {
    "coarse": "coarse histogram",
    "fourier": "truncated Fourier 1024 x 1 x 1",
    "separable": "Fourier + learned 256 x 2 x 2",
    "learned": "learned 256 x 2 x 2",
    "addressed": "truncated Fourier of each of 4 x 4 SPADs",
}


@dataclass(frozen=True)
class Method:
    """A compressive histogram on the chip: `FAMILY-K`.

    coarse     K counters of 8 bits
    fourier    K codes of 16 bits from a quarter wave of 256
    separable  K codes for each of 4 blocks of 256 bins from a quarter wave of 64, weighted and added over 2 x 2 cores
    learned    the same with a learned temporal table: does not fit for K >= 2
    addressed  fourier for each SPAD of the core; timestamps carry their SPAD's address above their time bits
    """

    family: str
    codes: int
    shift_step: int | None = None

    def __post_init__(self) -> None:
        normalise_fields(self, "program")
        require(self.family in FAMILIES, f"program family {self.family!r}, expected one of {', '.join(FAMILIES)}")
        if self.family == "coarse":
            good = self.codes in (2, 4, 8, 16, 32, 64, 128, 256, 512)
            require(good, f"program {self.name}: {self.codes} bins, expected a power of two from 2 to 512")
        else:
            even = self.family == "learned" or self.codes % 2 == 0
            good = 1 <= self.codes <= 1024 and even
            require(good, f"program {self.name}: {self.codes} codes, expected an even number from 2 to 1024")
            plain = self.shift_step is None
            require(
                plain, f"program {self.name}: shift {self.shift_step} is for coarse programs, the others shift none"
            )
        least = self.shift_step is None or self.shift_step >= 1
        require(least, f"program {self.name}: shift of {self.shift_step} bits an instruction, expected 1 or more")

    @property
    def name(self) -> str:
        step = "" if self.shift_step is None else f"-shift-{self.shift_step}"
        return f"{self.family}-{self.codes}{step}"

    @property
    def title(self) -> str:
        return f"{FAMILIES[self.family]}, K = {self.codes}"

    @property
    def published(self) -> Published | None:
        return PUBLISHED.get(self.name)

    @property
    def block(self) -> tuple[int, int]:
        """Return the rows and columns of cores whose codes leave the sensor as one."""
        return SPATIAL_BLOCK if self.family in ("separable", "learned") else (1, 1)

    @property
    def saturates(self) -> bool:
        """Return whether the numbers in RAM stay at their top, as counters do; sums of codes wrap around."""
        return self.family == "coarse"

    @property
    def temporal_bins(self) -> int:
        """Return Mt of the temporal coding tensor that the program's table comes from; 0 where there is none."""
        wide = dict.fromkeys(("fourier", "addressed"), TIMESTAMPS)
        return {**wide, "separable": TIME_BLOCK, "learned": TIME_BLOCK}.get(self.family, 0)

    def program(self, chip: ChipSpec | None = None) -> Program:
        """Return assembled, and checked against the chip. Raises InputError for what is over, and for a chip of other
        timestamps than the program's."""
        constants, timestamps = {"K": self.codes}, self._timestamps(chip)
        if self.family == "coarse":
            constants["SHIFT"] = (timestamps // self.codes).bit_length() - 1
            if self.shift_step is not None:
                constants["STEP"] = self.shift_step
        try:
            program = assemble_file(FOLDER / f"{self.family}.s", constants, chip, name=self.name)
        except InputError as error:
            if str(error).startswith(f"program {self.name}: "):
                raise
            raise InputError(f"program {self.name}: {self.codes} codes do not fit the core ({error})") from None
        return replace(program, timestamps=(SPADS if self.family == "addressed" else 1) * timestamps)

    def tables(self, temporal: np.ndarray | None = None, weights: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return tables for `CoreArray`: from the int8 temporal tensor (K, Mt), and of spatial weights (..., K) a
        core. Raises InputError for a tensor that the program does not compute."""
        if self.temporal_bins == 0:
            return {}
        if temporal is None:
            raise InputError(f"program {self.name}: needs an int8 temporal tensor (K, {self.temporal_bins})")
        self._check(temporal)
        learned = self.family == "learned"
        tables = {"learned": temporal.reshape(-1)} if learned else {"quarter": quarter_wave(temporal)}
        if self.block != (1, 1):
            tables["weight"] = np.full(self.codes, INT8_SCALE) if weights is None else weights
        return tables

    def _timestamps(self, chip: ChipSpec | None) -> int:
        """Return how many the chip has: tables of other programs than coarse ones are for 1,024."""
        count = (chip or ChipSpec()).timestamps
        if self.family == "coarse":
            require(2 * self.codes <= count, f"program {self.name}: {self.codes} bins of the chip's {count} timestamps")
            return count
        other = f"the chip has {count:,}; `compile_code` makes programs for those"
        require(count == TIMESTAMPS, f"program {self.name}: is for {TIMESTAMPS:,} timestamps, {other}")
        return count

    def matrix(self, temporal: np.ndarray | None = None, chip: ChipSpec | None = None) -> np.ndarray:
        """Return the integer matrix (numbers in RAM, timestamps) that the program computes, from the int8 temporal
        tensor."""
        timestamps = self._timestamps(chip)
        if self.family == "coarse":
            return coarse_matrix(self.codes, timestamps)
        if temporal is None:
            raise InputError(f"program {self.name}: needs an int8 temporal tensor (K, {self.temporal_bins})")
        self._check(temporal)
        if self.family == "learned":
            return block_matrix(np.asarray(temporal, np.int64), TIMESTAMPS)
        fourier = fourier_matrix(quarter_wave(temporal), self.codes)
        if self.family == "addressed":
            return block_matrix(fourier, SPADS * TIMESTAMPS)
        return fourier if self.family == "fourier" else block_matrix(fourier, TIMESTAMPS)

    def _check(self, temporal: np.ndarray) -> None:
        where, shape = f"program {self.name}", (self.codes, self.temporal_bins)
        array = isinstance(temporal, np.ndarray)
        found = f"{temporal.dtype} {temporal.shape}" if array else f"of type {type(temporal).__name__}"
        good = array and temporal.shape == shape and temporal.dtype.kind in "iu"
        require(good, f"{where}: temporal tensor is {found}, expected integers of shape {shape} (`int8_codes`)")
        if self.family != "learned":
            require_waves(temporal, range(1, self.codes // 2 + 1), where)


def method(name: str) -> Method:
    """Return the method of a name such as `fourier-16`, or `coarse-16-shift-2`: shifts of at most 2 bits an
    instruction. Raises InputError for another name, and for a number of codes that no program has.

    Examples
    --------
    >>> import ultraphase
    >>> fourier = ultraphase.method("fourier-8")
    >>> fourier.title, len(fourier.program().words)
    ('truncated Fourier 1024 x 1 x 1, K = 8', 96)
    """
    found = re.fullmatch(r"([a-z]+)-(\d{1,4})(?:-shift-(\d{1,2}))?", name) if isinstance(name, str) else None
    if not found or found[1] not in FAMILIES:
        raise InputError(f"program {name!r}: expected a file (.s) or FAMILY-K with one of {', '.join(FAMILIES)}")
    return Method(found[1], int(found[2]), int(found[3]) if found[3] else None)
