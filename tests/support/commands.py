"""Run a command of the command line in this process, and return what it says."""

import json

from scene2spad.cli import main


def run(capfd, *argv: str) -> dict:
    """Return the result of a command that ends well."""
    status = main([*argv, "--json"])
    out, err = capfd.readouterr()
    assert status == 0, err
    return json.loads(out)


def refused(capfd, *argv: str) -> str:
    """Return the one line of a command that is refused; warnings may stand before it, and stdout is empty."""
    capfd.readouterr()
    status = main(list(argv))
    out, err = capfd.readouterr()
    lines = [line for line in err.splitlines() if line.startswith("scene2spad: ")]
    assert status == 2 and out == "" and len(lines) == 1 and "Traceback" not in err, err
    return lines[0]
