"""`IntegerCode`: an 8-bit coding tensor as the compiler takes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenes.errors import normalise_fields, require, require_whole
from ultraphase.tables import coarse_matrix, quarter_wave, require_waves, wave_matrix


@dataclass(frozen=True, eq=False)
class IntegerCode:
    """An 8-bit coding tensor as the chip gets it.

    temporal   (K, Mt) integers within +-127, or (K, Mt, Mr, Mc) of a full tensor
    spatial    (K, Mr, Mc) integers within +-127 in steps of 1/128, or None
    harmonics  of a Fourier code, one for each two rows of `temporal`, cos and sin; empty: the rows are a table
    counters   the code is a coarse histogram over all timestamps: K counters of 8 bits, and no table

    Raises InputError for other shapes and values, and where harmonics or counters do not give `temporal` back.
    """

    name: str
    temporal: np.ndarray
    spatial: np.ndarray | None = None
    harmonics: tuple[int, ...] = ()
    counters: bool = False

    def __post_init__(self) -> None:
        normalise_fields(self, "code")
        for name in ("temporal", "spatial"):
            part = getattr(self, name)
            known = isinstance(part, np.ndarray) or (part is None and name == "spatial")
            require(known, f"code {self.name}: {name} of type {type(part).__name__}, expected a NumPy array")
        shape, spatial = self.temporal.shape, None if self.spatial is None else self.spatial.shape
        good = len(shape) in (2, 4) and 0 not in shape and self.temporal.dtype.kind in "iu"
        good = good and (spatial is None or (len(shape) == 2 and len(spatial) == 3 and spatial[0] == shape[0]))
        require(good, f"code {self.name}: integers of shape {shape} and {spatial}, expected (K, Mt) and (K, Mr, Mc)")
        require(spatial is None or self.block != (1, 1), f"code {self.name}: spatial weights of a block of one core")
        parts = [self.temporal] if self.spatial is None else [self.temporal, self.spatial]
        largest = max(int(np.abs(part.astype(np.int64)).max()) for part in parts)
        require(largest <= 127, f"code {self.name}: value {largest} is outside -127 to 127")
        self._check_harmonics()
        if self.counters:
            plain = self.spatial is None and not self.harmonics and len(shape) == 2
            require(plain, f"code {self.name}: counters have no harmonics, and no spatial part")
            gates = np.array_equal(self.temporal, coarse_matrix(*shape))
            require(gates, f"code {self.name}: counters of {shape[0]} equal gates, `temporal` is not that matrix")

    def _check_harmonics(self) -> None:
        where = f"code {self.name}"
        given = isinstance(self.harmonics, Sequence | np.ndarray) and not isinstance(self.harmonics, str)
        require(given, f"{where}: harmonics {self.harmonics!r}, expected whole numbers in a row")
        whole = tuple(require_whole(one, f"{where}: harmonic") for one in self.harmonics)
        object.__setattr__(self, "harmonics", whole)
        if not whole:
            return
        require(min(whole) >= 1, f"{where}: harmonic {min(whole)}, expected 1 or more")
        count = 2 * len(whole) == self.codes and self.temporal.ndim == 2
        shape = self.temporal.shape
        require(count, f"{where}: {len(whole)} harmonics for codes of shape {shape}, expected one for each two rows")
        require_waves(self.temporal, whole, where)

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
