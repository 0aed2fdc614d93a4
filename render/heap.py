"""Giving freed memory back between the stages of a render, which need arrays of other sizes than each other's."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache

from render.world import dr

SMALL_IMAGE = 1 << 13  # pixels


def release(pixels: int) -> None:
    """Return what Dr.Jit and the C library keep of freed arrays to the system, after work on an image of any size but
    the smallest: there it is little, and to take it again costs a sixteenth of the time of a view of a set (measured).

    Both keep it for later arrays of the same sizes; glibc also leaves holes below what is still in use, since large
    freed arrays raise the size up to which it takes memory from its heap.
    """
    if pixels > SMALL_IMAGE:
        dr.flush_malloc_cache()
        _trim()(0)


@cache
def _trim() -> Callable[[int], int]:
    """glibc's `malloc_trim`; where the C library has none, memory goes back as it sees fit."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return getattr(library, "malloc_trim", lambda pad: 0)
