"""Median and confidence of a posterior against plain twins; codes' rank; images of any size and in tiles."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from csph.codes.design import Design
from csph.codes.rank import coherence, participation_rank, pixel_gram, separable_gram
from csph.codes.temporal import orthogonal_start, spatial_seed, uniform_start
from csph.layer import CompressiveLayer
from csph.networks.config import ModelConfig
from csph.networks.images import mirrored, spans
from csph.networks.model import DepthModel
from csph.networks.posterior import confidence, decoded, posterior_median
from scene2spad.datasets.planes import random_planes
from scenes.errors import InputError
from spad.detection.detect import sense
from spad.measurements.histogram import TRUTH
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse

SMALL = Sensor(name="small", bins=64, bin_width_s=1e-10, pulse=Pulse(1.4e-10))


def plain_median(posterior: np.ndarray) -> float:
    """Go through the bins until half of the probability is reached, and a part of the last one."""
    gone = 0.0
    for number, fraction in enumerate(posterior):
        if gone + fraction >= 0.5:
            return number + (0.5 - gone) / fraction
        gone += fraction
    raise AssertionError


def plain_confidence(posterior: np.ndarray, position: float, within: float) -> float:
    """What part of every bin lies in the interval."""
    low, high = position - within, position + within
    return sum(fraction * max(0.0, min(high, i + 1) - max(low, i)) for i, fraction in enumerate(posterior))


def logits_of(*posteriors: list[float]) -> torch.Tensor:
    return torch.tensor(posteriors).clamp(min=1e-30).log().T.reshape(1, -1, 1, len(posteriors))


def test_median_by_hand():
    found = posterior_median(logits_of([0, 0, 1, 0], [0.5, 0, 0, 0.5], [0.25, 0.25, 0.25, 0.25], [0.1, 0.6, 0.2, 0.1]))
    torch.testing.assert_close(found.flatten(), torch.tensor([2.5, 1.0, 2.0, 1 + 0.4 / 0.6]))


def test_median_and_confidence_are_their_plain_twins():
    logits = 3 * torch.randn(2, 50, 4, 5, generator=torch.Generator().manual_seed(0))
    median = posterior_median(logits)
    sure = confidence(logits, median, 3.0)
    flat = logits.double().softmax(1).permute(0, 2, 3, 1).reshape(-1, 50).numpy()
    for one, position, fraction in zip(flat, median.flatten().tolist(), sure.flatten().tolist(), strict=True):
        assert position == pytest.approx(plain_median(one), abs=1e-4)
        assert fraction == pytest.approx(plain_confidence(one, position, 3.0), abs=1e-5)
    assert decoded(logits, "median").equal(median)


def test_median_moves_with_the_posterior_and_passes_nan_on():
    logits = torch.full((1, 40, 1, 1), -40.0)
    logits[0, 10:15, 0, 0] = torch.tensor([0.0, 1.0, 2.0, 0.5, 0.2])
    moved = logits.roll(7, 1)
    assert float(posterior_median(moved) - posterior_median(logits)) == pytest.approx(7, abs=1e-5)
    torch.testing.assert_close(confidence(moved, posterior_median(moved)), confidence(logits, posterior_median(logits)))
    logits[0, 3] = math.nan
    assert posterior_median(logits).isnan().all() and confidence(logits, torch.ones(1, 1, 1)).isnan().all()


def test_confidence_on_a_circle_does_not_depend_on_where_the_range_begins():
    """Rolling time moves position and posterior alike; only on a line do the ends of the range cut the interval."""
    logits = 3 * torch.randn(1, 20, 2, 3, generator=torch.Generator().manual_seed(1))
    place = torch.tensor([[[0.0, 1.3, 2.5], [9.9, 16.0, 19.7]]])
    there = confidence(logits, place, circular=True)
    for shift in (1, 4, 13):
        moved = confidence(logits.roll(shift, 1), (place + shift) % 20, circular=True)
        torch.testing.assert_close(moved, there, rtol=1e-4, atol=1e-6)
    on_a_line = confidence(logits, place)
    inside = (place >= 3) & (place <= 17)
    torch.testing.assert_close(there[inside], on_a_line[inside], rtol=1e-4, atol=1e-6)
    assert (there[~inside] > on_a_line[~inside]).all()


def test_a_flat_background_does_not_draw_the_median_to_mid_range():
    """The mean of 70 % at bin 10 and 30 % everywhere of 1000 lies at bin 157, the median within its bin."""
    posterior = torch.full((1000,), 0.3 / 1000)
    posterior[10] += 0.7
    logits = posterior.log().view(1, -1, 1, 1)
    assert float(decoded(logits, "soft-argmax")) == pytest.approx(157.35, abs=0.01)
    assert 10 < float(posterior_median(logits)) < 11
    assert float(confidence(logits, torch.full((1, 1, 1), 10.5))) == pytest.approx(0.7 + 0.3 * 6 / 1000, abs=1e-5)


def test_participation_rank_counts_the_directions_that_codes_tell_apart():
    alike = torch.ones(8, 4, 2, 2)
    apart = torch.eye(4).reshape(4, 1, 2, 2)
    assert participation_rank(pixel_gram(alike)) == pytest.approx(1)
    assert participation_rank(pixel_gram(apart)) == pytest.approx(4)
    assert participation_rank(pixel_gram(0 * apart)) == 0
    assert float(coherence(pixel_gram(alike))) == pytest.approx(1)
    assert float(coherence(pixel_gram(apart))) == pytest.approx(0)
    temporal, spatial = torch.randn(8, 16), torch.randn(8, 4, 4)
    formed = temporal[:, :, None, None] * spatial[:, None]
    torch.testing.assert_close(separable_gram(temporal, spatial), pixel_gram(formed), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("codes", "side"), [(32, 4), (8, 2), (8, 4), (20, 4)])
def test_an_orthogonal_start_has_full_rank_and_the_norms_of_the_uniform_one(codes, side):
    start = orthogonal_start((codes, side, side), side * side, 3)
    flat, pixels = start.flatten(1), side * side
    torch.testing.assert_close(flat.norm(dim=1), torch.full((codes,), 1 / math.sqrt(3)))
    uniform = uniform_start((4000, side, side), pixels, 3).flatten(1)
    assert float(uniform.square().sum(1).mean()) == pytest.approx(1 / 3, rel=0.03)
    if codes % pixels == 0:
        assert participation_rank(flat.T @ flat) == pytest.approx(pixels, rel=1e-4)
    layer = CompressiveLayer.of(Design("learned", (32, side, side), codes), sensor=SMALL, spatial_start="orthogonal")
    assert torch.equal(layer.spatial, orthogonal_start((codes, side, side), pixels, spatial_seed(0)))


def test_mirrored_and_spans():
    assert mirrored(-2, 5, 3).tolist() == [1, 0, 0, 1, 2, 2, 1]
    assert mirrored(0, 4, 1).tolist() == [0, 0, 0, 0]
    whole = spans(10, 4, 4, 5, None)
    assert len(whole) == 1 and whole[0].read.tolist() == [*range(10), 9, 8] and whole[0].own == slice(0, 10)
    parts = spans(30, 2, 4, 5, 10)
    assert [part.own for part in parts] == [slice(0, 12), slice(12, 24), slice(24, 30)]
    assert [(part.read[0], len(part.read), part.inner) for part in parts] == [(0, 20, 0), (4, 26, 8), (16, 14, 8)]


@pytest.mark.parametrize(
    "model",
    [
        ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL),
        ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL, network="blockwise"),
        ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL, network="refined"),
        ModelConfig(front="matched", sensor=SMALL),
        pytest.param(ModelConfig(front="counts", network="published-signed", sensor=SMALL), marks=pytest.mark.slow),
    ],
    ids=lambda m: m.name,
)
def test_tiles_give_what_the_whole_image_gives(model):
    histogram = sense(random_planes(1, size=70, seed=2).transients[0], SMALL, PhotonBudget(20, 5), seed=1)
    network = DepthModel(model, 2).eval()
    whole, tiled = network.estimate(histogram), network.estimate(histogram, tile=16)
    bins = np.abs(whole.depth_m - tiled.depth_m) / SMALL.bin_depth_m
    assert bins.max() < 1e-5 * SMALL.bins  # as float32 rounds sums of another order
    assert np.abs(whole.confidence - tiled.confidence).max() < 1e-5
    if model.design is not None:
        kinds = [network.estimate(histogram, int8=True, tile=tile) for tile in (None, 16)]
        assert np.abs(kinds[0].depth_m - kinds[1].depth_m).max() / SMALL.bin_depth_m < 1e-5 * SMALL.bins
        assert kinds[0].overflows == kinds[1].overflows


@pytest.mark.parametrize("size", [(3, 3), (24, 24), (22, 31), (1, 5)])
def test_images_that_blocks_do_not_tile(size):
    """From one row on, what is missing to whole blocks is reflected."""
    network = DepthModel(ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL), 2).eval()
    histogram = sense(random_planes(1, size=32, seed=2).transients[0], SMALL, PhotonBudget(20, 5), seed=1)
    rows, columns = size
    cut = {name: np.ascontiguousarray(getattr(histogram, name)[:rows, :columns]) for name in ("counts", *TRUTH)}
    found = network.estimate(replace(histogram, **cut))
    assert found.depth_m.shape == found.confidence.shape == size and np.isfinite(found.depth_m).all()
    assert (found.confidence >= 0).all() and (found.confidence <= 1).all()


def test_a_network_that_sees_no_photon_is_not_sure():
    """Without one it answers what training made likely; it was up to 69 % sure of that. Photons at its side count."""
    network = DepthModel(ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL), 2).eval()
    histogram = sense(random_planes(1, size=64, seed=2).transients[0], SMALL, PhotonBudget(20, 5), seed=1)
    counts = np.zeros_like(histogram.counts)
    for tile in (None, 16):
        dark = network.estimate(replace(histogram, counts=counts), tile=tile)
        assert not dark.confidence.any() and np.isfinite(dark.depth_m).all()
    counts[0, 0, 7] = 1
    found = network.estimate(replace(histogram, counts=counts))
    changed = found.depth_m != dark.depth_m
    assert changed.sum() > 100 and (found.confidence[changed] > 0).all()
    assert found.confidence[0, 0] > 0 and not found.confidence[32:].any()


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_answers_do_not_depend_on_mixed_precision(kind):
    """A sum in bf16 holds 8 bits, in float16 11: the mean of a peak was off by bins."""
    logits = torch.full((1, 1024, 1, 2), -20.0)
    logits[:, 777:780, :, 0] = 5.0
    logits[:, 901:903, :, 1] = 5.0
    for decoder in ("soft-argmax", "median"):
        exact = decoded(logits, decoder)
        with torch.autocast("cpu", dtype=kind):
            found = decoded(logits, decoder)
        assert found.dtype == torch.float32 and torch.equal(found, exact)


def test_decoders_by_another_name_are_refused():
    """They were the soft-argmax, unsaid."""
    with pytest.raises(InputError, match="'Median' is unknown, expected soft-argmax or median"):
        decoded(torch.zeros(1, 8, 2, 2), "Median")


@pytest.mark.parametrize("tile", [-5, 0, 2.5])
def test_tiles_of_no_pixel_are_refused(tile):
    """Their depth was whatever the memory held."""
    model = DepthModel(ModelConfig(front="counts", sensor=SMALL))
    with pytest.raises(InputError, match=r"tiles of .* expected a whole number"):
        model.estimate(None, tile=tile)
