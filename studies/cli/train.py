"""Train a depth network. Its options: `studies.commands`."""

from __future__ import annotations

from studies.commands import Train
from studies.options import Progress


def run(command: Train, progress: Progress) -> dict:
    """Set -> checkpoint; Lightning is imported only when it is asked for."""
    from studies import training

    return training.run_train(command, progress)
