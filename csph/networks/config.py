"""Everything that decides a trained network, in frozen dataclasses that JSON holds; the presets."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from csph.codes.design import Design
from csph.codes.temporal import MAX_SEED
from csph.layer_options import STARTS, SpatialStart, check_switches
from csph.levels import CONTINUOUS, TRAIN_LEVELS, Levels, checked_levels
from csph.networks.grid import GRIDS, Grid
from csph.networks.posterior import Decoder
from scenes.errors import InputError, normalise_fields, require, require_choice, require_number
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from spad.sensor.model import Sensor

Network = Literal["compact", "blockwise", "refined", "periodic", "published", "published-signed"]
Front = Literal["codes", "counts", "matched", "peak"]
HELD: dict[str, tuple[str, ...]] = {  # our networks, and those whose weights each holds
    "compact": ("compact",),
    "blockwise": ("compact", "blockwise"),
    "refined": ("compact", "blockwise", "refined"),
    "periodic": ("compact", "periodic"),
}
NETWORKS: tuple[str, ...] = (*HELD, "published", "published-signed")
FRONTS: tuple[str, ...] = ("codes", "counts", "matched", "peak")
Optimiser = Literal["adam", "muon"]
OPTIMISERS: tuple[str, ...] = ("adam", "muon")
Schedule = Literal["steps", "cosine"]
SCHEDULES: tuple[str, ...] = ("steps", "cosine")
SenseOn = Literal["host", "device"]
SENSE_ON: tuple[str, ...] = ("host", "device")
PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
MAX_STEPS, MAX_THREADS, MAX_WEIGHT = 10**8, 1024, 1e6
COUNT_BYTES = 4 * 4  # of a batch: counts, logits, their gradient and the target, in float32


def grows(smaller: str, larger: str) -> bool:
    """Tell whether a network holds all weights of another: the same kind, or one that it begins as (`HELD`)."""
    return smaller in HELD.get(larger, (larger,))


def _check_choices(owner: object, where: str, **choices: tuple[str, ...]) -> None:
    """Raise InputError unless each named attribute is one of its choices."""
    for name, known in choices.items():
        require_choice(getattr(owner, name), known, f"{where}{name}")


@dataclass(frozen=True)
class ModelConfig:
    """Configuration of a depth model: all that stands between counts and depth.

    front    what the network sees: the back-projection of codes; without compression the counts, or their correlation
             with the pulse (`spad.estimators.matching.normalised_correlation`); or one-hot argmax
    design   the codes, with `front` = "codes"
    layer    switches of `csph.layer_options.LayerOptions` that differ from the published layer
    network  compact; blockwise, the compact one that sees codes and places in a block, too; refined, the blockwise one
             that looks at the codes a second time; periodic, the compact one on a circle of time, for Fourier codes of
             the whole range; published; or published with logits of any sign, which cannot die
    sensor   whose histograms it takes
    grid     continuous labels on the pulse's centroid, or the published ones (`networks.grid`), to compare with the
             paper
    spatial_start   of learned spatial codes: uniform as published, or orthogonal, which keeps their rank

    Raises InputError for parts of another kind, and those that do not go together. `help(csph)` has an example.
    """

    front: Front = "codes"
    design: Design | None = None
    layer: dict[str, bool] = field(default_factory=dict)
    network: Network = "compact"
    sensor: Sensor = field(default_factory=Sensor)
    grid: Grid = "continuous"
    spatial_start: SpatialStart = "uniform"

    def __post_init__(self) -> None:
        _check_choices(self, "", front=FRONTS, network=NETWORKS, grid=GRIDS, spatial_start=STARTS)
        designed = self.design is None or isinstance(self.design, Design)
        require(designed, f"design {self.design!r}, expected a Design (`Design.named` makes one of a name)")
        require(isinstance(self.sensor, Sensor), f"sensor {self.sensor!r}, expected a Sensor (`sensor_by_name`)")
        check_switches(self.layer)
        coded = self.front == "codes"
        require(coded == (self.design is not None), f"front {self.front}: {'a' if coded else 'no'} design is expected")
        switches = ", ".join(sorted(name for name, on in self.layer.items() if on))
        require(coded or not switches, f"layer {switches}: is for codes, and there are none")
        self._check_network(coded)
        if self.design is not None:
            bins, block = self.sensor.bins, self.design.block
            folded = not self.sees_codes or block[0] % 16 == 0
            require(folded, f"network {self.network}: blocks of {block[0]} bins, expected a multiple of 16")
            require(bins % block[0] == 0, f"blocks of {block[0]} bins do not divide the sensor's {bins}")
            counted = self.design.code == "coarse" or self.design.full
            rounded = f"{self.design.name}: int8 is for codes with a table of their own, not counters or full tensors"
            require(not (counted and self.layer.get("int8")), rounded)
            message = "1 code: its mean over K is itself and is removed, which leaves zeros; expected 2 or more"
            require(self.design.codes > 1 or bool(self.layer.get("keep_mean")), f"{message}, or --layer keep_mean")
            mean = "blocks of 1 bin: a code's mean over its bins is removed, which leaves zeros; expected 2 or more"
            require(block[0] > 1 or not self.layer.get("zero_mean", self.design.zero_mean), mean)

    def _check_network(self, coded: bool) -> None:
        require(coded or not self.sees_codes, f"network {self.network}: is for codes, and there are none")
        require(self.network != "periodic" or self._on_a_circle, self._no_circle)
        unit = 32 if self.network == "periodic" else 16
        tiled = f"network {self.network}: {self.sensor.bins} bins, expected a multiple of {unit}"
        require(self.sensor.bins % unit == 0, tiled)

    @property
    def _on_a_circle(self) -> bool:
        """Tell whether back-projections move with a delay, around the end of the range."""
        if self.design is None or not self.design.periodic or not self.layer.get("keep_mean"):
            return False
        return self.design.block[0] == self.sensor.bins == self.sensor.bins_per_period

    @property
    def _no_circle(self) -> str:
        circle = f"Fourier codes over all {self.sensor.bins_per_period} bins of a period with --layer keep_mean"
        return f"network periodic: is for {circle}, not {self.name.partition(',')[0]}"

    @property
    def sees_codes(self) -> bool:
        """Tell whether the network sees the codes themselves beside their back-projection."""
        return self.network in ("blockwise", "refined")

    @property
    def codes_design(self) -> Design:
        """The design of the codes. Raises InputError for a model without codes."""
        if self.design is None:
            raise InputError(f"{self.name}: has no codes")
        return self.design

    @property
    def block(self) -> tuple[int, int, int]:
        """Return the size of a block, (Mt, Mr, Mc); one pixel and bin without codes."""
        return (1, 1, 1) if self.design is None else self.design.block

    @property
    def decoder(self) -> Decoder:
        """Return the default decoder of the network's posterior: soft-argmax on the published grid, as published, else
        the median."""
        return "soft-argmax" if self.grid == "published" else "median"

    @property
    def name(self) -> str:
        """Return codes and network in words, as tables name the model."""
        uncoded = {"counts": "no compression", "matched": "no compression", "peak": "peak"}
        return f"{uncoded[self.front] if self.design is None else self.design.name}, {self.network}"


@dataclass(frozen=True)
class TrainConfig:
    """Every number of a run.

    model         the network and its codes
    seed          of weights, crops, photon levels and noise
    epochs, steps_per_epoch    an epoch ends in validation, and is what an interrupted run goes back to
    batch, crop   patches a step, and their side in pixels
    optimiser     adam; or muon: Muon for hidden layers of our networks, Adam for the rest (`csph.training.optimiser`)
    rate          Adam's learning rate at the start, or after the warm-up; Muon's goes with it
    schedule      steps: times `decay` every `decay_steps` steps; cosine: one cosine over the run down to `rate_end` of
                  it; either after `warmup` steps of a linear rise
    decay, decay_steps, warmup, rate_end   of the schedule
    average       of the weights after every step, with this weight of the past: what is validated, kept and shipped;
                  0: the weights themselves
    init_share    of the weights that the run begins with in those that are kept at its end: the mean of both where a
                  converged model is trained on from a higher rate (Izmailov et al. 2018)
    window        train on so many bins around a label, in steps of 256, but for the last tenth of the run; 0: on all.
                  Not for blocks of more bins, whose codes would then not see the whole range
    weights       how often patches are drawn from each of several training sets (default: alike)
    sense_on      where patches are sensed: on the host, with the same bytes on every machine, or on the device that
                  trains, batch by batch (`spad.detection.device_patches`), for GPUs
    coherence     weight of the mean squared cosine between the codes of two pixels of a block (`csph.codes.rank`)
    decoded_weight   of the mean absolute error, in bins, of the posterior's mean: for models that are read by the
                  soft-argmax, as published; it takes mass from far bins that the divergence hardly sees
    tv_weight, tv_start        weight of the mean total variation of depth / range, and the step it comes in at
    levels        mean (signal, background) photons, one drawn for each patch; or "continuous" (`csph.levels`)
    time_offset_m random delay, uniform from 0 to this, of every patch: 0 is off, as published
    validation_views           frames of the validation scenes
    precision     Lightning's name; bf16-mixed on GPUs that have it
    threads       of a CPU (0: as many as there are); the same number gives the same bytes
    data          what it was trained on: path and SHA-256, filled in by `csph.training.loop.train`; of own codes the
                  path, `codes_file`, from which `train` reads them

    Raises InputError for numbers out of range. `help(csph)` has an example.
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
    levels: Levels = TRAIN_LEVELS
    time_offset_m: float = 0.0
    validation_views: int = 18
    precision: str = "32-true"
    threads: int = 0
    data: dict[str, Any] = field(default_factory=dict)
    schedule: Schedule = "steps"
    warmup: int = 0
    rate_end: float = 0.02
    average: float = 0.0
    window: int = 0
    weights: tuple[float, ...] = ()
    coherence: float = 0.0
    sense_on: SenseOn = "host"
    decoded_weight: float = 0.0
    optimiser: Optimiser = "adam"
    init_share: float = 0.0

    def __post_init__(self) -> None:
        require(isinstance(self.model, ModelConfig), f"training: model {self.model!r}, expected a ModelConfig")
        normalise_fields(self, "training")
        for name in ("epochs", "steps_per_epoch", "batch", "crop", "decay_steps", "validation_views"):
            require(getattr(self, name) >= 1, f"training: {name} {getattr(self, name)} is below 1")
        require(self.steps <= MAX_STEPS, f"training: {self.steps} steps are above {MAX_STEPS}")
        require(0 <= self.threads <= MAX_THREADS, f"training: threads {self.threads} is outside 0 to {MAX_THREADS}")
        require(0 < self.rate < 1, f"training: learning rate {self.rate:g} is outside 0 to 1")
        require(0 < self.decay <= 1, f"training: decay {self.decay:g} is outside (0, 1]")
        require(0 <= self.seed <= MAX_SEED, f"training: seed {self.seed} is outside 0 to {MAX_SEED}")
        # delays are drawn from 0 to this, and what they move beyond the range has no label: `data.warn_of_unlabelled`
        most, sensor = 2 * self.model.sensor.recorded_range_m, self.model.sensor.name
        expected = f"expected from 0 to {most:.4g} m, twice the range of sensor {sensor}"
        require(0 <= self.time_offset_m <= most, f"training: time offset {self.time_offset_m:g} m, {expected}")
        require(self.precision in PRECISIONS, f"precision {self.precision!r}: expected {', '.join(PRECISIONS)}")
        rows, columns = self.model.block[1:]
        fits = self.crop % rows == 0 and self.crop % columns == 0
        require(fits, f"training: crops of {self.crop} pixels are not tiled by blocks of {rows} x {columns}")
        object.__setattr__(self, "levels", checked_levels(self.levels))
        require(isinstance(self.data, dict), f"training: data {self.data!r}, expected entries by name")
        self._check_recipe()

    def _check_recipe(self) -> None:
        _check_choices(self, "training: ", optimiser=OPTIMISERS, schedule=SCHEDULES, sense_on=SENSE_ON)
        ours = self.optimiser == "adam" or self.model.network in HELD
        require(ours, f"training: optimiser muon is for {', '.join(HELD)}, not network {self.model.network}")
        require(self.warmup >= 0, f"training: warm-up of {self.warmup} steps is negative")
        require(0 < self.rate_end <= 1, f"training: rate_end {self.rate_end:g} is outside (0, 1]")
        require(0 <= self.average < 1, f"training: average {self.average:g} is outside [0, 1)")
        require(0 <= self.init_share < 1, f"training: init_share {self.init_share:g} is outside [0, 1)")
        terms = {"tv_weight": "total variation", "decoded_weight": "decoded error", "coherence": "coherence"}
        for name, term in terms.items():
            weight = getattr(self, name)
            good = 0 <= weight <= MAX_WEIGHT
            require(good, f"training: weight {weight:g} of the {term} is outside 0 to {MAX_WEIGHT:g}")
        several = math.prod(self.model.block[1:]) > 1
        refusal = f"training: weight {self.coherence:g} of the coherence is for codes over several pixels"
        require(several or not self.coherence, f"{refusal}, not {self.model.name}")
        listed = isinstance(self.weights, list | tuple)
        require(listed, f"training: weights {self.weights!r}, expected a number for each training set")
        object.__setattr__(self, "weights", tuple(require_number(one, "training: set weight") for one in self.weights))
        weighted = all(math.isfinite(weight) and weight > 0 for weight in self.weights)
        require(weighted, f"training: set weights {', '.join(map(str, self.weights))} are not all positive")
        if self.window:
            refusal = window_refused(self.model, self.window)
            require(not refusal, f"training: windows of {self.window} bins {refusal}")
            require(not self.time_offset_m, "training: windows and random time offsets do not go together")
        still = self.model.grid == "continuous" or not self.time_offset_m
        require(still, "training: the published grid and random time offsets do not go together")

    @property
    def steps(self) -> int:
        """Return the number of steps of the whole run."""
        return self.epochs * self.steps_per_epoch

    def check_memory(self) -> None:
        """Raise InputError unless the least that one step holds fits in memory: ask before sets are read."""
        counts = self.batch * self.crop**2 * self.model.sensor.bins
        patch = f"{self.crop} x {self.crop} pixels and {self.model.sensor.bins} bins"
        require_memory(COUNT_BYTES * counts, f"a step of {self.batch} patches of {patch}")

    def to_dict(self) -> JsonObject:
        """Return every number as JSON holds it."""
        values = asdict(self)
        design = values["model"]["design"]
        # files of before own codes stay what they were
        if design is not None and not design["sha256"]:
            del design["sha256"]
        return values

    @classmethod
    def from_dict(cls, values: JsonObject) -> TrainConfig:
        """Raise InputError for an entry that is missing or unknown."""
        try:
            model = {**values["model"]}
            design = model.pop("design")
            sensor = Sensor.from_dict(model.pop("sensor"))
            design = None if design is None else Design(**design)
            made = {"model": ModelConfig(design=design, sensor=sensor, **model), "levels": values["levels"]}
            return cls(**{**values, **made})
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"its configuration cannot be read ({' '.join(str(error).split())[:120]})") from None


