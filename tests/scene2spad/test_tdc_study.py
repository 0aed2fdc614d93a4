"""`study tdc`: clocks see the same photons, bits a pixel, and a small run."""

import json

import numpy as np
import pytest

from csph.codes.design import Design
from scene2spad.cli.main import main
from scene2spad.datasets.planes import random_planes
from scene2spad.networks.registry import TDC_SENSOR, ModelSpec
from scene2spad.networks.test_sets import TestSet
from scene2spad.studies.tdc import study
from scene2spad.studies.tdc.plan import CLOCKS, DELAY, FOLDED, PERFECT, REAL, TABLE, TRAINED, sensor_of


def recorded_planes() -> dict[str, study.Recorded]:
    return study.recorded_by_clock(TestSet("planes", random_planes(1, size=8)), 0, (50.0, 50.0), 3)


def test_every_clock_sees_the_same_photons_and_none_is_lost() -> None:
    found = recorded_planes()
    assert {*found, DELAY} == set(CLOCKS)
    counts = {clock: one.counts.sum(-1) for clock, one in found.items()}
    for clock, mine in counts.items():
        assert mine == pytest.approx(counts[PERFECT]), clock
    assert found[TRAINED].histogram is found[REAL].histogram
    far = np.abs(np.cumsum(found[REAL].counts - found[PERFECT].counts, axis=-1)).sum()
    near = np.abs(np.cumsum(found[TABLE].counts - found[PERFECT].counts, axis=-1)).sum()
    spread = np.abs(np.cumsum(found[FOLDED].counts - found[PERFECT].counts, axis=-1)).sum()
    assert near < far / 4 and spread < far / 4  # bins that photons were moved by


def test_bits_of_a_pixel() -> None:
    bits = {
        name: study.code_bits(Design.named(name, block, codes=8, compression=None, full=False))
        for name, block in (("learned", (256, 4, 4)), ("fourier", (1024, 1, 1)), ("coarse", (1024, 1, 1)))
    }
    assert bits["learned"] == (8 * (8 * 256 + 8),) * 2
    assert bits["fourier"] == (8 * 256, 8 * 8 * 1024)
    assert [row["correction_bits"] for row in study.clock_rows()] == [0, 0, 14, 980]
    assert study.code_bits(None) == (None, None)


def test_a_difference_from_the_perfect_clock_is_told_with_its_interval() -> None:
    subject = study.Subject("m", lambda one: one.counts, (PERFECT, TABLE), 8, 64, "")
    errors = {PERFECT: (10.0, 20.0), TABLE: (10.5, 20.5)}
    rows = [
        {"method": "m", "clock": clock, "view": str(n), "mae_mm": mae, "within_10mm": 0.5}
        for clock, values in errors.items()
        for n, mae in enumerate(values)
    ]
    perfect, table = study.compared_rows(rows, [subject])
    assert (perfect["difference"], perfect["holds"]) == (0.0, True)
    assert table["difference"] == table["low"] == table["high"] == pytest.approx(0.5 / 15)
    assert table["holds"] and (table["clock_bits"], table["code_bits"]) == (980, 8)


@pytest.mark.parametrize(("reach", "last"), [(8.0, "5"), (80.0, "50"), (3000.0, "1,000")])
def test_ticks_of_differences_reach_as_far_to_both_sides_as_they_do(monkeypatch, tmp_path, reach, last) -> None:
    drawn = []
    monkeypatch.setattr(study, "save", lambda figure, path: drawn.append(figure) or path)
    common = {"method": "m", "mae_mm": 5.0}
    rows = [{**common, "clock": clock, "difference": 0.0, "low": -reach / 100, "high": reach / 100} for clock in CLOCKS]
    study.draw(rows, tmp_path / "tdc.png")
    panel = drawn[0].axes[1]
    ticks = [text.get_text() for text in panel.get_xticklabels()]
    assert (ticks[0], ticks[-1]) == (f"-{last}", last) and len(ticks) < 12
    assert "linear to ±10 %" in panel.get_xlabel() and "perfect and real" in panel.get_title()


def test_the_mean_delay_is_that_of_codes_before_the_first_that_comes() -> None:
    """Codes that never come stand before all others: the first 18 or so of 140, 0.32 ns, whose effect falls to none."""
    assert 0.020 < study.mean_delay_m() < 0.030


def test_a_depth_below_the_mean_delay_is_0() -> None:
    """Leave no negative depth. No detection leaves its laser period, so that none lies at the period's end."""
    sensor = sensor_of(REAL)
    assert sensor.code_edges is not None and sensor.bins == sensor.bins_per_period
    assert (sensor.code_edges[:, [0, -1]] == [0, sensor.bins]).all()
    depth_m, truth_m = np.array([[0.01, 2.0]], np.float32), np.array([[0.5, 2.0]], np.float32)
    subject = study.Subject("m", lambda _: depth_m, (REAL,), None, None, "")
    real, delay = study.errors_by_clock(subject, {REAL: recorded_planes()[REAL]}, truth_m)
    assert (real["clock"], delay["clock"]) == (REAL, DELAY)
    assert real["mae_mm"] == pytest.approx(490 / 2, rel=1e-4)
    assert delay["mae_mm"] == pytest.approx((500 + 1000 * study.mean_delay_m()) / 2, rel=1e-4)


def test_models_trained_with_the_clock_begin_with_the_plain_one(tmp_path) -> None:
    one = ModelSpec("learned", (256, 4, 4), tdc=True)
    command = one.command("laptop", tmp_path / "set.h5", tmp_path)
    assert (command.sensor, command.init, one.name) == (TDC_SENSOR, one.plain.name, "learned-256x4x4-128x-tdc-s0")
    assert f"--init {one.plain.name} --sensor {TDC_SENSOR}" in one.training_command(
        "laptop", tmp_path / "s.h5", tmp_path
    )
    assert sensor_of(REAL).tdc != sensor_of(TABLE).tdc and sensor_of(PERFECT).tdc is not None


@pytest.mark.slow
def test_a_small_run(tmp_path, capfd) -> None:
    out = tmp_path / "out"
    assert main(["study", "tdc", "--preset", "smoke", "--out", str(out), "--json"]) == 0
    shown = json.loads(capfd.readouterr().out)
    assert (out / "tdc.png").is_file() and (out / "tdc.csv").is_file()
    by = {(row["method"], row["clock"]): row for row in shown["compared"]}
    exact = by["log-matched, all bins", TABLE]
    # the mean hangs on the few pixels that are metres off, and these on the draw of photons
    assert exact["within_10mm"] > 2 * by["log-matched, all bins", REAL]["within_10mm"]
    chip = [row for row in shown["compared"] if row["method"].endswith(study.CHIP)]
    assert [row["clock"] for row in chip] == [study.SENSED[0], REAL, DELAY, *study.SENSED[2:]]
    assert any(row["clock"] == TRAINED for row in shown["compared"])
