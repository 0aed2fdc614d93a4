"""The studies of coding tensors: tables against what they are made of, figures that exist, mistakes in one line."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from csph import CompressiveLayer, Design
from csph.networks.checkpoint import load_model
from csph.weights.shipped import shipped_file
from render.engine import render
from render.settings import RenderSettings
from scene2spad import estimate_depth
from scene2spad.bench import encode as bench_encode
from scene2spad.cli import main
from scene2spad.studies import codes, memory, tensors
from scenes import Laser
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError
from scenes.library.catalog import load_scene
from spad.detection.detect import sense
from spad.estimators.depth import cramer_rao_m, depth_errors
from spad.measurements.histogram import Histogram
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.template import binned_pulse


def run(capfd, *argv: str) -> tuple[int, dict, str]:
    status = main([*argv, "--json"])
    out, err = capfd.readouterr()
    return status, json.loads(out) if status == 0 else {}, err


@pytest.fixture(scope="module")
def plane():
    scene = replace(load_scene("plane", width=8, height=6), laser=Laser("scan"))
    return render(scene, RenderSettings(bounces=1))


def test_photon_levels_are_the_papers():
    assert len(codes.LEVELS) == len(set(codes.LEVELS)) == 16
    low = [(s, b) for s, b in codes.LEVELS if s <= 0.1 * b]
    assert low == [(5, 50), (2, 50), (10, 200), (10, 500), (10, 1000), (50, 500), (50, 1000)]


def test_decoded_table_holds_what_each_depth_map_gives(plane):
    sensor = Sensor()
    histograms = [sense(plane, sensor, PhotonBudget(*level), seed=2) for level in ((1000, 10), (50, 50))]
    rows = codes.decoded_table(iter(histograms), ("fourier", "coarse"), (8, 32, 48))
    names = {(row.method, row.codes) for row in rows}
    assert names == {
        ("log-matched", 0),
        ("fourier", 8),
        ("fourier", 32),
        ("fourier", 48),
        ("coarse", 8),
        ("coarse", 32),
    }
    assert len(rows) == 2 * len(names)
    for row in rows:
        histogram = next(h for h in histograms if h.budget.signal == row.signal)
        depth = estimate_depth(histogram, f"{row.method}-{row.codes}" if row.codes else row.method)
        errors = depth_errors(depth, histogram.depth_m, range_m=sensor.range_m, exclude=histogram.mixed)
        assert (row.mae_mm, row.pixels) == (pytest.approx(errors["mae_mm"]), errors["pixels"])
    best = {(r.method, r.codes): r.mae_mm for r in rows if r.signal == 1000}
    assert best["log-matched", 0] < best["fourier", 32] < best["fourier", 8] < best["coarse", 8]


def test_the_bound_of_the_table_is_the_uncompressed_histograms():
    sensor, rng, shape = Sensor(), np.random.default_rng(5), (20, 20)
    depth = rng.uniform(1, 14, shape).astype(np.float32)
    arrival = torch.from_numpy(depth.astype(np.float64)) * 2 / SPEED_OF_LIGHT_M_PER_S
    rate = 200 * binned_pulse(arrival, sensor) + 20 / sensor.bins
    histogram = Histogram(
        rng.poisson(rate.numpy()).astype(np.int32),
        sensor,
        PhotonBudget(200, 20),
        depth_m=depth,
        mixed=np.zeros(shape, bool),
        expected_signal=np.full(shape, 200, np.float32),
        expected_background=np.full(shape, 20, np.float32),
        albedo=np.zeros(shape, np.float16),
    )
    row = codes.decoded_table([histogram], (), ())[0]
    deviation = cramer_rao_m(arrival, torch.tensor(200.0), torch.tensor(20 / sensor.bins), sensor)
    assert row.bound_mm == pytest.approx(1e3 * math.sqrt(2 / math.pi) * float(deviation.mean()), rel=1e-5)
    # the mean of 400 Gaussian |errors| has a relative standard deviation of 0.756 / 20 = 3.8 %
    assert 1 - 4 * 0.038 < row.mae_mm / row.bound_mm < 1.05 + 4 * 0.038
    assert row.median_abs_mm == pytest.approx(row.mae_mm * 0.6745 / 0.7979, rel=5 * 0.06)


def test_groups_are_means_over_their_levels():
    rows = [codes.Row("fourier", 8, s, b, s + b, 1.0, 0.5, 2.0, 9) for s, b in ((10, 10), (10, 100), (10, 1000))]
    (line,) = codes.by_group(rows)
    assert line["mae_mm_high_sbr"] == 20 and line["mae_mm_low_sbr"] == (110 + 1010) / 2
    assert line["mae_mm_all"] == pytest.approx((20 + 110 + 1010) / 3)


def test_histograms_of_two_sensors_make_no_table(plane):
    one, other = (sense(plane, sensor, PhotonBudget(10, 10)) for sensor in (Sensor(), Sensor(name="other")))
    with pytest.raises(InputError, match="one sensor"):
        codes.decoded_table([one, other], ("fourier",), (8,))


def test_study_codes_writes_a_table_and_a_figure(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr(codes, "LEVELS", ((50, 50), (5, 50)))
    monkeypatch.setattr(codes, "NUMBERS", (8,))
    argv = ("study", "codes", "--scene", "plane", "--width", "8", "--height", "6", "--out", str(tmp_path / "new"))
    status, result, err = run(capfd, *argv)
    assert status == 0, err
    assert {row["method"] for row in result["rows"]} == {"log-matched", *codes.CODES} and "figures" in result
    assert len((tmp_path / "new" / "codes.csv").read_text().splitlines()) == 1 + len(result["rows"])
    assert (tmp_path / "new" / "codes.png").read_bytes()[:4] == b"\x89PNG"


def test_study_memory_draws_figures_15_and_16(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "CODES", (64, 512))
    status, result, err = run(capfd, "study", "memory", "--out", str(tmp_path))
    assert status == 0, err
    assert [name.rsplit("/", 1)[1] for name in result["figures"]] == ["memory-full.png", "memory-separable.png"]
    full = np.array(result["ratios"]["memory-full"]["64"]["in-sensor storage"])
    n, b = 1e9, 1e4
    assert full[3, 4] == pytest.approx(n / (64 * (b + n / b)))
    thin = np.array(result["ratios"]["memory-separable"]["512"]["in-sensor storage"])
    assert thin[3, 4] == pytest.approx(n / (512 * (b + n / b / 16)))
    common = {line["claim"]: line for line in memory.statements()}
    assert sum(line["verdict"].startswith("off") for line in common.values()) == 2
    worst = [
        v for line in common.values() for key, v in line["recomputed"].items() if "1e+06" in key and "x 4 x 4" in key
    ]
    assert len(worst) == 2 and min(worst) > 1


def test_study_tensors_draws_the_papers_designs_and_any_other(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr(tensors, "RATIOS", {"tensors-128x": tensors.RATIOS["tensors-128x"]})
    status, result, err = run(capfd, "study", "tensors", "--out", str(tmp_path))
    assert status == 0, err
    drawn = result["tensors"]["tensors-128x"]
    assert [(t["codes"], t["parameters"]) for t in drawn] == [
        (8, 8192),
        (8, 8192),
        (8, 8192),
        (32, 8704),
        (128, 133120),
    ]
    # learned codes are those of the models that ship
    assert [t["name"] for t in drawn[2:]] == [
        f"learned-{block}-128x-s0" for block in ("1024x1x1", "256x4x4", "1024x4x4")
    ]
    assert drawn[1]["harmonics"] == [1, 1, 2, 2, 4, 4, 8, 8] and all(t["compression"] == 128 for t in drawn)
    assert (tmp_path / "tensors-128x.png").read_bytes()[:4] == b"\x89PNG"
    argv = ("--design", "hadamard+learned", "--block", "64", "2", "2", "--codes", "4", "--out", str(tmp_path))
    status, result, err = run(capfd, "study", "tensors", *argv)
    assert status == 0 and result["tensors"]["tensors-design"][0]["storage"] == 16, err


def test_study_tensors_draws_checkpoints(capfd, tmp_path):
    layer = CompressiveLayer.of(Design("learned", (32, 2, 2), 6))
    with torch.no_grad():
        layer.temporal[:, 16:] = 0  # as codes learned where no scene is far away
    state = {f"layer.{name}": value for name, value in layer.state_dict().items()}
    torch.save({"state_dict": {**state, "head.weight": torch.ones(3)}, "epoch": 3}, tmp_path / "trained.ckpt")
    np.save(tmp_path / "given.npy", np.random.default_rng(1).normal(size=(3, 16, 2, 2)).astype(np.float32))
    argv = ("--checkpoints", str(tmp_path / "trained.ckpt"), str(tmp_path / "given.npy"), "--out", str(tmp_path))
    status, result, err = run(capfd, "study", "tensors", *argv)
    assert status == 0, err
    trained, given = result["tensors"]["tensors-checkpoints"]
    assert (trained["codes"], trained["block"], trained["parameters"]) == (6, [32, 2, 2], 6 * 36)
    assert trained["later_half_energy"] < 0.05 and given["block"] == [16, 2, 2]
    assert torch.equal(tensors.coding_of(tmp_path / "trained.ckpt").spatial, layer.spatial.detach())


def test_study_tensors_takes_names_of_models(capfd, tmp_path):
    """As `evaluate` and `depth` do: a shipped name, a run's folder and its checkpoint; mistakes in one line."""
    name = "learned-64x4x4-128x-s0"
    file = shipped_file(name)
    argv = ("study", "tensors", "--out", str(tmp_path), "--checkpoints")
    status, result, err = run(capfd, *argv, name, str(file), str(file.parent))
    assert status == 0, err
    drawn = result["tensors"]["tensors-checkpoints"]
    assert drawn[0]["name"] == name and drawn[0]["block"] == [64, 4, 4] and drawn[0]["compression"] == 128
    assert drawn[1:] == drawn[:1] * 2
    assert torch.equal(tensors.coding_of(Path(name)).temporal, load_model(file)[0].codes_layer.coding().temporal)
    for given, words in (
        ("learned-64x4x4", "learned-64x4x4: file not found, and model 'learned-64x4x4' is unknown, like learned-"),
        ("none-s0", "a network without codes, it takes the counts themselves"),
    ):
        status, _, err = run(capfd, *argv, given)
        assert status == 2 and words in err and len(err.splitlines()) == 1