_STEPS_PER_PUBLISHED_EPOCH = 3463  # 13,851 frames in batches of 4
# 1e-5 of a sum over 4 crops of 32 x 32, beside a KL divergence divided by 1024 bins
PUBLISHED_TV = 1e-5 * 1024 * 4 * 32 * 32

WINDOW_STEP = 256  # bins; windows begin at multiples of it


def window_refused(model: ModelConfig, window: int) -> str:
    """Return why a model cannot be trained on windows of so many bins; empty where it can."""
    if window % WINDOW_STEP or not 0 < window < model.sensor.bins:
        return f"are no multiple of {WINDOW_STEP} below the sensor's {model.sensor.bins}"
    if model.design is not None and WINDOW_STEP % model.block[0]:
        return f"do not hold codes over blocks of {model.block[0]} bins"
    if model.layer.get("per_pixel_norm"):
        return "are another thing to a norm over all time blocks"
    return ""


UNWINDOWED_STEPS = 0.55  # of a preset's steps where windows are left out: a step takes 256 ms instead of 146
# Of `refined`: a step takes three times as long as one of `compact`; larger patches hold more whole blocks.
REFINED_STEPS = 0.48
REFINED_PATCHES = {"batch": 3, "crop": 24}
ON_CPU = ("laptop", "workstation")
# Muon and Adam, one warm-up and one cosine, weights averaged, levels over the whole range, windows where they can be
RECIPE: dict[str, Any] = {
    "optimiser": "muon",
    "schedule": "cosine",
    "warmup": 100,
    "average": 0.995,
    "levels": CONTINUOUS,
    "window": 512,
    "validation_views": 24,
}
PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {**RECIPE, "epochs": 2, "steps_per_epoch": 4, "batch": 2, "crop": 8, "validation_views": 1, "warmup": 2},
    "laptop": {**RECIPE, "epochs": 12, "steps_per_epoch": 650},
    "workstation": {**RECIPE, "epochs": 24, "steps_per_epoch": 1500, "warmup": 400},
    # for a GPU, which senses its patches itself: three times the pixels of `workstation`
    "gpu": {
        **RECIPE,
        "epochs": 10,
        "steps_per_epoch": 2000,
        "batch": 8,
        "crop": 32,
        "warmup": 400,
        "average": 0.998,
        "validation_views": 12,
        "sense_on": "device",
    },
    "laptop-v1": {},  # what the first models were shipped with
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


