"""Muon beside PyTorch's own and closed forms; Adam's part beside Adam; which weights are whose; runs that go on."""

import numpy as np
import pytest
import torch
from test_training import MODEL, near_planes
from torch import nn

from csph.codes.design import Design
from csph.networks.checkpoint import load_model
from csph.networks.config import ModelConfig, TrainConfig, preset
from csph.networks.model import DepthModel
from csph.training.loop import train
from csph.training.optimiser import MOMENTUM, MuonAdam, hidden_weights, make_optimiser, orthogonalised
from csph.training.views import split_views
from scenes import InputError

CODED = ModelConfig(design=Design("learned", (256, 2, 2), 8))


def matrix(rows: int, columns: int, condition: float, seed: int = 0) -> torch.Tensor:
    """A random matrix with singular values from 1 down to 1 / condition, evenly in their logarithms."""
    generator = torch.Generator().manual_seed(seed)
    left, _, right = torch.linalg.svd(torch.randn(rows, columns, generator=generator), full_matrices=False)
    return left * torch.logspace(0, -np.log10(condition), min(rows, columns)) @ right


@pytest.mark.parametrize(("rows", "columns"), [(16, 48), (48, 16), (32, 32), (1, 16), (16, 1)])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_singular_values_of_a_step_are_alike(rows, columns, scale):
    """U S V^T becomes U S' V^T with S' from 0.68 to 1.21, the bounds of five quintic iterations from a hundredth up."""
    given = matrix(rows, columns, 10)
    found = orthogonalised(scale * given)
    left, _, right = torch.linalg.svd(given, full_matrices=False)
    diagonal = left.T @ found @ right.T
    values = diagonal.diagonal()
    assert values.min() > 0.68 and values.max() < 1.21
    assert (diagonal - values.diag()).abs().max() < 1e-4


def test_a_step_without_a_gradient_is_none():
    """A batch without light has zeros: no NaN. What is far below the rest of a matrix stays small."""
    assert not orthogonalised(torch.zeros(4, 6)).any()
    weak = orthogonalised(torch.diag(torch.tensor([1.0, 1e-6])))
    assert 0.68 < weak[0, 0] < 1.21 and 0 < weak[1, 1] < 1e-3


def test_muon_takes_the_steps_of_pytorchs():
    """On matrices, which are all that PyTorch's takes. It computes in bf16, of 8 bits: within 2 % of a step."""
    rng = torch.Generator().manual_seed(1)
    ours, theirs = (nn.Parameter(torch.zeros(24, 10)) for _ in range(2))
    mine = MuonAdam([{"params": [ours], "lr": 0.1, "muon": True}], 1.0)
    pytorch = torch.optim.Muon([theirs], lr=0.1, weight_decay=0.0, momentum=MOMENTUM)
    for _ in range(5):
        gradient = torch.randn(24, 10, generator=rng)
        for weight, optimiser in ((ours, mine), (theirs, pytorch)):
            before = weight.detach().clone()
            weight.grad = gradient.clone()
            optimiser.step()
            change = weight.detach() - before
            if optimiser is mine:
                step = change
        assert torch.linalg.vector_norm(change - step) < 0.02 * torch.linalg.vector_norm(step)


def test_convolutions_lie_in_memory_as_they_like():
    """A kernel with channels last takes the step of one in the usual order, and stays where it is."""
    gradient = torch.randn(8, 4, 3, 3, generator=torch.Generator().manual_seed(2))
    found = []
    for order in (torch.contiguous_format, torch.channels_last):
        weight = nn.Parameter(torch.zeros(8, 4, 3, 3).to(memory_format=order))
        weight.grad = gradient.to(memory_format=order)
        MuonAdam([{"params": [weight], "lr": 0.1, "muon": True}], 1.0).step()
        assert weight.is_contiguous(memory_format=order) and weight.grad is None
        found.append(weight.detach())
    assert torch.allclose(*found, atol=1e-6)


