"""Views of a rendered set, from its folder or its pack, and their split by scenes. Needs no renderer."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Sequence, Set
from pathlib import Path
from typing import NamedTuple

import numpy as np

from render.transient import Transient, read_transient
from render.transient.packs import depth_steps, read_pack
from scenes.errors import InputError, require, tuple_of
from scenes.files import whole_file
from scenes.io.set_index import read_set_index
from scenes.json_types import JsonObject
from spad.detection.training_patches import PackedViews, pack_views
from spad.sensor.model import Sensor

SEEN, KEY_DIGITS = "training-views.txt", 12  # of a run: the keys of the views that it was trained on
ANCESTORS_SEEN = "ancestor-views.txt"  # of a run: those that the models it began with were trained on
SEED_NOTE = re.compile(r"procedural, \w+ view \d+ of seed (\d+)")  # of a scene of an endless set
VALIDATION_FRACTION = 0.1  # of a set's scenes, its last, where no validation set is given


class _Views(NamedTuple):
    transients: tuple[Transient, ...]
    scenes: tuple[str, ...]


class Views(_Views):
    """Views of a rendered set and the names of the scenes that they show, one for each view.

    Raises InputError for no view, other objects than transients and text, and another number of names than views.

    Examples
    --------
    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> image = np.ones((8, 8))
    >>> near, far = (s2s.transient_from_rgbd(depth_m * image, image, 0 * image) for depth_m in (2.0, 5.0))
    >>> views = s2s.Views((near, far), ("near wall", "far wall"))
    >>> [float(view.depth_m.max()) for view in views.transients]  # [m]
    [2.0, 5.0]
    """

    __slots__ = ()

    def __new__(cls, transients: Sequence[Transient], scenes: Sequence[str]) -> Views:
        views = super().__new__(
            cls, tuple_of(transients, Transient, "Views: transients"), tuple_of(scenes, str, "Views: scenes")
        )
        require(len(views.transients) > 0, "Views: a set has no view")
        check_names(views, "Views")
        return views


def read_views(path: Path) -> Views:
    """Return all views of a pack (.h5), or of the folder that `scene2spad dataset` filled.

    Raises InputError in one line for anything else, an empty set, and a laser that is not at the camera.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> from render.transient.packs import write_pack
    >>> image = np.ones((8, 8))
    >>> wall = s2s.transient_from_rgbd(2.0 * image, image, 0 * image)  # at 2 m
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     count = write_pack([(wall, {"scene": "wall"})], folder + "/walls.h5")
    ...     s2s.read_views(folder + "/walls.h5").scenes
    ('wall',)
    """
    path = path_of(path, "read_views")
    if path.is_dir():
        transients, scenes = _from_folder(path)
    else:
        packed = read_pack(path)
        transients, scenes = list(packed), [_scene(meta, i) for i, meta in enumerate(packed.metas)]
    require(bool(transients), f"{path}: the set is empty")
    scenes = scenes_by_seed(scenes, transients)
    for transient, scene in zip(transients, scenes, strict=True):
        displaced = any(transient.meta.get("laser", {}).get("baseline_m", (0, 0, 0)))
        require(not displaced, f"{path}: the laser of {scene} is not at the camera, its path is not twice the depth")
    return Views(tuple(transients), tuple(scenes))


def path_of(given: object, where: str) -> Path:
    """Return a path that is given as a path or as text; InputError for anything else, `where` comes first."""
    if not isinstance(given, str | os.PathLike):
        raise InputError(f"{where}: expected a path, not {type(given).__name__}")
    return Path(given)


def check_names(views: Views, where: str) -> None:
    """Raise InputError for views that have another number of names than transients; `where` comes first."""
    number, names = len(views.transients), len(views.scenes)
    require(number == names, f"{where}: Views of {number} transients and {names} names of scenes, expected as many")


def _from_folder(path: Path) -> tuple[list[Transient], list[str]]:
    records = read_set_index(path)
    transients = [read_transient(path / record["file"]) for record in records]
    return transients, [_scene(record, i) for i, record in enumerate(records)]


def _scene(meta: JsonObject, number: int) -> str:
    """Return the scene that a view shows: views of one place are not independent, whatever their numbers."""
    return str(meta.get("place", meta.get("scene", number)))


def set_seed(meta: JsonObject) -> int | None:
    """Return the seed of the endless set that a view's scene is of, by the scene's notes; None where they name none."""
    notes = meta.get("notes")
    found = [SEED_NOTE.match(note) for note in notes if isinstance(note, str)] if isinstance(notes, list) else []
    return next((int(one[1]) for one in found if one is not None), None)


def name_with_seed(scene: str, view: Transient) -> str:
    """Return a scene's name with the seed of its set: the same number under another seed is another scene."""
    seed = set_seed(view.meta)
    suffix = f" of seed {seed}"
    return scene if seed is None or scene.endswith(suffix) else f"{scene}{suffix}"


def scenes_by_seed(scenes: Sequence[str], transients: Sequence[Transient]) -> list[str]:
    """Return the scenes' names, with the seeds of their sets where there are several."""
    several = len({set_seed(view.meta) for view in transients}) > 1
    return [name_with_seed(*pair) for pair in zip(scenes, transients, strict=True)] if several else list(scenes)


