"""Record a transient with a single-photon sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from studies.options import Common, File, Number, Positional, Progress, may_stay_open


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


def run(command: Sense, progress: Progress) -> dict:
    """Transient -> .h5, a picture of its counts, and with --export the .mat layout."""
    from studies.cli import sensing

    return sensing.run(command, progress)
