"""Compare trained networks with classical estimators. Its options: `studies.commands`."""

from __future__ import annotations

from studies.commands import Evaluate
from studies.options import Progress


def run(command: Evaluate, progress: Progress) -> dict:
    """Checkpoints and a set -> errors."""
    from studies import training

    return training.run_evaluate(command, progress)
