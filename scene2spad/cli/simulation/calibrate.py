"""Calibrate a multi-zone sensor from captures. Its options: `scene2spad.options.simulation`."""

from __future__ import annotations

from scene2spad.options.simulation import Calibrate
from scenes.progress import Progress


def run(command: Calibrate, progress: Progress) -> dict:
    """Run the command: captures -> sensor file, its standard errors, and the likelihood of the captures that were held
    out."""
    from scene2spad.cli.simulation import calibrating

    return calibrating.run(command, progress)
