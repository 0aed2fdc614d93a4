"""Mesh files (.obj .ply .stl .glb) as scenes: the model stands on a floor before a wall, seen from its front.

Only a .glb knows its unit, metres, and an STL not even its upward axis; what is assumed here is said in `Scene.notes`.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.arrays import check_faces
from scenes.errors import InputError, require
from scenes.geometry import shapes
from scenes.io.inputs import file_inside, read_bytes
from scenes.io.mesh_formats.glb import glb_notes
from scenes.io.mesh_formats.mesh_colours import Paint, Part
from scenes.io.mesh_formats.mesh_files import MAX_COORDINATE, check_vertices, load_trimesh
from scenes.io.mesh_formats.ply_meshes import load_ply
from scenes.io.mesh_formats.stl import STL_HEADER, has_some_colours, stl_colours
from scenes.model import Camera, Material, Scene, Surface
from scenes.placing import AS_IT_IS, Placing

if TYPE_CHECKING:
    import trimesh

EXTENSIONS = (".obj", ".ply", ".stl", ".glb")
BACKDROP_ALBEDO = 0.55
SENSIBLE_EXTENT_M = (0.2, 2.5)  # a model whose largest extent lies in here is taken to be in metres already
MAX_EXTENT_M = 1e5  # of a model with floor and wall around it, which are many times as large
METRES_EXTENT_M = (0.05, 50.0)  # beyond it a model whose format is in metres, as glTF is, may have another unit
UNITS_M = {"mm": 1e-3, "millimet": 1e-3, "cm": 1e-2, "centimet": 1e-2, "inch": 0.0254, "feet": 0.3048, "foot": 0.3048}
UNITS_M |= {"in": 0.0254, "ft": 0.3048, "met": 1.0, "m": 1.0}
HEADER_BYTES = 4096  # where a comment may name the unit
WALL_GAP_M = 1.0
FOV_DEG = 40.0
ELEVATION_DEG, AZIMUTH_DEG = 15.0, 30.0  # a little from above, and from the side: what faces away shows its flank
FILL = 0.7  # share of the smaller image dimension that the model's bounding sphere takes
# Rotations that bring an axis of the file upwards (to +y).
TURNS = {
    "x": np.array(((0.0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))),
    "y": np.eye(4),
    "z": np.array(((1.0, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))),
}
FLAT = 1e-6  # height of a level mesh to its largest extent, below which it would lie in the floor
ZERO_AREA = 1e-12  # m^2; a face of no larger area is degenerate; in a model under 1 m its share of the extent squared


def load_mesh(path: Path, *, width: int = 128, height: int = 96, placing: Placing = AS_IT_IS) -> Scene:
    """Return the scene of one mesh file, metres, y up: floor at y = 0, wall behind, camera before the model's +z side.

    A .glb is in metres, with a warning in the notes where its largest extent is not 0.05 to 50 m. Any other model keeps
    its size if its largest extent is 0.2 to 2.5 m. Otherwise the unit that the file names is taken (a comment or header
    such as "units: mm"), else millimetres or inches where these make 0.2 to 2.5 m of it, else it is scaled to 1 m; each
    with a warning in the notes. Every surface is diffuse with the file's colour as albedo (luminance of linear colour),
    0.6 where the file has none. `placing` states size, upward axis and camera instead. Raises InputError in one line
    for a file that is missing, of another kind, broken, empty, without faces or with NaNs, and for a camera that floor
    and wall cannot be put around.
    """
    path = Path(path)
    parts = _read(path)
    notes = glb_notes(read_bytes(path)) if path.suffix.lower() == ".glb" else []
    parts = _stand(path, parts, notes, placing)
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    centre = (low + high) / 2
    radius = max(float(np.linalg.norm(part.vertices - centre, axis=1).max()) for part in parts)
    camera = placing.camera(_camera(centre, radius, width, height), centre, notes)
    wall_z = low[2] - WALL_GAP_M
    around = [] if placing.bare else _around(path, camera, wall_z)
    paint = Paint(path, notes)
    surfaces = [_surface(part, paint) for part in parts]
    return Scene(path.stem, (*surfaces, *around), camera, notes=tuple(notes))


def _around(path: Path, camera: Camera, wall_z: float) -> list[Surface]:
    """Floor and wall, which a camera that was placed must stand before."""
    top = camera.rays(np.array([0.0, camera.width]), np.zeros(2))
    good = camera.origin[1] > 0 and camera.origin[2] > wall_z and bool((top[:, 2] < 0).all())
    if not good:
        raise InputError(f"{path}: the camera does not stand above the floor and look at the wall behind; use --bare")
    return backdrop(camera, wall_z)


def _camera(centre: np.ndarray, radius: float, width: int, height: int) -> Camera:
    """Place a camera before and a little above a sphere that is to fill 70 % of the smaller image dimension."""
    focal = Camera(np.eye(4), FOV_DEG, width, height).focal_px
    edge = FILL * min(width, height) / 2 / focal
    distance = radius * math.hypot(1, edge) / edge
    up, aside = math.radians(ELEVATION_DEG), math.radians(AZIMUTH_DEG)
    toward = (math.cos(up) * math.sin(aside), math.sin(up), math.cos(up) * math.cos(aside))
    origin = centre + distance * np.array(toward)
    return Camera.look_at(origin, centre, fov_deg=FOV_DEG, width=width, height=height)


def backdrop(camera: Camera, wall_z: float, least_m: float = 4.0) -> list[Surface]:
    """Return a floor at y = 0 and a wall at z = `wall_z`, both as large as the whole image needs and `least_m` at
    least.

    The camera is above the floor, before the wall, and its top row looks towards the wall (not steeper than upright).
    """
    # Floor and wall are one folded sheet, so the image's border maps to the border of what is seen of them.
    x, y = np.linspace(0, camera.width, 65), np.linspace(0, camera.height, 65)
    border_x = np.concatenate((x, x, np.zeros(65), np.full(65, camera.width)))
    border_y = np.concatenate((np.zeros(65), np.full(65, camera.height), y, y))
    rays = camera.rays(border_x, border_y)
    with np.errstate(divide="ignore"):
        to_floor = np.where(rays[:, 1] < 0, -camera.origin[1] / rays[:, 1], np.inf)
        to_wall = np.where(rays[:, 2] < 0, (wall_z - camera.origin[2]) / rays[:, 2], np.inf)
    seen = camera.origin + np.minimum(to_floor, to_wall)[:, None] * rays
    margin = 0.1 + 0.05 * np.ptp(seen, axis=0)
    low = np.minimum(seen.min(axis=0) - margin, (-least_m / 2, 0, wall_z))
    high = np.maximum(seen.max(axis=0) + margin, (least_m / 2, least_m / 2, wall_z + least_m))
    width, tall, deep = high[0] - low[0], high[1], high[2] - wall_z
    middle = (low[0] + high[0]) / 2
    square, faces, _ = shapes.rectangle()
    unit = (square[:, :2] + (0, 1)) / 2  # x from -1/2 to 1/2, upwards from 0 to 1
    material = Material(albedo=BACKDROP_ALBEDO, name="backdrop")
    across, zero = middle + width * unit[:, 0], np.zeros(4)
    floor = np.column_stack((across, zero, high[2] - deep * unit[:, 1]))
    wall = np.column_stack((across, tall * unit[:, 1], zero + wall_z))
    return [Surface(floor, faces, material, name="floor"), Surface(wall, faces, material, name="wall")]


# --- Reading -----------------------------------------------------------------------------------------------------


def _read(path: Path) -> list[Part]:
    """Read the file's triangle meshes, each moved by its node's transform, or an InputError in one line."""
    kind = path.suffix.lower()
    if kind not in EXTENSIONS:
        raise InputError(f"{path}: extension {kind or '(none)'}, expected one of {' '.join(EXTENSIONS)}")
    found: list[Part | None]
    if kind == ".ply":
        found = [*_ply_parts(path)]
    else:
        found = _trimesh_parts(path, kind)
        require(bool(found), f"{path}: empty, no mesh in it")
    parts = [part for part in found if part is not None]
    require(bool(parts), f"{path}: has no faces (a point cloud or lines only)")
    return [replace(parts[0], name=path.stem)] if len(parts) == 1 else parts


def _ply_parts(path: Path) -> list[Part]:
    """Return what a PLY holds, one part a texture."""
    parts = []
    for number, mesh in enumerate(load_ply(path)):
        try:
            image = None if mesh.image is None else file_inside(path.parent, mesh.image, "texture")
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        normals = _filled(mesh.normals, mesh.vertices, mesh.faces)
        uv = _finite(mesh.uv, len(mesh.vertices))
        as_read = mesh.vertices, mesh.faces
        name = f"{path.stem}_{number}"
        colours, coloured = mesh.colours, mesh.coloured
        parts.append(Part(name, *as_read, uv, normals, None, colours, coloured, as_read, image))
    return parts


def _trimesh_parts(path: Path, kind: str) -> list[Part | None]:
    """Return what trimesh reads of a file, moved by its nodes; None for points, lines and meshes without faces."""
    loaded = load_trimesh(path, kind)
    try:
        meshes = [(*loaded.graph[node], node) for node in loaded.graph.nodes_geometry]
        header = read_bytes(path)[:STL_HEADER] if kind == ".stl" else b""
        parts = [_part(loaded.geometry[name], np.asarray(pose), node, header) for pose, name, node in meshes]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # what trimesh works out only when it is asked for
        raise InputError(f"{path}: broken {kind} file ({(str(error).splitlines() or [''])[0][:200]})") from None
    return parts


def _part(mesh: trimesh.Trimesh, pose: np.ndarray, name: str, header: bytes) -> Part | None:
    """One mesh in world coordinates; None for points, lines and meshes without faces. `header` of an STL."""
    faces = np.asarray(getattr(mesh, "faces", ()))
    if faces.size == 0:
        return None
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    check_faces(faces, len(vertices), name)
    check_vertices(vertices, name)
    _check_pose(pose, name)
    uv = _finite(getattr(mesh.visual, "uv", None), len(vertices))
    # trimesh computes normals on demand; only those that it read from the file are in its cache before that.
    normals = np.asarray(mesh.vertex_normals) if "vertex_normals" in mesh._cache else None
    normals = _filled(normals, vertices, faces)
    normals = None if normals is None else shapes.transform_normals(normals, pose)
    if np.linalg.det(pose[:3, :3]) < 0:
        faces = faces[:, ::-1]  # a mirrored mesh would have its faces inside out
    beside = mesh.visual if "color" in getattr(mesh.visual, "vertex_attributes", {}) else mesh
    vertices = shapes.transform(vertices, pose)
    colours, coloured = beside.vertex_attributes.get("color"), "vertex"
    if "stl" in mesh.face_attributes:
        attributes = mesh.face_attributes["stl"]
        coloured = "some faces" if has_some_colours(header, attributes) else "face"
        colours = stl_colours(header, attributes)
    return Part(name, vertices, faces, uv, normals, mesh.visual, colours, coloured, as_read=(vertices, faces))


def _finite(uv: np.ndarray | None, vertices: int) -> np.ndarray | None:
    """Return texture coordinates, or None unless there are two finite ones for each vertex."""
    good = uv is not None and np.shape(uv) == (vertices, 2) and bool(np.isfinite(uv).all())
    return np.asarray(uv) if good else None


def _filled(normals: np.ndarray | None, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """Return normals with those of no direction made from the faces; None where no vertex of a face has one."""
    if normals is None:
        return None
    normals = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0)
    return shapes.filled_normals(normals, vertices, faces) if normals[faces].any() else None


def _check_pose(pose: np.ndarray, name: str) -> None:
    """InputError unless a node's transform is affine, can be inverted, and keeps coordinates of a sensible size."""
    largest = float(np.abs(pose).max()) if np.isfinite(pose).all() else math.inf
    if largest > MAX_COORDINATE:
        raise InputError(f"the transform of {name} holds {largest:g}, expected {MAX_COORDINATE:g} at the most")
    if abs(np.linalg.det(pose[:3, :3])) < 1e-30:
        raise InputError(f"the transform of {name} is not invertible")


