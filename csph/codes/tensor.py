"""`CodingTensor`: the K codes of a block of Mt bins x Mr rows x Mc columns, full or separable, and what it costs.

A block keeps K codes y_k = sum over (t, r, c) of C[k, t, r, c] n[t, r, c] instead of Mt Mr Mc counts; a detection adds
one column of C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from csph.codes.photons import encode_photons, photon_table
from scenes.errors import InputError, require, require_kind, require_kinds, require_number
from spad.estimators.depth import by_pixels

LEVELS = 127  # +- steps of an 8-bit part: symmetric, -128 is left out so that a sign can always be turned
LEAST = 1e-15  # of a part's largest value, and its inverse the most: squares of codes are summed in float32
WHOLE = 1e-3  # of a step: float32 holds products of steps to a hundredth of that


@dataclass(frozen=True, eq=False)
class CodingTensor:
    """K codes over a block of Mt bins x Mr rows x Mc columns.

    name      what it is called in results
    temporal  (K, Mt) float32; of a full tensor (K, Mt, Mr, Mc)
    spatial   (K, Mr, Mc) float32 of a separable tensor, C[k, t, r, c] = temporal[k, t] spatial[k, r, c]; else None
    computed  how many numbers generate the temporal part on the fly, whatever K (Fourier: Mt/4, a quarter wave);
              None where it is stored entry by entry
    steps     weight of one step of the temporal and of the spatial part where both are whole steps within +-127
              already, as those of a layer trained with `int8`; None for others

    Both parts are copied, and kept in float32, also those given in float64 or 16 bits. Raises InputError for other
    shapes, values that are not finite, or not in float32, more codes than counts, steps that are not above 0, and
    parts that are not whole steps, to a thousandth, within +-127.

    Examples
    --------
    Two codes of a pixel's four bins, the sums of the first and of the second half:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> halves = s2s.CodingTensor("halves", np.array([[1, 1, 0, 0], [0, 0, 1, 1]]))
    >>> halves.block, halves.codes, halves.compression_ratio
    ((4, 1, 1), 2, 2.0)
    """

    name: str
    temporal: Tensor
    spatial: Tensor | None = None
    computed: int | None = None
    steps: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_kinds(self, "coding tensor", name=str)
        for label, ranks, layout in (
            ("temporal", (2, 4), "(K, Mt) or (K, Mt, Mr, Mc)"),
            ("spatial", (3,), "(K, Mr, Mc)"),
        ):
            part = getattr(self, label)
            if part is None and label == "spatial":
                continue
            # a copy, as decoders keep what they make of a tensor; in float32 it may end in infinity
            part = as_tensor(part).detach().to(torch.float32, copy=True)
            shape = tuple(part.shape)
            if part.ndim not in ranks or 0 in shape or not bool(part.isfinite().all()):
                raise InputError(
                    f"coding tensor {self.name}: {label} part of shape {shape}, expected finite values {layout}"
                )
            largest = float(part.abs().max())
            what = f"coding tensor {self.name}: the largest value of the {label} part is {largest:g}"
            require(largest == 0 or LEAST <= largest <= 1 / LEAST, f"{what}, expected {LEAST:g} to {1 / LEAST:g}")
            object.__setattr__(self, label, part)
        if self.spatial is not None:
            alike = self.temporal.ndim == 2 and len(self.spatial) == len(self.temporal)
            shapes = f"temporal part {tuple(self.temporal.shape)} and spatial part {tuple(self.spatial.shape)}"
            require(alike, f"coding tensor {self.name}: {shapes}, expected (K, Mt) and (K, Mr, Mc)")
        if self.steps is not None:
            self._check_steps(self.steps)
        size = self.bins * self.rows * self.columns
        swapped = (
            "; codes come first, (K, T): transpose it?" if self.temporal.ndim == 2 and self.spatial is None else ""
        )
        limit = f"{self.codes} codes of a block of {size} counts, the limit{swapped}"
        require(self.codes <= size, f"coding tensor {self.name}: {limit}")

    def _check_steps(self, steps: object) -> None:
        """Make the steps a pair of numbers. Raises InputError unless both parts are whole steps within +-LEVELS."""
        what = f"coding tensor {self.name}: steps"
        pair = _pair_of_steps(steps, what)
        for label, part, step in (("temporal", self.temporal, pair[0]), ("spatial", self.spatial, pair[1])):
            if part is None:
                continue
            number = part / step
            largest, off = float(number.abs().max()), float((number - number.round()).abs().max())
            what_part = f"{what} of {step:g}: the {label} part"
            require(largest <= LEVELS + WHOLE, f"{what_part} has up to {largest:g}, limit {LEVELS}")
            require(off <= WHOLE, f"{what_part} is {off:.2g} off whole ones, limit {WHOLE:g}")
        object.__setattr__(self, "steps", pair)

    @property
    def codes(self) -> int:
        """Return K, the number of codes."""
        return self.temporal.shape[0]

    @property
    def bins(self) -> int:
        """Return Mt, the number of time bins of a block."""
        return self.temporal.shape[1]

    @property
    def rows(self) -> int:
        """Return Mr, the number of rows of a block."""
        return self.block[1]

    @property
    def columns(self) -> int:
        """Return Mc, the number of columns of a block."""
        return self.block[2]

    @property
    def block(self) -> tuple[int, int, int]:
        """Return the size of a block, (Mt, Mr, Mc)."""
        spatial = self.temporal.shape[2:] if self.spatial is None else self.spatial.shape[1:]
        return (self.bins, *(spatial or (1, 1)))

    @property
    def is_full(self) -> bool:
        """Return whether every entry of the tensor is a number of its own, not a product of factors."""
        return self.temporal.ndim == 4

    @cached_property
    def tensor(self) -> Tensor:
        """Return the full coding tensor, (K, Mt, Mr, Mc) float32."""
        return full_tensor(self.temporal, self.spatial)

    @cached_property
    def table(self) -> Tensor:
        """Return the tensor as `encode_photons` wants it, (Mr Mc Mt, K): a row for each place in the block,
        time fastest."""
        return photon_table(self.tensor)

    @property
    def compression_ratio(self) -> float:
        """Return the compression ratio Mt Mr Mc / K."""
        return self.bins * self.rows * self.columns / self.codes

    @property
    def parameters(self) -> int:
        """Count the numbers that make the tensor: K Mt Mr Mc if full, K Mt + K Mr Mc if separable."""
        return self.temporal.numel() + (0 if self.spatial is None else self.spatial.numel())

    @property
    def storage(self) -> int:
        """Count the numbers that a sensor stores where it computes the temporal part on the fly (supplement S.2): Mt/4
        + K Mr Mc for Fourier codes; else `parameters`."""
        temporal = self.temporal.numel() if self.computed is None else self.computed
        return temporal + self.parameters - self.temporal.numel()


def _pair_of_steps(steps: object, what: str) -> tuple[float, float]:
    pair = isinstance(steps, list | tuple) and len(steps) == 2
    require(pair, f"{what} {steps!r}, expected a pair of numbers above 0")
    temporal, spatial = (require_number(step, f"{what} of") for step in steps)  # type: ignore[attr-defined]
    good = 0 < temporal < math.inf and 0 < spatial < math.inf
    require(good, f"{what} of {temporal:g} and {spatial:g}, expected both above 0")
    return temporal, spatial


def full_tensor(temporal: Tensor, spatial: Tensor | None) -> Tensor:
    """Return C[k, t, r, c] = temporal[k, t] spatial[k, r, c], or the full tensor that `temporal` is: (K, Mt, Mr,
    Mc)."""
    if temporal.ndim == 4:
        return temporal
    wide = temporal[..., None, None]
    return wide if spatial is None else wide * spatial.unsqueeze(1)


def _per_pixel(coding: CodingTensor) -> None:
    require_kind(coding, CodingTensor, "codes of a pixel", " of `coding_tensor`")
    single = coding.rows == coding.columns == 1
    require(single, f"coding tensor {coding.name} is over {coding.rows} x {coding.columns} pixels, expected 1 x 1")


def as_tensor(values: Tensor | np.ndarray) -> Tensor:
    """Return a tensor as it is, and a numpy array as one, copied where it is read-only, as arrays of files are, and
    where its bytes are in another order than this computer's.

    Raises InputError for anything else.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        native = values.astype(values.dtype.newbyteorder("="), copy=False)
        return torch.from_numpy(np.require(native, requirements=["C", "W"]))
    if not isinstance(values, Tensor):
        got = f"an array of {values.dtype}" if isinstance(values, np.ndarray) else type(values).__name__
        raise InputError(f"expected a tensor or an array of numbers, got {got}")
    require(not values.is_complex(), f"expected real numbers, got {values.dtype}: real and imaginary part are two rows")
    return values


