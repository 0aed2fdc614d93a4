"""Sets that cannot be trained on are refused before the first step; errors that are no number are told."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_training import FEW, MODEL, SMALL, near_planes

from csph.codes.rank import coherence
from csph.codes.temporal import MAX_SEED, grouped_energy, orthogonal_start, spatial_seed, uniform_start
from csph.layer import CompressiveLayer
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig, preset
from csph.training.data import TrainBatch
from csph.training.loop import DepthTraining, Record, train
from csph.training.views import Views, split_views
from render.transient import Transient
from scene2spad.datasets.planes import wall
from scenes import InputError

FOURIER = ModelConfig(design=replace(MODEL.design, code="fourier", block=(64, 1, 1)), sensor=SMALL)


def dark(size: int = 16) -> Transient:
    """A wall in sight from which no light returns."""
    lit = wall(0.5, size)
    columns = ("path_near_m", "path_far_m", "radiance", "bounces")
    none = {name: getattr(lit, name)[:0] for name in columns}
    return replace(lit, offsets=np.zeros(size * size + 1, np.int64), **none)


def without_truth(size: int = 16) -> Transient:
    return replace(wall(0.5, size), depth_m=np.full((size, size), np.nan, np.float32))


@pytest.mark.parametrize(
    ("training", "validation", "message"),
    [
        (dark(), None, "training set: no light returns from a view of bad, its photons cannot be had"),
        (None, dark(), "validation set: no light returns from a view of bad"),
        (without_truth(), None, r"training set \(bad and 0 views more\): no pixel has a depth within the sensor's 0.9"),
        (None, without_truth(), r"validation set \(bad and 0 views more\): no pixel has a depth"),
        (None, wall(2.0, 16), r"validation set \(bad and 0 views more\): no pixel has a depth"),
    ],
)
def test_sets_without_light_or_truth_are_refused_before_the_first_step(training, validation, message, tmp_path):
    """They ended runs in the middle, counted as diverged, or trained nothing at a loss of 0."""
    good = near_planes(2)
    sets = [good if one is None else Views((one,), ("bad",)) for one in (training, validation)]
    with pytest.raises(InputError, match=message):
        train(preset("smoke", MODEL, **FEW), *sets, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coherence": math.inf}, r"weight inf of the coherence is outside 0 to 1e\+06"),
        ({"tv_weight": math.inf}, r"weight inf of the total variation is outside 0 to 1e\+06"),
        ({"seed": -1}, "seed -1 is outside 0 to 9223372036854775807"),
        ({"seed": MAX_SEED + 1}, "seed 9223372036854775808 is outside 0 to 9223372036854775807"),
    ],
)
def test_numbers_that_no_training_can_have_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        preset("smoke", MODEL, **FEW, **change)


def test_the_largest_seed_begins_both_factors():
    for start in (uniform_start, orthogonal_start):
        for seed in (MAX_SEED, spatial_seed(MAX_SEED)):
            assert start((4, 2, 2), 4, seed).isfinite().all()
        with pytest.raises(InputError, match="seed -1 is outside"):
            start((4, 2, 2), 4, -1)


def test_coherence_is_for_several_pixels():
    """One pixel a block ended in a traceback at the first step; without codes the option was ignored."""
    layer = CompressiveLayer.of(FOURIER.design)
    gram = layer.pixel_gram()
    torch.testing.assert_close(gram, layer.temporal.double().square().sum().float().view(1, 1))
    assert float(coherence(gram)) == 0
    for model in (FOURIER, ModelConfig(front="counts", sensor=SMALL)):
        with pytest.raises(InputError, match=r"weight 0\.1 of the coherence is for codes over several pixels, not"):
            preset("smoke", model, **FEW, coherence=0.1)


def test_errors_that_are_no_number_are_not_left_out():
    """One pixel without an answer: the validation's mean is NaN, not that of the others."""
    module = DepthTraining(preset("smoke", MODEL, **FEW, average=0.0))
    truth = torch.full((1, 4, 4), 0.5)
    batch = TrainBatch(torch.zeros(1, 1, 64, 4, 4), truth, truth > 0, torch.tensor([-1]))
    logits = torch.zeros(1, 64, 4, 4)
    module.model.forward = lambda _: logits
    module.validation_step(batch, 0)
    assert module.absolute_m["median"].compute().isfinite()
    logits[0, :, 2, 3] = math.nan
    module.validation_step(batch, 1)
    assert module.absolute_m["median"].compute().isnan() and module.squared_m2["soft-argmax"].compute().isnan()


def test_an_epoch_without_a_number_does_not_hide_the_best(tmp_path):
    record = Record(tmp_path, lambda what, fraction: None)
    record.rows = [{"val_rmse_mm": math.nan}, {"val_rmse_mm": 7.0}, {"val_rmse_mm": 9.0}]
    assert record.best_mm == 7.0


def test_the_last_energy_is_that_of_the_code_that_is_kept(tmp_path):
    """Also where the weights that a run begins with have a share in it."""
    training, validation = split_views(near_planes(6))
    config = preset("smoke", MODEL, **FEW)
    train(config, training, validation, tmp_path / "first")
    first, _, _ = load_model(tmp_path / "first")
    for name, share in (("end", 0.0), ("mean", 0.25)):
        changed = replace(config, seed=1, init_share=share)
        train(changed, training, validation, tmp_path / name, init=first)
        last = (tmp_path / name / "energy.csv").read_text().splitlines()[-1].split(",")
        kept = grouped_energy(load_model(tmp_path / name / "last.safetensors")[0].codes_layer.temporal)
        assert last[0] == str(config.steps) and [float(value) for value in last[1:]] == pytest.approx(kept, rel=1e-6)
    rows = [(tmp_path / name / "energy.csv").read_text().splitlines() for name in ("end", "mean")]
    assert rows[0][:-1] == rows[1][:-1] and len(rows[0]) == 2 + config.steps
