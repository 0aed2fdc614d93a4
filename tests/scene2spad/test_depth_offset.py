"""`study depth-offset`: its numbers against closed forms, the published convention, and a run that is interrupted."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from csph.evaluation.methods import Row
from csph.networks.checkpoint import load_model
from csph.weights.cards import shipped_model
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import random_planes
from scene2spad.networks import published
from scene2spad.networks.registry import EvaluatedModel, ModelRegistry, ModelSpec
from scene2spad.networks.results import Store
from scene2spad.networks.test_sets import TestSet, evaluated
from scene2spad.studies.depth_offset import figures, tables
from scene2spad.studies.depth_offset import plan as plans
from scene2spad.studies.depth_offset import study as depth_offset
from spad.detection.detect import sense
from spad.formats.rgbd import published_from_rgbd, published_taps
from spad.sensor.model import PhotonBudget, Sensor

SENSOR = Sensor()


class Counting(torch.nn.Module):
    """In a network's place: the mean position of a pixel's detections, and how often it was asked."""

    asked = 0

    def depth_of(self, histogram, *, decoder=None):
        type(self).asked += 1
        counts = histogram.counts.astype(np.float64)
        centres = np.arange(histogram.sensor.bins) + 0.5
        return (counts @ centres / np.maximum(counts.sum(-1), 1) * histogram.sensor.bin_depth_m).astype(np.float32), 0


def row(name: str, mae: float, level=(10.0, 10.0), scene="a", group="all") -> Row:
    return Row(name, scene, 0, *level, group, mae, mae, 0.0, 0.0, 0.5, 1.0, 0.0, 4, 0, 0)


# Numbers


def test_plans_ask_for_the_models_that_the_bars_need():
    headline = plans.Plan().headline
    for design, block in tables.BARS:
        mine = [w for w in headline if (w.design, w.block) == (design, block)]
        assert sorted((w.compression, w.seed) for w in mine) == [(64, 0), (128, 0), (128, 1), (128, 2)]
    assert len({w.name for w in plans.Plan().wanted}) == len(plans.Plan().wanted) == 20
    full = plans.plan_of("laptop", True)
    assert {w.compression for w in full.headline} == {32, 64, 128, 256} and len(full.levels) == 16
    assert len(plans.plan_of("smoke", False).wanted) == 2


def test_bars_are_geometric_means_over_seeds_then_compressions():
    wanted = [w for w in plans.Plan().headline if w.block == (1024, 4, 4)]
    ratios = {(64, 0): 2.0, (128, 0): 4.0, (128, 1): 8.0, (128, 2): 16.0}
    near = [row(w.name, 10.0) for w in wanted]
    far = [row(w.name, 10 * ratios[w.compression, w.seed]) for w in wanted]
    found = tables.ratio_rows(near, far, wanted)
    assert {(r["compression"], r["seed"]): r["ratio"] for r in found} == pytest.approx(ratios)
    by_design = {v["design"]: v for v in tables.verdicts(found, wanted)}
    long = by_design["learned 1024x4x4"]
    assert long["geometric_mean"] == pytest.approx(math.sqrt(2 * 8)) and long["holds"] is True
    assert sorted(long["128x"]) == [4.0, 8.0, 16.0]
    assert by_design["learned 256x4x4"]["holds"] is None
    halved = [{**r, "ratio": r["ratio"] / 2} for r in found]
    assert {v["design"]: v for v in tables.verdicts(halved, wanted)}["learned 1024x4x4"]["holds"] is False


def test_mean_error_takes_one_model_the_levels_asked_for_and_all_pixels():
    rows = [row("a", 1.0), row("a", 3.0, scene="b"), row("a", 50.0, (10.0, 200.0)), row("b", 9.0)]
    rows += [row("a", 1000.0, group="mixed")]
    assert tables.mean_error(rows, "a", [(10.0, 10.0)]) == 2.0
    assert tables.mean_error(rows, "a") == 18.0 and math.isnan(tables.mean_error(rows, "c"))


def test_energy_ratio_of_a_step_and_of_groups():
    energy = np.where(np.arange(1024) < 600, 4.0, 1.0)
    assert tables.energy_ratio(energy, 1024, 600) == pytest.approx(0.25)
    # 600 bins are 37.5 groups of 16: the group in between counts to both sides
    grouped = energy.reshape(64, 16).mean(1)
    inside, beyond = (37 * 4.0 + 0.5 * 2.5) / 37.5, (26 * 1.0 + 0.5 * 2.5) / 26.5
    assert tables.energy_ratio(grouped, 1024, 600) == pytest.approx(beyond / inside)


def test_no_return_from_the_reach_falls_beyond_the_boundary():
    boundary = tables.boundary_bin(7.0, SENSOR)
    after_m = 3 * 135e-12 * 299792458 / 2
    assert boundary == math.ceil((7.0 + after_m) / SENSOR.bin_depth_m)


def test_intervals_of_errors_and_shares_end_at_0_and_shares_at_1():
    """Student's of two scenes, one hard and one easy, reaches beyond."""
    one = ModelSpec()
    for hard, easy, ends in (((600.0, 0.0), (5.0, 0.1), 0), ((600.0, 1.0), (5.0, 0.8), 1)):
        rows = [
            replace(row(one.name, mae, scene=scene), within_10mm=within)
            for scene, (mae, within) in (("a", hard), ("b", easy))
        ]
        found = tables.summary_rows(rows, [one], {})[0]
        assert found["mae_mm_low"] == 0 and found["mae_mm_high"] > 4000
        assert found["within_10mm_low" if ends == 0 else "within_10mm_high"] == ends


