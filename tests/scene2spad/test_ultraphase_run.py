"""`ultraphase run` of one's own photons and tables, and what it shows of a core's steps."""

import json

import numpy as np
import pytest

from scene2spad.cli import main
from scene2spad.emulation.emulated_chain import emulate
from scene2spad.emulation.program_tables import int8_temporal
from spad.measurements.histogram import Histogram, write_histogram
from spad.sensor.model import Sensor
from ultraphase import method
from ultraphase.catalog import FOLDER
from ultraphase.tables import quarter_wave

SHORT = ".space sum, s16, 2\nloop: BNT idle\nRDT r1\nADDM [sum], r1\nJMP loop\nidle: BFE end\nJMP loop\n"
DRAIN = "end: LDH r1, [sum]\nOUTH r1\nHALT\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(capfd, *argv: str) -> dict:
    status = main(["ultraphase", *argv, "--json"])
    out, err = capfd.readouterr()
    assert status == 0, err
    return json.loads(out)


def refused(capfd, *argv: str) -> list[str]:
    status = main(["ultraphase", *argv])
    out, err = capfd.readouterr()
    assert status == 2 and out == ""
    return err.splitlines()


def histogram(path, rows: int, columns: int, bins: int = 1024, photons: float = 60) -> np.ndarray:
    counts = np.random.default_rng(3).poisson(photons / bins, (rows, columns, bins)).astype(np.int32)
    write_histogram(Histogram.from_counts(counts, Sensor(bins=bins)), path)
    return counts


@pytest.fixture
def own_copy(folder):
    """A copy of the package's Fourier program, with its table as a file."""
    for name in ("fourier.s", "harmonics.s", "harmonic.s", "drain16.s"):
        (folder / name).write_text((FOLDER / name).read_text())
    np.save(folder / "q.npy", quarter_wave(int8_temporal(method("fourier-8"))))
    return ("fourier.s", "--define", "K=8", "--table", "quarter=q.npy")


def test_a_histogram_through_a_copied_program_is_the_integer_product(capfd, folder, own_copy):
    counts = histogram(folder / "h.h5", 4, 6)
    result = run(capfd, "run", *own_copy, "--timestamps", "h.h5")
    chosen = method("fourier-8")
    expected = counts @ chosen.matrix(int8_temporal(chosen)).T
    assert np.array_equal(np.array(result["out"]).reshape(4, 6, 8), expected)
    assert result["cores"] == [4, 6] and result["counters"]["photons"] == counts.sum()
    shipped = run(capfd, "run", "fourier-8", "--timestamps", "h.h5")
    assert {**shipped, "program": ""} == {**result, "program": ""}
    assert result["power_30_fps"]["processing_energy_w"] == pytest.approx(45 * counts.sum() * 30 / 94.6e9)


def test_blocks_of_cores_take_a_histogram(capfd, folder):
    counts = histogram(folder / "h.h5", 4, 6)
    result = run(capfd, "run", "separable-8", "--timestamps", "h.h5")
    assert np.array_equal(np.array(result["out"]).ravel(), emulate(counts, method("separable-8")).codes.ravel())


def test_timestamps_of_a_file_are_every_cores(capfd, folder):
    np.save(folder / "t.npy", np.array([5, 5, 1023, 0], np.uint16))
    out = run(capfd, "run", "coarse-64", "--timestamps", "t.npy")["out"]
    assert len(out) == 4 and all(row == [2 + 1, *[0] * 62, 1] for row in out)
    np.save(folder / "t.npy", np.zeros(0, int))
    assert run(capfd, "run", "coarse-64", "--timestamps", "t.npy")["counters"]["photons"] == 0


def test_verify_takes_tables(capfd, folder, own_copy):
    assert run(capfd, "verify", *own_copy)["adds"] == {"least": -127, "most": 127}


