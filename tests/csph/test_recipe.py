"""The training recipe: levels over their range, one cosine, averaged weights, windows, several sets, published grid."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_training import FEW, MODEL, SMALL, Stopped, near_planes

from csph.codes.design import Design
from csph.levels import BACKGROUND, HARDEST, PHOTON_LEVELS, SIGNAL, TRAIN_LEVELS, draw_level
from csph.networks.checkpoint import load_model, weights_sha256
from csph.networks.config import RECIPE, ModelConfig, TrainConfig, preset
from csph.networks.grid import on_published_grid, published_centroid_bins, published_position, published_target
from csph.networks.model import DepthModel
from csph.training import loop
from csph.training.beginning import NetworkOf
from csph.training.data import DeviceSensing, Requests, Samples, SetData, sensed_batch
from csph.training.loop import DepthTraining, train
from csph.training.loss import decoded_error
from csph.training.schedule import rate_factor
from csph.training.views import split_views
from scene2spad.datasets.planes import random_planes
from scenes import InputError
from spad.detection.training_patches import PackedViews, pack_views
from spad.sensor.files import load_sensor
from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse
from spad.sensor.template import binned_pulse

CODED = ModelConfig(design=Design("learned", (256, 2, 2), 8))


def test_levels_are_drawn_over_the_whole_range_of_the_tests():
    rng = np.random.default_rng(0)
    drawn = np.array([draw_level(rng, "continuous") for _ in range(20_000)])
    signal, background = drawn.T
    assert SIGNAL[0] <= signal.min() < 1.02 and 98 < signal.max() <= SIGNAL[1]
    assert BACKGROUND[0] <= background.min() < 0.6 and 1100 < background.max() <= BACKGROUND[1]
    assert (signal / np.sqrt(background)).min() >= HARDEST * (1 - 1e-12)
    # every test level, and little background, has neighbours within a factor of 1.5 in both numbers
    for level in (*PHOTON_LEVELS, (100.0, 1.0), (50.0, 0.6)):
        assert (np.abs(np.log(drawn / level)) < math.log(1.5)).all(1).sum() > 20, level
    # the harder half of the backgrounds' logarithms: 1 - 0.5^(1 / 0.6) of the draws, within five sigma
    bright = signal > 20
    hard = np.log(background[bright]) > np.log(BACKGROUND).mean()
    fraction = 1 - 0.5 ** (1 / 0.6)
    assert abs(hard.mean() - fraction) < 5 * math.sqrt(fraction * (1 - fraction) / hard.size)
    assert {draw_level(rng, TRAIN_LEVELS) for _ in range(200)} == set(TRAIN_LEVELS)


def test_one_cosine_after_a_linear_warm_up():
    config = preset("smoke", CODED, epochs=10, steps_per_epoch=100, warmup=50)
    factors = [rate_factor(step, config) for step in range(1001)]
    assert factors[0] == pytest.approx(1 / 50, rel=1e-3) and max(factors) == pytest.approx(1, abs=0.01)
    assert factors[500] == pytest.approx(0.02 + 0.98 / 2) and factors[1000] == pytest.approx(0.02)
    assert all(a > b for a, b in pairwise(factors[50:]))
    old = preset("laptop-v1", CODED)
    assert [rate_factor(step, old) for step in (0, 249, 250, 500)] == [1, 1, 0.75, 0.75**2]


def test_configurations_of_before_mean_what_they_meant():
    """A JSON without the new entries is the recipe of the first models."""
    config = preset("laptop-v1", CODED)
    values = json.loads(json.dumps(config.to_dict()))
    for name in ("schedule", "warmup", "rate_end", "average", "window", "weights", "coherence"):
        values.pop(name)
    for name in ("grid", "spatial_start"):
        values["model"].pop(name)
    assert TrainConfig.from_dict(values) == config
    assert (config.levels, config.epochs, config.steps_per_epoch) == (TRAIN_LEVELS, 12, 250)
    recipe = preset("laptop", CODED)
    assert TrainConfig.from_dict(json.loads(json.dumps(recipe.to_dict()))) == recipe


def test_a_refined_network_has_fewer_steps_of_larger_patches():
    """On CPUs alone, and unless options say otherwise; without windows both fractions apply."""
    refined = replace(CODED, network="refined")
    compact, fewer = preset("laptop", CODED), preset("laptop", refined)
    assert (fewer.batch, fewer.crop) == (3, 24) and compact.batch * compact.crop**2 < fewer.batch * fewer.crop**2
    assert fewer.steps_per_epoch == math.ceil(0.48 * compact.steps_per_epoch)
    long = preset("laptop", replace(refined, design=Design("learned", (1024, 2, 2), 8)))
    assert long.window == 0 and long.steps_per_epoch == math.ceil(0.55 * 0.48 * compact.steps_per_epoch)
    asked = preset("laptop", refined, batch=2, steps_per_epoch=7)
    assert (asked.batch, asked.crop, asked.steps_per_epoch) == (2, 24, 7)
    assert replace(preset("gpu", refined), model=CODED) == preset("gpu", CODED)


def test_windows_are_left_out_where_they_would_lie():
    """Long blocks would not see the range, and moved scenes would lose the bias that the offset study is about."""
    assert preset("laptop", CODED).window == RECIPE["window"] == 512
    assert preset("laptop", ModelConfig(front="matched")).window == 512
    long = ModelConfig(design=Design("learned", (1024, 2, 2), 8))
    assert preset("laptop", long).window == preset("laptop", CODED, time_offset_m=8.0).window == 0
    assert preset("laptop", CODED, window=0).window == preset("laptop", MODEL).window == 0
    with pytest.raises(InputError, match="do not hold codes over blocks of 1024 bins"):
        preset("laptop", long, window=512)
    with pytest.raises(InputError, match="no multiple of 256"):
        preset("laptop", CODED, window=100)
    with pytest.raises(InputError, match="windows and random time offsets do not go together"):
        preset("laptop", CODED, window=512, time_offset_m=8.0)


@pytest.mark.parametrize(
    "model", [CODED, ModelConfig(front="matched"), ModelConfig(front="peak")], ids=lambda m: m.name
)
def test_a_window_is_a_cut_of_the_whole(model):
    """What the network sees of a window is that part of what it sees of all bins, and its labels move with it."""
    packs = [pack_views(random_planes(2, size=16, seed=5).transients)]
    config = preset("smoke", model)
    batch = sensed_batch(packs, model.sensor, (8, 8), 512, [Samples(packs, config, 0)[i] for i in range(4)])
    start = batch.first_bin
    assert (start % 256 == 0).all() and (start >= 0).all() and (start <= 512).all()
    training = DepthTraining(config)
    seen = []
    training.model.network.register_forward_hook(lambda module, given, _: seen.append(given[0]))
    training.model.windowed(batch.counts, start, 512)
    training.model(batch.counts)
    for i, first in enumerate(start.tolist()):
        torch.testing.assert_close(seen[0][i], seen[1][i, :, first : first + 512], rtol=1e-4, atol=1e-5)
        bins = batch.depth_m[i][batch.valid[i]] / model.sensor.bin_depth_m
        assert ((bins >= first) & (bins < first + 512)).any()
    assert math.isfinite(float(training.loss(batch).detach()))


def test_windows_keep_the_jitter_of_detector_and_clock(monkeypatch):
    """The target is what one detection looks like, on a part of the bins as on all."""
    clock = replace(load_sensor("reference-tdc").sensor.tdc, jitter_s=200e-12)
    sensor = replace(load_sensor("reference-tdc").sensor, jitter=Pulse(100e-12), tdc=clock)
    config = preset("smoke", replace(CODED, sensor=sensor))
    packs = [pack_views(random_planes(2, size=16, seed=5).transients)]
    training, targets = DepthTraining(config), []
    monkeypatch.setattr(loop, "kl_divergence", lambda logits, *rest: targets.append(rest[-1]) or logits.mean())
    for window in (512, 0):
        training.loss(sensed_batch(packs, sensor, (8, 8), window, [Samples(packs, config, 0)[0]]))
    arrival = torch.tensor([20e-9])
    windowed, whole = (binned_pulse(arrival, one) for one in targets)
    assert windowed.shape[-1] == 512 and whole.shape[-1] == 1024
    torch.testing.assert_close(windowed, whole[..., :512], rtol=1e-4, atol=1e-6)
    assert float(windowed.max()) < 0.8 * float(binned_pulse(arrival, replace(sensor, jitter=None, tdc=None)).max())


def test_the_last_tenth_is_at_full_length():
    packs = [pack_views(random_planes(3, size=16, seed=5).transients)]
    data = SetData(packs, packs, preset("smoke", CODED, epochs=10, steps_per_epoch=1))

    class At:
        current_epoch = 8

    data.trainer = At
    assert bool((next(iter(data.train_dataloader())).first_bin >= 0).all())
    At.current_epoch = 9
    assert bool((next(iter(data.train_dataloader())).first_bin < 0).all())


def test_sets_are_mixed_by_their_weights():
    """Of different sizes; a batch keeps the order of its samples."""
    packs = [
        pack_views(random_planes(3, size=16, seed=1).transients),
        pack_views(random_planes(2, size=24, seed=2).transients),
    ]
    config = preset("smoke", CODED, weights=(1.0, 3.0), steps_per_epoch=1000)
    samples = Samples(packs, config, 0)
    second = np.array([samples[i].source for i in range(2000)])
    assert abs(second.mean() - 0.75) < 5 * math.sqrt(0.75 * 0.25 / 2000)
    requests = [samples[i] for i in range(8)]
    assert len({one.source for one in requests}) == 2
    batch = sensed_batch(packs, config.model.sensor, (8, 8), 0, requests)
    for i, one in enumerate(requests):
        alone = sensed_batch(packs, config.model.sensor, (8, 8), 0, [one])
        assert torch.equal(batch.counts[i], alone.counts[0]) and torch.equal(batch.valid[i], alone.valid[0])
    with pytest.raises(InputError, match="3 set weights for 2 training sets"):
        Samples(packs, replace(config, weights=(1.0, 1.0, 1.0)), 0)


def test_the_average_is_what_is_kept_and_resumes_exactly(tmp_path):
    """Two sets, averaged weights, one cosine: a run that stopped goes on to the same bytes."""
    views = [split_views(near_planes(6, seed=seed)) for seed in (0, 1)]
    training, validation = ([pair[i] for pair in views] for i in (0, 1))
    model = replace(MODEL, spatial_start="orthogonal")
    config = preset("smoke", model, **FEW, weights=(1.0, 2.0), coherence=0.1)
    train(config, training, validation, tmp_path / "whole")

    def stop(what: str, fraction: float) -> None:
        if what == "step 5 of 9":
            raise Stopped

    with pytest.raises(Stopped):
        train(config, training, validation, tmp_path / "parts", progress=stop)
    train(config, training, validation, tmp_path / "parts")
    for name in ("last.safetensors", "model.safetensors", "log.csv", "config.json", "energy.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    header = (tmp_path / "whole" / "log.csv").read_text().splitlines()[0].split(",")
    assert {"val_mae_mm_soft-argmax", "val_mae_mm_median", "spatial_rank"} <= set(header)
    # one cosine: the last weights are kept
    assert load_model(tmp_path / "whole")[2]["step"] == 9
    plain = train(replace(config, average=0.0), training, validation, tmp_path / "plain")
    assert plain["steps"] == 9
    kept, last = (load_model(tmp_path / name / "last.safetensors")[0] for name in ("whole", "plain"))
    assert weights_sha256(kept) != weights_sha256(last)


def test_a_run_begins_with_a_trained_model(tmp_path):
    """At a learning rate of nearly 0 it stays that model; a run that goes on needs the same; others are refused."""
    training, validation = split_views(near_planes(6))
    config = preset("smoke", MODEL, **FEW)
    train(config, training, validation, tmp_path / "first")
    first, _, _ = load_model(tmp_path / "first")
    still = replace(config, seed=1, rate=1e-12, average=0.0)
    train(still, training, validation, tmp_path / "second", init=first)
    second, said, _ = load_model(tmp_path / "second")
    for name, value in second.state_dict().items():
        torch.testing.assert_close(value, first.state_dict()[name], rtol=0, atol=1e-9)
    assert said.data["init_sha256"] == weights_sha256(first)
    with pytest.raises(InputError, match="holds a run with other options"):
        train(still, training, validation, tmp_path / "second")
    other = DepthModel(replace(MODEL, design=Design("learned", (32, 2, 2), 4)))
    with pytest.raises(InputError, match="init: a model of learned 32x2x2 K4"):
        train(config, training, validation, tmp_path / "third", init=other)
    # of another design the network alone is taken, the codes begin anew
    config = replace(still, model=other.config)
    train(config, training, validation, tmp_path / "fourth", init=NetworkOf(first))
    fourth, said, _ = load_model(tmp_path / "fourth")
    for name, value in fourth.network.state_dict().items():
        torch.testing.assert_close(value, first.network.state_dict()[name], rtol=0, atol=1e-9)
    start = DepthModel(config.model, config.seed).layer
    torch.testing.assert_close(fourth.layer.temporal, start.temporal, rtol=0, atol=1e-9)
    assert said.data["init_sha256"] == weights_sha256(first)


@pytest.mark.parametrize("average", [0.0, 0.9])
def test_the_kept_weights_are_a_mean_with_those_begun_with(tmp_path, average):
    """With a share of them: of a run and of the model that it began with, parameter by parameter; after a kill, too."""
    training, validation = split_views(near_planes(6))
    config = preset("smoke", MODEL, **FEW)
    train(config, training, validation, tmp_path / "first")
    first, _, _ = load_model(tmp_path / "first")
    on = replace(config, seed=1, average=average)
    for name, share in (("end", 0.0), ("mean", 0.25)):
        train(replace(on, init_share=share), training, validation, tmp_path / name, init=first)
    end, mean = (load_model(tmp_path / name / "last.safetensors")[0].state_dict() for name in ("end", "mean"))
    for name, value in first.state_dict().items():
        torch.testing.assert_close(mean[name], 0.25 * value + 0.75 * end[name], rtol=1e-5, atol=1e-7)
    rows = [(tmp_path / name / "log.csv").read_text().splitlines() for name in ("end", "mean")]
    assert rows[0][:-1] == rows[1][:-1] and rows[0][-1] != rows[1][-1]  # what is validated last is what is kept
    with pytest.raises(InputError, match=r"init_share 0\.25 needs a model to begin with"):
        train(replace(on, init_share=0.25), training, validation, tmp_path / "none")
    with pytest.raises(InputError, match=r"init_share 1 is outside"):
        replace(on, init_share=1.0)


def test_the_decoded_error_is_the_soft_argmaxs_and_moves_far_mass():
    """Its value by hand, its slope by finite differences in float64; none where no pixel is valid."""
    generator = torch.Generator().manual_seed(3)
    logits = torch.randn((2, 20, 3, 2), generator=generator, dtype=torch.float64, requires_grad=True)
    position = 20 * torch.rand((2, 3, 2), generator=generator, dtype=torch.float64)
    valid = torch.tensor([True, False, True, True, True, True] * 2).view(2, 3, 2)
    centres = torch.arange(20, dtype=torch.float64) + 0.5
    mean = (logits.softmax(1) * centres.view(1, 20, 1, 1)).sum(1)
    by_hand = (mean - position).abs()[valid].mean()
    found = decoded_error(logits, torch.where(valid, position, torch.nan), valid)
    torch.testing.assert_close(found, by_hand, rtol=1e-6, atol=0, check_dtype=False)
    (slope,) = torch.autograd.grad(found, logits)
    assert slope.isfinite().all()
    direction = (mean - position).sign() * valid / valid.sum()
    expected = logits.softmax(1) * (centres.view(1, 20, 1, 1) - mean.unsqueeze(1)) * direction.unsqueeze(1)
    torch.testing.assert_close(slope, expected, rtol=1e-4, atol=1e-7)
    assert float(decoded_error(logits.detach(), position, torch.zeros_like(valid))) == 0


def test_training_senses_on_the_device_when_asked(tmp_path):
    """Two sets joined; the same seed gives the same weights, and labels and windows are those of the host's route."""
    views = [split_views(near_planes(6, seed=seed)) for seed in (0, 1)]
    training, validation = ([pair[i] for pair in views] for i in (0, 1))
    config = preset("smoke", MODEL, **FEW, weights=(1.0, 2.0), sense_on="device", decoded_weight=0.02)
    for name in ("one", "two"):
        train(config, training, validation, tmp_path / name)
    one, two = (load_model(tmp_path / name)[0] for name in ("one", "two"))
    assert weights_sha256(one) == weights_sha256(two)
    packs = [pack_views(views.transients) for views in training]
    window = 512 if config.model.sensor.bins > 512 else 0
    requests = [Samples(packs, config, 0)[i] for i in range(4)]
    here = DeviceSensing(packs, config, torch.device("cpu")).sense(Requests(tuple(requests), window))
    there = sensed_batch(packs, config.model.sensor, (config.crop, config.crop), window, requests)
    assert torch.equal(here.depth_m.nan_to_num(-1), there.depth_m.nan_to_num(-1))
    assert torch.equal(here.valid, there.valid) and torch.equal(here.first_bin, there.first_bin)
    with pytest.raises(InputError, match="sense_on 'gpu' is unknown, expected one of host, device"):
        replace(config, sense_on="gpu")


