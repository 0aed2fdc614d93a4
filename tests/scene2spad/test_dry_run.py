"""`--dry-run` tells plan, memory and work, and writes nothing; `study all` goes on past what cannot be run."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from csph.weights.shipped import RESUME
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.cli.opening import EXR_SIGNATURE
from scene2spad.datasets.planes import random_planes
from scene2spad.dry_runs.rendering import (
    LIBRARY_BYTES,
    MEMORY_MARGIN,
    PIXEL_BYTES,
    Trial,
    estimated,
    peak_of_render,
    trial_sizes,
)
from scene2spad.networks.registry import ModelRegistry, ModelSpec
from scene2spad.networks.training import config_of
from scene2spad.options.experiments import OPTIONS_OF, STUDIES, Study
from scene2spad.options.networks import Train
from scene2spad.studies import every
from scenes.errors import InputError
from scenes.files import append_line


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def answer(capfd, *argv: str) -> dict:
    assert main([*argv, "--json"]) == 0
    out = capfd.readouterr().out
    assert len(out.splitlines()) == 1
    return json.loads(out)


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_dry_render_states_its_plan_and_writes_nothing(capfd, folder):
    said = answer(capfd, "render", "plane", "--width", "96", "--height", "64", "--bounces", "1", "--dry-run")
    assert files(folder) == []
    assert said["dry_run"] and said["out"] == "plane.exr" and said["pixels"] == [96, 64]
    assert said["plan"]["bounces"] == 1 and "trial" in said["basis"]
    least = LIBRARY_BYTES + PIXEL_BYTES * 96 * 64
    assert MEMORY_MARGIN * least < said["memory"]["peak_bytes"] < said["memory"]["limit_bytes"]
    # the plane's rays are as many in every pixel, so that the trial tells the render's
    made = answer(capfd, "render", "plane", "--width", "96", "--height", "64", "--bounces", "1", "--no-figure")
    assert said["plan"]["grid"] == made["plan"]["grid"]
    assert said["estimate"]["rays"] == pytest.approx(made["rays"], rel=0.3)
    assert said["estimate"]["file_bytes"] == pytest.approx((folder / "plane.exr").stat().st_size, rel=0.5)


def test_two_trials_are_extended_by_edges_and_area():
    """Numbers that are a sqrt(p) + b p of p pixels come out as they are, and times as a constant and a slope."""

    def trial(side: int) -> Trial:
        edges_and_area = 300 * side + 2 * side**2
        return Trial(side, side, 1 + 1e-4 * side**2, 2.0, edges_and_area, 5 * side, 7 * side**2, 0)

    found = estimated([trial(48), trial(96)], 0.5, 640 * 480)
    side = (640 * 480) ** 0.5
    assert found["rays"] == pytest.approx(300 * side + 2 * side**2)
    assert found["returns"] == pytest.approx(5 * side, abs=1) and found["file_bytes"] == pytest.approx(7 * side**2)
    assert found["seconds"] == pytest.approx(0.5 + 1 + 1e-4 * side**2) and found["cpu_seconds"] == 2
    whole = estimated([trial(48)], 0.5, 48 * 48)
    assert whole["rays"] == 300 * 48 + 2 * 48**2 and whole["seconds"] == pytest.approx(1.5 + 1e-4 * 48**2)


def test_estimates_never_fall_with_the_size_of_the_image():
    """Noise of trials may say that the larger one took less, or that all is edges: no figure shrinks from there."""
    some = [Trial(48, 48, 2.0, 2.0, 900, 500, 800, 0), Trial(96, 96, 1.0, 1.0, 800, 900, 4000, 0)]
    found = estimated(some, 0.0, 640 * 480)
    assert found["seconds"] == 1 and found["cpu_seconds"] == 1
    times = 640 * 480 / 96**2  # as many pixels: all is edges, or all is area
    for name, other in (("rays", 800), ("returns", 900), ("file_bytes", 4000)):
        assert 0.999 * times**0.5 < found[name] / other < 1.001 * times


@pytest.mark.parametrize(
    ("pixels", "sizes"), [(100, [100]), (2304, [2304]), (6144, [576, 2304]), (10**6, [2304, 9216])]
)
def test_trials_are_no_larger_than_the_request(pixels, sizes):
    assert trial_sizes(pixels) == sizes


# scene, pixels, bounces, returns, and the peak of its process as the system counted it [MB]
PEAKS = [
    ("gallery", 64 * 64, 1, 57_343, 229),
    ("gallery", 256 * 256, 1, 250_374, 316),
    ("gallery", 640 * 480, 1, 837_719, 663),
    ("gallery", 256 * 256, 24, 4_620_740, 479),
    ("gallery", 640 * 480, 24, 19_310_597, 1211),
    ("living-room", 256 * 256, 1, 333_104, 407),
    ("living-room", 640 * 480, 1, 682_754, 699),
    ("living-room", 320 * 240, 24, 4_871_989, 512),
    ("living-room", 640 * 480, 24, 17_017_431, 1639),
]


@pytest.mark.parametrize(("scene", "pixels", "bounces", "returns", "peak"), PEAKS)
def test_memory_is_promised_near_measured_peaks(scene, pixels, bounces, returns, peak):
    """Promise at most half more than was measured; trials themselves took 220 MB of one bounce, 364 or more of 24."""
    promised = peak_of_render(pixels, returns, 220e6 if bounces == 1 else 364e6)
    assert 0.98 * peak < promised / 1e6 < 1.5 * peak, scene


def test_a_dry_render_refuses_what_the_render_refuses(capfd, folder):
    assert main(["render", "plane", "--width", "16384", "--height", "16384", "--dry-run"]) == 2
    assert main(["render", "plane", "--out", "nowhere/x.exr", "--dry-run"]) == 2
    assert files(folder) == []


def test_a_dry_data_set_counts_what_is_missing(capfd, folder):
    asked = ("dataset", "clutter", "--count", "3", "--width", "8", "--bounces", "1", "--out", "set")
    said = answer(capfd, *asked, "--dry-run")
    assert files(folder) == [] and said["missing"] == 3 and "trial of views 0, 1, 2" in said["basis"]
    answer(capfd, "dataset", "clutter", "--count", "2", *asked[4:])
    before = files(folder)
    said = answer(capfd, *asked, "--dry-run")
    assert files(folder) == before and (said["finished"], said["missing"]) == (2, 1)
    assert "recorded seconds of 2 views" in said["basis"] and said["estimate"]["seconds"] > 0
    other = [word if word != "8" else "12" for word in asked]
    assert main([*other, "--dry-run"]) == 2
    assert "other options" in capfd.readouterr().err


def test_a_dry_training_tells_its_steps(capfd, folder):
    said = answer(capfd, "train", "--preset", "smoke", "--dry-run")
    assert files(folder) == [] and said["steps_left"] == said["plan"]["steps"] == 8
    assert said["parameters"] > 1000 and said["estimate"]["seconds"] > 0 and "random counts" in said["basis"]
    run = folder / "run"
    run.mkdir()
    config = config_of(Train(preset="smoke"))
    (run / "config.json").write_text(json.dumps(replace(config, data={"training_sha256": "any"}).to_dict()))
    (run / "timings.jsonl").write_text('{"epoch": 1, "wall_s": 4.0, "cpu_s": 3.0}\n')
    said = answer(capfd, "train", "--preset", "smoke", "--dry-run", "--out", "run")
    assert said["steps_left"] == 4 and said["estimate"]["seconds"] == pytest.approx(4.0)
    assert main(["train", "--set", "nowhere", "--dry-run"]) == 2


def test_a_dry_training_refuses_the_folders_that_the_training_does(capfd, folder):
    """It told of the epochs that another run had recorded there."""
    (folder / "run").mkdir()
    (folder / "run/config.json").write_text(json.dumps(config_of(Train(preset="smoke", seed=1)).to_dict()))
    (folder / "mine").mkdir()
    (folder / "mine/notes.txt").write_text("mine")
    refused = {
        "run": "holds a run with other options or another set",
        "mine": "is not an empty folder and holds no run",
    }
    for out, line in refused.items():
        for dry in ([], ["--dry-run"]):
            assert main(["train", "--preset", "smoke", "--out", out, *dry]) == 2
            assert f"{out}: {line}" in capfd.readouterr().err


@pytest.mark.parametrize("words", [["--dry-run"], []])
def test_views_that_hold_no_patch_are_named_by_dry_trainings_as_by_others(capfd, folder, words):
    """A dry run promised seconds for such a training, which then did not say which set it was."""
    write_pack([(view, {"scene": f"wall {i}"}) for i, view in enumerate(random_planes(2, size=4).transients)], "few.h5")
    small = "few.h5: crops of 8 pixels do not fit views of 4; give a smaller --crop"
    for more, refusal in ((["few.h5", "planes"], small), (["planes", "--crop", "64"], "planes: crops of 64 pixels")):
        assert main(["train", "--preset", "smoke", "--set", *more, "--out", "mine", *words]) == 2
        assert f"train: --set {refusal}" in capfd.readouterr().err
    assert files(folder) == ["few.h5"]


def test_other_files_are_no_training_sets(capfd, folder):
    """They were called damaged packs."""
    Path("view.exr").write_bytes(EXR_SIGNATURE)
    assert main(["train", "--preset", "smoke", "--set", "view.exr", "--out", "mine"]) == 2
    expected = "view.exr: expected the folder of a set that `dataset` rendered, or its pack (.h5)"
    assert expected in capfd.readouterr().err


def test_a_dry_study_tells_models_and_recorded_runs(capfd, folder):
    said = answer(capfd, "study", "fourier", "--dry-run")
    assert files(folder) == [] and said["models"]["there"] and said["models"]["to_train"] == []
    assert said["estimate"]["seconds"] is None and "unknown" in said["basis"]
    answer(capfd, "study", "memory", "--out", "out")
    said = answer(capfd, "study", "memory", "--out", "out", "--dry-run")
    assert "median of 1 finished run" in said["basis"] and said["estimate"]["seconds"] > 0
    # a study without presets is the same run with every one of `study all`
    assert "preset" not in said and "preset" not in said["basis"]
    asked = ("study", "all", "--preset", "smoke", "--out", "out", "--dry-run")
    memory = next(one for one in answer(capfd, *asked)["studies"] if one["study"] == "memory")
    assert "preset" not in memory and memory["estimate"]["seconds"] == said["estimate"]["seconds"]
    said = answer(capfd, "study", "all", "--dry-run")
    assert [one["study"] for one in said["studies"]] == list(STUDIES)


def test_a_dry_study_counts_results_where_the_study_keeps_them(capfd, folder):
    for study, place in (("sim-to-real", "out/results"), ("fourier", "out/laptop/results")):
        (folder / place).mkdir(parents=True)
        append_line(folder / place / "a.jsonl", "[1, 2]")
        assert answer(capfd, "study", study, "--out", "out", "--dry-run")["kept"]["results"] == 1


def test_a_dry_study_lists_what_it_would_find_and_what_it_is_given(capfd, folder):
    """Also of studies that train nothing, of models put beside those asked for, and of networks that are given."""
    for name, one in (("transport", "gray-1024x1x1-128x-s0"), ("power", "fourier-1024x1x1-64x-s0"),
                      ("multipath", "none-mixed-s0"), ("fourier", "learned-256x4x4-128x-s1")):  # fmt: skip
        said = answer(capfd, "study", name, "--dry-run")["models"]
        assert one in said["there"] and said["to_train"] == []
    said = answer(capfd, "study", "transport", "--dry-run", "--retrain")["models"]
    assert said["there"] == [] and "gray-1024x1x1-128x-s0" in said["to_train"]
    for name in ("real-data", "render-error"):
        assert answer(capfd, "study", name, "--checkpoints", "none-s0", "--dry-run")["models"]["there"] == ["none-s0"]
        assert main(["study", name, "--checkpoints", "nowhere", "--dry-run"]) == 2
    assert files(folder) == []


def test_a_dry_study_counts_unfinished_trainings_as_to_be_trained(capfd, folder):
    """The weights of the first epoch are there long before the training's end."""
    one = ModelSpec("gray", (1024, 1, 1))
    ModelRegistry(folder / "models", None).train([one], "smoke", Path("planes"), lambda what, fraction: None)
    asked = ("study", "transport", "--dry-run", "--retrain", "--preset", "smoke", "--models", "models")
    assert answer(capfd, *asked)["models"]["there"] == [one.name]
    run = folder / "models" / one.name
    (run / "last.safetensors").unlink()
    (run / RESUME).touch()
    said = answer(capfd, *asked)["models"]
    assert said["there"] == [] and one.name in said["to_train"]


