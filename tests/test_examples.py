"""Examples: each runs at small size, is short, and divides into cells of a notebook that compile one by one."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
EXAMPLES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
SLOW = ("03", "09", "12", "13")
SMALL = {"WIDTH, HEIGHT = 64, 48": "WIDTH, HEIGHT = 16, 12"}
MAX_LINES = 60
SAYS = {  # what an example must print, as a pattern
    "01": r"log-matched: \d",
    "07": r"histogram: (0\.0e\+00|\d\.\de-0[4-9])",
    "10": r"right: True",
    "13": r"a wall at 2 m is seen at (1\.99|2\.0\d) m",
    "14": r"of a bin \d\.\de-0[4-9](.|\n)*counts -(0\.99|1\.0)\d*(.|\n)*path (1\.99|2\.0)",
}


def cells(source: str) -> list[str]:
    return re.split(r"^# %%.*$", source, flags=re.M)[1:]


def test_there_are_fourteen_numbered_from_one():
    assert [path.name[:2] for path in EXAMPLES] == [f"{number:02d}" for number in range(1, 15)]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_a_notebook(path):
    source = path.read_text(encoding="utf-8")
    assert len(source.splitlines()) < MAX_LINES
    assert source.startswith(f"# %% [markdown]\n# # {path.name[:2]} ")
    for cell in cells(source):
        compile(cell, path.name, "exec")


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=pytest.mark.slow) if path.name[:2] in SLOW else path for path in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_an_example_runs(path, tmp_path):
    """In a process and an empty folder of its own."""
    source = path.read_text(encoding="utf-8")
    for words, fewer in SMALL.items():
        source = source.replace(words, fewer)
    done = subprocess.run([sys.executable, "-c", source], cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert done.stdout and re.search(SAYS.get(path.name[:2], "."), done.stdout), done.stdout
