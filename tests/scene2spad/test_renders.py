"""`depth` and `evaluate` on transients: one file, a folder of them, and the folder of a set."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from render.transient import write_transient
from scene2spad.cli import main
from scene2spad.datasets.renders import transient_files, views_at
from scenes.errors import InputError
from spad.formats.depth_map import read_depth
from spad.formats.rgbd import transient_from_rgbd

MODEL = "learned-256x4x4-128x-s0"


def wall(distance_m: float):
    image = np.full((8, 8), 0.5)
    return transient_from_rgbd(np.full((8, 8), distance_m), image, image)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "renders").mkdir()
    for name, distance_m in (("a", 2.0), ("b", 3.0)):
        write_transient(wall(distance_m), tmp_path / f"renders/{name}.exr")
    shutil.copy("renders/a.exr", "a.exr")
    return tmp_path


def answer(capfd, *argv: str) -> dict:
    assert main([*argv, "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def refused(capfd, *argv: str) -> str:
    assert main([*argv]) == 2
    out, err = capfd.readouterr()
    assert out == "" and "Traceback" not in err
    return err.splitlines()[-1]


def test_depth_of_a_transient_is_that_of_sense_and_depth(capfd, folder):
    found = answer(capfd, "depth", "a.exr", "--signal", "100", "--background", "5", "--no-figure", "--seed", "3")
    assert found["sensed"] == "by reference with 100 signal and 5 background photons a pixel, seed 3"
    assert found["out"] == "a-sensed-log-matched.exr" and found["mae_mm"] < 20
    answer(capfd, "sense", "a.exr", "--signal", "100", "--background", "5", "--no-figure", "--seed", "3")
    other = answer(capfd, "depth", "a.h5", "--no-figure")
    assert other["out"] == "a-log-matched.exr", "both maps are kept, under names of their own"
    assert other["mae_mm"] == found["mae_mm"] and "sensed" not in other
    np.testing.assert_array_equal(read_depth(folder / "a-log-matched.exr")[0], read_depth(folder / found["out"])[0])


def test_the_defaults_are_stated(capfd, folder):
    found = answer(capfd, "depth", "a.exr", "--method", "network", "--model", MODEL, "--no-figure")
    assert "50 signal and 50 background photons a pixel, the defaults" in found["sensed"]
    assert found["out"] == f"a-sensed-network-{MODEL}.exr"


def test_depth_of_a_folder_makes_a_map_for_each(capfd, folder):
    found = answer(capfd, "depth", "renders", "--no-figure", "--method", "argmax")
    assert found["views"] == 2 and found["out"].endswith("renders-argmax")
    maps = sorted((folder / "renders-argmax").iterdir())
    assert [path.name for path in maps] == ["a-argmax.exr", "b-argmax.exr"]
    assert found["mae_mm"] == pytest.approx(np.mean([view["mae_mm"] for view in found["by_view"]]))
    shutil.copy(maps[0], "renders/map.exr")  # is passed over
    assert [path.name for path in transient_files(folder / "renders")] == ["a.exr", "b.exr"]
    line = refused(capfd, "depth", "renders-argmax")
    assert "no transient (.exr) in this folder" in line


def test_options_of_sensing_do_not_go_with_a_histogram(capfd, folder):
    answer(capfd, "sense", "a.exr", "--no-figure")
    assert "--signal goes with a transient (.exr)" in refused(capfd, "depth", "a.h5", "--signal", "3")
    assert "is no depth" in refused(capfd, "depth", "a.exr", "--out", "a.exr")
    assert "frame" in refused(capfd, "depth", "a.exr", "--frame", "1")
    assert not [*folder.glob("a-*log-matched.exr")]


def test_evaluate_takes_transients(capfd, folder):
    asked = ("evaluate", MODEL, "--levels", "10+10", "--baselines", "argmax", "--set")
    one = answer(capfd, *asked, "a.exr")
    both = answer(capfd, *asked, "renders", "--out", "both")
    assert one["mae_mm"] > 0 and both["mae_mm"] > 0
    assert len(views_at(folder / "renders").transients) == 2
    with pytest.raises(InputError, match="no transient"):
        views_at(folder / "both")


def test_evaluate_takes_views_of_several_sizes(capfd, folder):
    """As Middlebury's are. Nobody trains on them, and the error was that they cannot be packed."""
    image = np.full((9, 12), 0.5)
    write_transient(transient_from_rgbd(np.full((9, 12), 3.0), image, image), folder / "renders/c.exr")
    found = answer(capfd, "evaluate", MODEL, "--levels", "10+10", "--baselines", "argmax", "--set", "renders")
    assert found["mae_mm"] > 0


def test_a_folder_of_views_has_the_scenes_of_its_sets(capfd, folder):
    """Views of one room were several scenes in a folder, and one in the set; rooms of two seeds with one number were
    one."""
    shown = {}
    for seed in (0, 7):
        for number in (0, 1, 6):
            meta = {"scene": f"rooms/val/{number}", "notes": [f"procedural, val view {number} of seed {seed}: camera"]}
            shown[f"{seed}-{number}"] = replace(wall(2.0 + 0.1 * len(shown)), meta=meta)
    (folder / "views").mkdir()
    for name, view in shown.items():
        write_transient(view, folder / f"views/{name}.exr")
    room = "rooms/val/room"
    expected = [f"{room} {number} of seed {seed}" for seed in (0, 7) for number in (0, 0, 1)]
    assert [*views_at(folder / "views").scenes] == expected
    asked = ("evaluate", MODEL, "--levels", "10+10", "--baselines", "argmax", "--set")
    found = answer(capfd, *asked, "views")
    assert found["scenes"] == 4 and found["unsure_scenes"] == 0
    # as in the set and in its pack, whose index names the places
    for path in (folder / "views").glob("7-*"):
        path.unlink()
    assert [*views_at(folder / "views").scenes] == [f"{room} 0", f"{room} 0", f"{room} 1"]


def test_scenes_known_by_name_alone_are_told(capfd, folder):
    """Two views of an RGB-D camera: their file does not say of what. Nor of which seed a numbered view is."""
    asked = ["evaluate", MODEL, "--levels", "10+10", "--baselines", "argmax", "--set", "renders"]
    assert main(asked) == 0
    said = capfd.readouterr().err
    assert (
        "renders: scenes of 2 of 2 views are known by name alone: intervals count each name as one scene, 1 in" in said
    )
    write_transient(replace(wall(2.5), meta={"scene": "rooms/val/3"}), folder / "renders/c.exr")
    write_transient(replace(wall(2.6), meta={"scene": "tabletop/bowl"}), folder / "renders/d.exr")
    assert answer(capfd, *asked)["unsure_scenes"] == 3


def test_a_set_is_read_in_the_order_of_its_index(capfd, folder):
    answer(capfd, "dataset", "clutter", "--count", "2", "--width", "8", "--bounces", "1", "--out", "set")
    assert [path.name for path in transient_files(folder / "set")] == ["000000.exr", "000001.exr"]
    assert [*views_at(folder / "set/views").scenes] == [*views_at(folder / "set").scenes]
    assert [*views_at(folder / "set").scenes] == ["clutter/train/0", "clutter/train/1"]
    found = answer(capfd, "depth", "set", "--no-figure", "--out", "maps")
    assert found["views"] == 2 and (folder / "maps/000001-log-matched.exr").is_file()