@pytest.fixture
def studies(monkeypatch, tmp_path):
    """Studies that only note that they were run; one lacks its data."""
    calls = []

    def run(command, progress):
        calls.append(command.name)
        if command.name == "sim-to-real":
            raise InputError("captures:\n not found")
        command.out.mkdir(exist_ok=True)
        paths = {"figures": command.out / f"{command.name}.png", "csv": command.out / f"{command.name}.csv"}
        if command.seed == 2:  # a run without a table
            del paths["csv"]
        for path in paths.values():
            path.write_text(f"seed {command.seed}")
        return {key: [str(path)] for key, path in paths.items()}

    monkeypatch.setattr(every, "module_of", lambda name: SimpleNamespace(run=run))
    return calls


def test_all_studies_go_on_past_one_without_data(capfd, folder, studies):
    said = answer(capfd, "study", "all", "--out", "out", "--preset", "smoke")
    assert studies == list(STUDIES) and said["left_out"] == ["sim-to-real"]
    rows = {row["study"]: row for row in said["studies"]}
    assert rows["sim-to-real"]["why"] == "captures: not found" and rows["codes"]["status"] == "done"
    studies.clear()
    assert main(["study", "all", "--out", "out", "--preset", "smoke"]) == 0
    out = capfd.readouterr().out
    assert studies == ["sim-to-real"] and out.count("done before") == len(STUDIES) - 1
    studies.clear()
    (folder / "out/codes.png").unlink()
    answer(capfd, "study", "all", "--out", "out", "--preset", "smoke")
    assert studies == [name for name in STUDIES if name in ("codes", "sim-to-real")]
    studies.clear()
    answer(capfd, "study", "all", "--out", "out", "--preset", "smoke", "--seed", "1")
    assert studies == list(STUDIES)


