"""The network that sees codes and places in a block: its plain twin, its start, its scale, its files."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from csph.codes.design import Design
from csph.networks.blockwise import BlockMixer, code_features
from csph.networks.checkpoint import load_model, save_model
from csph.networks.compact import FOLD
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from scenes.errors import InputError
from spad.sensor.model import Sensor

SMALL = Sensor(bins=64, bin_width_s=100e-9 / 64)
COMPACT = ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL)
BLOCKWISE = replace(COMPACT, network="blockwise")


def counts(rows: int = 8, columns: int = 12) -> torch.Tensor:
    mean = np.random.default_rng(3).gamma(0.5, 2.0, (2, 1, 64, rows, columns))
    return torch.poisson(torch.from_numpy(mean).float(), generator=torch.Generator().manual_seed(1))


def awake(config: ModelConfig = BLOCKWISE) -> DepthModel:
    """A model whose mixers, which begin as zero, add something."""
    model = DepthModel(config, 2)
    random = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for mixer in (model.network.early, model.network.late):
            for parameter in (mixer.outer.weight, mixer.outer.bias, mixer.bias):
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=random))
    return model.eval()


def mixed_plainly(mixer: BlockMixer, features: torch.Tensor, codes: torch.Tensor) -> torch.Tensor:
    """x + D relu(A x + B_s u + b_s), one block and coarse bin after the other."""
    batch, times, down, across, _ = codes.shape
    places, result = len(mixer.of_codes), features.clone()
    for b, t, s, i, j in np.ndindex(batch, times, places, down, across):
        part = (b * times + t) * places + s, slice(None), *_block(mixer, i, j)
        x = features[part].permute(1, 2, 0).flatten()  # rows, columns, channels
        h = mixer.inner.weight @ x + mixer.of_codes[s].T @ codes[b, t, i, j] + mixer.bias[s, 0]
        added = mixer.outer.weight @ h.relu() + mixer.outer.bias
        result[part] += added.view(mixer.rows, mixer.columns, -1).permute(2, 0, 1)
    return result


def _block(mixer: BlockMixer, i: int, j: int) -> tuple[slice, slice]:
    return slice(i * mixer.rows, (i + 1) * mixer.rows), slice(j * mixer.columns, (j + 1) * mixer.columns)


@pytest.mark.parametrize("block", [(32, 4, 4), (64, 2, 2), (16, 1, 1), (32, 2, 4)])
def test_a_mixer_is_its_plain_twin(block):
    mixer = BlockMixer(5, block, 8)
    torch.nn.init.normal_(mixer.outer.weight)
    torch.nn.init.normal_(mixer.bias)
    random = torch.Generator().manual_seed(0)
    times = 64 // block[0]
    features = torch.randn((2 * 64 // FOLD, 5, 4, 8), generator=random)
    codes = torch.randn((2, times, 4 // block[1], 8 // block[2], 9), generator=random)
    with torch.no_grad():
        torch.testing.assert_close(mixer(features, codes), mixed_plainly(mixer, features, codes), rtol=1e-4, atol=1e-4)


def test_it_begins_as_the_compact_network():
    compact, blockwise = DepthModel(COMPACT, 1), DepthModel(BLOCKWISE, 5)
    blockwise.begin_with(compact)
    assert torch.equal(compact(counts()), blockwise(counts()))
    network = DepthModel(BLOCKWISE, 7)
    network.begin_with_network(compact)
    assert torch.equal(network.network.fine.weight, compact.network.fine.weight)
    with pytest.raises(RuntimeError, match="early"):
        DepthModel(COMPACT, 1).begin_with(blockwise)


def test_every_part_learns():
    model = awake().train()
    model(counts()).square().mean().backward()
    still = [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.any())]
    assert not still


def test_codes_count_and_their_scale_does_not():
    model = awake()
    with torch.no_grad():
        codes = model.layer.encode(counts())
        logits = model.logits_of_codes(codes)
        torch.testing.assert_close(model.logits_of_codes(7.5 * codes), logits, rtol=1e-3, atol=1e-3)
        x = model.layer.decode(codes)
        assert (model.network(x, codes.roll(1, 3)) - logits).abs().max() > 0.1
        nothing = model.logits_of_codes(torch.zeros_like(codes))
        assert bool(nothing.isfinite().all())


def test_the_time_block_of_the_signal_is_told():
    """Normalised codes of a time block forget how much light it holds; the last feature does not."""
    codes = torch.zeros((1, 4, 2, 1, 1))
    codes[0, :, 0, 0, 0] = torch.tensor([3.0, -3.0, 1.0, -1.0])
    codes[0, :, 1, 0, 0] = 0.5 * codes[0, :, 0, 0, 0]
    seen = code_features(codes)
    torch.testing.assert_close(seen[0, 0, 0, 0, :4], seen[0, 1, 0, 0, :4], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(seen[0, :, 0, 0, 4], torch.tensor([1.0, 0.5]) / 1.25**0.5)


def test_checkpoints_keep_it(tmp_path):
    model, path = awake(), tmp_path / "model.safetensors"
    save_model(model, TrainConfig(model=BLOCKWISE, crop=8), {"step": 1}, path)
    again, config, _ = load_model(path)
    assert config.model == BLOCKWISE and torch.equal(again(counts()), model(counts()))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"front": "matched", "design": None}, "network blockwise: is for codes, and there are none"),
        ({"design": Design("learned", (8, 4, 4), 8)}, "blocks of 8 bins, expected a multiple of 16"),
    ],
)
def test_what_it_does_not_fit_is_refused(config, message):
    with pytest.raises(InputError, match=message):
        replace(BLOCKWISE, **config)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_features_of_codes_do_not_depend_on_mixed_precision(kind):
    """Means of bright blocks, in 16 bits, rounded away the codes or overflowed into NaN."""
    codes = torch.randn(1, 8, 2, 2, 3, generator=torch.Generator().manual_seed(0)) + 50
    for scale in (1.0, 1e4):
        exact = code_features(scale * codes)
        with torch.autocast("cpu", dtype=kind):
            found = code_features(scale * codes)
        assert exact.isfinite().all() and torch.equal(found, exact)
