"""Hold Ctrl-C back where an exception in the middle would leave a half-done state, or a lock that nobody opens."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block, which should be short.

    Example: `with interrupts_wait(): write_both_files()`.
    """
    if current_thread() is not main_thread():  # only the main thread is interrupted, and may set handlers
        yield
        return
    held: list[tuple[int, FrameType | None]] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: held.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if held and callable(before):
            before(*held[0])
