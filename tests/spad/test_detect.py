"""Detections follow Poisson's law, are seeded, and survive their file."""

import json
import warnings
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from scipy import stats
from test_flux import transient_of

from scenes import InputError
from scenes.io.hdf5 import add_checksum
from spad.detection.detect import expected_in_pixel, sense
from spad.detection.flux import expected_counts
from spad.detection.rates import fill_background, rates_for
from spad.measurements.histogram import Histogram, read_histogram, write_histogram
from spad.measurements.timestamps import counts_from_timestamps
from spad.sensor.model import PhotonBudget, Sensor

REFERENCE = Sensor()


def row_of_walls(pixels: int = 512):
    """An image row of pixels that all see the same direct return and one late one."""
    transient = transient_of(*[[(4.0, 4.02, 1.0), (5.0, 5.4, 0.3)]] * pixels)
    return replace(transient, ambient=np.ones((1, pixels), np.float32))


def test_counts_are_poisson_in_every_bin():
    """512 pixels with equal rates: dispersion and chi-square of every bin, Sidak-corrected over the bins looked at."""
    transient, budget = row_of_walls(), PhotonBudget(40, 60)
    counts = sense(transient, REFERENCE, budget, seed=7).counts[0].astype(float)
    rate = expected_in_pixel(transient, REFERENCE, budget, 0, 0)
    pixels = len(counts)
    # index of dispersion: (n - 1) s^2 / rate is chi-square with n - 1 degrees of freedom only for large rates;
    # summed over many bins the central limit holds: var of (x - rate)^2 is rate + 2 rate^2
    squared = ((counts - rate) ** 2).sum()
    expected, variance = pixels * rate.sum(), pixels * (rate + 2 * rate**2).sum()
    assert abs(squared - expected) < 4 * np.sqrt(variance)
    # each bin's total is Poisson with mean n rate: two-sided exact tests, Sidak-corrected to 0.1 % in all
    total = counts.sum(axis=0)
    tail = np.minimum(stats.poisson.cdf(total, pixels * rate), stats.poisson.sf(total - 1, pixels * rate))
    assert (2 * tail).min() > 1 - (1 - 1e-3) ** (1 / len(rate))
    # chi-square of the values 0, 1, 2, ... in the fullest bins
    fullest = np.argsort(rate)[-8:]
    for time_bin in fullest:
        edges = stats.poisson.ppf([0.1, 0.3, 0.5, 0.7, 0.9], rate[time_bin])
        edges = np.unique(edges)
        fractions = np.diff(np.concatenate(([0], stats.poisson.cdf(edges, rate[time_bin]), [1])))
        seen = np.bincount(np.searchsorted(edges, counts[:, time_bin]), minlength=len(fractions))
        assert stats.chisquare(seen, fractions * pixels).pvalue > 1e-3 / len(fullest)


def test_mean_counts_are_as_asked():
    histogram = sense(row_of_walls(), REFERENCE, PhotonBudget(40, 60), seed=1)
    assert abs(histogram.counts.sum() - 512 * 100) < 4 * np.sqrt(512 * 100)
    assert histogram.expected_signal.mean() == pytest.approx(40, rel=1e-6)
    assert histogram.expected_background.mean() == pytest.approx(60, rel=1e-6)


def test_same_seed_same_bytes_with_one_and_two_threads():
    threads, hashes = torch.get_num_threads(), set()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            hashes.add(sense(row_of_walls(2048), REFERENCE, PhotonBudget(40, 60), seed=3).sha256())
    finally:
        torch.set_num_threads(threads)
    assert len(hashes) == 1
    assert sense(row_of_walls(2048), REFERENCE, PhotonBudget(40, 60), seed=4).sha256() not in hashes


def test_plan_reports_pile_up_wrap_and_dark_counts():
    dark = replace(REFERENCE, dark_count_rate_hz=300.0)
    meta = sense(transient_of([(31.0, 31.0, 1.0)]), dark, PhotonBudget(1e4, 20)).meta
    assert meta["wrapped"] == pytest.approx(1) and meta["dark_share"] == pytest.approx(0.5)
    assert meta["pile_up"] == pytest.approx(10020 / dark.cycles, rel=1e-6)
    assert any("pile-up" in reason for reason in meta["plan"]) and any("wraps" in reason for reason in meta["plan"])
    with pytest.raises(InputError, match="model"):
        sense(transient_of([(1, 1, 1.0)]), REFERENCE, PhotonBudget(), model="magic")