def test_verify_takes_the_table_of_one_core(capfd, folder, own_copy):
    """The message asked for (1, 1, 256), and the next one for a row for each of 1024 cores."""
    np.save(folder / "q.npy", np.tile(np.load(folder / "q.npy"), (2, 2, 1)))
    (line,) = refused(capfd, "verify", *own_copy)
    assert line.endswith("expected whole numbers of shape (256,): one core is verified")
    (line,) = refused(capfd, "verify", "fourier-8", "--table", "quarter=q.npy")
    assert "fourier-8 has its tables" in line


def test_verify_says_what_it_knows_of_the_frames_end(capfd, folder, own_copy):
    proof = run(capfd, "verify", *own_copy)
    assert proof["verified"] and proof["puts_out"] == [f"codes[{n}]" for n in range(8)]
    (folder / "a.s").write_text(SHORT + DRAIN)
    (line,) = refused(capfd, "verify", "a.s")
    assert "a.s: the same photons put out" in line and "its end leaves other than it found" in line
    (folder / "a.s").write_text(SHORT + DRAIN.replace("HALT", "MOV r1, #0\nSTH [sum], r1\nHALT"))
    assert main(["ultraphase", "verify", "a.s", "--json"]) == 0
    out, err = capfd.readouterr()
    assert err == "warning: a.s: photons are verified, the frame's end is not: no word is sum[1]\n"
    assert json.loads(out)["verified"] is False and json.loads(out)["frame_end"] == "no word is sum[1]"
    shipped = run(capfd, "verify", "separable-8")
    assert shipped["verified"] and shipped["frame_end"] == "puts out all numbers, in every frame anew"


def test_each_core_may_have_a_table_of_its_own(capfd, folder):
    (folder / "a.s").write_text(".table t, u8, 2\nLDB r1, [t + 1]\nOUTB r1\nHALT\n")
    np.save(folder / "t.npy", np.arange(8).reshape(2, 2, 2))
    result = run(capfd, "run", "a.s", "--table", "t=t.npy", "--photons", "0", "--trace", "1")
    assert result["out"] == [[1], [3], [5], [7]] and "r1: 0 -> 1" in result["trace"][0]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["fourier-8", "--timestamps", "wide.h5"], "wide.h5: 1536 time bins, expected the chip's 1024 timestamps"),
        (["fourier-8", "--timestamps", "half.h5"], "half.h5: 512 time bins, expected the chip's 1024 timestamps"),
        (["coarse-16", "--timestamps", "half.h5"], "(`sense --bins 1024` gives such bins)"),
        (
            ["separable-8", "--timestamps", "odd.h5"],
            "odd.h5: 3 x 2 pixels do not divide into the blocks of 2 x 2 cores",
        ),
        (["send.s", "--timestamps", "row.h5"], "row.h5: 1 x 2 pixels, expected 2 x 2 or more for send.s"),
        (["fourier-8", "--timestamps", "float.npy"], "float.npy: float64 (2,), expected timestamps"),
        (["fourier-8", "--timestamps", "late.npy"], "late.npy: timestamps 3 to 1024, expected 0 to 1023"),
        (["fourier-8", "--timestamps", "none.npy"], "none.npy"),
        (["fourier-8", "--timestamps", "late.npy", "--photons", "9"], "--photons 9 is for the made-up return"),
        (["fourier-8", "--timestamps", "late.npy", "--signal", "9"], "--signal 9 is for the made-up return"),
        (["fourier-8", "--table", "quarter=late.npy"], "fourier-8 has its tables"),
        (["tab.s", "--table", "t"], "--table 't': expected NAME=FILE.npy"),
        (["tab.s", "--table", "u=late.npy"], "no region 'u' in RAM, there are t, s"),
        (["tab.s", "--table", "s=late.npy"], "--table s: s is RAM that tab.s writes"),
        (["tab.s", "--table", "t=late.npy"], "late.npy: values 3 to 1024, expected 0 to 255 for u8 t"),
        (["tab.s", "--table", "t=float.npy"], "float.npy: float64 (2,) for table t of tab.s, expected whole numbers"),
        (["tab.s", "--table", "t=good.npy", "t=good.npy"], "t is given twice"),
        (["tab.s"], "table t has no contents"),
    ],
)
def test_files_that_do_not_fit_are_refused(capfd, folder, argv, message):
    histogram(folder / "wide.h5", 2, 2, bins=1536)
    histogram(folder / "half.h5", 2, 2, bins=512)
    histogram(folder / "odd.h5", 3, 2)
    histogram(folder / "row.h5", 1, 2)
    np.save(folder / "float.npy", np.ones(2))
    np.save(folder / "good.npy", np.ones(2, int))
    np.save(folder / "late.npy", np.array([3, 1024]))
    (folder / "send.s").write_text("SEND east, r1\nHALT\n")
    (folder / "tab.s").write_text(".table t, u8, 2\n.space s, s16, 2\nLDB r1, [t]\nHALT\n")
    (line,) = refused(capfd, "run", *argv)
    assert message in line


