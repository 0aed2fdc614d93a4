"""`study multipath`: its means and conclusions from made-up rows, and a small run."""

import json
from pathlib import Path

import pytest

from csph.evaluation.methods import Row
from scene2spad.cli import main
from scene2spad.datasets.planes import random_planes
from scene2spad.networks.registry import EvaluatedModel
from scene2spad.studies.multipath import study as multipath
from scene2spad.studies.multipath.plan import FILTER, LIGHTS, MODELS, PLANS
from scene2spad.studies.transport.study import direct_alone

LEVELS = ((50.0, 50.0), (50.0, 1.0))


def row(method: str, scene: str, level: tuple[float, float], mae: float, group: str = "all") -> Row:
    return Row(method, scene, 0, *level, group, mae, mae, 0.0, 0.0, 0.5, 1.0, 0.0, 4, 0, 0)


def test_conclusions_count_scenes_and_find_the_least_background():
    """The filter is better in one of two scenes, and less background makes the network worse."""
    near, far = LEVELS
    maes = {(FILTER, near): (10, 30), ("net", near): (20, 10), (FILTER, far): (5, 15), ("net", far): (40, 60)}
    rows = [
        row(method, scene, level, mae)
        for (method, level), both in maes.items()
        for scene, mae in zip("ab", both, strict=True)
    ]
    rows += [row("net", "a", near, 999, "mixed")]  # of a group that is not asked for
    subjects = [EvaluatedModel(name, None, name) for name in (FILTER, "net")]
    means = multipath.summary({"flood": rows}, subjects, LEVELS)
    scenes = multipath.by_scene({"flood": rows}, subjects, "ab")
    assert {(m["method"], m["background"]): m["mae_mm"] for m in means} == {
        (FILTER, 50.0): 20, (FILTER, 1.0): 10, ("net", 50.0): 15, ("net", 1.0): 50
    }  # fmt: skip
    (message,) = multipath.conclusions(means, scenes)
    assert (message["network"], message["mae_mm"], message["filter_mae_mm"]) == ("net", 15, 20)
    assert (message["filter_better_in"], message["scenes"]) == (1, 2)
    assert (message["least_background"], message["mae_mm_at_least_background"]) == (1.0, 50)
    assert multipath.in_words(message).endswith("in 1 of 2 scenes; at 50 + 1 50 and 10 mm")
    # of one level alone nothing is told twice
    (message,) = multipath.conclusions(multipath.summary({"flood": rows}, subjects, LEVELS[:1]), scenes)
    assert multipath.in_words(message).endswith(
        "15 mm at 50 + 50 photons, log-matched 20 mm, the filter better in 1 of 2 scenes"
    )


def test_direct_light_alone_of_direct_light_is_the_same():
    (plane,) = random_planes(1, size=8, seed=2).transients
    assert direct_alone(plane).radiance.sum() == pytest.approx(plane.radiance.sum())


def test_every_plan_tiles_the_models():
    for plan in PLANS.values():
        for model in MODELS:
            assert plan.size[1] % model.block[1] == 0 and plan.size[0] % model.block[2] == 0


@pytest.mark.slow
def test_a_small_run_ends_and_again_without_work(capfd, tmp_path, monkeypatch):
    command = ["study", "multipath", "--preset", "smoke", "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 0
    first = json.loads(capfd.readouterr().out)
    assert {line["light"] for line in first["summary"]} == {*LIGHTS}
    assert {line["method"] for line in first["summary"]} == {"log-matched", "argmax", *(one.name for one in MODELS)}
    assert first["scenes"][0]["indirect_share"] > 0.01 and Path(first["figures"][0]).is_file()
    monkeypatch.setattr("scene2spad.networks.test_sets.evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    assert main(command) == 0
    assert json.loads(capfd.readouterr().out) == first
