"""MATLAB files: what is sound reads as scipy reads it, what states more than it holds never reaches scipy."""

import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from test_rgbd import made

from scenes import InputError
from spad.detection.detect import sense
from spad.estimators.depth import histogram_depth_m
from spad.formats.linospad import read_linospad
from spad.formats.mat import pile_up_warning, read_mat, write_mat
from spad.formats.matfile import checked_contents, load_mat, save_mat
from spad.formats.rgbd import published_taps, transient_from_rgbd
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse, SampledPulse
from spad.sensor.zone_array import ZoneArray
from spad.sensor_names import sensor_by_name
from spad.zones.histogram import sense_zones, with_budget

BRIGHT = PhotonBudget(20_000, 100)


def saved(path: Path, compressed: bool = False, **variables) -> Path:
    scipy.io.savemat(path, variables, do_compression=compressed)
    return path


@pytest.mark.parametrize("compressed", [False, True])
def test_every_class_that_we_read_comes_as_from_scipy(compressed, tmp_path):
    cell = np.empty((1, 2), object)
    cell[0, 0], cell[0, 1] = scipy.sparse.csc_matrix(np.eye(3)), np.zeros((0, 4))
    variables = {
        "a": np.arange(6.0).reshape(2, 3), "b": np.uint16([1, 2, 3]), "c": "text", "d": {"x": 1, "y": np.eye(2)},
        "e": scipy.sparse.csc_matrix(np.diag([1.0, 0, 2])), "f": 1 + 2j * np.ones(2), "g": cell, "h": np.array([True]),
    }  # fmt: skip
    path = saved(tmp_path / "a.mat", compressed, **variables)
    expected, found = scipy.io.loadmat(path), load_mat(path)
    assert found.keys() == variables.keys()
    for name in "abcfh":
        assert np.array_equal(found[name], expected[name]) and found[name].dtype == expected[name].dtype
    assert (found["e"].todense() == np.diag([1.0, 0, 2])).all() and (found["g"][0, 0].todense() == np.eye(3)).all()
    assert found["d"][0, 0]["y"].shape == (2, 2) and list(load_mat(path, ["a"])) == ["a"]


def sparse_with(tmp_path: Path, old: tuple[int, ...], new: tuple[int, ...], compressed: bool) -> Path:
    """A sparse (3, 2) matrix whose int32 indices `old` are replaced, its compressed stream made anew."""
    path = saved(tmp_path / "s.mat", spad=scipy.sparse.csc_matrix(np.array([[1.0, 0], [2, 0], [0, 3]])))
    data = path.read_bytes()
    before, after = (np.array(values, "<i4").tobytes() for values in (old, new))
    assert data.count(before) == 1
    data = data.replace(before, after)
    if compressed:
        body = zlib.compress(data[128:])
        data = data[:128] + struct.pack("<II", 15, len(body)) + body
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("index", [3, 1 << 30, -1])
def test_sparse_indices_out_of_range_are_refused(index, compressed, tmp_path):
    """They ended the process by a segmentation fault, or lost photons in silence."""
    with pytest.raises(InputError, match=r"s\.mat: .*row index is outside 0 to 2"):
        load_mat(sparse_with(tmp_path, (0, 1, 2), (0, 1, index), compressed))


@pytest.mark.parametrize("starts", [(0, 3, 2), (1, 2, 3), (0, 2, 9), (0, -1, 3)])
def test_column_starts_that_do_not_rise_to_their_number_are_refused(starts, tmp_path):
    with pytest.raises(InputError, match="column starts"):
        load_mat(sparse_with(tmp_path, (0, 2, 3), starts, compressed=True))


def test_declared_sizes_are_compared_with_the_bytes(tmp_path, monkeypatch):
    path = saved(tmp_path / "a.mat", a=np.zeros((5, 7)))
    data = path.read_bytes()
    shape = np.array((5, 7), "<i4").tobytes()
    for other in ((5, 8), (1 << 20, 1 << 10), (-5, 7)):
        path.write_bytes(data.replace(shape, np.array(other, "<i4").tobytes()))
        with pytest.raises(InputError, match="dimensions"):
            load_mat(path)
    monkeypatch.setenv("SCENE2SPAD_MEMORY_GB", "0.01")
    bomb = zlib.compress(bytes(1 << 25))
    path.write_bytes(data[:128] + struct.pack("<II", 15, len(bomb)) + bomb)
    with pytest.raises(InputError, match="memory"):
        load_mat(path)