def test_the_published_grid_puts_one_return_where_print_has_it():
    sensor = Sensor()
    packed = pack_views(random_planes(2, size=16, seed=3).transients)
    grid = on_published_grid(packed, sensor)
    known = np.isfinite(packed.depth_m) & (packed.depth_m < sensor.range_m)
    fullest = np.rint(packed.depth_m[known] / sensor.bin_depth_m) - 1
    np.testing.assert_allclose(grid.depth_m[known] / sensor.bin_depth_m, fullest + 0.5, rtol=1e-5)
    early = published_centroid_bins(sensor)
    assert early == pytest.approx(-0.441, abs=1e-3)
    arrivals = grid.path_near_m / (2 * sensor.bin_depth_m)
    np.testing.assert_allclose(arrivals, fullest + 0.5 + early, atol=2e-4)
    assert (np.diff(grid.offsets).reshape(known.shape) == known).all()
    np.testing.assert_allclose(grid.mean_radiance, packed.mean_radiance, rtol=1e-5)


def test_a_pixel_at_an_edge_has_one_return_between_its_surfaces_on_the_published_grid():
    """Three quarters of the pixel at 2 m, albedo 0.4, and a quarter at 3 m, albedo 0.8: the mean of depth by area and
    albedo is 2.4 m; all the light arrives there. A pixel without returns is dark."""
    sensor = Sensor()
    near, far = 0.75 * 0.4 / 2.0**2, 0.25 * 0.8 / 3.0**2
    packed = PackedViews(
        offsets=np.array([0, 2, 2]),
        path_near_m=np.array([3.9, 6.0], np.float32),
        path_far_m=np.array([4.1, 6.0], np.float32),
        radiance=np.array([near, far], np.float32),
        depth_m=np.array([[[2.0, np.nan]]], np.float32),
        ambient=np.ones((1, 1, 2), np.float32),
        mixed=np.array([[[True, False]]]),
    )
    grid = on_published_grid(packed, sensor)
    fullest = np.rint(2.4 / sensor.bin_depth_m) - 1
    assert grid.depth_m[0, 0, 0] / sensor.bin_depth_m == pytest.approx(fullest + 0.5, rel=1e-5)
    assert np.isnan(grid.depth_m[0, 0, 1]) and grid.offsets.tolist() == [0, 1, 1]
    assert grid.radiance == pytest.approx(near + far, rel=1e-5)


