"""The commands `sense`, `depth` and `bench sense` with the sensor's wider options."""

import csv
import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from matplotlib.axes import Axes

from render.transient import write_transient
from scene2spad.bench import estimators
from scene2spad.bench.sense import alternating, first_photon_totals, max_deviation, one_law, poisson_totals, relief
from scene2spad.cli import main
from scene2spad.plots import pixels
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.detect import expected_in_pixel, sense
from spad.detection.laws import first_photon_counts
from spad.estimators.bistatic import true_arrival_s
from spad.formats.depth_map import read_depth
from spad.formats.mat import read_mat
from spad.formats.rgbd import transient_from_rgbd
from spad.measurements.histogram import Histogram, read_histogram, write_histogram
from spad.sensor.budget import Optics
from spad.sensor.files import SensorFile, write_sensor
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor_names import sensor_by_name


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    depth = np.linspace(2, 6, 8 * 10).reshape(8, 10)
    transient = transient_from_rgbd(depth, np.full_like(depth, 0.5), np.full_like(depth, 0.02))
    write_transient(transient, tmp_path / "s.exr")
    return transient


def run(capfd, *argv: str) -> tuple[int, dict, str]:
    status = main([*argv, "--json", "--no-figure"] if argv[0] in ("sense", "depth") else [*argv, "--json"])
    out, err = capfd.readouterr()
    return status, json.loads(out.splitlines()[-1]) if out.strip() else {}, err


def test_laws_and_inverses_by_command(scene, capfd, tmp_path):
    status, message, err = run(capfd, "sense", "s.exr", "--signal", "4e5", "--background", "4e5")
    assert status == 0 and message["model"] == "first-photon" and message["pile_up"] > 0.5 and "pile-up" in err
    assert message["mean_counts"] < 0.95 * 8e5
    errors = {}
    for method in ("log-matched", "coates", "lmf-published", "correlation"):
        status, depth, _ = run(capfd, "depth", "s.h5", "--method", method)
        assert status == 0 and 0 <= depth["confidence"] <= 1
        _, sure, _ = read_depth(tmp_path / f"s-{method}.exr")
        assert sure.shape == (8, 10) and np.nanmean(sure) == pytest.approx(depth["confidence"], rel=1e-5)
        errors[method] = depth["mae_mm"]
    assert errors["coates"] < 0.5 < errors["log-matched"]
    options = ("--model", "free-running", "--dead-time", "3e-7", "--exposure", "1e-3")
    status, message, _ = run(capfd, "sense", "s.exr", "--signal", "1e3", "--background", "1e3", *options)
    assert status == 0 and message["model"] == "free-running" and message["mean_counts"] < 1e-3 / 3e-7 + 1


def test_depth_beside_a_displaced_laser_has_no_confidence(scene, capfd, tmp_path):
    """The distance there is no arrival time, which the probability is of; pixels without a depth have none either."""
    assert run(capfd, "sense", "s.exr", "--signal", "2", "--background", "1")[0] == 0
    histogram = read_histogram(tmp_path / "s.h5")
    assert run(capfd, "depth", "s.h5", "--method", "argmax")[0] == 0
    depth, sure, _ = read_depth(tmp_path / "s-argmax.exr")
    assert np.isnan(depth).any() and np.array_equal(np.isnan(sure), np.isnan(depth))
    camera = {"fov_deg": 50.0, "width": 10, "height": 8, "pose": np.eye(4).tolist()}
    meta = {**histogram.meta, "transient": {"camera": camera, "laser": {"baseline_m": [0.1, 0.0, 0.0]}}}
    write_histogram(replace(histogram, meta=meta), tmp_path / "beside.h5")
    status, message, err = run(capfd, "depth", "beside.h5")
    assert status == 0 and message["confidence"] is None, err
    assert read_depth(tmp_path / "beside-log-matched.exr")[1] is None


