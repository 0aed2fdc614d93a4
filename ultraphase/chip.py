"""What is public about the UltraPhase chip, and the rates and powers that follow from it.

Source: supplement of the ICCV 2023 paper, section S.2 and Supplementary Figure 5; efficiency from the authors' public
plotting script.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ChipSpec:
    """Published numbers of the chip and of its readout interface (as on SwissSPAD2)."""

    cores: tuple[int, int] = (3, 6)
    program_words: int = 256
    ram_bits: int = 4096
    clock_s: float = 2.38e-9
    clocks_per_instruction: int = 3
    energy_per_instruction_j: float = 1 / 94.6e9
    io_voltage_v: float = 3.3
    io_load_f: float = 5e-12

    @property
    def instructions_per_second(self) -> float:
        """Per core."""
        return 1 / (self.clock_s * self.clocks_per_instruction)

    def processing_time_s(self, photons: float, clocks_per_photon: float) -> float:
        """Time one core works on one frame."""
        return photons * clocks_per_photon * self.clock_s

    def data_rate_bit_per_s(self, bits_per_pixel: float, pixels: int, frames_per_s: float) -> float:
        """What leaves the sensor."""
        return bits_per_pixel * pixels * frames_per_s

    def readout_power_w(self, data_rate_bit_per_s: float) -> float:
        """P = rate C V^2 of the digital output (S.2)."""
        return data_rate_bit_per_s * self.io_load_f * self.io_voltage_v**2
