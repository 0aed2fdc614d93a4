"""The network that looks at the codes twice: its plain twin, its start, what the second look is told, its files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from csph.codes.design import Design
from csph.codes.quantise import HALF_RANGE
from csph.networks.blockwise import code_features
from csph.networks.checkpoint import load_model, save_model
from csph.networks.compact import FOLD, averages
from csph.networks.config import ModelConfig, TrainConfig
from csph.networks.model import DepthModel
from csph.networks.refined import MAX_LOG_AMPLITUDE, unexplained
from scenes.errors import InputError
from spad.sensor.model import Sensor

SMALL = Sensor(bins=64, bin_width_s=100e-9 / 64)
BLOCKWISE = ModelConfig(design=Design("learned", (32, 4, 4), 8), sensor=SMALL, network="blockwise")
REFINED = replace(BLOCKWISE, network="refined")


def counts(rows: int = 8, columns: int = 12) -> Tensor:
    mean = np.random.default_rng(3).gamma(0.5, 2.0, (2, 1, 64, rows, columns))
    return torch.poisson(torch.from_numpy(mean).float(), generator=torch.Generator().manual_seed(1))


def awake(config: ModelConfig = REFINED) -> DepthModel:
    """A model whose products that begin as zero add something."""
    model = DepthModel(config, 2)
    network, random = model.network, torch.Generator().manual_seed(4)
    begins_as_zero = [network.amplitude, network.correction, network.correction_gates]
    begins_as_zero += [mixer.outer for mixer in (network.early, network.late, network.residual_mixer)]
    with torch.no_grad():
        for layer in begins_as_zero:
            layer.weight.copy_(0.3 * torch.randn(layer.weight.shape, generator=random))
            layer.bias.copy_(0.3 * torch.randn(layer.bias.shape, generator=random))
    return model.eval()


def logits_plainly(model: DepthModel, codes: Tensor) -> Tensor:
    """The logits by dense tensors and plain sums over blocks, with the steps of the second look written out."""
    network, layer = model.network, model.layer
    weights = layer.weights().double()  # (K, Mt, Mr, Mc)
    mt, mr, mc = weights.shape[1:]
    x = layer.decode(codes)
    seen = code_features(codes, centre=network.centre)
    features, slices = network.features(x, lambda f: network.early(f, seen), lambda f: network.late(f, seen))
    first = _read(features, slices, network.fine, network.skip_gates, x)
    batch, bins, rows, columns = first.shape
    p = first.softmax(1)
    log = torch.einsum("nchw,c->nhw", features, network.amplitude.weight[0]) + network.amplitude.bias
    a = log.clamp(-MAX_LOG_AMPLITUDE, MAX_LOG_AMPLITUDE).exp().view(batch, bins // FOLD, rows, columns)
    light = (a.repeat_interleave(FOLD, 1) * p).double()
    residual, back = torch.zeros(codes.shape).double(), torch.zeros(first.shape).double()
    unit = weights - weights.mean(0) if network.centre else weights
    unit = unit / (unit.norm(dim=0) + 1e-5)
    for b, i, j in np.ndindex(batch, rows // mr, columns // mc):
        own = b, slice(None), slice(i * mr, (i + 1) * mr), slice(j * mc, (j + 1) * mc)
        of_block = light[own].view(bins // mt, mt, mr, mc)
        q = torch.einsum("kmrc,tmrc->kt", weights, of_block)
        y = codes[b, :, :, i, j].double()
        y, q = (y - y.mean(0), q - q.mean(0)) if network.centre else (y, q)
        y = y / y.norm()
        r = y - max(float((y * q).sum() / (q * q).sum()), 0.0) * q
        residual[b, :, :, i, j] = r
        back[own] = torch.einsum("kmrc,kt->tmrc", unit, r).reshape(bins, mr, mc)
    residual, left = residual.float(), back.float().view(-1, FOLD, rows, columns)
    into = torch.cat([left, p.reshape(-1, FOLD, rows, columns)], 1)
    stretched = into.view(batch, -1, 2 * FOLD, rows * columns).transpose(1, 2)
    added = network.residual_stem(stretched).relu().transpose(1, 2).reshape(features.shape)
    features = network.second(features + added, batch)
    told = torch.cat([residual, residual.norm(dim=1, keepdim=True)], 1).permute(0, 2, 3, 4, 1)
    features = network.third(network.residual_mixer(features, told), batch)
    return first + _read(features, left, network.correction, network.correction_gates, x)


def _read(features: Tensor, slices: Tensor, fine: torch.nn.Linear, gates: torch.nn.Linear, x: Tensor) -> Tensor:
    across = features.permute(0, 2, 3, 1)
    total = fine(across).permute(0, 3, 1, 2)
    for number, view in enumerate((slices, *averages(slices))):
        total = total + gates(across)[..., number].unsqueeze(1) * view
    return total.reshape(x.shape[0], *x.shape[2:])


DESIGNS = [Design("learned", (32, 4, 4), 8), Design("learned", (64, 2, 2), 4), Design("fourier", (64, 1, 1), 8)]


@pytest.mark.parametrize("design", DESIGNS, ids=lambda d: d.name)
def test_the_second_look_is_its_plain_twin(design):
    model = awake(replace(REFINED, design=design))
    with torch.no_grad():
        codes = model.layer.encode(counts())
        torch.testing.assert_close(model.logits_of_codes(codes), logits_plainly(model, codes), rtol=1e-3, atol=1e-3)


def test_it_begins_as_the_blockwise_network():
    blockwise, refined = DepthModel(BLOCKWISE, 1), DepthModel(REFINED, 5)
    refined.begin_with(blockwise)
    assert torch.equal(blockwise(counts()), refined(counts()))
    compact = DepthModel(replace(BLOCKWISE, network="compact"), 3)
    refined.begin_with(compact)
    assert torch.equal(compact(counts()), refined(counts()))
    with pytest.raises(RuntimeError, match="amplitude"):
        DepthModel(BLOCKWISE, 1).begin_with(refined)


def test_a_single_code_is_seen_where_its_mean_is_kept():
    """Less its mean over K one code is zero: the network would see codes by name alone."""
    single = replace(REFINED, design=Design("learned", (32, 2, 2), 1), layer={"keep_mean": True})
    model = awake(single)
    with torch.no_grad():
        codes = model.layer.encode(counts())
        seen = code_features(codes, centre=model.network.centre)
        assert bool((seen[..., 0].abs() > 0.9).any()) and bool((seen[..., 1] > 0).any())
        torch.testing.assert_close(model(counts()), logits_plainly(model, codes), rtol=1e-3, atol=1e-3)


def test_every_part_learns():
    model = awake().train()
    model(counts()).square().mean().backward()
    still = [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.any())]
    assert not still


@pytest.mark.parametrize("seed", range(3))
def test_codes_that_the_answer_explains_leave_nothing(seed):
    """y proportional to C l, whatever the scales; a prediction of the opposite sign explains nothing."""
    random = torch.Generator().manual_seed(seed)
    codes = torch.randn((2, 8, 2, 3, 3), generator=random)
    scale = 10 ** torch.empty((2, 1, 1, 3, 3)).uniform_(-2, 4, generator=random)
    assert unexplained(scale * codes, 3.0 * codes).abs().max() < 1e-6
    other = torch.randn(codes.shape, generator=random)
    left = unexplained(codes, other)
    length = left.square().sum((1, 2))
    assert bool((length <= 1 + 1e-6).all())  # least squares never leaves more than there was
    torch.testing.assert_close(unexplained(codes, -codes).square().sum((1, 2)), torch.ones(2, 3, 3))
    kept = unexplained(codes + 5.0, codes + 5.0, centre=False)
    assert kept.abs().max() < 1e-6


def test_scale_of_the_codes_does_not_count():
    model = awake()
    with torch.no_grad():
        codes = model.layer.encode(counts())
        torch.testing.assert_close(
            model.logits_of_codes(7.5 * codes), model.logits_of_codes(codes), rtol=1e-3, atol=2e-3
        )


@pytest.mark.parametrize("kind", ["none", "one photon", "one bin", "background", "half of the image"])
def test_logits_and_slopes_are_finite_in_hard_cases(kind):
    histogram = torch.zeros((1, 1, 64, 8, 8))
    if kind == "one photon":
        histogram[0, 0, 5, 2, 3] = 1
    elif kind == "one bin":
        histogram[:, :, 63] = 60_000
    elif kind == "background":
        histogram[:] = 1_000
    elif kind == "half of the image":
        histogram[..., :4] = counts(8, 4)[:1]
    model = awake().train()
    logits = model(histogram)
    assert bool(logits.isfinite().all())
    logits.logsumexp(1).mean().backward()
    assert all(bool(p.grad.isfinite().all()) for p in model.parameters() if p.grad is not None)


def test_predicted_codes_do_not_wrap_in_8_bits():
    """The chip's sums wrap; what the second look predicts is a mean, of any scale."""
    config = replace(REFINED, layer={"int8": True})
    model = awake(config)
    light = torch.full((1, 1, 64, 8, 8), 0.01)
    light[:, :, 3] = 20.0 * HALF_RANGE
    with torch.no_grad():
        codes = model.layer.encode_mean(light)
        torch.testing.assert_close(model.layer.encode_mean(1e-4 * light), 1e-4 * codes, rtol=1e-4, atol=1e-3)
        exact = torch.einsum("kmrc,bzmirjc->bkzij", model.layer.weights(), light.view(1, 2, 32, 2, 4, 2, 4))
        torch.testing.assert_close(codes, exact, rtol=1e-4, atol=1.0)
        assert (model.layer.encode(light.round()) - exact).abs().max() > 1e3
        assert bool(model(counts()).isfinite().all())


