"""Scene sets by name: what a data set is rendered from. A set gives its view `index` by itself, in any order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scenes.errors import InputError, did_you_mean, require, require_whole
from scenes.io.inputs import file_sha256
from scenes.model import Scene

SETS: dict[str, str] = {
    "rooms/train": "procedural furnished rooms, each seen by six cameras, without end (short: rooms)",
    "rooms/val": "rooms that are not in rooms/train",
    "rooms/test": "rooms that are in neither",
    "clutter/train": "edge-rich procedural views, 0.3 to 13 m, without end (short: clutter)",
    "clutter/val": "views that are not in clutter/train",
    "clutter/test": "views that are in neither",
    "tabletop": "eight still lifes with fine structure, 1.3 to 2.9 m",
    "middlebury": "reliefs of the Middlebury 2006 scenes found in $SCENE2SPAD_DATA/middlebury",
    "hard-cases": "scenes that break renderers",
}
LARGEST = 1_000_000


@dataclass(frozen=True)
class SceneSet:
    """`size` views (None: as many as one likes); `make(index, seed, width, height)` builds one, None sizes its own.

    `place(index)` names what a view shows: views of one place, `views_per_place` in a row, are not independent, and are
    quickly made one after the other. `inputs(index)`: the files that a view is read from.
    """

    name: str
    size: int | None
    make: Callable[[int, int, int | None, int | None], Scene]
    place: Callable[[int], str]
    views_per_place: int = 1
    inputs: Callable[[int], Sequence[Path]] = lambda index: ()

    def view(self, index: int, *, seed: int = 0, width: int | None = None, height: int | None = None) -> Scene:
        index, seed = require_whole(index, f"set {self.name}: view"), require_whole(seed, f"set {self.name}: seed")
        most = LARGEST if self.size is None else self.size
        require(0 <= index < most, f"set {self.name}: view {index} is outside 0 to {most - 1}")
        require(seed >= 0, f"set {self.name}: seed {seed} is not a whole number of 0 or more")
        return self.make(index, seed, width, height)

    def inputs_sha256(self, index: int) -> dict[str, str]:
        """Return SHA-256 of each file that a view is read from, by the file's name. InputError where one is missing."""
        return {path.name: file_sha256(path) for path in self.inputs(index)}


def scene_set(name: str) -> SceneSet:
    """Return the set of that name, `rooms` and `clutter` for their training split.

    Raises InputError in one line for another name.
    """
    name = f"{name}/train" if name in ENDLESS else name
    if name not in SETS:
        raise InputError(f"scene set {name!r}: expected one of {', '.join(SETS)}{did_you_mean(name, SETS)}")
    family, _, split = name.partition("/")
    if family in ENDLESS:
        return ENDLESS[family](name, split)
    names, load, inputs = _named(name)

    def make(index: int, seed: int, width: int | None, height: int | None) -> Scene:
        scene = load(names[index])
        if (width, height) == (None, None):
            return scene
        return replace(scene, camera=scene.camera.resized(width, height))

    return SceneSet(
        name, len(names), make, lambda index: f"{name}/{names[index]}", inputs=lambda index: inputs(names[index])
    )


def _sides(width: int | None, height: int | None) -> dict[str, int]:
    """Return both sides of a view without an end: one alone makes a square."""
    side = next((side for side in (width, height) if side is not None), 64)
    return {"width": side if width is None else width, "height": side if height is None else height}


def _rooms(name: str, split: str) -> SceneSet:
    from scenes.library.rooms import VIEWS_PER_ROOM, room_name, room_view

    def make(index: int, seed: int, width: int | None, height: int | None) -> Scene:
        return room_view(index, split, seed=seed, **_sides(width, height))

    return SceneSet(name, None, make, lambda index: room_name(index, split), VIEWS_PER_ROOM)


def _clutter(name: str, split: str) -> SceneSet:
    from scenes.library.clutter_set import clutter_view

    def make(index: int, seed: int, width: int | None, height: int | None) -> Scene:
        return clutter_view(index, split, seed=seed, **_sides(width, height))

    return SceneSet(name, None, make, lambda index: f"{name}/{index}")


ENDLESS: dict[str, Callable[[str, str], SceneSet]] = {"rooms": _rooms, "clutter": _clutter}


def _named(name: str) -> tuple[list[str], Callable[[str], Scene], Callable[[str], Sequence[Path]]]:
    """Return the scenes of a set of named ones, what loads one of them, and which files it is read from."""
    if name == "tabletop":
        from scenes.library.tabletop import SCENES, tabletop

        return list(SCENES), tabletop, lambda scene: ()
    if name == "hard-cases":
        from scenes.library.hard_cases import SCENES as CASES
        from scenes.library.hard_cases import hard_case

        return list(CASES), hard_case, lambda scene: ()
    from scenes.io.relief import MIDDLEBURY_FILES, middlebury, middlebury_folder, middlebury_names

    def inputs(scene: str) -> list[Path]:
        return [middlebury_folder(scene) / file for file in MIDDLEBURY_FILES]

    return middlebury_names(), lambda scene: middlebury(middlebury_folder(scene), width=88), inputs
