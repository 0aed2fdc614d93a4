"""Options of `train` and `evaluate`, which studies read too. No torch, no Mitsuba: --help must be quick."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from scene2spad.options.common import (
    WITHOUT_HINT,
    Common,
    Count,
    File,
    Long,
    Number,
    Pixels,
    Positional,
    may_stay_open,
    only_for,
    required_word,
)
from scenes.errors import require

PLANES = Path("planes")  # the set that needs no renderer
TrainingPreset = Literal["smoke", "laptop", "workstation", "gpu", "laptop-v1", "paper"]
Switch = Literal["per_pixel_norm", "keep_mean", "pulse_in_decoder", "pulse_in_codes", "int8"]


@dataclass(frozen=True, kw_only=True)
class Train(Long):
    """Train a depth network, with or without compressive codes, on a rendered set; a run that was killed goes on."""

    design: str = "learned"
    """learned, fourier, gray, coarse, hadamard or random; with +learned for a fixed temporal code and a learned spatial
    part; fourier-published and gray-published have the published rows (cos and -sin at whole bins); none for the counts
    themselves, peak for their fullest bins."""
    block: tuple[int, int, int] = (256, 4, 4)
    """Block of the codes: time bins, rows, columns."""
    compression: Number = None
    """Counts of a block for one code that is kept (default: 128)."""
    codes: Count = None
    """Number K of codes, instead of --compression."""
    full: bool = False
    """A full coding tensor instead of a separable one."""
    codes_file: File = None
    """Fixed codes of your own instead of --design, as they are: an array (.npy), (K, Mt) or (K, Mt, Mr, Mc), or a table
    as `export` writes it (.txt). Block and number are the file's. The run keeps a copy."""
    layer: Annotated[tuple[Switch, ...], WITHOUT_HINT] = ()
    """Switches of the layer that differ from the published one; int8 trains codes for the in-pixel processor: 8 bits
    within ranges that are learned, sums of 16 bits that wrap (begin with --init)."""
    set: tuple[Path, ...] = (PLANES,)
    """Folders of sets that `dataset` rendered, or their packs (.h5); planes: random planes, no renderer needed."""
    set_weights: Annotated[tuple[float, ...], WITHOUT_HINT] = ()
    """Relative frequency at which patches are drawn from each set (default: alike)."""
    validation: Annotated[tuple[Path, ...], WITHOUT_HINT] = ()
    """Sets to validate on (default: the last tenth of the scenes)."""
    preset: TrainingPreset = "laptop"
    """smoke: seconds; laptop: one core, 25 minutes at the most; workstation: two cores, 2 hours at the most; gpu: the
    compact network on three times workstation's pixels, sensed on the GPU; paper: the published network and schedule
    (GPU); laptop-v1: the recipe of the first models."""
    network: Annotated[
        Literal["compact", "blockwise", "refined", "periodic", "published", "published-signed"] | None,
        may_stay_open("{compact,blockwise,refined,periodic,published,published-signed}"),
    ] = None
    """Our own (compact; blockwise sees the codes, too; refined looks at them twice; periodic answers alike at every
    delay, for Fourier codes over all bins with --layer keep_mean), the published, or the published without its final
    ReLU, which can die (default: that of --init or --init-network; without these published with paper; refined for
    blocks of several pixels with laptop and workstation; else compact)."""
    sensor: str = "reference"
    """Sensor preset or sensor file (.toml), as in `sense`; with a time-to-digital converter patches are drawn through
    it."""
    init: Annotated[str | None, may_stay_open("MODEL")] = None
    """Begin with the weights of a trained model, a shipped name or a checkpoint, instead of random ones (fine-tuning):
    of the same design, or of one whose blocks tile this design's at the same compression (learned 1024 4 4 can begin
    as 256 4 4 does, and --full as a separable one)."""
    init_network: Annotated[str | None, may_stay_open("MODEL")] = None
    """Begin with the network of a trained model of any design, and codes of one's own from their start."""
    init_share: Number = None
    """Share of the weights of --init in those that are kept at the end: 0.5 is the mean of both, for a converged model
    that is trained on from a higher rate (default: 0)."""
    steps: Count = None
    """Steps of the whole run, rounded up to whole epochs (default: the preset's)."""
    batch: Count = None
    """Patches a step (default: the preset's)."""
    crop: Pixels = None
    """Side of a patch (default: the preset's)."""
    optimiser: Annotated[Literal["adam", "muon"] | None, may_stay_open("{adam,muon}")] = None
    """adam, or muon for the hidden layers and adam for the rest: fewer steps from random weights (default: muon;
    adam with paper, laptop-v1 and the published network)."""
    rate: Number = None
    """Adam's learning rate at the start, or after the warm-up; Muon's is three times it (default: the preset's)."""
    levels: Annotated[Literal["continuous", "paper"] | None, may_stay_open("{continuous,paper}")] = None
    """Photon levels: signal from 1 to 100 over every background of the tests, or the paper's nine (default: the
    preset's)."""
    window: Count = None
    """Train on so many bins around a label but for the last tenth of the run; 0: all (default: the preset's, where the
    codes allow it)."""
    grid: Literal["continuous", "published"] = "continuous"
    """Labels: continuous, or on whole bins and decoded as published, for comparison with the paper."""
    spatial_start: Annotated[Literal["uniform", "orthogonal"] | None, may_stay_open("{uniform,orthogonal}")] = None
    """Start of learned spatial codes (default: orthogonal; uniform with paper and laptop-v1)."""
    sense_on: Annotated[Literal["host", "device"] | None, may_stay_open("{host,device}")] = None
    """Where patches are sensed: on the host, with the same bytes on every machine, or on the GPU that trains (default:
    the preset's)."""
    decoded: Number = None
    """Weight of the mean absolute error of the soft-argmax, in bins, for models that are read by it (default: 0)."""
    coherence: Number = None
    """Weight of the penalty on codes that are alike for two pixels of a block (default: 0)."""
    tv: Number = None
    """Weight of the mean total variation of depth / range; 41.9 is the published 1e-5 (default: 0, or the preset's)."""
    tv_start: Count = None
    """Step at which the total variation comes in (default: 500)."""
    time_offset: Number = None
    """Delay every patch at random by up to this many metres of depth (default: 0, as published)."""
    precision: Annotated[Literal["32-true", "bf16-mixed", "16-mixed"] | None, may_stay_open("{32-true,bf16-mixed}")] = (
        None
    )
    """Lightning's name of the arithmetic (default: 32-true)."""
    threads: Count = None
    """CPU threads; the same number gives the same bytes (default: all)."""
    workers: int = 0
    """Processes that sense ahead; the same patches, whatever their number."""
    devices: Count = None
    """Devices to train on: 1, the default. More are refused, since they would train another, shorter run."""
    out: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder of the run (default: out/train and a name from the options)."""


def check_used(command: Train) -> None:
    """Raise InputError for options that a training of this design would ignore."""
    own = command.codes_file is not None
    coded = command.design not in ("none", "peak")
    learned = not own and (command.design == "learned" or command.design.endswith("+learned"))
    spatial = learned and not command.full and math.prod(command.block[1:]) > 1
    varied = bool(command.tv) or (command.preset == "paper" and not coded)
    options = dict.fromkeys(("block", "compression", "codes"), (coded, "designs with codes"))
    options |= {"spatial_start": (spatial, "spatial codes that are learned"), "tv_start": (varied, "--tv above 0")}
    where = f"train --codes-file {command.codes_file}" if own else f"train --design {command.design}"
    options |= {"design": (not own, "codes of no file"), "full": (coded and not own, "designs with codes of no file")}
    only_for(command, where, options)
    for option in ("design", "init", "init_network"):
        given = getattr(command, option)
        array = given is not None and given.endswith(".npy")
        cure = "is a file of codes, expected --codes-file"
        require(not array, f"train: --{option.replace('_', '-')} {given}: {cure} {given}")


@dataclass(frozen=True, kw_only=True)
class Evaluate(Common):
    """Compare trained networks with classical estimators on a rendered set, at the paper's 16 photon levels; a run
    that was killed goes on: what networks have estimated lies in OUT/unfinished until it ends."""

    checkpoints: Positional[Annotated[tuple[Path, ...], required_word("MODEL [MODEL ...]")]]
    """Checkpoints of `train`, their folders, or names of models (see `models`); the first is the one that the others
    are compared with."""
    decoder: Annotated[Literal["soft-argmax", "median"] | None, may_stay_open("{soft-argmax,median}")] = None
    """Depth read from posteriors: their mean, or their median (default: each model's)."""
    tiled: bool = False
    """Cut images to what the blocks of all networks tile, instead of reflecting what is missing."""
    set: Path
    """Folder of a set that `dataset` rendered, its pack (.h5), a transient (.exr) or a folder of them; published: the
    paper's pairs, in its own simulation, read by both decoders (middlebury/NAME/ with view1.png, disp1.png and dmin.txt
    of half size, in $SCENE2SPAD_DATA)."""
    baselines: tuple[str, ...] = ("argmax", "log-matched", "fourier-8")
    """Estimators of `depth`, and codes decoded without a network: CODE-K, or your own (K, T) in a file (.npy, or .txt
    as `export` writes it)."""
    levels: Annotated[tuple[str, ...], WITHOUT_HINT] = ()
    """Photon levels, mean signal + background a pixel, as in 1+100 3+3 (default: the paper's 16); each gets a line."""
    law: Annotated[
        Literal["auto", "poisson", "first-photon", "free-running"] | None,
        may_stay_open("{auto,poisson,first-photon,free-running}"),
    ] = None
    """Detection law; auto chooses for every exposure by its brightest pixel, as `sense` does (default: poisson, which
    networks are trained by, up to 1 % detections a cycle in the mean pixel of a level; auto above)."""
    views: Count = None
    """Only the first N views (default: all)."""
    offset: float = 0.0
    """Move every scene this many metres away in time alone; other offsets are rendered: `dataset --offset-mode`."""
    int8: bool = False
    """Codes in 8 bits as well, summed in 16."""
    int8_rule: Annotated[Literal["calibrated", "published"] | None, may_stay_open("{calibrated,published}")] = None
    """Rounding of weights with --int8: 255 steps over each factor's own range (default), or over -1 to 1 as
    published."""
    maps: bool = False
    """Write all depth maps as well, without confidence: maps/METHOD/VIEW-SCENE-SIGNAL+BACKGROUND.exr below --out, where
    they stand at the end."""
    out: Path = Path("out/evaluate")
    """Folder for the table (.csv), and for what it is of (.json)."""
