"""Views and scenes that are trained on and validated on, too: errors there say nothing of other scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

from csph.training.views import Views, name_with_seed, set_seed, short_hash, view_key
from render.transient import Transient

SEEN_SCENES = "training-scenes.txt"  # of a run: short hashes of what tells the scenes that it was trained on
ANCESTORS_SCENES = "ancestor-scenes.txt"  # of a run: those that the models it began with were trained on


class Overlap(NamedTuple):
    """Numbers of validation views: all, those that are trained on, and those of scenes that are trained on."""

    views: int
    same_views: int
    same_scenes: int


def overlap(training: Sequence[Views], validation: Sequence[Views]) -> Overlap:
    """Count the validation views that are among the training views, and those whose scenes are.

    Sets of different seeds have scenes of the same names, so that a name alone tells nothing. Packs written by older
    versions name no seed. Two scenes are the same if name and seed are known and equal, if their hashes of surfaces and
    camera are, or if a view of one has the depth map of a view of the other.
    """
    trained_views = {view_key(view) for views in training for view in views.transients}
    trained_scenes = {key for views in training for keys in _keys_by_scene(views).values() for key in keys}
    number = same_views = same_scenes = 0
    for views in validation:
        shared = {scene for scene, keys in _keys_by_scene(views).items() if keys & trained_scenes}
        number += len(views.scenes)
        same_views += sum(view_key(view) in trained_views for view in views.transients)
        same_scenes += sum(scene in shared for scene in views.scenes)
    return Overlap(number, same_views, same_scenes)


def repeated(sets: Sequence[Views]) -> tuple[int, int] | None:
    """Return the numbers of the first two sets of the same views; None where there are none.

    A view in a folder and in a pack is the same. Under other light it is another: with indirect or ambient light.
    """
    shown = [{_lit_key(view) for view in views.transients} for views in sets]
    return next(((i, j) for i, j in combinations(range(len(shown)), 2) if shown[i] == shown[j]), None)


def _lit_key(view: Transient) -> tuple[str, int, bool]:
    """Return what a view shows and what tells its light apart, none of which a pack rounds."""
    return view_key(view), view.returns, bool(view.ambient.any())


def _keys_by_scene(views: Views) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for view, scene in zip(views.transients, views.scenes, strict=True):
        found.setdefault(scene, set()).update(_scene_keys(view, scene))
    return found


def _scene_keys(view: Transient, scene: str) -> set[str]:
    """Return what tells the scene of a view: what it shows, its surfaces and camera, its name with the set's seed."""
    keys = {view_key(view)}
    digest = view.meta.get("scene_sha256")
    if isinstance(digest, str):
        keys.add(digest)
    if set_seed(view.meta) is not None:
        keys.add(name_with_seed(scene, view))
    return keys


def scene_hashes(sets: Iterable[Views]) -> frozenset[str]:
    """Return short hashes of what tells the scenes of all views, as a run's folder keeps them."""
    return frozenset(one for views in sets for found in _hashes_by_scene(views).values() for one in found)


def of_seen_scenes(views: Views, seen: frozenset[str]) -> list[bool]:
    """Return for each view whether one of these hashes tells its scene: also at another size or with another camera."""
    shared = {scene for scene, found in _hashes_by_scene(views).items() if found & seen}
    return [scene in shared for scene in views.scenes]


def _hashes_by_scene(views: Views) -> dict[str, set[str]]:
    return {scene: {short_hash(key.encode()) for key in keys} for scene, keys in _keys_by_scene(views).items()}
