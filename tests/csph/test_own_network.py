"""A network of a user's own in `DepthModel`: what it must have, and what knows it."""

import numpy as np
import pytest
import torch
from torch import nn

from csph.codes.design import Design
from csph.networks.checkpoint import save_model
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from scenes import InputError
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor

SMALL = Sensor(bins=64, bin_width_s=1e-9)
MODEL = ModelConfig(design=Design("learned", (32, 2, 2), 8), sensor=SMALL)


class Smoothed(nn.Module):
    reach, coarsest = 1, 1

    def __init__(self) -> None:
        super().__init__()
        self.only = nn.Conv3d(1, 1, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 10 * self.only(x).squeeze(1)


def test_an_own_network_finds_depth_in_tiles_as_in_one_piece(tmp_path):
    torch.manual_seed(0)
    model = DepthModel(MODEL, network=Smoothed()).eval()
    histogram = Histogram.from_counts(np.random.default_rng(0).poisson(0.3, (12, 14, 64)), SMALL)
    whole, tiled = (model.estimate(histogram, tile=tile).depth_m for tile in (None, 4))
    np.testing.assert_allclose(tiled, whole, atol=1e-4)
    with pytest.raises(InputError, match=r"own\.safetensors: its network is no registered one: keep its state_dict"):
        save_model(model, TrainConfig(MODEL, crop=8), {}, tmp_path / "own.safetensors")
    assert not list(tmp_path.iterdir())
    again = DepthModel(MODEL, network=Smoothed())
    again.load_state_dict(model.state_dict())
    assert np.array_equal(again.eval().estimate(histogram).depth_m, whole)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (nn.Identity(), "DepthModel: network Identity: reach None, expected a whole number of pixels, 0 or more"),
        (lambda x: x, "DepthModel: network: expected a Module, not function"),
    ],
)
def test_what_is_no_network_is_refused(network, message):
    with pytest.raises(InputError, match=message):
        DepthModel(MODEL, network=network)