def test_the_published_decoding_of_the_target_is_the_label():
    sensor, fullest = Sensor(), torch.tensor([1.0, 117.0, 1000.0])
    label = (fullest + 0.5) * sensor.bin_depth_m
    stands = published_target(label, sensor) / sensor.bin_depth_m
    # weights i / 1023 of the range, in bins from the edge of bin 0 of a grid of 1024: bin k is k + 1/2 of ours
    torch.testing.assert_close(published_position(stands, sensor.bins), fullest + 0.5)
    torch.testing.assert_close((stands - 0.5) / 1023 * 1024, fullest)
    with pytest.raises(InputError, match="published grid and random time offsets"):
        preset("laptop-v1", replace(CODED, grid="published"), time_offset_m=1.0)
    assert (CODED.decoder, replace(CODED, grid="published").decoder) == ("median", "soft-argmax")


def test_training_on_the_published_grid(tmp_path):
    model = replace(MODEL, grid="published")
    train(preset("smoke", model, **FEW), *split_views(near_planes(3)), tmp_path / "run")
    assert load_model(tmp_path / "run")[0].config.grid == "published" and SMALL.bins == 64
    views = near_planes(3)
    late = [replace(one, bounces=np.full_like(one.bounces, 2)) for one in views.transients]
    lit_twice = views._replace(transients=tuple(late))
    with pytest.raises(InputError, match=r"one return a pixel, and .* has indirect light: .* --bounces 1"):
        train(preset("smoke", model, **FEW), *split_views(lit_twice), tmp_path / "other")


@pytest.mark.parametrize(("epochs", "windowed"), [(1, 0), (2, 1), (3, 2), (4, 3), (6, 5), (12, 11), (24, 22)])
def test_the_last_epochs_are_on_all_bins(epochs, windowed):
    """A tenth of the run, and at least one epoch: without it a network never sees the whole range."""
    training, validation = ([pack_views(one.transients)] for one in split_views(random_planes(3, size=16)))
    config = preset("smoke", ModelConfig(design=Design()), epochs=epochs)
    assert config.window == 512
    data, seen = SetData(training, validation, config), []
    for epoch in range(epochs):
        data.trainer = SimpleNamespace(current_epoch=epoch)
        batch = next(iter(data.train_dataloader()))
        seen.append(bool((batch.first_bin >= 0).all()))
    assert seen == [True] * windowed + [False] * (epochs - windowed)
