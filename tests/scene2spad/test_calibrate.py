"""The command `calibrate`: a sensor file from captures, which `sense` takes; mistakes in one line."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from render.transient import write_transient
from scene2spad.cli import main
from scene2spad.cli.simulation.calibrating import is_calibrated, warn_of_unknown
from scene2spad.datasets.zone_captures import read_plane_captures, render_plane, shipped_captures, zone_captures
from spad.measurements.histogram import read_histogram
from spad.sensor.files import load_sensor, read_sensor, sensor_tables, write_sensor
from spad.sensor.model import Sensor
from spad.sensor.toml import format_toml
from spad.zones.calibration import Calibration
from spad.zones.expected_counts import PulseBasis
from spad.zones.simulation import draw_zone_counts, zone_returns


def test_shipped_captures_are_a_tmf8820s():
    captures = read_plane_captures(shipped_captures())
    assert captures.counts.shape == (119, 9, 128) and (np.diff(captures.distance_m) > 0).all()
    assert captures.chip_m.shape == (119, 9) and np.abs(captures.drift_bins).max() < 0.5


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A calibration of every sixth capture beyond 0.25 m, enough for a test."""
    folder = tmp_path_factory.mktemp("calibrated")
    assert main(["calibrate", "--every", "6", "--nearest", "0.25", "--out", str(folder / "mine.toml")]) == 0
    return folder / "mine.toml"


@pytest.mark.slow
def test_a_calibrated_sensor_predicts_a_held_out_capture(calibrated):
    """Shape and amplitude of all zones at 0.3 m, with room over what the full calibration reaches."""
    found = read_sensor(calibrated)
    captures = read_plane_captures(shipped_captures())
    at = int(np.abs(captures.distance_m - 0.3025).argmin())
    (capture,) = zone_captures(captures.chosen(slice(at, at + 1)), found.sensor, found.zones)
    counts = draw_zone_counts(capture.returns, found.sensor, found.zones, seed=1, drift_s=capture.drift_s)
    assert np.linalg.norm(counts - capture.counts) < 0.1 * np.linalg.norm(capture.counts)
    assert np.abs(counts.sum(axis=1) / capture.counts.sum(axis=1) - 1).max() < 0.06
    assert 90e-12 < found.sensor.bin_width_s < 97e-12 and found.sources["zones.gain"].startswith("calibrated from")
    again = calibrated.with_name("again.toml")
    assert read_sensor(write_sensor(found, again)) == found


