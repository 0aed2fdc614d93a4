"""Define what `study depth-offset` runs: models, photon levels, offsets. Plain data."""

from __future__ import annotations

from dataclasses import dataclass

from csph.levels import PHOTON_LEVELS
from scene2spad.networks.registry import ModelSpec
from scene2spad.studies.depth_offset.tables import RATIO_LEVELS

OFFSET_M = 7.0
CURE_M = 8.0  # random time offsets that move training depths over the whole range
TEST_SET, RELIEF = "tabletop", "middlebury"
LONG = (("learned", (1024, 1, 1)), ("learned", (1024, 4, 4)))
DESIGNS = (("fourier", (1024, 1, 1)), *LONG, ("learned", (256, 4, 4)))
SHOWN_VIEWS, SHOWN_LEVELS = (0, 1), ((10.0, 10.0), (10.0, 200.0))  # of Figure 3

Level = tuple[float, float]


@dataclass(frozen=True)
class Plan:
    """Extent of the study. `compressions` and `seeds` (at 128x; one elsewhere) decide the models; None views are all.

    Beside the headline, which takes every model and level: `space_levels` of ray and rigid offsets, `relief_levels` of
    the reliefs, `pair_levels` of the photographs, each with seed 0 alone. Beyond what was decided beforehand, up to the
    end of the range: `end_m`, at which every seed at 128x and every arm of `depth_offset_range` is measured (the last
    one leaves the farthest pixel in range), and `walls_m`, a wall at each depth.
    """

    compressions: tuple[int, ...] = (64, 128)
    seeds: int = 3
    designs: tuple[tuple[str, tuple[int, int, int]], ...] = DESIGNS
    baselines: tuple[str, ...] = ("none", "peak")
    cures: tuple[tuple[str, tuple[int, int, int]], ...] = LONG
    levels: tuple[Level, ...] = RATIO_LEVELS
    views: int | None = None
    size: tuple[int, int] | None = None
    sweep_m: tuple[float, ...] = (*(i / 2 for i in range(17)), 9.0, 10.0, 10.5, 11.0, 11.5, 12.0)
    end_m: tuple[float, ...] = (0.0, 9.0, 10.0, 11.0, 12.0)
    walls_m: tuple[float, ...] = (0.4, *map(float, range(1, 12)), 12.0, 12.5, 13.0, 13.5, 14.0, 14.5)
    wall_level: Level = (50.0, 50.0)
    sweep_levels: tuple[Level, ...] = SHOWN_LEVELS[:1]
    sweep_views: int | None = 3
    space_levels: tuple[Level, ...] = SHOWN_LEVELS[:1]
    relief: bool = True
    relief_levels: tuple[Level, ...] = SHOWN_LEVELS
    pairs: int | None = None
    pair_levels: tuple[Level, ...] = SHOWN_LEVELS

    @property
    def headline(self) -> tuple[ModelSpec, ...]:
        """Every design at every compression and seed, then the lines without codes."""
        coded = [
            ModelSpec(design, block, ratio, seed)
            for ratio in self.compressions
            for design, block in self.designs
            for seed in range(self.seeds if ratio == 128 else 1)
        ]
        return (*coded, *(ModelSpec(design) for design in self.baselines))

    @property
    def every_seed(self) -> tuple[ModelSpec, ...]:
        """Every seed at 128x, and the lines without codes."""
        return tuple(one for one in self.headline if one.compression == 128 or not one.coded)

    @property
    def cured(self) -> tuple[ModelSpec, ...]:
        return tuple(ModelSpec(design, block, 128, time_offset_m=CURE_M) for design, block in self.cures)

    @property
    def wanted(self) -> tuple[ModelSpec, ...]:
        return (*self.headline, *self.cured)


SMOKE = Plan(
    compressions=(128,),
    seeds=1,
    designs=LONG[:1],
    baselines=(),
    cures=LONG[:1],
    levels=SHOWN_LEVELS,
    views=2,
    size=(24, 20),
    sweep_m=(0.0, 4.0, 8.0),
    end_m=(0.0, 12.0),
    walls_m=(1.0, 14.5),
    sweep_views=1,
    relief=False,
    pairs=1,
    pair_levels=SHOWN_LEVELS[:1],
)


def plan_of(preset: str, full: bool) -> Plan:
    """Return the plan of a preset; `full`: all 16 levels, 32x and 256x too, and the whole test set in the sweep."""
    if preset == "smoke":
        return SMOKE
    if not full:
        return Plan()
    return Plan(
        compressions=(32, 64, 128, 256),
        levels=PHOTON_LEVELS,
        sweep_levels=SHOWN_LEVELS,
        sweep_views=None,
        relief_levels=PHOTON_LEVELS,
        pair_levels=PHOTON_LEVELS,
    )