def test_rows_are_scaled_between_their_extremes():
    scaled = tensors.row_scaled(torch.tensor([[0.0, 1.0, 4.0], [2.0, 2.0, 2.0]]))
    assert scaled.tolist() == [[-1.0, -0.5, 1.0], [0.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["study", "tensors", "--design", "haar"], "'haar' is unknown"),
        (["study", "tensors", "--design", "fourier"], "no spatial part"),
        (["study", "tensors", "--design", "learned", "--codes", "0"], "0 codes"),
        (["study", "tensors", "--checkpoints", "missing.ckpt"], "missing.ckpt: file not found"),
        (["study", "tensors", "--checkpoints", "words.ckpt"], "words.ckpt: no checkpoint"),
        (["study", "tensors", "--checkpoints", "empty.ckpt"], "holds 0 coding tensors"),
        (["study", "tensors", "--checkpoints", "line.npy"], "line.npy: shape (4,), expected codes"),
        (["study", "tensors", "--checkpoints", "huge.npy"], "huge.npy: states shape (40000000000,)"),
        (["study", "codes", "--scene", "castle"], "castle"),
        (["study", "memory", "--out", "words.ckpt"], "words.ckpt: is a file"),
        (["study", "everything"], "everything"),
        (["bench", "encode", "--repeats", "0"], "repeats 0"),
    ],
)
def test_mistakes_end_in_one_line(capfd, tmp_path, monkeypatch, argv, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "words.ckpt").write_text("no tensors")
    torch.save({"weight": torch.ones(2)}, tmp_path / "empty.ckpt")
    np.save(tmp_path / "line.npy", np.ones(4))
    line = (tmp_path / "line.npy").read_bytes()
    (tmp_path / "huge.npy").write_bytes(line.replace(b"(4,), }          ", b"(40000000000,), }"))
    files = {path.name for path in tmp_path.iterdir()}
    status, _, err = run(capfd, *argv)
    assert status == 2 and message in err and len(err.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize("code", ["gray", "coarse", "hadamard", "random"])
def test_depth_decodes_every_temporal_code(capfd, tmp_path, monkeypatch, code):
    monkeypatch.chdir(tmp_path)
    main(["render", "sphere", "--width", "8", "--height", "6", "--no-figure", "--bounces", "1"])
    main(["sense", "sphere.exr", "--signal", "1000", "--background", "1", "--no-figure"])
    capfd.readouterr()
    argv = ("depth", "sphere.h5", "--method", "compressive", "--code", code, "--codes", "64")
    status, result, err = run(capfd, *argv)
    assert status == 0, err
    assert result["method"] == f"{code}-64" and result["unmixed"]["mae_mm"] < (150 if code == "coarse" else 50)
    status, _, err = run(capfd, *argv[:-1], "3000")
    assert status == 2 and "3000" in err


def test_bench_encode_measures_the_same_layer_in_both_forms(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_encode, "SIZE", (64, 8, 8))
    monkeypatch.setattr(bench_encode, "BATCH", 1)
    small = (
        Design("learned", (64, 4, 4), 8, full=True),
        Design("learned", (16, 2, 2), 4),
        Design("learned", (64, 1, 1), 4),
    )
    monkeypatch.setattr(bench_encode, "DESIGNS", small)
    status, result, err = run(capfd, "bench", "encode", "--repeats", "1", "--out", str(tmp_path))
    assert status == 0, err
    assert {row["part"] for row in result["rows"]} == {"layer", "encode"} and len(result["rows"]) == 3 * (2 + 4)
    assert all(row["error"] < 1e-4 and row["seconds"] > 0 for row in result["rows"])
    assert {path.name for path in tmp_path.iterdir()} == {f"bench-encode.{end}" for end in ("csv", "json", "png")}
    assert json.loads((tmp_path / "bench-encode.json").read_text())["rows"] == result["rows"]


def test_both_ways_to_a_dense_histogram_agree():
    stamps, offsets = bench_encode.photons(np.random.default_rng(3), 2, (32, 4, 4))
    one, other = (way(stamps, offsets, (32, 4, 4)) for way in (bench_encode.dense, bench_encode.dense_of_sensor))
    assert torch.equal(one, other) and int(one.sum()) == len(stamps)


def test_the_bound_is_not_hidden_behind_the_legend(tmp_path, monkeypatch):
    """The legend lies outside every panel, and the line of the Cramer-Rao bound inside its own."""
    kinds = [f"{kind}_{group}" for kind in ("mae_mm", "median_abs_mm", "bound_mm") for group in codes.GROUPS]
    lines = [
        {"method": method, "codes": number, **dict.fromkeys(kinds, 100.0 / (number or 512) + 1)}
        for method, number in (("log-matched", 0), ("fourier", 8), ("fourier", 64))
    ]
    kept = []
    monkeypatch.setattr(codes, "save", lambda figure, path: kept.append(figure) or path)
    codes.draw(lines, "made up", tmp_path / "codes.png")
    (figure,) = kept
    figure.canvas.draw()
    (legend,) = figure.legends
    panels = [axes.get_window_extent() for axes in figure.axes]
    assert all(axes.get_legend() is None for axes in figure.axes)
    assert not any(panel.overlaps(legend.get_window_extent()) for panel in panels)
    assert "Cramer-Rao, uncompressed" in [text.get_text() for text in legend.get_texts()]
    for axes in figure.axes[:2]:
        bound = next(line for line in axes.lines if line.get_label() == "Cramer-Rao, uncompressed")
        low, high = axes.get_ylim()
        assert low < bound.get_ydata()[0] < high
