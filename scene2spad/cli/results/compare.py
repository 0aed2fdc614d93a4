"""`compare FILE`: several depth methods on one histogram, as one table and one figure."""

from __future__ import annotations

import time
from dataclasses import dataclass

from scene2spad.cli.opening import open_for_depth
from scene2spad.cli.paths import PNG_FIGURE, Mark, begins, check_target, input_file, keep_foreign, picture
from scene2spad.options.common import Common, File, GivenFile, Positional
from scenes.errors import require
from scenes.progress import Progress

FIGURES = ("mae_mm", "rmse_mm", "median_mm", "median_abs_mm", "within_10mm", "pixels", "beyond_range", "missing")
TABLE = Mark("table of `compare`", lambda path: begins(path, rb"method,mae_mm,rmse_mm,"))


@dataclass(frozen=True, kw_only=True)
class Compare(Common):
    """Estimate depth from one histogram by several methods: one table (.csv) and one figure (.png). Every method sees
    the same photons."""

    file: Positional[GivenFile]
    """A histogram written by `sense` (.h5), its counts as `export` wrote them (.npz, .h5), or a frame or capture of the
    published family (.mat)."""
    methods: tuple[str, ...] = ("argmax", "log-matched", "fourier-16", "learned-1024x2x2-128x-t12-mixed-s13")
    """Estimators of `depth`, codes with their number (fourier-16), codes of your own (K, T) in a file (.npy, or .txt
    as `export` writes it), names of networks (see `models`) or their checkpoints."""
    frame: int = 0
    """Frame of a capture (.mat) of several, from 0."""
    unmixed: bool = False
    """Leave out pixels that see surfaces more than 50 mm apart."""
    out: File = None
    """The table to write (.csv); the figure (.compare.png) lies beside it (default: the histogram's name with
    -compare.csv)."""


def run(command: Compare, progress: Progress) -> dict:
    """Run the command: one histogram -> depth by every method, a table and a figure."""
    from scene2spad.methods import depth_method, is_classical
    from scene2spad.networks.end_warnings import warn_of_unfinished
    from scene2spad.plots.figures import draw_comparison
    from scenes.files import write_csv
    from spad.estimators.depth import histogram_errors

    require(bool(command.methods), "compare: no method")
    require(len(set(command.methods)) == len(command.methods), "compare: a method is named twice")
    source = input_file(command.file)
    out = command.out or source.with_name(f"{source.stem}-compare.csv")
    require(out.suffix.lower() == ".csv", f"{out}: the table must end in .csv")
    figure = picture(out, "compare")
    for target in (out, figure):
        check_target(target, source)
    keep_foreign(out, TABLE)
    keep_foreign(figure, PNG_FIGURE)
    histogram = open_for_depth(source, command.frame)
    methods = {name: depth_method(name, histogram.sensor, seed=command.seed) for name in command.methods}
    for name in command.methods:
        if not is_classical(name):
            warn_of_unfinished(name)
    rows, depths = [], {}
    for number, (name, method) in enumerate(methods.items()):
        progress(name, number / len(methods))
        start = time.perf_counter()
        depths[name] = method(histogram)
        seconds = time.perf_counter() - start
        exclude = histogram.mixed if command.unmixed else None
        errors = histogram_errors(depths[name], histogram, exclude=exclude)
        rows.append({"method": name, **{key: errors[key] for key in FIGURES}, "seconds": round(seconds, 3)})
    write_csv(rows, out)
    drawn = draw_comparison(histogram, depths, dict(zip(methods, rows, strict=True)), figure)
    shown = rows if command.json else _table(rows)
    return {"methods": shown, "table": str(out), "figure": str(drawn)}


def _table(rows: list[dict]) -> list[str]:
    """Return the rows as aligned lines."""
    from spad.estimators.depth import no_error_reason

    width = max(len(row["method"]) for row in rows)
    lines = [f"{'method':<{width}}  {'MAE mm':>8} {'RMSE mm':>8} {'< 10 mm':>8} {'missing':>8} {'seconds':>8}"]
    for row in rows:
        errors = f"{row['mae_mm']:>8.1f} {row['rmse_mm']:>8.1f} {row['within_10mm']:>8.1%}"
        errors = errors if row["pixels"] else f"{no_error_reason(row):>26}"
        lines.append(f"{row['method']:<{width}}  {errors} {row['missing']:>8d} {row['seconds']:>8.2f}")
    return lines
