"""Write one page of all results. Its options: `scene2spad.options.experiments`."""

from __future__ import annotations

from scene2spad.options.experiments import Report
from scenes.progress import Progress


def run(command: Report, progress: Progress) -> dict:
    """Run the command: results -> one page."""
    from scene2spad.report import page as report

    return report.run(command, progress)
