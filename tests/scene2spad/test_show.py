"""`show`, `compare` and `export`: pages that load nothing, pictures, tables, and files for other programs."""

import base64
import json
import re
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import trimesh
from PIL import Image

from render.transient import read_transient
from scene2spad.cli import main
from scene2spad.cli.results.show import PAGE_MARK
from scene2spad.viewer.content import LEVELS, Cube, cube_payload
from scene2spad.viewer.exports import COLUMNS
from scene2spad.viewer.sources import expected_cube, light_over_path, merged_returns
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.detect import expected_in_pixel, rates_for
from spad.formats.depth_map import read_depth
from spad.measurements.histogram import read_histogram

MODEL = "learned-256x4x4-128x-s0"


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["render", "gallery", "--width", "16", "--height", "12", "--bounces", "1", "--no-figure"]) == 0
        assert main(["sense", "gallery.exr", "--no-figure"]) == 0
        assert main(["depth", "gallery.h5", "--no-figure", "--out", "depth.exr"]) == 0
        size = ("--width", "16", "--height", "12", "--bounces", "1", "--count", "2")
        assert main(["dataset", "rooms", *size, "--out", "set", "--pack", "set.h5"]) == 0
        np.save("mine.npy", np.random.default_rng(0).normal(size=(8, 1024)))
        np.save("blocks.npy", np.random.default_rng(0).normal(size=(8, 1024, 4, 4)))
        np.save("short.npy", np.random.default_rng(0).normal(size=(8, 64)))
    return folder


@pytest.fixture(autouse=True)
def here(files, monkeypatch):
    monkeypatch.chdir(files)


def told(capfd: pytest.CaptureFixture, *argv: object) -> dict:
    capfd.readouterr()
    assert main([*map(str, argv), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def payload(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'id="payload">(.*?)</script>', text, re.S)[1])


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), kind)


@pytest.mark.parametrize(
    ("file", "kind", "words"),
    [
        ("gallery.exr", "transient", ("laser light", "indirect share")),
        ("gallery.h5", "histogram", ("detections", "expected signal")),
        ("depth.exr", "depth", ("log-matched",)),
        ("set.h5", "pack", ("laser light",)),
        ("set", "set", ("Views",)),
        ("mine.npy", "codes", ("data:image/png",)),
        (MODEL, "network", ("signal 2 to 10",)),
    ],
)
def test_every_kind_of_file_has_a_page_that_loads_nothing(file, kind, words, capfd):
    found = told(capfd, "show", file, "--out", "page.html")
    text = Path("page.html").read_text(encoding="utf-8")
    assert found["kind"] == kind and all(word in text for word in words)
    assert "default-src 'none'" in text and "http://" not in text and "https://" not in text
    assert not re.search(r"<(link|script|img)[^>]*(src|href)=\"(?!data:)", text)


