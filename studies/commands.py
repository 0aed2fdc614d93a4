"""The command line's configuration: one dataclass a command. No torch, no Mitsuba: --help must be quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from render.settings import SHARED_AMBIENT_SPP
from studies.experiments import Bench, Report, Study
from studies.options import Common, Count, File, Mode, Number, Offset, Pixels, Positional, may_stay_open


@dataclass(frozen=True, kw_only=True)
class Demo(Common):
    """From the default scene to depth, with a figure: render, sense, classical and compressive depth."""

    scene: str = "living-room"
    """A scene as `render` takes it."""
    width: int = 128
    """Image width, pixels."""
    height: int = 96
    """Image height, pixels."""
    signal: float = 50.0
    """Mean signal photons per pixel."""
    background: float = 50.0
    """Mean background photons per pixel."""
    out: Path = Path("out/demo")
    """Folder for the transient (.exr), the histogram (.h5) and the figure (.png)."""


@dataclass(frozen=True, kw_only=True)
class Scenes(Common):
    """List the built-in scenes and sets, or describe one: size, triangles, camera, lights, what a loader changed."""

    scene: Positional[str] = ""
    """A scene as `render` takes it, or with --sheet a set; none lists the names."""
    sheet: File = None
    """Draw a contact sheet of the set's first views to this .png."""
    count: int = 48
    """Views on the sheet, or all of a smaller set."""
    width: Pixels = None
    """Width of the sheet's views, pixels (default: 128 in 4:3 of rooms, the scene's own of others)."""


@dataclass(frozen=True, kw_only=True)
class Render(Common):
    """Render a scene's time-resolved radiance to a deep EXR file, with a picture beside it."""

    scene: Positional[str] = "living-room"
    """A name (see `scenes`), a mesh (.obj .ply .stl .glb), a Mitsuba scene (.xml), or a photograph with --depth."""
    out: File = None
    """The .exr file (default: the scene's name in this folder)."""
    width: Pixels = None
    """Image width, pixels (default: the scene's own; one of width and height alone keeps the proportions)."""
    height: Pixels = None
    """Image height, pixels."""
    laser: Mode = None
    """What is lit: the field of view, the row being measured, or the pixel being measured (default: the scene's)."""
    bounces: Count = None
    """Surfaces light may meet, 1 = direct only (default: planned from a pilot)."""
    spp: Count = None
    """Indirect light paths per pixel (default: planned from a pilot)."""
    filter: bool = False
    """Average late indirect light over small regions of surfaces: far less noise for the same paths, and a bias, which
    is measured and stated."""
    grid: Count = None
    """Direct rays per pixel side (default: planned from a pilot)."""
    error: Number = None
    """Target of the relative error: nRMSE of the expected counts on the reference sensor (default: 0.02)."""
    budget: Annotated[tuple[float, float] | None, may_stay_open("SIGNAL BACKGROUND")] = None
    """Mean SIGNAL and BACKGROUND photons: render no finer than their shot noise can show, instead of --error."""
    ambient: Literal["auto", "on", "off"] = "auto"
    """Steady ambient light; auto renders it if the scene has any and the budget has background."""
    ambient_spp: Count = None
    """Ambient light paths per pixel (default: until their noise is what --error or --budget asks for)."""
    offset: float = 0.0
    """Move the scene this many metres away."""
    offset_mode: Offset = "time"
    """time: identical counts, later; ray: every point along its camera ray; rigid: all of it, field of view matched."""
    depth: Annotated[Path | None, may_stay_open("FILE")] = None
    """Depth image (.png or .exr) of an RGB-D pair whose photograph is SCENE."""
    depth_scale: Annotated[float | None, may_stay_open("METRES")] = None
    """Metres per level of the depth image; a .png needs it, an .exr is taken in metres."""
    focal: Annotated[float | None, may_stay_open("PIXELS")] = None
    """Focal length of the depth image, pixels; an RGB-D pair needs it."""
    cosine: bool = False
    """RGB-D: apply the cosine of the surface to the photograph, which already holds shading of its own."""
    figure: bool = True
    """Draw a picture of the layers beside the file."""


