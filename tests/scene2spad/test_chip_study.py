"""`study chip` and the front of `study power`: pairs, verdicts, the front itself, and photons that busy cores lose."""

import json

import numpy as np
import pytest

from csph.levels import PHOTON_LEVELS
from scene2spad.cli import main
from scene2spad.networks.lookup import found_only
from scene2spad.options.experiments import Study
from scene2spad.studies.chip.plan import MAIN, SMOKE, Plan
from scene2spad.studies.chip.study import compared_rows, in_words, interval_in_words
from scene2spad.studies.power.front import (
    LOST_LIMIT,
    Design,
    costs_of,
    loss_rows,
    lost,
    most_photons_per_s,
    printed_rows,
)
from scene2spad.studies.power.front import designs as designs_of
from scene2spad.studies.power.front_figure import ENERGY, front, power_uw
from scene2spad.studies.power.plan import WANTED
from ultraphase import method
from ultraphase.power import measured_cost, sweep


def test_models_are_compared_in_pairs():
    random = np.random.default_rng(0)
    # two views of each scene at 16 levels: views are no levels
    hard = {f"scene {n}": 50 + 40 * random.random((1, 32)) for n in range(8)}
    values = {
        "a": hard,
        "a on the chip": {scene: 1.004 * v + 0.1 * random.normal(size=v.shape) for scene, v in hard.items()},
    }
    values |= {"b": hard, "b on the chip": {scene: 1.03 * v for scene, v in hard.items()}}
    first, second = compared_rows("set", {"a": "a", "b": "a"}, values, 16)
    assert first["difference"] == pytest.approx(0.004, abs=0.001) and first["holds"] is True
    assert first["low"] < first["difference"] < first["high"] and (first["scenes"], first["levels"]) == (8, 16)
    assert second["difference"] == pytest.approx(0.03, abs=1e-6) and second["holds"] is False
    alone = {name: {"only": next(iter(v.values()))} for name, v in values.items()}
    (single,) = compared_rows("set", {"a": "a"}, alone, 16)
    assert single["holds"] is None and "no interval: one scene" in in_words(single)
    assert "nan" not in in_words(single) and " to +" in in_words(first)


def test_the_plan_is_the_papers_levels_and_four_designs():
    assert Plan().levels == PHOTON_LEVELS and len(Plan().levels) == 16
    assert {(one.design, one.block, one.compression) for one in MAIN} == {
        ("fourier+learned", (256, 2, 2), 128),
        ("fourier+learned", (256, 2, 2), 64),
        ("fourier", (1024, 1, 1), 128),
        ("fourier", (1024, 1, 1), 64),
    }


def test_the_front_holds_what_nothing_else_beats():
    places = np.array([[1, 9], [2, 5], [2, 4], [3, 4], [4, 1], [5, 2]], float)
    assert front(places).tolist() == [[1, 9], [2, 4], [4, 1]]


def test_the_rate_at_which_a_core_loses_one_in_a_hundred():
    for clocks in (24.0, 132.0, 519.0):
        rate = most_photons_per_s(np.array([clocks]))
        assert lost(np.array([clocks]), rate) == pytest.approx(LOST_LIMIT, rel=1e-6)
        assert lost(np.array([clocks]), 1.1 * rate) > LOST_LIMIT


def test_published_points_have_the_printed_power_of_a_pixel():
    rows = {row["name"]: row for row in printed_rows()}
    assert rows["separable-16"]["mae_mm"] == 12.3 and rows["fourier-8"]["mae_mm"] == 40.34
    for row in rows.values():
        assert row["processing_uw_published"] == pytest.approx(row["published"]["processing_uw"] / 4, rel=6e-3)
        assert row["readout_uw"] == pytest.approx(row["published"]["readout_uw"] / 4, rel=6e-3)


def test_power_has_the_columns_of_the_sweep_and_the_figure_adds_the_frames_end():
    """Find photons and frame end apart, under one name in the front and in the sweep."""
    coarse = method("coarse-16")
    cost = measured_cost(coarse, None)
    one = Design("coarse", coarse.codes, cost, np.array([cost.clocks_per_photon]), coarse.program(), {}, coarse=coarse)
    mine = costs_of(one, 550.0, 30.0)
    (swept,) = [row for row in sweep({"coarse": cost}, [550.0], [30.0], [1]) if row["name"] == "coarse"]
    for name in ENERGY:
        assert mine[name] == pytest.approx(swept[name]) and mine[name] > 0
    parts = [mine[name] for name in ("processing_uw_energy", "frame_end_uw_energy", "readout_uw")]
    assert power_uw(ENERGY, mine) == pytest.approx(sum(parts))
    paper = printed_rows()[0]
    assert power_uw(ENERGY, paper) == paper["processing_uw_energy"] + paper["readout_uw"]


@pytest.mark.slow
def test_busy_cores_of_every_design_lose_what_the_closed_form_says(tmp_path):
    models = found_only(WANTED, Study(name="power", out=tmp_path))
    found = designs_of(models.found)
    assert {one.codes for one in found} >= {8, 16, 256}
    assert all(one.int8 or one.compression == 64 for one in models.absent)
    for row in loss_rows(found, 0, lambda what, fraction: None):
        for spads in ("one_spad", "16_spads"):
            expected = row[f"closed_form_{spads}"]
            spread = 2 * np.sqrt(expected / row[f"arrived_{spads}"])
            assert abs(row[f"emulated_{spads}"] - expected) < 5 * spread


@pytest.mark.slow
def test_study_chip_at_toy_size(capfd, tmp_path):
    assert main(["study", "chip", "--preset", "smoke", "--out", str(tmp_path), "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert {row["set"] for row in result["compared"]} >= {"tabletop", "rooms"}
    for row in result["interpreted"]:
        assert row["differs_from_torch"] == row["differs_from_fast"] == 0 < row["photons"]
    first, second, trained = (row["name"] for row in result["models"])
    pairs = {(row["model"], row["beside"]) for row in result["compared"]}
    headroom = ", 1 bit of headroom,"
    assert pairs == {
        *((first, first), (second, second), (trained, second)),
        *((f"{first}{headroom}", first), (f"{second}{headroom}", second)),
    }
    still = [row for row in result["compared"] if row["set"] == "tabletop" and "int8" not in row["model"]]
    assert all(abs(row["difference"]) < 0.1 for row in still)
    counts = {(row["set"], row["levels"]) for row in result["compared"]}
    assert {("tabletop", len(SMOKE.levels)), ("rooms", len(SMOKE.other_levels))} <= counts
    assert {path.rsplit("/", 1)[1] for path in result["csv"]} >= {"chip.csv", "chip-compared.csv"}


def test_ends_of_an_interval_are_told_where_there_are_any():
    assert interval_in_words(-0.012, 0.034, 1, "view") == "-1.2% to +3.4%"
    assert interval_in_words(np.nan, np.nan, 1, "view") == "no interval: one view"