@pytest.mark.parametrize("line", [["depth", "blind.h5"], ["compare", "blind.h5", "--methods", "argmax"]])
def test_a_histogram_beside_a_displaced_laser_without_a_camera_is_refused_by_name(scene, capfd, tmp_path, line):
    assert run(capfd, "sense", "s.exr")[0] == 0
    histogram = read_histogram(tmp_path / "s.h5")
    meta = {**histogram.meta, "transient": {"laser": {"baseline_m": [0.1, 0.0, 0.0]}}}
    write_histogram(replace(histogram, meta=meta), tmp_path / "blind.h5")
    assert main(line) == 2
    words = "blind.h5: histogram of 8 x 10 pixels beside a laser at 0.1 0 0 m: it states no camera"
    assert words in capfd.readouterr().err


def test_depth_beyond_the_record_says_that_no_pixel_is_in_range(scene, capfd):
    """The scene begins at 2 m, and 100 bins of the reference sensor end at 1.46 m."""
    assert run(capfd, "sense", "s.exr", "--bins", "100", "--period", "1e-7")[0] == 0
    status, message, _ = run(capfd, "depth", "s.h5")
    assert status == 0 and message["mae_mm"] is None and message["beyond_range"] == 80
    for line in (["s.h5"], [".", "--out", "maps", "--sensor", "tmf8828"]):
        assert main(["depth", *line, "--no-figure"]) == 0
        told = capfd.readouterr().out
        assert "errors: no pixel in range" in told and "nan" not in told and "beyond_range: 80" in told


def test_detector_options_reach_the_sensor(scene, capfd, tmp_path):
    np.save(tmp_path / "p.npy", np.exp(-np.arange(40) / 8))
    np.save(tmp_path / "d.npy", np.full((8, 10), 90.0))
    options = "--jitter 5e-11 --jitter-tail 1e-10 --pde 0.3 --crosstalk 0.002 --dead-pixels 0.1 --hot-pixels 0.05"
    status, message, err = run(
        capfd, "sense", "s.exr", *options.split(), "--pulse", "p.npy", "--pulse-step", "2e-11", "--sensor", "linospad"
    )
    sensor = read_histogram(tmp_path / "s.h5").sensor
    assert status == 0 and message["mean_signal"] == pytest.approx(45, rel=0.05) and "crosstalk" in err
    assert (sensor.name, sensor.bins, sensor.pde, sensor.crosstalk) == ("linospad", 1536, 0.3, 0.002)
    assert sensor.jitter.tail_s == 1e-10 and len(sensor.pulse.samples) == 40 and sensor.hot_rate_hz == 1e4
    status, message, _ = run(capfd, "sense", "s.exr", "--dark-map", "d.npy")
    assert status == 0 and message["dark_share"] == pytest.approx(3 / 50)
    status, message, err = run(capfd, "sense", "s.exr", "--dark-count-rate", "6000")
    assert status == 0 and message["mean_background"] == pytest.approx(200) and "scaled down" not in err
    status, message, err = run(capfd, "sense", "s.exr", "--dark-count-rate", "6000", "--background", "40")
    assert status == 0 and message["mean_background"] == pytest.approx(40) and "warning: background" in err


def test_a_sensor_file_is_the_sensor_and_options_change_it(scene, capfd, tmp_path):
    """Every field of the sensor has an option; one that the file sets and no option names stays as it is."""
    sensor = Sensor(name="mine", bins=512, bin_width_s=2e-10, crosstalk=0.01, hot_share=0.1, hot_rate_hz=3e3)
    write_sensor(SensorFile(sensor, Optics(1e-9, 5e-3, 1.4, 1e-5)), tmp_path / "mine.toml")
    status, _, _ = run(capfd, "sense", "s.exr", "--sensor", "mine.toml")
    assert status == 0 and read_histogram(tmp_path / "s.h5").sensor == sensor
    options = "--bins 256 --bin-width 4e-10 --pulse-fwhm 1e-9 --pulse-tail 2e-10 --crosstalk 0 --hot-pixels 0"
    assert run(capfd, "sense", "s.exr", "--sensor", "mine.toml", *options.split())[0] == 0
    changed = read_histogram(tmp_path / "s.h5").sensor
    assert (changed.bins, changed.bin_width_s, changed.period_s) == (256, 4e-10, 256 * 4e-10)
    assert changed.pulse.fwhm_s == pytest.approx(1e-9) and changed.pulse.tail_s == 2e-10
    assert changed.crosstalk == changed.hot_share == 0
    optics = ("sense", "s.exr", "--sensor", "mine.toml", "--crosstalk", "0", "--radiometric")
    _, ours, _ = run(capfd, *optics)
    _, lens, _ = run(capfd, *optics, "--f-number", "2.8")
    assert ours["mean_signal"] == pytest.approx(4 * lens["mean_signal"], rel=1e-4)


