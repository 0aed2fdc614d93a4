"""The layer against published numbers."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from csph.codes.tensor import CodingTensor
from csph.layer import CompressiveLayer

FIXTURE = Path(os.environ.get("SCENE2SPAD_DATA", Path(__file__).parents[3] / "shared" / "data")).parent


def fixture_tensor(name: str) -> CodingTensor:
    k, t, i = (torch.arange(n, dtype=torch.float64) for n in (4, 16, 2))
    phase = 0.5 * i[:, None] + 0.7 * i
    if name.startswith("separable"):
        return CodingTensor(
            name, torch.sin(0.1 * torch.outer(k + 1, t + 1)), (0.3 * (k + 1))[:, None, None].add(phase).cos()
        )
    if name.startswith("full"):
        return CodingTensor(name, (0.1 * torch.outer(k + 1, t + 1))[..., None, None].add(phase).sin())
    codes, bins = (int(name.split("_")[i].strip("kMt")) for i in (1, 2))
    return CodingTensor(name, torch.sin(0.1 * torch.outer(torch.arange(1.0, codes + 1), torch.arange(1.0, bins + 1))))


@pytest.mark.parametrize("name", ["separable_k4_Mt16_2x2", "full_k4_Mt16_2x2", "csph1d_k4_Mt32", "csph1d_k2_Mt32"])
def test_published_layer_outputs(name):
    path = FIXTURE / "fixtures" / "encoder.npz"
    if not path.is_file():
        pytest.skip(f"{path} is not there: set SCENE2SPAD_DATA to the data folder beside fixtures/")
    with np.load(path) as stored:
        counts, codes, projected = (torch.from_numpy(stored[key]) for key in ("x", f"{name}_B", f"{name}_X"))
    layer = CompressiveLayer(fixture_tensor(name))
    for ours, theirs in ((layer.encode(counts), codes), (layer(counts), projected)):
        assert ours.shape == theirs.shape
        assert (ours - theirs).abs().max() < 1e-5 * theirs.abs().max()


def test_the_text_of_the_published_fixture():
    """The few numbers printed with the fixture, so that this stands without the file."""
    t, r, c = (torch.arange(n, dtype=torch.float32) for n in (32, 4, 4))
    counts = ((7 * t[:, None, None] + 3 * r[:, None] + 5 * c) % 11)[None, None]
    layer = CompressiveLayer(fixture_tensor("full_k4_Mt16_2x2"))
    codes, projected = layer.encode(counts), layer(counts)
    assert codes[0, :, 0, 0, 0].tolist() == pytest.approx([4.23150, 5.26467, -0.67576, -2.84998], abs=2e-5)
    assert float(codes.abs().sum()) == pytest.approx(96.74655, abs=2e-4)
    assert projected[0, 0, :3, 0, 0].tolist() == pytest.approx([-0.96985, -0.95803, -0.94599], abs=2e-5)
    assert float(projected.abs().sum()) == pytest.approx(326.93695, abs=1e-3)
