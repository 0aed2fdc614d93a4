"""`inspect`: what is in a file, and in one pixel of it."""

import json
from pathlib import Path

import numpy as np
import pytest

from render.transient import read_transient
from scene2spad.cli import main
from scene2spad.cli.results.inspect import BARS, WIDTH, drawn
from spad.formats.dense import dense, write_dense
from spad.formats.depth_map import read_depth
from spad.formats.mat import write_mat
from spad.measurements.histogram import Histogram, read_histogram, write_histogram
from spad.sensor.model import Sensor


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["render", "gallery", "--width", "16", "--height", "12", "--bounces", "1", "--no-figure"]) == 0
        assert main(["sense", "gallery.exr", "--no-figure"]) == 0
        size = ("--width", "16", "--height", "12", "--bounces", "1", "--count", "3")
        assert main(["dataset", "rooms", *size, "--out", "set", "--pack", "set.h5"]) == 0
    return folder


def message(capfd: pytest.CaptureFixture, *argv: object) -> dict:
    capfd.readouterr()
    assert main(["inspect", *map(str, argv), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def test_a_transient_and_the_returns_of_a_pixel(files, capfd):
    found, transient = message(capfd, files / "gallery.exr", "--pixel", 5, 7), read_transient(files / "gallery.exr")
    assert found["kind"] == "transient" and (found["rows"], found["columns"]) == (12, 16)
    assert found["returns"] == transient.returns and found["depth_m"][0] == pytest.approx(np.nanmin(transient.depth_m))
    mine = slice(*transient.offsets[5 * 16 + 7 :][:2])
    assert [one["radiance_per_m2_sr"] for one in found["pixel"]["returns"]] == transient.radiance[mine].tolist()


def test_a_delay_is_shown(files, capfd, tmp_path):
    argv = ["render", "plane", "--width", "8", "--bounces", "1", "--offset", "2.5", "--no-figure"]
    assert main([*argv, "--out", str(tmp_path / "late.exr")]) == 0
    assert message(capfd, tmp_path / "late.exr")["time_offset_m"] == 2.5
    assert "time_offset_m" not in message(capfd, files / "gallery.exr")


def test_a_histogram_and_the_counts_of_a_pixel(files, capfd):
    found, histogram = message(capfd, files / "gallery.h5", "--pixel", 5, 7), read_histogram(files / "gallery.h5")
    assert (found["kind"], found["bins"], found["sensor"]) == ("histogram", 1024, "reference")
    counts = np.zeros(1024, int)
    for one in found["pixel"]["counts"]:
        counts[one["bin"]] = one["counts"]
    assert np.array_equal(counts, histogram.counts[5, 7]) and found["pixel"]["detections"] == counts.sum()


def test_a_depth_map_and_a_pixel_of_it(files, capfd, tmp_path):
    out = tmp_path / "map.exr"
    assert main(["depth", str(files / "gallery.h5"), "--out", str(out), "--no-figure"]) == 0
    found, (depth_m, confidence, _) = message(capfd, out, "--pixel", 5, 7), read_depth(out)
    assert (found["kind"], found["method"], found["rows"], found["columns"]) == ("depth", "log-matched", 12, 16)
    assert found["depth_m"] == [depth_m.min(), depth_m.max()] and found["missing"] == 0
    assert found["confidence"] == pytest.approx(confidence.mean())
    assert (found["pixel"]["depth_m"], found["pixel"]["confidence"]) == (depth_m[5, 7], confidence[5, 7])
    assert main(["inspect", str(out), "--pixel", "5", "7"]) == 0
    assert f"row 5, column 7, depth_m {depth_m[5, 7]:.6g}" in capfd.readouterr().out


def test_a_published_frame_is_inspected_as_a_histogram(files, capfd, tmp_path):
    write_mat(read_histogram(files / "gallery.h5"), tmp_path / "frame.mat")
    found, ours = message(capfd, tmp_path / "frame.mat", "--pixel", 5, 7), message(capfd, files / "gallery.h5")
    assert (found["kind"], found["bins"]) == ("histogram", 1024)
    assert found["detections_per_pixel"] == ours["detections_per_pixel"] and found["pixel"]["detections"] > 0
    assert main(["inspect", str(tmp_path / "frame.mat"), "--frame", "1"]) == 2
    assert main(["inspect", str(files / "gallery.exr"), "--frame", "1"]) == 2
    assert "gallery.exr: --frame 1 is for captures (.mat)" in capfd.readouterr().err


def test_counts_of_ones_own_were_not_asked_for(files, capfd, tmp_path):
    """Nobody knows how many of them are signal: neither `inspect` nor Python says that there is none."""
    own = Histogram.from_counts(np.ones((2, 3, 8), int), Sensor(bins=8))
    write_histogram(own, tmp_path / "own.h5")
    found, sensed = message(capfd, tmp_path / "own.h5"), message(capfd, files / "gallery.h5")
    asked = {"asked_signal", "asked_background"}
    assert found["detections_per_pixel"] == 8 and sensed.keys() - found.keys() >= asked and sensed["asked_signal"] == 50
    for shown in (repr(own), own._repr_html_()):
        assert "8 detections a pixel; how many are signal is unknown" in shown
    assert "50 signal + 50 background" in repr(read_histogram(files / "gallery.h5"))


def test_a_pack_shows_the_view_asked_for(files, capfd):
    assert message(capfd, files / "set.h5", "--view", 2)["views"] == 3
    assert main(["inspect", str(files / "set.h5"), "--view", "3"]) == 2
    assert "no view 3, there are 0 to 2" in capfd.readouterr().err


@pytest.mark.parametrize("name", ["counts.npz", "counts.h5"])
def test_dense_counts_are_those_of_their_histogram(files, capfd, tmp_path, name):
    histogram = read_histogram(files / "gallery.h5")
    layout = "hwt" if name == "counts.npz" else "thw"
    write_dense(dense(histogram), tmp_path / name, layout=layout)
    found = message(capfd, tmp_path / name, "--pixel", 5, 7)
    assert (found["kind"], found["data"], found["unit"]) == ("dense", "counts", "detections per bin")
    axes = {"hwt": ([12, 16, 1024], "row, column, time"), "thw": ([1024, 12, 16], "time, row, column")}
    assert (found["shape"], found["axes"]) == axes[layout] and (found["rows"], found["columns"]) == (12, 16)
    assert found["sensor"] == "reference" and found["bin_width_s"] == histogram.sensor.bin_width_s
    assert found["wrapped"] == histogram.meta["wrapped"] and {"meta", "mixed"} <= {*found["arrays"]}
    counts = np.zeros(1024, int)
    for one in found["pixel"]["counts"]:
        counts[one["bin"]] = one["counts"]
    assert np.array_equal(counts, histogram.counts[5, 7]) and found["pixel"]["sum"] == counts.sum()


def test_dense_light_has_its_unit_and_may_have_no_sensor(files, capfd, tmp_path):
    arrays = dense(read_transient(files / "gallery.exr"), "reference")
    write_dense(arrays, tmp_path / "light.npz")
    found = message(capfd, tmp_path / "light.npz", "--pixel", 5, 7)
    assert (found["data"], found["unit"]) == ("radiance", "1/(m^2 sr)")
    bins = [one["bin"] for one in found["pixel"]["counts"]]
    assert bins == np.flatnonzero(arrays["data"][5, 7]).tolist()
    write_dense({name: arrays[name] for name in ("data", "tofs", "depth_m")}, tmp_path / "bare.npz")
    assert message(capfd, tmp_path / "bare.npz")["sensor"] is None
    assert main(["inspect", str(tmp_path / "bare.npz"), "--pixel", "12", "0"]) == 2
    assert "no pixel in row 12, column 0" in capfd.readouterr().err
    np.savez(tmp_path / "other.npz", data=np.ones((2, 3, 8)))
    assert main(["inspect", str(tmp_path / "other.npz")]) == 2
    assert "or dense arrays (.npz, .h5)" in capfd.readouterr().err


def test_text_is_short_and_readable(files, capfd):
    capfd.readouterr()
    assert main(["inspect", str(files / "gallery.h5"), "--pixel", "5", "7"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) < 80 and any(" to " in line and line.startswith("depth_m: ") for line in lines)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["gallery.exr", "--pixel", "12", "0"], "no pixel in row 12, column 0 (rows 0 to 11, columns 0 to 15)"),
        (["gallery.exr", "--pixel", "-1", "0"], "no pixel in row -1"),
        (["nothing.exr"], "file not found"),
        (["set/index.jsonl"], "expected a transient"),
    ],
)
def test_mistakes_are_one_line(files, capfd, monkeypatch, argv, message):
    monkeypatch.chdir(files)
    capfd.readouterr()
    assert main(["inspect", *argv]) == 2
    error = capfd.readouterr().err
    assert message in error and len(error.splitlines()) == 1


@pytest.mark.parametrize("bins", [1, 10, 64, 1000])
def test_drawn_histograms(bins):
    counts = np.arange(bins)
    line = drawn(counts)
    assert len(line) == min(bins, WIDTH) and (bins == 1 or line[-1] == BARS[-1])
    assert set(drawn(np.zeros(bins, int))) == {BARS[0]}
