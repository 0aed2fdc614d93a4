"""`study transport`: its steps against RGB-D rates and the render they come from, shared photons by their law, rankings
of made-up errors, and one small run to the end and again."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csph.evaluation.methods import Row
from csph.evaluation.metrics import Interval
from render.transient import Transient
from scene2spad.cli import main
from scene2spad.networks.lookup import ModelLookup
from scene2spad.networks.registry import ModelSpec
from scene2spad.networks.training import run_train
from scene2spad.studies.transport import plan as transport_plan
from scene2spad.studies.transport import planned_renders as transport_planned
from scene2spad.studies.transport import study as transport
from scene2spad.studies.transport import tables as transport_tables
from scene2spad.studies.transport.plan import FIRST, KEPT, LASERS, LEVELS, OPEN, PLANS, REVERSED, STEPS
from spad.detection.flux import expected_counts
from spad.detection.rates import rates_for
from spad.formats.rgbd import transient_from_rgbd
from spad.sensor.model import PhotonBudget, Sensor

SHAPE, FOV_DEG = (12, 16), 50.0


def a_render(seed: int = 0) -> Transient:
    """Two direct returns a pixel of a slanted relief, one indirect return 0.7 m later, and uneven ambient light."""
    rng = np.random.default_rng(seed)
    fine = np.add.outer(np.linspace(2, 3, 2 * SHAPE[0]), np.linspace(0, 1, 2 * SHAPE[1])) + 0.01 * rng.random()
    albedo = rng.uniform(0.2, 0.9, fine.shape)
    direct = transient_from_rgbd(fine, albedo, albedo, fov_deg=FOV_DEG, block=2)
    pixels = SHAPE[0] * SHAPE[1]
    later = (direct.path_far_m.reshape(pixels, -1)[:, -1:] + 0.7).astype(np.float32)
    glow = rng.uniform(0.1, 0.4, (pixels, 1)).astype(np.float32) * direct.radiance.reshape(pixels, -1).sum(1)[:, None]
    path = np.hstack([direct.path_near_m.reshape(pixels, -1), later])
    bounces = np.tile(np.array([1, 1, 1, 1, 2], np.uint8), pixels)
    return replace(
        direct,
        offsets=np.arange(pixels + 1) * 5,
        path_near_m=path.ravel(),
        path_far_m=path.ravel(),
        radiance=np.hstack([direct.radiance.reshape(pixels, -1), glow]).ravel(),
        bounces=bounces,
        ambient=rng.uniform(1, 5, SHAPE).astype(np.float32),
        meta={"camera": {"fov_deg": FOV_DEG}},
    )


def rates_of(transient: Transient, budget: PhotonBudget) -> np.ndarray:
    sensor = Sensor()
    rates = rates_for(transient, sensor, budget)
    return expected_counts(transient, sensor, rates, slice(0, SHAPE[0] * SHAPE[1]))[0].numpy()


# Steps


def test_the_first_steps_are_rgbd_rates():
    full, budget = a_render(), PhotonBudget(10, 200)
    steps = transport.steps_of(full)
    albedo = full.albedo.astype(float)
    for name, fov_deg in (("rgbd", None), ("cosine", FOV_DEG)):
        image = transient_from_rgbd(full.depth_m, albedo, albedo, fov_deg=fov_deg)
        np.testing.assert_allclose(rates_of(steps[name], budget), rates_of(image, budget), rtol=1e-5)
    assert not np.allclose(rates_of(steps["rgbd"], budget), rates_of(steps["cosine"], budget), rtol=1e-3)


def test_each_later_step_adds_one_thing():
    full = a_render()
    steps = transport.steps_of(full)
    assert list(steps) == list(STEPS)
    direct, indirect, ambient = steps["footprint"], steps["indirect"], steps["ambient"]
    assert direct.returns == 4 * 12 * 16 and (direct.bounces == 1).all()
    assert direct.total_radiance().sum() == pytest.approx(full.radiance[full.bounces == 1].sum(dtype=float), rel=1e-6)
    for name in ("offsets", "path_near_m", "radiance", "bounces"):
        np.testing.assert_array_equal(getattr(indirect, name), getattr(full, name))
    np.testing.assert_array_equal(indirect.ambient, direct.ambient)
    assert ambient.sha256() == full.sha256() and not np.array_equal(ambient.ambient, indirect.ambient)


def test_truth_and_mean_counts_are_those_of_the_render_at_every_step():
    full, budget = a_render(), PhotonBudget(10, 50)
    for step in transport.steps_of(full).values():
        np.testing.assert_array_equal(step.depth_m, full.depth_m)
        np.testing.assert_array_equal(step.mixed, full.mixed)
        assert rates_of(step, budget).sum(1).mean() == pytest.approx(60, rel=1e-5)


def test_a_pixel_that_sees_nothing_stays_dark():
    full = a_render()
    depth = full.depth_m.copy()
    depth[3, 4] = np.nan
    steps = transport.steps_of(replace(full, depth_m=depth))
    assert steps["cosine"].total_radiance()[3, 4] == 0 and steps["cosine"].ambient[3, 4] == 0
    assert np.isfinite(rates_of(steps["cosine"], PhotonBudget(10, 10))).all()


# Shared photons


def test_coupled_counts_have_their_own_law_and_differ_by_what_the_rates_differ_by():
    first, budget, sensor = a_render(), PhotonBudget(20, 20), Sensor()
    second = transport.direct_alone(first)
    a, b = rates_of(first, budget), rates_of(second, budget)
    rng, pair = np.random.default_rng(0), [transport_planned.expected(one, sensor, budget) for one in (first, second)]
    draws = [transport_planned.coupled(*pair, sensor, budget, rng) for _ in range(20)]
    halves = slice(0, 200), slice(200, 1024)
    for part in halves:
        for place, rates in enumerate((a, b)):
            total = sum(int(pair[place].counts[..., part].sum()) for pair in draws)
            expected = 20 * rates[:, part].sum()
            assert abs(total - expected) < 4.5 * math.sqrt(expected)
        # independent draws would scatter by sqrt(sum a + b)
        apart = [int(x.counts[..., part].sum()) - int(y.counts[..., part].sum()) for x, y in draws]
        variance, mean = np.abs(a - b)[:, part].sum(), (a - b)[:, part].sum()
        assert abs(sum(apart) - 20 * mean) < 4.5 * math.sqrt(20 * variance)
        assert variance < 0.5 * (a + b)[:, part].sum()
        spread = sum((one - mean) ** 2 for one in apart) / variance  # chi-square of 20
        assert 4 < spread < 55


def test_equal_renders_give_equal_counts():
    sensor, budget = Sensor(), PhotonBudget(10, 200)
    one = transport_planned.expected(a_render(), sensor, budget)
    x, y = transport_planned.coupled(one, one, sensor, budget, np.random.default_rng(1))
    np.testing.assert_array_equal(x.counts, y.counts)
    assert x.counts.sum() > 0


@pytest.mark.parametrize(
    ("full", "planned", "expected"),
    [
        ((100.0, 102.0, 98.0), (100.5, 102.4, 98.6), "holds"),
        ((100.0, 102.0, 98.0), (110.0, 112.4, 107.9), "does not hold"),
        ((100.0, 102.0, 98.0), (90.0, 112.0, 101.0), "not decided"),
        ((100.0,), (100.1,), "not decided"),  # one draw has no interval
    ],
)
def test_a_plan_is_judged_by_its_interval(full, planned, expected):
    fraction, wide = transport_planned.compared(np.array(full), np.array(planned))
    assert fraction == pytest.approx(np.mean(planned) / np.mean(full) - 1)
    assert transport_planned.within(fraction, wide) == expected


def test_photons_are_drawn_until_a_scene_is_decided(monkeypatch):
    """A difference of 1 % with a scatter of 4 % a draw is open after 8 draws and under 2 % after 512; one of 0 is not
    drawn again."""
    rng = np.random.default_rng(3)

    def errors(place, checked, store, level, keys):
        off = rng.normal(0.01, 0.04, len(keys)) if place.name == "noisy" else np.zeros(len(keys))
        return [[[100.0, 100.0 * (1 + each)]] for each in off]

    monkeypatch.setattr(transport_planned, "_both", errors)
    places = [transport_planned.Place(name, "set", "flood", None, None) for name in ("noisy", "clear")]
    one = transport_planned.Contender(None, "likelihood", 1)
    monkeypatch.setattr(transport_planned.Contender, "name", "log-matched")
    rows = transport_planned.planned_rows(places, [one], (8, 512), None, 0, lambda what, fraction: None)
    assert [row["draws"] for row in rows] == [512, 8]
    assert {row["verdict"] for row in rows} == {"holds"} and rows[0]["difference"] == pytest.approx(0.01, abs=0.004)


def test_one_bad_design_fails_a_scene():
    row = {"scene": "s", "laser": "flood", "uncertain": 0.001, "draws": 16}
    rows = [
        {**row, "design": "a", "difference": 0.001, "verdict": "holds"},
        {**row, "design": "b", "difference": -0.03, "verdict": "does not hold"},
    ]
    (found,) = transport_planned.planned_conclusions(rows)
    assert found["verdict"] == "does not hold" and found["design"] == "b"
    assert transport_planned.planned_conclusions(rows[:1])[0]["verdict"] == "holds"


# Ranking


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ((-5, -8, -2), (-1, -2, -0.5), KEPT),
        ((-5, -8, -2), (3, 1, 5), REVERSED),
        ((-5, -8, -2), (3, -1, 5), OPEN),
        ((-5, -8, 2), (3, 1, 5), OPEN),
        ((-5, math.nan, math.nan), (3, 1, 5), OPEN),
    ],
)
def test_order_changes_where_both_intervals_say_so(before, after, expected):
    assert transport_tables.judged(Interval(*before), Interval(*after)) == expected


def made_up_rows(turned: str) -> dict[tuple[str, str], list[Row]]:
    """Errors of 6 scenes, hard ones hard for all: fourier-8 5 mm better than gray-8, from step `turned` on 7 worse;
    coarse-8 always far behind."""
    rows, worse = {}, False
    for step in STEPS:
        worse |= step == turned
        for laser in LASERS:
            found = []
            for scene in range(6):
                for number, level in enumerate(LEVELS):
                    base = 100.0 * (scene + 1) * (number + 1)
                    gap = (7 if worse and laser == "flood" else -5) + 0.5 * scene
                    for name, error in (("fourier-8", base + gap), ("gray-8", base), ("coarse-8", 3 * base)):
                        found.append(Row(name, f"s{scene}", scene, *level, "all", error, error, 0, 0, 0, 0, 1, 9, 0, 0))
            rows[laser, step] = found
    return rows


def contenders() -> list[transport_tables.Contender]:
    plan = replace(PLANS["smoke"], codes=("fourier-8", "gray-8", "coarse-8"))
    return transport.contenders_of(plan, ModelLookup({}, []))[1:]


def test_a_pair_that_turns_is_found_where_it_turns():
    found = transport_tables.conclusions(transport_tables.ranking(made_up_rows("indirect"), contenders()))
    common = {(one["laser"], one["step"], one["levels"]): one for one in found}
    assert len(common) == 2 * 4 * 3
    for step, expected in (
        ("cosine", "does not change"),
        ("footprint", "does not change"),
        ("indirect", "changes"),
        ("ambient", "changes"),
    ):
        assert common["flood", step, "all"]["ranking"] == expected
        assert common["scan", step, "all"]["ranking"] == "does not change"
    turned = common["flood", "indirect", "all"]
    assert turned["reversed"] == 1 and turned["kept"] == 2 and "fourier-8 - gray-8" in turned["turned"][0]
    assert turned["gap_moved"] == 2  # fourier-8 against both others


def test_the_table_has_the_change_by_each_step():
    lines = transport_tables.summary(made_up_rows("indirect"), contenders())
    mine = [one for one in lines if (one["laser"], one["levels"], one["pixels"]) == ("flood", "all", "all")]
    change = {(one["step"], one["design"]): one["change_mm"] for one in mine}
    assert math.isnan(change[FIRST, "gray-8"])
    assert change["indirect", "fourier-8"] == pytest.approx(12) and change["indirect", "gray-8"] == 0
    assert change["ambient", "fourier-8"] == 0


def test_an_interval_of_an_error_ends_at_0():
    """Student's of two scenes, one hard and one easy, reaches below."""
    rows = [Row("gray-8", f"s{i}", i, *LEVELS[0], "all", mae, mae, 0, 0, 0, 0, 1, 9, 0, 0)
            for i, mae in enumerate((5.0, 600.0))]  # fmt: skip
    (one,) = [c for c in contenders() if c.name == "gray-8"]
    every = {(laser, step): rows for laser in LASERS for step in STEPS}
    for line in transport_tables.summary(every, [one]):
        assert line["mae_low"] == 0 and line["mae_high"] > 4000 and line["mae_mm"] == 302.5