@pytest.mark.parametrize(("reach_m", "named"), [(7.0, 2), (9.5, 1), (20.0, 0)])
def test_the_legend_of_the_sweep_names_what_is_on_its_axis(monkeypatch, tmp_path, reach_m, named):
    """Depths of 1 to 4 m leave 7 m at 3 to 6 m; half of them leave 9.5 m beyond an axis of 6 m; none leaves 20 m."""
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or path)
    curves = [{"label": "learned 1024x1x1", "mae_mm": [10.0, 20.0, 30.0]}]
    found = {"offsets_m": [0.0, 3.0, 6.0], "curves": curves, "training_reach_m": reach_m, "levels": [[10, 10]]}
    figures.sweep({**found, "test_depths_m": [1.0, 2.0, 4.0], "scenes": 2}, tmp_path / "sweep.png")
    (legend,) = drawn[0].legends
    assert sum("test depths" in text.get_text() for text in legend.get_texts()) == named


def test_ratios_are_drawn_where_their_means_are_and_every_mark_is_named(monkeypatch, tmp_path):
    """With --full, 32x and 256x were triangles that no title named and no mean held."""
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or path)
    rows = [{"design": "learned 1024x1x1", "compression": c, "seed": 1, "ratio": c / 8} for c in (32, 64, 128, 256)]
    figures.every_seed(rows, [], tmp_path / "ratios.png")
    (panel,) = drawn[0].axes
    assert sorted(line.get_ydata()[0] for line in panel.lines if line.get_marker() in "os^v") == [8, 16]
    assert "circles 128x, squares 64x;" in panel.get_title() and "triangles" not in panel.get_title()
    assert figures.marks_in_words((32, 256)) == "triangles 32x, triangles on their tips 256x"


def test_a_break_lies_where_the_error_doubles():
    assert tables.break_m([0, 1, 2, 3], [10, 10, 30, 400]) == pytest.approx(1.5)
    assert tables.break_m([0, 1], [10, 20]) is None and tables.break_m([0.0], [10.0]) is None


def test_a_time_offset_leaves_every_pixel_its_signal():
    transient = random_planes(1, size=16, seed=3).transients[0]
    near, far = (sense(t, SENSOR, PhotonBudget(20, 0), seed=5) for t in (transient, transient.delayed(2.0)))
    np.testing.assert_array_equal(near.counts.sum(2), far.counts.sum(2))


# Kept results


def test_results_are_computed_once_and_shared_by_parts_of_a_set(tmp_path):
    views = random_planes(2, size=10, seed=1)
    test, store = TestSet("planes", views), Store(tmp_path)
    far = test.delayed(1.0)
    one = EvaluatedModel("one", Counting(), "1" * 64)
    levels = ((10.0, 10.0), (50.0, 50.0))
    Counting.asked = 0
    rows = evaluated(store, [one], far, levels, maps=(0,))
    assert Counting.asked == 4 and len(rows) == 4 * 3
    again = evaluated(Store(tmp_path), [one], far, levels, maps=(0,))
    assert repr(again) == repr(rows)  # NaN is not NaN
    first = evaluated(Store(tmp_path), [one._replace(name="again")], far.first(1), levels)
    assert Counting.asked == 4 and {r.method for r in first} == {"again"}
    evaluated(Store(tmp_path), [one], far, levels, maps=(1,))  # the maps of another view
    assert Counting.asked == 6
    evaluated(Store(tmp_path), [one], test, levels[:1])
    evaluated(Store(tmp_path), [one], far, levels[:1], seed=1)
    assert Counting.asked == 10


# The published convention


