"""Counts and event lists of one's own: what is not them is refused in one line, what is not known stays unknown."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import scipy.io

from scenes.errors import InputError
from spad.estimators.depth import histogram_depth_m
from spad.formats.mat import read_mat, write_mat
from spad.measurements.histogram import Histogram, read_histogram, write_histogram
from spad.sensor.model import Sensor, check_dark_map
from spad.sensor.pulse import Pulse

SENSOR = Sensor(name="mine", bins=64, bin_width_s=1e-10, pulse=Pulse(1e-10))
COUNTS = np.random.default_rng(0).poisson(0.5, (3, 4, 64))
ZONES = {name: np.ones((3, 4)).tolist() for name in ("centre_x", "centre_y", "delay_s", "clock")} | {"chirp_hz": 0.0}


@pytest.mark.parametrize(
    ("counts", "meant"),
    [
        (np.ma.masked_less(COUNTS, 1), "counts are masked"),
        (np.zeros((0, 4, 64)), "counts are of 0 x 4 pixels, expected 1 or more"),
        (np.zeros((4, 0, 64)), "counts are of 4 x 0 pixels"),
        (np.full((2, 2, 64), 2_000_000_00), "counts of 1.28e+10 a pixel on average, the limit is 1e9"),
        (np.full((2, 2, 64), 2**31), "counts from 2.14748e+09 to 2.14748e+09, expected whole numbers"),
    ],
)
def test_what_is_no_counts_is_refused_in_its_own_words(counts, meant):
    with pytest.raises(InputError) as refused:
        Histogram.from_counts(counts, SENSOR)
    assert meant in str(refused.value) and "budget" not in str(refused.value)


def test_a_masked_array_without_a_masked_value_is_counts():
    assert (Histogram.from_counts(np.ma.array(COUNTS), SENSOR).counts == COUNTS).all()


@pytest.mark.parametrize(
    ("meta", "meant"),
    [
        ("text", "meta 'text', expected a dictionary"),
        (["a"], "expected a dictionary"),
        ({3: "x"}, "meta 3, expected text as a key"),
        *(({name: "x"}, f"meta '{name}' is a name of the file's own") for name in ("sensor", "budget", "kind")),
        ({"x": {1, 2}}, "meta hold what JSON cannot"),
        ({"transient": "bench 3"}, "meta 'transient': 'bench 3', expected a dictionary"),
        ({"transient": {"camera": {"fov_deg": 3.0}}}, "'camera': 'width': is missing"),
        ({"transient": {"laser": {"baseline_m": [0, "a", 0]}}}, "'baseline_m': 'a', expected a number"),
        ({"zones": 3}, "meta 'zones': 3, expected a dictionary"),
        ({"zones": {"chirp_hz": 0.0}}, "meta 'zones': 'centre_x' is missing"),
        ({"zones": ZONES | {"clock": [[1.0, 1.0]]}}, "meta 'zones': 'clock' is of shape (1, 2), expected"),
        ({"pile_up": None}, "meta 'pile_up': None, expected a number"),
        ({"model": 3}, "meta 'model': 3, expected text"),
        ({"plan": "x"}, "meta 'plan': 'x', expected a list of texts"),
        ({"seed": 1.5}, "meta 'seed': 1.5, expected a whole number"),
    ],
)
def test_metadata_that_commands_cannot_read_are_refused_where_they_are_given(meta, meant):
    with pytest.raises(InputError) as refused:
        Histogram.from_counts(COUNTS, SENSOR, meta)
    assert str(refused.value).startswith("histogram: meta") and meant in str(refused.value)


def test_metadata_come_back_as_they_were_given(tmp_path):
    meta = {"note": [1, None, "x"], "seed": 3, "plan": ["mine"], "dark_share": None, "pile_up": 0.2, "zones": ZONES}
    meta["transient"] = {"camera": {"fov_deg": 30.0, "width": 4, "height": 3}, "laser": {"baseline_m": [0, 0, 0]}}
    own = Histogram.from_counts(COUNTS, SENSOR, meta)
    write_histogram(own, tmp_path / "own.h5")
    read = read_histogram(tmp_path / "own.h5")
    assert {name: read.meta[name] for name in meta} == meta and np.isfinite(histogram_depth_m(read)).any()


def test_an_unknown_split_stays_unknown_in_the_published_layout(tmp_path):
    own = Histogram.from_counts(COUNTS, SENSOR)
    write_mat(own, tmp_path / "own.mat")
    held = scipy.io.loadmat(tmp_path / "own.mat")
    assert all(np.isnan(held[name]).all() for name in ("photons", "SBR", "mean_signal_photons"))
    read = read_mat(tmp_path / "own.mat")
    assert (read.counts == COUNTS).all() and read.budget == own.budget and not read.signal_known
    assert np.isnan(read.expected_signal).all() and np.isnan(read.expected_background).all()
    assert "how many are signal is unknown" in repr(read)


def test_masked_truth_is_unknown_and_masked_counts_are_refused(tmp_path):
    histogram = Histogram.from_counts(COUNTS, SENSOR)
    masked = np.ma.array(np.full((3, 4), 2.0), mask=np.eye(3, 4, dtype=bool))
    known = replace(histogram, depth_m=masked, mixed=np.ma.array(histogram.mixed))
    write_histogram(known, tmp_path / "known.h5")
    for depth_m in (known.depth_m, read_histogram(tmp_path / "known.h5").depth_m):
        assert not isinstance(depth_m, np.ma.MaskedArray)
        assert np.array_equal(depth_m, masked.filled(np.nan), equal_nan=True)
    for name in ("counts", "mixed"):
        given = np.ma.array(getattr(histogram, name), mask=True)
        with pytest.raises(InputError, match=f"histogram: {name} are masked, fill them first"):
            replace(histogram, **{name: given})
    with pytest.raises(InputError, match="dark count map is masked, fill it first"):
        check_dark_map(masked, (3, 4))


def test_a_list_of_detections_is_the_histogram_that_it_came_from():
    stamps, offsets = Histogram.from_counts(COUNTS, SENSOR).timestamps()
    shuffled = np.concatenate([part[::-1] for part in np.split(stamps, offsets[1:-1])])
    for events in (stamps, shuffled, stamps.astype(np.uint64), stamps.astype(float), stamps.tolist()):
        found = Histogram.from_timestamps(events, offsets, (3, 4), SENSOR, {"note": "bench"})
        assert (found.counts == COUNTS).all() and found.meta["note"] == "bench" and not found.signal_known
    assert Histogram.from_timestamps([], np.zeros(7, int), (2, 3), SENSOR).counts.sum() == 0


@pytest.mark.parametrize(
    ("stamps", "offsets", "shape", "meant"),
    [
        ([1, 64], [0, 1, 2], (1, 2), "stamps[1] is 64, expected a bin from 0 to 63"),
        ([-1, 6], [0, 1, 2], (1, 2), "stamps[0] is -1, expected a bin"),
        ([1.5, 6], [0, 1, 2], (1, 2), "stamps are no whole numbers"),
        ([np.nan, 6], [0, 1, 2], (1, 2), "stamps are no whole numbers"),
        ([np.inf, 6], [0, 1, 2], (1, 2), "stamps[0] is"),
        (["a", "b"], [0, 1, 2], (1, 2), "expected whole numbers of one dimension"),
        (np.ma.masked_equal([1, 2], 2), [0, 1, 2], (1, 2), "stamps are masked"),
        ([1, 6], [0, 1, 2], (2, 2), "offsets are (3,), expected (5,) for 4 pixels"),
        ([1, 6], [0, 1, 1], (1, 2), "offsets from 0 to 1 must rise from 0 to the 2 stamps"),
        ([1, 6], [0, 3, 2], (1, 2), "must rise"),
        ([1, 6], [0, 1, 2], (1, 2.0), "side of the image 2.0, expected a whole number"),
        ([1, 6], [0, 1, 2], 2, "shape 2, expected rows and columns"),
        ([], [0], (0, 2), "image of 0 x 2 pixels"),
    ],
)
def test_a_list_that_does_not_fit_is_refused_in_one_line(stamps, offsets, shape, meant):
    with pytest.raises(InputError) as refused:
        Histogram.from_timestamps(stamps, offsets, shape, SENSOR)
    assert str(refused.value).startswith("timestamps: ") and meant in str(refused.value)


def test_files_of_others_are_told_the_way_in(tmp_path):
    with h5py.File(tmp_path / "theirs.h5", "w") as file:
        file["counts"] = COUNTS
    scipy.io.savemat(tmp_path / "theirs.mat", {"counts": COUNTS})
    for name, read in (("theirs.h5", read_histogram), ("theirs.mat", read_mat)):
        with pytest.raises(InputError, match=rf"{name}: .*Histogram\.from_counts takes counts .*from_timestamps"):
            read(tmp_path / name)