def test_radiometric_budget_by_command(scene, capfd):
    status, message, _ = run(capfd, "sense", "s.exr", "--radiometric", "--pde", "0.2", "--pulse-energy", "1e-9")
    assert status == 0 and message["mean_signal"] > 0 and message["mean_background"] > 0
    _, twice, _ = run(capfd, "sense", "s.exr", "--radiometric", "--pde", "0.4", "--pulse-energy", "1e-9")
    assert twice["mean_signal"] == pytest.approx(2 * message["mean_signal"], rel=1e-5)


def test_export_beside_another_sensors_pulse_is_refused_before_the_work(scene, capfd, tmp_path):
    assert run(capfd, "sense", "s.exr", "--export", "mat")[0] == 0
    status, _, err = run(capfd, "sense", "s.exr", "--export", "mat", "--out", "t.h5", "--pulse-fwhm", "2e-9")
    assert status == 2 and "holds the pulse of another sensor" in err and "model:" not in err
    assert not (tmp_path / "t.h5").exists()


def test_export_beside_a_displaced_laser_is_refused_before_the_work(scene, capfd, tmp_path):
    write_transient(replace(scene, meta={**scene.meta, "laser": {"baseline_m": [0.1, 0, 0]}}), tmp_path / "b.exr")
    status, _, err = run(capfd, "sense", "b.exr", "--export", "mat")
    assert status == 2 and "b.mat: the layout knows no laser beside the camera" in err and "model:" not in err
    assert not (tmp_path / "b.h5").exists()


def test_export_by_command(scene, capfd, tmp_path):
    status, message, _ = run(capfd, "sense", "s.exr", "--export", "mat")
    assert status == 0 and (tmp_path / "s.mat").is_file() and message["export"] == "s.mat"
    assert (read_mat(tmp_path / "s.mat").counts == read_histogram(tmp_path / "s.h5").counts).all()
    assert scipy.io.loadmat(message["pulse_file"])["PSF_img"].shape[:2] == (8, 10)
    # the layout does not say which pixels are mixed
    assert "unmixed" not in run(capfd, "depth", "s.mat")[1] and "unmixed" in run(capfd, "depth", "s.h5")[1]


def test_an_efficiency_that_changes_nothing_is_told(scene, capfd):
    status, _, err = run(capfd, "sense", "s.exr", "--pde", "0.5")
    assert status == 0 and "--pde 0.5 changes nothing" in err
    assert "--pde" not in run(capfd, "sense", "s.exr", "--pde", "0.5", "--radiometric")[2]