def test_published_numbers_are_those_recorded(shared_data):
    recorded = shared_data.parent / "reference/published_results.csv"
    if not recorded.is_file():
        pytest.skip("no recorded results beside the project")
    lines = [r for r in csv.DictReader(recorded.open()) if r["mid_largedepth_mae"] and r["enc"] != "none"]
    checked = 0
    for line in lines:
        name = {"Rand": "learned", "TruncFourier": "fourier"}.get(line["init"])
        block, ratio = (int(line["Mt"]), int(line["Mr"]), int(line["Mr"])), round(float(line["CR"]))
        ours = published.PUBLISHED.get((name, block), {}).get(ratio)
        if ours is not None:
            columns = ("mid_mae", "mid_rmse", "mid_largedepth_mae", "mid_largedepth_rmse")
            assert [1e3 * float(line[c]) for c in columns] == pytest.approx([*ours], abs=0.01)
            checked += 1
    assert checked == 9


def test_arrival_lies_where_the_published_pulse_has_its_centroid(tmp_path):
    """The mean of all detections of a signal without background: no error against the arrival, 0.44 bins early
    against the published label."""
    rng = np.random.default_rng(2)
    pair = published.Pair("ramp", rng.uniform(1.2, 2.5, (16, 24)), np.full((16, 24), 0.5))
    level = (50.0, 1000.0)
    histogram = published.sensed_pair(pair, level, 0.0, (0, 0, 0))
    assert histogram.counts.mean() * SENSOR.bins == pytest.approx(1050, rel=0.01)
    bright = published_from_rgbd(pair.depth_m, pair.luma, pair.luma, SENSOR, PhotonBudget(1e5, 0))
    counts = np.round(bright.rates).astype(np.int32)
    clean = SimpleNamespace(counts=counts, sensor=SENSOR, depth_m=bright.depth_m.astype(np.float32))
    errors = published.errors_as_published(Counting(), clean, "soft-argmax")
    taps = published_taps(SENSOR)
    early_mm = 1e3 * (taps.argmax() - taps @ np.arange(len(taps))) * 3e8 * SENSOR.bin_width_s / 2
    assert errors["mae_mm_arrival"] < 0.1
    assert errors["mae_mm_label"] == pytest.approx(early_mm, abs=0.1) and 6.3 < early_mm < 6.6
    # one that is sure of the first bin, half a bin deep but for rounding
    first = np.full(pair.depth_m.shape, np.nextafter(np.float32(0.5 * SENSOR.bin_depth_m), np.float32(0)))
    least = published.errors_as_published(SimpleNamespace(depth_of=lambda *_, **__: (first, 0)), clean, "median")
    assert least["mae_mm_label"] == pytest.approx(1e3 * clean.depth_m.mean(), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "low", "high"), [("Art", 1.411, 2.192), ("Laundry", 1.295, 2.328), ("Bowling1", 1.151, 2.022)]
)
def test_pairs_have_the_published_size_and_depths(shared_data, monkeypatch, name, low, high):
    monkeypatch.setenv("SCENE2SPAD_DATA", str(shared_data))
    pair = next(p for p in published.pairs() if p.name == name)
    assert pair.depth_m.shape == pair.luma.shape == ((72, 80) if name == "Bowling1" else pair.luma.shape)
    # the published minimum and maximum over valid pixels; a cubic may overshoot, and filling adds no nearer depth
    assert pair.depth_m.min() == pytest.approx(low, abs=0.03) and pair.depth_m.max() == pytest.approx(high, abs=0.06)


def test_published_rows_stand_beside_ours(tmp_path):
    wanted = ModelSpec("learned", (1024, 4, 4), 128)
    figures = {"mae_mm_label": 8.0, "mae_mm_arrival": 5.0, "rmse_mm_label": 9.0}
    rows = [
        {
            "model": wanted.name,
            "pair": pair,
            "offset_m": metres,
            "signal": 1,
            "background": 1,
            **{k: v + metres for k, v in figures.items()},
        }
        for pair in ("Art", "Books")
        for metres in (0.0, 7.0)
    ]
    (line,) = published.beside_ours(rows, [wanted], (0.0, 7.0))
    assert line["of"] == "2 of 8 scenes, 1 of 16 levels"
    assert line["far_mae_mm_arrival"] == 12.0 and line["far_published_mae_mm"] == 284.86


# The command


def run(out: Path, *more: str) -> int:
    return main(["study", "depth-offset", "--preset", "smoke", "--out", str(out), "--json", *more])