@dataclass(frozen=True, kw_only=True)
class Dataset(Common):
    """Render a scene set to a folder of EXR files with an index; stopped at any moment, it goes on where it was."""

    set: Positional[str] = "rooms"
    """rooms, rooms/val, rooms/test, tabletop, middlebury or hard-cases."""
    count: Count = None
    """Views (default: all of a finite set, 100 of rooms)."""
    out: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder of the set (default: out/ and the set's name)."""
    workers: int = 1
    """Processes on this machine."""
    scheduler: Annotated[str | None, may_stay_open("ADDRESS")] = None
    """Address of a running Dask scheduler, tcp://HOST:PORT, instead of processes here."""
    pack: File = None
    """Make one .h5 file of the finished set, which training reads without a renderer."""
    width: Pixels = None
    """Image width, pixels (default: 64 of rooms, the scenes' own of others)."""
    height: Pixels = None
    """Image height, pixels."""
    bounces: Count = None
    """Surfaces light may meet, 1 = direct only (default: planned for each view)."""
    spp: Count = None
    """Indirect light paths per pixel (default: planned for each view)."""
    filter: bool = False
    """Average late indirect light over small regions of surfaces, as `render` does: faster, and biased."""
    grid: Count = None
    """Direct rays per pixel side (default: planned, one for all views of an endless set)."""
    error: Number = None
    """Target of the relative error (default: 0.01 with 1 bounce, 0.03 with more)."""
    ambient: bool = True
    """Render ambient light."""
    ambient_spp: int = SHARED_AMBIENT_SPP
    """Paths per pixel of ambient light, which neighbouring pixels share."""
    offset: float = 0.0
    """Move every scene this many metres away."""
    offset_mode: Offset = "time"
    """As of `render`."""


@dataclass(frozen=True, kw_only=True)
class Sense(Common):
    """Record a transient with a single-photon sensor: photon counts to HDF5, with a picture beside it."""

    file: Positional[Path]
    """A transient written by `render` (.exr)."""
    out: File = None
    """The .h5 file (default: the transient's name)."""
    sensor: Literal["reference", "iccv2023-train", "linospad"] = "reference"
    """Sensor preset."""
    signal: Number = None
    """Mean signal photons per pixel and exposure (default: 50, or what the --radiometric optics give)."""
    background: Number = None
    """Mean background photons per pixel and exposure, dark counts included (default: as --signal)."""
    dark_count_rate: Number = None
    """Dark counts per second and pixel [Hz] (default: the preset's)."""
    dark_map: File = None
    """Measured dark counts per second of every pixel [Hz] (.npy), NaN in dead pixels, instead."""
    model: Literal["auto", "poisson", "first-photon", "free-running"] = "auto"
    """Detection law; auto says why it chose."""
    reset: Annotated[Literal["synchronous", "free-running"] | None, may_stay_open("{synchronous,free-running}")] = None
    """Armed at every laser cycle, or again after the dead time (default: the preset's)."""
    dead_time: Number = None
    """Dead time after a detection [s] (default: the preset's)."""
    exposure: Number = None
    """Exposure of the frame [s] (default: the preset's)."""
    jitter: Number = None
    """Standard deviation of the detector's timing jitter [s], a second kernel beside the pulse."""
    jitter_tail: float = 0.0
    """Time constant of the jitter's exponential tail [s]; needs --jitter."""
    pulse: File = None
    """Measured pulse (.npy, one dimension) in steps of --pulse-step, instead of the preset's."""
    pulse_step: Number = None
    """Time step of --pulse [s]."""
    pde: Number = None
    """Photon detection efficiency, 0 to 1: a --radiometric budget counts with it (default: the preset's)."""
    crosstalk: float = 0.0
    """Probability that a detection fires a given neighbour."""
    hot_pixels: float = 0.0
    """Share of hot pixels, placed by the seed."""
    hot_rate: float = 1e4
    """Dark counts per second of a hot pixel [Hz]."""
    dead_pixels: float = 0.0
    """Share of dead pixels, placed by the seed."""
    radiometric: bool = False
    """Compute the photon budget from the optics below, instead of --signal and --background."""
    pulse_energy: float = 10e-9
    """Energy of one laser pulse [J], over the whole cone."""
    focal_length: float = 10e-3
    """Focal length of the lens [m]."""
    f_number: float = 2.0
    """Focal length over aperture diameter."""
    pixel_pitch: float = 20e-6
    """Side of a pixel's active square [m]."""
    transmission: float = 0.8
    """Transmission of lens and filter."""
    filter_width: float = 10.0
    """Width of the band that the filter lets through [nm]."""
    wavelength: float = 850e-9
    """Wavelength of the laser [m]."""
    export: Annotated[Literal["mat"] | None, may_stay_open("mat")] = None
    """Write the published .mat layout, and its pulse, beside the .h5 file."""
    figure: bool = True
    """Draw a picture of the counts beside the file."""


@dataclass(frozen=True, kw_only=True)
class Depth(Common):
    """Estimate depth from a histogram and compare it with the truth; writes the depth map and a picture."""

    file: Positional[Path]
    """A histogram written by `sense` (.h5)."""
    out: File = None
    """The depth map (.exr) to write (default: the histogram's and the method's name)."""
    method: Literal[
        "argmax", "matched", "log-matched", "correlation", "lmf-published", "coates", "compressive", "network"
    ] = "log-matched"
    """Estimator; log-matched is the Poisson maximum likelihood, coates the same after the pile-up is undone."""
    checkpoint: File = None
    """A checkpoint of `train`, or its folder, for `--method network`."""
    int8: bool = False
    """Codes of `--method network` in 8 bits, summed in 16."""
    code: Literal["fourier", "gray", "coarse", "hadamard", "random"] = "fourier"
    """Temporal code of `--method compressive`: truncated Fourier, Gray Fourier, coarse histogram, Walsh-Hadamard."""
    codes: int = 16
    """Number K of codes kept per pixel by `--method compressive`."""
    figure: bool = True
    """Draw estimate, truth and error beside the file."""


@dataclass(frozen=True, kw_only=True)
class Train(Common):
    """Train a depth network, with or without compressive codes, on a rendered set; a run that was killed goes on."""

    design: str = "learned"
    """learned, fourier, gray, coarse, hadamard or random; with +learned for a fixed temporal code and a learned spatial
    part; none for the counts themselves, peak for their fullest bins."""
    block: tuple[int, int, int] = (256, 4, 4)
    """Block of the codes: time bins, rows, columns."""
    compression: float = 128.0
    """Counts of a block for one code that is kept."""
    codes: Count = None
    """Number K of codes, instead of --compression."""
    full: bool = False
    """A full coding tensor instead of a separable one."""
    layer: tuple[Literal["per_pixel_norm", "keep_mean", "pulse_in_decoder", "pulse_in_codes"], ...] = ()
    """Switches of the layer that differ from the published one."""
    set: tuple[Path, ...] = (Path("planes"),)
    """Folders of sets that `dataset` rendered, or their packs (.h5); planes: random planes, no renderer needed."""
    set_weights: tuple[float, ...] = ()
    """How often patches are drawn from each set (default: alike)."""
    validation: tuple[Path, ...] = ()
    """Sets to validate on (default: the last tenth of the scenes)."""
    preset: Literal["smoke", "laptop", "workstation", "laptop-v1", "paper"] = "laptop"
    """smoke: seconds; laptop: one core, 25 minutes at the most; workstation: two cores, 2 hours at the most; paper: the
    published network and schedule (GPU); laptop-v1: the recipe of the first models."""
    network: Annotated[
        Literal["compact", "published", "published-signed"] | None,
        may_stay_open("{compact,published,published-signed}"),
    ] = None
    """Our own, the published, or the published without its final ReLU, which can die (default: the preset's)."""
    sensor: Literal["reference", "iccv2023-train", "linospad"] = "reference"
    """Sensor preset."""
    steps: Count = None
    """Steps of the whole run (default: the preset's)."""
    batch: Count = None
    """Patches a step (default: the preset's)."""
    crop: Pixels = None
    """Side of a patch (default: the preset's)."""
    rate: Number = None
    """Learning rate at the start, or after the warm-up (default: the preset's)."""
    levels: Annotated[Literal["continuous", "paper"] | None, may_stay_open("{continuous,paper}")] = None
    """Photon levels: signal from 1 to 100 over every background of the tests, or the paper's nine (default: the
    preset's)."""
    window: Count = None
    """Train on so many bins around a label but for the last tenth of the run; 0: all (default: the preset's, where the
    codes allow it)."""
    grid: Literal["continuous", "published"] = "continuous"
    """Labels: continuous, or on whole bins and decoded as published, for comparison with print."""
    spatial_start: Annotated[Literal["uniform", "orthogonal"] | None, may_stay_open("{uniform,orthogonal}")] = None
    """Start of learned spatial codes (default: orthogonal; uniform with paper and laptop-v1)."""
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
    """GPUs (default: all there are)."""
    out: Annotated[Path | None, may_stay_open("FOLDER")] = None
    """Folder of the run (default: out/train and a name from the options)."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(Common):
    """Trained networks beside classical estimators on a rendered set, at the paper's 16 photon levels."""

    checkpoints: Positional[tuple[Path, ...]]
    """Checkpoints of `train`, or their folders; the first is the one that the others are compared with."""
    set: Path
    """Folder of a set that `dataset` rendered, or its pack (.h5)."""
    baselines: tuple[str, ...] = ("argmax", "log-matched", "fourier-8")
    """Estimators of `depth`, and CODE-K decoded without a network."""
    views: Count = None
    """Only the first N views (default: all)."""
    offset: float = 0.0
    """Move every scene this many metres away in time alone; other offsets are rendered: `dataset --offset-mode`."""
    int8: bool = False
    """Codes in 8 bits as well, summed in 16."""
    out: Path = Path("out/evaluate")
    """Folder for the table (.csv)."""


@dataclass(frozen=True, kw_only=True)
class Ultraphase(Common):
    """Compressive histograms as programs on the emulated UltraPhase processor: `table` (Supplementary Figure 5 beside
    the emulation), `run PROGRAM`, `asm FILE`, `list FILE`, `verify PROGRAM`, `sweep`."""

    action: Positional[Literal["table", "run", "asm", "list", "verify", "sweep"]] = "table"
    """What is done."""
    program: Positional[str] = ""
    """FAMILY-K with family coarse, fourier, separable, learned or addressed, or a source file (.s)."""
    define: tuple[str, ...] = ()
    """Constants of a source file, as NAME=VALUE."""
    out: File = None
    """File for the words (asm: one hexadecimal word a line), the listing (list) or the rows (table, sweep: .csv)."""
    photons: tuple[float, ...] = (550.0,)
    """Photons a pixel and frame, background included; `run` takes one number, `sweep` several."""
    signal: float = 50.0
    """Of these, photons of one laser return (run)."""
    fps: tuple[float, ...] = (30.0,)
    """Frames a second (sweep)."""
    codes: tuple[int, ...] = ()
    """K of the Fourier and separable programs (sweep; default: the seven of the paper)."""
    pixels: tuple[int, ...] = (4, 1048576)
    """Pixels of the sensor (sweep)."""
    trace: int = 0
    """Show this many instructions of one core (run)."""
    watch: str = ""
    """Show every change of this region of one core's RAM, 100 at the most (run)."""


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Scenes, tyro.conf.subcommand("scenes")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Dataset, tyro.conf.subcommand("dataset")]
    | Annotated[Sense, tyro.conf.subcommand("sense")]
    | Annotated[Depth, tyro.conf.subcommand("depth")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Ultraphase, tyro.conf.subcommand("ultraphase")]
    | Annotated[Study, tyro.conf.subcommand("study")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Report, tyro.conf.subcommand("report")]
)
