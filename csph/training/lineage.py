"""Tell what a model was trained on before it was trained: by its configuration, and by what lies in its run's folder.

A run that begins with a model keeps `data["ancestors"]`, nearest first: `name`, `sha256` of the weights, and
`training_sha256` of the training sets, where they are known. The keys of the ancestors' views lie in the run's folder,
and so do hashes that tell their scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from csph.networks.checkpoint import load_model, weights_sha256
from csph.networks.config import TrainConfig
from csph.networks.model import DepthModel
from csph.training.beginning import Beginning, NetworkOf, WeightsOf, what_is_known
from csph.training.overlap import ANCESTORS_SCENES, SEEN_SCENES, of_seen_scenes, scene_hashes
from csph.training.views import ANCESTORS_SEEN, SEEN, Views, is_seen, read_seen, view_key, write_keys
from csph.weights.shipped import WEIGHTS, checkpoint_name, shipped_file
from scenes.errors import InputError
from scenes.json_types import JsonObject


def begin_with(checkpoint: Path, *, network_alone: bool = False) -> WeightsOf | NetworkOf:
    """Return a checkpoint's model as a training begins with it, with the sets and views that it and those before it
    were trained on."""
    model, config, _ = load_model(checkpoint)
    ancestors = (_entry(checkpoint_name(checkpoint), model, config), *ancestors_of(config))
    seen, scenes = (
        frozenset().union(*(read_seen(checkpoint, name) or () for name in names))
        for names in ((SEEN, ANCESTORS_SEEN), (SEEN_SCENES, ANCESTORS_SCENES))
    )
    return (NetworkOf if network_alone else WeightsOf)(model, ancestors, seen, scenes)


def write_seen(folder: Path, sets: Iterable[Views], init: Beginning | None = None) -> None:
    """Keep in a run's folder the keys of all training views and hashes that tell their scenes; beside them, if any,
    those of the models that the run began with."""
    sets = [*sets]
    known = None if init is None else what_is_known(init)
    write_keys(folder, SEEN, {view_key(view) for views in sets for view in views.transients})
    write_keys(folder, SEEN_SCENES, scene_hashes(sets))
    for name, keys in () if known is None else ((ANCESTORS_SEEN, known.seen), (ANCESTORS_SCENES, known.scenes)):
        if keys:
            write_keys(folder, name, keys)


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
    known; numbers of other views, whose scenes it or its ancestors were trained on."""

    own: int
    inherited: int
    unknown: tuple[str, ...]
    own_scenes: int = 0
    inherited_scenes: int = 0


def count_seen(
    checkpoint: Path, config: TrainConfig, views: Views, parts: Callable[[], Mapping[str, int]]
) -> SeenViews:
    """Count the views that a model or its ancestors were trained on: by their keys where a run's folder holds them,
    else by the hashes of whole sets and of parts of them (`parts` returns `training_parts`, which takes time).

    Other views of the scenes that these show are counted where the folder holds hashes of the scenes.
    """
    own, kept = (read_seen(checkpoint, name) for name in (SEEN, ANCESTORS_SEEN))
    ancestors, there = ancestors_of(config), len(views.transients)
    number = _as_a_whole(config.data, parts) if own is None else sum(is_seen(one, own) for one in views.transients)
    inherited = [_as_a_whole(one, parts) for one in ancestors]
    inherited.append(sum(is_seen(one, kept or frozenset()) for one in views.transients))
    unknown = [str(one.get("name") or "unnamed weights") for one in ancestors if "training_sha256" not in one]
    # a part of a set may be evaluated on, whose hash is that of the whole
    return SeenViews(
        min(number, there),
        min(max(inherited), there),
        tuple(unknown),
        _others_of_scenes(views, read_seen(checkpoint, SEEN_SCENES), own),
        _others_of_scenes(views, read_seen(checkpoint, ANCESTORS_SCENES), kept),
    )


def _others_of_scenes(views: Views, scenes: frozenset[str] | None, seen: frozenset[str] | None) -> int:
    """Count the views of scenes that are trained on, but for the views that themselves are."""
    if not scenes:
        return 0
    pairs = zip(views.transients, of_seen_scenes(views, scenes), strict=True)
    return sum(of_scene and not is_seen(view, seen or frozenset()) for view, of_scene in pairs)


def _as_a_whole(data: JsonObject, parts: Callable[[], Mapping[str, int]]) -> int:
    """Return how many views of a set a run was trained on by the hashes of its sets: 0 unless they are the whole set,
    or the part of it that `training_parts` knows."""
    hashes = data.get("training_sha256", [])
    hashes = [hashes] if isinstance(hashes, str) else hashes
    known = parts() if hashes else {}
    return max((known.get(one, 0) for one in hashes), default=0)
