"""Standard output and standard error that are closed, full or left early."""

import sys

import pytest
from processes import run_process


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("scenes --json >&-", 0),
        ("scenes --json 2>&-", 0),
        ("scenes --json >/dev/full", 2),
        ("--help >/dev/full", 2),
        ("scenes | head -1", 0),
    ],
)
def test_closed_and_full_streams_end_without_a_traceback(command, status):
    shell = f"set -o pipefail; {sys.executable} -m scene2spad.cli {command}"
    done = run_process(["bash", "-c", shell])
    assert done.returncode == status and "Traceback" not in done.stderr and "ignored" not in done.stderr
    assert len(done.stderr.splitlines()) == (status != 0)