def encode(counts: Tensor | np.ndarray, coding: CodingTensor) -> Tensor:
    """Return y = C n of every pixel: counts (..., T) -> codes (..., K) float32, C over one pixel and all T bins.

    `counts` may be a numpy array. Raises InputError for another number of bins, and counts that are NaN or infinite,
    which their codes show. Counts below 0 are not looked for: that takes as long as the codes of few rows.
    Blocks of several pixels: `csph.codes.blocks.encode_blocks`.

    Examples
    --------
    Three photons in bin 0 and one in bin 1 are the sum of the first half, two in bin 3 that of the second:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> halves = s2s.CodingTensor("halves", np.array([[1, 1, 0, 0], [0, 0, 1, 1]]))
    >>> s2s.encode(np.array([3, 1, 0, 2]), halves).tolist()
    [4.0, 2.0]
    """
    _per_pixel(coding)
    counts = as_tensor(counts)
    if counts.ndim < 1 or counts.shape[-1] != coding.bins:
        shape = tuple(counts.shape)
        raise InputError(f"histogram of shape {shape}: the last axis must be the {coding.bins} bins of {coding.name}")
    if not counts.numel():
        return torch.empty((*counts.shape[:-1], coding.codes), device=counts.device)
    columns = coding.tensor.flatten(1).to(counts.device).T
    codes = by_pixels(lambda part: part.float() @ columns, counts.reshape(-1, coding.bins))
    finite = not counts.is_floating_point() or bool(codes.isfinite().all())
    require(finite, f"codes of {coding.name} are not finite: the counts hold NaN or infinite values")
    return codes.reshape(*counts.shape[:-1], coding.codes)