def split_views(views: Views, fraction: float = VALIDATION_FRACTION) -> tuple[Views, Views]:
    """Return training and validation views of different scenes: the last scenes are validation's. InputError for one
    scene."""
    check_names(views, "split_views")
    names = list(dict.fromkeys(views.scenes))
    require(len(names) >= 2, f"a set of one scene ({names[0]}) has none left to validate on; give a validation set")
    held = set(names[-max(1, round(fraction * len(names))) :])
    parts = []
    for wanted in (False, True):
        kept = [i for i, name in enumerate(views.scenes) if (name in held) == wanted]
        parts.append(Views(tuple(views.transients[i] for i in kept), tuple(views.scenes[i] for i in kept)))
    return parts[0], parts[1]


def check_direct(sets: Iterable[Views]) -> None:
    """Raise InputError for light of more than one surface: the published grid has one return a pixel, at the mean of
    its depths."""
    for views in sets:
        for transient, scene in zip(views.transients, views.scenes, strict=True):
            direct = not (transient.bounces > 1).any()
            message = f"the published grid has one return a pixel, and {scene} has indirect light"
            require(direct, f"{message}: render the set with --bounces 1")


def check_light(sets: Sequence[Sequence[Views]], packs: Sequence[Sequence[PackedViews]], sensor: Sensor) -> None:
    """Raise InputError for a view from which no light returns, whose photons cannot be had, and for a set without a
    depth within the sensor's range; training sets, then validation sets, as they are and packed."""
    for name, some, packed_sets in zip(("training", "validation"), sets, packs, strict=True):
        for views, packed in zip(some, packed_sets, strict=True):
            for scene, mean in zip(views.scenes, packed.mean_radiance, strict=True):
                require(mean > 0, f"{name} set: no light returns from a view of {scene}, its photons cannot be had")
            known = bool((packed.depth_m < sensor.recorded_range_m).any())
            within = f"no pixel has a depth within the sensor's {sensor.recorded_range_m:.4g} m"
            shows = f"{views.scenes[0]} and {len(views.scenes) - 1} views more"
            require(known, f"{name} set ({shows}): {within}")


def check_truth(path: Path, views: Views, sensor: Sensor, offset_m: float = 0.0) -> None:
    """Raise InputError for views without a depth to compare with: within the sensor's range, moved away by an offset
    [m]."""
    known = any(bool((one.depth_m + offset_m < sensor.recorded_range_m).any()) for one in views.transients)
    moved = f" at an offset of {offset_m:g} m" if offset_m else ""
    require(known, f"{path}: no pixel has a depth within the sensor's {sensor.recorded_range_m:.4g} m{moved}")


def packed_sha256(packed: PackedViews) -> str:
    """Return SHA-256 over what is sensed: a run that goes on must go on with the same set."""
    sha = hashlib.sha256(str(packed.depth_m.shape).encode())
    for name in ("offsets", "path_near_m", "path_far_m", "radiance", "depth_m", "ambient", "mixed"):
        sha.update(np.ascontiguousarray(getattr(packed, name)).tobytes())
    return sha.hexdigest()


def training_parts(views: Views) -> dict[str, int]:
    """Return the number of views that a run trains on, by the `packed_sha256` that it keeps of them: all of a set, or
    those of its first scenes, where the run splits it by `split_views`. None trains on views of several sizes."""
    several = len(set(views.scenes)) >= 2
    parts = [views, split_views(views)[0]] if several else [views]
    parts = [part for part in parts if len({one.depth_m.shape for one in part.transients}) == 1]
    return {packed_sha256(pack_views(part.transients)): len(part.transients) for part in parts}


def view_key(view: Transient) -> str:
    """Return a short hash of what a view shows: its true depth as a pack holds it.

    The same for a view in a folder, which has finer steps, and in the pack that is made of it; with indirect light and
    without. Which pixels are mixed does not count: two renders of a view may differ in it.
    """
    return short_hash(_shown(view))


def _shown(view: Transient) -> bytes:
    return f"{view.height}x{view.width}".encode() + depth_steps(view.depth_m).astype("<f8").tobytes()


def short_hash(content: bytes) -> str:
    """Return the first KEY_DIGITS digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:KEY_DIGITS]


def is_seen(view: Transient, keys: Set[str]) -> bool:
    """Tell whether one of the keys is that of a view. Keys written by older versions hash its mixed pixels, too."""
    shown = _shown(view)
    before = shown + view.mixed.astype(np.uint8).tobytes()
    return not keys.isdisjoint((short_hash(shown), short_hash(before)))


def write_keys(folder: Path, name: str, keys: Iterable[str]) -> None:
    """Keep keys of views or scenes in a run's folder, sorted, one a line."""
    with whole_file(folder / name) as beside:
        beside.write_text("".join(f"{key}\n" for key in sorted(keys)))


def read_seen(checkpoint: Path, name: str = SEEN) -> frozenset[str] | None:
    """Return the keys of the views that a run, given by its folder or a checkpoint in it, was trained on.

    Other names ask for the views of its ancestors (ANCESTORS_SEEN), and for scenes (`csph.training.overlap`). None
    where the folder holds no such file, as those written by older versions.
    """
    path = (checkpoint if checkpoint.is_dir() else checkpoint.parent) / name
    return frozenset(path.read_text(errors="replace").split()) if path.is_file() else None
