"""Entry point of the console script: it imports next to nothing, so that Ctrl-C is answered from the first moment."""

from __future__ import annotations

import os
import sys

STOPPED = "interrupted; finished files stay, nothing is half-written"


def script() -> None:
    """Run the command line and exit with its status; 130 for Ctrl-C, also while libraries are being imported."""
    _open_standard_streams()
    sys.unraisablehook = _interrupt_again
    try:
        from scene2spad.cli import main

        status = main(sys.argv[1:])
        if sys.stdout is not None:
            sys.stdout.flush()
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        status = 130
    except ImportError as error:
        if not _comes_of_interrupt(error):
            raise
        print(STOPPED, file=sys.stderr)
        status = 130
    except OSError as error:  # of --help: commands report their own files
        sys.stdout = None
        status = 0 if isinstance(error, BrokenPipeError) else 2
        if status:
            print(f"scene2spad: standard output: {error.strerror or error}", file=sys.stderr)
    sys.exit(status)


def _interrupt_again(swallowed: sys.UnraisableHookArgs) -> None:
    """Raise Ctrl-C again a moment after it came in a destructor or callback, from which no exception gets out."""
    if not isinstance(swallowed.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(swallowed)
        return
    import signal

    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def _comes_of_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C lies at the root of an exception: modules in C++ that it meets in their start say ImportError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _open_standard_streams() -> None:
    """Give closed streams (>&-) somewhere to write to, or the next file opened would take their number."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number: this one
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
