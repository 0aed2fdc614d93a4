"""Scenes by name or by file: one door for the command line and for studies."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Unpack

import numpy as np

from scenes.errors import InputError, did_you_mean
from scenes.geometry import shapes
from scenes.io.mesh_formats.meshes import EXTENSIONS as MESH_EXTENSIONS
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.library.gallery import gallery
from scenes.library.hall import hall
from scenes.library.living_room import living_room
from scenes.library.washroom import washroom
from scenes.model import Camera, Material, Scene, Surface
from scenes.placing import AS_IT_IS, Placing, PlacingFields, placed, stated

SCENES: dict[str, str] = {
    "living-room": "a furnished room made from the seed, 0.8 to 6.2 m, with a window and a lamp as ambient light",
    "plane": "a frontal Lambertian wall at 3 m, albedo 0.5",
    "sphere": "a Lambertian sphere of radius 0.5 m whose centre is 3 m away, albedo 0.5, nothing behind it",
    "corner": "a V-groove: two walls of 2 x 4 m, albedo 0.5, that meet at 90 degrees on an upright edge 3 m away",
    "gallery": "a bare closed room with six finely meshed bodies, 123,000 triangles",
    "hall": "a varnished stairwell: coated wood, lacquer, tiles and rough metal of alpha 0.05 to 0.3",
    "washroom": "chrome, a mirror, lamps in bulbs of thin and of thick glass, a glass door, glossy tiles",
}
WHOLE = {"gallery": gallery, "hall": hall, "washroom": washroom}  # scenes with cameras of their own, without a seed
EXTENSIONS = (*MESH_EXTENSIONS, ".xml")
HARD = "hard-cases/"
WALL = "wall@"
FAMILIES = (HARD, "tabletop/", "middlebury/", "rooms/", "clutter/")
WIDTH, HEIGHT = 128, 96  # pixels, where neither the caller nor the file says


def load_scene(
    spec: str,
    *,
    seed: int = 0,
    width: int | None = None,
    height: int | None = None,
    placing: Placing = AS_IT_IS,
    **placing_fields: Unpack[PlacingFields],
) -> Scene:
    """Return the scene of that name, or in that file (.obj .ply .stl .glb, or Mitsuba .xml).

    Names: a key of SCENES, `wall@METRES` (a frontal wall there, as `plane`), `hard-cases/NAME`, `tabletop/NAME`,
    `middlebury/NAME`, `rooms/SPLIT/NUMBER`, `clutter/SPLIT/NUMBER`; a folder with view1.png, disp1.png and dmin.txt is
    a Middlebury scene too.

    width, height: pixels; None is 128 x 96, or the film size of an .xml; one alone keeps the proportions. The seed
    matters to procedural scenes only. `placing` states size, upward axis (meshes) and camera; its fields can be given
    as keywords: `load_scene("part.stl", scale=0.001, up="y")`. Those are `up` (x, y or z), `scale` (metres per unit of
    the file), `origin` and `target` of the camera [m], `fov_deg`, and `bare` (no floor and no wall). Raises InputError
    in one line for an unknown name, extension or keyword, or a bad file.

    Examples
    --------
    A frontal wall at 5 m, seen by a camera at the origin of the world, which looks along -z:

    >>> import scene2spad as s2s
    >>> scene = s2s.load_scene("wall@5", width=4, height=3)
    >>> scene
    Scene('wall@5', 1 surfaces, 2 triangles, 4 x 3 pixels, fov 40 deg, flood laser)
    >>> scene.surfaces[0].vertices[:, 2].tolist()  # z [m]
    [-5.0, -5.0, -5.0, -5.0]
    """
    spec = str(spec)
    placing = stated(placing, placing_fields, "load_scene")
    if Path(spec).suffix.lower() in MESH_EXTENSIONS:
        size = _looking_ahead(WIDTH, HEIGHT).resized(width, height)
        return load_mesh(Path(spec), width=size.width, height=size.height, placing=placing)
    return placed(_loaded(spec, seed, width, height), placing)


def _loaded(spec: str, seed: int, width: int | None, height: int | None) -> Scene:
    """Load a scene that is no mesh file, as its name or its file has it."""
    kind = Path(spec).suffix.lower()
    if spec.startswith(WALL):
        return _wall_at(spec, _looking_ahead(WIDTH, HEIGHT).resized(width, height))
    if spec.startswith(HARD):
        return _hard_case(spec.removeprefix(HARD), width, height)
    if spec.startswith(FAMILIES[1:]) and not Path(spec).exists():
        return _of_a_set(spec, seed, width, height)
    if (Path(spec) / "disp1.png").is_file():
        from scenes.io.relief import middlebury

        return middlebury(Path(spec), width=WIDTH if width is None and height is None else width, height=height)
    if spec not in SCENES and kind not in EXTENSIONS:
        families = ", ".join(f"{family}NAME" for family in FAMILIES)
        raise InputError(
            f"scene {spec!r}: expected one of {', '.join(SCENES)}, {WALL}METRES, {families}, "
            f"or a file with extension {' '.join(EXTENSIONS)}{did_you_mean(spec, SCENES)}"
        )
    if kind == ".xml":
        from scenes.io.mitsuba.scene_file import load_mitsuba_xml

        return load_mitsuba_xml(Path(spec), width=width, height=height)
    size = _looking_ahead(WIDTH, HEIGHT).resized(width, height)
    if spec == "living-room":
        return living_room(seed, width=size.width, height=size.height)
    if spec in WHOLE:
        return WHOLE[spec](width=size.width, height=size.height)
    make = {"plane": _plane, "sphere": _sphere, "corner": _corner}[spec]
    return Scene(spec, make(), size)


def _wall_at(spec: str, camera: Camera) -> Scene:
    """`plane` at another distance, as large as the image needs."""
    try:
        distance_m = float(spec.removeprefix(WALL))
    except ValueError:
        distance_m = math.nan
    if not 0.01 <= distance_m <= 1e5:
        raise InputError(f"scene {spec!r}: expected {WALL} and metres from 0.01 to 100,000")
    return Scene(spec, _plane(distance_m, 8 / 3 * distance_m), camera)


def _of_a_set(spec: str, seed: int, width: int | None, height: int | None) -> Scene:
    """Load a scene by the name that its set gives it: `rooms/train/17`, `tabletop/spikes`, `middlebury/Art`."""
    from scenes.io.relief import middlebury, middlebury_folder
    from scenes.library.sets import scene_set
    from scenes.library.tabletop import SCENES as TABLETOP
    from scenes.library.tabletop import tabletop

    family, _, name = spec.partition("/")
    if family == "middlebury":
        return middlebury(
            middlebury_folder(name), width=WIDTH if width is None and height is None else width, height=height
        )
    if family == "tabletop":
        if name not in TABLETOP:
            raise InputError(f"scene {spec!r}: expected tabletop/ and one of {', '.join(TABLETOP)}")
        scene = tabletop(name)
        return replace(scene, camera=scene.camera.resized(width, height))
    split, _, number = name.partition("/")
    if not number.isdecimal():
        splits = ", ".join(f"{family}/{split}" for split in ("train", "val", "test"))
        raise InputError(f"scene {spec!r}: expected one of {splits}, then / and the number of a view")
    return scene_set(f"{family}/{split}").view(int(number), seed=seed, width=width, height=height)


def _hard_case(name: str, width: int | None, height: int | None) -> Scene:
    from scenes.library.hard_cases import SCENES as HARD_CASES
    from scenes.library.hard_cases import hard_case

    if name not in HARD_CASES:
        raise InputError(f"scene {HARD + name!r}: expected {HARD} and one of {', '.join(HARD_CASES)}")
    scene = hard_case(name)
    return replace(scene, camera=scene.camera.resized(width, height))


def _looking_ahead(width: int, height: int, fov_deg: float = 40.0) -> Camera:
    """Build a camera at the origin that looks along -z."""
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def _plane(distance_m: float = 3.0, half_m: float = 8.0) -> tuple[Surface, ...]:
    """Build a square large enough to fill an image up to 7 times as tall as wide."""
    square, faces, uv = shapes.rectangle()
    return (Surface(half_m * square - (0, 0, distance_m), faces, Material(name="grey"), uv=uv, name="wall"),)


def _sphere(distance_m: float = 3.0, radius_m: float = 0.5) -> tuple[Surface, ...]:
    """Triangles inscribed in the sphere (no deeper than 0.2 mm), with the true sphere's normals for shading."""
    points, faces, uv = shapes.sphere()
    vertices = radius_m * points - (0, 0, distance_m)
    return (Surface(vertices, faces, Material(name="grey"), uv=uv, normals=points, name="sphere"),)


def _corner(distance_m: float = 3.0, width_m: float = 2.0, height_m: float = 4.0) -> tuple[Surface, ...]:
    """Two upright rectangles, one material, each at 45 degrees to the camera's axis, open towards the camera."""
    square, faces, uv = shapes.rectangle()
    along, up = width_m * (square[:, :1] + 1) / 2, square[:, 1:2] * (0, height_m / 2, 0)
    slant, grey = math.sqrt(0.5), Material(name="grey")
    edge = np.array((0, 0, -distance_m))
    right = edge + up + along * (slant, 0, slant)
    left = edge + up + (width_m - along) * (-slant, 0, slant)
    return (
        Surface(left, faces, grey, uv=uv, name="left wall"),
        Surface(right, faces, grey, uv=uv, name="right wall"),
    )
