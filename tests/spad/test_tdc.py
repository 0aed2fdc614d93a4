"""Unequal time codes: edges against codes one by one, expected counts and draws against detections one by one,
corrections, and one line for every mistake."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from test_flux import transient_of
from test_training_patches import scenes

from scenes.constants import SPEED_OF_LIGHT_M_PER_S as C
from scenes.errors import InputError
from spad.detection.detect import expected_in_pixel, sense, sense_timestamps
from spad.detection.device_patches import DevicePatches
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.detection.training_patches import Patch, pack_views, sense_patches
from spad.estimators.depth import histogram_depth_m
from spad.measurements.histogram import read_histogram, write_histogram
from spad.reference import arrivals, code_overlap, detect_free_running, detect_synchronous, time_bin
from spad.sensor import tdc as converters
from spad.sensor.files import SensorFile, load_sensor, read_sensor, write_sensor
from spad.sensor.model import PhotonBudget, Pulse, Sensor
from spad.sensor.tdc import Tdc, clock_error, recalibrated, shipped_tables, time_codes

PERIOD_S, WIDTH_S = 12.5e-9, 12.5e-9 / 128  # five clock periods, 25.6 bins each
REAL = Tdc(2.5e-9, table="linospad2")
SENSOR = Sensor(bins=128, bin_width_s=WIDTH_S, tdc=REAL)
EVEN = Tdc(PERIOD_S, codes=128)
CORRECTED = [replace(REAL, correction=how) for how in ("none", "line", "table")]


def assert_poisson(total: np.ndarray, expected: np.ndarray) -> None:
    """Chi-square over all bins, and the worst bin, Sidak-corrected; what is not expected is not counted."""
    assert total[expected == 0].sum() == 0
    total, expected = total[expected > 0], expected[expected > 0]
    tail = np.minimum(stats.poisson.cdf(total, expected), stats.poisson.sf(total - 1, expected))
    assert 2 * tail.min() > 1 - (1 - 1e-3) ** (1 / total.size)
    many = expected > 5
    assert many.sum() > 5
    assert stats.chi2.sf(((total - expected)[many] ** 2 / expected[many]).sum(), many.sum()) > 1e-3


@pytest.mark.parametrize("tdc", CORRECTED, ids=lambda tdc: tdc.correction)
@pytest.mark.parametrize("bins", [128, 700])
def test_edges_are_those_of_codes_taken_one_by_one(tdc: Tdc, bins: int) -> None:
    rng, width = np.random.default_rng(0), PERIOD_S / bins
    ends, times = tdc.ends(), np.broadcast_to(converters.reported_times(tdc), tdc.ends().shape)
    row, position = rng.integers(256, size=4000), rng.uniform(0, bins, 4000)
    found = time_codes(position, row, tdc.edges(bins, width))
    for n, code in enumerate(found):
        assert code == time_bin(position[n] * width, ends[row[n]], 2.5e-9, width, times[row[n]])


def test_equal_codes_are_the_sensor_without_a_converter() -> None:
    assert np.array_equal(EVEN.edges(128, WIDTH_S), np.tile(np.arange(129.0), (256, 1)))
    plain, even = Sensor(bins=128, bin_width_s=WIDTH_S), Sensor(bins=128, bin_width_s=WIDTH_S, tdc=EVEN)
    transient = transient_of([(0.4, 0.5, 1.0), (3.7, 3.9, 0.3)], [(2.0, 2.0, 0.5)])
    rates = [
        expected_counts(transient, s, rates_for(transient, s, PhotonBudget(9, 3)), slice(0, 2)) for s in (plain, even)
    ]
    torch.testing.assert_close(rates[0][0], rates[1][0], rtol=1e-12, atol=1e-12)
    assert rates[0][1] == pytest.approx(rates[1][1], rel=1e-9)
    assert even.response == plain.response and even.converter_map(1, 2).max() < 256


def test_expected_counts_are_the_pulse_between_the_edges_of_each_pixels_converter() -> None:
    """Energy, the background by widths, and detections drawn one by one; one return wraps around the period."""
    paths = ((0.9, 1.0, 1.0), (2.6, 2.6, 0.7), (3.70, 3.80, 0.5))
    transient, budget = transient_of(list(paths), list(paths)), PhotonBudget(4e4, 3e4)
    rates = rates_for(transient, SENSOR, budget)
    expected = expected_counts(transient, SENSOR, rates, slice(0, 2))[0].numpy()
    assert expected.sum(1) == pytest.approx([7e4, 7e4])
    assert (expected[0] == 0).sum() == (np.diff(SENSOR.code_edges[rates.converter[0, 0]]) == 0).sum() > 0
    rng, times = np.random.default_rng(3), np.broadcast_to(converters.reported_times(REAL), REAL.ends().shape)
    for pixel, row in enumerate(rates.converter[0]):
        at = [rng.uniform(0, PERIOD_S, rng.poisson(3e4))]
        for near, far, share in paths:
            number = rng.poisson(4e4 * share / 2.2)
            at.append(rng.uniform(near, far, number) / C + rng.normal(0, Pulse().sigma_s, number))
        counts = np.zeros(128, np.int64)
        for time_s in np.concatenate(at) % PERIOD_S:
            counts[time_bin(time_s, REAL.ends()[row], 2.5e-9, WIDTH_S, times[row])] += 1
        assert_poisson(counts, expected[pixel])


@pytest.mark.parametrize("photons", [40.0, 900.0], ids=["photon by photon", "bin by bin"])
def test_sense_draws_what_is_expected_of_each_pixel(photons: float) -> None:
    transient, budget = transient_of(*[[(0.9, 1.0, 1.0), (3.7, 3.8, 0.5)]] * 600), PhotonBudget(photons, photons)
    counts = sense(transient, SENSOR, budget, seed=3, model="poisson").counts[0]
    rates = rates_for(transient, SENSOR, budget, seed=3)
    expected = expected_counts(transient, SENSOR, rates, slice(0, 600))[0].numpy()
    assert_poisson(counts.sum(0), expected.sum(0))
    worst = np.argsort(-np.abs(SENSOR.code_edges - np.arange(129)).max(1)[rates.converter[0]])[:40]
    assert_poisson(counts[worst].sum(0), expected[worst].sum(0))
    assert expected_in_pixel(transient, SENSOR, budget, 0, 5, seed=3) == pytest.approx(expected[5])
    stamps = sense_timestamps(transient, SENSOR, budget, seed=3, model="poisson")
    assert np.array_equal(np.bincount(stamps.stamps, minlength=128), counts.sum(0))


@pytest.mark.parametrize("law", ["first-photon", "free-running"])
def test_dead_time_decides_on_times_and_the_converter_names_them(law: str) -> None:
    """Against detections one by one: photons in true bins, dead time, then the codes. Flux of 0.9 photons a cycle."""
    dead_s = 0.0 if law == "first-photon" else 0.7 * PERIOD_S
    cycles, pixels = 100, 60
    reset = "synchronous" if law == "first-photon" else "free-running"
    options = {"exposure_s": cycles * PERIOD_S, "dead_time_s": dead_s, "reset": reset}
    fine = Sensor(bins=128, bin_width_s=WIDTH_S, **options)
    sensor = replace(fine, tdc=REAL)
    transient, budget = transient_of(*[[(2.5, 2.6, 1.0)]] * pixels), PhotonBudget(0.6 * cycles, 0.3 * cycles)
    rates = rates_for(transient, sensor, budget)
    counts = sense(transient, sensor, budget, model=law).counts[0].sum(0)
    assert np.isfinite(counts).all() and counts.sum() < 0.75 * cycles * pixels  # a quarter and more is lost
    flux = expected_counts(transient, fine, rates._replace(converter=None), slice(0, 1))[0][0].numpy() / cycles
    rng, seen = np.random.default_rng(5), np.zeros(128)
    for row in np.tile(rates.converter[0], 3):
        times = arrivals(flux, cycles, rng)
        edges = sensor.code_edges[[row]]
        if law == "first-photon":
            kept, last = [], -1
            for at in times:
                kept, last = ([*kept, at], int(at // 128)) if int(at // 128) != last else (kept, last)
            assert detect_synchronous(times, 128).sum() == len(kept)
        else:
            kept, ready = [], 0.0
            for at in times:
                kept, ready = ([*kept, at], at + dead_s / WIDTH_S) if at >= ready else (kept, ready)
            assert detect_free_running(times, 128, dead_s / WIDTH_S).sum() == len(kept)
        seen += np.bincount(time_codes(np.mod(kept, 128), np.zeros(len(kept), int), edges), minlength=128)
    # two draws, one of thrice the exposure: a chi-square of two samples; detections exclude each other, which makes
    # it smaller, never larger. A photon is uniform within its bin there: bins of the pulse's flank are put together
    pairs = np.stack([counts, seen]).reshape(2, -1, 4).sum(2)
    pairs = pairs[:, pairs.sum(0) > 20]
    assert stats.chi2_contingency(pairs).pvalue > 1e-3


def test_crosstalk_happens_at_a_time_and_every_pixel_names_it_by_its_own_converter() -> None:
    """A lit pixel between two dark ones: what these count is the lit one's light through their own codes."""
    transient = transient_of([], [(2.5, 2.6, 1.0)], [])
    budget, share = PhotonBudget(4e5 / 3, 0.0), 0.05
    sensor = replace(SENSOR, crosstalk=share)
    rates = rates_for(transient, sensor, budget)
    for law, exposure_s in (("poisson", 1 / 30), ("first-photon", 1.0), ("free-running", 1.0)):
        quiet = replace(sensor, exposure_s=exposure_s)
        counts = sense(transient, quiet, budget, model=law).counts[0]
        for dark in (0, 2):
            one = rates._replace(converter=np.full((1, 3), rates.converter[0, dark]))
            light = expected_counts(transient, sensor, one, slice(1, 2))[0][0].numpy()
            assert_poisson(counts[dark], share * light)


