"""Run programs of the emulated in-pixel processor. Its options: `scene2spad.options.experiments`."""

from __future__ import annotations

from scene2spad.options.experiments import Ultraphase
from scenes.progress import Progress


def run(command: Ultraphase, progress: Progress) -> dict:
    """Run the command: the emulated in-pixel processor."""
    from scene2spad.cli.experiments import ultraphase_actions

    return ultraphase_actions.run(command, progress)
