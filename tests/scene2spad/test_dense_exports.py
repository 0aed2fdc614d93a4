"""Dense arrays and points from Python and by `export`: light that wraps is told, and counts come back as they were."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh

import scene2spad as s2s
from scene2spad.cli import main
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.formats.dense_reader import read_dense_arrays

SENSOR = s2s.sensor_by_name("reference")


def relief(*depth_m: float) -> s2s.Transient:
    row = np.array([depth_m])
    return s2s.transient_from_rgbd(row, np.ones_like(row), np.ones_like(row))


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A gallery seen beside a displaced laser, its histogram, and that of zones."""
    folder = tmp_path_factory.mktemp("dense")
    size = ("--width", "16", "--height", "12", "--bounces", "1", "--baseline", "0.1", "0", "0", "--no-figure")
    assert main(["render", "gallery", *size, "--out", str(folder / "g.exr")]) == 0
    assert main(["render", "wall@50", *size[:6], "--no-figure", "--out", str(folder / "w50.exr")]) == 0
    assert main(["sense", str(folder / "g.exr"), "--no-figure", "--seed", "3"]) == 0
    zones = ["--sensor", "tmf8820", "--no-figure", "--out", str(folder / "zones.h5")]
    assert main(["render", "gallery", *size[:6], "--fov", "60", "--no-figure", "--out", str(folder / "wide.exr")]) == 0
    assert main(["sense", str(folder / "wide.exr"), *zones]) == 0
    return folder


@pytest.fixture(autouse=True)
def here(files, monkeypatch):
    monkeypatch.chdir(files)


def told(capfd, *argv: str) -> tuple[dict, str]:
    capfd.readouterr()
    assert main([*argv, "--json"]) == 0
    found = capfd.readouterr()
    return json.loads(found.out.splitlines()[-1]), found.err


def test_a_wall_beyond_the_range_is_said_to_wrap(capfd):
    """A wall at 50 m by a sensor of 14.99 m: all light wraps, and arrives at its time less whole periods."""
    found, err = told(capfd, "export", "w50.exr", "--out", "w50.npz")
    assert found["wrapped"] == pytest.approx(1.0)
    assert "warning: wrap: 100.000% of the signal arrives after the period of 14.990 m and wraps" in err
    with np.load("w50.npz") as arrays:
        assert arrays["wrapped"] == pytest.approx(1.0)
        late_s = (2 * arrays["depth_m"] / SPEED_OF_LIGHT_M_PER_S) % arrays["period_s"]
        peak_s = arrays["tofs"][arrays["data"].argmax(axis=2)]
        assert np.abs(peak_s - late_s).max() < 2e-9  # of 100 ns: a pixel of 2.5 degrees sees up to 0.5 m of depth
    with h5py.File(told(capfd, "export", "w50.exr", "--out", "w50.h5")[0]["out"]) as file:
        assert "one period of the laser" in file["tofs"].attrs["description"] and file["wrapped"][()] > 0.999
    assert "wrap" not in told(capfd, "export", "g.exr", "--out", "near.npz")[1]


def test_the_fraction_that_wraps_is_that_of_the_radiance():
    """Two pixels, one within the range and one beyond it; over more pixels than are binned at once."""
    transient = relief(*(2.0, 20.0) * 700)
    radiance = transient.total_radiance()[0, :2]
    arrays = s2s.dense(transient, SENSOR)
    assert float(arrays["wrapped"]) == pytest.approx(radiance[1] / radiance.sum(), rel=1e-6)
    assert "unrecorded" not in arrays
    assert float(s2s.dense(transient, replace(SENSOR, period_s=200e-9))["wrapped"]) == 0
    black = np.zeros((1, 2))
    assert float(s2s.dense(s2s.transient_from_rgbd(black + 2, black, black))["wrapped"]) == 0


def test_light_without_bins_is_told(capfd):
    """A record of a quarter of the period: the pixel at 10 m is outside it, the one at 2 m within."""
    short = replace(SENSOR, bins=256, period_s=SENSOR.period_s)
    transient = relief(2.0, 10.0)
    radiance = transient.total_radiance()[0]
    arrays = s2s.dense(transient, short)
    assert float(arrays["unrecorded"]) == pytest.approx(radiance[1] / radiance.sum(), rel=1e-6)
    text = (
        'name = "short"\n[histogram]\nbins = 64\nbin_width = "100 ps"\nperiod = "102.4 ns"\n[pulse]\nfwhm = "400 ps"\n'
    )
    Path("short.toml").write_text(text)
    found, err = told(capfd, "export", "w50.exr", "--out", "short.npz", "--sensor", "short.toml")
    assert found["unrecorded"] > 0.9 and "warning: record: " in err and "6.4 ns of a period of 102.4 ns" in err


