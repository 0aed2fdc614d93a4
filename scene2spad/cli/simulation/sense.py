"""Record a transient with a single-photon sensor. Its options: `scene2spad.options.simulation`."""

from __future__ import annotations

from scene2spad.options.simulation import Sense
from scenes.progress import Progress


def run(command: Sense, progress: Progress) -> dict:
    """Run the command: transient -> .h5, a picture of its counts, and with --export the .mat layout."""
    from scene2spad.cli.simulation import sensing

    return sensing.run(command, progress)