def test_a_trace_goes_to_the_end_of_the_frame(capfd, folder):
    (folder / "a.s").write_text(SHORT + DRAIN)
    trace = run(capfd, "run", "a.s", "--photons", "2", "--trace", "99")["trace"]
    assert [line.split()[3] for line in trace[-4:]] == ["BFE", "LDH", "OUTH", "HALT"]
    assert trace[-1].split()[:2] == [str(3 * len(trace)), "a.s:10"]


def test_a_trace_ends_at_a_link_and_says_so(capfd, folder):
    trace = run(capfd, "run", "separable-8", "--photons", "1", "--trace", "999")["trace"]
    assert "BBS r1, #0" in trace[-2] and "RECV r7, east): a core alone has no neighbours" in trace[-1]


def test_a_frame_that_fails_shows_the_last_steps_of_its_core(capfd, folder):
    late = "RDT r1\nID r3\nBBC r3, #1, end\nMOV r2, #3\nSTH [sum], r2\nSTH [r2 + sum], r1\nend: HALT\n"
    (folder / "a.s").write_text(".space sum, s16, 4\n" + late)
    lines = refused(capfd, "run", "a.s", "--photons", "3", "--trace", "2", "--watch", "sum")
    assert lines[0].startswith("core (1, 0), last 2 of 5 steps")
    assert lines[1].split()[:4] == ["12", "a.s:5", "3", "MOV"] and lines[2].split()[:4] == ["15", "a.s:6", "4", "STH"]
    assert lines[3].startswith("core (1, 0), last 1 changes of sum") and "[3, 0, 0, 0]" in lines[4]
    assert len(lines) == 6
    assert lines[5].startswith("scene2spad: a.s:7, word 5") and lines[5].endswith("address 3 of 16 bits is odd")
    assert refused(capfd, "run", "a.s", "--photons", "3") == lines[5:]


@pytest.mark.parametrize(
    ("source", "first", "step"),
    [
        ("loop: ADD r1, r1, #1\nJMP loop\n", "core (0, 0), last 2 of", "JMP 0"),
        ("ID r1\nBBS r1, #0, end\nRECV r2, east\nend: HALT\n", "core (0, 0), last 2 of 2 steps", "BBS r1, #0, 3"),
        ("ID r1\nBBS r1, #0, go\nHALT\ngo: RECV r2, east\nHALT\n", "core (0, 1), last 2 of 2 steps", "BBS r1, #0, 3"),
    ],
)
def test_a_frame_without_an_end_shows_where_it_turns_or_waits(capfd, folder, source, first, step):
    (folder / "a.s").write_text(source)
    lines = refused(capfd, "run", "a.s", "--photons", "0", "--trace", "2")
    assert len(lines) == 4 and lines[0].startswith(first) and any(step in line for line in lines[1:3])