def test_files_say_their_axes_and_units_and_keep_ambient_light():
    dark, lit = (replace(relief(2.0, 3.0), ambient=np.full((1, 2), level, np.float32)) for level in (0, 0.25))
    assert "ambient" not in s2s.dense(dark)
    arrays = s2s.dense(lit, "swissspad3")
    for layout, axes in (("hwt", "row, column, time"), ("thw", "time, row, column")):
        s2s.write_dense(arrays, Path("a.npz"), layout=layout)
        s2s.write_dense(arrays, "a.h5", layout=layout)
        with np.load("a.npz") as file, h5py.File("a.h5") as other:
            units = json.loads(str(file["units"]))
            assert str(file["axes"]) == other.attrs["axes"] == axes
            assert units["ambient"] == "W/(m^2 sr nm)" and units["data"] == "1/(m^2 sr)" and units["tofs"] == "s"
            assert units.keys() == {*file.files} - {"axes", "units"} == {*other}
            assert (file["ambient"] == 0.25).all() and (other["ambient"][()] == 0.25).all()
            assert json.loads(str(file["sensor"]))["name"] == "swissspad3"


@pytest.mark.parametrize("source", ["g.h5", "zones.h5"])
@pytest.mark.parametrize("out", ["back.npz", "back.h5", "back-thw.npz", "back-thw.h5"])
def test_counts_come_back_with_all_that_was_known(source, out, capfd):
    told(capfd, "export", source, "--out", out, "--layout", "thw" if "thw" in out else "hwt")
    histogram, back = s2s.read_histogram(source), s2s.read_dense(out)
    assert back.sha256() == histogram.sha256()
    assert (back.sensor, back.budget, back.meta) == (histogram.sensor, histogram.budget, histogram.meta)


def test_depth_of_dense_counts_is_that_of_their_histogram(capfd):
    """Beside a displaced laser, whose place only the metadata tell; compare takes them as well."""
    told(capfd, "export", "g.h5", "--out", "counts.h5", "--layout", "thw")
    given, of_histogram = (told(capfd, "depth", name, "--no-figure")[0] for name in ("counts.h5", "g.h5"))
    assert {**given, "seconds": 0, "out": ""} == {**of_histogram, "seconds": 0, "out": ""}
    one, other = (Path(found["out"]).read_bytes() for found in (given, of_histogram))
    assert one == other
    assert [row["mae_mm"] for row in told(capfd, "compare", "counts.h5", "--methods", "argmax")[0]["methods"]] == [
        row["mae_mm"] for row in told(capfd, "compare", "g.h5", "--methods", "argmax")[0]["methods"]
    ]


def test_measured_counts_come_back():
    counts = np.random.default_rng(1).integers(0, 5, (2, 3, 1024))
    histogram = s2s.Histogram.from_counts(counts, SENSOR)
    arrays = s2s.dense(histogram)
    assert not any(arrays[name].flags.writeable for name in ("data", "depth_m", "mixed", "expected_signal"))
    assert "wrapped" not in arrays  # nobody knows it
    back = s2s.read_dense(s2s.write_dense(arrays, "measured.npz"))
    assert back.sha256() == histogram.sha256() and not back.signal_known


def refused(capfd, path: str) -> str:
    capfd.readouterr()
    assert main(["depth", path]) == 2
    err = capfd.readouterr().err
    assert path in err and err.count("\n") == 1
    return err


