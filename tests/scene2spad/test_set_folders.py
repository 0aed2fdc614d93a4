"""Folders of sets: rays planned for the scenes that are rendered, damaged views and records, packs of one size."""

import json
import shutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
from set_folders import begun, finished

from render.transient import read_transient
from scene2spad.cli import main
from scene2spad.datasets.packing import pack_set
from scene2spad.datasets.rendering import PLANNED_PLACES, Job, make_set
from scene2spad.datasets.set_folder import SetFolder
from scenes import InputError
from scenes.library.sets import scene_set

JOB = Job("hard-cases", width=12, height=9, bounces=1, grid=2)


@pytest.fixture
def small(tmp_path) -> Path:
    """A set of three views."""
    make_set(JOB, 3, tmp_path / "set")
    return tmp_path / "set"


@pytest.mark.slow
def test_a_place_that_was_planned_without_ambient_light_is_rendered_without(tmp_path):
    """Planning had left the last place's world behind with its lamps, and the first view after it was lit by them."""
    job, out = Job("rooms", width=8, bounces=1, error=0.3, ambient=False), tmp_path / "set"
    last = (PLANNED_PLACES - 1) * scene_set("rooms").views_per_place
    make_set(job, last + 1, out)
    view = out / f"views/{last:06d}.exr"
    before = view.read_bytes()
    view.unlink()
    (out / "grid.json").unlink()
    make_set(job, last + 1, out)
    assert view.read_bytes() == before and not read_transient(view).ambient.any()


def test_rays_are_planned_for_the_moved_scenes(tmp_path):
    """A rigid move shows the camera another image, which takes another number of rays."""
    errors = {}
    for offset_m in (0.0, 3.0):
        make_set(
            Job("clutter", width=8, bounces=1, error=0.3, offset_m=offset_m, offset_mode="rigid"),
            1,
            tmp_path / f"{offset_m}",
        )
        errors[offset_m] = json.loads((tmp_path / f"{offset_m}/grid.json").read_text())["errors"]
    assert errors[0.0] != errors[3.0]


def test_a_mode_of_moving_by_nothing_makes_no_other_set():
    """A folder begun with `--offset-mode ray` and no offset was another's without it."""
    assert Job("rooms", offset_mode="ray").made() == Job("rooms").made()
    assert Job("rooms", offset_m=1.0, offset_mode="ray").made() != Job("rooms", offset_m=1.0).made()


@pytest.mark.parametrize("damage", [{"grid": True}, {"edge_threshold": True}, {"grid": "2"}, {"grid": 2.5}])
def test_a_plan_of_rays_that_holds_no_numbers_is_damaged(tmp_path, damage):
    job, out = Job("clutter", width=8, bounces=1, error=0.3), tmp_path / "set"
    begun(out, job.made())
    (out / "grid.json").write_text(json.dumps({"grid": 2, "edge_threshold": 0.5, "errors": []} | damage))
    with pytest.raises(InputError, match=r"grid\.json: is damaged; delete it"):
        make_set(job, 1, out)


def test_views_of_several_sizes_are_not_packed(tmp_path, capsys):
    """It is said before any is rendered."""
    argv = ["dataset", "hard-cases", "--width", "12", "--bounces", "1", "--out", str(tmp_path / "set")]
    assert main([*argv, "--pack", str(tmp_path / "set.h5")]) == 2
    message = capsys.readouterr().err
    assert "set.h5: views of hard-cases are of several sizes (12 x " in message and message.count("\n") == 1
    assert not (tmp_path / "set").exists()


def test_a_pack_may_lie_in_a_folder_that_the_set_makes(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argv = ["dataset", "rooms", "--count", "1", "--width", "8", "--bounces", "1", "--error", "0.3", "--no-ambient"]
    assert main([*argv, "--out", "out/set", "--pack", "elsewhere/set.h5"]) == 2
    assert "elsewhere/set.h5: folder elsewhere does not exist" in capsys.readouterr().err
    assert main([*argv, "--out", "out/set", "--pack", "out/set.h5"]) == 0
    assert (tmp_path / "out/set.h5").is_file()
    assert main([*argv, "--out", "other/set", "--pack", "other/set/pack.h5", "--dry-run"]) == 0


def test_a_damaged_view_is_named_with_what_mends_it(small, tmp_path):
    view = small / "views/000001.exr"
    view.write_bytes(view.read_bytes()[:-40] + bytes(40))
    with pytest.raises(InputError, match=r"000001\.exr: .*; delete it, and `dataset` renders it again$"):
        pack_set(small, tmp_path / "set.h5")
    assert not (tmp_path / "set.h5").exists()


@pytest.mark.parametrize("change", [lambda r: r.pop("target_met"), lambda r: r.update(error=float("nan"))])
def test_a_record_without_its_numbers_is_rendered_again(small, change):
    index = small / "index.jsonl"
    records = [json.loads(line) for line in index.read_text().splitlines()]
    change(records[0])
    index.write_text("".join(json.dumps(record) + "\n" for record in records))
    assert set(SetFolder(small, JOB.made()).records) == {1, 2}
    assert make_set(JOB, 3, small)["rendered_now"] == 1


def test_a_set_of_which_no_view_can_be_rendered_is_an_error(tmp_path, monkeypatch, shared_data, capsys):
    folder = tmp_path / "data/middlebury/Art"
    shutil.copytree(shared_data / "middlebury/Art", folder)
    (folder / "view1.png").write_bytes((folder / "view1.png").read_bytes()[:100])
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path / "data"))
    argv = ["dataset", "middlebury", "--width", "8", "--bounces", "1", "--error", "0.3", "--out", str(tmp_path / "set")]
    assert main(argv) == 2
    assert "set: none of 1 views could be rendered; view 0: " in capsys.readouterr().err


def added(path: Path, view: int) -> str:
    """Add a view to a set in this process; returns what was refused."""
    folder = SetFolder(path, {"set": "any"})
    try:
        with folder.held():
            folder.add(finished(view))
            folder.close()
    except InputError as error:
        return str(error)
    return ""


def test_two_processes_do_not_lose_views_of_each_other(tmp_path):
    """The later end wrote its own records alone over the index."""
    folder, late = SetFolder(tmp_path / "set", {"set": "any"}), SetFolder(tmp_path / "set", {"set": "any"})
    with ProcessPoolExecutor(1, get_context("spawn")) as other:
        with folder.held():
            folder.add(finished(0))
            refused = other.submit(added, folder.path, 1).result()
            assert "set: another process adds views to this set" in refused and "\n" not in refused
        assert other.submit(added, folder.path, 1).result() == ""
    with late.held():
        late.add(finished(2))
        late.close()
    assert sorted(SetFolder(folder.path, {"set": "any"}).records) == [0, 1, 2]


def test_a_finished_set_is_read_while_another_process_holds_it(small):
    with SetFolder(small, JOB.made()).held():
        assert make_set(JOB, 3, small)["rendered_now"] == 0
        with pytest.raises(InputError, match="another process adds views"):
            make_set(JOB, 4, small)
