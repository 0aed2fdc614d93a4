"""Sets whose making was stopped, or never got under way: what is left, and what is said of it."""

import gc
import json
import math
import os

import pytest
from processes import ended_process
from set_folders import begun, finished

from scene2spad.datasets.rendering import Job, make_set
from scenes import InputError
from scenes.io.set_index import read_set_index

MADE = {"set": "any"}
JOB = Job("hard-cases", width=12, height=9, bounces=1, grid=2)


def test_a_scheduler_that_is_not_there_is_one_line_and_leaves_no_folder(tmp_path):
    """Leave no folder, which would refuse a command that was corrected in more than its address."""
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="cannot be reached"):
        make_set(JOB, 1, tmp_path / "set", scheduler="nonsense")
    assert not (tmp_path / "set").exists()


def test_a_machine_too_busy_for_dask_is_told_so_in_one_line(tmp_path, monkeypatch):
    """Dask asserts that its thread has started in 10 s."""
    distributed = pytest.importorskip("distributed")

    def too_busy(*_, **__):
        raise AssertionError

    monkeypatch.setattr(distributed, "Client", too_busy)
    with pytest.raises(InputError, match=r"scheduler tcp://x:1: cannot be reached \(Dask's event loop did not start"):
        make_set(JOB, 1, tmp_path / "set", scheduler="tcp://x:1")


def test_no_garbage_is_collected_while_a_client_of_dask_starts(tmp_path, monkeypatch):
    """An earlier client that is collected then waits for the lock of the one that starts: the suite stood still."""
    distributed = pytest.importorskip("distributed")
    collects = []

    def starting(*_, **__):
        collects.append(gc.isenabled())
        raise OSError

    monkeypatch.setattr(distributed, "Client", starting)
    with pytest.raises(InputError, match="cannot be reached"):
        make_set(JOB, 1, tmp_path / "set", scheduler="tcp://x:1")
    assert collects == [False] and gc.isenabled()


def test_a_finished_set_does_not_hide_a_scheduler_that_is_not_there(tmp_path):
    pytest.importorskip("distributed")
    make_set(JOB, 1, tmp_path / "set")
    with pytest.raises(InputError, match="cannot be reached"):
        make_set(JOB, 1, tmp_path / "set", scheduler="nonsense")


def test_a_second_run_leaves_what_a_living_one_is_writing(tmp_path):
    """Files of processes that are gone are removed, again in a process that has written to the folder before."""
    begun(tmp_path, MADE).add(finished(0))
    machine = os.uname().nodename[:40]
    for folder in (tmp_path, tmp_path / "views"):
        living = folder / f".000001.{machine}.{os.getppid()}.part.exr"
        ended = folder / f".000002.{machine}.{ended_process()}.part.exr"
        for path in (living, ended):
            path.write_bytes(b"half")
        begun(tmp_path, MADE)
        assert living.exists() and not ended.exists()


def test_a_continuation_that_was_interrupted_is_not_read_as_the_set_before(tmp_path):
    folder = begun(tmp_path, MADE)
    for view in range(2):
        folder.add(finished(view))
    folder.close()
    assert len(read_set_index(tmp_path)) == 2
    folder = begun(tmp_path, MADE)
    for view in range(2, 5):
        folder.add(finished(view))
    with pytest.raises(InputError, match=r"was left unfinished, 3 views more .*; run scene2spad dataset again$"):
        read_set_index(tmp_path)
    begun(tmp_path, MADE).close()
    assert len(read_set_index(tmp_path)) == 5


def test_views_that_failed_again_leave_a_set_as_it_was(tmp_path):
    folder = begun(tmp_path, MADE)
    folder.add(finished(0))
    folder.close()
    with (tmp_path / "journal.jsonl").open("w") as file:  # and the index was written, its journal not yet removed
        file.writelines(json.dumps(line) + "\n" for line in ({"view": 1, "failed": "odd"}, finished(0).record))
    assert len(read_set_index(tmp_path)) == 1


def test_an_index_is_json_for_strict_readers(tmp_path):
    """A view of mirrors alone has no depth: its statistics were NaN, which JSON does not know."""

    def refused(constant: str) -> float:
        raise AssertionError(f"{constant} is no JSON")

    folder = begun(tmp_path, MADE)
    folder.add(finished(0, depth_m={"min": math.nan}))
    journal = (tmp_path / "journal.jsonl").read_text()
    folder.close()
    for text in (journal, (tmp_path / "index.jsonl").read_text()):
        assert json.loads(text, parse_constant=refused)["depth_m"] == {"min": None}
    again = begun(tmp_path, MADE)
    again.close()
    assert (tmp_path / "index.jsonl").read_text() == journal and [*again.records] == [0]
    (tmp_path / "index.jsonl").write_text(journal.replace("null", "NaN"))  # as it was written before
    assert read_set_index(tmp_path)[0]["view"] == 0 and [*begun(tmp_path, MADE).records] == [0]
