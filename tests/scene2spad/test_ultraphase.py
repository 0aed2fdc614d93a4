"""The emulated processor from the command line, in the chain, in the bench and in the study."""

import json

import numpy as np
import pytest

from scene2spad.bench import emulate as bench
from scene2spad.cli import main
from scene2spad.emulation.emulated_chain import by_torch, decode, emulate
from scene2spad.emulation.program_tables import int8_temporal
from scenes.errors import InputError
from spad.sensor_names import sensor_by_name
from ultraphase import method
from ultraphase.catalog import FOLDER, PUBLISHED


def run(capfd, *argv: str) -> dict:
    status = main([*argv, "--json"])
    out, err = capfd.readouterr()
    assert status == 0 and len(out.splitlines()) == 1, err
    return json.loads(out)


def refused(capfd, *argv: str) -> str:
    status = main(list(argv))
    out, err = capfd.readouterr()
    assert status == 2 and out == "" and len(err.splitlines()) == 1, err
    return err


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def counts(height: int, width: int, seed: int = 0, signal: float = 50, background: float = 500) -> np.ndarray:
    """A plane seen by a pixel array: the same arrival, bin 400 to 401, in every pixel."""
    random = np.random.default_rng(seed)
    found = random.poisson(background / 1024, (height, width, 1024)).astype(np.int32)
    stamps = random.normal(400.5, 1.4, (height, width, round(signal))).astype(int)
    for row, column in np.ndindex(height, width):
        np.add.at(found[row, column], stamps[row, column], 1)
    return found


def test_table(capfd, folder):
    rows = run(capfd, "ultraphase", "table", "--out", "table.csv")["rows"]
    assert [row["name"] for row in rows] == [*PUBLISHED]
    for row in rows:
        for column in ("frame_time_s", "rate_kb_per_s", "processing_uw", "readout_uw"):
            assert row["recomputed"][column] == pytest.approx(row["published"][column], rel=6e-3)
        assert row["emulated"]["processing_uw_energy"] > 1000 * row["emulated"]["processing_uw"]
    assert len((folder / "table.csv").read_text().splitlines()) == 8


def test_run_shows_what_it_cost_and_how(capfd, folder):
    result = run(capfd, "ultraphase", "run", "fourier-8", "--photons", "100", "--signal", "40", "--trace", "9")
    assert result["counters"]["photons"] == 400 and result["out_bits"] == 4 * 8 * 16
    assert len(result["trace"]) == 9 and result["trace"][1].split()[:4] == ["6", "fourier.s:14", "1", "RDT"]
    again = run(capfd, "ultraphase", "run", "fourier-8", "--photons", "100", "--signal", "40", "--watch", "codes")
    assert again["out"] == result["out"] and len(again["watch"]) == 100
    assert again["watch_cut"] == "the first 100 changes; the next one is at clock 1716, after 13 of 100 photons"
    other = run(capfd, "ultraphase", "run", "fourier-8", "--photons", "100", "--signal", "40", "--seed", "1")
    assert other["out"] != result["out"]
    summed = run(capfd, "ultraphase", "run", "separable-8")
    assert np.array(summed["out"]).shape == (1, 32) and summed["stall_clocks"] > 0


def test_run_prices_the_end_of_the_frame_apart_from_its_photons(capfd, folder):
    empty = run(capfd, "ultraphase", "run", "fourier-8", "--photons", "0", "--signal", "0")
    full = run(capfd, "ultraphase", "run", "fourier-8")
    assert empty["clocks_per_photon"] is None and full["clocks_per_photon"] == 135
    for result in (empty, full):
        assert result["frame_end_clocks"] == 138
        assert result["power_30_fps"]["frame_end_energy_w"] == pytest.approx(46 * 30 * 4 / 94.6e9)
        assert result["power_30_fps"]["frame_end_time_s"] == pytest.approx(138 * 2.38e-9)
    assert full["power_30_fps"]["processing_energy_w"] == pytest.approx(45 * 550 * 30 * 4 / 94.6e9)


@pytest.mark.parametrize(
    ("source", "photon", "end", "words"),
    [
        ("MOV r1, #1\nHALT", None, 6, ["80 of 80 photons unread"]),
        ("RDT r1\nHALT", 6, 0, ["76 of 80 photons unread", "no timestamp is there"]),
        ("MOV r1, #9\nBNT r\nRDT r2\nHALT\nr: SUB r1, r1, #1\nBNZ r1, r\nHALT", 12, 0, ["76 of", "takes longer"]),
    ],
)
def test_run_says_what_a_program_leaves_unread(capfd, folder, source, photon, end, words):
    (folder / "a.s").write_text(source + "\n")
    assert main(["ultraphase", "run", "a.s", "--photons", "20", "--signal", "5", "--json"]) == 0
    out, err = capfd.readouterr()
    result = json.loads(out)
    assert result["clocks_per_photon"] == photon and result["frame_end_clocks"] == end
    assert len(err.splitlines()) == len(words) and all(word in err for word in words)