def test_tables_programs_and_sensors_have_pages(capfd):
    Path("rows.csv").write_text("method,mae_mm\nargmax,3.5\n")
    assert main(["ultraphase", "list", "fourier-16"]) == 0
    Path("own.s").write_text("; a program\nhalt\n")
    for file, word in (("rows.csv", "argmax"), ("own.s", "; a program")):
        told(capfd, "show", file, "--out", "other.html")
        assert word in Path("other.html").read_text(encoding="utf-8")
    source = Path(__file__).parents[2] / "spad/sensors/tmf8820.toml"
    told(capfd, "show", source, "--out", "sensor.html")
    assert "bin_width" in Path("sensor.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("table", ["a,b\n1,2,3\n", "a,b\n1\n", f"a,b\n1,{'x' * 200_000}\n", 'a,b\n1,"2\n'])
def test_tables_that_are_none_are_one_line(capfd, table):
    Path("odd.csv").write_text(table)
    assert main(["show", "odd.csv", "--out", "odd.html"]) == 2
    message = capfd.readouterr().err
    assert "odd.csv: " in message and message.count("\n") == 1 and not Path("odd.html").exists()


def test_the_page_holds_the_counts_and_the_images(capfd):
    told(capfd, "show", "gallery.h5", "--out", "page.html")
    found, histogram = payload(Path("page.html")), read_histogram(Path("gallery.h5"))
    counts, expected = found["cubes"]
    assert np.array_equal(unpacked(counts["data"], counts["type"]).reshape(histogram.counts.shape), histogram.counts)
    layers = {layer["name"]: unpacked(layer["data"], "<f4") for layer in found["layers"]}
    assert np.array_equal(layers["true depth"], histogram.depth_m.ravel(), equal_nan=True)
    levels = unpacked(expected["data"], "u1").reshape(histogram.counts.shape)
    rates = expected["top"] * (levels / LEVELS) ** 2
    truth = expected_in_pixel(read_transient(Path("gallery.exr")), histogram.sensor, histogram.budget, 6, 8)
    assert rates[6, 8] == pytest.approx(truth, abs=0.02 * truth.max())
    assert found["points"] is not None and found["returns"] is not None
    arrival = unpacked(found["arrival_ns"], "<f4")
    assert arrival == pytest.approx(2e9 * histogram.depth_m.ravel() / SPEED_OF_LIGHT_M_PER_S, rel=1e-6, nan_ok=True)


def test_rates_for_looking_are_those_that_sense_draws_from():
    """Quarters of a bin move little of the light: 1 % of a pixel's brightest bin at the most."""
    transient, histogram = read_transient(Path("gallery.exr")), read_histogram(Path("gallery.h5"))
    rates = rates_for(transient, histogram.sensor, histogram.budget)
    cube = expected_cube(transient, histogram.sensor, rates)
    for row, column in ((0, 0), (6, 8), (11, 15)):
        exact = expected_in_pixel(transient, histogram.sensor, histogram.budget, row, column)
        assert cube[row, column].sum() == pytest.approx(exact.sum(), rel=1e-5)
        assert np.abs(cube[row, column] - exact).max() < 0.01 * exact.max()


def test_light_over_path_and_lines_keep_the_energy():
    transient = read_transient(Path("gallery.exr"))
    total = transient.total_radiance().sum()
    assert 0.99 * total < light_over_path(transient).values.sum() <= total * (1 + 1e-6)
    lines = merged_returns(transient, 2.0, "")
    assert lines.energy.sum() == pytest.approx(2 * total)
    firsts = lines.offsets[:-1][np.diff(lines.offsets) > 1]
    assert all(lines.time_ns[first] <= lines.time_ns[first + 1] for first in firsts)


def test_a_sensor_that_records_less_than_its_period(capfd):
    """Lines of returns wrap as the light does, and the page tells of arrivals that the record does not reach."""
    told(capfd, "sense", "gallery.exr", "--sensor", "tmf8828", "--out", "short.h5")
    told(capfd, "show", "short.h5", "--transient", "gallery.exr", "--out", "short.html")
    found, sensor = payload(Path("short.html")), read_histogram(Path("short.h5")).sensor
    period_ns, record_ns = 1e9 * sensor.period_s, 1e9 * sensor.bins * sensor.bin_width_s
    arrival = unpacked(found["arrival_ns"], "<f4")
    late = int((arrival >= record_ns).sum())
    assert 0 < late < arrival.size and np.nanmax(arrival) < period_ns
    assert f"true depth of {late} pixels arrives after the record" in Path("short.html").read_text(encoding="utf-8")
    transient = read_transient(Path("gallery.exr"))
    far, wrapped = merged_returns(transient, 1.0, ""), merged_returns(transient, 1.0, "", period_ns=period_ns)
    assert far.time_ns.max() > period_ns > wrapped.time_ns.max()
    assert wrapped.energy.sum() == pytest.approx(far.energy.sum())


def test_large_cubes_are_summed_in_time_and_keep_their_counts(monkeypatch):
    monkeypatch.setattr("scene2spad.viewer.content.MAX_CELLS", 64)
    counts = np.arange(4 * 5 * 9, dtype=np.int32).reshape(4, 5, 9)
    found = cube_payload(Cube("counts", "", counts, 0.0, 1.0, "bars"))
    assert found["summed"] == 4 and found["step_ns"] == 4.0
    assert unpacked(found["data"], found["type"]).sum() == counts.sum()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.uint32, np.float16])