def test_the_rest_is_adam():
    """With no group of Muon's, the same bytes as PyTorch's Adam; closures are called once, with gradients on."""
    start = torch.randn(7, generator=torch.Generator().manual_seed(3))
    found = []
    for make in (lambda p: MuonAdam([{"params": [p]}], 0.01), lambda p: torch.optim.Adam([p], lr=0.01, fused=True)):
        weight, calls = nn.Parameter(start.clone()), []
        optimiser = make(weight)

        def loss(weight=weight, optimiser=optimiser, calls=calls):
            calls.append(torch.is_grad_enabled())
            optimiser.zero_grad()
            value = (weight**4).sum()
            value.backward()
            return value

        values = [optimiser.step(loss).item() for _ in range(5)]
        assert calls == [True] * 5 and values[-1] < values[0]
        found.append(weight.detach().numpy().tobytes())
    assert found[0] == found[1]


def test_scaled_losses_take_the_same_step_and_infinite_ones_none():
    """As with 16-mixed on a GPU: gradients come divided by the scale, and a step that is no number is skipped."""
    found = []
    for scale in (1.0, 2.0**10):
        weights = [nn.Parameter(torch.ones(3, 3)), nn.Parameter(torch.ones(3))]
        optimiser = MuonAdam([{"params": weights[:1], "muon": True}, {"params": weights[1:]}], 0.01)
        scaler = torch.amp.GradScaler("cpu", init_scale=scale)
        for factor in (1.0, float("inf")):
            before = [weight.detach().clone() for weight in weights]
            optimiser.zero_grad()
            scaler.scale(factor * sum((weight**2).sum() for weight in weights)).backward()
            scaler.step(optimiser)
            changed = [not torch.equal(old, weight) for old, weight in zip(before, weights, strict=True)]
            assert changed == [factor == 1.0] * 2
            scaler.update()
        found.append(torch.cat([weight.detach().flatten() for weight in weights]))
    assert torch.allclose(*found, atol=1e-7)


@pytest.mark.parametrize("network", ["compact", "blockwise", "refined"])
def test_hidden_layers_are_muons_and_read_outs_and_codes_adams(network):
    config = preset("laptop", ModelConfig(design=CODED.design, network=network))
    model = DepthModel(config.model)
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    groups = make_optimiser(model, config).param_groups
    by_muon = {names[id(one)] for group in groups if group["muon"] for one in group["params"]}
    by_adam = {names[id(one)] for group in groups if not group["muon"] for one in group["params"]}
    assert by_muon | by_adam == set(names.values()) and not by_muon & by_adam
    assert {"network.stem.weight", "network.quarter_resolution.1.whole.weight"} <= by_muon
    assert {"layer.temporal", "layer.spatial", "network.fine.weight", "network.stem.bias"} <= by_adam
    assert ("network.early.inner.weight" in by_muon) == (network != "compact")
    assert ("network.correction.weight" in by_adam) == (network == "refined")
    assert all(names[id(one)].endswith("weight") for one in hidden_weights(model.network))
    rates = {group["muon"]: group["lr"] for group in groups}
    assert rates[True] == pytest.approx(3 * rates[False]) and rates[False] == config.rate


def test_recipes_of_before_keep_adam():
    """The first models' and the published recipe, the published network, and files that do not say."""
    published = ModelConfig(design=CODED.design, network="published")
    assert preset("laptop", CODED).optimiser == "muon"
    assert {preset(name, CODED).optimiser for name in ("laptop-v1", "paper")} == {"adam"}
    assert preset("laptop", published).optimiser == "adam"
    values = preset("laptop", CODED, optimiser="adam").to_dict()
    del values["optimiser"]
    assert TrainConfig.from_dict(values) == preset("laptop", CODED, optimiser="adam")
    with pytest.raises(InputError, match=r"muon is for compact, blockwise, refined, periodic, not network published"):
        preset("laptop", published, optimiser="muon")
    with pytest.raises(InputError, match=r"optimiser 'sgd' is unknown, expected one of adam, muon"):
        preset("laptop", CODED, optimiser="sgd")


@pytest.mark.parametrize("optimiser", ["adam", "muon"])
def test_a_run_learns_and_says_by_which_optimiser(tmp_path, optimiser):
    config = preset("smoke", MODEL, optimiser=optimiser, epochs=3, steps_per_epoch=40, threads=1)
    train(config, *split_views(near_planes(40)), tmp_path)
    rows = (tmp_path / "log.csv").read_text().splitlines()
    column = rows[0].split(",").index("train_loss")
    losses = [float(row.split(",")[column]) for row in rows[1:]]
    assert len(losses) == 3 and losses[2] < losses[1] < losses[0]
    assert load_model(tmp_path)[1].optimiser == optimiser
