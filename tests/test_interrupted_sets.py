"""`dataset` with worker processes and on a Dask cluster: Ctrl-C, dead workers and a dead scheduler.

Every end is one line, nothing runs on, and the same command goes on to the same bytes.
"""

from __future__ import annotations

import os
import random
import re
import signal
import socket
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from killed import Killed, Run, Warm, check_whole, command, whole_run
from processes import is_alone, wait_for

pytest.importorskip("distributed")

SET = ("dataset", "rooms", "--width", "8", "--height", "8", "--bounces", "1", "--grid", "2", "--count", "24")
STOPPED = "interrupted; finished files stay, nothing is half-written\n"
# A line of progress comes every half a minute, which a busy machine takes for work of seconds.
PROGRESS = re.compile(r"^[^\n]+: \d+%\n", re.M)
LOST = r"scene2spad: scheduler tcp://\S+: (has gone away|cannot be reached)[^\n]*\n"
WAITING = r"(scheduler \S+ has no workers yet[^\n]*\n)*"  # where workers are later than the run
# Clients wait for a scheduler on a busy machine longer than users would.
PATIENT = "from scene2spad.datasets import workers\nworkers.CONNECT_S = 60"
SCHEDULER = """
import asyncio
from distributed import Scheduler
async def serve():
    async with Scheduler(host="127.0.0.1", port={port}, dashboard=False) as scheduler:
        await scheduler.finished()
asyncio.run(serve())
"""
WORKER = """
import asyncio
from distributed import Worker
async def work():
    async with Worker("{address}", nthreads=1, local_directory="{folder}", dashboard=False) as worker:
        await worker.finished()
asyncio.run(work())
"""


class Cluster:
    """A Dask scheduler at a port that was free, and workers without nannies."""

    def __init__(self, warm: Warm, folder: Path) -> None:
        self.warm, self.folder, self.workers = warm, folder, []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.start()

    def start(self, workers: int = 2) -> None:
        self.scheduler = self._run(SCHEDULER.format(port=self.port))
        wait_for(self._answers, self.scheduler)
        for _ in range(workers):
            self.add_worker()

    def add_worker(self) -> None:
        self.workers.append(self._run(WORKER.format(address=self.address, folder=self.folder)))

    def kill_worker(self) -> None:
        self.warm.kill(self.workers.pop(0))

    def kill_scheduler(self) -> None:
        self.warm.kill(self.scheduler)

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            if self.warm.status(process) is None:
                self.warm.kill(process)
        self.workers = []

    def _run(self, code: str) -> int:
        return self.warm.start(code, self.folder, self.folder / "cluster.txt")

    def _answers(self) -> bool:
        """Return whether somebody else answers: a socket may be given this very port, and then connects to itself."""
        with socket.socket() as asking:
            there = asking.connect_ex(("127.0.0.1", self.port)) == 0
            return there and asking.getsockname() != asking.getpeername()


@pytest.fixture(scope="module")
def whole(warm, tmp_path_factory) -> tuple[Path, float]:
    """The set made in one go, and its CPU-seconds."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, whole_run(warm, Run(command(*SET, "--out", "out")), folder)


@pytest.fixture
def cluster(warm, tmp_path) -> Iterator[Cluster]:
    (tmp_path / "cluster").mkdir()
    made = Cluster(warm, tmp_path / "cluster")
    yield made
    made.close()


def pool_workers(parent: int) -> list[int]:
    """Process numbers of the workers that a process has started, less Python's own tracker of resources."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            is_worker = b"spawn_main" in (stat.parent / "cmdline").read_bytes()
            if is_worker and int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(stat.parent.name))
    return sorted(found)


def set_of(warm: Warm, whole: tuple[Path, float], folder: Path, *more: str, before: str = "") -> Killed:
    run = Run(command(*SET, "--out", "out", *more, before=before))
    return Killed(warm, run, *whole, folder / "run", folder / "temporary")


def wait_for_views(run: Killed, child: int, count: int, delay_s: float) -> int | None:
    """Until so many views are there, and a moment longer; the exit status where the run has ended."""
    status = None

    def there() -> bool:
        nonlocal status
        status = run.warm.status(child)
        return status is not None or len([*run.folder.glob("out/views/0*.exr")]) >= count

    wait_for(there, child)
    return run.warm.wait(child, seconds=delay_s) if status is None else status