def test_evaluate_on_the_published_pairs_reads_both_decoders(tmp_path, monkeypatch, capfd):
    """Ours against the arrival, those of the published grid against the label; soft-argmax as the study has it."""
    rng = np.random.default_rng(5)
    pair = published.Pair("made-up", 1.5 + 0.2 * rng.random((16, 16)), 0.2 + 0.6 * rng.random((16, 16)))
    monkeypatch.setattr(published, "pairs", lambda count=None: [pair])
    monkeypatch.setattr(published, "PHOTON_LEVELS", ((50.0, 50.0),))
    name = "learned-256x4x4-128x-s0"
    assert main(["evaluate", name, "--set", "published", "--out", str(tmp_path), "--json"]) == 0
    message = json.loads(capfd.readouterr().out.splitlines()[-1])
    soft, median = message["rows"]
    assert (soft["decoder"], median["decoder"]) == ("soft-argmax", "median") and soft["reference"] == "arrival"
    model = load_model(shipped_model(name))[0]
    drawn = published.sensed_pair(pair, (50.0, 50.0), 0.0, (0, 0, 0))
    assert soft["mae_mm"] == published.errors_as_published(model, drawn, "soft-argmax")["mae_mm_arrival"]
    assert len(message["means"]) == 2 and (tmp_path / "evaluation-published.csv").is_file()
    assert 0 < median["mae_mm"] < 100


def test_no_model_and_bad_models_are_one_line(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr("scene2spad.networks.lookup.WEIGHTS", tmp_path)
    (tmp_path / "empty").mkdir()
    assert main(["study", "depth-offset", "--out", str(tmp_path), "--models", str(tmp_path / "empty")]) == 2
    out, err = capfd.readouterr()
    assert out == "" and "holds none of the 20 models" in err.splitlines()[-1] and "Traceback" not in err


def test_training_depths_are_the_models_own_or_those_of_the_set_given(tmp_path):
    packed = tmp_path / "planes.h5"
    views = random_planes(4, size=16, seed=6)
    write_pack(((t, {"scene": s}) for t, s in zip(views.transients, views.scenes, strict=True)), packed)
    silent = SimpleNamespace(config=SimpleNamespace(data={}))
    message = SimpleNamespace(config=SimpleNamespace(data={"training_reach_m": 6.5}))
    options = (plans.SMOKE, Store(tmp_path / "r"), tmp_path, 0, None)
    session = depth_offset.Session(options[0], {ModelSpec(): silent}, *options[1:], packed)
    depth = np.concatenate([t.depth_m[np.isfinite(t.depth_m)] for t in views.transients[:3]])
    assert session.reach_m == pytest.approx(float(np.quantile(depth, 0.999)), abs=0.5)
    session = depth_offset.Session(options[0], {ModelSpec(): silent, ModelSpec(seed=1): message}, *options[1:], packed)
    assert session.reach_m == 6.5
    assert depth_offset.Session(options[0], {ModelSpec(): silent}, *options[1:]).reach_m is None


@pytest.mark.slow
def test_interrupted_and_resumed_repeats_nothing(capfd, tmp_path, monkeypatch):
    """Stopped in training, in rendering, and three times in evaluation: as many results are computed as in a run that
    is left alone, and the numbers are the same."""
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path))
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    assert run(tmp_path / "whole") == 0
    message = json.loads(capfd.readouterr().out)
    assert len(message["figures"]) == 8 and all(Path(name).is_file() for name in message["figures"])
    assert message["absent"] == [] and message["published"] == [] and message["relief"] == []
    assert {row["mode"] for row in csv.DictReader((tmp_path / "whole/depth-offset.csv").open())} == {
        "time", "ray", "rigid",
    }  # fmt: skip

    counts = {"put": 0, "stop": 0}
    put, fraction = Store.put, ModelRegistry.train

    def counted(self, *values, **key):
        counts["put"] += 1
        if counts["put"] == counts["stop"]:
            raise KeyboardInterrupt
        put(self, *values, **key)

    def stopped(self, wanted, preset, training, progress):
        fraction(self, wanted[:1], preset, training, progress)
        raise KeyboardInterrupt

    results = tmp_path / "whole/smoke/results"
    whole = sum(len(path.read_text().splitlines()) for path in results.glob("*.jsonl"))
    monkeypatch.setattr(ModelRegistry, "train", stopped)
    assert run(tmp_path / "cut") == 130
    monkeypatch.setattr(ModelRegistry, "train", fraction)
    monkeypatch.setattr(Store, "put", counted)
    for stop in (3, 8, whole):
        counts["stop"] = stop
        assert run(tmp_path / "cut") == 130
    counts["stop"] = 0
    assert run(tmp_path / "cut") == 0
    assert counts["put"] == whole + 3  # each interruption lost the result that it stopped
    for name in ("depth-offset.json", "depth-offset.csv", "depth-offset-summary.csv"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
