"""Stop a run that diverges, keep its last good epoch, and go on from there."""

import csv
import math

import pytest
from test_training import FEW, MODEL, near_planes

from csph.networks.checkpoint import load_model
from csph.networks.config import preset
from csph.training.loop import DepthTraining, train
from csph.training.views import split_views
from scenes import InputError

RUN_FILES = ("log.csv", "energy.csv", "model.safetensors", "last.safetensors")


def spoil(monkeypatch, at: int, value: float) -> None:
    """Multiply the loss of one step."""
    loss = DepthTraining.loss
    monkeypatch.setattr(
        DepthTraining, "loss", lambda self, batch: loss(self, batch) * (value if self.global_step == at else 1.0)
    )


@pytest.mark.parametrize("schedule", ["cosine", "steps"])
def test_a_run_that_diverges_keeps_its_last_good_epoch(tmp_path, monkeypatch, schedule):
    """And goes on from there: the run is then the one that never diverged."""
    sets = split_views(near_planes(3))
    config = preset("smoke", MODEL, **FEW, schedule=schedule)
    train(config, *sets, tmp_path / "whole")
    with monkeypatch.context() as patch:
        spoil(patch, 7, math.nan)  # the second step of the last of three epochs
        with pytest.raises(InputError, match=r"diverged in epoch 3 \(training loss nan, .* after epoch 2 is kept"):
            train(config, *sets, tmp_path / "run")
    model, _, row = load_model(tmp_path / "run")
    assert row["epoch"] <= 2 and all(part.isfinite().all() for part in model.parameters())
    with (tmp_path / "run/log.csv").open(newline="") as lines:
        assert [line["epoch"] for line in csv.DictReader(lines)] == ["1", "2"]
    assert not (tmp_path / "run/last.safetensors").exists()
    train(config, *sets, tmp_path / "run")
    for name in RUN_FILES:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_run_that_diverges_at_once_keeps_nothing(tmp_path, monkeypatch):
    spoil(monkeypatch, 0, math.inf)
    with pytest.raises(InputError, match=r"diverged in epoch 1 .* nothing is kept; use a lower --rate"):
        train(preset("smoke", MODEL, **FEW), *split_views(near_planes(3)), tmp_path / "run")
    assert not [*(tmp_path / "run").glob("*.safetensors")] and not (tmp_path / "run/resume.ckpt").exists()
