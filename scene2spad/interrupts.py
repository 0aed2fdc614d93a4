"""Ctrl-C where Python does not raise it plainly, and the signals that mean the same. Imports next to nothing, as the
start of the command line does."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

STOPPED = "interrupted; finished files stay, nothing is half-written"
_received = [2]  # SIGINT


def stop_signals_interrupt() -> None:
    """Let SIGTERM and SIGHUP, of batch systems and of terminals that close, end a command as Ctrl-C does: at once, they
    would leave temporary files.

    One that is ignored stays so (nohup). Where Ctrl-C is ignored, as in a script's background, nothing is changed.
    """
    import signal

    if not callable(signal.getsignal(signal.SIGINT)):
        return
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    import signal

    if number != signal.SIGALRM:  # of `interrupt_again`
        _received.append(number)
    handler = signal.getsignal(signal.SIGINT)  # not always Python's own: it may be held back for a moment
    if callable(handler):
        handler(signal.SIGINT, frame)


def stopped() -> int:
    """Say that a signal has ended the command, and return the exit status of that signal."""
    with suppress(OSError):  # of a terminal that is closed
        print(STOPPED, file=sys.stderr, flush=True)
    return 128 + _received[-1]


def interrupt_again(swallowed: sys.UnraisableHookArgs) -> None:
    """Raise Ctrl-C again a moment after it came in a destructor or callback, from which no exception gets out."""
    if not isinstance(swallowed.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(swallowed)
        return
    import signal

    signal.signal(signal.SIGALRM, _interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def comes_of_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C is the root of an exception: C++ modules that it meets in their start say ImportError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
