"""Data sets of inputs that are not whole: scenes that come later, photographs and captures with gaps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene2spad.datasets.rendering import Job, make_set
from scene2spad.datasets.zone_captures import read_plane_captures
from scene2spad.dry_runs.sets import dry_run
from scene2spad.networks import published
from scenes import InputError


def photographed(folder: Path, *, photo: tuple[int, int] = (16, 12), least: str | None = "4\n") -> None:
    """Write a pair as those of Middlebury; `least` None: without dmin.txt."""
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((12, 16), 200, np.uint8)).save(folder / "disp1.png")
    Image.new("RGB", photo, (90, 90, 90)).save(folder / "view1.png")
    if least is not None:
        (folder / "dmin.txt").write_text(least)


def test_a_set_whose_scenes_changed_is_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It went on with the new numbers: one scene twice, another never."""
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path))
    photographed(tmp_path / "middlebury/Books")
    job, out = Job("middlebury", width=8, height=6, bounces=1, grid=1), tmp_path / "set"
    assert make_set(job, 1, out)["rendered_now"] == 1 and make_set(job, 1, out)["rendered_now"] == 0
    photographed(tmp_path / "middlebury/Art")
    with pytest.raises(InputError, match=r"view 0 is of middlebury/Books, the set has middlebury/Art there now"):
        make_set(job, 2, out)
    with pytest.raises(InputError, match=r"view 0 is of middlebury/Books, the set has middlebury/Art there now"):
        dry_run(job, 2, out, 1)


def test_a_set_whose_photographs_changed_is_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It went on, half of its views of one photograph and half of another. Records of before do not tell."""
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path))
    folder, out = tmp_path / "middlebury/Books", tmp_path / "set"
    photographed(folder)
    job = Job("middlebury", width=8, height=6, bounces=1, grid=1)
    make_set(job, 1, out)
    index = (out / "index.jsonl").read_text()
    photographed(folder, least="5\n")
    with pytest.raises(InputError, match=r"view 0 is of another dmin\.txt than middlebury/Books has now; choose"):
        make_set(job, 1, out)
    with pytest.raises(InputError, match=r"view 0 is of another dmin\.txt than middlebury/Books has now; choose"):
        dry_run(job, 1, out, 1)
    record = json.loads(index)
    del record["inputs_sha256"]
    (out / "index.jsonl").write_text(json.dumps(record) + "\n")
    assert make_set(job, 1, out)["rendered_now"] == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"least": None}, r"dmin\.txt: file not found"),
        ({"least": "four"}, r"dmin\.txt: holds no number"),
        ({"photo": (16, 8)}, r"view1\.png: 16 x 8 pixels, disp1\.png has 16 x 12"),
    ],
)
def test_pairs_that_are_not_whole_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict, words: str
) -> None:
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path))
    photographed(tmp_path / "middlebury/Art", **changes)
    with pytest.raises(InputError, match=words):
        published.pairs()


def test_a_capture_without_reference_light_has_no_drift(tmp_path: Path) -> None:
    """An empty channel has no drift. It counted as bin 0: 15 bins early, and all others 5 bins late."""
    reference = np.zeros((4, 128), np.int32)
    reference[:, 20] = 1000
    reference[2] = 0
    counts = np.ones((4, 9, 128), np.int32)
    distance = np.array([0.5, 0.6, 0.7, 0.8])
    np.savez(tmp_path / "a.npz", distance_m=distance, counts=counts, reference_counts=reference)
    assert read_plane_captures(tmp_path / "a.npz").drift_bins == pytest.approx(np.zeros(4))