def test_a_bad_input_is_told_before_a_bad_output(scene, capfd, tmp_path):
    for name in ("text.exr", "text.h5"):
        (tmp_path / name).write_text("no")
    status, _, err = run(capfd, "sense", "text.exr")
    assert status == 2 and "text.exr: not a readable EXR file" in err and "text.h5" not in err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--jitter-tail", "1e-10"], "needs --jitter"),
        (["--pulse", "p.npy"], "go together"),
        (["--pulse", "none.npy", "--pulse-step", "1e-11"], "none.npy"),
        (["--dark-map", "none.npy"], "none.npy"),
        (["--dark-map", "negative.npy"], "negative.npy: dark count map: rates must be finite and 0 or more"),
        (["--dark-map", "small.npy"], "small.npy: dark count map is (2, 2)"),
        (["--dark-map", "fine.npy", "--dark-count-rate", "9"], "--dark-count-rate does not go with --dark-map"),
        (["--dark-map", "fine.npy", "--hot-pixels", "0.1"], "--hot-pixels does not go with --dark-map"),
        (["--dark-map", "fine.npy", "--dead-pixels", "0.1"], "--dead-pixels does not go with --dark-map"),
        (["--jitter", "0"], "--jitter: pulse sigma 0 s is outside"),
        (["--sensor", "tmf8820", "--pde", "0.1"], "--pde does not go with a sensor of zones"),
        (["--sensor", "tmf8820", "--exposure", "1"], "--exposure does not go with a sensor of zones"),
        (["--radiometric", "--signal", "3"], "leave out --signal"),
        (["--pde", "2"], "PDE 2"),
        (["--hot-pixels", "2"], "--hot-pixels 2 is outside 0 to 1"),
        (["--dead-time", "1e-6", "--model", "first-photon"], "use free-running"),
        (["--exposure", "1e-12"], "shorter than the period"),
        (["--exposure", "inf"], "exposure inf s is not finite"),
        (["--dark-count-rate", "1e308"], "dark count rate 1e+308 Hz is outside 0 to 1e+12"),
        (["--pulse-fwhm", "-1"], "--pulse-fwhm -1, --pulse-tail 0: pulse sigma"),
        (["--radiometric", "--pulse-energy", "-1"], "--pulse-energy -1 is outside 0 to 1e+12"),
        (["--radiometric", "--wavelength", "1"], "--wavelength 1 is outside"),
        (["--radiometric", "--focal-length", "1e308"], "--focal-length 1e+308 is outside 1e-12 to 1e+12"),
        (["--radiometric", "--f-number", "1e-308"], "--f-number 1e-308 is outside 1e-12 to 1e+12"),
        (["--sensor", "retina"], "retina"),
        (["--sensor", "mine.toml"], "mine.toml: sensor file not found"),
        (["--pulse-tail", "1e-10"], "needs --pulse-fwhm"),
        (["--pulse", "p.npy", "--pulse-step", "1e-11", "--pulse-fwhm", "1e-10"], "not both"),
        (["--bins", "100", "--period", "1e-12"], "is not a whole number of bin widths"),
        (["--sensor", "tmf8828", "--export", "mat"], "s.mat: the layout needs bins that cover the period, tmf8828 has"),
    ],
)
def test_bad_options_are_refused_in_one_line(scene, capfd, tmp_path, options, words):
    np.save(tmp_path / "negative.npy", np.full((8, 10), -1.0))
    np.save(tmp_path / "small.npy", np.ones((2, 2)))
    np.save(tmp_path / "fine.npy", np.ones((8, 10)))
    status, _, err = run(capfd, "sense", "s.exr", *options)
    lines = [line for line in err.splitlines() if line.startswith("scene2spad: ")]
    assert status == 2 and len(lines) == 1 and words in lines[0] and not (tmp_path / "s.h5").exists()


def test_dense_counts_are_told_how_they_become_a_histogram(scene, capfd):
    np.save("counts.npy", np.ones((2, 3, 8), np.int32))
    np.savez("counts.npz", data=np.ones((2, 3, 8), np.int32))
    for name in ("counts.npy", "counts.npz"):
        status, _, err = run(capfd, "depth", name)
        assert status == 2 and f"{name}: is of kind dense" in err and "Histogram.from_counts" in err
    np.save("codes.npy", np.ones((4, 8)))
    assert "is of kind codes" in run(capfd, "depth", "codes.npy")[2]
    argv = ("depth", "s.h5", "--method", "compressive", "--codes-file", "c.csv")
    assert "--codes-file c.csv: expected codes (K, T) in a .npy file" in run(capfd, *argv)[2]


def test_table_of_estimators():
    rows = estimators.table([("a", relief(6, 7))], sensor_by_name("reference"), [(30, 300)], seed=1)
    assert len(rows) == 6 * 3 and {row["group"] for row in rows} == {"all", "unmixed", "mixed"}
    summary = estimators.summary(rows)
    assert summary["log-matched"]["all"]["rmse_mm"] < summary["argmax"]["all"]["rmse_mm"]
    for group in ("unmixed", "mixed"):
        assert sum(row["pixels"] for row in rows if row["group"] == group) <= 6 * 42
    assert len(set(estimators.LEVELS)) == 16
    message = estimators.markdown(rows)
    assert (
        message[2].startswith("| 30 / 300 | ")
        and message[-1].startswith("| coates | ")
        and len(message) == 3 + 1 + 2 + 6
    )


