"""Define what `study chip` runs: models, sets, photon levels. Plain data."""

from __future__ import annotations

from dataclasses import dataclass, replace

from csph.levels import PHOTON_LEVELS
from scene2spad.networks.registry import ModelSpec

Level = tuple[float, float]
TEST_SET = "tabletop"
WITHIN = 0.02  # of the float model's MAE: what the chip may lose
HEADROOM_BITS = 1  # that float models are compiled with as well, and by `ultraphase compile` unless asked otherwise
PAIR_LEVELS: tuple[Level, ...] = ((10.0, 10.0), (10.0, 200.0), (50.0, 50.0), (50.0, 500.0))
ROOM_VIEWS, ROOM_SIZE = 8, (64, 64)
MAIN = (
    ModelSpec("fourier+learned", (256, 2, 2), 128),
    ModelSpec("fourier+learned", (256, 2, 2), 64),
    ModelSpec("fourier", (1024, 1, 1), 128),
    ModelSpec("fourier", (1024, 1, 1), 64),
)
TRAINED_FOR_CHIP = tuple(replace(one, int8=True) for one in MAIN)
OTHERS = (
    ModelSpec("gray", (1024, 1, 1), 128),
    ModelSpec("fourier+learned", (256, 4, 4), 128),
    ModelSpec("fourier", (256, 1, 1), 128),
)


@dataclass(frozen=True)
class Plan:
    """Extent of the study: `models` at every level of `levels` on the still lifes, at PAIR_LEVELS on rooms and pairs.

    views, size   of each set; None: all, as they come
    """

    models: tuple[ModelSpec, ...] = (*MAIN, *TRAINED_FOR_CHIP, *OTHERS)
    levels: tuple[Level, ...] = PHOTON_LEVELS
    other_levels: tuple[Level, ...] = PAIR_LEVELS
    views: int | None = None
    size: tuple[int, int] | None = None
    rooms: int = ROOM_VIEWS
    pairs: int | None = None


SMOKE = Plan(
    models=(MAIN[0], MAIN[2], TRAINED_FOR_CHIP[2]),
    levels=PAIR_LEVELS[:2],
    other_levels=PAIR_LEVELS[:1],
    views=2,
    size=(24, 16),
    rooms=1,
    pairs=1,
)


def plan_of(preset: str) -> Plan:
    return SMOKE if preset == "smoke" else Plan()
