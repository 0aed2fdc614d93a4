"""Ctrl-C where Python does not raise it plainly. Imports next to nothing, as the start of the command line does."""

from __future__ import annotations

import sys

STOPPED = "interrupted; finished files stay, nothing is half-written"


def interrupt_again(swallowed: sys.UnraisableHookArgs) -> None:
    """Raise Ctrl-C again a moment after it came in a destructor or callback, from which no exception gets out."""
    if not isinstance(swallowed.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(swallowed)
        return
    import signal

    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def comes_of_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C is the root of an exception: C++ modules that it meets in their start say ImportError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
