"""Standard output and standard error that are closed, full or left early."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import run_process

from spad.measurements.histogram import Histogram, write_histogram
from spad.sensor.model import Sensor

COMMAND = [sys.executable, "-m", "scene2spad"]
PLAIN = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.fixture
def counts(tmp_path) -> Path:
    """A file of a few counts, whose drawing needs more letters than ASCII has."""
    write_histogram(Histogram.from_counts(np.ones((2, 2, 8), int), Sensor(bins=8)), tmp_path / "g.h5")
    return tmp_path / "g.h5"


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


@pytest.mark.parametrize("plain", [{"LC_ALL": "POSIX", "PYTHONIOENCODING": "ascii"}, PLAIN], ids=["set", "locale"])
def test_letters_that_an_output_lacks_are_replaced(counts, plain):
    command = [*COMMAND, "inspect", str(counts), "--pixel", "1", "1"]
    done = run_process(command, env=os.environ | plain)
    assert done.returncode == 0 and f"|{'?' * 8}| bins" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("words", "plain"),
    [
        ((b"g.h5", b"--out", b"bad\xff\xfe.exr"), {}),
        ((b"in\xff.h5",), {}),
        (("日é.h5".encode(),), PLAIN),
    ],
    ids=["out", "in", "locale"],
)
def test_names_that_are_no_text_are_refused_in_one_line(counts, tmp_path, words, plain):
    (tmp_path / os.fsdecode(words[-1])).write_bytes(counts.read_bytes())
    before = {path.name for path in tmp_path.iterdir()}
    done = run_process([*COMMAND, "depth", *words], env=os.environ | plain, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "text; rename the file" in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("columns", ["1", "4"])
def test_help_comes_to_an_end_in_a_narrow_window(columns):
    done = run_process([*COMMAND, "sense", "--help"], env=os.environ | {"COLUMNS": columns})
    assert done.returncode == 0 and "--background" in done.stdout


def test_a_folder_that_is_gone_is_told_in_one_line(tmp_path):
    shell = f"mkdir gone; cd gone; rmdir ../gone; exec {sys.executable} -m scene2spad scenes"
    # an empty entry of PYTHONPATH is the current folder, without which Python itself does not start
    found = [str(Path(__file__).parents[2]), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    done = run_process(["bash", "-c", shell], cwd=tmp_path, env=os.environ | {"PYTHONPATH": os.pathsep.join(found)})
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "current folder is gone" in done.stderr


def test_the_start_imports_nothing_that_takes_long():
    """Before `script` nobody answers Ctrl-C in one line."""
    asked = "import sys, scene2spad.start; print([n for n in ('numpy', 'tyro', 'scenes.model') if n in sys.modules])"
    assert run_process([sys.executable, "-c", asked]).stdout.strip() == "[]"
