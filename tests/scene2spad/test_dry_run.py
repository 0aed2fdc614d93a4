"""`--dry-run` tells plan, memory and work, and writes nothing; `study all` goes on past what cannot be run."""

import json
from pathlib import Path

import pytest

from scene2spad.cli import main
from scene2spad.options.experiments import STUDIES, Study
from scene2spad.studies import every
from scenes.errors import InputError


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
    assert said["memory"]["work_bytes_at_least"] == 650 * 96 * 64 < said["memory"]["limit_bytes"]
    # the plane's rays are as many in every pixel, so that the trial tells the render's
    made = answer(capfd, "render", "plane", "--width", "96", "--height", "64", "--bounces", "1", "--no-figure")
    assert said["plan"]["grid"] == made["plan"]["grid"]
    assert said["estimate"]["rays"] == pytest.approx(made["rays"], rel=0.3)
    assert said["estimate"]["file_bytes"] == pytest.approx((folder / "plane.exr").stat().st_size, rel=0.5)


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
    (run / "config.json").write_text("{}")
    (run / "timings.jsonl").write_text('{"epoch": 1, "wall_s": 4.0, "cpu_s": 3.0}\n')
    said = answer(capfd, "train", "--preset", "smoke", "--dry-run", "--out", "run")
    assert said["steps_left"] == 4 and said["estimate"]["seconds"] == pytest.approx(4.0)
    assert main(["train", "--set", "nowhere", "--dry-run"]) == 2


def test_a_dry_study_tells_models_and_recorded_runs(capfd, folder):
    said = answer(capfd, "study", "fourier", "--dry-run")
    assert files(folder) == [] and said["models"]["there"] and said["models"]["to_train"] == []
    assert said["estimate"]["seconds"] is None and "unknown" in said["basis"]
    answer(capfd, "study", "memory", "--out", "out")
    said = answer(capfd, "study", "memory", "--out", "out", "--dry-run")
    assert "median of 1 finished run" in said["basis"] and said["estimate"]["seconds"] > 0
    said = answer(capfd, "study", "all", "--dry-run")
    assert [one["study"] for one in said["studies"]] == list(STUDIES)


@pytest.fixture
def studies(monkeypatch, tmp_path):
    """Studies that only note that they were run; one lacks its data."""
    calls = []

    def run_one(command, progress):
        calls.append(command.name)
        if command.name == "sim-to-real":
            raise InputError("captures:\n not found")
        command.out.mkdir(exist_ok=True)
        figure = command.out / f"{command.name}.png"
        figure.write_bytes(b"x")
        return {"figures": [str(figure)]}

    monkeypatch.setattr(every, "run_one", run_one)
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


def test_all_studies_are_interrupted_between_two(folder, studies, monkeypatch):
    def stopped(command, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr(every, "run_one", stopped)
    with pytest.raises(KeyboardInterrupt):
        every.run_all(Study(name="all", out=folder / "out"), lambda what, fraction: None)
