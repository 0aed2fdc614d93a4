"""`bench hard-cases`: scenes that break renderers, each against a closed form or a quadrature. One table for all users.

The tests run the same table, one test a case.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from pathlib import Path

from scene2spad.bench.hard import direct as hard_cases_direct
from scene2spad.bench.hard import indirect as hard_cases_indirect
from scene2spad.bench.hard import optics as hard_cases_optics
from scene2spad.bench.hard.case import Case, Measured
from scene2spad.options.experiments import Bench
from scenes.errors import InputError, require
from scenes.files import write_csv
from scenes.progress import Progress

CASES: dict[str, Case] = {
    case.name: case for case in (*hard_cases_direct.CASES, *hard_cases_indirect.CASES, *hard_cases_optics.CASES)
}


def run(command: Bench, progress: Progress) -> dict:
    """Measure every case, or those that `command.only` names, and write the table as CSV where `command.out` is set.

    `command` has `seed` and may have `out` (a folder), `only` (names) and `quick` (leave out slow ones).
    A row is one case: its quantity nearest to the limit, all of them under `quantities`, and what was clipped. Its
    seconds, oracle included, leave out renders and quadratures that an earlier row has paid for.
    """
    cases = chosen(getattr(command, "only", ()) or (), quick=getattr(command, "quick", False))
    out = getattr(command, "out", None)
    if out is not None:
        require(out.is_dir() or not out.exists(), f"{out}: is a file, expected a folder for the results")
    rows = []
    for number, case in enumerate(cases):
        progress(case.name, number / len(cases))
        rows.append(row(case, command.seed))
    progress("done", 1.0)
    result = {"rows": rows, "passed": sum(r["passed"] for r in rows), "cases": len(rows)}
    if out is not None:
        result["out"] = str(_write(out, rows))
    return result


def chosen(only: Iterable[str], *, quick: bool = False) -> list[Case]:
    """Return the cases of those names, all where none is named; InputError for a name that is not there."""
    names = [only] if isinstance(only, str) else list(only)
    for name in names:
        require(name in CASES, f"hard case {name!r}: expected one of {', '.join(CASES)}")
    return [CASES[name] for name in names] or [case for case in CASES.values() if not (quick and case.slow)]


def row(case: Case, seed: int) -> dict:
    """Return one line of the table. A case that a renderer refuses or breaks on has failed; the others go on."""
    start = time.perf_counter()
    reason = ""
    try:
        errors, clipped = case.measure(seed)
    except (InputError, ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        errors, clipped = {"refused": Measured(math.inf, 0)}, 0
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    quantity, worst = max(errors.items(), key=lambda item: item[1].fraction)
    return {
        "name": case.name,
        "passed": bool(worst.fraction <= 1),
        "quantity": quantity,
        "error": float(worst.error),
        "limit": float(worst.limit),
        "seconds": time.perf_counter() - start,
        "clipped": int(clipped),
        "oracle": case.oracle,
        "quantities": {name: [float(m.error), float(m.limit)] for name, m in errors.items()},
        **({"reason": reason} if reason else {}),
    }


def _write(out: Path, rows: list[dict]) -> Path:
    """Write the table as CSV, one line a quantity; whole or not at all."""
    out.mkdir(parents=True, exist_ok=True)
    lines = [
        {
            "name": one["name"],
            "passed": Measured(error, limit).fraction <= 1,
            "quantity": quantity,
            "error": f"{error:.4g}",
            "limit": f"{limit:.4g}",
            "seconds": f"{one['seconds']:.4g}",
            "clipped": one["clipped"],
            "oracle": one["oracle"],
        }
        for one in rows
        for quantity, (error, limit) in one["quantities"].items()
    ]
    return write_csv(lines, out / "bench-hard-cases.csv")
