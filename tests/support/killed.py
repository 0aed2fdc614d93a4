"""Runs that are killed and go on: a process with everything imported, whose children each run one piece of Python.

A child is a process group of its own, so that a signal reaches its workers too. It begins where the imports end, which
take longer than the work of most tests: kills fall into the work.
"""

from __future__ import annotations

import csv
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image
from processes import Hang, cpu_seconds

from csph.networks.checkpoint import load_model
from csph.weights.torch_files import check_torch_file
from render.transient import read_transient
from render.transient.packs import read_pack
from scenes.files import read_array, read_arrays
from scenes.io.inputs import parse_json, read_whole_lines
from spad.formats.depth_map import read_depth

SERVER = """
import importlib, json, os, signal, sys, traceback

for name in sys.argv[1:]:
    importlib.import_module(name)
for line in sys.stdin:
    asked = json.loads(line)
    if "poll" in asked:
        pid, status = os.waitpid(asked["poll"], os.WNOHANG)
        print(json.dumps(os.waitstatus_to_exitcode(status) if pid else None), flush=True)
        continue
    child = os.fork()
    if child:
        try:
            os.setpgid(child, child)  # here too: whoever is first
        except OSError:
            pass
        print(child, flush=True)
        continue
    os.setpgid(0, 0)
    os.environ.update(asked["environment"])
    os.chdir(asked["folder"])
    output = os.open(asked["output"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for descriptor, other in enumerate((os.open(os.devnull, os.O_RDONLY), output, output)):
        os.dup2(other, descriptor)
    sys.argv[:] = ["-c"]
    status = 1
    try:
        exec(asked["code"], {"__name__": "__main__"})
        status = 0
    except SystemExit as stop:
        status = stop.code or 0
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
"""
# Not Mitsuba: Dr.Jit's threads would not live in a child.
MODULES = ("torch", "pytorch_lightning", "matplotlib.pyplot", "OpenEXR", "skimage.metrics", "scipy.io", "h5py")
MODULES += ("trimesh", "distributed", "csph.training.loop", "spad.formats.linospad", "scene2spad.cli", "rich.progress")


class Warm:
    """A process that has imported everything, and forks."""

    def __init__(self, *before: str) -> None:
        """`before`: a command that runs this one, as `unshare` does."""
        command = [*before, sys.executable, "-c", SERVER, *MODULES]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        environment["PYTHONFAULTHANDLER"] = "1"  # of workers, too: `wait` asks those that hang where they are
        self._server = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self._alive: dict[int, Path] = {}  # and what they print into
        self._ended: dict[int, int] = {}
        self.cpu_s = 0.0  # of the child that was waited for last

    def close(self) -> None:
        """End every child that is left, and the process."""
        for child in self._alive:
            os.killpg(child, signal.SIGKILL)
        self._server.stdin.close()
        self._server.wait()

    def _ask(self, **words: Any) -> Any:
        self._server.stdin.write(json.dumps(words) + "\n")
        self._server.stdin.flush()
        return json.loads(self._server.stdout.readline())

    def start(self, code: str, folder: Path, output: Path, **environment: str) -> int:
        """Run code in a new process group; returns its number."""
        child = self._ask(code=code, folder=str(folder), output=str(output), environment=environment)
        self._alive[child] = output
        return child

    def status(self, child: int) -> int | None:
        """Exit status, negative of a signal; None while it runs."""
        if child in self._alive:
            found = self._ask(poll=child)
            if found is None:
                return None
            del self._alive[child]
            self._ended[child] = found
        return self._ended[child]

    def wait(self, child: int, cpu_s: float = math.inf, seconds: float = math.inf) -> int | None:
        """Exit status; None where the group still runs after so many CPU-seconds, or seconds. AssertionError, with the
        stacks of all threads, where it hangs.

        Moments are told in CPU-seconds: they fall on the same work on a machine that does other things beside.
        """
        end, self.cpu_s, hang = time.monotonic() + seconds, 0.0, Hang(child)
        looked = time.monotonic()
        while (status := self.status(child)) is None and time.monotonic() < end and self.cpu_s < cpu_s:
            self.cpu_s = max(self.cpu_s, cpu_seconds(child))
            time.sleep(0.02)
            if time.monotonic() - looked > 1:
                looked = time.monotonic()
                if hang.found():
                    output = self._alive[child]
                    self.kill(child, signal.SIGABRT)
                    time.sleep(1)  # each process writes its stacks, and ends
                    raise AssertionError(f"process group {child} hangs:\n{output.read_text()}")
        return status

    def kill(self, child: int, number: int = signal.SIGKILL) -> None:
        """Send a signal to the group, and wait where it is SIGKILL."""
        os.killpg(child, number)
        if number == signal.SIGKILL:
            assert self.wait(child) is not None