@pytest.mark.slow
@pytest.mark.parametrize("where", ["one process", "two processes", "cluster"])
def test_ctrl_c_ends_in_one_line_and_the_run_goes_on(whole, warm, tmp_path, where, request):
    """At five random moments, to the whole process group, as a terminal does."""
    options = {"one process": (), "two processes": ("--workers", "2")}
    more = options.get(where) or ()
    if where == "cluster":
        more = ("--scheduler", request.getfixturevalue("cluster").address)
    run, moments = set_of(warm, whole, tmp_path, *more, before=PATIENT), random.Random(7)
    for views in (0, 1, 4, 8, 12):
        child = run.start()
        while (status := wait_for_views(run, child, views, moments.uniform(0, 0.3))) is not None:
            run.begin_anew(status)
            child = run.start()
        warm.kill(child, signal.SIGINT)
        status = warm.wait(child)
        message = PROGRESS.sub("", run.output.read_text())
        run.output.write_text("")
        assert (status, message) in ((130, STOPPED), (0, message)) and "Traceback" not in message, message[-3000:]
        wait_for(partial(is_alone, child), child)
        check_whole(run.folder / "out")
    run.finish()


@pytest.mark.slow
def test_ten_killed_workers_of_a_cluster_change_no_byte(whole, warm, tmp_path, cluster):
    """SIGKILL to a worker at a random moment, and another in its place; the client runs on, or is run again."""
    run = set_of(warm, whole, tmp_path, "--scheduler", cluster.address, before=PATIENT)
    moments = random.Random(3)
    child = run.start()
    for number in range(10):
        if wait_for_views(run, child, 2 * number, moments.uniform(0, 0.3)) is not None:
            child = run.start()
        cluster.kill_worker()
        cluster.add_worker()
    assert warm.wait(child) in (0, 1), run.output.read_text()[-3000:]
    run.finish()  # views whose workers died again and again are told, and tried again


@pytest.mark.slow
def test_ten_killed_worker_processes_change_no_byte(whole, warm, tmp_path):
    """SIGKILL to one of the two processes of `--workers 2`, which takes the pool with it: the run goes on by itself."""
    run, moments, killed = set_of(warm, whole, tmp_path, "--workers", "2"), random.Random(5), 0
    child = run.start()
    while killed < 10:
        status = wait_for_views(run, child, min(2 * killed, 20), moments.uniform(0, 1.0))
        if status is not None:
            # a view whose process died three times is told, and done by the next run
            assert status in (0, 1), run.output.read_text()[-3000:]
            if len([*run.folder.glob("out/views/0*.exr")]) == 24:
                run.begin_anew(warm.wait(run.start()))
            child = run.start()
            continue
        workers = pool_workers(child)
        if workers:
            with suppress(ProcessLookupError):
                os.kill(moments.choice(workers), signal.SIGKILL)
                killed += 1
                check_whole(run.folder / "out")
    assert warm.wait(child) in (0, 1), run.output.read_text()[-3000:]
    run.finish()


@pytest.mark.slow
def test_five_killed_schedulers_are_one_line_each_and_the_run_goes_on(whole, warm, tmp_path, cluster):
    run, moments = set_of(warm, whole, tmp_path, "--scheduler", cluster.address), random.Random(4)
    for number in range(5):
        child = run.start()
        status = wait_for_views(run, child, max(1, 4 * number), moments.uniform(0, 0.3))
        cluster.kill_scheduler()
        status = warm.wait(child) if status is None else status
        message = PROGRESS.sub("", run.output.read_text())
        run.output.write_text("")
        gone = status == 2 and re.fullmatch(WAITING + LOST, message)
        assert gone or (status == 0 and "Traceback" not in message), f"{status} {message[-3000:]}"
        check_whole(run.folder / "out")
        cluster.close()
        cluster.start()
    set_of(warm, whole, tmp_path, "--scheduler", cluster.address, before=PATIENT).finish()


def test_an_address_where_nobody_listens_is_one_line(tmp_path, capsys, monkeypatch):
    from scene2spad.cli import main
    from scene2spad.datasets import workers

    monkeypatch.setattr(workers, "CONNECT_S", 1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    assert main([*SET, "--out", str(tmp_path / "set"), "--scheduler", address]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"scene2spad: scheduler {address}: cannot be reached") and message.count("\n") == 1
    assert main([*SET[:-1], "1", "--out", str(tmp_path / "set")]) == 0
