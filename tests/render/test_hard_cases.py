"""Every hard case against its oracle: the table of `bench hard-cases`, one test a row."""

import csv
import json
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

from scene2spad.bench.hard.case import Case, Measured
from scene2spad.bench.hard_cases import CASES, row, run
from scenes import InputError
from scenes.library.catalog import load_scene
from scenes.library.hard_cases import SCENES

# Twice what float32 counts to, and the half of what `bench hard-cases` takes: limits follow from the number of paths.
FEWER = {"one-pixel-2^26": (1 << 25, 2)}
LONG = ("groove-60", "caustic")
PARAMETERS = [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] * (case.slow or case.name in LONG))
    for case in CASES.values()
]


@pytest.mark.parametrize("case", PARAMETERS)
def test_case(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        fewer = FEWER.get(case.name)
        errors, clipped = case.measure(1) if fewer is None else case.measure.func(*fewer, 1)
    assert errors and clipped >= 0
    failed = {name: tuple(measured) for name, measured in errors.items() if not measured.fraction <= 1}
    assert not failed, f"{case.name}: (error, limit) of {failed}; oracle: {case.oracle}"


@pytest.mark.parametrize("name", ["mirror", "groove-60", "nothing"])
def test_hard_cases_are_scenes_by_name(name):
    scene = load_scene(f"hard-cases/{name}", width=20)
    assert scene.name == f"hard-cases/{name}" and scene.camera.width == 20
    assert scene.surfaces[0].vertices.tolist() == SCENES[name]().surfaces[0].vertices.tolist()


def test_the_table_is_printed_and_written(tmp_path):
    messages = []
    command = SimpleNamespace(seed=1, out=tmp_path / "bench", only=("near-5cm", "wraps-14.995m", "nothing-in-view"))
    result = run(command, lambda what, fraction: messages.append(fraction))
    assert [r["name"] for r in result["rows"]] == list(command.only) and result["passed"] == 3
    assert json.loads(json.dumps(result)) == result
    assert all(r["error"] <= r["limit"] and r["seconds"] > 0 and r["clipped"] == 0 for r in result["rows"])
    assert messages[-1] == 1.0
    with Path(result["out"]).open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert {line["name"] for line in lines} == set(command.only) and len(lines) == 2 + 6 + 3
    with pytest.raises(InputError, match="hard case 'far'"):
        run(SimpleNamespace(seed=1, only=("far",)), lambda what, fraction: None)


def test_a_case_that_breaks_is_a_row_that_failed():
    def broken(seed):
        raise RuntimeError("no\nluck")

    failed = row(Case("broken", "none", broken), 0)
    assert not failed["passed"] and failed["reason"] == "RuntimeError: no luck"
    assert Measured(float("nan"), 1.0).fraction > 1 and Measured(0.0, 0.0).fraction <= 1 < Measured(1e-9, 0.0).fraction
