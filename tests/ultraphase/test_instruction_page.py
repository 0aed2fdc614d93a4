"""docs/ultraphase-instructions.md: its tables are the assembler's, and its example runs."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import ultraphase
from scene2spad.cli import main
from ultraphase.assembly.assembler import DIRECTIVES
from ultraphase.assembly.isa import OPS, operands

PAGE = (Path(__file__).parents[2] / "docs/ultraphase-instructions.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[str]:
    """Lines of the table below a heading, without its head."""
    part = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"^\|.*$", part, re.M)[2:]


def test_the_page_has_every_instruction_as_the_assembler_takes_it():
    expected = []
    for op in OPS:
        written = f"{op.name} {operands(op)}".rstrip()
        expected.append(f"| `{written}` | {op.does} | {op.reads} | {op.writes} |")
    assert rows("Instructions") == expected


def test_the_page_has_every_directive():
    assert rows("Directives") == [
        f"| `{f'{name} {takes}'.rstrip()}` | {does} |" for name, (takes, does) in DIRECTIVES.items()
    ]


@pytest.fixture
def example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (source,) = re.findall(r"```asm\n(.*?)```", PAGE, re.S)
    (tmp_path / "gate.s").write_text(source)
    return tmp_path


def test_the_commands_of_the_page_run(example, capfd):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    exec(code, {})
    programs = Path(ultraphase.__file__).parent / "programs"
    for name in re.findall(r"`(\w+\.s)`", PAGE.split("`fourier.s` includes")[1].split(": copy")[0]) + ["fourier.s"]:
        (example / name).write_text((programs / name).read_text())
    commands = re.findall(r"^    (scene2spad ultraphase .*)$", PAGE, re.M)
    assert len(commands) == 5
    for command in commands:
        assert main([*shlex.split(command, comments=True)[1:], "--json"]) == 0, capfd.readouterr().err


def test_the_example_counts_and_adds_as_it_says(example, capfd):
    stamps = np.random.default_rng(0).integers(0, 1024, 300)
    np.save(example / "t.npy", stamps)
    gates = {(256, 128): (), (384, 64): ("--define", "FIRST=384", "BINS=64")}
    for (first, bins), given in gates.items():
        assert main(["ultraphase", "run", "gate.s", "--timestamps", "t.npy", "--json", *given]) == 0
        inside = stamps[(stamps >= first) & (stamps < first + bins)] - first
        assert json.loads(capfd.readouterr().out)["out"] == [[len(inside), inside.sum()]] * 4


def test_every_directive_is_known_to_the_assembler(example, capfd):
    (example / "b.s").write_text("HALT\n")
    uses = {".equ": ".equ A, 1", ".reg": ".reg A, r1", ".table": ".table A, u8, 1, 3", ".space": ".space A, u8, 1"}
    uses |= {".for": ".for n in 1..2", ".end": ".end", ".include": '.include "b.s"'}
    assert uses.keys() == DIRECTIVES.keys()
    for name in (".equ", ".reg", ".table", ".space", ".include"):
        (example / "a.s").write_text(f"{uses[name]}\nHALT\n")
        assert main(["ultraphase", "asm", "a.s"]) == 0, capfd.readouterr().err
    (example / "a.s").write_text(f"{uses['.for']}\nHALT\n{uses['.end']}\n")
    assert main(["ultraphase", "asm", "a.s"]) == 0