def test_versions_and_cells_without_end_are_named(tmp_path):
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(InputError, match=r"version 7\.3; save it again with -v7"):
        read_linospad(tmp_path / "new.mat")
    value: object = 1
    for _ in range(40):
        cell = np.empty((1, 1), object)
        cell[0, 0] = value
        value = cell
    with pytest.raises(InputError, match="nested"):
        checked_contents(saved(tmp_path / "deep.mat", x=value).read_bytes())


# --- The published loaders -------------------------------------------------------------------------------------------


def empty_in_places(histogram: Histogram) -> Histogram:
    counts = histogram.counts.copy()
    counts[0, :3] = 0
    return replace(histogram, counts=counts)


def test_no_exported_bin_is_zero_also_where_nothing_was_detected(tmp_path):
    """Published loaders subtract 1 from uint16 bins: a 0 becomes 65535, an IndexError or the next frame in silence."""
    histogram = empty_in_places(made())
    write_mat(histogram, tmp_path / "f.mat")
    frame = load_mat(tmp_path / "f.mat")
    for name in ("bin", "range_bins", "est_range_bins_argmax", "est_range_bins_lmf", "est_range_bins_zncc"):
        index = frame[name] - np.uint16(1)
        assert index.dtype == np.uint16 and index.max() < histogram.sensor.bins, name
    counts = np.asarray(frame["spad"].todense()).reshape(7, 5, -1).swapaxes(0, 1)
    some = counts.any(axis=-1)
    assert (frame["est_range_bins_argmax"][some] == counts.argmax(axis=-1)[some] + 1).mean() > 0.95


@pytest.mark.parametrize("name", ["reference", "iccv2023-train"])
def test_bin_is_the_fullest_bin_of_the_pulse(name, tmp_path):
    """With a measured, lopsided pulse it stood a bin behind in two thirds of the pixels."""
    sensor = sensor_by_name(name)
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 11, (24, 32))
    image = np.ones(depth.shape)
    histogram = sense(transient_from_rgbd(depth, image, image), sensor, PhotonBudget(100, 10), seed=0)
    write_mat(histogram, tmp_path / "f.mat")
    frame = load_mat(tmp_path / "f.mat")
    assert (frame["bin"] == frame["rates"].argmax(axis=-1) + 1).all()
    assert np.abs(frame["bin_hr"] - frame["bin"]).max() <= 1.01
    assert abs(float((frame["bin_hr"] - frame["bin"]).mean())) < 0.05


@pytest.mark.parametrize("name", ["reference", "iccv2023-train"])
def test_exported_estimates_are_bins_of_the_peak_as_the_truth_is(name, tmp_path):
    """With the lopsided pulse they were bins of the centroid, one behind."""
    depth = np.random.default_rng(0).uniform(2, 8, (16, 16))
    image = np.ones(depth.shape)
    sensor = replace(sensor_by_name(name), dark_count_rate_hz=0.0)
    histogram = sense(transient_from_rgbd(depth, image, image), sensor, PhotonBudget(3000, 1), seed=0)
    write_mat(histogram, tmp_path / "f.mat")
    frame = load_mat(tmp_path / "f.mat")
    assert (frame["est_range_bins_argmax"] == histogram.counts.argmax(axis=-1) + 1).all()
    for estimate in ("argmax", "lmf", "zncc"):
        behind = frame[f"est_range_bins_{estimate}"].astype(int) - frame["bin"]
        # whole bins: an answer is off by one at most, and by less than half a bin on average
        assert np.abs(behind).max() <= 1 and abs(behind.mean()) < 0.5, estimate


def test_the_pulse_of_another_sensor_is_not_overwritten(tmp_path):
    write_mat(made(), tmp_path / "a.mat")
    write_mat(made(), tmp_path / "b.mat")
    other = replace(made(), sensor=Sensor(pulse=sensor_by_name("linospad").pulse))
    with pytest.raises(InputError, match=r"PSF.*holds the pulse of another sensor"):
        write_mat(other, tmp_path / "c.mat")
    assert not (tmp_path / "c.mat").exists()
    assert (read_mat(tmp_path / "a.mat").counts == made().counts).all()


