"""Train a depth network. Its options: `scene2spad.options.networks`."""

from __future__ import annotations

from scene2spad.options.networks import Train
from scenes.progress import Progress


def run(command: Train, progress: Progress) -> dict:
    """Set -> checkpoint; Lightning is imported only when it is asked for."""
    if command.dry_run:
        from scene2spad.dry_runs.training import dry_run

        return dry_run(command)
    from scene2spad.networks import training

    return training.run_train(command, progress)
