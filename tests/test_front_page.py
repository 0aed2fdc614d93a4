"""The numbers that README shows beside its first commands are what these commands print."""

import json
import re
import shlex
from pathlib import Path

import pytest

from scene2spad.cli.main import main

README = Path(__file__).parents[1] / "README.md"
# Other processors round otherwise, which draws other photons. Over draws the MAE of these lines has a standard
# deviation of 2 to 4 %, the share within 10 mm one of 0.005; the page has two digits of both.
CLOSE = {"mae_mm": {"rel": 0.15}, "within_10mm": {"abs": 0.02}}


def block_after(heading: str) -> list[str]:
    """Return the lines of code under a heading of README."""
    part = README.read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    fenced = re.search(r"```python\n(.*?)```", part, re.S)
    return fenced[1].splitlines() if fenced else [line[4:] for line in part.splitlines() if line.startswith("    ")]


@pytest.mark.slow
def test_the_shells_numbers(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    shown = 0
    for line in block_after("Five minutes in the shell"):
        command, _, comment = line.partition("#")
        assert main([*shlex.split(command)[1:], "--json"]) == 0
        printed = json.loads(capfd.readouterr().out.splitlines()[-1])
        for name, number in re.findall(r"(\w+): ([\d.]+)", comment):
            assert printed[name] == pytest.approx(float(number), **CLOSE[name]), line
            shown += 1
    assert shown == 5


@pytest.mark.slow
def test_pythons_numbers():
    names: dict = {}
    shown = 0
    for line in block_after("The same in Python"):
        exec(line, names)
        for name, number in re.findall(r"(\w+): ([\d.]+)", line.partition("#")[2]):
            errors = names["s2s"].depth_errors(names["depth_m"], names["histogram"])
            assert errors[name] == pytest.approx(float(number), **CLOSE[name]), line
            shown += 1
    assert shown == 4