def test_middlebury_pairs_become_transients(shared_data):
    transient = estimators.middlebury(shared_data / "middlebury" / "Art")
    assert (transient.height, transient.width) == (69, 86) and 0 < transient.mixed.mean() < 0.5
    assert 1.3 < np.nanmin(transient.depth_m) < np.nanmax(transient.depth_m) < 2.3


def test_measuring_tools():
    calls = []
    seconds = alternating({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 3)
    assert calls == ["a", "b"] * 4 and set(seconds) == {"a", "b"}
    rng = np.random.default_rng(0)
    counts = [rng.poisson(rate, (500, 8)) for rate in (3.0, 3.0)]
    assert one_law(*counts) > 1e-3
    assert one_law(counts[0], rng.poisson(np.linspace(2, 4, 8), (500, 8))) < 1e-6


def test_deviations_from_closed_forms_are_of_the_law_that_drew_the_counts():
    """At 0.5 photons a cycle first photons are far from Poisson's law; the largest of 64 normal deviates is below 5."""
    rng = np.random.default_rng(1)
    flux = np.linspace(0.5, 1.5, 64) / 128 * np.ones((50, 1))
    counts = first_photon_counts(flux, 2000, rng)
    assert max_deviation(counts, first_photon_totals(flux, 2000)) < 5
    assert max_deviation(counts, poisson_totals(2000 * flux)) > 10
    assert max_deviation(rng.poisson(2000 * flux), poisson_totals(2000 * flux)) < 5
    assert max_deviation(counts[:, ::-1], first_photon_totals(flux, 2000)) > 10


def test_a_data_folder_without_its_images_is_refused(tmp_path, capfd, shared_data):
    """The table of estimators was left out without a word."""
    odd = tmp_path / "odd/middlebury/Art"
    shutil.copytree(shared_data / "middlebury/Art", odd)
    (odd / "dmin.txt").write_text("many")
    (tmp_path / "empty/middlebury").mkdir(parents=True)
    words = {"nosuch": "folder .*middlebury not found", "empty": "holds no Middlebury scene", "odd": "holds no number"}
    for data, word in words.items():
        argv = ["bench", "sense", "--quick", "--data", str(tmp_path / data), "--out", str(tmp_path / "b")]
        assert main(argv) == 2
        message = capfd.readouterr().err
        assert re.search(word, message) and message.count("\n") == 1 and not (tmp_path / "b").exists()


@pytest.mark.slow
def test_bench_sense(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path))
    status, message, told = run(capfd, "bench", "sense", "--quick", "--out", str(tmp_path / "b"))
    assert status == 0 and "estimators" not in message and "the table of estimators is left out" in told
    names = [row["name"] for row in message["rows"]]
    assert sum("numpy" in name for name in names) == 2 and any("training batch" in name for name in names)
    assert all(row["same_law_p"] is None or row["same_law_p"] > 1e-4 for row in message["rows"])
    assert all(row["error"] < 0.02 and row["max_deviation_se"] < 6 for row in message["rows"]), message["rows"]
    with (tmp_path / "b" / "bench-sense.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(message["rows"])


def test_the_figure_shows_pixels_by_a_stated_rule_with_their_rates_over_the_counts(scene, tmp_path, monkeypatch):
    """At 10 + 200 photons the rate still peaks at the true depth, where counts alone would not."""
    budget = PhotonBudget(10, 200)
    histogram = sense(scene, sensor_by_name("reference"), budget, seed=1)
    shown = pixels.shown_pixels(histogram)
    signal = histogram.expected_signal
    for name, rank in (("dark", 0.1), ("median", 0.5), ("bright", 0.9)):
        below = (signal < signal[shown[name]]).mean()
        assert abs(below - rank) < 0.02  # 80 pixels
    mixed = replace(histogram, mixed=signal > np.median(signal))
    assert all(not mixed.mixed[place] for place in pixels.shown_pixels(mixed).values())
    kept = []
    monkeypatch.setattr(pixels, "save", lambda figure, path: kept.append(figure) or path)
    rate = partial(expected_in_pixel, scene, histogram.sensor, budget)
    pixels.draw_histogram(histogram, tmp_path / "h.png", expected=rate)
    panels = {axes.get_title().split(" pixel")[0]: axes for axes in kept[0].axes if " pixel (" in axes.get_title()}
    assert [*panels] == ["dark", "median", "bright"]
    for name, axes in panels.items():
        counts, expected = axes.patches
        depth_ns = 2e9 * float(histogram.depth_m[shown[name]]) / SPEED_OF_LIGHT_M_PER_S
        values, edges, _ = expected.get_data()
        centre = 0.5 * (edges[values.argmax()] + edges[values.argmax() + 1])
        assert abs(centre - depth_ns) < 0.1  # one bin
        # every bin of the window, and no other
        bars, edges, _ = counts.get_data()
        first = round(edges[0] / (1e9 * histogram.sensor.bin_width_s))
        assert np.array_equal(bars, histogram.counts[shown[name]][first : first + bars.size])
        low, high = axes.get_xlim()
        assert edges[0] <= low < edges[1] and edges[-2] < high <= edges[-1] and low < depth_ns < high


def drawn(histogram: Histogram, monkeypatch: pytest.MonkeyPatch) -> list[Axes]:
    """Return the panels of pixels in the histogram's figure."""
    kept = []
    monkeypatch.setattr(pixels, "save", lambda figure, path: kept.append(figure) or path)
    pixels.draw_histogram(histogram, Path("h.png"))
    return [axes for axes in kept[0].axes if " pixel (" in axes.get_title()]


def test_the_figure_of_measured_counts_makes_nothing_up(scene, monkeypatch):
    """Without a truth there is no signal, no ratio and no true depth: pixels are ranked by what was counted."""
    counts = sense(scene, sensor_by_name("reference"), PhotonBudget(10, 200), seed=1).counts
    panels = drawn(Histogram.from_counts(counts, sensor_by_name("reference")), monkeypatch)
    figure, total = panels[0].figure, counts.sum(axis=2)
    assert "expected" not in " ".join([figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)])
    for axes, rank in zip(panels, (0.1, 0.5, 0.9), strict=True):
        row, column = map(int, axes.get_title().split("(")[1].split(")")[0].split(","))
        assert axes.get_title().endswith(f" {total[row, column]:,} detections")
        assert abs((total < total[row, column]).mean() - rank) < 0.1
        assert not axes.lines