def test_plan_names_what_there_is():
    """No ambient light where the scene has none, no drawn hot pixels beside a measured map, and dead ones do not count
    as light that arrives in time."""
    wall = transient_of(*[[(31.0, 31.0, 1.0)]] * 8)
    lit = replace(wall, ambient=np.ones((1, 8), np.float32))
    dark = replace(REFERENCE, dark_count_rate_hz=300.0, hot_share=0.25, hot_rate_hz=600.0)
    plan = sense(wall, dark, PhotonBudget(10, 20)).meta["plan"]
    assert "the rest uniform over the image, the scene has no ambient light" in plan[0] and "hot pixels" in plan[1]
    assert "the rest ambient light" in sense(lit, dark, PhotonBudget(10, 20)).meta["plan"][0]
    measured = sense(wall, dark, PhotonBudget(10, 20), dark_map_hz=np.full((1, 8), 300.0)).meta["plan"]
    assert not any("hot pixels" in reason for reason in measured)
    # a third of a radiometric budget is not exact in floats: its dark counts do not exceed themselves
    third = np.nextafter(1 / 3, 1) * np.ones((1, 8))
    filled = fill_background(np.zeros((1, 8), np.float32), third, 1 / 3)
    assert "exceed" not in filled.reason and filled.dark_fraction == 1 and (filled.background == third).all()
    idle = sense(wall, replace(dark, hot_share=0.0), PhotonBudget(10, 20)).meta["plan"]
    assert "hot pixels: none, their rate of 600 Hz needs a hot_fraction (--hot-pixels)" in idle
    single = sense(wall, Sensor(bins=1, bin_width_s=1e-7), PhotonBudget(10, 20)).meta["plan"]
    assert "warning: one bin: photons are counted, but not timed, so that there is no depth" in single
    half_dead = sense(wall, replace(REFERENCE, dead_share=0.5), PhotonBudget(10, 20)).meta
    assert half_dead["wrapped"] == pytest.approx(1)


@pytest.mark.parametrize(
    ("signal", "background"), [(0.0, 0.0), (0.0, 5.0), (1e-6, 0.0), (1.0, 0.0), (1e7, 10.0), (10.0, 1e6)]
)
def test_hard_budgets(signal, background):
    transient = transient_of([(4.0, 4.0, 1.0)])
    histogram = sense(transient, REFERENCE, PhotonBudget(signal, background), seed=2, model="poisson")
    mean = signal + background
    assert abs(histogram.counts.sum(dtype=np.int64) - mean) <= 5 * np.sqrt(mean) + 5
    assert np.isfinite(histogram.expected_signal).all() and (histogram.expected_signal >= 0).all()


def test_counts_beyond_what_a_bin_holds_are_refused():
    transient, narrow = transient_of([(4.0, 4.0, 1.0)]), Sensor(bins=1, bin_width_s=1e-7)
    rates = rates_for(transient, narrow, PhotonBudget(1e9, 1e9))
    assert expected_counts(transient, narrow, rates, slice(0, 1))[0].sum() == pytest.approx(2e9)
    four = transient_of([(4.0, 4.0, 1.0)], [], [], [])
    with pytest.raises(InputError, match="a bin holds"):
        sense(four, narrow, PhotonBudget(1e9, 0), model="poisson")


# The file


def made() -> Histogram:
    transient = transient_of(*[[(4.0, 4.02, 1.0)]] * 30, *[[]] * 2)
    return sense(transient, REFERENCE, PhotonBudget(20, 20), seed=5)


