"""Check what a training begins with: a trained model, or the network of one."""

from __future__ import annotations

import logging
from collections.abc import Set
from dataclasses import asdict, replace
from typing import NamedTuple

from csph.codes.nested import holds
from csph.layer_options import LayerOptions
from csph.networks.config import ModelConfig, TrainConfig, grows
from csph.networks.model import DepthModel
from scenes.errors import require, require_kind
from scenes.json_types import JsonObject

log = logging.getLogger("csph")


class WeightsOf(NamedTuple):
    """A trained model that a training begins with, and what it was trained on in its turn.

    ancestors   the model and those before it, nearest first: SHA-256 of each one's weights and, where they are known,
                of its training sets (`csph.training.lineage`)
    seen        keys of the views that all of them were trained on (`csph.training.views.view_key`)
    scenes      hashes that tell the scenes of these views (`csph.training.overlap.scene_hashes`)
    """

    model: DepthModel
    ancestors: tuple[JsonObject, ...] = ()
    seen: Set[str] = frozenset()
    scenes: Set[str] = frozenset()


class NetworkOf(NamedTuple):
    """A trained model whose network alone a training begins with; the rest as in `WeightsOf`."""

    model: DepthModel
    ancestors: tuple[JsonObject, ...] = ()
    seen: Set[str] = frozenset()
    scenes: Set[str] = frozenset()


Beginning = DepthModel | WeightsOf | NetworkOf


def what_is_known(init: Beginning) -> WeightsOf | NetworkOf:
    """Return the model that a training begins with, and what it was trained on: nothing is known of a bare model.
    Raises InputError for anything else."""
    known = init if isinstance(init, WeightsOf | NetworkOf) else WeightsOf(init)
    require_kind(known.model, DepthModel, "train: init", " of `load_model`")
    return known


def check_init(init: Beginning | None, config: TrainConfig) -> None:
    """Raise InputError unless a trained model fits the one to be trained, but for converters of its sensor; and for a
    share of the weights of none. Warn where only switches of the layer differ: the network then meets other inputs."""
    network_alone = isinstance(init, NetworkOf)
    shared = config.init_share > 0 and (init is None or network_alone)
    require(not shared, f"training: init_share {config.init_share:g} needs a model to begin with")
    if init is None:
        return
    mine, other = config.model, what_is_known(init).model.config
    names = ("network", "sensor") if network_alone else ("front", "network", "design", "sensor")
    bare = [replace(one, sensor=replace(one.sensor, name="", tdc=None)) for one in (mine, other)]
    differ = [name for name in names if name != "network" and getattr(bare[0], name) != getattr(bare[1], name)]
    within = differ == ["design"] and mine.design is not None and other.design is not None
    held = within and mine.layer == other.layer and holds(mine.codes_design, other.codes_design)
    alike = (not differ or held) and grows(other.network, mine.network)
    switches = [_switches(one) for one in (mine, other)]
    named = "" if switches[0] == switches[1] else f": --layer {switches[1]} and {switches[0]}"
    message = f"{other.name} on {other.sensor.name} cannot begin one of {mine.name} on {mine.sensor.name}{named}"
    cure = f"; with --network {other.network} it can" if not differ or held else ""  # the network alone hinders
    require(alike, f"init: a model of {message}{cure}")
    less = not network_alone and other.layer.get("int8", False) and not mine.layer.get("int8", False)
    require(not less, f"init: a model of {other.name} in 8 bits cannot begin one without --layer int8")
    theirs = _options(other)
    changed = {name for name, on in _options(mine).items() if on != theirs.get(name, False)}
    # int8 alone is what --init is for: the same codes, rounded
    if not network_alone and mine.design is not None and changed - {"int8"}:
        message = "init: a model of %s with --layer %s begins one with --layer %s; its network meets other inputs"
        log.warning(message, other.name, switches[1], switches[0])


def _options(model: ModelConfig) -> dict[str, bool]:
    """Return all switches of the layer, those at their defaults among them."""
    return {**asdict(LayerOptions()), **model.layer}


def _switches(model: ModelConfig) -> str:
    """Name the switches that differ from the published layer, as `--layer` takes them; zero_mean has no option."""
    published = asdict(LayerOptions())
    changed = [
        name if on else f"no {name}" for name, on in sorted(_options(model).items()) if on != published.get(name)
    ]
    return ", ".join(changed) or "none"
