"""`show` of what `export` and `ultraphase` wrote: dense arrays, point clouds, codes and programs in text."""

import base64
import json
import re
import shutil
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from scene2spad.cli import main
from scene2spad.cli.results.show import page_of
from scene2spad.viewer.exports import cloud_content, dense_content
from scenes.errors import InputError
from spad.formats.dense import dense, write_dense
from spad.formats.linospad import capture_of, write_linospad
from spad.formats.mat import read_mat
from spad.measurements.histogram import Histogram, read_histogram
from spad.measurements.timestamps import Timestamps
from spad.sensor.model import Sensor

MODEL = "fourier-1024x1x1-128x-s0"
EXPORTS = ("counts.npz", "counts.h5", "counts-thw.h5", "light.npz", "cloud.ply")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exports")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["render", "gallery", "--width", "16", "--height", "12", "--bounces", "1", "--no-figure"]) == 0
        assert main(["sense", "gallery.exr", "--no-figure"]) == 0
        for name in EXPORTS:
            source = "gallery.exr" if name.startswith("light") else "gallery.h5"
            layout = ["--layout", "thw"] if "thw" in name else []
            assert main(["export", source, "--out", name, *layout]) == 0
        assert main(["export", MODEL, "--out", "codes.txt", "--int8"]) == 0
        assert main(["ultraphase", "compile", MODEL, "--out", "program.txt"]) == 0
    return folder


@pytest.fixture(autouse=True)
def here(files, monkeypatch):
    monkeypatch.chdir(files)


@pytest.mark.parametrize(
    ("file", "word"),
    [*((name, "") for name in EXPORTS), ("codes.txt", "one step is"), ("program.txt", "BNT")],
)
def test_every_export_has_a_page_that_loads_nothing(file, word):
    assert main(["show", file, "--out", "page.html"]) == 0
    text = Path("page.html").read_text(encoding="utf-8")
    assert word in text and "default-src 'none'" in text and "https://" not in text
    assert not re.search(r"<(link|script|img)[^>]*(src|href)=\"(?!data:)", text)


def test_the_pulse_beside_a_published_frame_is_shown(capfd):
    assert main(["sense", "gallery.exr", "--out", "frame.h5", "--export", "mat", "--no-figure"]) == 0
    (pulse,) = Path().glob("PSF_*.mat")
    assert main(["show", str(pulse), "--out", "pulse.html"]) == 0
    assert "data:image/png" in Path("pulse.html").read_text(encoding="utf-8")
    assert main(["show", "frame.mat", "--out", "frame.html"]) == 0
    Path("PSF_used_for_simulation_nr-1_nc-1.mat").write_bytes(pulse.read_bytes()[:200])
    capfd.readouterr()
    assert main(["show", "PSF_used_for_simulation_nr-1_nc-1.mat", "--out", "bad.html"]) == 2
    assert capfd.readouterr().err.count("\n") == 1 and not Path("bad.html").exists()
    assert main(["export", str(pulse), "--out", "x.npz"]) == 2


def test_a_frame_of_a_capture_is_shown_by_its_number(capfd, tmp_path):
    """A capture does not say which detections are signal, and the page does not make a split up."""
    counts = np.random.default_rng(0).poisson(0.02, (2, 6, 6, 1536)).astype(np.int32)
    write_linospad([capture_of(Timestamps.of_counts(one)) for one in counts], tmp_path / "capture.mat")
    assert main(["show", str(tmp_path / "capture.mat"), "--frame", "1", "--out", "frame.html"]) == 0
    text = Path("frame.html").read_text(encoding="utf-8")
    assert "capture.mat, frame 1" in text and f"{int(counts[1].sum()):,}" in text
    assert "how many are signal is unknown" in text and "background detections" not in text
    capfd.readouterr()
    assert main(["show", str(tmp_path / "capture.mat"), "--frame", "2", "--out", "none.html"]) == 2
    assert "frame 2 is not one of its 2" in capfd.readouterr().err
    for frame in (0, 1):
        asked = ["--frame", str(frame)] if frame else []
        assert main(["export", str(tmp_path / "capture.mat"), "--out", str(tmp_path / "dense.npz"), *asked]) == 0
        with np.load(tmp_path / "dense.npz") as dense:
            assert np.array_equal(dense["data"], read_mat(tmp_path / "capture.mat", frame).counts)
    assert main(["export", str(tmp_path / "capture.mat"), "--out", str(tmp_path / "x.npz"), "--frame", "2"]) == 2