@pytest.mark.parametrize(
    ("part", "words"), [(0.5, "50.0%"), (0.996, "99.6%"), (0.9998, "99.98%"), (1.0, "100%"), (-0.2, "-20.0%")]
)
def test_nearly_all_is_not_called_all(part, words):
    assert transport_tables.part_saved(part) == words


def test_codes_are_ranked_among_their_own():
    plan, models = PLANS["laptop"], ModelLookup({}, [])
    kinds = {one.name: (one.decoder, one.compression) for one in transport.contenders_of(plan, models)}
    assert kinds["log-matched"][1] == 1 and kinds["fourier-8"][1] == 128 and kinds["gray-16"][1] == 64
    assert len({one.subject.digest for one in transport.contenders_of(plan, models)}) == len(kinds)


@pytest.mark.parametrize("preset", PLANS)
def test_every_model_tiles_the_images(preset):
    plan = PLANS[preset]
    blocks = [one.block for one in transport_plan.MODELS if one.coded]
    assert all(side % block[1] == 0 for side in plan.size for block in blocks)
    assert plan.full.bounces > 1 and plan.full.ambient and plan.full.spp and plan.full.grid
    assert set(transport_plan.CHECKED) <= {transport_plan.UNCOMPRESSED, *plan.codes}


# The whole


