"""Depth maps that `evaluate --maps` keeps."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import wall
from scene2spad.networks.depth_maps import map_writer
from scenes.errors import InputError
from spad.formats.depth_map import read_depth


def test_every_map_has_the_errors_of_its_row(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_pack([(wall(distance, 4), {"scene": f"walls/{distance:g}"}) for distance in (2.0, 3.0)], Path("walls.h5"))
    command = ["evaluate", "none-s0", "--set", "walls.h5", "--levels", "50+1", "2+0.5", "--baselines", "argmax"]
    assert main([*command, "--out", "out", "--json", "--maps"]) == 0
    told = capfd.readouterr()
    assert json.loads(told.out)["maps"] == "out/maps" and "earlier evaluation" not in told.err
    with Path("out/evaluation.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["group"] == "all"]
    assert len(rows) == len([*Path("out/maps").rglob("*.exr")]) == 8
    for row in rows:
        level = f"{float(row['signal']):g}+{float(row['background']):g}"
        scene, distance = row["scene"].replace("/", "-"), float(row["scene"].removeprefix("walls/"))
        depth, confidence, meta = read_depth(Path(f"out/maps/{row['method']}/{row['view']}-{scene}-{level}.exr"))
        truth = wall(distance, 4).depth_m
        assert meta["method"] == row["method"] and depth.shape == (4, 4) and confidence is None
        assert 1e3 * np.nanmean(np.abs(depth - truth)) == pytest.approx(float(row["mae_mm"]), rel=1e-3)


def test_maps_of_an_earlier_evaluation_are_told(capfd, tmp_path, monkeypatch):
    """They stay beside a table without maps of its own; an empty folder is nothing to tell."""
    monkeypatch.chdir(tmp_path)
    write_pack([(wall(2.0, 4), {"scene": "wall"})], Path("wall.h5"))
    command = ["evaluate", "none-s0", "--set", "wall.h5", "--levels", "50+1", "--out", "out"]
    Path("out/maps").mkdir(parents=True)
    assert main(command) == 0 and "earlier evaluation" not in capfd.readouterr().err
    Path("out/maps/old.exr").write_bytes(b"map")
    assert main(command) == 0 and "warning: out/maps holds depth maps of an earlier" in capfd.readouterr().err
    assert Path("out/maps/old.exr").read_bytes() == b"map"


def test_maps_of_two_evaluations_do_not_mix(capfd, tmp_path):
    """Told before models and set are read: the set is none here. So are wrong levels."""
    (tmp_path / "maps").mkdir()
    command = ["evaluate", "none-s0", "--set", str(tmp_path / "none.h5"), "--out", str(tmp_path)]
    assert main([*command, "--maps"]) == 2 and "none.h5: file not found" in capfd.readouterr().err
    (tmp_path / "maps" / "argmax").mkdir()
    for more, words in (
        (["--maps"], f"{tmp_path / 'maps'}: is not empty, and would mix maps of two evaluations"),
        (["--levels", "nan+1"], "levels 'nan+1': expected"),
        (["--levels", "1+1", "1+1"], "levels '1+1': given twice"),
    ):
        assert main([*command, *more]) == 2
        message = capfd.readouterr().err
        assert words in message and message.count("\n") == 1


def test_two_methods_do_not_share_a_folder(tmp_path):
    with pytest.raises(InputError, match="maps of runs-a and runs/a would have one folder, runs-a"):
        map_writer(tmp_path, ["runs/a", "argmax", "runs-a"])