def test_files_of_one_name_have_pages_of_their_own(tmp_path, capfd):
    """A dense array in two forms, counts in two layouts, a checkpoint and its run's folder, sets of two folders."""
    for name in ("a", "b"):
        (tmp_path / name / "set").mkdir(parents=True)
    sources = {Path(name): "dense" for name in ("c.npz", "c.h5", "c.hdf5")}
    sources |= {Path(f"x{end}"): "histogram" for end in (".h5", ".hdf5", ".mat")}
    sources |= {Path("x"): "network", Path("x.safetensors"): "network"}
    sources |= {tmp_path / "a" / "set": "set", tmp_path / "b" / "set": "set"}
    pages = [page_of(path, kind) for path, kind in sources.items()]
    assert len({*pages}) == len(sources)
    assert pages[:2] == [Path("c.dense.html"), Path("c.h5.dense.html")] and pages[3] == Path("x.histogram.html")
    shutil.copy("counts.h5", tmp_path / "c.h5")
    shutil.copy("counts.npz", tmp_path / "c.npz")
    for end in ("h5", "npz"):
        assert main(["show", str(tmp_path / f"c.{end}")]) == 0
    assert {page.name for page in tmp_path.glob("*.html")} == {"c.dense.html", "c.h5.dense.html"}


def test_the_page_of_a_folder_is_named_as_the_folder_is_given(tmp_path, monkeypatch):
    (tmp_path / "a/set").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert page_of(Path("a/set"), "set") == Path("a/set.set.html")
    assert page_of(tmp_path / "a/set", "set") == tmp_path / "a/set.set.html"
    monkeypatch.chdir(tmp_path / "a/set")
    assert page_of(Path(), "set") == Path("../set.set.html")
    assert page_of(Path(".."), "set") == Path("../../a.set.html")


def test_hdf5_files_may_end_in_hdf5(tmp_path, capfd):
    """Counts, sets in one file and dense arrays, in every command that reads or writes them."""
    histogram, dense, pack = (str(tmp_path / name) for name in ("a.hdf5", "dense.hdf5", "set.HDF5"))
    for line in (
        ["sense", "gallery.exr", "--out", histogram, "--no-figure"],
        ["inspect", histogram],
        ["depth", histogram, "--no-figure"],
        ["compare", histogram, "--methods", "argmax"],
        ["export", histogram, "--out", dense],
        ["show", histogram],
        ["show", dense],
        [
            *["dataset", "rooms", "--count", "1", "--width", "8", "--height", "8", "--bounces", "1", "--out"],
            str(tmp_path / "s"),
            "--pack",
            pack,
        ],
        ["inspect", pack],
        ["show", pack],
    ):
        assert main(line) == 0, (line, capfd.readouterr().err)
    assert main(["sense", histogram]) == 2 and "is an HDF5 file" in capfd.readouterr().err


def test_a_checkpoint_is_shown_and_exported_by_its_file(tmp_path):
    from csph.weights.cards import checkpoint_of

    shutil.copy(checkpoint_of(MODEL), tmp_path / "mine.safetensors")
    assert main(["show", str(tmp_path / "mine.safetensors"), "--out", "page.html"]) == 0
    assert "data:image/png" in Path("page.html").read_text(encoding="utf-8")
    assert main(["export", str(tmp_path / "mine.safetensors"), "--out", "mine.txt"]) == 0


@pytest.mark.parametrize("name", ["counts.npz", "counts.h5", "counts-thw.h5"])
def test_a_dense_page_holds_the_counts_on_the_sensors_times(name):
    histogram = read_histogram(Path("gallery.h5"))
    assert main(["show", name, "--out", "page.html"]) == 0
    found = json.loads(
        re.search(r'id="payload">(.*?)</script>', Path("page.html").read_text(encoding="utf-8"), re.S)[1]
    )
    (cube,) = found["cubes"]
    data = np.frombuffer(zlib.decompress(base64.b64decode(cube["data"])), cube["type"])
    assert np.array_equal(data.reshape(histogram.counts.shape), histogram.counts)
    assert cube["start_ns"] == pytest.approx(0, abs=1e-9)
    assert cube["step_ns"] == pytest.approx(1e9 * histogram.sensor.bin_width_s, rel=1e-9)