@pytest.mark.parametrize("name", ["reference", "iccv2023-train"])
def test_an_exported_frame_comes_back_with_its_sensor(name, tmp_path):
    """The pulse lies beside the frame: a measured one was read as the reference Gaussian, 1 to 8 mm off."""
    sensor = sensor_by_name(name)
    histogram = sensed(replace(sensor, dark_count_rate_hz=0.0))
    write_mat(histogram, tmp_path / "f.mat")
    again = read_mat(tmp_path / "f.mat")
    same = (again.sensor.bins, again.sensor.bin_width_s, again.sensor.response)
    assert same == (sensor.bins, sensor.bin_width_s, sensor.response)
    next(tmp_path.glob("PSF*")).unlink()
    assert read_mat(tmp_path / "f.mat").sensor.pulse == Sensor().pulse


@pytest.mark.parametrize("bins", [2, 16])
def test_a_frame_of_few_bins_is_read_back(bins, tmp_path):
    """Too few bins for the taps of the pulse that published frames have: the frame's pulse is another one."""
    sensor = Sensor(bins=bins, bin_width_s=50e-12, pulse=Pulse(5e-12))
    histogram = Histogram.from_counts(np.arange(6 * bins).reshape(2, 3, bins), sensor)
    write_mat(histogram, tmp_path / "few.mat")
    again = read_mat(tmp_path / "few.mat")
    assert np.array_equal(again.counts, histogram.counts) and again.sensor.pulse.std_s < 50e-12


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dist", math.inf), ("dist", -1.0), ("dist", 1e300), ("intensity", 1e9), ("photons", math.nan),
        ("photons", -1.0), ("bin_size", math.nan), ("bin_size", -1e-10), ("mean_background_photons", math.inf),
        ("spad", math.nan), ("spad", 0.5), ("spad", -1.0), ("spad", 1e300),
    ],
)  # fmt: skip
def test_numbers_that_no_frame_has_are_refused_in_one_line(name, value, tmp_path):
    write_mat(sensed(Sensor()), tmp_path / "f.mat")
    contents = scipy.io.loadmat(tmp_path / "f.mat")
    array = contents[name].toarray() if scipy.sparse.issparse(contents[name]) else contents[name].astype(float)
    array.flat[0] = value
    saved(tmp_path / "f.mat", **{key: array if key == name else contents[key] for key in contents if key[0] != "_"})
    with np.errstate(over="ignore"), pytest.raises(InputError, match=r"^[^\n]*f\.mat: [^\n]*$"):
        read_mat(tmp_path / "f.mat")


def test_pile_up_of_a_frame_is_not_undone_with_a_made_up_exposure(tmp_path):
    sensor = Sensor(bins=200, bin_width_s=5e-10, exposure_s=1e-3)
    wall = transient_from_rgbd(np.full((4, 4), 3.0), np.ones((4, 4)), np.ones((4, 4)))
    strong, weak = (sense(wall, sensor, PhotonBudget(photons, 10)) for photons in (3000, 5))
    assert "holds no exposure" in pile_up_warning(strong) and pile_up_warning(weak) is None
    write_mat(strong, tmp_path / "strong.mat")
    read = read_mat(tmp_path / "strong.mat")
    with pytest.raises(InputError, match=r"coates: a .mat file holds no exposure.* Histogram.from_counts"):
        histogram_depth_m(read, "coates")
    around = histogram_depth_m(Histogram.from_counts(read.counts, sensor), "coates")
    assert np.array_equal(around, histogram_depth_m(strong, "coates"), equal_nan=True)


@pytest.mark.parametrize("frame", [1.0, "1", True])
def test_a_frame_that_is_no_whole_number_is_refused(frame, tmp_path):
    with pytest.raises(InputError, match=r"frame .* expected a whole number"):
        read_mat(tmp_path / "capture.mat", frame)


def test_a_pulse_that_is_no_preset_is_read_by_its_taps(tmp_path):
    slow = Pulse(300e-12, 400e-12)
    histogram = sensed(Sensor(pulse=slow))
    write_mat(histogram, tmp_path / "f.mat")
    again = read_mat(tmp_path / "f.mat")
    assert isinstance(again.sensor.pulse, SampledPulse)
    # its bins blur it once more, by a twelfth of a bin squared
    assert again.sensor.pulse.std_s == pytest.approx(math.hypot(slow.std_s, Sensor().bin_width_s / 6**0.5), rel=0.01)
    medians = []
    for read in (again, replace(again, sensor=Sensor())):
        error = histogram_depth_m(read, "matched") - read.depth_m
        medians.append(abs(float(np.median(error))) * 1e3)
    assert medians[0] < 1 and medians[1] > 15  # mm