def encode_timestamps(timestamps: Tensor | np.ndarray, offsets: Tensor | np.ndarray, coding: CodingTensor) -> Tensor:
    """Return the sum of the columns of C that a pixel's detections name, without a histogram: (P, K) float32.

    timestamps (N,) bin of each detection, any integer type, pixel after pixel; offsets (P + 1,) where each pixel's
    begin, and the end: 0 .. N; both may be numpy arrays, as of `Histogram.timestamps`. A pixel without detections gives
    zeros. Raises InputError for bad offsets or bins.

    Examples
    --------
    Two pixels, of which the first has detections in bins 0, 0 and 3, and the second one in bin 2:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> halves = s2s.CodingTensor("halves", np.array([[1, 1, 0, 0], [0, 0, 1, 1]]))
    >>> s2s.encode_timestamps(np.array([0, 0, 3, 2]), np.array([0, 3, 4]), halves).tolist()
    [[2.0, 1.0], [0.0, 1.0]]
    """
    _per_pixel(coding)
    timestamps, offsets = as_tensor(timestamps), as_tensor(offsets)
    table = coding.table.to(timestamps.device)
    codes = encode_photons(timestamps, offsets, table, coding.block, (coding.bins, 1, 1), name=coding.name)
    return codes.flatten(1)
