"""The end of the range in `study depth-offset`: what is changed at a time, and walls of one depth."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene2spad.datasets.planes import wall
from scene2spad.networks.registry import ModelRegistry, ModelSpec
from scene2spad.networks.training import network_method
from scene2spad.studies.depth_offset import range_end
from spad.detection.detect import sense
from spad.sensor.model import PhotonBudget, Sensor

SENSOR = Sensor()


@pytest.fixture(scope="module")
def fourier(tmp_path_factory):
    return ModelRegistry(tmp_path_factory.mktemp("none")).find(ModelSpec("fourier", (1024, 1, 1)))


@pytest.fixture(scope="module")
def histogram():
    return sense(wall(2.0, 8), SENSOR, PhotonBudget(500, 50), seed=4, model="poisson")


@pytest.mark.parametrize("name", range_end.ARMS)
def test_every_arm_finds_a_near_wall(fourier, histogram, name):
    depth = network_method(range_end.arm(fourier, name, 0.0).model)(histogram)
    assert abs(np.median(depth) - 2.0) < 0.3


def test_results_of_an_arm_are_kept_by_weights_and_decoder(fourier):
    """The published grid is read by soft-argmax: its results were taken for those of the median."""
    model = copy.copy(fourier.model)
    model.config = replace(model.config, grid="published")
    other = replace(fourier, model=model)
    assert other.digest == fourier.digest
    for name in range_end.ARMS:
        assert range_end.arm(other, name).digest != range_end.arm(fourier, name).digest


def test_arms_that_move_nothing_are_the_model_as_trained(fourier, histogram):
    plain, _ = range_end.arm(fourier, "as trained").model.depth_of(histogram)
    for name in ("near input, far place", "far input, near place"):
        assert np.array_equal(range_end.arm(fourier, name, 0.0).model.depth_of(histogram)[0], plain)


def test_the_mean_over_k_alone_is_not_the_same_at_every_delay(fourier, histogram):
    """Truncated Fourier codes turn with a delay: without removal of the mean the back-projection moves with it."""
    counts = torch.from_numpy(histogram.counts).permute(2, 0, 1)[None, None].float()
    delayed = counts.roll(300, 2)
    layer = fourier.model.layer
    kept = range_end.MeanKept(layer)
    with torch.no_grad():
        assert torch.allclose(kept(delayed), kept(counts).roll(300, 2), atol=2e-3)  # codes are kept in half precision
        assert not torch.allclose(layer(delayed), layer(counts).roll(300, 2), atol=1e-2)


def test_moved_inputs_undo_one_another(fourier, histogram):
    """A near input at the far place is the input of the near scene, moved: the network sees it delayed."""
    # in memory as what is rolled lies: products of matrices that lie otherwise are rounded otherwise
    counts = torch.from_numpy(histogram.counts).permute(2, 0, 1)[None, None].float().contiguous()
    moved = range_end.NearInput(fourier.model.layer, 200)
    with torch.no_grad():
        assert torch.equal(moved(counts.roll(200, 2)), fourier.model.layer(counts).roll(200, 2))


def test_a_wall_is_equally_far_in_every_pixel():
    flat = wall(3.25, 4)
    assert flat.depth_m.shape == (4, 4) and np.all(flat.depth_m == np.float32(3.25))
    assert np.allclose(flat.path_near_m, 6.5) and np.array_equal(flat.path_near_m, flat.path_far_m)


def test_the_observation_names_the_arm_that_fails():
    rows = range_end.arm_rows(
        {
            ("as trained", 0.0): [10, 12],
            ("as trained", 12.0): [400, 500],
            ("mean kept", 0.0): [20],
            ("mean kept", 12.0): [21],
        }
    )
    trained, kept = range_end.observation(rows, 2.0)
    assert "fails" in trained and "450 mm" in trained and "400 to 500" in trained
    assert "holds to the end of the range" in kept