def test_the_published_taps_of_the_reference_pulse_are_the_reference(tmp_path):
    write_mat(made(), tmp_path / "f.mat")
    pulse = next(tmp_path.glob("PSF*"))
    scipy.io.savemat(pulse, {"psf": published_taps(Sensor())})
    assert read_mat(tmp_path / "f.mat").sensor.pulse == Sensor().pulse
    for taps in (np.zeros(5), np.full(5, np.nan), np.ones(2000), np.zeros(0)):
        scipy.io.savemat(pulse, {"psf": taps})
        with pytest.raises(InputError, match=r"PSF_used_for_simulation_nr-5_nc-7\.mat: holds no pulse of 1 to 1024"):
            read_mat(tmp_path / "f.mat")


def sensed(sensor: Sensor) -> Histogram:
    """An image of 24 x 32 depths with 1,000 photons each."""
    depth = np.random.default_rng(0).uniform(0.5, 11, (24, 32))
    image = np.ones(depth.shape)
    return sense(transient_from_rgbd(depth, image, image), sensor, PhotonBudget(1000, 1), seed=0)


def test_a_laser_beside_the_camera_is_refused(tmp_path):
    """The layout's rates and bins are of twice the depth, where its light does not arrive."""
    histogram = sensed(Sensor())
    beside = {"laser": {"baseline_m": [0.1, 0.0, -0.02]}}
    displaced = replace(histogram, meta={**histogram.meta, "transient": beside})
    with pytest.raises(InputError, match=r"f\.mat: the layout knows no laser beside .* is at 100 0 -20 mm"):
        write_mat(displaced, tmp_path / "f.mat")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("late", [{"delay_s": (3e-9, 0.0)}, {"clock": (1.0, 1.02)}, {"chirp_hz": 1e5}, {}], ids=str)
def test_zones_that_measure_other_times_are_refused(late, tmp_path):
    """The layout's bin is of twice the depth: a delay of 3 ns had put it 30 bins from the return."""
    plane = np.full((16, 16), 3.0)
    wall = transient_from_rgbd(plane, plane, plane, meta={"camera": {"fov_deg": 60.0}})
    sensor = Sensor(name="two", bins=512, bin_width_s=1e-10, pulse=Pulse(2e-10))
    two = with_budget(ZoneArray((-0.2, 0.2), (0.0,) * 2, (0.3,) * 2, (0.5,) * 2, **late), wall, sensor, BRIGHT)
    histogram = sense_zones(wall, sensor, two, seed=1)
    if late:
        with pytest.raises(InputError, match=r"f\.mat: the layout knows no zones whose converters measure other times"):
            write_mat(histogram, tmp_path / "f.mat")
        assert not [*tmp_path.iterdir()]
        return
    write_mat(histogram, tmp_path / "f.mat")
    frame = load_mat(tmp_path / "f.mat")
    assert np.abs(frame["bin"].astype(int) - frame["est_range_bins_lmf"]).max() <= 1


def test_the_same_data_give_the_same_bytes_whenever_they_are_written(tmp_path, monkeypatch):
    """scipy's header tells the time and the system."""
    save_mat({"a": np.arange(3.0)}, tmp_path / "a.mat")
    monkeypatch.setattr("time.asctime", lambda *_: "another day")
    save_mat({"a": np.arange(3.0)}, tmp_path / "b.mat")
    data = (tmp_path / "a.mat").read_bytes()
    assert data == (tmp_path / "b.mat").read_bytes()
    assert data[:19] == b"MATLAB 5.0 MAT-file" and data[124:128] == b"\x00\x01IM"
    assert (load_mat(tmp_path / "b.mat")["a"].ravel() == np.arange(3.0)).all()


def test_a_pulse_of_another_size_is_said_not_to_be_taken(tmp_path, caplog):
    write_mat(made(), tmp_path / "f.mat")
    pulse = next(tmp_path.glob("PSF*"))
    read_mat(tmp_path / "f.mat")
    assert not caplog.records
    pulse.rename(pulse.with_name("PSF_used_for_simulation_nr-9_nc-9.mat"))
    read_mat(tmp_path / "f.mat")
    assert "reference pulse is taken; of other sizes: PSF_used_for_simulation_nr-9_nc-9.mat" in caplog.text