def test_sums_of_narrow_numbers_do_not_overflow(kind, monkeypatch):
    monkeypatch.setattr("scene2spad.viewer.content.MAX_CELLS", 4)
    top = np.finfo(kind).max if kind is np.float16 else np.iinfo(kind).max
    found = cube_payload(Cube("counts", "", np.full((2, 2, 8), top, kind), 0.0, 1.0, "bars"))
    assert found["summed"] == 8 and found["top"] == 8 * float(top)
    data = unpacked(found["data"], found["type"])
    assert (data == (255 if "rooted" in found else found["top"])).all()


@pytest.mark.parametrize("suffix", ["png", "pdf", "gif"])
def test_pictures_and_animations(suffix, capfd):
    for file in ("gallery.exr", "gallery.h5") if suffix == "gif" else ("gallery.h5", "depth.exr", MODEL):
        out = Path(f"picture.{suffix}")
        told(capfd, "show", file, "--out", out)
        if suffix == "pdf":
            assert out.read_bytes().startswith(b"%PDF")
        else:
            with Image.open(out) as image:
                assert image.size > (100, 100) and (suffix == "png" or image.n_frames > 3)


def test_a_film_needs_its_extra(capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # what an import of a missing package meets
    capfd.readouterr()
    assert main(["show", "gallery.h5", "--out", "film.mp4"]) == 2
    error = capfd.readouterr().err
    assert error == "scene2spad: film.mp4: needs a video encoder: pip install 'scene2spad[video]', or write a .gif\n"
    assert not Path("film.mp4").exists()


def test_a_film_that_the_encoder_leaves_cut_short_is_refused(capfd, monkeypatch):
    """As on a full disk, where the encoder ends without an error."""

    def takes_frames(path, size, **_):
        Path(path).write_bytes(b"cut short")
        while True:
            yield

    encoder = SimpleNamespace(write_frames=takes_frames, count_frames_and_secs=lambda path: (3, 0.24))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", encoder)
    capfd.readouterr()
    assert main(["show", "gallery.h5", "--out", "film.mp4"]) == 2
    assert capfd.readouterr().err == "scene2spad: film.mp4: could not be written whole; is the disk full?\n"
    assert not Path("film.mp4").exists()


def test_a_film_has_the_frames_of_the_gif(capfd):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    for suffix in ("gif", "mp4"):
        told(capfd, "show", "gallery.exr", "--out", f"film.{suffix}")
    with Image.open("film.gif") as image:
        size, count = tuple(length + length % 2 for length in image.size), image.n_frames
    film = ffmpeg.read_frames("film.mp4")
    assert tuple(next(film)["source_size"]) == size and sum(1 for _ in film) == count


def test_a_transient_beside_is_used_only_if_it_is_the_right_one(tmp_path, capfd):
    other = tmp_path / "gallery.exr"
    assert main(["render", "plane", "--width", "16", "--height", "12", "--bounces", "1", "--no-figure", "--out",
                 str(other)]) == 0  # fmt: skip
    (tmp_path / "gallery.h5").write_bytes(Path("gallery.h5").read_bytes())
    told(capfd, "show", tmp_path / "gallery.h5")
    assert payload(tmp_path / "gallery.histogram.html")["returns"] is None
    assert main(["show", "gallery.h5", "--transient", str(other)]) == 2
    assert "is not the transient" in capfd.readouterr().err
    assert main(["show", "gallery.h5", "--transient", "missing"]) == 2
    assert capfd.readouterr().err == "scene2spad: missing: file not found\n"


def test_pages_of_a_transient_and_of_its_histogram_do_not_overwrite_one_another(tmp_path, capfd):
    for name in ("gallery.exr", "gallery.h5"):
        (tmp_path / name).write_bytes(Path(name).read_bytes())
    written = [told(capfd, "show", tmp_path / name)["out"] for name in ("gallery.exr", "gallery.h5")]
    assert written == [str(tmp_path / f"gallery.{kind}.html") for kind in ("transient", "histogram")]
    assert all(PAGE_MARK in Path(one).read_bytes() for one in written)


def test_comparisons_are_one_table_and_one_figure(capfd):
    found = told(capfd, "compare", "gallery.h5", "--methods", "argmax", "log-matched", "fourier-16", "mine.npy", MODEL)
    assert [row["method"] for row in found["methods"]] == ["argmax", "log-matched", "fourier-16", "mine.npy", MODEL]
    assert all(row["mae_mm"] > 0 for row in found["methods"])
    assert len(Path(found["table"]).read_text().splitlines()) == 6 and Path(found["figure"]).is_file()


def test_codes_of_ones_own_are_those_of_the_same_name(capfd):
    assert main(["export", MODEL, "--out", "codes.npy"]) == 0
    from scene2spad import coding_tensor

    np.save("fourier.npy", coding_tensor("fourier", 16).temporal.numpy())
    own = told(capfd, "depth", "gallery.h5", "--method", "compressive", "--codes-file", "fourier.npy", "--no-figure")
    named = told(capfd, "depth", "gallery.h5", "--method", "compressive", "--codes", "16", "--no-figure")
    assert own["mae_mm"] == named["mae_mm"] and own["method"] == "fourier"


def test_dense_exports_are_read_back(capfd):
    histogram = read_histogram(Path("gallery.h5"))
    told(capfd, "export", "gallery.h5", "--out", "dense.npz")
    told(capfd, "export", "gallery.h5", "--out", "dense.h5", "--layout", "thw")
    with np.load("dense.npz") as arrays:
        assert np.array_equal(arrays["data"], histogram.counts)
        assert arrays["tofs"][3] == pytest.approx(3.5 * histogram.sensor.bin_width_s)
    with h5py.File("dense.h5") as file:
        assert np.array_equal(np.moveaxis(file["data"][:], 0, 2), histogram.counts)
        assert all({"unit", "description"} <= {*file[name].attrs} for name in file)
    told(capfd, "export", "gallery.exr", "--out", "light.npz")
    transient = read_transient(Path("gallery.exr"))
    with np.load("light.npz") as arrays:
        assert arrays["data"].sum(axis=2) == pytest.approx(transient.total_radiance(), rel=1e-5)


def test_points_lie_at_their_depth(capfd):
    found = told(capfd, "export", "depth.exr", "--out", "cloud.ply", "--intensity", "gallery.h5")
    depth_m, sure, _ = read_depth(Path("depth.exr"))
    points = trimesh.load("cloud.ply").vertices
    known = depth_m[np.isfinite(depth_m)]
    assert found["points"] == len(points) == known.size
    assert np.linalg.norm(points, axis=1) == pytest.approx(known, rel=1e-5)
    assert b"property float confidence" in Path("cloud.ply").read_bytes()[:400]
    held = np.frombuffer(Path("cloud.ply").read_bytes().partition(b"end_header\n")[2], COLUMNS)["confidence"]
    assert np.array_equal(held, sure[np.isfinite(depth_m)]) and 0 <= held.min() < held.max() <= 1
    told(capfd, "show", "depth.exr", "--out", "page.html")
    layers = {layer["name"]: unpacked(layer["data"], "<f4") for layer in payload(Path("page.html"))["layers"]}
    assert np.array_equal(layers["confidence"], sure.ravel(), equal_nan=True)


def test_an_intensity_of_another_histogram_is_warned_of(capfd):
    argv = ["export", "depth.exr", "--out", "lit.ply", "--intensity"]
    assert main([*argv, "gallery.h5"]) == 0 and "not the histogram" not in capfd.readouterr().err
    assert main(["sense", "gallery.exr", "--seed", "1", "--out", "others.h5", "--no-figure"]) == 0
    assert main([*argv, "others.h5"]) == 0
    assert "warning: others.h5: not the histogram that depth.exr was made from" in capfd.readouterr().err


@pytest.mark.parametrize("int8", [False, True])
def test_code_tables_hold_the_tensor(int8, capfd):
    told(capfd, "export", MODEL, "--out", "codes.txt", *(["--int8"] if int8 else []))
    lines = Path("codes.txt").read_text().splitlines()
    temporal = np.array([line.split() for line in lines[2:34]], float)
    from scene2spad import load_model

    truth = load_model(MODEL).layer.coding().temporal.numpy()
    if int8:
        step = float(lines[1].rsplit(" ", 1)[1])
        assert np.abs(temporal).max() <= 127 and temporal * step == pytest.approx(truth, abs=0.51 * step)
    else:
        assert temporal == pytest.approx(truth, abs=1e-6)


def test_integers_of_an_array_have_their_step_beside_them(tmp_path, capfd):
    out = tmp_path / "codes.npy"
    line = told(capfd, "export", MODEL, "--out", str(out), "--int8")
    step, whole = np.loadtxt(tmp_path / "codes.step.txt"), np.load(out)
    assert whole.dtype == np.int8 and line["step"] == pytest.approx(step, rel=1e-8)
    told(capfd, "export", MODEL, "--out", str(tmp_path / "exact.npy"))
    assert whole * step == pytest.approx(np.load(tmp_path / "exact.npy"), abs=1.1 * step)
    (tmp_path / "codes.step.txt").write_text("notes of mine")
    assert main(["export", MODEL, "--out", str(out), "--int8"]) == 2
    assert "codes.step.txt: exists and is no table of codes" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["show", "nothing.h5"], "file not found"),
        (["show", "nothing"], "nothing: file not found, and model 'nothing' is unknown"),
        (["show", "gallery.h5", "--out", "a.jpg"], "must end in .html"),
        (["show", "mine.npy", "--out", "a.gif"], "has nothing to play"),
        (["show", "set.h5", "--view", "7"], "no view 7"),
        (["show", "set/views"], "of no set and of no run"),
        (["compare", "gallery.h5", "--methods", "nosuch"], "'nosuch' is none of"),
        (["compare", "gallery.h5", "--methods", "argmax", "argmax"], "named twice"),
        (["compare", "gallery.h5", "--methods", "blocks.npy"], "blocks.npy: codes of blocks of 1024 bins x 4 rows"),
        (["compare", "gallery.h5", "--methods", "short.npy"], "short.npy: codes of blocks of 64 bins x 1 rows"),
        (["depth", "gallery.h5", "--codes-file", "mine.npy"], "--codes-file mine.npy is for --method compressive"),
        (["export", "gallery.h5", "--out", "a.txt"], "goes to .npz"),
        (["export", "mine.npy", "--out", "a.ply"], "goes to .txt"),
        (["export", "gallery.h5", "--out", "gallery.h5"], "is the input itself"),
    ],
)
def test_mistakes_are_one_line(argv, message, capfd):
    capfd.readouterr()
    assert main(argv) == 2
    error = capfd.readouterr().err
    assert message in error and len(error.splitlines()) == 1


def test_a_depth_map_is_no_transient_of_a_histogram(capfd):
    assert main(["show", "gallery.h5", "--transient", "depth.exr"]) == 2
    assert (
        "depth.exr: is of kind depth, expected the transient that gallery.h5 was sensed from" in capfd.readouterr().err
    )
