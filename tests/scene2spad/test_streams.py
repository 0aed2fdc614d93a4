"""Standard output and standard error that are closed, full or left early."""

import subprocess
import sys

import pytest


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
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, timeout=60)
    assert done.returncode == status and "Traceback" not in done.stderr and "ignored" not in done.stderr
    assert len(done.stderr.splitlines()) == (status != 0)
