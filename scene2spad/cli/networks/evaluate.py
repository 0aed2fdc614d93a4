"""Compare trained networks with classical estimators. Its options: `scene2spad.options.networks`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scene2spad.cli.paths import output_folder
from scene2spad.options.networks import Evaluate
from scenes.errors import require
from scenes.progress import Progress

PUBLISHED_SET = Path("published")


def run(command: Evaluate, progress: Progress) -> dict:
    """Run the command: checkpoints and a set -> errors."""
    output_folder(command.out, "the table")
    twice = [name for name in command.baselines if command.baselines.count(name) > 1]
    require(not twice, f"evaluate: baseline {' '.join(twice[:1])} is named twice")
    _check_checkpoints(command.checkpoints)
    if command.set == PUBLISHED_SET:
        from scene2spad.datasets import published

        return published.run_evaluate(command, progress)
    from scene2spad.networks import evaluating

    return evaluating.run_evaluate(command, progress)


def _check_checkpoints(paths: Sequence[Path]) -> None:
    """Raise InputError for one checkpoint under two names: it would count as two trainings."""
    from csph.networks.model import checkpoint_file
    from csph.weights.cards import checkpoint_of

    known: dict[Path, Path] = {}
    for path in paths:
        file = checkpoint_file(checkpoint_of(path)).resolve()
        require(file not in known, f"evaluate: {path} is the same checkpoint as {known.get(file)}; give it once")
        known[file] = path