@pytest.mark.slow
def test_sense_takes_the_calibrated_sensor(calibrated, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    zones = load_sensor(str(calibrated)).zones
    write_transient(render_plane(0.25, zones), tmp_path / "plane.exr")
    options = ["sense", "plane.exr", "--sensor", str(calibrated), "--json"]
    assert main(options) == 0
    message = json.loads(capfd.readouterr().out.splitlines()[-1])
    histogram = read_histogram(tmp_path / "plane.h5")
    assert histogram.counts.shape == (3, 3, 128) and message["model"] == "zones" and message["mean_signal"] > 1e5
    light = zone_returns(render_plane(0.25, zones), zones)
    assert len(light) == 9
    assert main([*options, "--signal", "500", "--background", "100"]) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["mean_signal"] == pytest.approx(500, rel=1e-4)
    assert main([*options, "--background", "500"]) == 0
    line = "signal: 50 photons a zone, the default, and not as calibrated, since --background is given"
    assert line in capfd.readouterr().err
    assert main(["depth", "plane.h5", "--method", "coates"]) == 2
    assert "depth method coates: undoes the pile-up of a pixel's detector" in capfd.readouterr().err
    assert main(["depth", "plane.h5", "--out", "d.exr", "--no-figure"]) == 0
    for name in ("plane.h5", "d.exr"):
        assert main(["export", name, "--out", "plane.ply"]) == 0
        points = trimesh.load("plane.ply").vertices
        assert points[:, 2] == pytest.approx(np.full(9, 0.25), abs=2e-3 if name == "plane.h5" else 0.02)
        # zones look where they look: rows from the top, columns from the left
        assert (np.diff(points[:3, 0]) > 0.03).all() and points[0, 1] < -0.03 < 0.03 < points[8, 1]
    capfd.readouterr()
    assert main([*options, "--radiometric"]) == 2
    assert "--radiometric does not go with a sensor of zones" in capfd.readouterr().err


def test_parameters_that_the_captures_do_not_know_are_warned_of(caplog):
    zones = replace(load_sensor("tmf8820").zones, trials=(1e6,) * 8 + (math.inf,), leak=(0.0,) * 8 + (3.0,))
    known = {name: np.zeros(9) for name in ("gain", "skew_s", "background", "echo_m2", "recovery", "compression")}
    errors = known | {"trials": np.full(9, 2e6), "leak": np.ones(9), "crosstalk": np.zeros(1)}
    warn_of_unknown(Calibration(Sensor(), zones, errors, 1.0, {}, PulseBasis.made(0, 2, 2), ()))
    (record,) = caplog.records
    assert record.message == "standard error larger than the value, so that it is not known: trials of 8 zones"


@pytest.mark.slow
def test_files_that_calibrate_did_not_write_are_kept(calibrated, tmp_path, monkeypatch, capfd):
    """A folder, another program's file, a sensor of one's own with its comments: refused before any work."""

    def work(*_):
        raise AssertionError("work was begun")

    monkeypatch.setattr("scene2spad.cli.simulation.calibrating.zone_captures", work)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dd.toml").mkdir()
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 'mine'\n")
    mine = "# measured on Tuesday\n" + format_toml(sensor_tables(load_sensor("tmf8820")))
    (tmp_path / "mine.toml").write_text(mine)
    for name, words in (("dd", "is a folder"), ("pyproject", "exists and is no"), ("mine", "exists and is no")):
        assert main(["calibrate", "--out", f"{name}.toml"]) == 2
        err = capfd.readouterr().err
        assert f"{name}.toml: {words}" in err and len(err.splitlines()) == 1
    assert (tmp_path / "mine.toml").read_text() == mine
    assert is_calibrated(calibrated)  # and so it may be written again
    with pytest.raises(AssertionError, match="work was begun"):
        main(["calibrate", "--out", str(calibrated)])


def shipped_without(path, change):
    """Write the shipped captures beyond 0.25 m, changed, to a file of one's own."""
    with np.load(shipped_captures()) as held:
        far = held["distance_m"] > 0.25
        arrays = {name: held[name][far] for name in ("distance_m", "counts", "reference_counts")}
    change(arrays["counts"])
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("distances", "words"),
    [
        (lambda held: held[::-1], "distance_m does not belong to counts: in 9 of 9 zones the return moves -"),
        (lambda held: 2 * held, "distance_m does not belong to counts: in 9 of 9 zones the return moves 0.4"),
        (lambda held: np.full_like(held, 0.3), "distinct distances in distance_m of the captures fitted: 1, which do"),
        (lambda held: 0.25 + 0.1 * held, "distance_m spans"),
    ],
    ids=["reversed", "paths", "equal", "near"],
)
def test_distances_of_other_captures_are_refused_before_any_work(distances, words, capfd, tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.cli.simulation.calibrating.zone_captures", no_work)
    monkeypatch.chdir(tmp_path)
    with np.load(shipped_captures()) as held:
        arrays = {"distance_m": distances(held["distance_m"]), "counts": held["counts"]}
    np.savez("mine.npz", **arrays)
    assert main(["calibrate", "mine.npz"]) == 2
    err = capfd.readouterr().err
    assert f"scene2spad: mine.npz: {words}" in err and not [*tmp_path.glob("*.toml")]


@pytest.mark.parametrize("effects", [["delay", "background"], pytest.param([], marks=pytest.mark.slow)])
def test_captures_in_part_of_another_order_lead_to_no_file(effects, capfd, tmp_path, monkeypatch):
    """Refuse 6 of 45 captures that are others': returns still move with distance, so that the fit shows it, without
    numbers that overflow."""
    monkeypatch.chdir(tmp_path)
    shipped_without("turned.npz", lambda counts: np.copyto(counts, np.roll(counts, -6, axis=0)))
    options = ["--effects", *effects] if effects else []
    assert main(["calibrate", "turned.npz", "--every", "6", *options]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("scene2spad: turned.npz: the fit ") and not [*tmp_path.glob("*.toml")]


def no_work(*_):
    raise AssertionError("the plane was rendered")


@pytest.mark.parametrize(
    ("change", "options", "meant"),
    [
        (
            {"counts": np.s_[:, :4]},
            [],
            "mine.npz: captures of 4 zones and 128 bins, sensor tmf8820 has 9 zones of 128",
        ),
        ({"counts": np.s_[:, :, :64]}, [], "mine.npz: captures of 9 zones and 64 bins, sensor tmf8820 has 9 zones"),
        ({}, ["--every", "1000"], "--every 1000 fits 1 of {n} captures of mine.npz, 8 are needed: expected --every"),
    ],
)
def test_captures_that_do_not_fit_are_refused_before_any_work(change, options, meant, capfd, tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.cli.simulation.calibrating.zone_captures", no_work)
    monkeypatch.chdir(tmp_path)
    with np.load(shipped_captures()) as held:
        arrays = {name: held[name][change.get(name, np.s_[:])] for name in ("distance_m", "counts")}
    np.savez("mine.npz", **arrays)
    assert main(["calibrate", "mine.npz", *options]) == 2
    number = int((arrays["distance_m"] >= 0.1).sum())
    err = capfd.readouterr().err
    assert meant.format(n=number) in err and len(err.splitlines()) == 1


def test_the_largest_every_that_is_proposed_leaves_enough(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.cli.simulation.calibrating.zone_captures", no_work)
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "--every", "1000"]) == 2
    most = int(capfd.readouterr().err.split("expected --every ")[1].split()[0])
    assert main(["calibrate", "--every", str(most + 1)]) == 2
    with pytest.raises(AssertionError, match="the plane was rendered"):
        main(["calibrate", "--every", str(most)])


@pytest.mark.parametrize("background", [0, 100])
def test_a_zone_that_sees_nothing_is_named_with_its_file(background, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(1)
    shipped_without("dead.npz", lambda counts: np.copyto(counts[:, 3], random.poisson(background, counts[:, 3].shape)))
    assert main(["calibrate", "dead.npz", "--every", "6", "--nearest", "0.25"]) == 2
    err = capfd.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("scene2spad: ")]
    assert len(lines) == 1 and "dead.npz: zone 3 (of 0 to 8) sees a return in 0 of 8 captures" in lines[0]
    assert "Traceback" not in err and "RuntimeWarning" not in err and not [*tmp_path.glob("*.toml")]


def test_captures_that_a_zone_misses_are_told_and_used(capfd, tmp_path, monkeypatch):
    """Among them the one that the fit would begin with."""
    monkeypatch.chdir(tmp_path)
    shipped_without("some.npz", lambda counts: counts[18:25, 2].fill(0))
    assert main(["calibrate", "some.npz", "--every", "6", "--nearest", "0.25", "--effects", "delay"]) == 0
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("some.npz: in 7 of 45 captures a zone sees no return, the first at 0.3") and "zone 2" in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.npz"], "capture file not found"),
        (["bad.npz"], "not a readable .npz file"),
        (["thin.npz"], "holds no counts"),
        (["foreign.npz"], "holds no distance_m, expected captures: distance_m (N,) and counts (N, zones, bins)"),
        (["small.npz"], "captures of 2 zones and 5 bins"),
        (["halves.npz"], "counts are no whole numbers"),
        (["endless.npz"], "endless.npz: reference_counts holds values that are not finite"),
        (["huge.npz"], "huge.npz: counts holds values that are not finite, negative or above"),
        (["mm.npz"], "mm.npz: distance_m 400 m is beyond the record of 1.75 m: are these millimetres?"),
        (["--sensor", "reference"], "has no zones"),
        (["renamed.h5"], "renamed.h5: captures are a .npz file"),
        (["--nearest", "-1"], "--nearest -1: expected a distance in m, 0 or more"),
        (["--nearest", "nan"], "--nearest nan: expected a distance in m, 0 or more"),
        (["--every", "1"], "leaves no capture"),
        (["--nearest", "0.39"], "expected 16 or more"),
        (["--effects", "gravity"], "gravity cannot be fitted"),
        (["--out", "x.txt"], "must end in .toml"),
        (["--model-error", "-1"], "is outside 0 to 1"),
    ],
)
def test_mistakes_end_in_one_line(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.npz").write_text("no")
    np.savez(tmp_path / "thin.npz", distance_m=np.ones(3))
    np.savez(tmp_path / "foreign.npz", meta="text", data=np.ones(3))
    distance_m, counts = np.linspace(0.1, 0.4, 20), np.ones((20, 2, 5))
    np.savez(tmp_path / "small.npz", distance_m=distance_m, counts=counts)
    (tmp_path / "renamed.h5").write_bytes(shipped_captures().read_bytes())
    np.savez(tmp_path / "mm.npz", distance_m=1e3 * distance_m, counts=np.ones((20, 9, 128)))
    np.savez(tmp_path / "halves.npz", distance_m=distance_m, counts=0.5 * counts)
    np.savez(tmp_path / "endless.npz", distance_m=distance_m, counts=counts, reference_counts=np.full((20, 5), np.nan))
    np.savez(tmp_path / "huge.npz", distance_m=distance_m, counts=1e300 * counts)
    status = main(["calibrate", *arguments])
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("scene2spad: ")]
    assert status == 2 and len(lines) == 1 and words in lines[0]
    assert not [*tmp_path.glob("*.toml")]
