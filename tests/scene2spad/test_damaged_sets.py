"""What commands left behind and go on from, damaged: one line, or the same work again; never a traceback."""

import json
import os

import pytest
from set_folders import begun, finished

from scene2spad.cli import main
from scene2spad.networks.results import Store
from scenes.errors import InputError

MADE = {"set": "planes", "seed": 0}
DEEP = b"[" * 100_000 + b"\n"


@pytest.mark.parametrize("junk", [b"\xff\xfe", b"{", DEEP, b'{"view": 1e400}\n', b'{"view": [], "file": {}}\n'])
@pytest.mark.parametrize("name", ["journal.jsonl", "index.jsonl"])
def test_damaged_lines_of_a_journal_cost_their_view_alone(tmp_path, name, junk):
    folder = begun(tmp_path, MADE)
    for view in range(3):
        folder.add(finished(view))
    lines = (tmp_path / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "journal.jsonl").unlink()
    (tmp_path / name).write_bytes(lines[0] + junk.rstrip(b"\n") + b"\n" + lines[2])
    assert sorted(begun(tmp_path, MADE).records) == [0, 2]


def test_a_journal_vouches_for_no_file_elsewhere(tmp_path):
    (tmp_path / "out.exr").write_bytes(b"exr")
    begun(tmp_path / "set", MADE)
    stolen = [finished(0, file="../out.exr").record, finished(1, file=None).record, finished(2, error=None).record]
    (tmp_path / "set" / "views" / "000002.exr").write_bytes(b"exr")
    (tmp_path / "set" / "journal.jsonl").write_text("".join(json.dumps(one) + "\n" for one in stolen))
    assert begun(tmp_path / "set", MADE).records == {}


@pytest.mark.parametrize("junk", [b"\xff\xfe", b"", DEEP])
def test_a_damaged_set_json_is_refused(tmp_path, junk):
    begun(tmp_path, MADE)
    (tmp_path / "set.json").write_bytes(junk)
    with pytest.raises(InputError):
        begun(tmp_path, MADE)


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
