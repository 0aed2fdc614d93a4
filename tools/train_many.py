"""Train many models side by side on one machine, as a list of jobs says; a run that was killed goes on.

    python tools/train_many.py jobs.json --out runs --processes 6

`jobs.json` is a list of objects: `name`, and options of `scene2spad train` as Python writes them, for example
{"name": "learned-256x4x4-128x-s0", "design": "learned", "block": [256, 4, 4], "preset": "gpu", "set": ["rooms.h5"]}.
Every model is trained by a process of its own in `runs/NAME`, in the order of the list. What is finished goes to
`runs/shipped` as the package ships it. Needs neither Mitsuba nor OpenEXR.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path


def train_one(job: dict, out: Path) -> None:
    """Train the model of one job in this process, and ship it."""
    from csph.weights.shipped import ship
    from scene2spad.networks.training import run_train
    from scene2spad.options.networks import Train

    options = dict(job)
    name = options.pop("name")
    for key in ("set", "validation"):
        options[key] = tuple(map(Path, options.get(key, ())))
    for key in ("block", "set_weights", "layer"):
        if key in options:
            options[key] = tuple(options[key])
    result = run_train(Train(**options, out=out / name), lambda what, fraction: None)
    ship(out / name, name, out / "shipped")
    print(json.dumps({"name": name, **result}, default=str), flush=True)


def run_job(job: dict, arguments: argparse.Namespace) -> str:
    """Run one job in a process of its own, with its log beside the run; returns a line about it."""
    name, out = job["name"], arguments.out
    if (out / "shipped" / name / "model.safetensors").is_file():
        return f"{name}: was finished"
    start = time.monotonic()
    with (out / f"{name}.log").open("a") as log:
        command = [sys.executable, __file__, str(arguments.jobs), "--out", str(out), "--only", name]
        status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode
    return f"{name}: {'finished' if status == 0 else f'FAILED ({status})'} after {time.monotonic() - start:.0f} s"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("jobs", type=Path, help="list of jobs (.json)")
    parser.add_argument("--out", type=Path, default=Path("out/models"), help="folder of the runs")
    parser.add_argument("--processes", type=int, default=1, help="models trained at a time")
    parser.add_argument("--only", help="train this one in this process")
    arguments = parser.parse_args()
    jobs = json.loads(arguments.jobs.read_text())
    if arguments.only:
        train_one(next(job for job in jobs if job["name"] == arguments.only), arguments.out)
        return 0
    arguments.out.mkdir(parents=True, exist_ok=True)
    lines = []
    with ThreadPoolExecutor(arguments.processes) as pool:
        for line in pool.map(lambda job: run_job(job, arguments), jobs):
            print(line, flush=True)
            lines.append(line)
    return int(any("FAILED" in line for line in lines))


if __name__ == "__main__":
    sys.exit(main())