@pytest.mark.parametrize("on", ["host", "device"])
def test_training_patches_pass_the_converters_of_their_pixels(on: str) -> None:
    transients, sensor = scenes(), SENSOR
    packed, patches = pack_views(transients), [Patch(1, 3, 4, 6.0, 4.0, seed=(9, i)) for i in range(1500)]
    if on == "host":
        counts = sense_patches(packed, sensor, patches, size=(4, 5)).counts
    else:
        counts = DevicePatches(packed, sensor, "cpu").sense(patches, size=(4, 5), seed=4).counts
    rates = rates_for(transients[1], sensor, PhotonBudget(6, 4))
    expected = expected_counts(transients[1], sensor, rates, slice(0, 120))[0].numpy().reshape(12, 10, 128)
    assert_poisson(counts.sum((0, 1)).double().numpy(), 1500 * np.moveaxis(expected[3:7, 4:9], -1, 0))


def test_a_recorded_histogram_is_recalibrated_and_a_code_by_rows_of_its_own() -> None:
    """Flat light comes back flat; summing rows averaged over each code's time is encoding what is recalibrated."""
    edges = SENSOR.code_edges
    row, rng = np.array([[3, 200]]), np.random.default_rng(1)
    flat = np.diff(edges)[row]
    assert recalibrated(flat, row, edges) == pytest.approx(np.ones((1, 2, 128)))
    assert not np.allclose(flat, 1, atol=0.2)
    counts, coding = rng.poisson(3.0, (1, 2, 128)) * (flat > 0), rng.normal(size=(4, 128))
    again = recalibrated(counts, row, edges)
    assert again.sum(-1) == pytest.approx(counts.sum(-1))
    for pixel in range(2):
        shares = code_overlap(edges[row[0, pixel]])
        assert shares.sum(0) == pytest.approx(np.where(flat[0, pixel] > 0, 1.0, 0.0))
        assert (coding @ shares) @ counts[0, pixel] == pytest.approx(coding @ again[0, pixel])


