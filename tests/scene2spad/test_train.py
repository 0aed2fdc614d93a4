"""Training and evaluation as a user meets them: a set, a checkpoint, depth; killed and resumed; one line a mistake."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from commands import refused, run
from small_runs import QUICK

from csph.codes.design import Design
from csph.levels import PHOTON_LEVELS
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig, preset
from csph.weights.cards import checkpoint_of
from csph.weights.shipped import ship
from render.transient import write_transient
from render.transient.packs import write_pack
from scene2spad.bench import network as bench
from scene2spad.cli import main
from scene2spad.datasets.planes import FAR_M, Plane, random_planes, wall
from scene2spad.networks.evaluating import group_names
from scene2spad.networks.training import config_of
from scene2spad.options.networks import Train
from scenes import InputError
from spad.detection.detect import sense
from spad.formats.depth_map import read_depth
from spad.measurements.histogram import write_histogram
from spad.sensor.model import PhotonBudget, Sensor


def test_planes_of_few_pixels_return_no_light_from_behind_the_camera():
    """A wide pixel of a steep plane spans more than twice its depth: one scene of twenty at 2 x 2, few at 8 x 8."""
    with pytest.raises(InputError, match="planes: images of 1 x 1 pixels, expected 2 x 2 or more"):
        random_planes(1, size=1)
    for view in random_planes(100, size=2).transients:
        assert view.returns > 0 and (view.path_near_m >= 0).all()


def test_planes_are_planes():
    plane = Plane(np.array([0.0, 0.0, -1.0]), 2.0, 0.5)
    rays = np.array([[0.0, 0, 1], [0.6, 0, 0.8], [0, 0, -1]])
    assert plane.distance_m(rays).tolist() == [2.0, 2.5, np.inf]
    views = random_planes(12, size=24, seed=3)
    for transient in views.transients:
        met = np.isfinite(transient.depth_m)
        assert met.any() and transient.returns == met.sum()
        np.testing.assert_allclose(transient.mean_path_m()[met] / 2, transient.depth_m[met], rtol=1e-6)
        assert transient.depth_m[met].min() > 0.1 and transient.depth_m[met].min() < 2 * FAR_M
    again = random_planes(12, size=24, seed=3)
    assert [t.sha256() for t in views.transients] == [t.sha256() for t in again.transients]
    assert views.transients[0].sha256() != random_planes(1, size=24, seed=4).transients[0].sha256()


def test_train_evaluate_depth(capfd, packed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run(capfd, "train", *QUICK, "--set", str(packed), "--out", "run")
    assert {"steps", "seconds", "val_rmse_mm", "checkpoint", "parameters"} <= result.keys()
    assert result["steps"] == 8 and result["model"] == "learned 256x4x4 K32, compact"
    config = json.loads(Path("run/config.json").read_text())
    assert config["data"]["training"] == str(packed) and len(config["data"]["training_sha256"]) == 64
    assert config["model"]["sensor"]["bins"] == 1024

    found = run(capfd, "evaluate", "run", "--set", str(packed), "--views", "2", "--int8", "--out", "table")
    assert {"mae_mm", "rmse_mm", "within_10mm", "by_sbr", "methods", "overflows"} <= found.keys()
    name = "learned 256x4x4 K32, compact"
    assert set(found["methods"]) == {name, f"{name} int8", "argmax", "log-matched", "fourier-8"}
    assert found["method"] == f"{name} int8" and found["trainings"] == 1
    rows = Path("table/evaluation.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * len(PHOTON_LEVELS) * 5 * 3
    by_sbr = found["by_sbr"]["log-matched"]
    assert by_sbr["high_sbr"]["mae_mm"] < by_sbr["low_sbr"]["mae_mm"]
    every = found["methods"]["log-matched"]["all"]["all"]
    assert every["mae_interval_mm"][0] < every["mae_mm"] < every["mae_interval_mm"][1]
    few = run(capfd, "evaluate", "run", "--set", str(packed), "--levels", "2+100", "50+1", "--out", "few")
    assert [(one["signal"], one["background"]) for one in few["by_level"][::4]] == [(2, 100), (50, 1)]
    dim, bright = (
        [x["mae_mm"] for x in few["by_level"] if x["signal"] == s and x["method"] == "argmax"] for s in (2, 50)
    )
    assert dim > bright and len(Path("few/evaluation.csv").read_text().splitlines()) == 1 + 6 * 2 * 4 * 3
    moved = run(capfd, "evaluate", "run", "--set", str(packed), "--views", "1", "--offset", "2", "--out", "table")
    assert min(b["near_m"] for b in moved["methods"]["argmax"]["bias_by_depth"]) >= 2

    histogram = sense(random_planes(1, size=16, seed=4).transients[0], Sensor(), PhotonBudget(50, 50))
    write_histogram(histogram, Path("planes.h5"))
    depth = run(capfd, "depth", "planes.h5", "--method", "network", "--checkpoint", "run", "--no-figure")
    assert depth["pixels"] == np.isfinite(histogram.depth_m).sum() and depth["method"] == "network-run"
    assert Path("planes-network-run.exr").is_file()
    assert 0 < depth["confidence"] <= 1
    mean = run(capfd, "depth", "planes.h5", "--method", "network", "--model", "none-s0", "--decoder", "soft-argmax")
    median = run(capfd, "depth", "planes.h5", "--method", "network", "--model", "none-s0", "--no-figure")
    assert median["mae_mm"] < mean["mae_mm"]
    assert mean["method"] == "network-none-s0-soft-argmax" and mean["out"] != median["out"]
    assert [read_depth(Path(one["out"]))[2]["decoder"] for one in (mean, median)] == ["soft-argmax", "median"]
    layers = OpenEXR.File("planes-network-none-s0.exr", separate_channels=True).channels()
    assert set(layers) == {"Z", "confidence"}
    sure = layers["confidence"].pixels
    assert sure.shape == (16, 16) and sure.mean() == pytest.approx(median["confidence"], abs=1e-6)


def test_codes_of_several_pixels_get_the_refined_network():
    """With the presets that have the time for it; other codes, no codes and other presets get what they had."""

    def network(**options) -> str:
        return config_of(Train(**{"preset": "laptop", **options})).model.network

    assert network() == network(preset="workstation", block=(1024, 2, 2)) == "refined"
    single = network(design="fourier", block=(1024, 1, 1))
    assert {single, network(design="none"), network(block=(8, 4, 4), codes=4), network(preset="smoke")} == {"compact"}
    assert network(preset="laptop-v1") == network(preset="gpu") == network(network="compact") == "compact"
    assert network(preset="paper") == "published"


def test_training_goes_on_from_a_model_by_name(capfd, packed, tmp_path):
    """One step at a learning rate of nearly 0 keeps the shipped weights, of 11 bits each."""
    design = ["--design", "learned", "--block", "256", "4", "4", "--init", "learned-256x4x4-128x-s0"]
    more = [
        "--init-share",
        "0.5",
        "--rate",
        "1e-12",
        "--steps",
        "1",
        "--set",
        str(packed),
        "--out",
        str(tmp_path / "run"),
    ]
    run(capfd, "train", *QUICK, *design, *more)
    tuned, config, _ = load_model(tmp_path / "run")
    shipped, _, _ = load_model(checkpoint_of("learned-256x4x4-128x-s0"))
    assert config.data["init"] == "learned-256x4x4-128x-s0" and config.init_share == 0.5
    for name, value in tuned.state_dict().items():
        torch.testing.assert_close(value, shipped.state_dict()[name], rtol=0, atol=1e-9)


def test_trainings_by_other_recipes_are_groups_of_their_own():
    config = preset("smoke", ModelConfig(front="matched"))
    again, other = replace(config, seed=1), replace(config, seed=2, data={"training_sha256": "0" * 64})
    assert group_names([config, again], ["a", "b"]) == ["no compression, compact"] * 2
    named = group_names([config, again, other], ["a", "b", "c"])
    assert named == ["no compression, compact (a)"] * 2 + ["no compression, compact (c)"]
    coded = preset("smoke", ModelConfig(design=Design("fourier", (1024, 1, 1), 8)))
    others = [
        replace(coded, time_offset_m=12.0, window=0),
        replace(coded, rate=1e-3),
        replace(coded, model=replace(coded.model, layer={"keep_mean": True})),
        replace(coded, model=replace(coded.model, grid="published")),
    ]
    names = group_names([coded, *others], ["a", "b", "c", "d", "e"])
    assert names == [f"fourier 1024x1x1 K8, compact ({one})" for one in "abcde"]


def test_what_a_training_began_with_is_of_its_recipe():
    """Another start is another recipe, whatever the seed; names of the same weights do not count. A second checkpoint
    of one seed is no further training."""
    config = preset("smoke", ModelConfig(front="matched"))
    begun = replace(config, seed=1, data={"init": "a", "init_sha256": "1" * 64})
    others = [
        replace(begun, seed=2, data={"init": "b", "init_sha256": "1" * 64}),
        replace(begun, seed=3, data={"init": "a", "init_sha256": "2" * 64}),
        replace(begun, seed=4, data={"init_network": "a", "init_sha256": "1" * 64}),
        replace(begun, seed=5, init_share=0.5),
        replace(config, threads=2),
    ]
    named = group_names([config, begun, *others], [*"abcdefg"])
    assert [name.removeprefix("no compression, compact ") for name in named] == [f"({one})" for one in "abbdefg"]


def test_the_same_weights_twice_are_refused(capfd, packed, trained, tmp_path):
    """Under another name, and as they are shipped, in half precision: they counted as two seeds."""
    copy = tmp_path / "copy.safetensors"
    shutil.copy(trained / "model.safetensors", copy)
    for other in (copy, ship(trained, "half", tmp_path)):
        said = refused(
            capfd, "evaluate", str(trained), str(other), "--set", str(packed), "--out", str(tmp_path / "out")
        )
        assert f"{trained} and {other} are the same weights; give them once" in said
    assert not (tmp_path / "out").exists()


def test_models_are_listed_with_their_limits(capfd):
    found = {card["name"]: card for card in run(capfd, "models")["models"]}
    assert found["none-s0"]["compression"] == 1 and found["none-s0"]["training"] == ["rooms2.h5"]
    assert run(capfd, "models", "none-s0") == found["none-s0"]
    assert "model 'nonne-s0' is unknown, like none-s0" in refused(capfd, "models", "nonne-s0")


def test_folder_of_a_set(capfd, tmp_path):
    views = random_planes(3, size=8, seed=1)
    (tmp_path / "views").mkdir()
    records = []
    for i, (transient, scene) in enumerate(zip(views.transients, views.scenes, strict=True)):
        write_transient(transient, tmp_path / f"views/{i}.exr")
        records.append({"view": i, "scene": scene, "file": f"views/{i}.exr"})
    records.append({"view": 3, "failed": "no light"})
    (tmp_path / "index.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    result = run(capfd, "train", *QUICK, "--steps", "2", "--set", str(tmp_path), "--out", str(tmp_path / "run"))
    assert result["views"] == 2 and result["steps"] == 2


def test_bad_input_is_one_line(capfd, packed, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    train = ["train", *QUICK, "--out", "x", "--set"]
    assert "nowhere.h5: file not found" in refused(capfd, *train, "nowhere.h5")
    Path("empty").mkdir()
    assert "no index.jsonl" in refused(capfd, *train, "empty")
    Path("empty/index.jsonl").write_text("")
    assert "empty: the set is empty" in refused(capfd, *train, "empty")
    Path("empty/index.jsonl").write_text("{cut")
    assert "is damaged" in refused(capfd, *train, "empty")
    lasers = random_planes(2, size=8).transients
    displaced = [(t, {"scene": "a", "laser": {"baseline_m": [0.1, 0, 0]}}) for t in lasers]
    write_pack(displaced, Path("displaced.h5"))
    assert "the laser of a is not at the camera" in refused(capfd, *train, "displaced.h5")
    write_pack([(t, {"scene": "a"}) for t in lasers], Path("one.h5"))
    assert "one.h5: a set of one scene (a)" in refused(capfd, *train, "one.h5")
    assert "crops of 8 pixels are not tiled by blocks of 3 x 3" in refused(
        capfd, *train, str(packed), "--block", "256", "3", "3", "--codes", "8"
    )
    assert "does not divide" in refused(capfd, *train, str(packed), "--compression", "100")
    assert "holds a run with other options or another set (seed: 0 there, 1 asked)" in refused(
        capfd, "train", *QUICK, "--seed", "1", "--set", str(packed), "--out", str(trained)
    )
    assert not Path("x").exists()

    planes = random_planes(1, size=16).transients[0]
    write_histogram(sense(planes, replace(Sensor(), bins=512), PhotonBudget(5, 5)), Path("other.h5"))
    depth = ["depth", "other.h5", "--method", "network"]
    assert "--method network and --checkpoint or --model go together" in refused(capfd, *depth)
    assert "trained for another sensor" in refused(capfd, *depth, "--checkpoint", str(trained))
    evaluate = ["evaluate", str(trained), "--set", str(packed)]
    assert "method 'guess' is none of argmax" in refused(capfd, *evaluate, "--baselines", "guess")
    assert "method 'fourier-²' is none of" in refused(capfd, *evaluate, "--baselines", "fourier-²")
    for level in ("10", "1+x", "0+5", "2+-1", "nan+1"):
        assert f"levels '{level}': expected" in refused(capfd, *evaluate, "--levels", level)
    paper = refused(capfd, "evaluate", str(trained), "--set", "published", "--levels", "1+1")
    assert "--levels does not go with --set published" in paper
    for more in (
        ("--maps",),
        ("--int8",),
        ("--tiled",),
        ("--views", "2"),
        ("--decoder", "median"),
        ("--law", "auto"),
        ("--baselines", "argmax"),
    ):
        paper = refused(capfd, "evaluate", str(trained), "--set", "published", *more)
        assert f"{more[0]} does not go with --set published" in paper
    far = refused(capfd, "evaluate", str(trained), "--set", "published", "--baselines", "--offset", "20")
    assert "outside 0 to the sensor's range" in far
    uncoded = [*train, str(packed), "--design", "none"]
    assert "layer int8, keep_mean: is for codes" in refused(capfd, *uncoded, "--layer", "int8", "keep_mean")
    wrong = ["--design", "fourier", "--block", "1024", "1", "1", "--codes"]
    assert "expected" in refused(capfd, *train, str(packed), *wrong, "7")
    assert not Path("x").exists()
    assert "outside 0 to the sensor's range" in refused(capfd, *evaluate, "--offset", "20")
    assert "file not found" in refused(capfd, "evaluate", "nowhere", "--set", str(packed))


def test_a_dry_training_refuses_the_sets_that_the_run_refuses(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    planes_pack(Path("one.h5"), [wall(2.0, 8), wall(3.0, 8)], "aa")
    Path("mixed").mkdir()
    records = [{"view": i, "scene": f"s{i}", "file": f"{i}.exr"} for i in range(2)]
    for i, size in enumerate((8, 16)):
        write_transient(wall(2.0, size), Path(f"mixed/{i}.exr"))
    Path("mixed/index.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    expected = {
        "one.h5": "a set of one scene (a) has none left to validate on",
        "mixed": "mixed: views are of several sizes (8 x 8 and 16 x 16 pixels), training takes one size",
    }
    for name, words in expected.items():
        for dry in ((), ("--dry-run",)):
            assert words in refused(capfd, "train", *QUICK, "--out", "x", "--set", name, *dry)
    planes_pack(Path("other.h5"), [wall(4.0, 8)], "b")
    assert run(capfd, "train", *QUICK, "--set", "one.h5", "--validation", "other.h5", "--dry-run")["dry_run"]


@pytest.mark.parametrize("option", ["--init", "--init-network"])
def test_a_dry_training_refuses_the_beginnings_that_the_run_refuses(capfd, tmp_path, monkeypatch, option):
    monkeypatch.chdir(tmp_path)
    other = "fourier-1024x1x1-128x-periodic-s1"
    expected = {"nowhere": "nowhere", other: f"{other}: network periodic: is for Fourier codes over all 1024 bins"}
    for name, words in expected.items():
        for dry in ((), ("--dry-run",)):
            assert words in refused(capfd, "train", *QUICK, "--set", "planes", "--out", "x", option, name, *dry)


def test_a_model_to_begin_with_decides_the_network(capfd, tmp_path, monkeypatch):
    """Compact by default with smoke; the model is refined. One that cannot be is answered with the one that can."""
    monkeypatch.chdir(tmp_path)
    name = "learned-256x4x4-128x-t8-mixed-s42"
    begun = ("train", *QUICK, "--block", "256", "4", "4", "--compression", "128", "--init", name)
    assert run(capfd, *begun, "--dry-run")["model"] == "learned 256x4x4 K32, refined"
    assert "with --network refined it can" in refused(capfd, *begun, "--network", "compact", "--out", "x")
    compact = replace(Train(), init="learned-256x4x4-128x-s0", preset="laptop")
    assert config_of(compact).model.network == "compact"
    assert config_of(replace(compact, network="refined")).model.network == "refined"


def test_an_evaluation_counts_its_pixels_and_views(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    two = planes_pack(Path("two.h5"), [wall(2.0, 4), wall(9.0, 4)], "ab")
    command = ("evaluate", "none-s0", "--baselines", "argmax", "--levels", "50+1", "--set", two, "--out", "out")
    assert "evaluate: views 3 is outside 1 to 2 of two.h5" in refused(capfd, *command, "--views", "3")
    found = run(capfd, *command)
    assert (found["pixels_within_range"], found["beyond_range"]) == (32, 0)
    assert main([*command, "--offset", "7", "--json"]) == 0
    out, err = capfd.readouterr()
    assert (json.loads(out)["pixels_within_range"], json.loads(out)["beyond_range"]) == (16, 16)
    assert "two.h5: 16 of 32 pixels lie beyond the 14.99 m that the sensor records" in err


def planes_pack(path: Path, transients, scenes) -> str:
    write_pack([(t, {"scene": s}) for t, s in zip(transients, scenes, strict=True)], path)
    return str(path)


def test_an_evaluation_without_answers_or_truth(capfd, tmp_path, monkeypatch):
    """One line that names the set before any work; a method without an answer has none, and the others keep theirs."""
    monkeypatch.chdir(tmp_path)
    far = planes_pack(Path("far.h5"), [wall(9.0, 4), wall(10.0, 4)], "ab")
    command = ("evaluate", "none-s0", "--baselines", "log-matched", "--out", "out", "--levels")
    told = refused(capfd, *command, "50+1", "--set", far, "--offset", "7")
    assert told == "scene2spad: far.h5: no pixel has a depth within the sensor's 14.99 m at an offset of 7 m"
    lit, none = wall(2.0, 4), {"path_near_m": 0, "path_far_m": 0, "radiance": 0, "bounces": 0}
    dark = replace(lit, offsets=0 * lit.offsets, **{name: getattr(lit, name)[:n] for name, n in none.items()})
    told = refused(capfd, *command, "50+1", "--set", planes_pack(Path("dark.h5"), [lit, dark], ("lit", "dark")))
    assert "evaluation: no light returns from a view of dark" in told and not Path("out").exists()
    found = run(capfd, *command, "0.001+0", "--set", far)
    nothing = found["methods"]["log-matched"]["all"]["all"]["mae_mm"]
    assert nothing is None and found["mae_mm"] > 0 and found["by_level"][1]["mae_mm"] is None
    assert found["by_level"][1]["missing"] == 32 and found["by_level"][1]["within_10mm"] == 0
    assert main([*command, "0.001+0", "--set", far]) == 0
    assert "no estimate in some pixels (log-matched 1): MAE" in capfd.readouterr().err
    assert found["mae_difference_mm"]["all"]["log-matched"] == {"mean": None, "low": None, "high": None}


def test_figures_of_levels_and_depths_count_scenes_and_every_pixel(capfd, tmp_path, monkeypatch):
    """The MAE in the line of the only level is the headline's, whatever the views of a scene; the bias of the farthest
    pixel is told where it is whole metres away."""
    monkeypatch.chdir(tmp_path)
    near = [wall(1.0 + i / 8, 4) for i in range(3)]
    uneven = planes_pack(Path("uneven.h5"), [*near, wall(3.0, 4)], "aaab")
    command = ("evaluate", "none-s0", "--baselines", "argmax", "--levels", "3+9", "--set", uneven, "--out", "out")
    found = run(capfd, *command)
    by_level = {one["method"]: one["mae_mm"] for one in found["by_level"]}
    assert by_level == {name: pytest.approx(of["all"]["all"]["mae_mm"]) for name, of in found["methods"].items()}
    counted = {b["near_m"]: b["pixels"] for b in found["methods"]["argmax"]["bias_by_depth"]}
    assert counted == {1: 48, 3: 16}


@pytest.mark.slow
def test_bench_network(capfd, tmp_path, monkeypatch):
    """At a small size: the plain layers give what ours give, and training takes a step even when its time is up."""
    small = {"PRESET": "smoke", "FRAME": (1, 1, 1024, 8, 8), "SCENES": 10, "VIEW_PIXELS": 16, "QUICK_SECONDS": 0.0}
    for name, value in small.items():
        monkeypatch.setattr(bench, name, value)
    found = run(capfd, "bench", "network", "--quick", "--repeats", "1", "--out", str(tmp_path))
    compact, published, plain = found["rows"]
    assert compact["gmac"] <= 1.5 and published["parameters"] == plain["parameters"] == 568_278
    assert compact["trained_steps"] == published["trained_steps"] == 1 and compact["error"] > 0
    assert plain["error"] < 1e-4 and plain["gmac"] > published["gmac"]
    assert len((tmp_path / "network.csv").read_text().splitlines()) == 4


@pytest.mark.slow
def test_killed_and_resumed(packed, tmp_path):
    """SIGKILL in the middle of an epoch, twice: the last weights are those of a run that was left alone."""
    arguments = ["--steps", "40", "--set", str(packed)]

    def start(folder: Path) -> subprocess.Popen:
        code = "import sys; from scene2spad.cli import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", code, "train", *QUICK, *arguments, "--out", str(folder)]
        return subprocess.Popen(command, cwd=Path(__file__).parents[2], stderr=subprocess.DEVNULL)

    assert start(tmp_path / "whole").wait() == 0
    folder = tmp_path / "killed"
    process = start(folder)
    for wait in (lambda: (folder / "config.json").is_file(), lambda: (folder / "resume.ckpt").is_file()):
        while not wait() and process.poll() is None:
            time.sleep(0.01)
        time.sleep(0.3)
        assert process.poll() is None, "the run ended before it could be killed"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process = start(folder)
    assert process.wait() == 0
    for name in ("last.safetensors", "model.safetensors", "log.csv", "energy.csv"):
        assert (folder / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