def test_no_pixel_is_shown_twice(scene):
    """Show the brighter one of two pixels as the bright one."""
    two = sense(
        transient_from_rgbd(np.array([[2.0, 3.0]]), np.ones((1, 2)), np.zeros((1, 2))), Sensor(), PhotonBudget(9, 0)
    )
    assert pixels.shown_pixels(two) == {"median": (0, 1), "bright": (0, 0)}


def test_the_figure_draws_true_depth_where_its_light_arrives(scene, monkeypatch):
    """A record shorter than the period, and a laser beside the camera."""
    sensor = Sensor(name="gated", bins=128, bin_width_s=9.1e-11, period_s=2.73e-8)
    histogram = sense(scene, sensor, PhotonBudget(10, 200), seed=1)
    record_ns = 1e9 * sensor.bins * sensor.bin_width_s
    camera = {"pose": np.eye(4).tolist(), "fov_deg": 40.0, "width": 10, "height": 8}
    for laser in ({}, {"mode": "flood", "baseline_m": [0.3, 0.0, 0.0]}):
        transient = {**histogram.meta["transient"], "laser": laser, "camera": camera}
        seen = replace(histogram, meta={**histogram.meta, "transient": transient})
        arrival_ns = 1e9 * true_arrival_s(seen)
        for axes, place in zip(drawn(seen, monkeypatch), pixels.shown_pixels(seen).values(), strict=True):
            lines = [line.get_xdata()[0] for line in axes.lines if len(line.get_xdata())]
            assert lines == ([pytest.approx(arrival_ns[place])] if arrival_ns[place] < record_ns else [])
    unrecorded = replace(histogram, depth_m=np.full_like(histogram.depth_m, 0.95 * sensor.range_m))
    words = [text.get_text() for axes in drawn(unrecorded, monkeypatch) for text in axes.get_legend().get_texts()]
    assert sum("after the record" in word for word in words) == 3
