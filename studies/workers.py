"""Who does the work on numbered things: this process, several processes, or the workers of a Dask cluster.

Work comes in runs, numbers that one process does in a row. A run whose worker dies is tried again number by number.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from threading import Thread
from typing import Any

from scenes.errors import InputError

log = logging.getLogger("scene2spad")

TRIES = 3  # of a number whose worker process died
Numbers = tuple[int, ...]
Work = Callable[[Numbers], list]  # one result a number; pickled to other processes
Lost = Callable[[int, str], Any]  # the result of a number that nobody could do, and why
Run = Callable[[Work, Sequence[Numbers], Lost], Iterator[Any]]


@contextmanager
def executor(workers: int, scheduler: str | None) -> Iterator[Run]:
    """Something that does runs and gives their results, in whatever order; InputError if a scheduler is not there."""
    if scheduler is not None:
        with _dask_client(scheduler) as client:
            yield lambda work, runs, lost: _on_dask(client, work, runs, lost)
    elif workers == 1:
        yield lambda work, runs, lost: (result for run in runs for number in run for result in work((number,)))
    else:
        yield lambda work, runs, lost: _on_processes(workers, work, runs, lost)


def _on_processes(workers: int, work: Work, runs: Sequence[Numbers], lost: Lost) -> Iterator[Any]:
    """Several processes of ours. One that dies takes the pool with it: a new one goes on, and retries what was lost."""
    waiting, workers = list(runs)[::-1], min(workers, len(runs))
    tries = {number: 0 for run in waiting for number in run}
    threads = max(1, (os.cpu_count() or 1) // workers)
    while waiting:
        with ProcessPoolExecutor(workers, get_context("spawn"), _start_worker, (threads,)) as pool:
            running: dict[Future, Numbers] = {}
            try:
                while waiting or running:
                    while waiting and len(running) < 2 * workers:
                        run = waiting.pop()
                        running[pool.submit(work, run)] = run
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        done = future.result()
                        del running[future]
                        yield from done
            except BrokenProcessPool:
                for number in sorted((number for run in running.values() for number in run), reverse=True):
                    tries[number] += 1
                    if tries[number] < TRIES:
                        waiting.append((number,))
                    else:
                        yield lost(number, f"its process died {TRIES} times")
                log.warning("a worker process died; starting others")


def _start_worker(threads: int) -> None:
    """In a new process: as many threads as its share of the cores; it ends when the one that started it does."""
    Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    from render.llvm import start_mitsuba

    start_mitsuba()
    import drjit

    drjit.set_thread_count(threads)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


@contextmanager
def _dask_client(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs the package `distributed`: pip install 'scene2spad[cluster]'") from None
    try:
        client = Client(address, timeout=20)
    except (OSError, ValueError, TypeError) as error:
        told = " ".join(str(error).split())[:120]
        raise InputError(f"scheduler {address}: cannot be reached ({told or type(error).__name__})") from None
    try:
        yield client
    finally:
        client.close()


def _on_dask(client: Any, work: Work, runs: Sequence[Numbers], lost: Lost) -> Iterator[Any]:
    """A cluster's workers, a few tasks each in flight, so that results do not heap up; a dead worker's move on."""
    from distributed import as_completed

    waiting = list(runs)[::-1]
    lanes = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
    submitted: dict[Any, Numbers] = {}

    def submit() -> Any:
        run = waiting.pop()
        future = client.submit(work, run, pure=False, retries=TRIES)
        submitted[future] = run
        return future

    pending = as_completed([submit() for _ in range(min(len(waiting), 3 * lanes))])
    for future in pending:
        run = submitted.pop(future)
        if future.status != "error":
            yield from future.result()
        elif len(run) > 1:  # one of them may be to blame: each by itself
            waiting.extend((number,) for number in reversed(run))
        else:
            told = " ".join(str(future.exception()).split())[:300]
            yield lost(run[0], f"its workers died: {told}")
        future.release()
        while waiting and len(submitted) < 3 * lanes:
            pending.add(submit())
