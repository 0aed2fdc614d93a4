"""Run work on numbered things in processes on this machine, each on a pipe of its own.

Pools of the standard library let their workers share queues: one that is killed within an answer leaves a half message
or a closed lock there, for whose end the pool waits for ever. Here the end of a worker is the end of its pipe.
"""

from __future__ import annotations

import logging
import os
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, islice
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import TypeAlias, TypeVar

from render.backend.interrupts import interrupts_wait

log = logging.getLogger("scene2spad")

TRIES = 3  # of a number whose worker process died, among others; then once by itself
Numbers = tuple[int, ...]
Result = TypeVar("Result")
Work: TypeAlias = Callable[[Numbers], list[Result]]  # one result a number; pickled to other processes
Lost: TypeAlias = Callable[[int, str], Result]  # the result of a number that nobody could do, and why


def on_processes(
    workers: int, work: Work[Result], runs: Iterable[Numbers], lost: Lost[Result]
) -> Generator[Result, None, None]:
    """Do runs in several processes of ours. Another takes the place of one that dies; what it had is tried again."""
    runs = iter(runs)
    first = list(islice(runs, workers))
    waiting: Iterator[Numbers] = chain(first, runs)
    deaths: Counter[int] = Counter()
    threads = max(1, (os.cpu_count() or 1) // max(1, len(first)))
    with _workers() as start:
        idle, busy = [start(threads) for _ in first], dict[Connection, tuple[_Worker, Numbers]]()
        results: list[Result] = []
        while True:
            while idle and (run := next(waiting, None)) is not None:
                worker = idle.pop()
                worker.begin(work, run)
                busy[worker.pipe] = worker, run
            yield from results  # while all have work
            if not busy:
                break
            results = []
            ready = wait([*busy])
            for pipe in [pipe for pipe in busy if pipe in ready]:
                worker, run = busy.pop(pipe)
                done = worker.results()
                if done is None:
                    log.warning("a worker process died; starting another")
                    deaths.update(run)
                    waiting = chain([(number,) for number in run if deaths[number] < TRIES], waiting)
                    worker = start(threads)
                idle.append(worker)
                results += done or []
    for number in sorted(number for number, count in deaths.items() if count >= TRIES):
        with _workers() as start:
            worker = start(threads)
            worker.begin(work, (number,))
            done = worker.results()
        yield from done or [lost(number, f"its process died {TRIES + 1} times, at last by itself")]


class _Worker:
    """A process that does runs, one at a time."""

    def __init__(self, threads: int) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, start_worker, (threads, os.getpid())), daemon=True)
        resource_tracker.ensure_running()  # `start` would do so, and unblock Ctrl-C
        # Ctrl-C is kept from the process for good: its parent ends it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()  # or the pipe would not end with the process

    def begin(self, work: Work[Result], run: Numbers) -> None:
        with suppress(OSError):  # it has died: `results` tells
            self.pipe.send((work, run))

    def results(self) -> list | None:
        """Wait for the results of its run, or raise what the work raised; None where the process has died."""
        try:
            done = self.pipe.recv()
        except (EOFError, OSError):  # the latter within a message
            self.process.kill()
            self.process.join()
            return None
        if isinstance(done, Exception):
            raise done
        return done


@contextmanager
def _workers() -> Iterator[Callable[[int], _Worker]]:
    """Yield what starts a worker. They end with the block: at once, where an exception such as Ctrl-C ends it."""
    started: list[_Worker] = []

    def start(threads: int) -> _Worker:
        with interrupts_wait():  # a process half started would be nobody's
            started.append(_Worker(threads))
        return started[-1]

    try:
        yield start
        for worker in started:
            worker.pipe.close()  # it ends by itself
        for worker in started:
            worker.process.join()
    finally:
        with interrupts_wait():
            for worker in started:
                worker.process.kill()
        for worker in started:
            worker.process.join()
            worker.pipe.close()


def _serve(pipe: Connection, start: Callable[[int, int], None], options: tuple[int, int]) -> None:
    """In a new process: do runs until the pipe ends."""
    start(*options)
    with suppress(EOFError, OSError):
        while True:
            work, run = pipe.recv()
            try:
                done = work(run)
            except Exception as error:
                error.add_note(traceback.format_exc())
                done = error
            pipe.send(done)


def start_worker(threads: int, parent: int) -> None:
    """Take as many threads as a worker's share of the cores, and end when the process that started it does."""
    Thread(target=_end_with, args=(parent,), daemon=True).start()
    from render.backend.llvm import start_mitsuba

    start_mitsuba()
    import drjit

    drjit.set_thread_count(threads)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
