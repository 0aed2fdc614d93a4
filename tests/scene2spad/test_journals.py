"""What a kill or a full disk leaves: cut lines, temporary files, folders that were just begun. Runs go on from all."""

from __future__ import annotations

import json
import os
import resource
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import ended_process
from set_folders import begun, finished

from csph.codes.design import Design
from csph.networks.config import ModelConfig, TrainConfig
from csph.training.resume import claim_run
from csph.weights.shipped import cpu_minutes
from render.transient.packs import read_pack, write_pack
from scene2spad.datasets.planes import random_planes
from scene2spad.networks.results import Store
from scenes import InputError
from scenes.files import append_line, is_unclaimed, whole_file
from scenes.io.inputs import read_whole_lines

MADE = {"set": "any"}


@contextmanager
def largest_file(size: int):
    """Writing beyond `size` bytes of any file fails meanwhile, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_journal_cut_at_any_byte_of_its_last_line_loses_that_entry_alone(tmp_path):
    path = tmp_path / "journal.jsonl"
    entries = [{"view": 0}, {"view": 1, "text": "ä"}, {"view": 2, "error": 0.5}]
    lines = [json.dumps(entry, ensure_ascii=False).encode() + b"\n" for entry in entries]
    for kept in range(len(lines[-1]) + 1):
        path.write_bytes(b"".join(lines[:-1]) + lines[-1][:kept])
        append_line(path, json.dumps({"view": 3}))
        whole = kept >= len(lines[-1]) - 1  # the end of the line may be missing
        assert [*read_whole_lines(path)] == [*entries[: 3 if whole else 2], {"view": 3}]


def test_a_set_goes_on_from_a_journal_cut_at_any_byte(tmp_path):
    done = [finished(view) for view in range(3)]
    whole = begun(tmp_path / "whole", MADE)
    for one in done:
        whole.add(one)
    journal = (tmp_path / "whole/journal.jsonl").read_bytes()
    whole.close()
    start = journal[:-1].rindex(b"\n") + 1
    for kept in range(len(journal) - start):
        path = tmp_path / f"cut {kept}"
        for one in done:
            begun(path, MADE).add(one)
        for name in ("journal.jsonl", "timings.jsonl"):
            data = (path / name).read_bytes()
            (path / name).write_bytes(data[: start + kept] if name == "journal.jsonl" else data[: -(kept % 20) or None])
        folder = begun(path, MADE)
        assert {0, 1} <= set(folder.records)
        if 2 not in folder.records:
            folder.add(done[2])
        folder.close()
        assert (path / "index.jsonl").read_bytes() == (tmp_path / "whole/index.jsonl").read_bytes()
        assert not (path / "journal.jsonl").exists()


def test_results_of_a_study_cut_at_any_byte_lose_one_entry(tmp_path):
    digest = "0" * 40
    store = Store(tmp_path)
    for number in range(3):
        store.put(digest, {"mae": number}, number=number)
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    start = data[:-1].rindex(b"\n") + 1
    for kept in range(len(data) - start):
        path.write_bytes(data[: start + kept])
        store = Store(tmp_path)
        assert [store.get(digest, number=number) for number in range(2)] == [{"mae": 0}, {"mae": 1}]
        store.put(digest, {"mae": 2}, number=2)
        assert [Store(tmp_path).get(digest, number=n) for n in range(3)] == [{"mae": n} for n in range(3)]


def test_cpu_minutes_of_a_run_that_was_killed_count_an_epoch_once(tmp_path):
    path = tmp_path / "timings.jsonl"
    for epoch, cpu in ((1, 60.0), (2, 30.0), (2, 120.0)):
        append_line(path, json.dumps({"epoch": epoch, "wall_s": 1.0, "cpu_s": cpu}))
    path.write_bytes(path.read_bytes() + b'{"epoch": 3, "cp')
    assert cpu_minutes(tmp_path) == 3.0


def test_temporary_files_of_ended_processes_are_removed_and_those_of_others_stay(tmp_path):
    """Of living processes, of other machines, and files that only look alike."""
    machine = os.uname().nodename[:40]
    gone = [f".a.{machine}.{ended_process()}.part.txt", f".other.{machine}.{ended_process()}.part.h5"]
    stay = [f".a.{machine}.{os.getppid()}.part.txt", f".a.elsewhere-{machine}x.1.part.txt", ".part.txt", "a.part"]
    for name in (*gone, *stay):
        (tmp_path / name).write_text("half")
    with whole_file(tmp_path / "a.txt") as beside:
        beside.write_text("whole")
    assert {path.name for path in tmp_path.iterdir()} == {*stay, "a.txt"}


def test_a_folder_that_was_killed_while_it_was_begun_is_begun_again(tmp_path):
    config = TrainConfig(model=ModelConfig(design=Design()))
    for claim, name in (
        (lambda path: begun(path, MADE), "set.json"),
        (lambda path: claim_run(path, config), "config.json"),
    ):
        path = tmp_path / name
        path.mkdir()
        (path / f".{Path(name).stem}.{os.uname().nodename[:40]}.{ended_process()}.part.json").write_text("{")
        assert is_unclaimed(path)
        claim(path)
        assert (path / name).is_file() and not [*path.glob(".*")] and not is_unclaimed(path)
        claim(path)


def test_a_full_disk_is_one_line_that_names_the_file_and_leaves_nothing(tmp_path):
    """HDF5 alone would print tracebacks while it closes, and crash as the process ends."""
    views = random_planes(3, size=16, seed=1).transients
    path = tmp_path / "set.h5"
    write_pack(((view, {}) for view in views), path)
    whole = path.read_bytes()
    for size in range(0, len(whole), len(whole) // 9):
        with largest_file(size), pytest.raises(InputError, match=r"set\.h5: cannot be written \(File too large\)$"):
            write_pack(((view, {}) for view in views), path)
        assert path.read_bytes() == whole and [*tmp_path.iterdir()] == [path]
    write_pack(((view, {}) for view in views), path)
    assert path.read_bytes() == whole and len(read_pack(path)) == 3
    journal = tmp_path / "journal.jsonl"
    append_line(journal, '{"a": 1}')
    with largest_file(12), pytest.raises(InputError, match=r"journal\.jsonl: cannot be written"):
        append_line(journal, '{"b": 2}')
    append_line(journal, '{"c": 3}')
    assert [*read_whole_lines(journal)] == [{"a": 1}, {"c": 3}]
