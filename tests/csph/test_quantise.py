"""8-bit tensors and 16-bit sums against integer arithmetic written out."""

import numpy as np
import pytest
import torch

from csph.codes.blocks import encode_blocks
from csph.codes.design import Design
from csph.codes.quantise import PUBLISHED_STEP, encode_int16, published_int8, quantised
from csph.codes.tensor import CodingTensor
from csph.layer import CompressiveLayer, make_coding
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
    assert made.tensor.dtype == np.int8 and made.tensor.shape == (design.codes, *design.block)
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


def test_published_int8_is_127_and_a_half_steps_for_each_factor():
    """q = round(127.5 w), 2/255 a step, the same for every factor; clamped where the published code wraps around."""
    temporal = torch.tensor([[0.5, -1.0, 1.0, 3.0, -2.0, 0.0], [0.031, 0.02, 0.004, 0.003, -0.031, 0.9]])
    spatial = torch.tensor([[[0.25, -0.125]], [[0.1, 0.7]]])
    made = published_int8(CodingTensor("two factors", temporal, spatial))
    steps = torch.tensor([[64, -127, 127, 127, -127, 0], [4, 3, 1, 0, -4, 115]])
    torch.testing.assert_close(made.temporal, steps * 2 / 255)
    torch.testing.assert_close(made.spatial, torch.tensor([[[32, -16]], [[13, 89]]]) * 2 / 255)
    # not rounded a second time, as one 8-bit tensor is
    torch.testing.assert_close(made.tensor, made.temporal[:, :, None, None] * made.spatial[:, None], rtol=0, atol=0)
    full = published_int8(CodingTensor("full", temporal[..., None, None]))
    torch.testing.assert_close(full.temporal[..., 0, 0], steps * 2 / 255)
    assert full.spatial is None and pytest.approx(2 / 255, rel=1e-7) == PUBLISHED_STEP


def test_published_int8_of_fourier_rows_is_as_far_off_as_printed():
    """Root mean square error of 2.1e-3 to 2.3e-3 for cosines and sines (published)."""
    for code in ("fourier-published", "gray-published"):
        coding = make_coding(Design(code, (1024, 1, 1), 16))
        error = (published_int8(coding).tensor - coding.tensor).square().mean().sqrt()
        assert 2.1e-3 < error < 2.35e-3


def test_published_int8_errs_by_7_percent_where_1_127_of_the_product_errs_by_46():
    """Codes of a learned 256x4x4 as it begins, of 60 photons a pixel: what "fixed" was, and what is published."""
    coding = CompressiveLayer.of(Design("learned", (256, 4, 4), 32)).coding()
    seen = torch.from_numpy(np.random.default_rng(1).poisson(60 / 1024, (4, 1, 256, 16, 16)))
    exact = encode_blocks(seen, coding.tensor.double())

    def error(tensor: torch.Tensor) -> float:
        return float((encode_blocks(seen, tensor.double()) - exact).norm() / exact.norm())

    temporal, spatial = ((127 * part.double()).round() for part in (coding.temporal, coding.spatial))
    product = ((temporal[:, :, None, None] * spatial[:, None] + 64) / 128).floor() * 128 / 127**2
    assert error(product) == pytest.approx(0.46, abs=0.02)
    assert error(published_int8(coding).tensor) == pytest.approx(0.07, abs=0.01)
    assert error(quantised(coding).coding().tensor) < 0.03


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


def test_codes_of_zeros_stay_zero():
    zero = CodingTensor("zero", torch.zeros(2, 4))
    assert (quantised(zero).tensor == 0).all() and (published_int8(zero).tensor == 0).all()


def test_a_row_that_8_bits_lose_is_named_once(caplog):
    """All rows share one step: a thousandth of the largest was all zeros without a word."""
    wave = torch.cos(torch.arange(64) / 5)
    rows = torch.stack([wave, 1e-3 * wave, 0.02 * wave, 0 * wave, wave.roll(9)])
    for _ in range(2):
        quantised(CodingTensor("weak rows", rows))
    (told,) = (record.getMessage() for record in caplog.records)
    assert "weak rows: of its 5 codes" in told and "row 1 (0), 2 (3)," in told and "\n" not in told
    caplog.clear()
    quantised(CodingTensor("even rows", rows[[0, 4]]))
    for design in DESIGNS:
        quantised(make_coding(design))
    assert not caplog.records


def test_published_int8_names_the_rows_that_it_loses(caplog):
    published_int8(CodingTensor("weak as published", torch.tensor([[1.0, -1.0], [1e-3, 0.0]])))
    (told,) = (record.getMessage() for record in caplog.records)
    assert "weak as published: of its 2 codes" in told and "row 1 (0)," in told


def test_steps_are_those_that_the_parts_have():
    """8 bits would clip parts beyond 127 steps, and round those between two, without a word."""
    temporal, spatial = np.array([[0.3, -12.7], [0.1, 0.0]]), np.array([[[2.0, -4.0]], [[0.0, 254.0]]])
    found = quantised(CodingTensor("x", temporal, spatial, steps=(0.1, 2.0)))
    assert found.temporal.tolist() == [[3, -127], [1, 0]] and found.spatial.ravel().tolist() == [1, -2, 0, 127]
    wide = np.array([[1.0, -1.0], [0.5, -0.5]])
    for parts, words in (
        ({"temporal": wide, "steps": (0.001, 1.0)}, "0.001: the temporal part has up to 1000, limit 127"),
        ({"temporal": temporal, "steps": (0.2, 1.0)}, "0.2: the temporal part is 0.5 off whole ones, limit 0.001"),
        ({"temporal": temporal, "spatial": spatial, "steps": (0.1, 1.0)}, "1: the spatial part has up to 254"),
    ):
        with pytest.raises(InputError, match=f"coding tensor x: steps of {words}"):
            CodingTensor("x", **parts)