def test_run_makes_all_of_few_photons_signal(capfd, folder):
    few = run(capfd, "ultraphase", "run", "coarse-64", "--photons", "10")
    assert few == run(capfd, "ultraphase", "run", "coarse-64", "--photons", "10", "--signal", "10")
    usual = run(capfd, "ultraphase", "run", "coarse-64")
    assert usual == run(capfd, "ultraphase", "run", "coarse-64", "--photons", "550", "--signal", "50")


def test_asm_list_and_verify(capfd, folder):
    source = folder / "mine.s"
    source.write_text((FOLDER / "coarse.s").read_text())
    assembled = run(capfd, "ultraphase", "asm", "mine.s", "--define", "K=8", "SHIFT=7", "--out", "mine.hex")
    assert (folder / "mine.hex").read_text().split() == assembled["words"] and assembled["ram_bits"] == 64
    assert "SHR r1, r1, #4" in run(capfd, "ultraphase", "list", "mine.s")["listing"]
    proof = run(capfd, "ultraphase", "verify", "mine.s")
    assert proof["verified"] and proof["overflow"] == "saturates" and proof["adds"] == {"least": 0, "most": 1}
    assert run(capfd, "ultraphase", "verify", "separable-8")["clocks_mean"] == 147


def test_compile_counts_cores_as_the_supplement_does(capfd, folder):
    """Rows first: the chip has 3 x 6 cores (S.2), the design is 256 x 4 x 4."""
    result = run(capfd, "ultraphase", "compile", "learned-16x4x4-128x-s0")
    assert result["array"] == "blocks of 4 x 4 cores need a larger array than the fabricated 3 x 6"


def test_sweep_refuses_what_does_not_fit_and_goes_on(capfd, folder):
    result = run(capfd, "ultraphase", "sweep", "--codes", "4", "26", "--photons", "55", "550", "--pixels", "1048576")
    assert {row["name"] for row in result["rows"]} >= {"fourier-4", "separable-4", "coarse-16", "raw timestamps"}
    assert (
        set(result["refused"]) == {"fourier-26", "separable-26"} and "over the 256" in result["refused"]["fourier-26"]
    )


def test_sweep_lists_numbers_that_no_program_has_beside_those_that_do_not_fit(capfd, folder):
    """An odd number ended the command without a row, where 34 was listed."""
    result = run(capfd, "ultraphase", "sweep", "--codes", "3", "9999", "34", "8", "--pixels", "4")
    assert {"fourier-8", "separable-8"} <= {row["name"] for row in result["rows"]}
    assert list(result["refused"]) == [
        f"{kind}-{codes}" for codes in (3, 9999, 34) for kind in ("fourier", "separable")
    ]
    assert "3 codes, expected an even number" in result["refused"]["fourier-3"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["run"], "which program"),
        (["table", "fourier-8"], "takes no program"),
        (["run", "walsh-8"], "walsh-8"),
        (["run", "fourier-26"], "over the 256"),
        (["verify", "learned-2"], "144 bits over"),
        (["verify", "learned-1"], "learned"),
        (["run", "addressed-8"], "no frame of 2 x 2"),
        (["asm", "missing.s"], "missing.s"),
        (["asm", "bad.s"], "bad.s:2:7"),
        (["asm", "bad.s", "--define", "K"], "NAME=VALUE"),
        (["asm", "bad.s", "--define", "K=1", "K=2"], "--define K=2: K is given twice"),
        (["run", "fourier-8", "--define", "K=3"], "--define"),
        (["run", "fourier-8", "--photons", "10", "--signal", "11"], "--signal 11 is outside 0 to 10"),
        (["run", "fourier-8", "--signal", "-1"], "--signal -1 is outside 0 to 550"),
        (["run", "fourier-8", "--signal", "nan"], "--signal nan is outside 0 to 550"),
        (["run", "fourier-8", "--photons", "1", "2"], "2 photon counts"),
        (["run", "fourier-8", "--photons", "1e9"], "--photons 1e+09 is outside 0 to 20000"),
        (["run", "fourier-8", "--photons", "1.5"], "--photons 1.5: expected a whole number"),
        (["run", "fourier-8", "--photons", "2", "--signal", "0.6"], "--signal 0.6: expected a whole number"),
        (["run", "fourier-8", "--trace", "-1"], "--trace -1 is outside 0 to 100000"),
        (["run", "fourier-8", "--watch", "nothing"], "nothing"),
        (["sweep", "--fps", "0"], "load: 0 frames a second, expected more than 0, at most 1e9"),
        (["sweep", "--pixels", "0"], "0 pixels"),
        (["table", "--out", "nowhere/t.csv"], "nowhere"),
    ],
)
def test_mistakes_end_in_one_line(capfd, folder, argv, message):
    (folder / "bad.s").write_text("HALT\n  ADD r1\n".replace("ADD r1", "JMP 3"))
    assert message in refused(capfd, "ultraphase", *argv)
    assert [path.name for path in folder.iterdir()] == ["bad.s"]


@pytest.mark.parametrize("asked", [("--trace", "-1"), ("--watch", "nothing")])
def test_what_to_look_at_is_checked_before_the_run(capfd, folder, monkeypatch, asked):
    monkeypatch.setattr("scene2spad.cli.experiments.ultraphase_run.CoreArray", None)
    assert asked[1] in refused(capfd, "ultraphase", "run", "fourier-8", *asked)


