"""Choose the network that a configuration names, or take a user's own."""

from __future__ import annotations

from typing import cast

from torch import nn

from csph.networks.blockwise import Blockwise
from csph.networks.compact import Compact
from csph.networks.config import ModelConfig
from csph.networks.periodic import Periodic
from csph.networks.published import DeepBoosting
from csph.networks.refined import Refined
from scenes.errors import require, require_kind


def network_of(config: ModelConfig) -> Compact | DeepBoosting:
    """Return the network that a configuration names, with random weights."""
    if config.sees_codes:
        kind = Refined if config.network == "refined" else Blockwise
        design, keep_mean = config.codes_design, config.layer.get("keep_mean", False)
        return kind(design.block, design.codes, keep_mean=keep_mean)
    if config.network in ("compact", "periodic"):
        return Compact() if config.network == "compact" else Periodic()
    return DeepBoosting(final_relu=config.network == "published")


def own_network(network: nn.Module) -> Compact:
    """Return a user's network, which has what ours have. Raises InputError where it has not."""
    require_kind(network, nn.Module, "DepthModel: network")
    for name, least in (("reach", 0), ("coarsest", 1)):
        value = getattr(network, name, None)
        expected = f"expected a whole number of pixels, {least} or more"
        good = isinstance(value, int) and value >= least
        require(good, f"DepthModel: network {type(network).__name__}: {name} {value!r}, {expected}")
    return cast(Compact, network)
