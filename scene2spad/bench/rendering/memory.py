"""`bench render --memory`: peak memory above a fresh process after its imports, ours against mitransient."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

from scene2spad.bench.rendering import ours, peers, settings
from scene2spad.bench.rendering.settings import BIN_M, BINS, BOUNCES, METHODS
from scene2spad.options.common import only_for
from scene2spad.options.experiments import Bench
from scenes.errors import InputError, require
from scenes.progress import Progress

SIZE, SPP = 256, 64
OF_TIMES = ("repeats", "seeds", "quick", "seed", "cache", "out")  # options that mean nothing here


def run(command: Bench, progress: Progress) -> dict:
    """Run the bench: one process a method, 256 x 256 pixels (or those of --sizes), 64 samples a pixel, full transport.

    Raises InputError for options of the comparison of times, and more than one scene or size.
    """
    only_for(command, "bench render --memory", dict.fromkeys(OF_TIMES, (False, "the bench without --memory")))
    for name, given in (("scenes", command.scenes), ("sizes", command.sizes)):
        words = " ".join(map(str, given))
        require(len(given) <= 1, f"bench render --memory: --{name} {words}: expected one, memory is measured of one")
    (scene,), (size,) = command.scenes or ("flash",), command.sizes or (SIZE,)
    methods = list(METHODS["full"])
    if command.peer == "none" or not peers.available():
        methods = [m for m in methods if m.code == "ours"]
    peaks = {}
    for number, method in enumerate(methods):
        progress(f"memory of {method.name}", number / len(methods))
        data = [] if command.data is None else [str(command.data)]
        argv = [sys.executable, "-m", "scene2spad.bench.rendering.memory", method.name, scene, str(size), *data]
        done = subprocess.run(argv, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise InputError(f"bench: the process that measures {method.name} ended with {done.returncode}: {last}")
        peaks[method.name] = json.loads(done.stdout.splitlines()[-1])
    theirs = min((peaks[m.name] for m in methods if m.code != "ours"), default=math.nan)
    result = {"scene": scene, "size": size, "spp": SPP, "peak_mb_above_imports": peaks}
    if math.isfinite(theirs):
        result["ours_over_mitransient"] = {m.name: peaks[m.name] / theirs for m in methods if m.code == "ours"}
    return result


def measure(name: str, scene_name: str, size: int, data: Path | None) -> float:
    """Return peak resident memory of loading the scene and rendering it, above the process as it is now [MB].

    Ours ends at its samples, since nothing of ours needs bins; mitransient has nothing but the dense tensor.
    """
    method = next(m for m in METHODS["full"] if m.name == name)
    from render.scene.traced_scene import TracedScene

    if method.code != "ours":
        import mitransient  # noqa: F401  (an import, so not counted)
    before = reset_peak_mb()
    scene = settings.bench_scene(scene_name, size, data)
    if method.code == "ours":
        kept = ours.trace(TracedScene(scene), method, BOUNCES["full"], SPP, 1)
    else:
        kept = peers.Peer(TracedScene(scene), method.sampler, BOUNCES["full"], BINS, BIN_M).render(SPP, 1)
    peak = peak_mb() - before
    del kept
    return peak


def reset_peak_mb() -> float:
    """Forget the process's peak memory and return what it holds now [MB]; NaN where Linux's /proc is not there."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return math.nan
    return _status_mb("VmRSS")


def peak_mb() -> float:
    """Return peak resident memory since the process's start or the last reset [MB]; NaN where it cannot be told."""
    return _status_mb("VmHWM")


def _status_mb(name: str) -> float:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:")), math.nan)


if __name__ == "__main__":
    _, method_name, scene_, size_, *data_ = sys.argv
    sys.stdout.write(json.dumps(measure(method_name, scene_, int(size_), Path(data_[0]) if data_ else None)) + "\n")