def test_clock_errors_are_those_of_times_drawn_at_random() -> None:
    rng = np.random.default_rng(2)
    row, position = rng.integers(256, size=1 << 18), rng.uniform(0, 128, 1 << 18)
    for tdc in CORRECTED:
        edges = tdc.edges(128, WIDTH_S)
        off = time_codes(position, row, edges) + 0.5 - position
        found, tolerance = clock_error(edges), 5 / np.sqrt(len(off))
        assert found.mean == pytest.approx(off.mean(), abs=tolerance * off.std())
        assert found.rms**2 == pytest.approx((off**2).mean(), abs=tolerance * (off**2).std())
    errors = [clock_error(tdc.edges(128, WIDTH_S)) for tdc in CORRECTED]
    assert clock_error(EVEN.edges(128, WIDTH_S)) == pytest.approx((0, 12**-0.5))
    assert errors[0].mean > 1 and abs(errors[2].mean) < 0.01  # codes before the first that comes are late, all of them
    assert errors[0].rms > 2 and 12**-0.5 < errors[2].rms < errors[1].rms < 0.4


def test_the_table_that_ships_is_as_unequal_as_its_source_says() -> None:
    """real-sensors facts: mean width 18.0 ps, nonlinearity 0.80 codes rms, 12 % of the codes empty."""
    widths = np.diff(REAL.ends(), axis=1, prepend=0) * 140
    assert widths.shape == (256, 140) and widths.mean() == pytest.approx(1)
    assert widths.std() == pytest.approx(0.80, abs=0.01) and (widths == 0).mean() == pytest.approx(0.12, abs=0.01)
    assert [t.bits_per_pixel for t in CORRECTED] == [0, 16, 1120]
    notice = (shipped_tables()["linospad2"].parent / "NOTICE").read_text()
    assert "MIT License" in notice and "Sergei Kulkov" in notice


