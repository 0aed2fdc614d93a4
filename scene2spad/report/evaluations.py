"""Sum up the table of an `evaluate` for `report`: each method's means, as `evaluate` itself forms them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from scene2spad.report.files import read_rows

# heading: the figure, of which pixels, and the factor that makes it of the heading's unit
COLUMNS = {
    "MAE [mm]": ("mae_mm", "all", 1),
    "MAE of mixed pixels [mm]": ("mae_mm", "mixed", 1),
    "RMSE [mm]": ("rmse_mm", "all", 1),
    "within 10 mm [%]": ("within_10mm", "all", 100),
    "SSIM": ("ssim", "all", 1),
}


class Summary(NamedTuple):
    """Means of every method, and what they are of."""

    rows: list[dict[str, object]]
    views: int
    levels: int


def read_summary(path: Path) -> Summary:
    """Return the means of an `evaluation.csv` by method, over scenes and photon levels; ValueError or TypeError for
    a table of another kind."""
    from csph.evaluation.methods import Evaluation, Row  # loads PyTorch, which a page without evaluations does not need

    rows_read = read_rows(path, ("method", "scene", "group", "law"))
    found = Evaluation([Row(**row) for row in rows_read])  # type: ignore[arg-type]
    rows = []
    for method in dict.fromkeys(row.method for row in found.rows):
        line: dict[str, object] = {"method": method}
        for heading, (figure, group, factor) in COLUMNS.items():
            interval = found.interval([method], group, figure=figure)
            line[heading] = None if interval is None else factor * interval.mean
        rows.append(line)
    views, levels = {row.view for row in found.rows}, {(row.signal, row.background) for row in found.rows}
    return Summary(rows, len(views), len(levels))
