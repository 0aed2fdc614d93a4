"""Define what the studies `spatial-block`, `tensor-size` and `fourier` run (supplement S.3.1 to S.3.3): models, levels,
and the conclusions of the paper as claims that numbers decide. Plain data."""

from __future__ import annotations

from dataclasses import dataclass

from scene2spad.networks.registry import ModelSpec
from scene2spad.studies.depth_offset.tables import RATIO_LEVELS

Level = tuple[float, float]

BETTER, ALIKE = "has the smaller error than", "is comparable with"
ALIKE_WITHIN = 0.25  # of the second's error: what `comparable` is taken to mean
LEVELS: tuple[Level, ...] = (*RATIO_LEVELS, (50.0, 500.0))
SIDES = (1, 2, 4, 8)
FIRST, LAST = (10.0, 10.0), (10.0, 1000.0)
MIDDLE = (50.0, 500.0)


@dataclass(frozen=True)
class Sheet:
    """One figure at one compression: models from left to right, and the levels of the depth images beneath."""

    figure: str
    title: str
    wanted: tuple[ModelSpec, ...]
    shown: tuple[Level, ...]

    @property
    def compression(self) -> int:
        return self.wanted[0].compression


@dataclass(frozen=True)
class Claim:
    """A conclusion of the paper: the first model stands in `relation` to the second at a group of levels."""

    text: str
    first: ModelSpec
    relation: str
    second: ModelSpec
    levels: str = "all"


def _learned(bins: int, side: int, ratio: int, *, full: bool = False) -> ModelSpec:
    return ModelSpec("learned", (bins, side, side), ratio, full=full)


def _spatial(ratio: int, preset: str) -> tuple[Sheet, ...]:
    # 1024 x 8 x 8 at 32x has 2,048 codes: a GPU's work
    long_sides = SIDES[:3] if ratio == 32 and preset != "paper" else SIDES
    return tuple(
        Sheet(
            figure,
            f"spatial block, {bins} time bins",
            tuple(_learned(bins, side, ratio) for side in sides),
            (FIRST, LAST),
        )
        for figure, bins, sides in (("6", 256, SIDES), ("7", 1024, long_sides))
    )


def _size(ratio: int, preset: str) -> tuple[Sheet, ...]:
    wanted = (
        _learned(1024, 4, ratio, full=True),
        _learned(1024, 4, ratio),
        _learned(256, 4, ratio, full=True),
        _learned(256, 4, ratio),
        _learned(64, 4, ratio),
        _learned(16, 4, ratio),
    )
    figure = {32: "8-9", 128: "8-10"}.get(ratio, "8")
    return (Sheet(figure, "size of the coding tensor, 4 x 4 pixels", wanted, (FIRST, LAST, MIDDLE)),)


def _fourier(ratio: int, preset: str) -> tuple[Sheet, ...]:
    wanted = (
        _learned(256, 4, ratio),
        ModelSpec("fourier+learned", (256, 4, 4), ratio),
        _learned(256, 2, ratio),
        ModelSpec("fourier+learned", (256, 2, 2), ratio),
        _learned(256, 1, ratio),
        ModelSpec("fourier", (256, 1, 1), ratio),
        ModelSpec("fourier", (1024, 1, 1), ratio),
        ModelSpec("gray", (1024, 1, 1), ratio),
    )
    return (Sheet("11" if ratio == 64 else "12", "learned and Fourier temporal codes", wanted, (MIDDLE, LAST)),)


_SHEETS = {
    "spatial-block": (_spatial, (32, 64, 128)),
    "tensor-size": (_size, (32, 64, 128)),
    "fourier": (_fourier, (64, 128)),
}
_SMOKE = {
    "spatial-block": (_learned(256, 1, 128), _learned(256, 2, 128)),
    "tensor-size": (_learned(256, 4, 128), _learned(64, 4, 128)),
    "fourier": (ModelSpec("fourier", (1024, 1, 1), 128), ModelSpec("gray", (1024, 1, 1), 128)),
}


def sheets_of(study: str, preset: str, full: bool) -> tuple[Sheet, ...]:
    """Return the figures of a study: at 128x, with `full` at every compression of the paper; `smoke` has two models."""
    make, compressions = _SHEETS[study]
    if preset == "smoke":
        (first, *_) = make(128, preset)
        return (Sheet(first.figure, first.title, _SMOKE[study], first.shown),)
    return tuple(sheet for ratio in (compressions if full else (128,)) for sheet in make(ratio, preset))


CLAIMS: dict[str, tuple[Claim, ...]] = {
    "spatial-block": (
        Claim("single pixels fail at 128x, 256 bins", _learned(256, 4, 128), BETTER, _learned(256, 1, 128)),
        Claim("neighbours help at 128x, low SBR", _learned(256, 4, 128), BETTER, _learned(256, 2, 128), "low_sbr"),
        Claim("and with 1024 bins", _learned(1024, 4, 128), BETTER, _learned(1024, 1, 128), "low_sbr"),
        Claim("8 x 8 blurs at 128x, high SBR", _learned(256, 4, 128), BETTER, _learned(256, 8, 128), "high_sbr"),
        Claim("the block matters little at 32x", _learned(256, 4, 32), ALIKE, _learned(256, 1, 32), "high_sbr"),
    ),
    "tensor-size": (
        Claim("2,560 parameters do at 32x", _learned(64, 4, 32), ALIKE, _learned(1024, 4, 32, full=True)),
        Claim("8,704 parameters do at 128x", _learned(256, 4, 128), ALIKE, _learned(1024, 4, 128, full=True)),
        Claim(
            "size tells at 128x, high SBR",
            _learned(1024, 4, 128, full=True),
            BETTER,
            _learned(64, 4, 128),
            "high_sbr",
        ),
    ),
    "fourier": (
        Claim(
            "Fourier temporal codes do at 64x",
            ModelSpec("fourier+learned", (256, 4, 4), 64),
            ALIKE,
            _learned(256, 4, 64),
        ),
        Claim(
            "learned ones win at 128x, low SBR, 2 x 2",
            _learned(256, 2, 128),
            BETTER,
            ModelSpec("fourier+learned", (256, 2, 2), 128),
            "low_sbr",
        ),
        Claim("4 x 4 is best at 128x", _learned(256, 4, 128), BETTER, ModelSpec("fourier", (1024, 1, 1), 128)),
        Claim("also beside Gray Fourier", _learned(256, 4, 128), BETTER, ModelSpec("gray", (1024, 1, 1), 128)),
    ),
}
