"""Run one stage of the bench. Its options: `scene2spad.options.experiments`."""

from __future__ import annotations

import importlib

from scene2spad.cli.paths import output_folder
from scene2spad.options.common import only_for
from scene2spad.options.experiments import MIN_SENSE_REPEATS, STAGES_OF, Bench
from scenes.errors import InputError
from scenes.progress import Progress


def run(command: Bench, progress: Progress) -> dict:
    """Run the command: one stage of the bench: the module of its name, imported only when it is asked for."""
    for name, value in (("seeds", command.seeds), ("repeats", command.repeats)):
        if not 1 <= value <= 1000:
            raise InputError(f"bench: {name} {value} is outside 1 to 1000")
    output_folder(command.out, "the results")
    stage = command.stage
    if stage == "sense" and command.repeats < MIN_SENSE_REPEATS:
        raise InputError(f"bench sense: --repeats {command.repeats} is below {MIN_SENSE_REPEATS}")
    purposes = {name: (stage in stages, " and ".join(stages)) for name, stages in STAGES_OF.items()}
    only_for(command, f"bench {stage}", purposes)
    return importlib.import_module(f"scene2spad.bench.{stage.replace('-', '_')}").run(command, progress)