@pytest.mark.parametrize("options", [{}, {"keep_mean": True}, {"pulse_in_decoder": True}, {"per_pixel_norm": True}])
def test_back_projection_of_residuals_is_linear_and_decodes_unit_codes(options):
    model = awake(replace(REFINED, layer=options))
    with torch.no_grad():
        codes = model.layer.encode(counts())
        back = model.layer.back_project(codes)
        torch.testing.assert_close(model.layer.back_project(3 * codes), 3 * back, rtol=1e-4, atol=1e-2)
        ratio = model.layer.decode(codes)[0, 0, :32, :4, :4] / back[0, 0, :32, :4, :4]  # of one block: its length alone
        assert float(ratio.std() / ratio.mean()) < 1e-3
    with pytest.raises(InputError, match=r"expected \(batch, 8"):
        model.layer.back_project(codes[:, :5])


def test_checkpoints_keep_it(tmp_path):
    model, path = awake(), tmp_path / "model.safetensors"
    save_model(model, TrainConfig(model=REFINED, crop=8), {"step": 1}, path)
    again, config, _ = load_model(path)
    assert config.model == REFINED and torch.equal(again(counts()), model(counts()))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"front": "matched", "design": None}, "network refined: is for codes, and there are none"),
        ({"design": Design("learned", (8, 4, 4), 8)}, "network refined: blocks of 8 bins, expected a multiple of 16"),
    ],
)
def test_what_it_does_not_fit_is_refused(config, message):
    with pytest.raises(InputError, match=message):
        replace(REFINED, **config)
