"""Compressive histograms as programs on the emulated in-pixel processor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scene2spad.options.common import Common, Count, File, Positional
from scenes.progress import Progress


@dataclass(frozen=True, kw_only=True)
class Ultraphase(Common):
    """Compressive histograms as programs on the emulated UltraPhase processor: `table` (Supplementary Figure 5 beside
    the emulation), `compile MODEL` (a trained model's codes), `run PROGRAM`, `asm FILE`, `list FILE`, `verify PROGRAM`,
    `sweep`."""

    action: Positional[Literal["table", "compile", "run", "asm", "list", "verify", "sweep"]] = "table"
    """Action: tabulate or sweep the chip's power, or compile, run, assemble, list or verify a program."""
    program: Positional[str] = ""
    """FAMILY-K with family coarse, fourier, separable, learned or addressed, or a source file (.s); of compile, a
    shipped model's name or a checkpoint."""
    headroom: Count = None
    """Make the tables so many bits smaller, so that sums of bright pixels fit 16 bits (compile): 0 to 4 (default: 1; a
    model that was trained for the chip keeps the ranges that it learned)."""
    define: tuple[str, ...] = ()
    """Constants of a source file, as NAME=VALUE."""
    out: File = None
    """File for the words (asm: one hexadecimal word a line), the listing (list; compile: with the tables) or the rows
    (table, sweep: .csv)."""
    photons: tuple[float, ...] = (550.0,)
    """Photons a pixel and frame, background included; `run` takes one number, `sweep` several."""
    signal: float = 50.0
    """Photons of one laser return among --photons (run)."""
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


def run(command: Ultraphase, progress: Progress) -> dict:
    """Run the command: the emulated in-pixel processor."""
    from scene2spad.cli.experiments import ultraphase_actions

    return ultraphase_actions.run(command, progress)