def test_a_load_that_cannot_be_is_refused_before_the_programs_run(capfd, folder, monkeypatch):
    monkeypatch.setattr("scene2spad.cli.experiments.ultraphase_actions.all_costs", None)
    assert "load: -1 frames a second" in refused(capfd, "ultraphase", "sweep", "--fps", "2", "-1")


@pytest.mark.parametrize("name", PUBLISHED)
def test_emulated_codes_are_the_torch_paths_and_give_depth(name, monkeypatch):
    chosen, found = method(name), counts(4, 6)
    with monkeypatch.context() as patch:
        if chosen.block != (1, 1):
            spatial = np.random.default_rng(1).integers(-127, 128, (2, 2, chosen.codes))
            patch.setattr("scene2spad.emulation.emulated_chain.fixed_spatial", lambda _: spatial)
        emulated = emulate(found, chosen)
        assert np.array_equal(emulated.codes, by_torch(found, chosen))
    assert emulated.counters.photons == found.sum()
    assert emulated.bits == emulated.codes.size * (8 if chosen.family == "coarse" else 16)
    sensor = sensor_by_name("reference")
    bright = counts(4, 6, signal=150, background=50)
    depth = decode(emulate(bright, chosen).codes, chosen, sensor)
    # a coarse bin without its neighbours only says which bin: half a bin; codes of a few harmonics: some bins of 1024
    most_bins = {"coarse-16": 64, "coarse-64": 16, "coarse-256": 4}.get(name, 5)
    assert np.abs(depth / sensor.bin_depth_m - 401).max() < most_bins


def test_torch_and_cores_agree_where_numbers_overflow():
    found = np.zeros((2, 2, 1024), np.int32)
    found[..., 0] = 300
    for name in PUBLISHED:
        chosen = method(name)
        emulated = emulate(found, chosen)
        assert np.array_equal(emulated.codes, by_torch(found, chosen))
        assert (emulated.counters.wraps > 0) == (chosen.family != "coarse")
        assert emulated.counters.saturations > 0 or chosen.family == "fourier"


def test_images_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="512 bins"):
        emulate(np.zeros((2, 2, 512), np.int32), method("coarse-16"))
    with pytest.raises(InputError, match="3 x 2 pixels does not divide"):
        emulate(np.zeros((2, 3, 1024), np.int32), method("separable-8"))


def test_the_tables_come_from_csph():
    assert int8_temporal(method("coarse-16")) is None
    assert int8_temporal(method("fourier-8")).shape == (8, 1024)
    assert int8_temporal(method("separable-16")).shape == (16, 256)


def test_bench_rows_agree_bit_for_bit(capfd, folder):
    result = run(capfd, "bench", "emulate", "--quick", "--only", "coarse-64", "separable-8", "--out", "bench")
    assert len(result["rows"]) == 8 and all(row["seconds"] > 0 for row in result["rows"])
    for row in result["rows"]:  # a proof that does not hold raises
        assert row["error"] == (None if row["name"].endswith("proof") else 0)
    assert (folder / "bench" / "bench-emulate.csv").is_file()


@pytest.mark.slow
def test_a_megapixel_frame_equals_the_integer_product():
    row = bench.time_megapixel(method("fourier-16"), seed=0, repeats=1)
    assert row["error"] == 0 and row["pixels"] == 1 << 20 and row["photons"] == pytest.approx(550 << 20, rel=1e-2)


@pytest.mark.slow
def test_study_power(capfd, folder):
    argv = ("study", "power", "--scene", "plane", "--width", "8", "--height", "8", "--out", "study")
    result = run(capfd, *argv)
    assert [row["name"] for row in result["depth"]] == [*PUBLISHED] == [row["name"] for row in result["rows"]]
    assert all(row["differs_from_torch"] == 0 for row in result["depth"])
    assert set(result["shared_core"]) == {"addresses lost", "addresses kept"}
    for figure in result["figures"]:
        assert (folder / figure).read_bytes()[:4] == b"\x89PNG"
    for table in ("ultraphase", "ultraphase-front", "ultraphase-lost"):
        assert (folder / "study" / f"{table}.csv").is_file()
    names = {row["name"] for row in result["front"]}
    assert {"coarse histogram, K = 64", "fourier 1024x1x1, K = 8"} <= names
    assert len(result["front"]) == 5 * 4 * len(names) and len(result["lost_photons"]) == len(names)
    assert all(row["lost"] < row["lost_16_spads"] < 1 for row in result["front"])
    kept = {path: path.stat().st_mtime_ns for path in (folder / "study" / "emulated").iterdir()}
    broken = sorted(kept)[0]
    broken.write_bytes(b"no archive")
    again = run(capfd, *argv)  # finished programs are not run again
    assert again == result and len(kept) == len(PUBLISHED)
    assert all(path.stat().st_mtime_ns == time for path, time in kept.items() if path != broken)
    assert "multiple of 4" in refused(capfd, "study", "power", "--width", "9")
