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
    """Return the one line of a command that is refused."""
    capfd.readouterr()
    status = main(list(argv))
    err = capfd.readouterr().err
    assert status == 2 and len(err.splitlines()) == 1, err
    return err
