"""8-bit tensors and 16-bit sums against integer arithmetic written out."""

import numpy as np
import pytest
import torch

from csph.blocks import encode_blocks
from csph.coding import CodingTensor
from csph.design import Design
from csph.layer import CompressiveLayer, make_coding
from csph.quantise import encode_int16, quantised
from scenes.errors import InputError

DESIGNS = (
    Design("fourier", (32, 1, 1), 8),
    Design("learned", (16, 2, 2), 8),
    Design("learned", (16, 2, 2), 6, full=True),
    Design("hadamard", (16, 2, 2), 4),
)


def counts(mean: float) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(1).poisson(mean, (2, 1, 32, 4, 4)))


@pytest.mark.parametrize("design", DESIGNS, ids=lambda d: d.name)
def test_each_factor_is_rounded_to_the_nearest_of_255_steps(design):
    coding = make_coding(design)
    made = quantised(coding)
    assert made.tensor.dtype == np.int8 and made.tensor.shape == (design.codes, *design.block) and made.clipped == 0
    for part, step, scale in (
        (coding.temporal, made.temporal, made.temporal_scale),
        (coding.spatial, made.spatial, made.spatial_scale),
    ):
        if part is not None:
            assert step.dtype == np.int8 and np.abs(step).max() == 127
            assert np.abs(step * scale - part.numpy()).max() <= scale / 2 * (1 + 1e-6)
    # of a product of two factors: half a step each, times the other's largest value, and half a step of the product
    steps = 0.5 if coding.spatial is None else 0.5 + (127.5 + 127) / 2 / 128 + 1 / 512
    assert (made.coding().tensor - coding.tensor).abs().max() <= steps * made.scale * (1 + 1e-5)


def test_separable_products_are_shifted_as_integers():
    made = quantised(make_coding(Design("learned", (16, 2, 2), 8)))
    for k, t, r, c in np.ndindex(made.tensor.shape):
        product = int(made.temporal[k, t]) * int(made.spatial[k, r, c])
        assert made.tensor[k, t, r, c] == (product + 64) // 128
    assert made.scale == pytest.approx(128 * made.temporal_scale * made.spatial_scale)


def test_a_fixed_range_clamps_instead_of_wrapping():
    coding = CodingTensor("wide", torch.tensor([[0.5, -1.0, 1.004, 3.0, -2.0, 0.0]]))
    made = quantised(coding, "fixed")
    assert made.tensor.ravel().tolist() == [64, -127, 127, 127, -127, 0]
    assert made.scale == pytest.approx(1 / 127) and made.clipped == 3
    narrow = quantised(coding, "fixed", top=4.0)
    assert narrow.clipped == 0 and narrow.tensor.ravel()[3] == 95


@pytest.mark.parametrize("design", DESIGNS, ids=lambda d: d.name)
def test_integer_codes_stand_for_the_float_codes(design):
    made, seen = quantised(make_coding(design)), counts(3.0)
    codes, overflows = encode_int16(seen, made)
    assert codes.dtype == torch.int16 and overflows == 0
    exact = encode_blocks(seen, made.coding().tensor.double())
    assert (codes * made.scale - exact).abs().max() < 1e-4 * exact.abs().max()


def test_overflow_wraps_and_is_counted():
    made = quantised(CodingTensor("ones", torch.ones(2, 4) * torch.tensor([[1.0], [-1.0]])))
    for photons, wrapped in ((258, 0), (259, 2), (1000, 2)):
        histogram = torch.zeros(1, 1, 4, 1, 1, dtype=torch.int64)
        histogram[0, 0, 2] = photons
        codes, overflows = encode_int16(histogram, made)
        assert overflows == wrapped
        sums = np.zeros(2, np.int16)
        for _ in range(photons):  # one detection after the other
            sums += np.array([127, -127], np.int16)
        assert codes.flatten().tolist() == sums.tolist()


def test_depth_layers_decode_integer_codes():
    layer = CompressiveLayer.of(Design("fourier", (32, 1, 1), 8))
    lone = torch.zeros(1, 1, 32, 1, 1)
    lone[0, 0, 11] = 200
    codes, _ = encode_int16(lone, quantised(layer.coding()))
    assert layer.decode(codes).argmax() == 11


def test_empty_ranges_and_unknown_scalings():
    assert (quantised(CodingTensor("zero", torch.zeros(2, 4))).tensor == 0).all()
    with pytest.raises(InputError, match="expected calibrated or fixed"):
        quantised(CodingTensor("zero", torch.zeros(2, 4)), "loose")
    with pytest.raises(InputError, match="top 0"):
        quantised(CodingTensor("zero", torch.zeros(2, 4)), "fixed", top=0.0)
