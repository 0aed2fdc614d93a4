"""Limit the memory of one piece of work: asked before anything is allocated, not found out by the kernel."""

from __future__ import annotations

import math
import os
from functools import cache
from pathlib import Path

from scenes.errors import InputError

VARIABLE = "SCENE2SPAD_MEMORY_GB"
# Of the machine's memory: the rest is for the interpreter, its libraries, and everybody else.
FRACTION = 0.8
# The limits of a Linux container, version 2 and version 1; "max", or a number beyond any machine, where there is none.
CONTAINER_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory_limit() -> int:
    """Return the bytes that one piece of work may take: 80 % of the machine's (or container's) memory.

    The environment variable SCENE2SPAD_MEMORY_GB states another limit. Raises InputError where it is no number above 0.
    """
    asked = os.environ.get(VARIABLE)
    if asked is None:
        return int(FRACTION * min(_physical(), *map(_container, CONTAINER_LIMITS)))
    try:
        limit = float(asked)
    except ValueError:
        limit = math.nan
    if not 0 < limit < math.inf:
        raise InputError(f"{VARIABLE}={asked!r}: expected a number of gigabytes above 0")
    return int(limit * 1e9)


def require_memory(bytes_needed: float, what: str) -> None:
    """Raise InputError if `what` needs more memory than `memory_limit` allows."""
    limit = memory_limit()
    if bytes_needed > limit:
        raise InputError(
            f"{what}: needs {bytes_needed / 1e9:.3g} GB of memory, the limit is {limit / 1e9:.3g} GB; "
            f"{VARIABLE} states another"
        )


def _physical() -> float:
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (ValueError, OSError, AttributeError):  # no POSIX system tells
        return math.inf


@cache  # the limit is asked for at every exposure
def _container(path: Path) -> float:
    try:
        return float(path.read_text())
    except (OSError, ValueError):
        return math.inf