@pytest.mark.parametrize(
    ("codes", "dnl", "missing"),
    [(140, 0.8, 0.1), (140, 3.0, 0.0), (16, 2.0, 0.25), (4, 1.0, 0.0), (4, 1.5, 0.0), (4, 3**0.5, 0.25), (2, 0.5, 0.0)],
)
def test_drawn_converters_have_the_nonlinearity_that_is_asked_for(codes: int, dnl: float, missing: float) -> None:
    widths = np.diff(Tdc(2.5e-9, codes=codes, dnl=dnl, missing=missing).ends(), axis=1, prepend=0) * codes
    squares = ((widths - 1) ** 2).mean(axis=1)  # of each converter, whose codes fill one clock period
    assert squares.mean() == pytest.approx(dnl**2, abs=5 * squares.std() / len(squares) ** 0.5 + 1e-9)
    if dnl < 1:  # else widths below the smallest number come, too
        assert (widths == 0).mean() == pytest.approx(missing)
    assert np.array_equal(Tdc(2.5e-9, codes=140).ends()[0], np.cumsum(np.full(140, 1.0)) / 140)


def test_the_clocks_jitter_adds_to_the_response() -> None:
    sensor = replace(SENSOR, tdc=replace(REAL, jitter_s=1e-10), jitter=Pulse(5e-11))
    assert sensor.response == Pulse(np.sqrt(Pulse().sigma_s ** 2 + 1e-20 + 25e-22))
    shaken = replace(sensor, tdc=replace(EVEN, jitter_s=1e-10))
    counts = sense(transient_of([(1.5, 1.5, 1.0)]), shaken, PhotonBudget(4e5, 0), model="poisson").counts[0, 0]
    place = np.arange(128) + 0.5
    variance = np.average((place - np.average(place, weights=counts)) ** 2, weights=counts) - 1 / 12
    assert variance * WIDTH_S**2 == pytest.approx(sensor.response.sigma_s**2, rel=0.01)


@pytest.mark.parametrize("tdc", [*CORRECTED, Tdc(2.5e-9 / 3, codes=7, dnl=0.5, missing=0.1, jitter_s=1e-11 / 3)])
def test_a_sensor_with_a_converter_survives_its_files(tdc: Tdc, tmp_path) -> None:
    sensor = Sensor(bins=128, bin_width_s=WIDTH_S, tdc=tdc)
    assert read_sensor(write_sensor(SensorFile(sensor), tmp_path / "s.toml")).sensor == sensor
    assert Sensor.from_dict(sensor.to_dict()) == sensor and "tdc" not in Sensor().to_dict()
    histogram = sense(transient_of([(1.5, 1.5, 1.0)]), sensor, PhotonBudget(9, 9))
    write_histogram(histogram, tmp_path / "h.h5")
    assert read_histogram(tmp_path / "h.h5").sensor == sensor


