"""Rendered transients wherever they lie: one file, a folder of files, the folder of a set, or its pack."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scenes.errors import require
from scenes.files import ATTRIBUTE
from scenes.io.set_index import read_set_index
from scenes.json_types import JsonObject
from scenes.library.sets import ENDLESS, SETS, scene_set

if TYPE_CHECKING:
    from csph.training.views import Views

HEADER_BYTES = 1 << 20  # a file's attributes come first


def is_set(folder: Path) -> bool:
    """Tell whether a folder is one that `dataset` fills."""
    return any((folder / name).is_file() for name in ("set.json", "index.jsonl"))


def transient_files(folder: Path) -> list[Path]:
    """Return the transients of a set's folder in the order of its index, or those (.exr) of any folder by name.

    Depth maps and other EXR images are passed over. Raises InputError for a folder without a transient.
    """
    if is_set(folder):
        found = [folder / record["file"] for record in read_set_index(folder)]
    else:
        found = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".exr" and is_transient(path))
    require(bool(found), f"{folder}: no transient (.exr) in this folder, and it is not the folder of a set")
    return found


def is_transient(path: Path) -> bool:
    """Tell whether the attributes of an EXR file say that it is a transient of ours."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    return ATTRIBUTE.encode() in head and b'"kind": "transient"' in head


def views_at(path: Path) -> Views:
    """Return the views of a set's folder, of a pack (.h5), of a folder of transients, or of one transient (.exr).

    Several views of one room of a set are of one scene in all of them; views of one number of a set of other seeds are
    of several.
    Raises InputError in one line for anything else, and for a laser that is not at the camera.
    """
    from csph.training.views import Views, read_views, scenes_by_seed
    from render.transient import read_transient

    if not _is_loose(path):
        return read_views(path)
    files = [path] if path.is_file() else transient_files(path)
    transients = [read_transient(file) for file in files]
    for file, transient in zip(files, transients, strict=True):
        displaced = any(transient.meta.get("laser", {}).get("baseline_m", (0, 0, 0)))
        require(not displaced, f"{file}: its laser is not at the camera, its path is not twice the depth")
    scenes = [
        _place(one.meta) or str(one.meta.get("scene", file.stem)) for file, one in zip(files, transients, strict=True)
    ]
    return Views(tuple(transients), tuple(scenes_by_seed(scenes, transients)))


def _is_loose(path: Path) -> bool:
    """Tell whether a path is a transient, or a folder of some, whose scenes no index of a set names."""
    return path.suffix.lower() == ".exr" if path.is_file() else path.is_dir() and not is_set(path)


def _place(meta: JsonObject) -> str | None:
    """Return the place that a view of a set shows, as the set's index and pack name it, by the scene's name alone; None
    for scenes of no set."""
    from csph.training.views import set_seed

    name, _, view = str(meta.get("scene", "")).rpartition("/")
    if name not in SETS:
        return None
    if name.partition("/")[0] not in ENDLESS:
        return f"{name}/{view}"
    # without its seed the same number may be another scene
    known = view.isascii() and view.isdigit() and set_seed(meta) is not None
    return scene_set(name).place(int(view)) if known else None


def unsure_scenes(path: Path, views: Views) -> int:
    """Count views of several whose scene is known by a name alone: those of one name may show several scenes, and those
    of several names one."""
    if len(views.transients) == 1:
        return 0
    if _is_loose(path):
        return sum(_place(view.meta) is None for view in views.transients)
    # records of an index name their places; those of a pack that somebody made may lack them
    return sum(path.is_file() and not {"place", "scene"} & view.meta.keys() for view in views.transients)