# --- Standing upright, at a sensible size, with sound faces ----------------------------------------------------------


def _stand(path: Path, parts: list[Part], notes: list[str], placing: Placing) -> list[Part]:
    """Return the parts y up, in metres, without useless faces, resting on y = 0 with their middle at x = z = 0."""
    up = placing.up or ("z" if path.suffix.lower() == ".stl" else "y")
    turn = TURNS[up]
    if placing.up is None and up == "z":
        notes.append("z taken as up, as is usual for .stl; --up says otherwise")
    points = np.concatenate([part.vertices[np.unique(part.faces)] for part in parts]) @ turn[:3, :3].T
    low, high = points.min(axis=0), points.max(axis=0)
    with np.errstate(over="ignore"):
        extent = float((high - low).max())
    if not 0 < extent < math.inf:
        raise InputError(f"{path}: its largest extent is {extent:g}, expected a solid body of finite size")
    scale, warning = _scale(path, extent) if placing.scale is None else (placing.scale, [])
    if not placing.bare and scale * extent > MAX_EXTENT_M:
        wide = f"{path}: largest extent of {scale * extent:.4g} m is beyond the {MAX_EXTENT_M:g} m that floor and wall"
        raise InputError(f"{wide} are put around; --scale says how many metres a unit has")
    size = (
        f"{extent:.4g} m kept" if scale == 1 else f"scaled by {scale:.3g}: {extent:.4g} to {round(scale * extent, 4)} m"
    )
    notes += [f"largest extent {size}", *warning]
    pose = scale * turn
    pose[:, 3] = -scale * (low[0] + high[0]) / 2, -scale * low[1], -scale * (low[2] + high[2]) / 2, 1
    if not placing.bare and high[1] - low[1] < FLAT * extent:
        pose[1, 3] += 1e-3
        notes.append("flat and level: lifted by 1 mm off the floor")
    moved = [_moved(part, pose) for part in parts]
    sound = [part for part in (_sound(part, notes) for part in moved) if part is not None]
    if not sound:
        raise InputError(f"{path}: all of its faces are degenerate")
    return sound


