"""The command line's configuration of what compares, draws and emulates: `bench`, `study`, `report`, `ultraphase`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from scene2spad.options.common import WITHOUT_HINT, Common, Count, File, Long, Number, Positional, may_stay_open

MIN_SENSE_REPEATS = 3  # of `bench sense`
MAX_HEADROOM_BITS = 4  # of the 7 that a code on the chip has


@dataclass(frozen=True, kw_only=True)
class Bench(Common):
    """Measure speed against error: `render` beside mitransient, `sense` beside dense Poisson draws, `encode` of
    compressive layers, `network` of depth networks, `emulate` of the in-pixel processor and its two routes to the
    same bits; the table of `hard-cases`."""

    stage: Positional[Literal["render", "sense", "encode", "network", "emulate", "hard-cases"]] = "render"
    """Stage to measure."""
    scenes: Annotated[
        tuple[
            Literal["flash", "lamp", "artist", "artist-lamp", "gallery", "groove", "hall", "hall-lamp", "washroom"], ...
        ],
        WITHOUT_HINT,
    ] = ()
    """Scenes of `bench render` (default: all)."""
    sizes: Annotated[tuple[int, ...], WITHOUT_HINT] = ()
    """Image sides, pixels (default: 64 128 256 of flash, lamp and gallery, 64 128 of artist, artist-lamp and groove,
    64 256 of hall and hall-lamp, 64 of washroom)."""
    only: Annotated[tuple[str, ...], WITHOUT_HINT] = ()
    """Cases of `bench hard-cases`, or programs of `bench emulate` (default: all)."""
    quick: bool = False
    """No 256 pixels, and flash and lamp alone at 128; two levels of one image; no slow hard cases or megapixels."""
    peer: Literal["mitransient", "none"] = "mitransient"
    """The renderer beside ours; none measures ours alone, against its own finer results."""
    repeats: int = 3
    """Warm runs of each quality; their median is reported. `sense` needs 3 or more, `encode` makes three times as
    many."""
    seeds: int = 3
    """Runs of different seeds that the error is averaged over."""
    memory: bool = False
    """Compare peak memory of one scene and size in fresh processes instead."""
    data: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder with the artist's scene and the Middlebury images (default: SCENE2SPAD_DATA, else shared/data beside
    the project)."""
    set: Annotated[Path | None, may_stay_open("SET")] = None
    """Rendered set whose views the estimators of `bench sense` are compared on (default: the Middlebury images)."""
    cache: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder that keeps references from run to run (default: ~/.cache/scene2spad)."""
    out: Path = Path("out/bench")
    """Folder for the table (.csv) and the pictures (.png)."""


# Options that some stages of the bench read, and which ones; the others are of all stages.
STAGES_OF: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("scenes", "sizes", "peer", "seeds", "memory", "cache"), ("render",)),
    "only": ("hard-cases", "emulate"),
    "data": ("render", "sense"),
    "quick": ("render", "sense", "network", "emulate", "hard-cases"),
    "repeats": ("render", "sense", "encode", "network", "emulate"),
    "set": ("sense",),
}
ABLATIONS = ("spatial-block", "tensor-size", "fourier")
StudyName = Literal[
    "tensors",
    "memory",
    "codes",
    "power",
    "chip",
    "depth-offset",
    "spatial-block",
    "tensor-size",
    "fourier",
    "real-data",
    "render-error",
    "transport",
    "multipath",
    "sim-to-real",
    "tdc",
    "all",
]
STUDIES: tuple[str, ...] = tuple(name for name in get_args(StudyName) if name != "all")
# Studies that train, with --retrain, what they do not find.
TRAINING = ("chip", "depth-offset", *ABLATIONS, "transport", "multipath", "tdc")
NO_PRESET = ("tensors", "memory", "codes")  # studies whose results are the same with every preset
# Options that some studies read, and which ones; the others are of all studies.
OPTIONS_OF: dict[str, tuple[str, ...]] = {
    "checkpoints": ("tensors", "render-error", "real-data"),
    **dict.fromkeys(("design", "block", "codes"), ("tensors",)),
    "full": ("tensors", "depth-offset", *ABLATIONS),
    "ship": ("depth-offset", *ABLATIONS),
    "scene": ("codes", "power"),
    **dict.fromkeys(("width", "height"), ("codes", "power", "render-error")),
    **dict.fromkeys(("signal", "background"), ("power",)),
    **dict.fromkeys(("scene_set", "views", "cache"), ("render-error",)),
    **dict.fromkeys(("capture", "frame"), ("real-data",)),
    **dict.fromkeys(("retrain", "set"), TRAINING),
    "models": (*TRAINING, "power"),
    "preset": tuple(name for name in STUDIES if name not in NO_PRESET),
}


@dataclass(frozen=True, kw_only=True)
class Study(Long):
    """Run one study, or `all`, and write its figures and tables. With figures of the paper's
    supplement: `tensors` (1, 17), `memory` (15, 16,
    Table 1), `depth-offset` (1, 2, 3, 17), `power` (4, 5), `spatial-block` (6, 7), `tensor-size` (8
    to 10), `fourier` (11, 12), `real-data` (13, 14). Studies of ours: depth from `codes` without a network; trained
    codes on the emulated `chip`; light `transport` added to RGB-D simulation, step by step; networks beside the
    filter under `multipath`; a real chip beside its model (`sim-to-real`); codes behind a real clock (`tdc`); what
    the error of a rendered set costs in depth (`render-error`). `all` goes on past studies whose data are absent, and
    ends in a table."""

    name: Positional[StudyName]
    """Study to run, or all of them."""
    checkpoints: Annotated[tuple[Path, ...], WITHOUT_HINT] = ()
    """Trained layers that `study tensors` draws: names of models (see `models`), checkpoints, or .npy arrays (K, Mt) or
    (K, Mt, Mr, Mc); trained networks of `study render-error` and `study real-data`, by name or checkpoint."""
    design: Annotated[str, WITHOUT_HINT] = ""
    """A design that `study tensors` draws instead of the paper's: learned, fourier, gray, coarse, hadamard or random,
    with +learned for a fixed temporal code and a learned spatial part."""
    block: tuple[int, int, int] = (256, 4, 4)
    """Block of --design: time bins, rows, columns."""
    codes: int = 32
    """Number K of codes of --design."""
    full: bool = False
    """--design is a full coding tensor instead of a separable one; of studies of trained models, every compression of
    the paper instead of 128x (depth-offset: 64x and 128x), of depth-offset all 16 photon levels too."""
    preset: Literal["smoke", "laptop", "paper"] = "laptop"
    """Of studies of trained models: smoke trains two for seconds and tests them on two small views; laptop and paper
    say how models are trained with --retrain. Of `study real-data`, how captures are rendered: 32 x 32 pixels of direct
    light, 256 x 256 to 5 %, to 2 %. Of `study transport`, 2, 12 or 24 scenes, 24, 88 or 176 pixels wide. Of `study
    render-error`, smoke is one view at two coarse qualities, in a minute."""
    pdf: bool = False
    """Write each figure as PDF as well, as wide as a paper's column (3.5 in) or page (7.16 in)."""
    models: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder of runs of `train`, each under its model's name, looked in before the models that come with the package
    (default: models in --out)."""
    retrain: bool = False
    """Train what is not finished in --models, and use no model that came with the package."""
    set: Annotated[Path | None, may_stay_open("SET")] = None
    """Set that --retrain or smoke trains on, as in `train` (default: 2,000 rooms rendered into --out; smoke: planes).
    `study depth-offset` also reads from it how deep the training of models was whose runs do not say it."""
    ship: bool = False
    """Put the models found into the package in half precision, with configuration and training log."""
    scene: str = "tabletop/kitchen"
    """Scene of `study codes` (direct light alone, under a scanning laser) and `study power`, as `render` takes it."""
    width: int = 64
    """Image width of these, pixels."""
    height: int = 48
    """Image height of these, pixels."""
    signal: float = 50.0
    """Mean signal photons per pixel of `study power`."""
    background: float = 500.0
    """Mean background photons per pixel of `study power`."""
    scene_set: str = "tabletop"
    """Scene set of `study render-error`, as `dataset` takes it."""
    views: int = 3
    """First N views of --scene-set to render, at --width x --height."""
    cache: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder that keeps its renders from run to run (default: ~/.cache/scene2spad)."""
    capture: Annotated[tuple[Path, ...], WITHOUT_HINT] = ()
    """Captures (.mat) of the LinoSPAD prototype for `study real-data`, instead of rendered ones in their layout."""
    frame: int = 0
    """Frame of these files, from 0."""
    out: Path = Path("out/study")
    """Folder for the figures (.png) and tables (.csv)."""


