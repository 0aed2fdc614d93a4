"""List the built-in scenes and sets, or describe one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from scene2spad.cli.paths import PNG_FIGURE, check_target, keep_foreign
from scene2spad.options.common import Common, File, Pixels, Positional, may_stay_open, only_for
from scenes.errors import require
from scenes.library.catalog import SCENES, load_scene
from scenes.library.sets import SETS, scene_set
from scenes.progress import Progress

MAX_SHEET = 1000  # views; sets of rooms have no end


@dataclass(frozen=True, kw_only=True)
class Scenes(Common):
    """List the built-in scenes and sets, or describe one: size, triangles, camera, lights, what a loader changed."""

    scene: Positional[Annotated[str, may_stay_open("[SCENE]")]] = ""
    """A scene as `render` takes it, or with --sheet a set; none lists the names."""
    sheet: File = None
    """Draw a contact sheet of the set's first views to this .png."""
    count: int = 48
    """Views on the sheet, at most 1,000, or all of a smaller set."""
    width: Pixels = None
    """Width of the sheet's views, pixels (default: 128 in 4:3 of rooms, the scene's own of others)."""


def run(command: Scenes, progress: Progress) -> dict:
    """List or describe."""
    drawn = (command.sheet is not None, "a contact sheet (--sheet)")
    only_for(command, "scenes", {"count": drawn, "width": drawn})
    if command.sheet is not None:
        return _sheet(command, command.sheet, progress)
    if not command.scene:
        return {"scenes": dict(SCENES), "sets": dict(SETS)}
    scene = load_scene(command.scene, seed=command.seed)
    low, high = scene.bounds()
    camera, laser = scene.camera, scene.laser
    described = {
        "size_m": (high - low).tolist(),
        "surfaces": len(scene.surfaces),
        "materials": sorted({f"{s.material.name} ({s.material.kind})" for s in scene.surfaces}),
        "triangles": scene.triangles,
        "camera": {
            "position_m": camera.origin.tolist(),
            "fov_deg": camera.fov_deg,
            "pixels": [camera.width, camera.height],
        },
        "laser": {"mode": laser.mode, "baseline_m": list(laser.baseline_m)},
        "ambient_light": scene.has_ambient,
        "notes": list(scene.notes),
    }
    return {"scenes": {scene.name: described}}


def _sheet(command: Scenes, path: Path, progress: Progress) -> dict:
    """Draw a contact sheet of a set."""
    from scene2spad.datasets.contact_sheets import draw_sheet
    from scene2spad.datasets.rendering import check_sides

    require(path.suffix.lower() == ".png", f"{path}: expected a .png in a folder that exists")
    check_target(path)
    keep_foreign(path, PNG_FIGURE)
    of = scene_set(command.scene or "rooms")
    require(command.count >= 1, f"--count {command.count} is less than 1")
    endless = of.size is None
    require(not endless or command.count <= MAX_SHEET, f"--count {command.count} is more than {MAX_SHEET} views")
    check_sides(() if command.width is None else (command.width,))
    count = command.count if of.size is None else min(of.size, command.count)
    width, height = command.width, None
    if of.size is None:
        width = 128 if command.width is None else command.width
        height = round(0.75 * width)
    scenes = [of.view(i, seed=command.seed, width=width, height=height) for i in range(count)]
    draw_sheet(scenes, path, progress=progress)
    return {"scenes": [scene.name for scene in scenes], "figure": str(path)}
