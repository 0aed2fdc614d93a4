"""Run one stage of the bench. Its options: `studies.experiments`."""

from __future__ import annotations

import importlib

from scenes.errors import InputError
from studies.experiments import Bench
from studies.options import Progress


def run(command: Bench, progress: Progress) -> dict:
    """One stage of the bench: the module of its name, imported only when it is asked for."""
    for name, value in (("seeds", command.seeds), ("repeats", command.repeats)):
        if not 1 <= value <= 1000:
            raise InputError(f"bench: {name} {value} is outside 1 to 1000")
    return importlib.import_module(f"studies.bench.{command.stage.replace('-', '_')}").run(command, progress)
