"""Giving freed memory back between the stages of a render, which need arrays of other sizes than each other's."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache

from render.world import dr


def release() -> None:
    """Return what Dr.Jit and the C library keep of freed arrays to the system.

    Both keep it for later arrays of the same sizes; glibc also leaves holes below what is still in use, since large
    freed arrays raise the size up to which it takes memory from its heap.
    """
    dr.flush_malloc_cache()
    _trim()(0)


@cache
def _trim() -> Callable[[int], int]:
    """glibc's `malloc_trim`; where the C library has none, memory goes back as it sees fit."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return getattr(library, "malloc_trim", lambda pad: 0)
