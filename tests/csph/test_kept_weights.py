"""Keep the last weights of a cosine, and say where an earlier epoch was better."""

import csv

import pytest
from test_training import FEW, MODEL, near_planes

from csph.networks.config import preset
from csph.training.loop import train
from csph.training.views import split_views


@pytest.mark.parametrize("rate", [0.3, 0.9])
def test_an_epoch_that_was_better_than_the_kept_one_is_named(tmp_path, caplog, rate):
    training, validation = split_views(near_planes(6))
    config = preset("smoke", MODEL, **{**FEW, "rate": rate})
    result = train(config, training, validation, tmp_path / "run")
    with (tmp_path / "run/log.csv").open(newline="") as lines:
        errors = {int(row["step"]): float(row["val_rmse_mm"]) for row in csv.DictReader(lines)}
    last, best = max(errors), min(errors, key=errors.__getitem__)
    assert result["kept_step"] == last and result["val_rmse_mm"] == errors[last]
    told = [one.getMessage() for one in caplog.records if "weights kept" in one.getMessage()]
    words = f"the weights kept are of step {last}, with a validation RMSE of {errors[last]:.1f} mm; "
    assert told == ([] if best == last else [f"{words}step {best} had {errors[best]:.1f} mm"])