@pytest.mark.slow
def test_a_small_run_ends_and_again_without_work(capfd, tmp_path, monkeypatch):
    one = ModelSpec("fourier", (1024, 1, 1))
    run_train(one.command("smoke", Path("planes"), tmp_path / "models"), lambda what, fraction: None)
    capfd.readouterr()
    command = ["study", "transport", "--preset", "smoke", "--out", str(tmp_path / "out"), "--json"]
    command += ["--models", str(tmp_path / "models")]
    assert main(command) == 0
    printed, message = capfd.readouterr()
    first = json.loads(printed)
    assert all(Path(path).is_file() for path in (*first["figures"], *first["csv"], first["numbers"]))
    assert one.name in {line["design"] for line in first["summary"]}
    assert len(first["scenes"]) == 4 and message.count("rays saved;") == 4
    assert {c["verdict"] for c in first["planned_conclusions"]} <= {"holds", "does not hold", "not decided"}
    assert all(math.isfinite(line["mae_mm"]) for line in first["summary"])
    # RGB-D rates know no laser
    mae = {(line["laser"], line["step"], line["design"], line["levels"], line["pixels"]): line["mae_mm"]
           for line in first["summary"]}  # fmt: skip
    assert all(mae["scan", *key[1:]] == mae[key] for key in mae if key[0] == "flood" and key[1] in ("rgbd", "cosine"))
    written = Path(first["numbers"]).read_text()
    assert "seconds" not in written and (tmp_path / "out/smoke/timings.jsonl").read_text().count("\n") == 8

    monkeypatch.setattr("scene2spad.studies.transport.study.render", lambda *_, **__: pytest.fail("rendered again"))
    monkeypatch.setattr("scene2spad.networks.test_sets.evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    monkeypatch.setattr(
        "scene2spad.studies.transport.planned_renders.coupled", lambda *_, **__: pytest.fail("drawn again")
    )
    assert main(command) == 0
    assert json.loads(capfd.readouterr().out) == first and Path(first["numbers"]).read_text() == written
