"""The network on a circle of time: its law, its plain twin, its start, what it is for, its files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from csph.codes.design import Design
from csph.networks.checkpoint import load_model, save_model
from csph.networks.compact import Compact
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from csph.networks.periodic import PERIOD, STEP, CircularInTime, Periodic
from csph.networks.posterior import confidence
from scenes.errors import InputError
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

BINS = 128
SMALL = Sensor(bins=BINS, bin_width_s=100e-9 / BINS)
FOURIER = ModelConfig(design=Design("fourier", (BINS, 1, 1), 8), sensor=SMALL, layer={"keep_mean": True})
PERIODIC = replace(FOURIER, network="periodic")


def counts(rows: int = 8, columns: int = 12) -> Tensor:
    mean = np.random.default_rng(3).gamma(0.5, 2.0, (2, 1, BINS, rows, columns))
    return torch.poisson(torch.from_numpy(mean).float(), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("code", ["fourier", "gray", "fourier-published", "gray-published"])
@pytest.mark.parametrize("steps", [1, 3, 4, 13])
def test_a_delay_moves_the_answer(code, steps):
    """From histograms on: photons that come 8 bins later, around the end of the range, move the logits by 8 bins."""
    model = DepthModel(replace(PERIODIC, design=Design(code, (BINS, 1, 1), 8)), 2).eval()
    seen, shift = counts(), steps * STEP
    with torch.no_grad():
        moved, logits = model(seen.roll(shift, 2)), model(seen)
    torch.testing.assert_close(moved, logits.roll(shift, 1), rtol=1e-3, atol=1e-3)


def test_a_delay_around_the_end_of_the_range_leaves_the_network_as_sure():
    """Move the light by 32 bins: the share of the posterior around its own peak stays the same."""
    model = DepthModel(PERIODIC, 2).eval()
    early, pulse = np.zeros((8, 8, BINS), np.int32), [3, 9, 3]
    early[..., BINS - 2 :], early[..., 0] = pulse[:2], pulse[2]
    later = np.roll(early, PERIOD, 2)
    with torch.no_grad():
        logits = [model(torch.from_numpy(one).permute(2, 0, 1)[None, None].float()) for one in (early, later)]
    at = torch.full((1, 8, 8), BINS - 0.5)
    sure = [confidence(of, place % BINS, circular=True) for of, place in zip(logits, (at, at + PERIOD), strict=True)]
    torch.testing.assert_close(sure[0], sure[1], rtol=1e-3, atol=1e-5)


def test_an_estimate_on_both_ends_of_the_range_is_sure(monkeypatch):
    """Three fifths of the posterior are in the first bin, the others in the last one."""
    model = DepthModel(PERIODIC, 2).eval()
    posterior = torch.full((1, BINS, 8, 8), 1e-9)
    posterior[:, 0], posterior[:, -1] = 0.6, 0.4
    monkeypatch.setattr(model, "forward", lambda counts: posterior.log())
    found = model.estimate(Histogram.from_counts(np.ones((8, 8, BINS), np.int32), SMALL))
    assert (found.depth_m < SMALL.bin_depth_m).all() and (found.confidence > 0.999).all()


def test_in_training_it_follows_whole_periods():
    model = DepthModel(PERIODIC, 2).train()
    with torch.no_grad():
        whole, part = (model(counts().roll(shift, 2)) - model(counts()).roll(shift, 1) for shift in (PERIOD, STEP))
    assert whole.abs().max() < 1e-3 < 0.05 < part.abs().max()


def test_the_compact_network_breaks_that_law():
    """So the test above can fail: zeros before the first bin are seen near both ends of the range."""
    model = DepthModel(FOURIER, 2).eval()
    with torch.no_grad():
        moved, logits = model(counts().roll(PERIOD, 2)), model(counts())
    assert (moved - logits.roll(PERIOD, 1)).abs().max() > 0.01


def test_it_is_the_compact_network_of_three_periods():
    """The plain twin: the middle of three copies of the range, farther from both ends than the network sees; trained,
    the mean over four delays."""
    torch.manual_seed(1)
    periodic, compact = Periodic().eval(), Compact().eval()
    compact.load_state_dict(periodic.state_dict())
    x = torch.randn(2, 1, 256, 6, 9)
    with torch.no_grad():
        delayed = [compact(x.roll(by, 2).repeat(1, 1, 3, 1, 1))[:, 256:512].roll(-by, 1) for by in (0, 8, 16, 24)]
        torch.testing.assert_close(periodic.train()(x), delayed[0], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(periodic.eval()(x), sum(delayed) / 4, rtol=1e-4, atol=1e-4)


def test_its_convolutions_in_three_dimensions_are_plain_ones_of_a_range_continued():
    periodic = Periodic().eval()
    layers = [module for module in periodic.modules() if isinstance(module, CircularInTime)]
    assert len(layers) == len([module for module in periodic.modules() if isinstance(module, nn.Conv3d)]) == 3
    for layer in layers:
        x = torch.randn(1, layer.in_channels, 8, 6, 6)
        around = torch.cat([x[:, :, -1:], x, x[:, :, :1]], 2)
        plain = F.conv3d(F.pad(around, (1, 1, 1, 1)), layer.weight, layer.bias, layer.stride)
        torch.testing.assert_close(layer(x), plain, rtol=1e-4, atol=1e-5)


def test_it_begins_with_the_weights_of_the_compact_network():
    compact, periodic = DepthModel(FOURIER, 1), DepthModel(PERIODIC, 5)
    periodic.begin_with(compact)
    state = compact.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in periodic.state_dict().items())


def test_every_part_learns():
    model = DepthModel(PERIODIC, 2).train()
    model(counts()).square().mean().backward()
    assert all(p.grad is not None and bool(p.grad.any()) for p in model.parameters())


def test_its_checkpoint_gives_the_same_answers(tmp_path):
    model = DepthModel(PERIODIC, 2).eval()
    save_model(model, TrainConfig(PERIODIC), {}, tmp_path / "model.safetensors")
    again, config, _ = load_model(tmp_path / "model.safetensors")
    assert config.model == PERIODIC
    assert torch.equal(again(counts()), model(counts()))


@pytest.mark.parametrize(
    "changes",
    [
        {"layer": {}},
        {"design": Design("learned", (BINS, 1, 1), 8)},
        {"design": Design("fourier", (BINS // 2, 1, 1), 8)},
        {"design": None, "front": "counts", "layer": {}},
        {"sensor": Sensor(bins=BINS, bin_width_s=100e-9 / BINS, period_s=200e-9)},
    ],
    ids=["without the mean", "learned codes", "half of the range", "no codes", "half of the period"],
)
def test_it_is_for_codes_that_know_no_first_bin(changes):
    with pytest.raises(InputError, match=r"network periodic: is for Fourier codes over all \d+ bins of a period with"):
        replace(PERIODIC, **changes)


def test_bins_that_its_coarsest_slices_do_not_tile():
    with pytest.raises(InputError, match="48 bins: expected a multiple of 32"):
        Periodic()(torch.zeros(1, 1, 48, 4, 4))
    sensor = Sensor(bins=48, bin_width_s=1e-9)
    with pytest.raises(InputError, match="network periodic: 48 bins, expected a multiple of 32"):
        replace(PERIODIC, sensor=sensor, design=Design("fourier", (48, 1, 1), 8))
    with pytest.raises(InputError, match="network compact: 1000 bins, expected a multiple of 16"):
        ModelConfig(front="counts", sensor=Sensor(bins=1000))
