"""Calibrate a multi-zone sensor from captures at known distances. No torch, no Mitsuba: --help must be quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scene2spad.options.common import Common, Positional
from scenes.progress import Progress

FITTED = ("delay", "skew", "clock", "bin_width", "chirp", "background", "leak", "echo", "trials", "recovery")


@dataclass(frozen=True, kw_only=True)
class Calibrate(Common):
    """Calibrate a multi-zone sensor from captures of a plane at known distances, and write its sensor file."""

    captures: Positional[Path] = Path("shipped")
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


def run(command: Calibrate, progress: Progress) -> dict:
    """Run the command: captures -> sensor file, its standard errors, and the likelihood of the captures that were held
    out."""
    from scene2spad.cli.simulation import calibrating

    return calibrating.run(command, progress)
