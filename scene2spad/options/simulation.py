"""Define the options of `sense` and `calibrate`. No torch, no Mitsuba: --help must be quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from scene2spad.options.common import Common, Count, File, GivenFile, Number, Positional, may_stay_open, word

FITTED = ("delay", "skew", "clock", "bin_width", "chirp", "background", "leak", "echo", "trials", "recovery")


@dataclass(frozen=True, kw_only=True)
class Sense(Common):
    """Record a transient with a single-photon sensor: photon counts to HDF5, with a picture beside it."""

    file: Positional[GivenFile]
    """A transient written by `render` (.exr)."""
    out: File = None
    """The .h5 file (default: the transient's name)."""
    sensor: str = "reference"
    """Sensor preset (reference, reference-tdc, iccv2023-train, linospad, linospad2, pf32, swissspad3, tmf8820, tmf8828,
    vl53l1x, vl53l8ch, ads6311) or a sensor file (.toml)."""
    bins: Count = None
    """Time bins of the histogram (default: the preset's)."""
    bin_width: Number = None
    """Width of a bin [s] (default: the preset's)."""
    period: Number = None
    """Period of the laser [s], whole bins (default: the preset's, or what new --bins cover)."""
    signal: Number = None
    """Mean signal photons per pixel and exposure (default: 50, or what the --radiometric optics or a calibrated sensor
    give)."""
    background: Number = None
    """Mean background photons per pixel and exposure, dark counts included (default: 50, or the sensor's dark
    counts if they are more, or what the --radiometric optics give)."""
    dark_count_rate: Number = None
    """Dark counts per second and pixel [Hz] (default: the preset's)."""
    dark_map: File = None
    """Measured dark counts per second of every pixel [Hz] (.npy), NaN in dead pixels, instead."""
    model: Literal["auto", "poisson", "first-photon", "free-running"] = "auto"
    """Detection law; auto says why it chose."""
    reset: Annotated[Literal["synchronous", "free-running"] | None, may_stay_open("{synchronous,free-running}")] = None
    """Armed at every laser cycle, or again after the dead time (default: the preset's)."""
    dead_time: Number = None
    """Dead time after a detection [s] (default: the preset's). Up to one laser period it has no effect on a synchronous
    detector, which is armed at every cycle."""
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
    pulse_fwhm: Number = None
    """Full width at half maximum of a Gaussian pulse [s], instead of the preset's."""
    pulse_tail: float = 0.0
    """Time constant of its exponential tail [s]; needs --pulse-fwhm."""
    pde: Number = None
    """Photon detection efficiency, fill factor included, 0 to 1: a --radiometric budget counts with it (default: the
    preset's)."""
    crosstalk: Number = None
    """Probability that a detection fires a given neighbour (default: the preset's)."""
    hot_pixels: Number = None
    """Share of hot pixels, placed by the seed (default: the preset's)."""
    hot_rate: Number = None
    """Dark counts per second of a hot pixel [Hz] (default: the preset's, or 1e4)."""
    dead_pixels: Number = None
    """Share of dead pixels, placed by the seed (default: the preset's)."""
    radiometric: bool = False
    """Compute the photon budget from the optics below, instead of --signal and --background."""
    pulse_energy: Number = None
    """Energy of one laser pulse [J], over the whole cone (default: the sensor file's, or 10e-9)."""
    focal_length: Number = None
    """Focal length of the lens [m] (default: the sensor file's, or 10e-3)."""
    f_number: Number = None
    """Focal length over aperture diameter (default: the sensor file's, or 2)."""
    pixel_pitch: Number = None
    """Distance from pixel to pixel [m]; the fill factor is part of --pde (default: the sensor file's, or 20e-6)."""
    transmission: Number = None
    """Transmission of lens and filter (default: the sensor file's, or 0.8)."""
    filter_width: Number = None
    """Width of the band that the filter lets through [nm] (default: the sensor file's, or 10)."""
    wavelength: Number = None
    """Wavelength of the laser [m] (default: the sensor file's, or 850e-9)."""
    export: Annotated[Literal["mat"] | None, may_stay_open("mat")] = None
    """Write the published .mat layout, and its pulse, beside the .h5 file."""
    figure: bool = True
    """Draw a picture of the counts beside the file."""


@dataclass(frozen=True, kw_only=True)
class Calibrate(Common):
    """Calibrate a multi-zone sensor from captures of a plane at known distances, and write its sensor file."""

    captures: Positional[Annotated[Path, word("[CAPTURES]")]] = Path("shipped")
    """Captures (.npz: distance_m, counts by zone and bin, and reference_counts if any); shipped: a TMF8820's that come
    with the package."""
    sensor: str = "tmf8820"
    """Preset or sensor file (.toml) that zones, and what is not fitted, are taken from."""
    out: Path = Path("sensor.toml")
    """The sensor file to write."""
    every: int = 2
    """Fit every N-th capture; the others are held out."""
    nearest: float = 0.1
    """Nearest distance that is used [m]."""
    effects: tuple[str, ...] = FITTED
    """Effects to fit beside pulse and gains; crosstalk too, if named. Effects left out are off."""
    model_error: float = 0.004
    """Relative error of the model that every bin's variance is widened by; 0 is the Poisson likelihood alone."""
