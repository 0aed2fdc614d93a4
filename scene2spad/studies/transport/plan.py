"""Define what `study transport` runs, and the names of its steps, designs and verdicts. Plain data."""

from __future__ import annotations

from dataclasses import dataclass, field

from render.settings import RenderSettings
from scene2spad.networks.registry import ModelSpec
from scenes.model import LaserMode

# Each step adds one thing to the one before it; all see the same surfaces and are scaled to the same mean counts.
STEPS: dict[str, str] = {
    "rgbd": "RGB-D rates",
    "cosine": "+ cosine",
    "footprint": "+ footprint, mixed returns",
    "indirect": "+ indirect light",
    "ambient": "+ rendered ambient",
}
FIRST, *LATER = STEPS
LASERS: tuple[LaserMode, ...] = ("flood", "scan")
LEVELS = ((10.0, 10.0), (10.0, 200.0), (50.0, 50.0))
UNCOMPRESSED = "log-matched"
# Of one pixel and all bins, at 128x and 64x, decoded by correlation.
CODES = ("fourier-8", "gray-8", "coarse-8", "hadamard-8", "fourier-16", "gray-16", "coarse-16")
SMOKE_CODES = CODES[:3]
CHECKED = (UNCOMPRESSED, "fourier-8", "gray-8")  # on planned and on full renders
MODELS = (
    ModelSpec("none"),
    ModelSpec("fourier", (1024, 1, 1)),
    ModelSpec("gray", (1024, 1, 1)),
    ModelSpec("learned", (1024, 1, 1)),
    ModelSpec("learned", (1024, 4, 4)),
    ModelSpec("learned", (256, 4, 4)),
    ModelSpec("fourier+learned", (256, 4, 4)),
)
LIMIT = 0.02  # relative, of the MAE on a planned render from that on a full one

KEPT, REVERSED, OPEN = "kept", "reversed", "not decided"
HOLDS, FAILS = "holds", "does not hold"


@dataclass(frozen=True)
class Places:
    """One view of each of the first places of a set; `sun`: under sun and sky instead of lights of their own."""

    set: str
    count: int
    sun: bool = False


@dataclass(frozen=True)
class Plan:
    """places  one view each, as views of one place are not independent
    size       (width, height), multiples of the blocks of all models
    full       a render with everything in it, no choice of which is left to the planner
    planned    one whose choices are the planner's
    draws      of photons, on which planned and full renders are compared
    most_draws where those leave it open
    """

    places: tuple[Places, ...]
    size: tuple[int, int]
    full: RenderSettings
    planned: RenderSettings = field(default_factory=RenderSettings)
    codes: tuple[str, ...] = CODES
    draws: int = 16
    most_draws: int = 64


def _full(bounces: int, grid: int, spp: int, ambient_spp: int) -> RenderSettings:
    return RenderSettings(
        bounces=bounces, grid=grid, spp=spp, adaptive=False, edge_threshold=0.0, ambient=True, ambient_spp=ambient_spp
    )


_SMOKE_PLANNED = RenderSettings(error=0.1)
# nothing else lights the still lifes
PLANS = {
    "smoke": Plan(
        (Places("tabletop", 2, sun=True),),
        (24, 20),
        _full(2, 4, 16, 16),
        _SMOKE_PLANNED,
        codes=SMOKE_CODES,
        draws=2,
        most_draws=2,
    ),
    "laptop": Plan((Places("tabletop", 8, sun=True), Places("rooms/test", 4)), (88, 72), _full(8, 16, 512, 1024)),
    "paper": Plan((Places("tabletop", 8, sun=True), Places("rooms/test", 16)), (176, 144), _full(16, 16, 1024, 4096)),
}