def test_dense_arrays_that_are_no_histogram_are_refused(capfd):
    s2s.write_dense(s2s.dense(relief(2.0, 3.0)), "light.npz")
    s2s.write_dense(s2s.dense(relief(2.0, 3.0)), "light.h5")
    for name in ("light.npz", "light.h5"):
        assert "holds light, expected counts; sense the transient" in refused(capfd, name)
    histogram = s2s.read_histogram(Path("g.h5"))
    arrays = s2s.dense(histogram)
    for name in ("older.npz", "older.h5"):
        s2s.write_dense({key: arrays[key] for key in arrays if key not in ("sensor", "meta")}, name)
        err = refused(capfd, name)
        assert "does not hold sensor, meta" in err and "Histogram.from_counts" in err
    changes = {
        "bins.npz": {"sensor": np.array(json.dumps(replace(SENSOR, bins=8, period_s=None).to_dict()))},
        "width.npz": {"bin_width_s": np.array(1e-9)},
        "list.npz": {"sensor": np.array("[1]")},
        "word.npz": {"sensor": np.array("{")},
        "empty.npz": {"meta": np.array("{}")},
        "field.npz": {"sensor": np.array('{"pulse": 3}')},
        "below.npz": {"data": -1 - arrays["data"]},
        "above.npz": {"data": arrays["data"].astype(np.int64) + (1 << 32)},
        "truth.npz": {"mixed": arrays["mixed"][:2]},
    }
    for name, change in changes.items():
        s2s.write_dense(arrays | change, name)
        refused(capfd, name)
    text = Path("back.npz")
    np.savez(text, **arrays | {"sensor": np.ones(3)}, axes=np.array("row, column, time"))
    assert "sensor holds float64, expected text" in refused(capfd, "back.npz")
    Path("cut.npz").write_bytes(Path("light.npz").read_bytes()[:-40])
    Path("cut.h5").write_bytes(Path("light.h5").read_bytes()[:-400])
    for name in ("cut.npz", "cut.h5"):
        refused(capfd, name)


def test_reading_damaged_files_ends_in_one_line():
    """Single bytes are changed everywhere in turn: what is read is what was written, or is refused."""
    histogram = s2s.sense(relief(2.0, 3.0), signal=20, background=2, sensor=s2s.Sensor(bins=64))
    for name in ("whole.npz", "whole.h5"):
        whole = s2s.write_dense(s2s.dense(histogram), name).read_bytes()
        rng = np.random.default_rng(7)
        for place in rng.choice(len(whole), 60, replace=False):
            broken = bytearray(whole)
            broken[place] ^= int(rng.integers(1, 256))
            Path(f"broken{Path(name).suffix}").write_bytes(broken)
            try:
                s2s.read_dense(f"broken{Path(name).suffix}")
            except s2s.InputError as error:
                assert "\n" not in str(error) and "broken" in str(error)


@pytest.mark.parametrize(("offset", "damage"), [(6, b"\x63"), (8, b"\x00\x08"), (46, b"\xff")])
def test_damaged_directories_of_archives_are_one_line(tmp_path, capfd, offset, damage):
    """Damage the version that is needed, the flag of names in UTF-8, and a name."""
    np.savez(tmp_path / "bad.npz", däta=np.ones(3))
    content = bytearray((tmp_path / "bad.npz").read_bytes())
    start = content.rindex(b"PK\x01\x02") + offset
    content[start : start + len(damage)] = damage
    (tmp_path / "bad.npz").write_bytes(content)
    for argv in (["inspect", str(tmp_path / "bad.npz")], ["export", "g.h5", "--out", str(tmp_path / "bad.npz")]):
        assert main(argv) == 2
        message = capfd.readouterr().err
        assert "bad.npz: " in message and message.count("\n") == 1
    assert (tmp_path / "bad.npz").read_bytes() == content


def test_time_first_is_told_by_the_file_where_sizes_do_not():
    """As many columns and rows as bins: only `axes` says which is time."""
    counts = np.random.default_rng(2).integers(0, 5, (8, 8, 8))
    histogram = s2s.Histogram.from_counts(counts, s2s.Sensor(bins=8))
    s2s.write_dense(s2s.dense(histogram), "cube.npz", layout="thw")
    assert (s2s.read_dense("cube.npz").counts == counts).all()
    arrays, text = read_dense_arrays(Path("cube.npz"))
    assert text["axes"] == "time, row, column" and (np.moveaxis(arrays["data"], 0, 2) == counts).all()


