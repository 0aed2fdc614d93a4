"""Check what a training begins with: a trained model, or the network of one."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from csph.codes.nested import holds
from csph.networks.model import DepthModel
from csph.training.config import TrainConfig, grows
from scenes.errors import require


class NetworkOf(NamedTuple):
    """A trained model whose network alone a training begins with."""

    model: DepthModel


def check_init(init: DepthModel | NetworkOf | None, config: TrainConfig) -> None:
    """Raise InputError unless a trained model fits the one to be trained, but for converters of its sensor; and for a
    share of the weights of none."""
    network_alone = isinstance(init, NetworkOf)
    shared = config.init_share > 0 and (init is None or network_alone)
    require(not shared, f"training: init_share {config.init_share:g} needs a model to begin with")
    if init is None:
        return
    mine, other = config.model, (init.model if isinstance(init, NetworkOf) else init).config
    names = ("network", "sensor") if network_alone else ("front", "network", "design", "sensor")
    bare = [replace(one, sensor=replace(one.sensor, name="", tdc=None)) for one in (mine, other)]
    differ = [name for name in names if name != "network" and getattr(bare[0], name) != getattr(bare[1], name)]
    within = differ == ["design"] and mine.design is not None and other.design is not None
    held = within and mine.layer == other.layer and holds(mine.codes_design, other.codes_design)
    alike = (not differ or held) and grows(other.network, mine.network)
    switches = [", ".join(sorted(name for name, on in one.layer.items() if on)) or "none" for one in (mine, other)]
    named = "" if switches[0] == switches[1] else f": --layer {switches[1]} and {switches[0]}"
    message = f"{other.name} on {other.sensor.name} cannot begin one of {mine.name} on {mine.sensor.name}{named}"
    require(alike, f"init: a model of {message}")
    less = not network_alone and other.layer.get("int8", False) and not mine.layer.get("int8", False)
    require(not less, f"init: a model of {other.name} in 8 bits cannot begin one without --layer int8")