def command(*argv: str, before: str = "") -> str:
    """Code that runs the command line."""
    return f"{before}\nimport sys\nfrom scene2spad.start import script\nsys.argv = {['scene2spad', *argv]!r}\nscript()"


@dataclass(frozen=True)
class Run:
    """Code that fills the folder `out` of where it runs.

    unlike    files that differ between two runs that were never stopped
    """

    code: str
    unlike: tuple[str, ...] = ("timings.jsonl",)


def other_file_system(folder: Path) -> Path | None:
    """A folder that can be written on another file system than `folder`, if there is one."""
    here = folder.stat().st_dev
    for place in map(Path, ("/dev/shm", "/tmp", "/var/tmp", str(Path.home()))):
        if place.is_dir() and os.access(place, os.W_OK) and place.stat().st_dev != here:
            return place
    return None


def contents(folder: Path, unlike: Sequence[str] = ("timings.jsonl",)) -> dict[str, Any]:
    """Every file by its bytes, journals of results by what their lines say."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in unlike]
    return {str(path.relative_to(folder)): _content(path) for path in files}


def _content(path: Path) -> Any:
    if path.suffix == ".jsonl" and path.parent.name == "results":
        return {str(key): value for key, value in read_whole_lines(path)}
    return path.read_bytes()


def check_whole(folder: Path) -> None:
    """Open every file that stands under its own name: none is half-written."""
    for path in folder.rglob("*"):
        if path.is_dir() or path.name.startswith("."):
            continue
        match path.suffix:
            case ".exr" if "maps" in path.parts:
                read_depth(path)
            case ".exr":
                read_transient(path)
            case ".h5":
                read_pack(path)
            case ".safetensors":
                load_model(path)
            case ".ckpt":
                check_torch_file(path)
            case ".npy":
                read_array(path)
            case ".json":
                parse_json(path.read_bytes())
            case ".csv":
                rows = [*csv.reader(path.open(newline=""))]
                assert path.read_bytes().endswith(b"\n") and len({len(row) for row in rows}) == 1, path
            case ".txt":  # keys of views, one a line
                assert path.read_bytes().endswith(b"\n"), path
            case ".png":
                Image.open(path).verify()
            case ".jsonl" | ".mat":  # lines that are cut are passed over; .mat by its bytes at the end
                pass
            case ".npz":
                read_arrays(path)
            case other:
                raise AssertionError(f"{path}: a file of kind {other!r} nobody expects")


class Killed:
    """One run that is killed again and again in `folder`, beside what the same run gives unstopped."""

    def __init__(self, warm: Warm, run: Run, whole: Path, cpu_s: float, folder: Path, tmpdir: Path) -> None:
        self.warm, self.run, self.whole, self.cpu_s = warm, run, whole, cpu_s
        self.folder, self.tmpdir, self.output = folder, tmpdir, folder / "output.txt"
        for made in (folder, tmpdir):
            made.mkdir(parents=True, exist_ok=True)

    def kill(self, times: int, moments: random.Random, fraction: float = 0.6) -> None:
        """SIGKILL after random times up to a share of the whole; a run that has ended by then begins anew."""
        killed = 0
        while killed < times:
            child = self.start()
            status = self.warm.wait(child, moments.uniform(0, fraction) * self.cpu_s)
            if status is None:
                self.warm.kill(child)
                killed += 1
                check_whole(self.folder / "out")
            else:
                self.begin_anew(status)

    def start(self) -> int:
        return self.warm.start(self.run.code, self.folder, self.output, TMPDIR=str(self.tmpdir))

    def begin_anew(self, status: int | None) -> None:
        """Check what a run made that has ended, and remove it."""
        self.check_end(status)
        shutil.rmtree(self.folder / "out")

    def finish(self) -> None:
        """Run to the end."""
        self.check_end(self.warm.wait(self.start()))

    def check_end(self, status: int | None) -> None:
        """The same bytes as the whole run's, nothing else, and no traceback in what was printed until now."""
        message = self.output.read_text()
        assert status == 0 and "Traceback" not in message, message[-3000:]
        found, expected = (contents(f / "out", self.run.unlike) for f in (self.folder, self.whole))
        assert sorted(found) == sorted(expected), {*found} ^ {*expected}
        other = [name for name in found if found[name] != expected[name]]
        assert not other, other
        left = [path.name for path in self.tmpdir.rglob("*")]
        assert not left, left


def whole_run(warm: Warm, run: Run, folder: Path) -> float:
    """The run in one go; returns its CPU-seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    status = warm.wait(warm.start(run.code, folder, folder / "output.txt"))
    assert status == 0, (folder / "output.txt").read_text()[-3000:]
    return warm.cpu_s
