"""Laws that evaluations draw photons by, and what is said of them."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from csph.evaluation.exposures import PlanLine, Plans, asked_law
from csph.evaluation.methods import EvaluationPlan, evaluate
from csph.levels import PHOTON_LEVELS
from csph.training.views import Views
from render.transient.packs import write_pack
from scene2spad.cli import main
from scene2spad.datasets.planes import wall
from scene2spad.networks.training import baseline
from spad.detection.detect import sense
from spad.estimators.depth import estimate_depth
from spad.sensor.model import PhotonBudget, Sensor

BRIGHT = PhotonBudget(600, 600)
FEW_CYCLES = replace(Sensor(), exposure_s=1000 * Sensor().period_s)  # 1.2 detections a cycle


@pytest.mark.parametrize("law", ["poisson", "first-photon"])
def test_coates_undoes_the_law_that_drew_the_photons_and_no_other(law):
    """Poisson counts are more than cycles here: undone as first photons, they were refused."""
    histogram = sense(wall(9.0, 4), FEW_CYCLES, BRIGHT, model=law)
    found, matched = (baseline(name)(histogram) for name in ("coates", "log-matched"))
    if law == "poisson":
        np.testing.assert_allclose(found, matched, atol=1e-3)
    else:
        undone = estimate_depth(torch.from_numpy(histogram.counts), FEW_CYCLES, "coates", law=law)
        np.testing.assert_array_equal(found, undone)
        errors = [np.abs(depth - histogram.depth_m).mean() for depth in (found, matched)]
        assert errors[0] < 0.5 * errors[1]


@pytest.fixture
def walls(tmp_path, monkeypatch) -> str:
    """Return a pack of two views of walls, one of whose 16 pixels has all ambient light, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    window = np.zeros((4, 4), np.float32)
    window[0, 0] = 1
    views = [replace(wall(distance, 4), ambient=window) for distance in (2.0, 3.0)]
    write_pack([(view, {"scene": name}) for view, name in zip(views, "ab", strict=True)], Path("walls.h5"))
    return "walls.h5"


def evaluated(capfd, *options: str) -> tuple[dict, list[str], list[dict]]:
    """Return the result of an evaluation, what it tells, and its table."""
    assert main(["evaluate", "none-s0", "--baselines", "argmax", "--out", "out", "--json", *options]) == 0
    out, err = capfd.readouterr()
    with Path("out/evaluation.csv").open(newline="") as file:
        return json.loads(out), err.splitlines(), list(csv.DictReader(file))


def test_an_evaluation_says_what_it_is_of(capfd, walls):
    """Tell tables of two offsets apart: before, the folder's name alone did."""
    for offset_m, law in ((1.0, "auto"), (0.0, None)):
        options = ("--offset", str(offset_m), "--seed", "4", "--decoder", "median", "--views", "1", "--tiled")
        more = () if law is None else ("--law", law)
        found, _, _ = evaluated(capfd, "--set", walls, "--levels", "50+1", *options, *more)
        assert found["conditions"] == json.loads(Path("out/evaluation.json").read_text())
        common = {"set": walls, "views": 1, "sensor": "reference", "seed": 4, "decoder": "median", "tile": [1, 1]}
        assert found["conditions"] == common | {"offset_m": offset_m, "law": law or "by level"}


def test_an_evaluation_says_its_law(capfd, walls):
    """200 background photons a pixel, 3,200 of which are in one: just below 1 % detections a cycle; 300 are above."""
    chosen = ("--set", walls, "--levels", "50+200", "50+300")
    found, told, rows = evaluated(capfd, *chosen, "--law", "auto")
    assert found["laws"] == {"poisson": 2, "first-photon": 2}
    assert [one["laws"] for one in found["by_level"][::2]] == [{"poisson": 2}, {"first-photon": 2}]
    assert {row["background"]: row["law"] for row in rows} == {"200.0": "poisson", "300.0": "first-photon"}
    assert sum("model: first photon of each cycle" in line and "2 of 4 exposures" in line for line in told) == 1
    assert sum("model: independent Poisson" in line and "2 of 4 exposures" in line for line in told) == 1
    assert sum(line.startswith("background: the scene's ambient light") for line in told) == 1
    assert not any("4 of 4" in line for line in told)

    usual, told, rows = evaluated(capfd, *chosen)
    assert usual["laws"] == {"poisson": 4} and {row["law"] for row in rows} == {"poisson"}
    assert sum("in 2 of 4 exposures pile-up matters in the brightest pixel (up to 1.5% " in line for line in told) == 1
    assert not any("as asked" in line for line in told)
    _, told, asked_rows = evaluated(capfd, *chosen, "--law", "poisson")
    assert rows == asked_rows and sum("poisson as asked" in line and "left out" in line for line in told) == 1


def test_by_default_the_law_is_that_of_the_mean_pixel():
    """So that the usual levels are Poisson's, and a level that is bright for the sensor has its pile-up."""
    assert {asked_law(None, Sensor(), PhotonBudget(*level)) for level in PHOTON_LEVELS} == {"poisson"}
    assert asked_law(None, FEW_CYCLES, BRIGHT) == "auto" and asked_law("poisson", FEW_CYCLES, BRIGHT) == "poisson"
    views, methods = Views([wall(2.0, 4)], ["a"]), {"log-matched": baseline("log-matched")}
    levels = ((BRIGHT.signal, BRIGHT.background), (1, 1))
    found = evaluate(methods, views, FEW_CYCLES, EvaluationPlan(levels, law=None))
    assert found.laws() == {"first-photon": 1, "poisson": 1} and found.plans.left_out is None


def test_dark_counts_above_a_level_are_told_once():
    """33 dark counts a pixel, of four exposures of which two ask for less."""
    dark = replace(Sensor(), dark_count_rate_hz=990.0)
    views = Views([wall(2.0, 4), wall(3.0, 4)], ["a", "b"])
    plan = EvaluationPlan(((10, 10), (10, 50)))
    found = evaluate({"argmax": baseline("argmax")}, views, dark, plan)
    warnings = [line for line in found.plans.messages() if line.startswith("warning:")]
    assert len(warnings) == 1 and "33 dark counts a pixel exceed the asked 10" in warnings[0]
    assert "2 of 4 exposures" in warnings[0]


def test_plans_name_an_exposure_where_a_line_has_numbers_of_it():
    lines = {words: PlanLine(count, words, 0.1, "a") for words, count in (("x", 4), ("y", 2), ("7 z", 4), ("8 w", 2))}
    messages = ["x", "y (2 of 4 exposures)", "7 z (numbers of a)", "8 w (2 of 4 exposures, numbers of a)"]
    assert Plans(4, lines).messages() == messages
