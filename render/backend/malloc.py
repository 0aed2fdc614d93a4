"""Control what glibc's malloc does with freed memory: give it back between the stages of a render, or keep it for the
next.

No Mitsuba import: training keeps its memory by the same call as the renderer (`render.scene.traced_scene`).
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable
from functools import cache

SMALL_IMAGE = 1 << 14  # pixels
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # names of glibc's malloc.h
_LARGEST_MMAP_THRESHOLD = 32 << 20  # that glibc takes; a tensor of a training step has a few MB


def retain_freed_memory() -> None:
    """Have malloc keep freed arrays for the next step, image or view instead of giving them back to the system.

    Returned pages come back zeroed, one page fault per 4 KiB: a fifth of a training step on a CPU, 0.4 of an estimate
    of 72 x 88 pixels or of the direct light of 64 x 64. For the whole process and for good; nothing happens with
    another C library. `trim_memory` still gives all of it back.
    """
    mallopt = _glibc("mallopt")
    mallopt(_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD)
    mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def trim_memory(pixels: int) -> None:
    """Return what Dr.Jit and the C library keep of freed arrays to the system, after work on an image of more than
    SMALL_IMAGE pixels: below it is little, some 60 MB, and to take it again costs a sixteenth of the time of a view of
    a set, and a twelfth of 128 x 128 pixels with 64 paths (measured).

    Both keep it for later arrays of the same sizes; glibc also leaves holes below what is still in use, since large
    freed arrays raise the size up to which it takes memory from its heap.
    """
    import drjit

    if pixels > SMALL_IMAGE:
        drjit.flush_malloc_cache()
        _glibc("malloc_trim")(0)


@cache
def _glibc(name: str) -> Callable[..., int]:
    """Look up a function of glibc; with another C library a function that does nothing."""
    if platform.libc_ver()[0] != "glibc":
        return lambda *arguments: 0
    return getattr(ctypes.CDLL(None), name, lambda *arguments: 0)
