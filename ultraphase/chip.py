"""State what is public about the UltraPhase chip, what is assumed beside it, and the rates and powers that follow.

Source: supplement of the ICCV 2023 paper, section S.2 and Supplementary Figure 5; efficiency from the authors' public
plotting script. The chip's instruction set is not public: the emulated one is UltraPhase-constrained, not UltraPhase's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from scenes.errors import InputError, normalise_fields, require, require_kind, require_whole
from scenes.limits import require_memory

CORE_BYTES = 512  # of an emulated core beside its RAM: registers, links, counters

ASSUMPTIONS: dict[str, str] = {
    "instruction set": "UltraPhase-constrained, ours: the chip's is not public; logic, 32-bit arithmetic, data, links",
    "program store": "separate from the 4,096 bits of RAM",
    "ram access": "bytes, and aligned 16-bit words; one access, or one 16-bit read-modify-write, an instruction",
    "registers": "16 of 32 bits, not counted as RAM",
    "max_shift": "one instruction shifts by 1 to 4 bits",
    "timestamp port": "one timestamp at a time; a branch tells whether one is there, another whether the frame is over",
    "links": "one 32-bit word to each neighbour; sending to a full link and receiving from an empty one wait",
    "energy": "every instruction costs the published energy; idle cores, links, SPADs and converters cost nothing",
    "one core, one pixel": "as in S.2; a core shared by 4 x 4 SPADs receives their timestamps without addresses",
}


def whole_pair(value: Any, what: str, least: int = 1) -> tuple[int, int]:
    """Return (rows, columns) as Python's whole numbers. Raises InputError that names `what` was given, for other than
    two, and for one below `least`."""
    try:
        first, second = value
    except (TypeError, ValueError):
        raise InputError(f"{what} {value!r}, expected two whole numbers (rows, columns)") from None
    rows, columns = require_whole(first, what), require_whole(second, what)
    require(min(rows, columns) >= least, f"{what} {rows} x {columns}, expected {least} or more each")
    return rows, columns


@dataclass(frozen=True)
class ChipSpec:
    """Published numbers of the chip and of its readout interface (as on SwissSPAD2); below them, assumed ones.

    energy_per_instruction_j: 94.6 GOPS/W of the authors' script. S.2 prints its inverse as Watts; see `power`.
    Raises InputError for a chip that cannot be emulated.

    Examples
    --------
    Three clocks of 2.38 ns an instruction are 140 million instructions a second. 1 Gbit/s through 5 pF at 3.3 V takes
    rate C V^2 = 54 mW:

    >>> import scene2spad as s2s
    >>> chip = s2s.ChipSpec()
    >>> round(chip.instructions_per_second / 1e6), chip.ram_bytes
    (140, 512)
    >>> round(1e3 * chip.readout_power_w(1e9))  # mW
    54
    """

    cores: tuple[int, int] = (3, 6)
    program_words: int = 256
    ram_bits: int = 4096
    clock_s: float = 2.38e-9
    clocks_per_instruction: int = 3
    energy_per_instruction_j: float = 1 / 94.6e9
    timestamp_bits: int = 10
    io_voltage_v: float = 3.3
    io_load_f: float = 5e-12
    # assumed
    max_shift: int = 4

    def __post_init__(self) -> None:
        normalise_fields(self, "chip")
        require(1 <= self.program_words <= 512, f"chip: {self.program_words} program words, expected 1 to 512")
        good = self.ram_bits % 16 == 0 and 16 <= self.ram_bits <= 1 << 19
        require(good, f"chip: {self.ram_bits} bits of RAM, expected a multiple of 16 from 16 to 524288")
        require(1 <= self.max_shift <= 31, f"chip: max_shift {self.max_shift}, expected 1 to 31")
        object.__setattr__(self, "cores", whole_pair(self.cores, "chip: cores"))
        clocks = self.clocks_per_instruction
        require(clocks >= 1, f"chip: {clocks} clocks an instruction, expected 1 or more")
        for name in ("clock_s", "energy_per_instruction_j", "io_voltage_v", "io_load_f"):
            number = getattr(self, name)
            require(0 < number < math.inf, f"chip: {name} {number:g}, expected above 0")
        require(1 <= self.timestamp_bits <= 16, f"chip: {self.timestamp_bits} bits a timestamp, expected 1 to 16")

    @property
    def ram_bytes(self) -> int:
        """Return the bytes of one core's RAM."""
        return self.ram_bits // 8

    @property
    def timestamps(self) -> int:
        """Return the number of different timestamps."""
        return 1 << self.timestamp_bits

    @property
    def instructions_per_second(self) -> float:
        """Return the instructions per second of one core."""
        return 1 / (self.clock_s * self.clocks_per_instruction)

    def processing_time_s(self, photons: float, clocks_per_photon: float) -> float:
        """Return the time [s] that one core works on a frame of so many `photons`, a number for the core."""
        return photons * clocks_per_photon * self.clock_s

    def energy_j(self, clocks: float) -> float:
        """Return energy of the instructions that fill `clocks` clock cycles of one core."""
        return clocks / self.clocks_per_instruction * self.energy_per_instruction_j

    def data_rate_bit_per_s(self, bits_per_pixel: float, pixels: int, frames_per_s: float) -> float:
        """Return what leaves the sensor."""
        return bits_per_pixel * pixels * frames_per_s

    def readout_power_w(self, data_rate_bit_per_s: float) -> float:
        """Return P = rate C V^2 of the digital output (S.2)."""
        return data_rate_bit_per_s * self.io_load_f * self.io_voltage_v**2


def chosen_chip(chip: ChipSpec | None, where: str) -> ChipSpec:
    """Return a chip that is given, or the published one for None; InputError for anything else, `where` comes first."""
    if chip is None:
        return ChipSpec()
    require_kind(chip, ChipSpec, f"{where}: chip")
    return chip


def array_shape(shape: Any, chip: ChipSpec) -> tuple[int, int]:
    """Return (rows, columns) of an array of cores, or an InputError, also for more cores than memory holds."""
    rows, columns = whole_pair(shape, "core array of shape")
    require_memory(rows * columns * (chip.ram_bytes + CORE_BYTES), f"a core array of {rows} x {columns}")
    return rows, columns
