"""Ctrl-C where the pool of processes holds its locks."""

from __future__ import annotations

import subprocess
import sys

INTERRUPTING = """
import signal
from concurrent.futures import _base
from scene2spad.datasets import workers

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

class Interrupting(_base._AcquireFutures):
    def __enter__(self):
        self.futures[0]._condition.acquire()
        signal.raise_signal(signal.SIGINT)
        for future in self.futures[1:]:
            future._condition.acquire()

if __name__ == "__main__":
    _base._AcquireFutures = Interrupting
    workers._start_worker = max  # a worker of no renderer
    try:
        with workers.executor(2, None) as run:
            print(*run(list, [(0,), (1,), (2,)], lambda number, why: why))
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_ctrl_c_while_the_locks_of_all_runs_are_taken_ends_the_pool(tmp_path):
    """An exception there would leave some locked, and the pool's own thread would wait for them for ever."""
    script = tmp_path / "interrupting.py"
    script.write_text(INTERRUPTING)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0 and done.stdout == "interrupted\n" and not done.stderr, done.stderr