def _scale(path: Path, extent: float) -> tuple[float, list[str]]:
    """Metres per unit of the file, and what to warn of."""
    if path.suffix.lower() == ".glb":
        return 1.0, _odd_metres(extent)
    low, high = SENSIBLE_EXTENT_M
    with path.open("rb") as file:
        header = file.read(HEADER_BYTES).decode("latin-1").replace("\r", "\n")
    # short ones are whole words: neither "microns" nor "units in use" is a unit of these; "metric" is none either
    ends = {"met": "(?=er|re)", "in": r"(?! *[a-z0-9])"}
    names = "|".join(
        f"{name}{ends.get(name, '(?![a-z0-9])' if len(name) < 3 else '')}"
        for name in sorted(UNITS_M, key=len, reverse=True)
    )
    stated = re.search(rf"\bunits?\b[^a-z0-9\n]{{0,9}}(?:are |in )?({names}).*", header, re.IGNORECASE)
    unit = "" if stated is None else stated[1].lower()
    if stated is not None and not _names_another(stated[0], UNITS_M[unit]):
        return UNITS_M[unit], [f"warning: unit {unit!r} taken from the file's own words"]
    if low <= extent <= high:
        return 1.0, []
    for name, metres in (("millimetres", 1e-3), ("inches (or centimetres)", 0.0254)):
        if low <= metres * extent <= high:
            return metres, [f"warning: no unit in the file, {extent:.4g} looks like {name}"]
    kept = f"; --scale 1 keeps {extent:.4g} m"
    return 1.0 / extent, [f"warning: no unit makes a sensible size of it, so its size is made up{kept}"]