def trains_models(name: str, command: Study) -> bool:
    """Return whether a study, by its name, trains what it does not find: with --retrain, and of `smoke` all but
    `transport`, which has something to say without models."""
    toy = command.preset == "smoke" and name != "transport"
    return name in TRAINING and (command.retrain or toy)


@dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write one self-contained HTML page of every figure, table, configuration and version made so far: speed against
    error first, published numbers beside ours, and what was not measured. Nothing is loaded, and it prints well."""

    results: Path = Path("out")
    """Folder that `bench`, `study`, `evaluate` and `demo` have filled, with all its subfolders."""
    out: Path = Path("out/report.html")
    """The page to write."""


@dataclass(frozen=True, kw_only=True)
class Ultraphase(Common):
    """Run compressive histograms as programs on the emulated UltraPhase processor: `table` (Supplementary Figure 5
    beside the emulation), `compile MODEL` (a trained model's codes), `run PROGRAM`, `asm FILE`, `list FILE`, `verify
    PROGRAM` and `sweep`. docs/ultraphase-instructions.md has the instructions and directives."""

    action: Positional[Literal["table", "compile", "run", "asm", "list", "verify", "sweep"]] = "table"
    """Action: tabulate or sweep the chip's power, or compile, run, assemble, list or verify a program."""
    program: Positional[Annotated[str, may_stay_open("[PROGRAM]")]] = ""
    """FAMILY-K with family coarse, fourier, separable, learned or addressed, or a source file (.s); of compile, a
    shipped model's name or a checkpoint."""
    headroom: Count = None
    """Make the tables so many bits smaller, so that sums of bright pixels fit 16 bits (compile): 0 to 4 (default: 1; a
    model that was trained for the chip keeps the ranges that it learned)."""
    define: Annotated[tuple[str, ...], WITHOUT_HINT] = ()
    """Constants of a source file, as NAME=VALUE; all behind one --define: --define K=8 SHIFT=7."""
    table: Annotated[tuple[str, ...], WITHOUT_HINT] = ()
    """Contents of the tables of a source file, as NAME=FILE.npy with whole numbers of shape (count,) (run,
    verify), or (rows, columns, count) for each core its own (run)."""
    out: File = None
    """File for the words (asm: one hexadecimal word a line), the listing (list; compile: with the tables) or the rows
    (table, sweep: a .csv)."""
    photons: tuple[float, ...] = (550.0,)
    """Photons a pixel and frame, background included; `run` takes one whole number, `sweep` several numbers."""
    signal: Number = None
    """Photons of one laser return among --photons, a whole number, the rest spread evenly over time (run; default: 50,
    or all where these are fewer)."""
    timestamps: File = None
    """Photons of the frame instead of a made-up return (run): timestamps of every core, a .npy of shape (N,) from 0 to
    1023; or a histogram of `sense` (.h5) of 1024 bins, whose pixels have a core each and give their photons in the
    order of time."""
    fps: tuple[float, ...] = (30.0,)
    """Frames a second (sweep)."""
    codes: Annotated[tuple[int, ...], WITHOUT_HINT] = ()
    """K of the Fourier and separable programs (sweep; default: the seven of the paper); those that are no program are
    listed with the reason."""
    pixels: tuple[int, ...] = (4, 1048576)
    """Pixels of the sensor (sweep)."""
    trace: int = 0
    """Show this many instructions of one core, the first ones of core (0, 0) with clock and line; of a frame that
    fails, the last ones of the core that failed (run)."""
    watch: Annotated[str, WITHOUT_HINT] = ""
    """Show the changes of this region of one core's RAM, 100 at the most, as --trace does (run)."""