def test_points_lie_at_the_depth_that_is_given():
    transient, histogram = s2s.read_transient("g.exr"), s2s.read_histogram("g.h5")
    points = s2s.points(transient)
    assert np.linalg.norm(points, axis=-1) == pytest.approx(transient.depth_m, rel=1e-6, nan_ok=True)
    depth_m = s2s.estimate_depth(histogram)
    depth_m[0, 0] = np.nan
    found = s2s.points(histogram, depth_m)
    assert np.linalg.norm(found, axis=-1) == pytest.approx(depth_m, rel=1e-6, nan_ok=True)
    photons = histogram.counts.sum(axis=2)
    s2s.write_ply(found, "cloud.ply", intensity=photons / photons.max())
    read = trimesh.load("cloud.ply").vertices
    known = np.isfinite(depth_m)
    assert not known[0, 0] and read == pytest.approx(found[known], rel=1e-6)
    near = np.ma.masked_where(np.broadcast_to(~(depth_m < 4)[..., None], found.shape), found)
    s2s.write_ply(near, "near.ply")
    assert trimesh.load("near.ply").vertices == pytest.approx(found[depth_m < 4], rel=1e-6)
    assert main(["show", "cloud.ply", "--out", "cloud.html"]) == 0
    assert s2s.points(s2s.read_histogram("zones.h5")).shape[2] == 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t, h: s2s.dense(3), "dense: expected a Transient or a Histogram, not int"),
        (lambda t, h: s2s.dense(h, SENSOR), "dense: a histogram has a sensor of its own"),
        (lambda t, h: s2s.dense(t, "tmf8820"), "tmf8820 has zones"),
        (lambda t, h: s2s.dense(t, "reference-tdc"), r"a dense transient: the converters .* of reference-tdc"),
        (lambda t, h: s2s.dense(replace(h, meta={"a": object()})), "dense: the metadata hold what JSON cannot"),
        (lambda t, h: s2s.write_dense(h, "a.npz"), "write_dense: expected a dict of `dense`, not Histogram"),
        (lambda t, h: s2s.write_dense({"weights": np.ones(3)}, "a.npz"), "a.npz: weights is no array of `dense`"),
        (lambda t, h: s2s.write_dense({"tofs": np.ones(3)}, "a.npz"), r"a.npz: expected data \(H, W, T\)"),
        (lambda t, h: s2s.write_dense(s2s.dense(h), "a.csv"), "a.csv: a dense export ends in .npz or .h5"),
        (lambda t, h: s2s.write_dense(s2s.dense(h), "a.npz", layout="twh"), "layout 'twh' is unknown, .* hwt, thw"),
        (lambda t, h: s2s.write_dense(s2s.dense(h), 3), "write_dense: expected a path, not int"),
        (lambda t, h: s2s.read_dense(3), "read_dense: expected a path, not int"),
        (lambda t, h: s2s.read_dense("nosuch.npz"), "nosuch.npz: dense array not found"),
        (lambda t, h: s2s.points(3), "points: expected a Transient or a Histogram, not int"),
        (
            lambda t, h: s2s.points(t, np.ones((2, 2))),
            r"depth_m is float64\(2, 2\), expected numbers \(12, 16\)",
        ),
        (lambda t, h: s2s.points(t, "x"), "points: depth_m is <U1"),
        (lambda t, h: s2s.points(h, -h.depth_m), r"points: depth_m: a depth of -[\d.]+ m, expected 0 or more, or none"),
        (lambda t, h: s2s.points(s2s.Histogram.from_counts(h.counts, SENSOR)), "points: does not say which camera"),
        (lambda t, h: s2s.write_ply(np.ones((2, 2)), "a.ply"), r"a.ply: points are float64\(2, 2\)"),
        (lambda t, h: s2s.write_ply(np.full((2, 3), np.nan), "a.ply"), "a.ply: none of 2 points is known"),
        (lambda t, h: s2s.write_ply(np.ma.masked_all((2, 3)), "a.ply"), "a.ply: none of 2 points is known"),
        (lambda t, h: s2s.estimate_depth(h, np.ones((8, 1024))), "depth method of type ndarray: expected a name"),
        (lambda t, h: s2s.write_ply(np.ones((0, 3)), "a.ply"), "a.ply: none of 0 points is known"),
        (
            lambda t, h: s2s.write_ply(np.ones((2, 3)), "a.ply", intensity=np.array([0, 40])),
            "a.ply: intensity is from 0 to 40, expected 0 to 1",
        ),
        (lambda t, h: s2s.read_mat("."), "is a folder, expected a file"),
        (lambda t, h: s2s.write_ply(np.ones((2, 3)), "a.obj"), "a.obj: a point cloud ends in .ply"),
        (lambda t, h: s2s.write_ply(np.ones((2, 3)), "a.ply", intensity=np.ones(3)), r"intensity is float64\(3,\)"),
        (lambda t, h: s2s.write_ply(np.ones((2, 3)), 3), "write_ply: expected a path, not int"),
    ],
)
def test_mistakes_are_one_line(call, message):
    with pytest.raises(s2s.InputError, match=message) as caught:
        call(s2s.read_transient("g.exr"), s2s.read_histogram("g.h5"))
    assert "\n" not in str(caught.value)
