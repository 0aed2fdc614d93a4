"""Codes as an operator of deepinv; a stand-in that calls the two functions is used where it is not installed."""

import sys

import numpy as np
import pytest
import torch
from deepinv_stand_in import provide_deepinv

import scene2spad as s2s
from csph.codes.physics import deepinv_physics

CODINGS = {
    "pixel": lambda: s2s.coding_tensor("fourier", 8, s2s.Sensor(bins=64)),
    "block": lambda: s2s.make_coding(s2s.Design("learned", (16, 2, 4), 6), seed=1),
    "full": lambda: s2s.make_coding(s2s.Design("learned", (16, 2, 4), 6, full=True), seed=2),
}


@pytest.fixture
def deepinv(monkeypatch):
    provide_deepinv(monkeypatch)


@pytest.mark.parametrize("name", CODINGS)
def test_the_operator_is_the_sum_over_blocks_and_has_its_adjoint(name, deepinv):
    coding = CODINGS[name]()
    physics, (mt, mr, mc) = deepinv_physics(coding), coding.block
    counts = torch.poisson(torch.full((2, 1, 64, 4, 8), 0.7), generator=torch.Generator().manual_seed(0))
    codes = physics(counts)
    blocks = counts.numpy().reshape(2, 64 // mt, mt, 4 // mr, mr, 8 // mc, mc)
    written = np.einsum("ktrc,bxtyrzc->bkxyz", coding.tensor.numpy().astype(float), blocks)
    assert np.allclose(codes.numpy(), written, rtol=1e-5, atol=1e-5)
    other = torch.randn(codes.shape, generator=torch.Generator().manual_seed(1))
    left, right = (codes * other).sum(), (counts * physics.A_adjoint(other)).sum()
    assert left.item() == pytest.approx(right.item(), rel=1e-4)


def test_counts_that_blocks_do_not_tile_are_refused(deepinv):
    with pytest.raises(s2s.InputError, match="not tiled"):
        deepinv_physics(CODINGS["block"]())(torch.zeros(1, 1, 64, 3, 8))


def test_without_deepinv_it_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "deepinv.physics", None)
    with pytest.raises(s2s.InputError, match="pip install deepinv"):
        deepinv_physics(CODINGS["pixel"]())
