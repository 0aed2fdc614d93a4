"""The models of a study: those of another training under a wanted name are told, and figures of smoke runs marked."""

import pytest

from scene2spad.networks.lookup import found_only
from scene2spad.networks.registry import ModelRegistry, ModelSpec
from scene2spad.networks.training import PLANES
from scene2spad.options.experiments import Study
from scene2spad.studies.every import SMOKE_MARK, mark_of

ONE, OTHER = ModelSpec("fourier", (1024, 1, 1)), ModelSpec("gray", (1024, 1, 1))


def test_models_of_different_trainings_are_told(tmp_path, caplog):
    """One trained for seconds into the folder of results, and one of the package, under the names of the package."""
    command = Study(name="transport", preset="smoke", out=tmp_path)
    found_only([OTHER], command)
    assert not caplog.messages
    ModelRegistry(tmp_path / "smoke" / "models", None).train([ONE], "smoke", PLANES, lambda what, fraction: None)
    caplog.clear()
    found = found_only([ONE, OTHER], command)
    assert [one.shipped for one in found.found.values()] == [False, True]
    assert ["models of different trainings are compared" in one for one in caplog.messages] == [True]


def test_absent_models_are_named(tmp_path, caplog):
    absent = ModelSpec("learned", (16, 2, 2), 7)
    found = found_only([OTHER, absent], Study(name="power", out=tmp_path))
    assert found.absent == [absent] and list(found.found) == [OTHER]
    assert caplog.messages == [f"no trained {absent.name}: left out"]


@pytest.mark.parametrize(("name", "preset", "marked"), [
    ("transport", "smoke", True), ("transport", "laptop", False), ("memory", "smoke", False)
])  # fmt: skip
def test_figures_of_smoke_runs_are_marked(name, preset, marked):
    assert mark_of(Study(name=name, preset=preset)) == (SMOKE_MARK if marked else "")


def test_captures_that_are_given_unmark_the_study_of_captures_alone():
    """`study all` gives them to every study."""
    marks = {name: mark_of(Study(name=name, preset="smoke", capture=("a.mat",))) for name in ("real-data", "chip")}
    assert marks == {"real-data": "", "chip": SMOKE_MARK}
