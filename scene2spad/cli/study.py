"""Run one study. Its options: `scene2spad.options.experiments`."""

from __future__ import annotations

import importlib
from importlib.util import find_spec

from scene2spad.options.experiments import ABLATIONS, Study
from scenes.errors import InputError
from scenes.progress import Progress


def run(command: Study, progress: Progress) -> dict:
    """Run the command: one study: the module of its name, imported only when it is asked for."""
    if command.out.is_file():
        raise InputError(f"{command.out}: is a file, expected a folder for the figures")
    name = "ablations" if command.name in ABLATIONS else command.name.replace("-", "_")
    room = f"scene2spad.studies.{name}"
    spec = find_spec(room)
    module = room if spec is None or spec.submodule_search_locations is None else f"{room}.study"
    return importlib.import_module(module).run(command, progress)
