"""Models as studies ask for them: names, the commands that make them, what is found, and what is refused."""

import csv
import logging
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import scene2spad as s2s
from csph.networks.checkpoint import load_model, save_model
from csph.weights.shipped import shipped_file, shipped_names
from scene2spad.cli.main import parse_command
from scene2spad.datasets.planes import random_planes
from scene2spad.networks.registry import ModelRegistry, ModelSpec, check, ship_all
from scene2spad.networks.results import Store
from scene2spad.networks.training import config_of, training_reach_m
from scenes import InputError

LEARNED = ModelSpec("learned", (256, 4, 4), 128, 1)
PERIODIC = "fourier-1024x1x1-128x-periodic-s1"


def quietly(what: str, fraction: float) -> None:
    pass


def spec_of(name: str) -> ModelSpec:
    """Read a model's name: design, block and compression, what it was trained on, and seed."""
    design, *_ = re.split(r"-(?=\d+x|mixed|published|s\d)", name)
    full = design.startswith("full-")
    design = design.removeprefix("full-").replace("fourier-learned", "fourier+learned")
    block = re.search(r"-(\d+)x(\d+)x(\d+)-(\d+)x", name)
    coded = {} if block is None else {"block": tuple(map(int, block.groups()[:3])), "compression": int(block[4])}
    delay = re.search(r"-t([\d.]+)-", name)
    on = next((kind for kind in ("mixed", "published") if f"-{kind}-" in name), "rooms")
    seed, offset_m = int(name.rpartition("-s")[2]), float(delay[1]) if delay else 0.0
    return ModelSpec(design, seed=seed, time_offset_m=offset_m, full=full, trained_on=on, tdc="-tdc-" in name, **coded)


def test_studies_take_every_model_that_ships(tmp_path):
    """Each passes the check of its name. Some had been begun with runs of other seeds, or keep the mean over codes, and
    the ablations refused them at their end. A periodic one is no study's."""
    names = set(shipped_names()) - {PERIODIC}
    assert len(names) > 50 and PERIODIC in shipped_names()
    for name in names:
        wanted = spec_of(name)
        assert wanted.name == name
        found = ModelRegistry(tmp_path).find(wanted)
        assert found is not None and found.shipped, name