def test_presets_with_a_converter() -> None:
    assert load_sensor("reference-tdc").sensor == Sensor(name="reference-tdc", tdc=REAL)
    chip = load_sensor("linospad2").sensor
    assert chip.tdc == REAL
    assert np.diff(chip.code_edges).std() == pytest.approx(0.806, abs=0.01)  # a bin is a code


@pytest.mark.parametrize(
    ("tdc", "words"),
    [
        ('clock_period = "2.5 ns"', "expected a table or a number of codes"),
        ('clock_period = "2.5 ns"\ntable = "linospad2"\ncodes = 140', "expected a table or a number of codes"),
        ('clock_period = "2.5 ns"\ntable = "linospad3"', "'linospad3' is unknown; did you mean 'linospad2'?"),
        ('clock_period = "2.5 ns"\ntable = "none.npz"', "none.npz"),
        ('clock_period = "2.6 ns"\ntable = "linospad2"', "codes end at 2500 ps, expected the clock period of 2600 ps"),
        ('clock_period = "2.6 ns"\ncodes = 140', "no whole number of clock periods"),
        ('clock_period = "2.5 s"\ncodes = 140', "clock period 2.5 s is outside"),
        ('clock_period = "2.5 ns"\ncodes = 14.5', "tdc.codes: 14.5 is no whole number"),
        ('clock_period = "2.5 ns"\ncodes = 140\nmissing = 0.2\ndnl = 0.1', "dnl 0.1 is below 0.5 codes"),
        ('clock_period = "2.5 ns"\ncodes = 140\ndnl = -1', "dnl"),
        (
            'clock_period = "2.5 ns"\ncodes = 16\ndnl = 100',
            "dnl 100 is above 3.87 codes, the most that 16 codes can have",
        ),
        ('clock_period = "2.5 ns"\ncodes = 4\nmissing = 0.9', "missing 0.9 of 4 codes leaves none"),
        ('clock_period = "2.5 ns"\ntable = "linospad2"\ndnl = 1', "has its own nonlinearity"),
        ('clock_period = "2.5 ns"\ncodes = 140\ncorrection = "lut"', "correction 'lut' is unknown"),
        ('clock_period = "2.5 ns"\ncodes = 140\ncorrection_bits = 17', "17 correction bits, expected 1 to 16"),
        ('clock_period = "2.5 ns"\ncodes = 140\njitter = "5"', "tdc.jitter"),
        ('table = "linospad2"', "tdc.clock_period is missing"),
    ],
)
def test_mistakes_in_a_file_are_told_in_one_line(tdc: str, words: str, tmp_path) -> None:
    path = tmp_path / "s.toml"
    head = 'name = "mine"\n[histogram]\nbins = 128\nbin_width = "97.65625 ps"\n[pulse]\nfwhm = "200 ps"\n[tdc]\n'
    path.write_text(head + tdc)
    with pytest.raises(InputError) as caught:
        read_sensor(path)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_tables_that_are_none_are_told_in_one_line(tmp_path) -> None:
    path = tmp_path / "codes.npz"
    for name, values, words in (
        ("ends", np.ones((2, 3)), "holds no end_ps"),
        ("end_ps", np.ones(3), "expected numbers"),
        ("end_ps", np.array([[10.0, 5.0, 2500.0]]), "falls, or is negative"),
    ):
        np.savez(path, **{name: values})
        converters.measured_table.cache_clear()
        with pytest.raises(InputError, match=words):
            Tdc(2.5e-9, table=str(path))
    with pytest.raises(InputError, match="bins that cover the period"):
        Sensor(bins=100, bin_width_s=WIDTH_S, period_s=PERIOD_S, tdc=REAL)


