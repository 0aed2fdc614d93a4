"""Weights of a training that was stopped are those of an epoch before its last, and whoever takes them is told."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest

from render.transient.packs import write_pack
from scene2spad.cli.results.compare import Compare
from scene2spad.cli.results.compare import run as run_compare
from scene2spad.cli.simulation.depth import Depth
from scene2spad.cli.simulation.depth import run as run_depth
from scene2spad.datasets.planes import wall
from scene2spad.networks.evaluating import run_evaluate
from scene2spad.networks.training import run_train
from scene2spad.options.networks import Evaluate, Train
from spad.detection.detect import sense
from spad.measurements.histogram import write_histogram
from spad.sensor.model import PhotonBudget, Sensor

TRAIN = Train(preset="smoke", network="compact", threads=1, out=Path("run"))
EVALUATE = Evaluate(checkpoints=(Path("run"),), set=Path("wall.h5"), levels=("50+1",), baselines=())
WARNING = "run: its training has not come to its end; the same `train` command goes on with it"


class Stopped(Exception):
    pass


def quietly(what: str, fraction: float | None) -> None:
    pass


def stop_in_the_last_epoch(what: str, fraction: float | None) -> None:
    if what.startswith("step 6 "):
        raise Stopped


@pytest.fixture
def stopped(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_pack([(wall(2.0, 8), {"scene": "walls/2"})], Path("wall.h5"))
    with pytest.raises(Stopped):
        run_train(TRAIN, stop_in_the_last_epoch)


def test_commands_that_take_a_stopped_run_say_so_until_it_ends(stopped, caplog):
    histogram = sense(wall(2.0, 8), Sensor(), PhotonBudget(50, 1), seed=1)
    write_histogram(histogram, Path("wall.sensed.h5"))

    def told(out: str) -> list[str]:
        depth = Path(f"{out}.exr")
        caplog.clear()
        with caplog.at_level(logging.WARNING, "scene2spad"):
            run_evaluate(EVALUATE, quietly)
            run_train(replace(TRAIN, init="run", out=Path(out), steps=1), quietly)
            run_depth(Depth(file=Path("wall.sensed.h5"), method="network", checkpoint=Path("run"), out=depth), quietly)
            run_compare(Compare(file=Path("wall.sensed.h5"), methods=("argmax", "fourier-4", "run")), quietly)
        return [line for line in caplog.messages if "come to its end" in line]

    assert told("next") == [WARNING] * 4
    run_train(TRAIN, quietly)
    assert told("other") == []
