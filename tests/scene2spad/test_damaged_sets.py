"""What commands left behind and go on from, damaged: one line, or the same work again; never a traceback."""

import json
import os

import pytest

from scene2spad.cli import main
from scene2spad.datasets.set_folder import Done, SetFolder, file_name
from scene2spad.studies.results import Store
from scenes.errors import InputError

MADE = {"set": "planes", "seed": 0}
DEEP = b"[" * 100_000 + b"\n"


def record(view: int) -> dict:
    return {"view": view, "file": file_name(view), "bytes": 3, "error": 0.01, "target": 0.02, "target_met": True}


@pytest.mark.parametrize("junk", [b"\xff\xfe", b"{", DEEP, b'{"view": 1e400}\n', b'{"view": [], "file": {}}\n'])
@pytest.mark.parametrize("name", ["journal.jsonl", "index.jsonl"])
def test_damaged_lines_of_a_journal_cost_their_view_alone(tmp_path, name, junk):
    folder = SetFolder(tmp_path, MADE)
    for view in range(3):
        folder.add(Done(record(view), b"exr", 0.1, "here"))
    lines = (tmp_path / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "journal.jsonl").unlink()
    (tmp_path / name).write_bytes(lines[0] + junk.rstrip(b"\n") + b"\n" + lines[2])
    assert sorted(SetFolder(tmp_path, MADE).records) == [0, 2]


def test_a_journal_vouches_for_no_file_elsewhere(tmp_path):
    (tmp_path / "out.exr").write_bytes(b"exr")
    SetFolder(tmp_path / "set", MADE)
    stolen = [record(0) | {"file": "../out.exr"}, record(1) | {"file": None}, record(2) | {"error": None}]
    (tmp_path / "set" / "views" / "000002.exr").write_bytes(b"exr")
    (tmp_path / "set" / "journal.jsonl").write_text("".join(json.dumps(one) + "\n" for one in stolen))
    assert SetFolder(tmp_path / "set", MADE).records == {}


@pytest.mark.parametrize("junk", [b"\xff\xfe", b"", DEEP])
def test_a_damaged_set_json_is_refused(tmp_path, junk):
    SetFolder(tmp_path, MADE)
    (tmp_path / "set.json").write_bytes(junk)
    with pytest.raises(InputError):
        SetFolder(tmp_path, MADE)


def test_damaged_lines_of_a_store_are_passed_over(tmp_path):
    Store(tmp_path).put("d" * 64, 1.5, view=1)
    path = next(tmp_path.glob("*.jsonl"))
    path.write_bytes(b'\xff\xfe\n{"a": 1}\n[1, 2]\n["k"]\n[[], 1]\n' + DEEP + path.read_bytes() + b'["cut')
    assert Store(tmp_path).get("d" * 64, view=1) == 1.5


@pytest.mark.parametrize("name", [b"caf\xe9.png", b"caf\xe9.csv", b"caf\xe9/config.json"])
@pytest.mark.parametrize("options", [(), ("--json",)])
def test_a_report_of_files_whose_names_are_no_text(tmp_path, capsys, name, options):
    path = tmp_path / "results" / os.fsdecode(name)
    path.parent.mkdir(parents=True)
    path.write_bytes(b"[" * 100_000)
    out = tmp_path / "report.html"
    assert main(["report", "--results", str(tmp_path / "results"), "--out", str(out), *options]) == 0
    assert "caf" in out.read_text(encoding="utf-8")
    capsys.readouterr().out.encode()
