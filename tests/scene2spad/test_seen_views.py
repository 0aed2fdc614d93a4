"""`evaluate` tells views that a network was trained on."""

import json
import re
import shutil
from dataclasses import replace

import pytest
from small_runs import QUICK

from csph.networks.checkpoint import load_model
from csph.training.lineage import ancestors_of
from csph.training.overlap import SEEN_SCENES
from csph.training.views import ANCESTORS_SEEN, SEEN, Views, read_views
from csph.weights.cards import checkpoint_of, read_card
from csph.weights.shipped import ship
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import random_planes


def test_a_test_on_views_of_training_says_so(capfd, packed, trained, tmp_path):
    """Also where a run split its set itself; not of views that it has not seen."""
    others = tmp_path / "others.h5"
    views = random_planes(6, size=16, seed=9)
    write_pack(((t, {"scene": s}) for t, s in zip(views.transients, views.scenes, strict=True)), others)
    out = ("--levels", "50+1", "--views", "1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    for path, said in ((packed, True), (others, False)):
        assert main(["evaluate", str(trained), "--set", str(path), *out]) == 0
        told = re.findall(
            rf"was trained on (\d+) views of {path}: its errors there are not those", capfd.readouterr().err
        )
        assert told == ["1"] * said


def test_a_set_that_is_given_under_two_names_is_refused(capfd, packed, tmp_path):
    """Refuse what was taken without a word, and had its views drawn twice as often as others."""
    again, out = pack(read_views(packed), tmp_path / "again.h5", grid=4), tmp_path / "run"
    others = str(pack(random_planes(3, size=16, seed=9), tmp_path / "others.h5"))
    cure = "; --set-weights says how often a set is drawn from"
    for asked, option, end in (((), "set", cure), (("--set", others, "--validation"), "validation", "")):
        sets = [*(asked or ("--set",)), str(again), str(packed)]
        assert main(["train", *QUICK, *sets, "--out", str(out)]) == 2
        said = capfd.readouterr().err.strip().splitlines()[-1]
        assert said.endswith(f"train: --{option} {again} and {packed} hold the same views{end}")
    assert not out.exists()


def test_views_of_training_are_known_one_by_one(capfd, packed, trained, tmp_path):
    """Some of them among others, too. Runs of before have one hash of all: known where the set is the same."""
    seen, other = read_views(packed), random_planes(3, size=16, seed=9)
    some = tmp_path / "some.h5"
    pairs = [*zip(seen.transients[:2], seen.scenes[:2], strict=True), *zip(other.transients, "xyz", strict=True)]
    write_pack(((t, {"scene": s}) for t, s in pairs), some)
    before = tmp_path / "before"
    shutil.copytree(trained, before)
    (before / SEEN).unlink()
    out = ("--levels", "50+1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    for model, path, number in ((trained, some, "2"), (before, some, None), (before, packed, r"\d")):
        assert main(["evaluate", str(model), "--set", str(path), *out]) == 0
        assert bool(re.search(rf"was trained on {number} views of {path}", capfd.readouterr().err)) == bool(number)


def test_scenes_of_training_are_known_at_another_size(capfd, tmp_path):
    """Also through a beginning; not scenes that were held out, nor by runs of before."""
    large, small = (random_planes(4, size=size, seed=5) for size in (16, 8))
    names = [f"rooms/train/room {number}" for number in range(4)]
    for views, name in ((large, "large.h5"), (small, "small.h5")):
        records = [
            {"place": name, "scene": name, "notes": [f"procedural, train view {number} of seed 5: camera 0"]}
            for number, name in enumerate(names)
        ]
        noted = [replace(t, meta={**t.meta, **r}) for t, r in zip(views.transients, records, strict=True)]
        write_pack(zip(noted, records, strict=True), tmp_path / name)
    run, child, before, small_set = (tmp_path / name for name in ("run", "child", "before", "small.h5"))
    assert main(["train", *QUICK, "--set", str(tmp_path / "large.h5"), "--out", str(run)]) == 0
    others = pack(random_planes(3, size=16, seed=9), tmp_path / "others.h5")
    assert main(["train", *QUICK, "--set", str(others), "--init", str(run), "--out", str(child)]) == 0
    shutil.copytree(run, before)
    (before / SEEN_SCENES).unlink()
    out = ("--levels", "50+1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    words = f"trained on scenes that 3 views of {small_set} show: its errors there"
    for model, told in ((run, f"{run} was {words}"), (child, f"{child} began with a model that was {words}")):
        capfd.readouterr()
        assert main(["evaluate", str(model), "--set", str(small_set), *out]) == 0
        assert told in capfd.readouterr().err
    for model, path in ((before, small_set), (run, others)):
        assert main(["evaluate", str(model), "--set", str(path), *out]) == 0
        assert "on scenes that" not in capfd.readouterr().err


def pack(views: Views, path, **meta):
    write_pack(((t, {"scene": s, **meta}) for t, s in zip(views.transients, views.scenes, strict=True)), path)
    return path


@pytest.fixture(scope="module")
def grandchild(trained, tmp_path_factory):
    """Return the run that began with a run that began with `trained`, each on planes of its own."""
    folder = tmp_path_factory.mktemp("runs")
    parent = trained
    for seed, name in ((11, "child"), (12, "grandchild")):
        path = pack(random_planes(4, size=16, seed=seed), folder / f"{name}.h5")
        asked = ["--init", str(parent), "--set", str(path), "--seed", str(seed), "--out", str(folder / name)]
        assert main(["train", *QUICK, *asked]) == 0
        parent = folder / name
    return parent


def test_views_of_an_ancestors_training_are_known(capfd, packed, trained, grandchild, tmp_path):
    """By their keys where the run's folder holds them, by the sets' hashes in the checkpoint alone; from both sides of
    two beginnings."""
    ancestors = load_model(grandchild)[1].data["ancestors"]
    sets = [load_model(path)[1].data["training_sha256"] for path in (grandchild.with_name("child"), trained)]
    assert [one["training_sha256"] for one in ancestors] == sets and ancestors[1]["name"] == trained.name
    own, before = (set((grandchild / name).read_text().split()) for name in (SEEN, ANCESTORS_SEEN))
    assert own and not own & before and before >= set((trained / SEEN).read_text().split())
    moved = tmp_path / "moved.safetensors"
    shutil.copy(grandchild / "model.safetensors", moved)
    out = ("--levels", "50+1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    others = pack(random_planes(3, size=16, seed=9), tmp_path / "others.h5")
    for model in (grandchild, moved):
        for path, expected in ((packed, ["5"]), (others, [])):
            assert main(["evaluate", str(model), "--set", str(path), *out]) == 0
            said = capfd.readouterr().err
            assert re.findall(rf"began with a model that was trained on (\d+) views of {path}", said) == expected
            assert f"was trained on 5 views of {path}: its" not in said.replace("model that was trained", "")
        assert main(["evaluate", str(model), "--set", str(packed), "--views", "2", *out]) == 0
        assert f"trained on 2 views of {packed}" in capfd.readouterr().err  # no more than are evaluated
    asked = ["--set", str(others), "--validation", str(packed), "--init", str(grandchild), "--out", str(tmp_path / "n")]
    assert main(["train", *QUICK, *asked]) == 0
    said = "the model to begin with was trained on 5 of 6 validation views: validation errors are too low"
    assert said in capfd.readouterr().err
    ship(grandchild, "shipped", tmp_path)
    assert read_card(tmp_path / "shipped/card.json").init == "child"
    assert [*ancestors_of(load_model(tmp_path / "shipped/model.safetensors")[1])] == ancestors


def test_runs_of_before_go_on_without_ancestors(capfd, grandchild, tmp_path):
    """Their configuration names none. The hash of the weights that a run began with still decides."""
    run = tmp_path / "run"
    shutil.copytree(grandchild, run)
    config = json.loads((run / "config.json").read_text())
    del config["data"]["ancestors"]
    (run / "config.json").write_text(json.dumps(config))
    child = grandchild.with_name("child")
    again = ["train", *QUICK, "--set", f"{grandchild}.h5", "--seed", "12", "--out", str(run), "--init"]
    assert main([*again, str(child)]) == 0
    assert main([*again, str(grandchild)]) == 2
    assert "init_sha256" in capfd.readouterr().err


def test_shipped_models_of_before_know_their_shipped_ancestors(capfd, packed, tmp_path):
    """By name and hash. Of weights that were never shipped, or were replaced, the hash is all there is."""
    config = load_model(checkpoint_of("learned-256x4x4-128x-tdc-s0"))[1]
    (parent,) = ancestors_of(config)
    assert parent["name"] == config.data["init"] and parent["sha256"] == config.data["init_sha256"]
    assert parent["training_sha256"] == load_model(checkpoint_of(parent["name"]))[1].data["training_sha256"]
    (other,) = ancestors_of(replace(config, data={**config.data, "init_sha256": "0" * 64}))
    assert other == {"name": parent["name"], "sha256": "0" * 64}
    out = ("--levels", "50+1", "--baselines", "argmax", "--out", str(tmp_path / "out"))
    assert main(["evaluate", "none-published-s0", "--set", str(packed), *out]) == 0
    said = (
        "none-published-s0 goes back to weights named none-mixed-s0, after 4,800 steps on the published grid; whether"
    )
    assert said in capfd.readouterr().err


def test_validation_on_training_views_is_refused_or_told(capfd, packed, tmp_path):
    """All of them: nothing is left. Some, and scenes that two sets share and split each by itself: a warning."""
    views = read_views(packed)
    some = pack(Views(views.transients[4:], views.scenes[4:]), tmp_path / "some.h5")
    train = ["train", *QUICK, "--dry-run", "--set"]
    for path in (packed, some):
        assert main([*train, str(packed), "--validation", str(path)]) == 2
        assert f"--validation {path}: all its" in capfd.readouterr().err
    new = random_planes(3, size=16, seed=9)
    mixed = pack(Views(views.transients[:1] + new.transients, ("x", *new.scenes)), tmp_path / "mixed.h5")
    assert main([*train, str(packed), "--validation", str(mixed)]) == 0
    assert "1 of 4 validation views are trained on, 1 show scenes that are" in capfd.readouterr().err
    # the last scene is validated on; in a longer set it is not the last
    longer = Views(views.transients + new.transients, (*views.scenes, *"xyz"))
    assert main([*train, str(packed), str(pack(longer, tmp_path / "longer.h5"))]) == 0
    assert "1 of 2 validation views are trained on" in capfd.readouterr().err
    assert main([*train, str(packed), str(pack(new, tmp_path / "new.h5"))]) == 0
    assert "validation views" not in capfd.readouterr().err