@pytest.mark.parametrize(
    "tdc", [Tdc(2.5e-9, codes=1, correction="line"), Tdc(2.5e-9, codes=3, missing=0.6, dnl=2**0.5)]
)
def test_a_converter_with_one_code_gives_the_clock_period(tdc: Tdc) -> None:
    """Keep the clock's edges where one code alone comes: a line through it has no slope."""
    edges = Sensor(bins=8, bin_width_s=2.5e-9, tdc=replace(tdc, correction="line")).code_edges
    assert np.allclose(edges, np.arange(9))


@pytest.mark.parametrize(("codes", "dnl"), [(16, 15**0.5), (2, 1.0), (4096, 4095**0.5)])
def test_the_largest_nonlinearity_leaves_every_converter_a_code(codes: int, dnl: float) -> None:
    ends = Tdc(2.5e-9, codes=codes, dnl=dnl).ends()
    assert np.isfinite(ends).all() and (ends[:, -1] == 1).all() and (np.diff(ends, axis=1) >= 0).all()


def test_a_table_of_ones_own_lies_beside_its_sensor_file_and_a_histogram_needs_it_no_more(tmp_path, monkeypatch):
    """Found from any folder; what was recorded is read and turned into depth without it; a changed one is refused."""
    folder = tmp_path / "lab"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    end_ps = np.cumsum(np.full((3, 25), 100.0), axis=1)
    np.savez(folder / "own.npz", end_ps=end_ps)
    written = write_sensor(SensorFile(SENSOR), folder / "own.toml").read_text().replace('"linospad2"', '"own.npz"')
    (folder / "own.toml").write_text(written)
    sensor = load_sensor("lab/own.toml").sensor
    assert sensor.tdc is not None and sensor.tdc.ends() == pytest.approx(np.tile(np.arange(1, 26) / 25, (3, 1)))
    moved = write_sensor(SensorFile(sensor), tmp_path / "moved.toml")
    assert np.array_equal(read_sensor(moved).sensor.tdc.ends(), sensor.tdc.ends())

    transient = transient_of(*[[(0.6, 0.61, 1.0)]] * 40)
    write_histogram(sense(transient, sensor, PhotonBudget(300, 10), seed=1), tmp_path / "h.h5")
    (folder / "own.npz").rename(tmp_path / "elsewhere.npz")
    converters.measured_table.cache_clear()
    found = read_histogram(tmp_path / "h.h5")
    assert found.sensor == sensor and abs(np.median(histogram_depth_m(found)) - 0.3) < 0.02
    with pytest.raises(InputError, match=r"own\.npz: table of codes not found"):
        found.sensor.tdc.ends()
    np.savez(folder / "own.npz", end_ps=end_ps**1.0001 * (2500 / 2500**1.0001))
    with pytest.raises(InputError, match=r"own\.npz: is another table of codes"):
        sense(transient, read_histogram(tmp_path / "h.h5").sensor, PhotonBudget(300, 10))


def test_a_sensor_file_with_an_own_table_comes_back_but_for_the_tables_path(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("own.npz", end_ps=np.cumsum(np.full((3, 25), 100.0), axis=1))
    text = write_sensor(SensorFile(SENSOR), Path("own.toml")).read_text().replace('"linospad2"', '"own.npz"')
    Path("own.toml").write_text(text)
    first = read_sensor(Path("own.toml")).sensor
    second = read_sensor(write_sensor(SensorFile(first), Path("again.toml"))).sensor
    assert second.tdc.table == str(tmp_path / "own.npz") and first.tdc.table == "own.npz"
    assert replace(second, tdc=replace(second.tdc, table=first.tdc.table)) == first


@pytest.mark.parametrize(("cycles", "drawn"), [(10.4, 10), (10.6, 11)])
def test_the_nearest_whole_number_of_cycles_is_drawn(cycles: float, drawn: int) -> None:
    """At 30 photons a cycle every cycle has a first one."""
    sensor = Sensor(bins=64, exposure_s=cycles * Sensor(bins=64).period_s)
    histogram = sense(transient_of([(0.5, 0.5, 1.0)]), sensor, PhotonBudget(30 * cycles, 0), model="first-photon")
    assert histogram.counts.sum() == drawn
