"""`Design`: which coding tensor, told in a few words, and what it costs. Needs no torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from scenes.errors import InputError, did_you_mean, normalise_fields, require, require_number

CODES = ("learned", "fourier", "gray", "coarse", "hadamard", "random", "fourier-published", "gray-published")
_QUARTER_WAVE = ("fourier", "gray", "fourier-published", "gray-published")
_COUNTED = ("coarse", "hadamard")  # an entry follows from its place: nothing is stored
OWN = "own"  # fixed codes of a user's file (`csph.codes.files.own_codes`), which have no other name
_FREE = ("learned", "random", OWN)  # K is limited by the block alone, and every entry may be a number of its own
MAX_BINS = 65536  # of a block: as many as a sensor has
MAX_PARAMETERS = 1 << 28  # 1 GiB: a full tensor of as many codes as a block of 1024 x 4 x 4 has counts


@dataclass(frozen=True)
class Design:
    """K codes over blocks of Mt bins x Mr rows x Mc columns.

    code             temporal part: learned, or fixed to one of the codes of `csph.codes.temporal`, or to OWN codes
    block            (Mt, Mr, Mc)
    codes            K
    full             every entry a number of its own, instead of temporal x spatial (learned, random and own alone)
    spatial_learned  the spatial part of a fixed temporal code is learned ("fourier+learned")
    zero_mean        rows are held to sum to zero over Mt; None: all but coarse histograms, as published, and own codes,
                     which stay as their file has them
    sha256           of the file of own codes; empty for others

    Raises InputError for an unknown code, fields of another kind, a number of codes that is not whole or more than it
    has, a block of more than MAX_BINS bins, and more than MAX_PARAMETERS parameters.

    Examples
    --------
    A block of 16 bins x 2 x 2 pixels holds 64 counts, 8 times as many as its codes. The temporal and the spatial part
    of these are 8 x 16 + 8 x 2 x 2 = 160 numbers:

    >>> import scene2spad as s2s
    >>> design = s2s.Design.named("learned", (16, 2, 2), compression=8)
    >>> design.codes, design.parameters
    (8, 160)
    >>> coding = s2s.make_coding(design)  # where training begins
    >>> tuple(coding.temporal.shape), tuple(coding.spatial.shape)
    ((8, 16), (8, 2, 2))
    """

    code: str = "learned"
    block: tuple[int, int, int] = (256, 4, 4)
    codes: int = 32
    full: bool = False
    spatial_learned: bool = True
    zero_mean: bool | None = None
    sha256: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "block", _block_of(self.block))
        meant = did_you_mean(str(self.code), CODES)
        word = isinstance(self.code, str) and self.code in (*CODES, OWN)
        require(word, f"design {self.code!r} is unknown{meant}, expected one of {', '.join(CODES)}")
        most = self.size if self.code in _FREE else self.block[0]
        expected = f"expected a whole number from 1 to {most} for {self.code} codes"
        whole = isinstance(self.codes, Integral) and not isinstance(self.codes, bool) and 1 <= self.codes <= most
        require(whole, f"{self.codes!r} codes over a block of {self.block_name}, {expected}")
        normalise_fields(self, "design")
        known = self.zero_mean is None or isinstance(self.zero_mean, bool)
        require(known, f"design: zero_mean {self.zero_mean!r}, expected True, False or None")
        require(self.code in _FREE or not self.full, f"design {self.code}: full coding tensors are learned or random")
        hashed = isinstance(self.sha256, str) and bool(self.sha256) == (self.code == OWN)
        require(hashed, f"design {self.code}: sha256 {self.sha256!r}, expected that of a file of own codes alone")
        size = f"{'full ' if self.full else ''}{self.code}, {self.codes} codes over a block of {self.block_name}"
        large = f"design {size}: {self.parameters} parameters are above the limit of {MAX_PARAMETERS}"
        require(self.parameters <= MAX_PARAMETERS, large)
        several = self.full == (math.prod(self.block[1:]) > 1) and not self.spatial_learned
        require(
            self.code != OWN or several, f"design {OWN}: codes over several pixels are full, and nothing is learned"
        )
        if self.zero_mean is None:
            object.__setattr__(self, "zero_mean", self.code not in ("coarse", OWN))

    @classmethod
    def named(
        cls,
        name: str,
        block: tuple[int, int, int],
        *,
        codes: int | None = None,
        compression: float | None = None,
        full: bool = False,
    ) -> Design:
        """Return from a name as the command line has it: a code, or CODE+learned with a learned spatial part.

        K is given, or follows from the compression ratio Mt Mr Mc / K, which must divide. A fixed code alone has no
        spatial part: over several pixels it needs +learned. Raises InputError.
        """
        require(isinstance(name, str), f"design {name!r}: expected CODE or CODE+learned")
        block = _block_of(block)
        code, plus, second = name.partition("+")
        require(not plus or second == "learned", f"design {name!r}: expected CODE or CODE+learned")
        known = f"expected one of {', '.join(CODES)}, or CODE+learned"
        require(code in CODES, f"design {name!r} is unknown{did_you_mean(code, CODES)}, {known}")
        if codes is None and compression is not None:
            codes = codes_for(block, compression)
        elif codes is None or compression is not None:
            raise InputError(f"design {name!r}: give the number of codes or the compression ratio, one of them")
        design = cls(code, block, codes, full=full, spatial_learned=code == "learned" or bool(plus))
        alone = code in ("learned", "random") or plus or math.prod(block[1:]) == 1
        cure = f"has no spatial part: {code}+learned has one, or take a block of one pixel, {block[0]} x 1 x 1"
        require(bool(alone), f"design {name!r} over a block of {design.block_name} {cure}")
        return design

    @property
    def size(self) -> int:
        """Return M = Mt Mr Mc, the number of counts of one block."""
        return math.prod(self.block)

    @property
    def block_name(self) -> str:
        """Return the block in words, as in "256 x 4 x 4"."""
        return " x ".join(map(str, self.block))

    @property
    def has_spatial(self) -> bool:
        """Return whether there is a spatial factor: a separable tensor over more than one pixel."""
        return not self.full and math.prod(self.block[1:]) > 1

    @property
    def name(self) -> str:
        """Return the name of the design, as in "fourier+learned 256x4x4 K32"; own codes have the beginning of their
        file's hash in it."""
        plus = "+learned" if self.has_spatial and self.spatial_learned and self.code != "learned" else ""
        code = f"{OWN}-{self.sha256[:8]}" if self.code == OWN else self.code
        return f"{'full ' if self.full else ''}{code}{plus} {'x'.join(map(str, self.block))} K{self.codes}"

    @property
    def learned(self) -> tuple[str, ...]:
        """Name the parts that training changes: temporal, spatial."""
        spatial = self.has_spatial and (self.code == "learned" or self.spatial_learned)
        return (("temporal",) if self.code == "learned" else ()) + (("spatial",) if spatial else ())

    @property
    def compression_ratio(self) -> float:
        """Return the compression ratio Mt Mr Mc / K."""
        return self.size / self.codes

    @property
    def periodic(self) -> bool:
        """Return whether the temporal code is a Fourier series, which knows no first bin."""
        return self.code in _QUARTER_WAVE

    @property
    def spatial_parameters(self) -> int:
        """Count the parameters of the spatial factor, K Mr Mc; 0 without one."""
        return self.codes * math.prod(self.block[1:]) if self.has_spatial else 0

    @property
    def parameters(self) -> int:
        """Count the parameters: K Mt Mr Mc of a full tensor, K Mt + K Mr Mc of a separable one, K Mt over single
        pixels."""
        return self.codes * (self.size if self.full else self.block[0]) + self.spatial_parameters

    @property
    def computed(self) -> int | None:
        """Count the numbers from which the temporal part is computed on the fly: a quarter wave, Mt/4, for Fourier
        codes whatever K (supplement S.2), none for gates and Walsh functions; None where every entry is stored."""
        if self.code in _QUARTER_WAVE:
            return math.ceil(self.block[0] / 4)
        return 0 if self.code in _COUNTED else None

    @property
    def storage(self) -> int:
        """Count the numbers that a sensor stores: `parameters`, with the temporal part computed on the fly where it can
        be."""
        return self.parameters if self.computed is None else self.computed + self.spatial_parameters


def _block_of(block: Sequence[int] | np.ndarray) -> tuple[int, int, int]:
    """Return a block as three of Python's whole numbers. Raises InputError for anything else."""
    block = block.tolist() if isinstance(block, np.ndarray) else block
    sides = list(block) if isinstance(block, list | tuple) else []
    good = len(sides) == 3 and all(isinstance(n, Integral) and not isinstance(n, bool) and int(n) >= 1 for n in sides)
    require(good, f"block {block!r}: expected three positive whole numbers of bins, rows and columns")
    bins, rows, columns = map(int, sides)
    require(bins <= MAX_BINS, f"block {' x '.join(map(str, sides))}: {bins} bins are above the limit of {MAX_BINS}")
    return bins, rows, columns


def codes_for(block: tuple[int, int, int], compression: float) -> int:
    """Return K = Mt Mr Mc / CR. Raises InputError unless it is a whole number of at least 1."""
    size, compression = math.prod(block), require_number(compression, "compression ratio")
    whole = math.isfinite(compression) and compression > 0 and size % compression == 0 and size >= compression
    message = f"compression ratio {compression:g} does not divide the {size} counts of a block of"
    require(whole, f"{message} {' x '.join(map(str, block))}")
    return int(size / compression)
