"""Run one study, or all. Its options: `scene2spad.options.experiments`."""

from __future__ import annotations

from dataclasses import replace

from scene2spad.cli.experiments.study_checks import check_study
from scene2spad.cli.paths import output_folder
from scene2spad.options.experiments import STUDIES, Study
from scenes.progress import Progress


def run(command: Study, progress: Progress) -> dict:
    """Run the command: one study or all of them, or say what that would take."""
    output_folder(command.out, "the figures")
    check_study(command)
    if not command.dry_run:
        from scene2spad.plots.style import with_pdf
        from scene2spad.studies import every

        with with_pdf(command.pdf):
            return every.run(command, progress)
    from scene2spad.dry_runs.studies import dry_run

    if command.name != "all":
        return dry_run(command)
    found = [dry_run(replace(command, name=name)) for name in STUDIES]
    return {"dry_run": True, "studies": found, "out": str(command.out)}
