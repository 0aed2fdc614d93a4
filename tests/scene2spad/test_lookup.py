"""The models of a study: those of another training under a wanted name are told, and figures of smoke runs marked."""

from dataclasses import replace

import pytest

from csph.networks.checkpoint import load_model, save_model
from render.transient.packs import write_pack
from scene2spad.datasets.planes import random_planes
from scene2spad.networks.lookup import found_only, obtain
from scene2spad.networks.registry import ModelRegistry, ModelSpec
from scene2spad.options.experiments import Study
from scene2spad.options.networks import PLANES
from scene2spad.studies.every import SMOKE_MARK, mark_of
from scenes import InputError

ONE, OTHER = ModelSpec("fourier", (1024, 1, 1)), ModelSpec("gray", (1024, 1, 1))


def quietly(what: str, fraction: float) -> None:
    pass


def test_a_retraining_takes_only_finished_models_of_its_preset_and_set(tmp_path, monkeypatch):
    """Laptop runs made a "paper" run, and --set named a set that no model had seen. Where all is finished no rooms are
    rendered."""
    ModelRegistry(tmp_path, None).train([ONE], "smoke", PLANES, quietly)
    path = tmp_path / ONE.name / "model.safetensors"
    model, config, state = load_model(path)
    save_model(model, replace(config, preset="laptop"), state, path)
    monkeypatch.setattr("scene2spad.networks.lookup.rooms", lambda *_: pytest.fail("rooms are rendered"))
    asked = Study(name="transport", retrain=True, preset="laptop", models=tmp_path, out=tmp_path / "out")
    assert list(obtain([ONE], asked, quietly).found) == [ONE]
    with pytest.raises(InputError, match=rf"{ONE.name}: was trained with --preset laptop, not paper"):
        obtain([ONE], replace(asked, preset="paper"), quietly)
    other = tmp_path / "other.h5"
    write_pack(((view, {}) for view in random_planes(3, size=32, seed=5).transients), other)
    with pytest.raises(InputError, match=rf"{ONE.name}: was not trained on --set .*other\.h5"):
        obtain([ONE], replace(asked, set=other), quietly)
    toy = replace(asked, preset="smoke", models=tmp_path / "toy", set=other)
    assert list(obtain([ONE], toy, quietly).found) == list(obtain([ONE], toy, quietly).found) == [ONE]


def test_models_of_different_trainings_are_told(tmp_path, caplog):
    """One trained for seconds into the folder of results, and one of the package, under the names of the package."""
    command = Study(name="transport", preset="smoke", out=tmp_path)
    found_only([OTHER], command)
    assert not caplog.messages
    ModelRegistry(tmp_path / "smoke" / "models", None).train([ONE], "smoke", PLANES, quietly)
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
