"""`show` of a set's folder counts every view once, whatever a kill left of its journal."""

import json
from pathlib import Path

import pytest
from set_folders import begun, finished

from render.transient import write_transient
from scene2spad.cli import main
from scene2spad.datasets.planes import wall
from scene2spad.datasets.set_folder import Done, file_name

MADE = {"set": "planes", "seed": 0}


@pytest.fixture
def rendered(tmp_path) -> Path:
    """A set of views 0 to 2, the last of which failed."""
    path = tmp_path / "set"
    folder = begun(path, MADE)
    for view in range(2):
        folder.add(finished(view))
        write_transient(wall(1.0 + view, 8), path / file_name(view))
    folder.add(Done({"view": 2, "failed": "no light"}, None, 0.1, "here/1"))
    folder.close()
    return path


def page_of(folder: Path) -> str:
    out = folder.parent / "page.html"
    assert main(["show", str(folder), "--out", str(out)]) == 0
    return out.read_text(encoding="utf-8")


def test_failed_views_are_counted_apart(rendered):
    page = page_of(rendered)
    assert "<dt>views</dt><dd>2</dd><dt>failed</dt><dd>1</dd>" in page and page.count("no light") == 1


def test_a_view_in_index_and_journal_is_one(rendered):
    """A process that was killed after it had written the index, before its journal was gone."""
    index, journal = rendered / "index.jsonl", rendered / "journal.jsonl"
    journal.write_text(index.read_text())
    page = page_of(rendered)
    assert "<dt>views</dt><dd>2</dd>" in page and page.count(file_name(1)) == 1


def test_a_view_that_was_tried_again_has_failed_no_more(rendered):
    write_transient(wall(3.0, 8), rendered / file_name(2))
    (rendered / "journal.jsonl").write_text(json.dumps(finished(2).record) + "\n")
    page = page_of(rendered)
    assert "<dt>views</dt><dd>3</dd></dl>" in page and "no light" not in page
