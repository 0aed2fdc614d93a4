"""Compare trained networks with classical estimators. Its options: `scene2spad.options.networks`."""

from __future__ import annotations

from pathlib import Path

from scene2spad.options.networks import Evaluate
from scenes.progress import Progress

PUBLISHED_SET = Path("published")


def run(command: Evaluate, progress: Progress) -> dict:
    """Run the command: checkpoints and a set -> errors."""
    if command.set == PUBLISHED_SET:
        from scene2spad.datasets import published

        return published.run_evaluate(command, progress)
    from scene2spad.networks import training

    return training.run_evaluate(command, progress)
