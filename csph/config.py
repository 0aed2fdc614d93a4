"""Everything that decides a trained network, in frozen dataclasses that JSON holds; the presets."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from csph.design import Design
from csph.metrics import TRAIN_LEVELS
from scenes.errors import InputError, require
from spad.sensor import Sensor

Network = Literal["compact", "published", "published-signed"]
Front = Literal["codes", "counts", "matched", "peak"]
NETWORKS: tuple[str, ...] = ("compact", "published", "published-signed")
FRONTS: tuple[str, ...] = ("codes", "counts", "matched", "peak")
PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")


@dataclass(frozen=True)
class ModelConfig:
    """What stands between counts and depth.

    front    what the network sees: the back-projection of codes; without compression the counts, or their correlation
             with the pulse (`spad.matching.normalised_correlation`); or one-hot argmax
    design   the codes, with `front` = "codes"
    layer    switches of `csph.layer.LayerOptions` that differ from the published layer
    network  compact; published; or published with logits of any sign, which cannot die
    sensor   whose histograms it takes
    """

    front: Front = "codes"
    design: Design | None = None
    layer: dict[str, bool] = field(default_factory=dict)
    network: Network = "compact"
    sensor: Sensor = field(default_factory=Sensor)

    def __post_init__(self) -> None:
        require(self.front in FRONTS, f"front {self.front!r} is unknown, expected one of {', '.join(FRONTS)}")
        require(self.network in NETWORKS, f"network {self.network!r} is unknown, expected {', '.join(NETWORKS)}")
        switches = isinstance(self.layer, dict) and all(isinstance(value, bool) for value in self.layer.values())
        require(switches, f"layer {self.layer!r}: expected switches by name")
        coded = self.front == "codes"
        require(coded == (self.design is not None), f"front {self.front}: {'a' if coded else 'no'} design is expected")
        if self.design is not None:
            bins, block = self.sensor.bins, self.design.block
            require(bins % block[0] == 0, f"blocks of {block[0]} bins do not divide the sensor's {bins}")

    @property
    def block(self) -> tuple[int, int, int]:
        """(Mt, Mr, Mc); one pixel and bin without codes."""
        return (1, 1, 1) if self.design is None else self.design.block

    @property
    def name(self) -> str:
        uncoded = {"counts": "no compression", "matched": "no compression", "peak": "peak"}
        return f"{uncoded[self.front] if self.design is None else self.design.name}, {self.network}"


@dataclass(frozen=True)
class TrainConfig:
    """Every number of a run.

    model         the network and its codes
    seed          of weights, crops, photon levels and noise
    epochs, steps_per_epoch    an epoch ends in validation, and is what an interrupted run goes back to
    batch, crop   patches a step, and their side in pixels
    rate, decay, decay_steps   Adam's learning rate, times `decay` every `decay_steps` steps
    tv_weight, tv_start        weight of the mean total variation of depth / range, and the step it comes in at
    levels        mean (signal, background) photons, one drawn for each patch
    time_offset_m random delay, uniform from 0 to this, of every patch: 0 is off, as published
    validation_views           frames of the validation scenes
    precision     Lightning's name; bf16-mixed on GPUs that have it
    threads       of a CPU (0: as many as there are); the same number gives the same bytes
    data          what it was trained on: path and SHA-256, filled in by `csph.training.train`
    """

    model: ModelConfig = field(default_factory=lambda: ModelConfig(design=Design()))
    preset: str = "laptop"
    seed: int = 0
    epochs: int = 12
    steps_per_epoch: int = 250
    batch: int = 6
    crop: int = 16
    rate: float = 2e-3
    decay: float = 0.75
    decay_steps: int = 250
    tv_weight: float = 0.0
    tv_start: int = 500
    levels: tuple[tuple[float, float], ...] = TRAIN_LEVELS
    time_offset_m: float = 0.0
    validation_views: int = 18
    precision: str = "32-true"
    threads: int = 0
    data: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("epochs", "steps_per_epoch", "batch", "crop", "decay_steps", "validation_views"):
            require(getattr(self, name) >= 1, f"training: {name} {getattr(self, name)} is below 1")
        require(0 < self.rate < 1, f"training: learning rate {self.rate:g} is outside 0 to 1")
        require(0 < self.decay <= 1, f"training: decay {self.decay:g} is outside (0, 1]")
        require(self.tv_weight >= 0, f"training: weight {self.tv_weight:g} of the total variation is negative")
        require(0 <= self.time_offset_m < math.inf, f"training: time offset {self.time_offset_m:g} m is negative")
        require(self.precision in PRECISIONS, f"precision {self.precision!r}: expected {', '.join(PRECISIONS)}")
        rows, columns = self.model.block[1:]
        fits = self.crop % rows == 0 and self.crop % columns == 0
        require(fits, f"training: crops of {self.crop} pixels are not tiled by blocks of {rows} x {columns}")
        require(bool(self.levels), "training: no photon level")

    @property
    def steps(self) -> int:
        return self.epochs * self.steps_per_epoch

    def to_dict(self) -> dict:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> TrainConfig:
        """Raises InputError for an entry that is missing or unknown."""
        try:
            model = dict(values["model"])
            design = model.pop("design")
            sensor = Sensor.from_dict(model.pop("sensor"))
            if design is not None:
                design = Design(**{**design, "block": tuple(design["block"])})
            levels = tuple(tuple(level) for level in values["levels"])
            return cls(**{**values, "model": ModelConfig(design=design, sensor=sensor, **model), "levels": levels})
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"its configuration cannot be read ({' '.join(str(error).split())[:120]})") from None


_STEPS_PER_PUBLISHED_EPOCH = 3463  # 13,851 frames in batches of 4
# 1e-5 of a sum over 4 crops of 32 x 32, beside a KL divergence divided by 1024 bins
PUBLISHED_TV = 1e-5 * 1024 * 4 * 32 * 32

PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"epochs": 2, "steps_per_epoch": 4, "batch": 2, "crop": 8, "validation_views": 1, "decay_steps": 4},
    "laptop": {},
    "paper": {
        # half a published epoch: validated and kept twice in each
        "epochs": 60,
        "steps_per_epoch": math.ceil(_STEPS_PER_PUBLISHED_EPOCH / 2),
        "batch": 4,
        "crop": 32,
        "rate": 1e-3,
        "decay": 0.9,
        "decay_steps": _STEPS_PER_PUBLISHED_EPOCH,
        "validation_views": 2777,
    },
}


def preset(name: str, model: ModelConfig, **changes: Any) -> TrainConfig:
    """A preset's configuration with a model; `changes` that are None leave it as it is.

    smoke (seconds), laptop (compact, two cores), paper (the published network and schedule). Without compression, and
    of one-hot peaks, `paper` has the published total variation and a tenth of the learning rate.
    """
    require(name in PRESETS, f"preset {name!r} is unknown, expected one of {', '.join(PRESETS)}")
    known = {item.name for item in fields(TrainConfig)}
    given = {key: value for key, value in changes.items() if value is not None}
    require(given.keys() <= known, f"unknown options {', '.join(sorted(given.keys() - known))}")
    oracle = {"rate": 1e-4, "tv_weight": PUBLISHED_TV} if name == "paper" and model.front != "codes" else {}
    return TrainConfig(**{"model": model, "preset": name, **PRESETS[name], **oracle, **given})
