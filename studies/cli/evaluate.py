"""Compare trained networks with classical estimators. Its options: `studies.commands`."""

from __future__ import annotations

from pathlib import Path

from studies.commands import Evaluate
from studies.options import Progress

PUBLISHED_SET = Path("published")


def run(command: Evaluate, progress: Progress) -> dict:
    """Checkpoints and a set -> errors."""
    if command.set == PUBLISHED_SET:
        from studies import published

        return published.run_evaluate(command, progress)
    from studies import training

    return training.run_evaluate(command, progress)
