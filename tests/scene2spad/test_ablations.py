"""`study spatial-block`, `tensor-size`, `fourier`: what they ask for, what decides a conclusion, and one small run."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csph.evaluation.methods import Row
from csph.training.loop import train
from scene2spad.cli import main
from scene2spad.networks.published import printed
from scene2spad.networks.registry import ModelSpec
from scene2spad.networks.training import config_of
from scene2spad.studies.ablations import figures
from scene2spad.studies.ablations import plan as plans
from scene2spad.studies.ablations.study import decided, verdict

STUDIES = tuple(plans.CLAIMS)


@pytest.mark.parametrize("study", STUDIES)
@pytest.mark.parametrize("preset", ["smoke", "laptop", "paper"])
@pytest.mark.parametrize("full", [False, True])
def test_every_model_can_be_trained_and_every_conclusion_decided(study, preset, full):
    sheets = plans.sheets_of(study, preset, full)
    wanted = {one for sheet in sheets for one in sheet.wanted}
    assert all(config_of(one.command(preset, Path("planes"), Path())).model.design for one in wanted)
    for sheet in sheets:
        assert {one.compression for one in sheet.wanted} == {sheet.compression}
        assert set(sheet.shown) <= set(plans.LEVELS)
    if preset == "smoke":
        assert len(wanted) == 2
    elif full:
        assert {one for claim in plans.CLAIMS[study] for one in (claim.first, claim.second)} <= wanted
        assert all(printed(one) for one in wanted)
    else:
        assert {one.compression for one in wanted} == {128}


def test_the_largest_tensor_is_a_gpus_work():
    largest = ModelSpec("learned", (1024, 8, 8), 32)
    of = {p: {w for s in plans.sheets_of("spatial-block", p, True) for w in s.wanted} for p in ("laptop", "paper")}
    assert largest in of["paper"] and largest not in of["laptop"]


@pytest.mark.parametrize(
    ("relation", "interval", "expected"),
    [
        (plans.BETTER, (-5, -8, -2), "holds"),
        (plans.BETTER, (5, 2, 8), "does not hold"),
        (plans.BETTER, (-1, -4, 2), "not decided"),
        (plans.BETTER, (-1, math.nan, math.nan), "not decided"),
        (plans.ALIKE, (1, -20, 20), "holds"),
        (plans.ALIKE, (60, 30, 90), "does not hold"),
        (plans.ALIKE, (-60, -90, -30), "does not hold"),
        (plans.ALIKE, (20, -10, 40), "not decided"),
    ],
)
def test_intervals_decide(relation, interval, expected):
    assert verdict(relation, interval, 100.0) == expected


def test_a_conclusion_is_decided_scene_by_scene_and_says_what_is_absent():
    claim = plans.Claim("c", ModelSpec(), plans.BETTER, ModelSpec(block=(256, 2, 2)))

    def row(one: ModelSpec, scene: int, mae: float) -> Row:
        return Row(one.name, str(scene), scene, 10.0, 10.0, "all", mae, mae, 0, 0, 0.5, 1.0, 0.0, 4, 0, 0)

    # hard scenes are hard for both: the pairs tell the two apart though their ranges overlap
    rows = [row(claim.first, i, 100.0 * i + 5) for i in range(8)]
    rows += [row(claim.second, i, 100.0 * i + 9 + i % 2) for i in range(8)]
    found = decided(claim, rows, dict.fromkeys((claim.first, claim.second)))
    assert found["verdict"] == "holds" and found["difference_mm"][0] == pytest.approx(-4.5)
    found = decided(claim, rows, {claim.first: None})
    # the other may be there, but of another preset or compression: it is not called absent
    assert found["verdict"] == "not decided" and found["why"] == f"not in this run: {claim.second.name}"

    # other seeds count: one that is better on average leaves open what the means' interval would decide
    again = replace(claim.second, seed=1)
    for mae, expected in ((9, "holds"), (4, "not decided"), (-20, "not decided")):
        more = [*rows, *(row(again, i, 100.0 * i + mae) for i in range(8))]
        found = decided(claim, more, dict.fromkeys((claim.first, claim.second, again)))
        assert found["verdict"] == expected and len(found["second_seeds_mm"]) == 2


def test_the_title_of_a_figure_is_the_sheets(monkeypatch, tmp_path):
    """It was the photon level of the last line of depth images."""
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or path)
    rows = [Row("m", "s", 0, 10.0, 10.0, "all", e, e, 0, 0, 0.5, 1.0, 0.0, 4, 0, 0) for e in (3.0, 5.0)]
    depth = np.linspace(1, 2, 16).reshape(4, 4)
    lines = [(level, depth, [depth + 0.01]) for level in ("10 + 10", "10 + 1000")]
    figures.draw("spatial block, 128x", ["learned"], ["m"], rows, lines, tmp_path / "a.png")
    assert drawn[0].get_suptitle().startswith("spatial block, 128x\n")
    labels = [axes.get_ylabel() for axes in drawn[0].get_axes()]
    assert [label for label in labels if " + " in label] == ["10 + 10", "10 + 1000"]


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_a_study_runs_to_the_end_and_again_without_work(study, capfd, tmp_path, monkeypatch):
    monkeypatch.setenv("SCENE2SPAD_DATA", str(tmp_path))
    command = ["study", study, "--preset", "smoke", "--out", str(tmp_path), "--json"]
    assert main(command) == 0
    first = json.loads(capfd.readouterr().out)
    assert all(Path(path).is_file() for path in (*first["figures"], *first["csv"], first["numbers"]))
    assert len(first["models"]) == 2 and len(first["conclusions"]) == len(plans.CLAIMS[study])
    monkeypatch.setattr("scene2spad.networks.test_sets.evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    monkeypatch.setattr(train.__module__ + ".train", lambda *_, **__: pytest.fail("trained again"))
    assert main(command) == 0
    assert json.loads(capfd.readouterr().out) == first
