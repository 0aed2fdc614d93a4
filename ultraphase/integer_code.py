"""`IntegerCode`: an 8-bit coding tensor as the compiler takes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.errors import require
from ultraphase.tables import quarter_wave, wave_matrix


@dataclass(frozen=True, eq=False)
class IntegerCode:
    """An 8-bit coding tensor as the chip gets it.

    temporal   (K, Mt) integers within +-127, or (K, Mt, Mr, Mc) of a full tensor
    spatial    (K, Mr, Mc) integers within +-127 in steps of 1/128, or None
    harmonics  of a Fourier code, one for each two rows of `temporal`, cos and sin; empty: the rows are a table
    counters   the code is a coarse histogram over all timestamps: K counters of 8 bits, and no table
    """

    name: str
    temporal: np.ndarray
    spatial: np.ndarray | None = None
    harmonics: tuple[int, ...] = ()
    counters: bool = False

    def __post_init__(self) -> None:
        shape, spatial = self.temporal.shape, None if self.spatial is None else self.spatial.shape
        good = len(shape) in (2, 4) and 0 not in shape and self.temporal.dtype.kind in "iu"
        good = good and (spatial is None or (len(shape) == 2 and len(spatial) == 3 and spatial[0] == shape[0]))
        require(good, f"code {self.name}: integers of shape {shape} and {spatial}, expected (K, Mt) and (K, Mr, Mc)")
        require(spatial is None or self.block != (1, 1), f"code {self.name}: spatial weights of a block of one core")
        parts = [self.temporal] if self.spatial is None else [self.temporal, self.spatial]
        largest = max(int(np.abs(part).max()) for part in parts)
        require(largest <= 127, f"code {self.name}: value {largest} is outside -127 to 127")

    @property
    def codes(self) -> int:
        """Return K, the number of codes."""
        return self.temporal.shape[0]

    @property
    def bins(self) -> int:
        """Return Mt, the number of time bins of a block."""
        return self.temporal.shape[1]

    @property
    def block(self) -> tuple[int, int]:
        """Return (Mr, Mc): the cores whose codes leave the sensor as one."""
        return tuple((self.temporal.shape[2:] if self.spatial is None else self.spatial.shape[1:]) or (1, 1))

    @property
    def output_shift(self) -> int:
        """Return the bits that the sum of a block's cores is shifted by, so that what 16-bit sums make never leaves 16
        bits: 7 of the weights' steps and one for every doubling of the cores."""
        rows, columns = self.block
        weights = 0 if self.spatial is None or rows * columns == 1 else 7
        return weights + (rows * columns - 1).bit_length()


def folded_temporal(code: IntegerCode) -> np.ndarray:
    """Return (K, Mt) integers that a Fourier code's quarter wave gives back: its rows, even harmonics half a step
    late."""
    return wave_matrix(quarter_wave(code.temporal), code.harmonics)
