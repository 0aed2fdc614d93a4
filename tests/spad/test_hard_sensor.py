"""Hard cases of the sensor, by name."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_flux import transient_of
from test_laws import same

import scene2spad as s2s
from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.errors import InputError
from spad.detection.detect import sense, sense_timestamps
from spad.detection.rates import default_background
from spad.estimators.depth import METHODS, estimate_depth
from spad.measurements.histogram import Histogram, read_histogram, write_histogram
from spad.sensor.files import pixel_sensor
from spad.sensor.model import PRESETS, PhotonBudget, Pulse, Sensor

REFERENCE = Sensor()
MODELS = ("poisson", "first-photon", "free-running")


@pytest.mark.parametrize("model", MODELS)
def test_rate_0_everywhere(model: str, tmp_path) -> None:
    histogram = sense(same(6, (4.0, 4.0, 1.0)), REFERENCE, PhotonBudget(0, 0), model=model)
    assert histogram.counts.sum() == 0
    for method in METHODS:
        assert estimate_depth(torch.from_numpy(histogram.counts), REFERENCE, method).isnan().all()
    write_histogram(histogram, tmp_path / "h.h5")
    assert read_histogram(tmp_path / "h.h5").counts.sum() == 0
    assert len(sense_timestamps(same(6), REFERENCE, PhotonBudget(0, 0), model=model).stamps) == 0


def test_more_timestamps_than_memory_holds_are_refused(monkeypatch) -> None:
    monkeypatch.setenv("SCENE2SPAD_MEMORY_GB", "0.001")
    with pytest.raises(InputError, match=r"6e\+06 timestamps: needs 0.024 GB of memory, the limit is 0.001 GB"):
        sense_timestamps(same(6, (4.0, 4.0, 1.0)), REFERENCE, PhotonBudget(5e5, 5e5))


def test_one_photon() -> None:
    counts = torch.zeros((1, 1024), dtype=torch.int32)
    counts[0, 300] = 1
    for method in METHODS:
        depth = estimate_depth(counts, REFERENCE, method)
        assert abs(float(depth) - 300.5 * REFERENCE.bin_depth_m) < 0.5 * REFERENCE.bin_depth_m


@pytest.mark.parametrize("model", ["poisson", "first-photon"])
def test_1e7_photons_in_one_pixel(model: str) -> None:
    transient = transient_of([(8.0, 8.0, 1.0)], *[[]] * 9)
    histogram = sense(transient, REFERENCE, PhotonBudget(1e6, 0), seed=1, model=model)
    total, cycles = histogram.counts[0, 0].sum(dtype=np.int64), round(REFERENCE.cycles)
    expected = 1e7 if model == "poisson" else cycles * (1 - np.exp(-1e7 / cycles))
    assert abs(total - expected) < 5 * np.sqrt(expected) and histogram.counts[0, 1:].sum() == 0
    assert histogram.meta["pile_up"] == pytest.approx(1e7 / REFERENCE.cycles, rel=1e-6)
    assert sense(transient, REFERENCE, PhotonBudget(1e6, 0)).meta["model"] == "first-photon"
    depth = estimate_depth(torch.from_numpy(histogram.counts[0, 0]), REFERENCE, "log-matched")
    walk = 4.0 - float(depth)
    # 30 photons a cycle: the first comes nearly 2 sigma early, and no correction is asked for here
    assert abs(walk) < 1e-4 if model == "poisson" else 1e-2 < walk < 0.1


def test_pulse_narrower_than_a_hundredth_of_a_bin() -> None:
    sensor = Sensor(pulse=Pulse(REFERENCE.bin_width_s / 300))
    transient = same(64, (7.0, 7.0, 1.0))
    counts = sense(transient, sensor, PhotonBudget(100, 0), seed=2).counts
    assert (np.flatnonzero(counts.sum(axis=(0, 1))) == [int(7.0 / C / sensor.bin_width_s)]).all()
    for method in METHODS:
        depth = estimate_depth(torch.from_numpy(counts[0, 0]), sensor, method)
        assert abs(float(depth) - 3.5) < sensor.bin_depth_m


@pytest.mark.parametrize("bins_before", [0.0, 0.5, 1.0])
def test_return_on_the_periods_edge(bins_before: float) -> None:
    path = 2 * REFERENCE.range_m - 2 * bins_before * REFERENCE.bin_depth_m
    histogram = sense(same(200, (path, path, 1.0)), REFERENCE, PhotonBudget(200, 0), seed=3)
    counts = histogram.counts.sum(axis=(0, 1))
    assert counts.sum() == pytest.approx(40000, abs=900) and counts[10:-10].sum() == 0
    if bins_before == 0:
        assert histogram.meta["wrapped"] == pytest.approx(0.5, abs=1e-3)
        assert counts[:10].sum() / counts.sum() == pytest.approx(0.5, abs=4.5 * 0.5 / np.sqrt(40000))
    depth = estimate_depth(torch.from_numpy(histogram.counts[0]), REFERENCE).numpy().astype(float)
    error = (depth - path / 2 + REFERENCE.range_m / 2) % REFERENCE.range_m - REFERENCE.range_m / 2
    assert np.abs(error).max() < 8e-3


@pytest.mark.parametrize("model", MODELS)
def test_background_only(model: str) -> None:
    counts = sense(same(40, (4.0, 4.0, 1.0)), REFERENCE, PhotonBudget(0, 100), seed=4, model=model).counts
    assert abs(counts.sum() - 4000) < 5 * np.sqrt(4000)
    for method in METHODS:
        assert estimate_depth(torch.from_numpy(counts), REFERENCE, method).isfinite().all()


def test_counts_past_65535(tmp_path) -> None:
    sensor = Sensor(pulse=Pulse(REFERENCE.bin_width_s / 300))
    histogram = sense(same(3, (7.0, 7.0, 1.0)), sensor, PhotonBudget(2e5, 0), seed=5, model="poisson")
    assert histogram.counts.max() > 65535
    write_histogram(histogram, tmp_path / "h.h5")
    assert (read_histogram(tmp_path / "h.h5").counts == histogram.counts).all()
    stamps = sense_timestamps(same(3, (7.0, 7.0, 1.0)), sensor, PhotonBudget(2e5, 0), seed=5, model="poisson")
    assert (stamps.counts() == histogram.counts).all()


def test_dead_time_longer_than_the_period() -> None:
    periods = 7.5
    cycles = 3000
    sensor = Sensor(bins=64, dead_time_s=periods * 64 * REFERENCE.bin_width_s)
    sensor = replace(sensor, exposure_s=cycles * sensor.period_s)
    scene, budget = same(200, (0.6, 0.6, 1.0)), PhotonBudget(0.3 * cycles, 0.1 * cycles)
    histogram = sense(scene, sensor, budget, seed=6)
    assert histogram.meta["model"] == "free-running" and "outlasts" in " ".join(histogram.meta["plan"])
    assert histogram.counts.sum(axis=2).max() <= np.ceil(cycles / periods)
    with pytest.raises(InputError, match="use free-running"):
        sense(scene, sensor, budget, model="first-photon")
    rare = sense(scene, sensor, PhotonBudget(0.003 * cycles, 0), seed=6)
    assert rare.meta["model"] == "free-running", "0.3 % a cycle, but 2 % a dead time"


@pytest.mark.parametrize("background", [20.0, 0.0])
def test_dark_counts_alone_above_the_asked_background(background: float) -> None:
    sensor = replace(REFERENCE, dark_count_rate_hz=(3000.0, 1000.0))
    transient = same(30, (4.0, 4.0, 1.0))
    histogram = sense(transient, sensor, PhotonBudget(10, background), seed=7)
    assert histogram.expected_background.mean() == pytest.approx(background)
    if background:
        assert histogram.meta["dark_share"] == 1.0 and "scaled down" in " ".join(histogram.meta["plan"])


def test_dark_counts_above_the_default_background_are_the_sensors() -> None:
    transient = same(30, (4.0, 4.0, 1.0))
    for rate_hz in (300.0, 9000.0):  # 10 and 300 dark counts in an exposure of 1 / 30 s
        sensor = replace(REFERENCE, dark_count_rate_hz=rate_hz)
        histogram = s2s.sense(transient, sensor=sensor, seed=7)
        dark = rate_hz / 30
        assert histogram.expected_background == pytest.approx(max(50.0, dark))
        assert histogram.meta["dark_share"] == pytest.approx(min(1.0, dark / 50))
        assert not any(reason.startswith("warning: background") for reason in histogram.meta["plan"])
    asked = s2s.sense(transient, sensor=sensor, background=100.0).meta["plan"]
    assert any(reason.startswith("warning: background: 300 dark counts") for reason in asked)


@pytest.mark.parametrize("name", [*PRESETS, "linospad2", "pf32", "swissspad3"])
def test_dark_counts_of_presets_leave_the_default_background_as_it_was(name: str) -> None:
    assert default_background(same(64, (4.0, 4.0, 1.0)), pixel_sensor(name)) == 50.0


def test_all_pixels_hot_and_dead_ones_and_a_measured_map() -> None:
    transient = same(50, (4.0, 4.0, 1.0))
    hot = replace(REFERENCE, hot_share=1.0, hot_rate_hz=1e5)
    histogram = sense(transient, hot, PhotonBudget(10, 1e4), seed=8, model="poisson")
    assert histogram.meta["dark_share"] == pytest.approx(1e5 / 30 / 1e4)
    assert abs(histogram.counts.sum() - 50 * (1e4 + 10)) < 5 * np.sqrt(50 * 1e4)
    # dead pixels stay empty and take nothing from the others
    dead = sense(transient, replace(REFERENCE, dead_share=0.2), PhotonBudget(10, 20), seed=8)
    empty = dead.counts.sum(axis=2) == 0
    assert empty.sum() == 10 and dead.expected_signal[~empty].mean() == pytest.approx(10)
    assert dead.expected_signal[empty].max() == 0 == dead.expected_background[empty].max()
    measured = np.full((1, 50), 30.0)
    measured[0, 0], measured[0, 1] = np.nan, 3e4
    mapped = sense(transient, REFERENCE, PhotonBudget(10, 100), seed=8, dark_map_hz=measured)
    assert mapped.counts[0, 0].sum() == 0 and mapped.counts[0, 1].sum() > 900
    # the sensor's own dead pixels stay dead beside a map
    both = sense(transient, replace(REFERENCE, dead_share=0.2), PhotonBudget(10, 100), seed=8, dark_map_hz=measured)
    silent = (dead.counts.sum(axis=2) == 0) | np.isnan(measured)
    assert ((both.counts.sum(axis=2) == 0) == silent).all()
    for bad, words in ((measured[:, :3], "map is"), (-measured, "0 or more")):
        with pytest.raises(InputError, match=words):
            sense(transient, REFERENCE, PhotonBudget(), dark_map_hz=bad)


def test_some_hot_pixels_are_where_the_seed_puts_them() -> None:
    sensor = replace(REFERENCE, hot_share=0.1, hot_rate_hz=1e6)
    maps = [sensor.dark_rate_map_hz(20, 30, seed) for seed in (1, 1, 2)]
    assert (maps[0] == maps[1]).all() and (maps[0] != maps[2]).any()
    assert all((rates == 1e6).sum() == 60 for rates in maps)


@pytest.mark.parametrize(
    "bad",
    [
        {"pde": 0.0}, {"pde": 1.5}, {"crosstalk": -0.1}, {"crosstalk": 0.3}, {"hot_share": 2.0}, {"dead_share": -1.0},
        {"reset": "never"}, {"dead_time_s": -1e-9}, {"dead_time_s": float("nan")}, {"dark_count_rate_hz": ()},
        {"dark_count_rate_hz": (1.0, -1.0)}, {"hot_rate_hz": float("inf")}, {"exposure_s": 1e12}, {"exposure_s": 1e300},
    ],
)  # fmt: skip
def test_bad_detectors_are_refused_in_one_line(bad: dict) -> None:
    with pytest.raises(InputError) as refused:
        Sensor(**bad)
    assert "\n" not in str(refused.value) and "sensor reference" in str(refused.value)


@pytest.mark.parametrize(
    "bad",
    [
        {"bins": 20.0},
        {"bins": True},
        {"bins": "10"},
        {"dark_count_rate_hz": "5"},
        {"dark_count_rate_hz": True},
        {"name": 3},
    ]
    + [{"bin_width_s": "1 ns"}, {"pde": None}, {"exposure_s": None}, {"dead_time_s": [1.0]}, {"crosstalk": 1j}]
    + [{"dark_count_rate_hz": ["5"]}, {"dark_count_rate_hz": np.ones((2, 2))}, {"dark_count_rate_hz": np.array(1.0)}],
    ids=str,
)
def test_fields_of_a_sensor_of_the_wrong_kind_are_named(bad: dict) -> None:
    [name] = bad
    with pytest.raises(InputError, match=f"sensor.*: {name}.* expected"):
        Sensor(**bad)


def test_numbers_of_numpy_are_kept_as_pythons_own(tmp_path) -> None:
    sensor = Sensor(bins=np.int64(64), exposure_s=np.float32(0.125), dark_count_rate_hz=np.array([1, 2.0]))
    made = s2s.sense(
        same(3, (4.0, 4.0, 1.0)), signal=np.float32(5), background=np.int64(3), sensor=sensor, seed=np.int64(2)
    )
    assert type(sensor.bins) is int and type(sensor.exposure_s) is float and type(made.meta["seed"]) is int
    write_histogram(made, tmp_path / "made.h5")
    read = read_histogram(tmp_path / "made.h5")
    assert read.sensor == sensor and read.budget == PhotonBudget(5, 3)
    with pytest.raises(InputError, match=r"metadata hold what JSON cannot: .*ndarray"):
        write_histogram(replace(made, meta={"angles": np.ones(3)}), tmp_path / "other.h5")
    assert not (tmp_path / "other.h5").exists()


def test_auto_says_why() -> None:
    few, many = PhotonBudget(10, 10), PhotonBudget(1e5, 10)
    scene = same(4, (4.0, 4.0, 1.0))
    free = replace(REFERENCE, reset="free-running")
    blind = replace(free, dead_time_s=2e-8)
    for sensor, budget, model, words in (
        (REFERENCE, few, "poisson", "detections a cycle"),
        (REFERENCE, many, "first-photon", "armed at every cycle"),
        (free, many, "poisson", "loses none"),
        (blind, many, "free-running", "dead time 2e-08 s"),
        (blind, few, "poisson", "detections a cycle"),
    ):
        meta = sense(scene, sensor, budget).meta
        assert meta["model"] == model and words in " ".join(meta["plan"])


@pytest.mark.parametrize(
    "counts",
    [np.zeros((2, 8)), np.zeros((2, 2, 9)), np.full((1, 1, 8), -1), np.full((1, 1, 8), 0.5), np.full((1, 1, 8), np.nan)]
    + [np.full((1, 1, 8), 2.0**31), np.full((1, 1, 8), "a")]
    + [[[[1] * 8, [1] * 7]], torch.ones(1, 1, 8, requires_grad=True)],
    ids=["flat", "bins", "negative", "half", "nan", "large", "text", "ragged", "trained"],
)
def test_measured_counts_that_are_none_are_refused(counts) -> None:
    with pytest.raises(InputError, match="counts"):
        Histogram.from_counts(counts, Sensor(bins=8))


def test_measured_counts_become_a_histogram_without_truth(tmp_path) -> None:
    counts = np.arange(48).reshape(2, 3, 8)
    made = Histogram.from_counts(counts.astype(float), Sensor(bins=8))
    write_histogram(made, tmp_path / "made.h5")
    read = read_histogram(tmp_path / "made.h5")
    assert np.array_equal(read.counts, counts) and np.isnan(read.depth_m).all()
    assert read.budget.background == counts.sum() / 6


def test_arrays_of_the_caller_are_neither_kept_nor_frozen() -> None:
    buffer, sensor, made = np.zeros((1, 2, 8), np.int32), Sensor(bins=8), []
    for frame in range(2):  # one buffer, used again
        buffer[:] = frame
        made.append(Histogram.from_counts(buffer, sensor))
    assert [histogram.counts.max() for histogram in made] == [0, 1]
    depth_m = np.ones((1, 2), np.float32)
    histogram = replace(made[0], depth_m=depth_m)
    depth_m[0, 0] = 2.0
    assert not histogram.depth_m.flags.writeable
    transient = same(2, (4.0, 4.0, 1.0))
    radiance = transient.radiance.copy()
    assert not replace(transient, radiance=radiance).radiance.flags.writeable and radiance.flags.writeable
