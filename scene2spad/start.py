"""Entry point of the console script: it imports next to nothing, so that Ctrl-C is answered some milliseconds after
Python itself has started."""

from __future__ import annotations

import gc
import io
import os
import sys

from scene2spad.interrupts import comes_of_interrupt, interrupt_again, stop_signals_interrupt, stopped


def script() -> None:
    """Run the command line and exit with its status; 130 for Ctrl-C, 143 for SIGTERM and 129 for SIGHUP, also while
    libraries are being imported."""
    _open_standard_streams()
    _check_folder()
    # Libraries make a million objects that stay: searching them for garbage is a tenth of the time of their import.
    gc.set_threshold(50_000)
    # Threads of OpenMP (torch) that wait for each other sleep instead of spinning: a small depth map takes a quarter
    # less of a processor. Training alone on its cores is a sixth slower so, and keeps the default.
    if sys.argv[1:2] != ["train"]:
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.unraisablehook = interrupt_again
    try:
        stop_signals_interrupt()
        from scene2spad.cli import main

        status = main(sys.argv[1:])
        if sys.stdout is not None:
            sys.stdout.flush()
    except KeyboardInterrupt:
        status = stopped()
    except ImportError as error:
        if not comes_of_interrupt(error):
            raise
        status = stopped()
    except OSError as error:  # of --help: commands report their own files
        sys.stdout = None
        status = 0 if isinstance(error, BrokenPipeError) else 2
        if status:
            print(f"scene2spad: standard output: {error.strerror or error}", file=sys.stderr)
    exec("")  # Python remembers a Ctrl-C within the last exec(), as of imports, and would end by a signal of its own
    gc.freeze()  # Python would search all libraries for garbage once more at its end: 0.2 s with torch
    sys.exit(status)


def _open_standard_streams() -> None:
    """Give closed streams (>&-) somewhere to write to, or the next file opened would take their number.

    What the encoding of an output lacks, as bars of a histogram in ASCII, is written as question marks.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number: this one
    sys.stdout = sys.stdout or os.fdopen(1, "w", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", closefd=False)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors != "backslashreplace":  # which stderr has
            stream.reconfigure(errors="replace")


def _check_folder() -> None:
    """Exit with 2 where the current folder has been deleted: libraries fail in it, each by words of its own."""
    try:
        os.getcwd()  # noqa: PTH109 (pathlib is not imported yet)
    except OSError as error:
        print(f"scene2spad: the current folder is gone ({error.strerror}); change to another", file=sys.stderr)
        sys.exit(2)
