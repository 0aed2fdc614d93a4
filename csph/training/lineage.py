"""Tell what a model was trained on before it was trained: by its configuration, and by what lies in its run's folder.

A run that begins with a model keeps `data["ancestors"]`, nearest first: `name`, `sha256` of the weights, and
`training_sha256` of the training sets, where they are known. The keys of the ancestors' views lie in the run's folder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from csph.networks.config import TrainConfig
from csph.networks.model import DepthModel, load_model, weights_sha256
from csph.training.beginning import NetworkOf, WeightsOf
from csph.training.views import ANCESTORS_SEEN, SEEN, Views, is_seen, read_seen
from csph.weights.shipped import WEIGHTS, checkpoint_name, shipped_file
from scenes.errors import InputError
from scenes.json_types import JsonObject


def begin_with(checkpoint: Path, *, network_alone: bool = False) -> WeightsOf | NetworkOf:
    """Return a checkpoint's model as a training begins with it, with the sets and views that it and those before it
    were trained on."""
    model, config, _ = load_model(checkpoint)
    ancestors = (_entry(checkpoint_name(checkpoint), model, config), *ancestors_of(config))
    seen = (read_seen(checkpoint, name) or frozenset() for name in (SEEN, ANCESTORS_SEEN))
    return (NetworkOf if network_alone else WeightsOf)(model, ancestors, frozenset().union(*seen))


def _entry(name: str, model: DepthModel, config: TrainConfig) -> JsonObject:
    known = {key: config.data[key] for key in ("training_sha256",) if key in config.data}
    return {"name": name, "sha256": weights_sha256(model), **known}


def ancestors_of(config: TrainConfig, folder: Path = WEIGHTS) -> tuple[JsonObject, ...]:
    """Return the models that a trained one goes back to, nearest first; of random weights none.

    Runs written by older versions keep only the name of the model that they began with, and the hash of its weights. If
    both are those of a shipped model, its own configuration tells its ancestors. Of other models no more is known.
    """
    data = config.data
    if isinstance(data.get("ancestors"), list):
        return tuple(one for one in data["ancestors"] if isinstance(one, dict))
    if "init_sha256" not in data:
        return ()
    name = str(data.get("init", data.get("init_network", "")))
    unknown: JsonObject = {"name": name, "sha256": data["init_sha256"]}
    path = shipped_file(name, folder)
    if not name or not path.is_file():
        return (unknown,)
    try:
        model, parent, _ = load_model(path)
    except InputError:
        return (unknown,)
    entry = _entry(name, model, parent)
    # shipped models are replaced by better ones of the same name
    return (entry, *ancestors_of(parent, folder)) if entry["sha256"] == data["init_sha256"] else (unknown,)


class SeenViews(NamedTuple):
    """Numbers of views that a model was trained on itself, and that its ancestors were; ancestors of which nothing is
    known."""

    own: int
    inherited: int
    unknown: tuple[str, ...]


def count_seen(
    checkpoint: Path, config: TrainConfig, views: Views, parts: Callable[[], Mapping[str, int]]
) -> SeenViews:
    """Count the views that a model or its ancestors were trained on: by their keys where a run's folder holds them,
    else by the hashes of whole sets and of parts of them (`parts` returns `training_parts`, which takes time)."""
    own, kept = (read_seen(checkpoint, name) for name in (SEEN, ANCESTORS_SEEN))
    ancestors, there = ancestors_of(config), len(views.transients)
    number = _as_a_whole(config.data, parts) if own is None else sum(is_seen(one, own) for one in views.transients)
    inherited = [_as_a_whole(one, parts) for one in ancestors]
    inherited.append(sum(is_seen(one, kept or frozenset()) for one in views.transients))
    unknown = [str(one.get("name") or "unnamed weights") for one in ancestors if "training_sha256" not in one]
    # a part of a set may be evaluated on, whose hash is that of the whole
    return SeenViews(min(number, there), min(max(inherited), there), tuple(unknown))


def _as_a_whole(data: JsonObject, parts: Callable[[], Mapping[str, int]]) -> int:
    """Return how many views of a set a run was trained on by the hashes of its sets: 0 unless they are the whole set,
    or the part of it that `training_parts` knows."""
    hashes = data.get("training_sha256", [])
    hashes = [hashes] if isinstance(hashes, str) else hashes
    known = parts() if hashes else {}
    return max((known.get(one, 0) for one in hashes), default=0)
