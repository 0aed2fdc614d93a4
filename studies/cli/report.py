"""Write one page of all results. Its options: `studies.experiments`."""

from __future__ import annotations

from studies.experiments import Report
from studies.options import Progress


def run(command: Report, progress: Progress) -> dict:
    """Results -> one page."""
    from studies import report

    return report.run(command, progress)