@pytest.mark.parametrize("signal", [20, 1e5])
def test_histogram_reads_back_bit_for_bit(tmp_path, signal):
    histogram = sense(
        transient_of(*[[(4.0, 4.02, 1.0)]] * 30), REFERENCE, PhotonBudget(signal, 20), seed=5, model="poisson"
    )
    write_histogram(histogram, tmp_path / "h.h5")
    again = read_histogram(tmp_path / "h.h5")
    assert again.sha256() == histogram.sha256() and (again.counts == histogram.counts).all()
    assert again.sensor == histogram.sensor and again.budget == histogram.budget
    assert again.meta == json.loads(json.dumps(histogram.meta))
    with h5py.File(tmp_path / "h.h5") as file:
        assert ("timestamps" in file) == (signal == 20), "few photons are stored as timestamps"


def test_timestamps_and_counts_convert_exactly():
    histogram = made()
    stamps, offsets = histogram.timestamps()
    assert stamps.dtype == np.uint16 and offsets.dtype == np.int64 and offsets[-1] == histogram.counts.sum()
    assert (counts_from_timestamps(stamps, offsets, 1024).reshape(histogram.counts.shape) == histogram.counts).all()


def test_torch_shares_the_counts_without_a_warning():
    """Which it gives for arrays that cannot be written to: counts can, the truth beside them cannot."""
    histogram = Histogram.from_counts(np.ones((2, 3, 8), np.int32), Sensor(bins=8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shared = torch.from_numpy(histogram.counts)
    assert shared.data_ptr() == histogram.counts.ctypes.data
    with pytest.raises(ValueError, match="read-only"):
        histogram.depth_m[0, 0] = 1


def test_empty_histogram_survives_its_file(tmp_path):
    histogram = sense(transient_of([(4.0, 4.0, 1.0)]), REFERENCE, PhotonBudget(0, 0))
    write_histogram(histogram, tmp_path / "h.h5")
    assert read_histogram(tmp_path / "h.h5").counts.sum() == 0


def test_metadata_may_be_long(tmp_path):
    histogram = made()
    long = replace(histogram, meta={**histogram.meta, "notes": ["what a loader changed"] * 20000})
    write_histogram(long, tmp_path / "h.h5")
    assert len(read_histogram(tmp_path / "h.h5").meta["notes"]) == 20000


def test_truncated_and_damaged_files_are_refused_in_one_line(tmp_path):
    write_histogram(made(), tmp_path / "h.h5")
    data, good = (tmp_path / "h.h5").read_bytes(), made().sha256()
    rng = np.random.default_rng(0)
    damaged = [data[:length] for length in [*range(0, len(data), len(data) // 60), len(data) - 1]]
    for position in rng.integers(0, len(data), 100):
        flipped = bytearray(data)
        flipped[position] ^= 0x55
        damaged.append(bytes(flipped))
    refused = 0
    for contents in damaged:
        (tmp_path / "d.h5").write_bytes(contents)
        try:
            assert read_histogram(tmp_path / "d.h5").sha256() == good
        except InputError as error:
            refused += 1
            assert "d.h5" in str(error) and "\n" not in str(error)
    assert refused > 60


def test_foreign_and_newer_files_are_refused_by_name(tmp_path):
    write_histogram(made(), tmp_path / "h.h5")
    with h5py.File(tmp_path / "h.h5") as file:
        meta = json.loads(file.attrs["scene2spad"])
    slower = {**meta["sensor"], "bin_width_s": 2e-10, "period_s": 1024 * 2e-10}
    for change, message in (
        ({"schema": 2}, "schema 2"),
        ({"kind": "transient"}, "holds a transient, expected a histogram"),
        ({"sensor": slower}, "do not match"),
        ({"sensor": {}}, "not a readable"),
        ({"budget": {"signal": -1}}, "signal -1"),
    ):
        with h5py.File(tmp_path / "h.h5", "r+") as file:
            file.attrs["scene2spad"] = json.dumps({**meta, **change})
        add_checksum(tmp_path / "h.h5")
        with pytest.raises(InputError, match=message):
            read_histogram(tmp_path / "h.h5")
    with h5py.File(tmp_path / "g.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(InputError, match="not a file of scene2spad"):
        read_histogram(tmp_path / "g.h5")
    with pytest.raises(InputError, match="not found"):
        read_histogram(tmp_path / "none.h5")
