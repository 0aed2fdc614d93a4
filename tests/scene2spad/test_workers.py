"""Ctrl-C and death where a worker is half started, or half through an answer; clusters that grow while they work."""

from __future__ import annotations

import subprocess
import sys

import pytest

from scene2spad.datasets import processes
from scene2spad.datasets.workers import executor
from scenes.errors import InputError

SCRIPT = """
import os, signal, time
from multiprocessing import active_children
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from scene2spad.datasets import processes, workers

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

def interrupt_parent():
    os.kill(os.getppid(), signal.SIGINT)
    time.sleep(100)

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def half_sent(numbers, then):
    def send(self, message):
        os.write(self.fileno(), message[: len(message) // 2])
        then()
    if 1 in numbers:
        Connection._send = send
    return [*numbers]

def interrupted_half_sent(numbers):
    return half_sent(numbers, interrupt_parent)

def dead_half_sent(numbers):
    return half_sent(numbers, die)

def interrupted_with_parent(numbers):
    signal.raise_signal(signal.SIGINT)
    interrupt_parent()

def interrupted_start(self, start=BaseProcess.start):
    start(self)
    signal.raise_signal(signal.SIGINT)

def late_runs():
    yield from [(0,), (1,)]
    for child in active_children():
        child.kill()
        child.join()
    yield from [(2,), (3,)]

if __name__ == "__main__":
    processes.start_worker = max  # a worker of no renderer
    work, runs = list, [(0,), (1,), (2,)]
    {moment}
    try:
        with workers.executor(2, None) as run:
            print(*sorted(run(work, runs, lambda number, why: number + 100)))
    except KeyboardInterrupt:
        print("interrupted")
    assert not active_children()
"""
# What happens, and what is printed: numbers that are done, or 100 more where they are lost.
MOMENTS = {
    "Ctrl-C within an answer": ("work = interrupted_half_sent", "interrupted"),
    "Ctrl-C in the workers, too": ("work = interrupted_with_parent", "interrupted"),
    "Ctrl-C while a worker starts": ("BaseProcess.start = interrupted_start", "interrupted"),
    "a worker dies within its answer": ("work = dead_half_sent", "0 2 101"),
    "all workers die between two runs": ("runs = late_runs()", "0 1 2 3"),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_run_ends_whatever_its_workers_were_at(tmp_path, moment):
    script = tmp_path / "moment.py"
    happens, printed = MOMENTS[moment]
    script.write_text(SCRIPT.format(moment=happens))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100)
    warned = {"a worker process died; starting another"} if "die" in moment else set()
    assert (done.returncode, done.stdout) == (0, f"{printed}\n"), done.stderr
    assert {*done.stderr.splitlines()} == warned


def test_an_error_of_the_work_is_raised_with_where_it_came_from(monkeypatch):
    monkeypatch.setattr(processes, "start_worker", max)  # a worker of no renderer
    with executor(2, None) as run, pytest.raises(TypeError, match="bad operand") as raised:
        list(run(abs, [(0,)], lambda number, why: number))
    assert "in _serve" in raised.value.__notes__[0]


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
