"""Run one study. Its options: `studies.experiments`."""

from __future__ import annotations

import importlib

from scenes.errors import InputError
from studies.experiments import ABLATIONS, Study
from studies.options import Progress


def run(command: Study, progress: Progress) -> dict:
    """One study: the module of its name, imported only when it is asked for."""
    if command.out.is_file():
        raise InputError(f"{command.out}: is a file, expected a folder for the figures")
    module = "ablations" if command.name in ABLATIONS else command.name.replace("-", "_")
    return importlib.import_module(f"studies.{module}").run(command, progress)