def test_a_study_is_done_only_while_its_files_are_as_it_wrote_them(capfd, folder, studies):
    """Another run into the same folder overwrote them, or a table was deleted or changed: no row says done before."""
    asked = ("study", "all", "--out", "out")
    answer(capfd, *asked)
    answer(capfd, "study", "transport", "--out", "out", "--seed", "1")
    (folder / "out/chip.csv").unlink()
    (folder / "out/tdc.csv").write_text("mine")
    studies.clear()
    answer(capfd, *asked)
    assert studies == [name for name in STUDIES if name in ("chip", "transport", "sim-to-real", "tdc")]
    assert (folder / "out/transport.csv").read_text() == "seed 0"
    studies.clear()
    answer(capfd, *asked, "--ship")
    assert {*OPTIONS_OF["ship"]} <= {*studies} and "chip" not in studies


def test_what_a_run_does_not_make_again_goes_and_what_was_changed_stays(capfd, folder, studies):
    for name in ("chip", "tdc", "tensors"):
        answer(capfd, "study", name, "--out", "out")
    (folder / "out/tdc.csv").write_text("mine")
    for name in ("chip", "tdc", "tensors"):
        answer(capfd, "study", name, "--out", "out", "--seed", "2")
    # sheets of `study tensors` are named by what is drawn: they stand beside each other
    assert {path.name for path in (folder / "out").glob("*.csv")} == {"tdc.csv", "tensors.csv"}
    (folder / "out/chip.run.json").write_text("{")
    assert main(["study", "all", "--out", "out", "--seed", "2"]) == 0
    assert "chip.run.json" in capfd.readouterr().err and "chip" in studies


def test_all_studies_are_interrupted_between_two(folder, studies, monkeypatch):
    def stopped(command, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(every, "run_one", stopped)
    with pytest.raises(KeyboardInterrupt):
        every.run_all(Study(name="all", out=folder / "out"), lambda what, fraction: None)