def test_depth_by_the_path_of_a_model(tmp_path):
    transient = s2s.render("plane", width=8, height=8, bounces=1)
    histogram = s2s.sense(transient, signal=50, background=5)
    found = s2s.estimate_depth(histogram, shipped_file("none-s0"))
    assert (found == s2s.estimate_depth(histogram, "none-s0")).all()
    with pytest.raises(InputError, match="depth method of type NoneType: expected a name"):
        s2s.estimate_depth(histogram, None)
    with pytest.raises(InputError, match=r"^seed -1: expected a whole number, 0 or more$"):
        s2s.sense(transient, seed=-1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder of runs that holds one."""
    path = tmp_path_factory.mktemp("models")
    ModelRegistry(path, None).train([LEARNED], "smoke", Path("planes"), quietly)
    return path


def test_names_and_labels():
    wanted = [
        ModelSpec(),
        ModelSpec("fourier+learned", full=True),
        ModelSpec("none", seed=2),
        ModelSpec(time_offset_m=7.5),
        ModelSpec(trained_on="mixed"),
    ]
    assert [one.name for one in wanted] == [
        "learned-256x4x4-128x-s0",
        "full-fourier-learned-256x4x4-128x-s0",
        "none-s2",
        "learned-256x4x4-128x-t7.5-s0",
        "learned-256x4x4-128x-mixed-s0",
    ]
    labels = ["no compression", "learned 256x4x4, trained with offsets to 7.5 m", "learned 256x4x4, mixed training"]
    assert [one.label for one in wanted[2:]] == labels


@pytest.mark.parametrize(
    "wanted",
    [
        LEARNED,
        ModelSpec("none"),
        ModelSpec("peak"),
        ModelSpec("fourier", (1024, 1, 1), 64, 2),
        ModelSpec(time_offset_m=8, full=True),
    ],
    ids=lambda one: one.name,
)
def test_spelled_command_is_the_command(wanted):
    spelled = shlex.split(wanted.training_command("laptop", Path("rooms.h5"), Path("runs")))
    parsed = parse_command(spelled[1:])
    assert parsed.out == Path("runs") / wanted.name
    assert config_of(parsed) == config_of(wanted.command("laptop", Path("rooms.h5"), Path("runs")))
    check(config_of(parsed), wanted, Path("model"))


def test_found_trained_shipped_or_absent(folder, tmp_path, caplog):
    found = ModelRegistry(folder, None).find(LEARNED)
    assert found.described()["trained_on"] == "planes" and not found.shipped and found.table("energy.csv")
    assert ModelRegistry(tmp_path, None).find(LEARNED) is None
    names = ship_all([found], tmp_path / "weights")
    assert names == [str(tmp_path / "weights" / LEARNED.name / "model.safetensors")]
    shipped = ModelRegistry(tmp_path, tmp_path / "weights").find(LEARNED)
    assert shipped.shipped and shipped.digest != found.digest and len(shipped.table("log.csv")) == 2
    assert shipped.config.data["training_reach_m"] == found.config.data["training_reach_m"]
    assert ship_all([shipped], tmp_path / "none") == []
    other = ModelSpec("fourier", (1024, 1, 1), seed=99)  # of a seed that nobody ships
    assert [*ModelRegistry(folder).gather([other, LEARNED])] == [LEARNED]


def test_finished_runs_are_not_trained_again(folder, monkeypatch):
    monkeypatch.setattr("scene2spad.networks.registry.run_train", lambda *_: pytest.fail("trained again"))
    ModelRegistry(folder).train([LEARNED], "smoke", Path("planes"), quietly)


def test_a_run_killed_before_its_last_weights_goes_on(folder, tmp_path):
    """Log and state are at the end, `last.safetensors` is not there yet: the run writes it, and ends the same."""
    run = tmp_path / "models" / LEARNED.name
    shutil.copytree(folder / LEARNED.name, run)
    last = (run / "last.safetensors").read_bytes()
    (run / "last.safetensors").unlink()
    library = ModelRegistry(tmp_path / "models", None)
    assert library.find(LEARNED) is None
    library.train([LEARNED], "smoke", Path("planes"), quietly)
    assert (run / "last.safetensors").read_bytes() == last and library.find(LEARNED) is not None


def test_unfinished_runs_are_left_out(folder, tmp_path, caplog):
    run = tmp_path / LEARNED.name
    run.mkdir()
    for name in ("model.safetensors", "config.json", "log.csv"):
        (run / name).write_bytes((folder / LEARNED.name / name).read_bytes())
    assert ModelRegistry(tmp_path).find(LEARNED) is not None  # its log reaches the last step
    assert ModelRegistry(tmp_path).has(LEARNED) and not ModelRegistry(tmp_path / "none", None).has(LEARNED)
    rows = list(csv.reader((run / "log.csv").open()))
    (run / "log.csv").write_text("\n".join(",".join(row) for row in rows[:-1]) + "\n")
    with caplog.at_level(logging.WARNING, "scene2spad"):
        assert ModelRegistry(tmp_path).find(LEARNED) is None
        assert not ModelRegistry(tmp_path).has(LEARNED)
    assert "not come to its end" in caplog.text


def test_other_models_under_its_name_are_refused_in_one_line(folder, tmp_path):
    model, config, state = load_model(folder / LEARNED.name)
    for changes, message in (
        ({"time_offset_m": 8.0, "window": 0}, r"random time offsets \[m\] 8.0, expected 0.0"),
        ({"seed": 5}, "seed 5, expected 1"),
        ({"model": replace(config.model, layer={"keep_mean": True})}, "layer"),
    ):
        run = tmp_path / LEARNED.name
        run.mkdir(exist_ok=True)
        save_model(model, replace(config, **changes), state, run / "model.safetensors")
        with pytest.raises(InputError, match=message):
            ModelRegistry(tmp_path).find(LEARNED)
    with pytest.raises(InputError, match="design learned 256x4x4 K32, expected learned 1024x4x4 K128"):
        check(config, ModelSpec("learned", (1024, 4, 4), 128, 1), Path("x"))


def test_reach_is_the_depth_that_one_pixel_in_a_thousand_passes():
    views = random_planes(3, size=24, seed=1)
    depth = sorted(float(d) for t in views.transients for d in t.depth_m.ravel() if d == d)
    reach = training_reach_m(views)
    assert sum(d > reach + 1e-3 for d in depth) <= 0.001 * len(depth) + 1


def test_store_keeps_what_was_put_and_survives_a_cut_line(tmp_path):
    store = Store(tmp_path / "results")
    store.put("a" * 64, {"mae": float("nan")}, view=1, level=[10.0, 2.0])
    store.put("a" * 64, 3, view=2)
    store.put("b" * 64, 4, view=2)
    again = Store(tmp_path / "results")
    assert again.get("a" * 64, view=2) == 3 and again.get("b" * 64, view=2) == 4 and again.get("a" * 64, view=3) is None
    assert again.get("a" * 64, level=[10.0, 2.0], view=1)["mae"] != 0
    path = tmp_path / "results" / f"{'a' * 32}.jsonl"
    path.write_bytes(path.read_bytes()[:-3])  # killed while it wrote the second line
    cut = Store(tmp_path / "results")
    assert cut.get("a" * 64, view=2) is None and cut.get("a" * 64, level=[10.0, 2.0], view=1) is not None
    cut.put("a" * 64, 5, view=2)
    assert Store(tmp_path / "results").get("a" * 64, view=2) == 5