def test_a_cloud_page_holds_the_points():
    content, depth_m = cloud_content(Path("cloud.ply")), read_histogram(Path("gallery.h5")).depth_m
    assert np.linalg.norm(content.points, axis=1) == pytest.approx(depth_m[np.isfinite(depth_m)], rel=1e-6)
    assert content.point_value.min() >= 0 and content.point_value.max() <= 1


@pytest.mark.parametrize("layout", ["hwt", "thw"])
def test_an_export_of_a_single_bin_is_shown_and_inspected(layout, tmp_path, capfd):
    sensor = Sensor(bins=1, bin_width_s=2e-9)
    counts = np.arange(12).reshape(3, 4, 1)
    path = write_dense(dense(Histogram.from_counts(counts, sensor)), tmp_path / "one.npz", layout=layout)
    (cube,) = dense_content(path).cubes
    assert (cube.start_ns, cube.step_ns) == pytest.approx((0, 2)) and np.array_equal(cube.values, counts)
    assert main(["show", str(path), "--out", str(tmp_path / "page.html")]) == 0
    assert main(["inspect", str(path), "--pixel", "2", "1", "--json"]) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["pixel"]["sum"] == 9


def test_files_of_others_are_refused_in_one_line(tmp_path, capfd):
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    np.savez(tmp_path / "b.npz", data=np.zeros((2, 2, 4)), tofs=np.arange(3.0), depth_m=np.ones((2, 2)))
    np.savez(tmp_path / "c.npz", data=-np.ones((2, 2, 4)), tofs=np.arange(4.0), depth_m=np.ones((2, 2)))
    with h5py.File(tmp_path / "d.h5", "w") as file:
        file["other"] = np.zeros(3)
    (tmp_path / "e.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    cut = Path("cloud.ply").read_bytes()[:-7]
    (tmp_path / "f.ply").write_bytes(cut)
    for name, words in (
        ("a.npz", "holds no data"), ("b.npz", "data of shape"), ("c.npz", "negative"), ("d.h5", "no dense array"),
        ("e.ply", "no point cloud"), ("f.ply", "f.ply"),
    ):  # fmt: skip
        assert main(["show", str(tmp_path / name), "--out", str(tmp_path / "page.html")]) == 2
        told = capfd.readouterr().err
        assert words in told and told.count("\n") == 1
    assert not (tmp_path / "page.html").exists()
    with pytest.raises(InputError, match="are no dense export"):
        np.savez(tmp_path / "g.npz", data=np.zeros(4), tofs=np.arange(4.0), depth_m=np.ones((2, 2)))
        dense_content(tmp_path / "g.npz")


def test_what_is_not_exported_says_so(capfd):
    for name, kind in (("cloud.ply", "cloud"), ("codes.txt", "text")):
        assert main(["export", name, "--out", "x.npz"]) == 2
        assert f"{name}: is of kind {kind}, which is not exported" in capfd.readouterr().err


def test_every_dataset_of_our_hdf5_files_says_its_unit_and_what_it_is(tmp_path):
    size = ("--width", "8", "--height", "6", "--bounces", "1", "--count", "2")
    assert main(["dataset", "rooms", *size, "--out", str(tmp_path / "set"), "--pack", str(tmp_path / "set.h5")]) == 0
    assert main(["sense", "gallery.exr", "--signal", "3000", "--out", str(tmp_path / "dense.h5"), "--no-figure"]) == 0
    for path in (Path("gallery.h5"), Path("counts.h5"), tmp_path / "set.h5", tmp_path / "dense.h5"):
        with h5py.File(path) as file:
            assert len(file) >= 5
            for name, dataset in file.items():
                assert dataset.attrs["unit"] and len(dataset.attrs["description"]) > 10, f"{path}: {name}"
