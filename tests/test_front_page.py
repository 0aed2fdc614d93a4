"""The numbers that README shows beside its first commands are what these commands print."""

import json
import re
import shlex
from pathlib import Path

import pytest

from scene2spad.cli.main import main

README = Path(__file__).parents[1] / "README.md"
CLOSE = 0.02  # relative: other processors round otherwise, other versions must not


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
            assert float(number) == pytest.approx(printed[name], rel=CLOSE), line
            shown += 1
    assert shown == 4


@pytest.mark.slow
def test_pythons_numbers():
    names: dict = {}
    shown = []
    for line in block_after("The same in Python"):
        exec(line, names)
        if found := re.search(r"#.*?([\d.]+) mm|#.*'mae_mm': ([\d.]+)", line):
            errors = names["s2s"].depth_errors(names["depth_m"], names["histogram"])
            shown.append(float(found[1] or found[2]))
            assert shown[-1] == pytest.approx(errors["mae_mm"], rel=CLOSE), line
    assert len(shown) == 3
