"""Memory of this process and time of trials, as dry runs state them."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from scenes.limits import memory_limit

T = TypeVar("T")


class Cost(NamedTuple):
    """Seconds that a trial took, by the clock and of the processors."""

    wall_s: float
    cpu_s: float


def timed(work: Callable[[], T]) -> tuple[T, Cost]:
    """Return what `work()` returns and what it cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    made = work()
    return made, Cost(time.perf_counter() - wall, time.process_time() - cpu)


def peak_bytes() -> int:
    """Return the most memory that this process has held so far, libraries included."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # bytes there, kilobytes elsewhere


def memory(least_bytes: float | None, processes: int = 1) -> dict[str, float | None]:
    """Return the memory of a dry run's answer: libraries and trial as measured, the least that the work adds (None:
    unknown), limit."""
    return {
        "measured_bytes": processes * peak_bytes(),
        "work_bytes_at_least": least_bytes,
        "limit_bytes": memory_limit(),
    }
