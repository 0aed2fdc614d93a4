"""Compare trained networks with classical estimators. Its options: `scene2spad.options.networks`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from scene2spad.cli.checks import check_model
from scene2spad.cli.paths import output_folder
from scene2spad.options.networks import Evaluate
from scenes.errors import InputError, require
from scenes.io.hdf5 import HDF5_SUFFIXES, open_checked
from scenes.progress import Progress

log = logging.getLogger("scene2spad")
PUBLISHED_SET = Path("published")


def run(command: Evaluate, progress: Progress) -> dict:
    """Run the command: checkpoints and a set -> errors."""
    output_folder(command.out, "the table")
    output_folder(command.out / "unfinished", "what is estimated")
    twice = [name for name in command.baselines if command.baselines.count(name) > 1]
    require(not twice, f"evaluate: baseline {' '.join(twice[:1])} is named twice")
    require(bool(command.checkpoints), "evaluate: no checkpoint; MODEL [MODEL ...] comes before the options")
    for path in command.checkpoints:
        check_model(path)
    if command.set != PUBLISHED_SET:
        if command.maps:
            from scene2spad.networks.depth_maps import check_free

            check_free(command.out / "maps")
        if command.levels:
            from scene2spad.networks.evaluating import photon_levels

            photon_levels(command.levels)
        _check_set(command.set)
    _check_checkpoints(command.checkpoints)
    if command.set == PUBLISHED_SET:
        from scene2spad.networks import published

        result = published.run_evaluate(command, progress)
    else:
        from scene2spad.networks import evaluating

        result = evaluating.run_evaluate(command, progress)
    _warn_of_old_maps(command)
    return result


def _check_set(path: Path) -> None:
    """Raise InputError for a set that is not there, and for a damaged pack, before torch is loaded."""
    require(path.exists(), f"{path}: file not found")
    if path.is_file() and path.suffix.lower() in HDF5_SUFFIXES:
        try:
            with open_checked(path):
                pass
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


def _warn_of_old_maps(command: Evaluate) -> None:
    """Warn of depth maps that an earlier evaluation left beside the new table: they are kept, and are not of it."""
    folder = command.out / "maps"
    if not command.maps and folder.is_dir() and any(folder.iterdir()):
        log.warning("warning: %s holds depth maps of an earlier evaluation, not of the table just written", folder)


def _check_checkpoints(paths: Sequence[Path]) -> None:
    """Raise InputError for one checkpoint under two names: it would count as two trainings."""
    from csph.networks.checkpoint import checkpoint_file
    from csph.weights.cards import checkpoint_of

    known: dict[Path, Path] = {}
    for path in paths:
        file = checkpoint_file(checkpoint_of(path)).resolve()
        require(file not in known, f"evaluate: {path} is the same checkpoint as {known.get(file)}; give it once")
        known[file] = path
