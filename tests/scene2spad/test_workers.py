"""Ctrl-C where a pool of processes is half made, or holds its locks; clusters that grow while they work."""

from __future__ import annotations

import subprocess
import sys

import pytest

from scene2spad.datasets.workers import executor
from scenes.errors import InputError

INTERRUPTING = """
import signal
from concurrent.futures import _base
from multiprocessing import resource_tracker
from scene2spad.datasets import workers

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

class Interrupting(_base._AcquireFutures):
    def __enter__(self):
        self.futures[0]._condition.acquire()
        signal.raise_signal(signal.SIGINT)
        for future in self.futures[1:]:
            future._condition.acquire()

def interrupting(*semaphore, register=resource_tracker.register):
    register(*semaphore)
    signal.raise_signal(signal.SIGINT)

if __name__ == "__main__":
    {patch}
    workers._start_worker = max  # a worker of no renderer
    try:
        with workers.executor(2, None) as run:
            print(*run(list, [(0,), (1,), (2,)], lambda number, why: why))
    except KeyboardInterrupt:
        print("interrupted")
"""
PATCHES = {
    # an exception there would leave locks that the pool's own thread waits for, for ever
    "the locks of all runs are taken": "_base._AcquireFutures = Interrupting",
    # a semaphore that the tracker of resources knows and nobody removes
    "a semaphore is made": "resource_tracker.register = interrupting",
}


@pytest.mark.parametrize("moment", PATCHES)
def test_ctrl_c_in_the_middle_of_the_pool_ends_it_without_a_word(tmp_path, moment):
    script = tmp_path / "interrupting.py"
    script.write_text(INTERRUPTING.format(patch=PATCHES[moment]))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0 and done.stdout == "interrupted\n" and not done.stderr, done.stderr


def test_a_cluster_whose_workers_join_later_has_work_for_all_of_them():
    """A run that began before its workers had joined kept three views under way, however many came."""
    distributed = pytest.importorskip("distributed")
    taken = []

    def numbers():
        for number in range(40):
            taken.append(number)
            yield (number,)

    options = {"threads_per_worker": 1, "processes": False, "protocol": "tcp", "host": "127.0.0.1"}
    with (
        distributed.LocalCluster(n_workers=1, dashboard_address=None, **options) as cluster,
        executor(1, cluster.scheduler_address) as run,
    ):
        results = run(list, numbers(), lambda number, why: why)
        next(results)
        assert len(taken) == 3
        cluster.scale(4)
        cluster.wait_for_workers(4)
        next(results)
        assert len(taken) == 1 + 3 * 4


def test_a_scheduler_that_is_lost_for_good_is_named(monkeypatch):
    """A client that has given up has no scheduler any more, whose address could be asked for."""
    distributed = pytest.importorskip("distributed")

    class GivenUp:
        status, scheduler = "closed", None

        def __init__(self, address, timeout):
            pass

        def scheduler_info(self, n_workers):
            raise OSError("gone")

        def close(self, timeout):
            pass

    monkeypatch.setattr(distributed, "Client", GivenUp)
    with pytest.raises(InputError, match=r"^scheduler tcp://a:1: has gone away"), executor(1, "tcp://a:1") as run:
        list(run(list, [(0,)], lambda number, why: why))
