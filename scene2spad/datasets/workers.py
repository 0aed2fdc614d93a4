"""Run work on numbered things in this process, in several processes, or on the workers of a Dask cluster.

Work comes in runs, numbers that one process does in a row. A run whose worker dies is tried again number by number.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import re
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain, islice
from typing import TYPE_CHECKING, Protocol

from scene2spad.datasets.processes import TRIES, Lost, Numbers, Result, Work, on_processes
from scenes.errors import InputError, require

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as DaskFuture

log = logging.getLogger("scene2spad")

MAX_WORKERS = 256
CONNECT_S, CLOSE_S = 10, 2  # until a scheduler that does not answer is given up, and one is left


class Run(Protocol):
    """Do runs of numbers by a function and give their results: what `executor` yields."""

    def __call__(self, work: Work[Result], runs: Iterable[Numbers], lost: Lost[Result]) -> Iterator[Result]: ...


def check_workers(number: int, least: int = 1) -> None:
    """Raise InputError for a number of processes that nobody means."""
    require(least <= number <= MAX_WORKERS, f"workers {number} is outside {least} to {MAX_WORKERS}")


def check_address(scheduler: str) -> None:
    """Raise InputError for what is no address of a Dask scheduler: whether one is there, `executor` finds out."""
    parts = re.fullmatch(r"(?:[a-z]+://)?(?:[^\s/:\[\]]+|\[[0-9a-fA-F:.%]+\]):(\d{1,5})", scheduler)
    good = parts is not None and 1 <= int(parts[1]) <= 65535
    require(good, f"scheduler {scheduler}: is no address, expected tcp://HOST:PORT with a port from 1 to 65535")


@contextmanager
def executor(workers: int, scheduler: str | None) -> Iterator[Run]:
    """Yield something that does runs and gives their results, in whatever order; InputError if a scheduler is not
    there.

    Runs are taken one by one, as they can be done. At the end what is still under way is given up, not waited for.
    """
    with ExitStack() as stack:
        client = None if scheduler is None else stack.enter_context(_dask_client(scheduler))

        def run(work: Work[Result], runs: Iterable[Numbers], lost: Lost[Result]) -> Iterator[Result]:
            results: Generator[Result, None, None]
            if client is not None and scheduler is not None:
                results = _on_dask(client, scheduler, work, runs, lost)
            elif workers == 1:
                results = (result for some in runs for number in some for result in work((number,)))
            else:
                results = on_processes(workers, work, runs, lost)
            stack.callback(results.close)
            return results

        yield run


@contextmanager
def _dask_client(address: str) -> Iterator[Client]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs the package `distributed`: pip install 'scene2spad[cluster]'") from None
    with _cluster_logs_off():
        try:
            with _nothing_collected():
                client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError, TypeError) as error:
            message = " ".join(str(error).split())[:120]
            raise InputError(f"scheduler {address}: cannot be reached ({message or type(error).__name__})") from None
        except AssertionError:  # of Dask, whose thread of its own had 10 s to start
            message = "Dask's event loop did not start in 10 s: try again when the machine is less busy"
            raise InputError(f"scheduler {address}: cannot be reached ({message})") from None
        try:
            yield client
        finally:
            with suppress(TimeoutError):
                client.close(timeout=CLOSE_S)


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """Keep Python from collecting garbage: an earlier client that never reached its scheduler closes itself when it is
    collected, and waits for a lock that a client holds while it starts: for ever, in one thread."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def _cluster_logs_off() -> Iterator[None]:
    """Dask and its event loop tell of a lost connection in tracebacks: what it means to the user is said in a line."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]
    loggers = [logging.getLogger(name) for name in (*names, "asyncio")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _on_dask(
    client: Client, address: str, work: Work[Result], runs: Iterable[Numbers], lost: Lost[Result]
) -> Generator[Result, None, None]:
    """Use a cluster's workers, a few tasks each in flight, so that results do not heap up; a dead worker's move on.

    Raises InputError where the scheduler goes away.
    """
    from distributed import as_completed

    waiting = iter(runs)
    workers = _workers_of(client, address)
    if not workers:
        log.warning("scheduler %s has no workers yet: waiting for some", address)
    submitted: dict[DaskFuture, Numbers] = {}
    pending = as_completed()
    while True:
        if client.status == "running":  # else it is the scheduler's loss that is told next, not waited for
            workers = _workers_of(client, address)
        for run in islice(waiting, max(0, 3 * max(1, workers) - len(submitted))):
            with _explain_lost_scheduler(client, address):
                future = client.submit(work, run, pure=False, retries=TRIES)
            submitted[future] = run
            pending.add(future)
        if not submitted:
            return
        future = next(pending)
        run = submitted.pop(future)
        done: list[Result] | None
        with _explain_lost_scheduler(client, address):
            done, error = _outcome(future)
        future.release()
        if done is not None:
            yield from done
        elif len(run) > 1:  # one of them may be to blame: each by itself
            waiting = chain([(number,) for number in run], waiting)
        else:
            yield lost(run[0], f"its workers died: {' '.join(str(error).split())[:300]}")


def _workers_of(client: Client, address: str) -> int:
    """Return how many workers a cluster has now: they come and go."""
    with _explain_lost_scheduler(client, address):
        return client.scheduler_info(n_workers=0)["n_workers"]  # their number alone, however many there are


def _outcome(future: DaskFuture[list[Result]]) -> tuple[list[Result] | None, BaseException | None]:
    """Return what a finished task gave, or why it gave nothing."""
    from distributed import KilledWorker

    if future.status == "error":
        return None, future.exception()
    try:
        return future.result(), None
    except Exception as error:
        if isinstance(error, KilledWorker) or future.status == "error":
            return None, error  # the result died with a worker before it was fetched, and so did those who redid it
        raise


@contextmanager
def _explain_lost_scheduler(client: Client, address: str) -> Iterator[None]:
    """InputError in one line where the scheduler does not answer any more; it is told by errors of several types.

    A client that has given up knows no address any more, hence `address`."""
    try:
        yield
    except (Exception, asyncio.CancelledError) as error:
        # a fetch may meet the closed connection before the client's own has noticed: then `status` is still "running"
        lost = isinstance(error, (CancelledError, asyncio.CancelledError, OSError))
        if client.status == "running" and not lost:
            raise
        message = f"scheduler {address}: has gone away; what is finished stays"
        raise InputError(f"{message}, and the same command goes on from it") from None
