"""Compare the error that a set's views state with their true one, against much finer renders of the same views.

    python tools/set_error.py FOLDER [--views 16] [--paths 256] [--grid 12]

FOLDER was filled by `scene2spad dataset`. Of some views, evenly spread over it, two references are rendered with other
noise: so many paths a pixel, rays a side of a pixel, bounces beyond those that the view has, and hardly any merging.
The true error is the nRMSE of the expected counts on the reference sensor after the pulse, by the counts of `sense`
and not by the renderer's own estimate. The references' noise is independent and leaves no trace in it
(`measured_error`); it holds the energy that a view's plan leaves out, too, which the stated error does not.
"""

from __future__ import annotations

import argparse
import io
import math
import sys
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from render.settings import MAX_BOUNCES
from render.transient import Transient, read_transient
from scene2spad.datasets.rendering import Job, render_view
from scene2spad.studies.render_error import FINE_MERGING, measured_error
from scenes.errors import InputError, require
from scenes.io.inputs import read_json_object
from scenes.io.set_index import read_set_index

MORE_BOUNCES, REFERENCES = 6, 2
EDGE_THRESHOLD = 0.1  # of a reference's cells


def reference(job: Job, view: int, again: int) -> Transient:
    """Render a view with other noise than the set's; InputError where it cannot be rendered."""
    done = render_view(job, view, again)
    if done.exr is None:
        raise InputError(f"view {view} of {job.set} cannot be rendered: {done.record.get('failed')}")
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(done.exr)
        file.flush()
        return read_transient(Path(file.name))


def errors_of(folder: Path, record: dict, job: Job) -> tuple[float, float]:
    """Return stated and true nRMSE of one view, rendered again as `job` says but for its bounces."""
    bounces = min(record["plan"]["bounces"] + MORE_BOUNCES, MAX_BOUNCES)
    job = replace(job, bounces=1 if record["plan"]["bounces"] == 1 else bounces)
    fine = [reference(job, record["view"], again) for again in range(1, 1 + REFERENCES)]
    found = read_transient(folder / record["file"])
    return record["error"], measured_error([found], *([one] for one in fine))


def fine_job(folder: Path, paths: int, grid: int) -> Job:
    """Return the job of a set's folder, with so many paths a pixel and rays a side of a pixel instead of a target."""
    made = read_json_object(folder / "set.json")
    job = Job(**{field.name: made[field.name] for field in fields(Job) if field.name in made})
    return replace(job, error=None, spp=paths, grid=grid, edge_threshold=EDGE_THRESHOLD, merging=FINE_MERGING)


def table(rows: list[tuple[int, float, float]]) -> str:
    """Return one line a view (number, stated, true, stated / true), and one of medians and root mean squares.

    The references' noise can make a small true error 0; its ratio is infinite.
    """
    out = io.StringIO()
    all_stated, all_true = (np.array(column, dtype=float) for column in list(zip(*rows, strict=True))[1:])
    ratios = np.divide(all_stated, all_true, out=np.full(len(rows), np.inf), where=all_true > 0)
    for (view, stated, true), ratio in zip(rows, ratios, strict=True):
        out.write(f"view {view:>6}: stated {stated:.2%}, true {true:.2%}, ratio {ratio:.3f}\n")
    medians = (np.median(values) for values in (all_stated, all_true, ratios))
    rms = (math.sqrt(np.mean(values**2)) for values in (all_stated, all_true))
    out.write("median stated {:.2%}, true {:.2%}, ratio {:.3f}; ".format(*medians))
    out.write("root mean square {:.2%}, {:.2%}\n".format(*rms))
    return out.getvalue()


def main(argv: list[str] | None = None) -> int:
    """Run the script; return its exit status, 2 for what cannot be compared."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--paths", type=int, default=256)
    parser.add_argument("--grid", type=int, default=12)
    asked = parser.parse_args(argv)
    try:
        records = [record for record in read_set_index(asked.folder) if "failed" not in record]
        require(1 <= asked.views <= len(records), f"views {asked.views} is outside 1 to {len(records)}")
        job = fine_job(asked.folder, asked.paths, asked.grid)
        rows = []
        for number in np.arange(asked.views) * len(records) // asked.views:
            rows.append((records[number]["view"], *errors_of(asked.folder, records[number], job)))
            print(f"view {rows[-1][0]} done", file=sys.stderr, flush=True)
    except InputError as error:
        print(f"set_error: {error}", file=sys.stderr)
        return 2
    print(table(rows), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
