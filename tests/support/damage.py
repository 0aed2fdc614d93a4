"""Damaged copies of a good file, and a process that reads them: no crash, no traceback, no hang, no wild memory.

`python tests/support/damage.py READER FOLDER GOOD` reads every file of a folder and prints one JSON line a file.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from processes import Hang

# What one file may take: seconds of the processor, children included, since others may keep the machine busy; memory
# above that of the process before its first file.
SECONDS, MEMORY_BYTES = 10.0, 2 << 30
ENDLESS_CPU_S, ASLEEP_S = 60.0, 120.0  # after which a file is given up
ROOT = Path(__file__).parents[2]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a copy with bytes flipped, a range zeroed, cut off, swapped, repeated or removed."""
    array, size = bytearray(data), len(data)

    def span(most: int) -> tuple[int, int]:
        start = int(rng.integers(size))
        return start, min(size, start + 1 + int(rng.integers(most)))

    kind = int(rng.integers(7))
    if kind <= 1:
        for _ in range(1 if kind == 0 else int(rng.integers(2, 20))):
            array[int(rng.integers(size))] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        start, end = span(max(1, size // 4))
        array[start:end] = bytes(end - start)
    elif kind == 3:
        array = array[: int(rng.integers(size))]
    elif kind == 4:
        (a, b), (c, d) = sorted((span(64), span(64)))
        if b <= c:
            array[a:b], array[c:d] = array[c:d], array[a:b]
        else:
            array[a:b] = bytes([255]) * (b - a)
    elif kind == 5:
        start, end = span(max(1, size // 8))
        array[start:start] = array[start:end]
    else:
        start, end = span(max(1, size // 8))
        del array[start:end]
    return bytes(array)


@dataclass(frozen=True)
class Verdict:
    """What became of one damaged file: `outcome` is refused, same, changed, unbounded, or a fault with its words."""

    file: str
    outcome: str
    words: str
    seconds: float
    memory_bytes: int


def read_all(reader: str, folder: Path, good: Path) -> list[Verdict]:
    """Read every file of a folder in processes of their own; one that dies or hangs is a verdict, and another goes on.

    `good` holds the undamaged file that results are compared with.
    """
    left, verdicts = sorted(path.name for path in folder.iterdir() if path.is_file()), []
    while left:
        listing = folder.parent / f"{folder.name}.list"
        listing.write_text("\n".join(left))
        found, how = _read_some(reader, folder, good, listing, len(left))
        verdicts += found
        left = left[len(found) :]
        if left:
            verdicts.append(Verdict(left.pop(0), how, "", 0.0, 0))
    return verdicts


def _read_some(reader: str, folder: Path, good: Path, listing: Path, count: int) -> tuple[list[Verdict], str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, __file__, reader, str(folder), str(good), str(listing)]
    found: list[Verdict] = []
    options = {"stdout": subprocess.PIPE, "env": environment, "cwd": folder, "start_new_session": True}
    with subprocess.Popen(command, **options) as process:
        hang = Hang(process.pid, ENDLESS_CPU_S, ASLEEP_S)
        while len(found) < count:
            if not select.select([process.stdout], [], [], 1.0)[0]:
                if hang.found():
                    os.killpg(process.pid, signal.SIGKILL)
                    return found, f"hang of over {ENDLESS_CPU_S:g} CPU-s, or asleep for {ASLEEP_S:g} s"
                continue
            line = process.stdout.readline()
            if not line:
                break
            hang = Hang(process.pid, ENDLESS_CPU_S, ASLEEP_S)
            message = json.loads(line)
            if "ready" not in message:
                found.append(Verdict(**message))
    return found, f"death by status {process.returncode}"


def _cpu_seconds() -> float:
    return sum(os.times()[:4])


def _peak_bytes() -> int:
    """Of this process, or of the largest child that has ended."""
    return 1024 * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def _numbers(values: object) -> tuple[str, bool]:
    """Digest arrays and whether all that should be finite are: readers give pairs (array, may hold NaN)."""
    sha, finite = hashlib.sha256(), True
    for array, may_hold_nan in values:
        array = np.ascontiguousarray(array)
        sha.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        if array.dtype.kind == "f" and not may_hold_nan:
            finite = finite and bool(np.isfinite(array).all())
    return sha.hexdigest(), finite


def _main(reader: str, folder: Path, good: Path, listing: Path) -> None:
    sys.path.insert(0, str(Path(__file__).parent))
    from readers import READERS

    from scenes.errors import InputError

    # what libraries print to stdout must not be taken for a verdict, and is a fault of its own
    report = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    read = READERS[reader].read
    expected, _ = _numbers(read(good))
    before = _peak_bytes()
    print(json.dumps({"ready": True}), file=report, flush=True)
    for name in listing.read_text().split("\n"):
        start, words = _cpu_seconds(), ""
        try:
            found, finite = _numbers(read(folder / name))
            outcome = "same" if found == expected else "changed" if finite else "not finite"
        except InputError as error:
            words = str(error)
            named = Path(name).name in words or Path(name).stem in words
            outcome = "refused" if "\n" not in words and named else "refused badly"
        except BaseException as error:  # every other one is what the test looks for
            outcome, words = f"traceback of {type(error).__name__}", str(error)[:200]
        verdict = Verdict(name, outcome, words[:300], _cpu_seconds() - start, max(0, _peak_bytes() - before))
        print(json.dumps(verdict.__dict__), file=report, flush=True)


if __name__ == "__main__":
    _main(sys.argv[1], *map(Path, sys.argv[2:]))
