"""Test what `train` warns of: photon levels that its sensor has pile-up at, or more dark counts than."""

from dataclasses import replace

import pytest
from small_runs import QUICK

from csph.levels import CONTINUOUS
from csph.networks.config import ModelConfig, preset
from scene2spad.cli import main
from scene2spad.networks.level_warnings import level_warnings
from spad.sensor.files import SensorFile, write_sensor
from spad.sensor.model import Sensor
from spad.sensor_names import sensor_by_name

PERIOD_S = Sensor().period_s


def warnings_of(sensor: Sensor, levels=CONTINUOUS) -> list[str]:
    return level_warnings(preset("smoke", ModelConfig(front="matched", sensor=sensor), levels=levels))


def test_the_usual_trainings_have_nothing_to_warn_of():
    assert warnings_of(Sensor()) == warnings_of(Sensor(), "paper") == warnings_of(sensor_by_name("linospad")) == []


@pytest.mark.parametrize(
    ("changes", "warns"),
    [
        ({}, True),  # armed at every cycle
        ({"exposure_s": 140_000 * PERIOD_S}, False),
        ({"reset": "free-running"}, False),  # loses nothing without a dead time
        ({"reset": "free-running", "dead_time_s": 1e-8}, True),
        ({"exposure_s": 140_000 * PERIOD_S, "reset": "free-running", "dead_time_s": 2 * PERIOD_S}, True),
    ],
)
def test_pile_up_at_the_highest_level(changes, warns):
    """100 + 1200 photons in 120,000 cycles are 1.08 %, in 140,000 they are 0.93 %, and twice that a dead time."""
    sensor = replace(Sensor(), **{"exposure_s": 120_000 * PERIOD_S, **changes})
    found = warnings_of(sensor)
    assert [("100 + 1200 photons, the highest level" in line, "pile-up" in line) for line in found] == [
        (True, True)
    ] * warns
    assert not warnings_of(sensor, "paper")


def test_dark_counts_above_the_lowest_background():
    """The prototype's are 32 a pixel; the lowest backgrounds are 0.5 and, of the paper, 2."""
    for levels, lowest in ((CONTINUOUS, "0.5"), ("paper", "2")):
        (line,) = warnings_of(sensor_by_name("iccv2023-train"), levels)
        assert "31.87 dark counts a pixel" in line and f"the lowest level {lowest} background photons" in line
    few = replace(Sensor(), dark_count_rate_hz=1.9 * 30)
    assert len(warnings_of(few)) == 1 and not warnings_of(few, "paper")


def test_train_warns_in_one_line_each(capfd, packed, tmp_path):
    sensor = tmp_path / "odd.toml"
    write_sensor(SensorFile(replace(Sensor(), name="odd", exposure_s=3000 * PERIOD_S, dark_count_rate_hz=1e4)), sensor)
    command = [
        "train",
        *QUICK,
        "--steps",
        "2",
        "--set",
        str(packed),
        "--sensor",
        str(sensor),
        "--out",
        str(tmp_path / "run"),
    ]
    for more in (["--dry-run"], []):
        assert main([*command, *more]) == 0
        told = [line for line in capfd.readouterr().err.splitlines() if line.startswith("train: ")]
        assert len(told) == 2 and "pile-up" in told[0] and "dark counts" in told[1]
