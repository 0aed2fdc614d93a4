"""Muon for the weights of a network's hidden layers, Adam for everything else, in one optimiser.

Adam scales each weight's step alone. Muon (Jordan et al. 2024, https://kellerjordan.github.io/posts/muon) takes the
weights of a layer as a matrix from inputs to outputs and makes all singular values of its step alike, so that rare
directions are learned as fast as common ones. From random weights, learned 256x4x4 codes with the compact network have
after 500 steps the validation error that Adam reaches after 1,500 (docs/training-notebook.md).

    M <- 0.95 M + 0.05 G                    G: the gradient, a matrix (outputs, inputs x taps)
    W <- W - rate sqrt(max(1, outputs / inputs)) orthogonalised(0.95 M + 0.05 G)

PyTorch's own Muon takes matrices alone, and computes in bf16; tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from csph.networks.config import TrainConfig
from csph.networks.model import DepthModel

RANGE_RATE = 0.02  # of the logarithms of int8 clipping ranges: a bit more headroom in some 40 steps
MOMENTUM = 0.95
MUON_RATE = 3.0  # of Muon's learning rate in units of Adam's
ITERATIONS = 5
QUINTIC = (3.4445, -4.7750, 2.0315)  # Jordan's: singular values from 0.01 up come to 0.7 to 1.2 in five iterations
SMALLEST = 1e-30  # length of a step below which there is none


def make_optimiser(model: DepthModel, config: TrainConfig) -> MuonAdam:
    """Return the optimiser of a configuration, before its schedule: all by Adam, or hidden layers by Muon."""
    hidden = hidden_weights(model.network) if config.optimiser == "muon" else []
    ranges = [one for name, one in model.named_parameters() if name.endswith("_range")]
    apart = {id(one) for one in (*hidden, *ranges)}
    groups: list[dict[str, Any]] = [
        {"params": [one for one in model.parameters() if id(one) not in apart]},
        {"params": ranges, "lr": RANGE_RATE},
        {"params": hidden, "lr": MUON_RATE * config.rate, "muon": True},
    ]
    return MuonAdam([group for group in groups if group["params"]], config.rate)


def orthogonalised(matrix: Tensor) -> Tensor:
    """Return about U V^T of a matrix U S V^T, of any size: its singular values come to 0.7 to 1.2; 0 of zeros.

    Newton-Schulz iterations X <- a X + (b X X^T + c (X X^T)^2) X of the matrix divided by its Frobenius norm. Singular
    values below a hundredth of that norm stay smaller.
    """
    first, third, fifth = QUINTIC
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide / torch.linalg.vector_norm(wide).clamp(min=SMALLEST)
    for _ in range(ITERATIONS):
        square = x @ x.T
        x = first * x + (third * square + fifth * square @ square) @ x
    return x if wide is matrix else x.T


def hidden_weights(network: nn.Module) -> list[nn.Parameter]:
    """Return the weights of convolutions and linear layers, but for those that a network names as its `read_outs`."""
    kinds = (nn.Conv2d, nn.Conv3d, nn.Linear)
    left_out = getattr(network, "read_outs", ())
    hidden = [m for name, m in network.named_modules() if isinstance(m, kinds) and name not in left_out]
    return [weight for module in hidden if isinstance(weight := module.weight, nn.Parameter)]


class MuonAdam(torch.optim.Adam):
    """Adam, and Muon for the groups of parameters that say `muon`: True, whose first axis is the outputs'.

    A group's `lr` is its own. Same gradients, same bytes.
    """

    def __init__(self, groups: Iterable[dict[str, Any]], rate: float) -> None:
        super().__init__([{"muon": False, **group} for group in groups], lr=rate, fused=True)
        # A fused Adam divides by the scale of 16-bit losses itself, and skips steps that are no numbers: Muon needs
        # gradients of which both is done before.
        self._step_supports_amp_scaling = False

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Take one step; `closure` computes the gradients first, where there is one."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            if group["muon"]:
                for weight in group["params"]:
                    self._muon_step(weight, group["lr"])
        super().step()
        return loss

    def _muon_step(self, weight: Tensor, rate: float) -> None:
        """Change a weight by its gradient, and drop that: Adam passes by weights without one."""
        if weight.grad is None:
            return
        state = self.state[weight]
        if not state:  # `step` as in Adam's, which asks for it when states are loaded
            state.update(step=torch.zeros(()), momentum=torch.zeros_like(weight))
        state["step"] += 1
        state["momentum"].lerp_(weight.grad, 1 - MOMENTUM)
        ahead = weight.grad.lerp(state["momentum"], MOMENTUM).flatten(1)
        scale = max(1.0, ahead.shape[0] / ahead.shape[1]) ** 0.5
        weight.sub_(orthogonalised(ahead).view(weight.shape), alpha=rate * scale)
        weight.grad = None
