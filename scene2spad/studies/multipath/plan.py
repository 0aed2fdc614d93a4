"""Define what `study multipath` runs: scenes, photon levels, methods. Plain data."""

from __future__ import annotations

from dataclasses import dataclass, replace

from render.settings import RenderSettings
from scene2spad.networks.registry import ModelSpec

BACKGROUNDS = (50.0, 10.0, 1.0)
LEVELS = tuple((signal, background) for signal in (100.0, 50.0, 10.0) for background in BACKGROUNDS)
HEADLINE = (50.0, 50.0)
FILTER, PEAK = "log-matched", "argmax"
MODELS = (
    ModelSpec("learned", (256, 4, 4)),
    ModelSpec("learned", (1024, 4, 4)),
    ModelSpec("learned", (1024, 2, 2)),
    ModelSpec("fourier", (1024, 1, 1)),
    ModelSpec("none"),
)
# The same designs trained with indirect light, too
MIXED = tuple(replace(one, trained_on="mixed") for one in MODELS)
# Trained with random delays: right at every depth
DELAYED = (
    ModelSpec("learned", (1024, 2, 2), time_offset_m=12, trained_on="mixed"),
    ModelSpec("learned", (256, 4, 4), time_offset_m=8, trained_on="mixed", seed=42),
)
# What of a render is sensed: the same surfaces, truth and mean counts.
LIGHTS: dict[str, str] = {"flood": "direct and indirect light", "direct": "direct light alone"}


@dataclass(frozen=True)
class Plan:
    """scenes  by name and seed, as `render` takes them
    size       (width, height), multiples of the blocks of all models
    """

    scenes: tuple[tuple[str, int], ...]
    size: tuple[int, int]
    settings: RenderSettings
    levels: tuple[tuple[float, float], ...] = LEVELS


SCENES = (
    ("rooms/test/0", 0),
    ("rooms/test/6", 0),
    ("rooms/test/12", 0),
    ("living-room", 0),
    ("gallery", 0),
    ("clutter/test/0", 0),
)
PLANS = {
    "smoke": Plan(SCENES[:1], (24, 20), RenderSettings(bounces=2, spp=16, ambient=True), (HEADLINE,)),
    "laptop": Plan(SCENES, (88, 72), RenderSettings(error=0.02, ambient=True)),
    "paper": Plan(SCENES, (176, 144), RenderSettings(error=0.01, ambient=True)),
}
