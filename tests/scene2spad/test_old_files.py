"""Files written before the packages were rearranged (commit 2982616) still open, and say the same.

`old_files` holds what that tree wrote: a transient of `gallery` at 4x4 pixels with two bounces, its histogram
(`sense --seed 2`), a depth map of that by the log-matched filter, a set of two rooms as a folder and as a pack, and the
configuration of a training. The models that ship are older than the rearrangement, too; other tests load them.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import scene2spad as s2s
from csph.networks.config import TrainConfig
from csph.training.views import read_views
from render.transient.packs import read_pack
from scene2spad.cli import main
from spad.formats.depth_map import read_depth
from spad.measurements.histogram import TRUTH, read_histogram

OLD = Path(__file__).parent / "old_files"


def test_an_old_transient_is_sensed_into_its_old_histogram():
    transient = s2s.read_transient(OLD / "gallery.exr")
    assert (transient.height, transient.width, transient.meta["plan"]["bounces"]) == (4, 4, 2)
    old, again = read_histogram(OLD / "gallery.h5"), s2s.sense(transient, signal=50, background=50, seed=2)
    np.testing.assert_array_equal(again.counts, old.counts)
    for name in TRUTH:
        np.testing.assert_array_equal(getattr(again, name), getattr(old, name))
    assert old.sensor == again.sensor


def test_an_old_histogram_gives_its_old_depth():
    old, confidence, meta = read_depth(OLD / "gallery-log-matched.exr")
    assert confidence is None and meta["method"] == "log-matched"
    found = s2s.estimate_depth(read_histogram(OLD / "gallery.h5"), "log-matched")
    np.testing.assert_array_equal(found, old)


def test_an_old_set_is_the_same_as_folder_and_as_pack():
    folder, pack = read_views(OLD / "set"), read_views(OLD / "set.h5")
    assert folder.scenes == pack.scenes and len(folder.scenes) == 2
    for one, other in zip(folder.transients, pack.transients, strict=True):
        assert one.height == one.width == other.height
        np.testing.assert_array_equal(one.offsets, other.offsets)
        steps = {"path_near_m": 2e-3, "path_far_m": 2e-3, "depth_m": 2e-4}  # of packs, and a quarter of it in the EXR
        for name, step in steps.items():
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=step)
        np.testing.assert_allclose(one.radiance, other.radiance, rtol=0.01)
        np.testing.assert_allclose(one.ambient, other.ambient, rtol=0.1)  # four steps an octave
    assert [meta["scene"] for meta in read_pack(OLD / "set.h5").metas] == ["rooms/train/0", "rooms/train/1"]


def test_an_old_configuration_of_a_training_means_what_it_meant():
    config = TrainConfig.from_dict(json.loads((OLD / "run" / "config.json").read_text()))
    assert config.model.name == "learned 256x4x4 K32, compact" and config.preset == "smoke"
    assert config.model.grid == "continuous" and config.model.spatial_start == "uniform"


def test_an_old_set_is_not_continued_by_a_newer_plan(tmp_path, capsys):
    """Views of two versions in one set would have two error targets: the command says so instead."""
    folder = shutil.copytree(OLD / "set", tmp_path / "set")
    made = json.loads((folder / "set.json").read_text())
    size = ["--width", str(made["width"]), "--height", str(made["height"])]
    with pytest.raises(SystemExit) as stopped:
        raise SystemExit(main(["dataset", "rooms", "--count", "3", "--bounces", "1", *size, "--out", str(folder)]))
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(folder) in line and "another" in line
    assert (folder / "views" / "000000.exr").is_file()


@pytest.mark.parametrize("name", ["gallery.exr", "gallery.h5", "set.h5"])
def test_old_files_are_inspected(name, capsys):
    assert main(["inspect", str(OLD / name)]) == 0
    assert capsys.readouterr().out.strip()