def preset(name: str, model: ModelConfig, **changes: object) -> TrainConfig:
    """Return a preset's configuration with a model; `changes` that are None leave it as it is.

    smoke (seconds), laptop (one core, 25 minutes at the most), workstation (two cores, 2 hours at the most), gpu (three
    times workstation's pixels, sensed on the GPU), paper (the published network, levels and schedule), laptop-v1 (the
    recipe of the first models). Windows are left out where the model does not allow them, and with random time offsets.
    A refined network has fewer steps of larger patches with laptop and workstation. Without compression, and of one-hot
    peaks, `paper` has the published total variation and a tenth of the learning rate. `levels` may be "paper". The
    published network is trained by Adam with every preset.
    """
    require_choice(name, PRESETS, "preset")
    require(isinstance(model, ModelConfig), f"preset: model {model!r}, expected a ModelConfig")
    known = {item.name for item in fields(TrainConfig)}
    given = {key: value for key, value in changes.items() if value is not None}
    require(given.keys() <= known, f"unknown options {', '.join(sorted(given.keys() - known))}")
    levels = given.get("levels")
    oracle = {"rate": 1e-4, "tv_weight": PUBLISHED_TV} if name == "paper" and model.front != "codes" else {}
    if isinstance(levels, str) and levels == "paper":
        given["levels"] = TRAIN_LEVELS
    values: dict[str, Any] = {"model": model, "preset": name, **PRESETS[name], **oracle, **given}
    if "optimiser" not in given and model.network not in HELD:
        values["optimiser"] = "adam"
    fraction = 1.0  # of the steps
    if "window" not in given and (window_refused(model, values.get("window", 0)) or values.get("time_offset_m")):
        values["window"] = 0
        fraction = UNWINDOWED_STEPS if PRESETS[name].get("window", 0) else 1.0
    if name in ON_CPU and model.network == "refined":
        tiled = math.lcm(*model.block[1:], REFINED_PATCHES["crop"]) == REFINED_PATCHES["crop"]
        values |= {key: value for key, value in REFINED_PATCHES.items() if key not in given and tiled}
        fraction *= REFINED_STEPS
    if "steps_per_epoch" not in given and fraction != 1:
        values["steps_per_epoch"] = math.ceil(fraction * values["steps_per_epoch"])
    return TrainConfig(**values)