def _odd_metres(extent: float) -> list[str]:
    """Warn of an extent that few models in metres have."""
    low, high = METRES_EXTENT_M
    words = f"warning: glTF is in metres, but {extent:.4g} m is outside {low:g} to {high:g} m; --scale says otherwise"
    return [] if low <= extent <= high else [words]


def _names_another(words: str, metres: float) -> bool:
    """Return whether a statement of a unit names another one too, as of what a program works in and what it writes."""
    # "in" and "m" may be other words
    names = [name if len(name) > 2 else rf"{name}\b" for name in UNITS_M if name not in ("in", "m")]
    named = re.findall("|".join(rf"\b{name}" for name in names), words, re.IGNORECASE)
    return any(UNITS_M[name.lower()] != metres for name in named)


def _moved(part: Part, pose: np.ndarray) -> Part:
    normals = None if part.normals is None else shapes.transform_normals(part.normals, pose)
    return replace(part, vertices=shapes.transform(part.vertices, pose), normals=normals)


def _sound(part: Part, notes: list[str]) -> Part | None:
    """Drop faces of no area, doubled faces and vertices that no face uses; None when nothing is left."""
    a, b, c = part.vertices[part.faces].transpose(1, 0, 2)
    zero = ZERO_AREA * min(1.0, float(np.ptp(part.vertices, axis=0).max())) ** 2
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2 <= zero
    # The same three points in any order are one face: its two sides reflect alike.
    _, point = np.unique(part.vertices, axis=0, return_inverse=True)
    corners = np.sort(point.ravel()[part.faces], axis=1)
    first = np.zeros(len(corners), dtype=bool)
    first[np.unique(corners, axis=0, return_index=True)[1]] = True
    keep = ~flat & first
    used, faces = np.unique(part.faces[keep], return_inverse=True)
    counts = (
        (int(flat.sum()), "degenerate faces"),
        (int((~first & ~flat).sum()), "duplicate faces"),
        (len(part.vertices) - len(np.unique(part.faces)), "unreferenced vertices"),
    )
    notes += [f"{part.name}: {what} dropped: {count}" for count, what in counts if count]
    if not keep.any():
        return None
    uv, normals = (None if value is None else value[used] for value in (part.uv, part.normals))
    return replace(part, vertices=part.vertices[used], faces=faces.reshape(-1, 3), uv=uv, normals=normals)


def _surface(part: Part, paint: Paint) -> Surface:
    uv = paint.coordinates(part)
    return Surface(part.vertices, part.faces, paint.material(part), uv=uv, normals=part.normals, name=part.name)
