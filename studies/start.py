"""Entry point of the console script: it imports next to nothing, so that Ctrl-C is answered from the first moment."""

from __future__ import annotations

import sys


def script() -> None:
    """Run the command line and exit with its status; 130 for Ctrl-C, also while libraries are being imported."""
    try:
        from studies.cli import main

        status = main(sys.argv[1:])
    except KeyboardInterrupt:
        print("interrupted; finished files stay, nothing is half-written", file=sys.stderr)
        status = 130
    sys.exit(status)
