"""Mitsuba's shape plugins as surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.arrays import check_faces
from scenes.errors import InputError
from scenes.geometry import shapes
from scenes.io.mesh_formats.mesh_files import check_vertices, load_trimesh
from scenes.io.mesh_formats.ply_meshes import load_ply
from scenes.io.mesh_formats.serialized import read_serialized
from scenes.io.mitsuba.bsdf import Look, Materials
from scenes.io.mitsuba.nodes import Document
from scenes.io.mitsuba.plugin import Plugin
from scenes.model import Camera, Surface

# At 128 segments a disk's area is 4e-4 too small, at 5 subdivisions a sphere's 3e-4: under the 1e-3 that is promised.
SEGMENTS = 128
SUBDIVISIONS = 5

# Side of Mitsuba's cube -> the directions in which its u and v grow, in the order of shapes.box: z, -z, x, -x, y, -y.
_CUBE_UV = (
    ((0, 1, 0), (1, 0, 0)),
    ((0, -1, 0), (1, 0, 0)),
    ((0, 1, 0), (0, 0, -1)),
    ((0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0)),
)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles before to_world; uv with Mitsuba's v, which is 0 at the top row of an image.

    `keeps_side` says that the outside stays outside under a mirroring to_world, as Mitsuba has it where normals are
    known beside the faces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None
    keeps_side: bool = True
    smooth: bool = False
    notes: tuple[str, ...] = ()


class Shapes:
    """Builds surfaces; every mesh file is read once."""

    def __init__(self, document: Document, materials: Materials) -> None:
        self._document = document
        self._materials = materials
        self._unread = Materials(document, reads_images=False)
        self._files: dict[tuple[Path, int], Mesh] = {}

    def check(self, plugin: Plugin) -> None:
        """Refuse a <shape> that has no counterpart here, in one line, before any mesh or image is read."""
        plugin.refuse("medium", "volume", "phase", "subsurface", "sensor")
        plugin.transform("to_world")
        if plugin.type in _CONTAINERS:
            for part in _parts(plugin):
                self.check(part)
            return
        if plugin.type not in _BUILDERS:
            way_round = _WAYS_ROUND.get(plugin.type, f"expected one of {', '.join((*_BUILDERS, *_CONTAINERS))}")
            raise plugin.fail(f"shape {plugin.type!r} is not supported, {way_round}")
        plugin.refuse("shape")
        if plugin.type in _FILES:
            self._document.file(plugin.element, plugin.string("filename"), "mesh")
        else:
            _BUILDERS[plugin.type](self, plugin)
        if not _is_unseen(plugin):
            self._unread.of_shape(plugin)
        self._emission(plugin, self._unread)

    def surfaces(self, plugin: Plugin) -> list[Surface]:
        """Return the surfaces of a <shape> in the world: one, or those of an instance or a merge; none of a group."""
        if plugin.type in _CONTAINERS:
            plugin.note_left_out("bsdf", "emitter", why="shapes have those inside their own elements")
            plugin.note_unused()
        if plugin.type == "shapegroup":
            if plugin.has("to_world"):
                plugin.note("to_world of a shapegroup is left out, as in Mitsuba")
            return []  # is seen where instances put it
        if plugin.type in _CONTAINERS:
            matrix = plugin.transform("to_world")
            return [_moved(one, matrix) for part in _parts(plugin) for one in self.surfaces(part)]
        if _is_unseen(plugin):
            plugin.note("a null bsdf lets all light pass, the shape is left out")
            return []
        return [self.surface(plugin)]

    def surface(self, plugin: Plugin) -> Surface:
        """Return the surface of a <shape>, in the world, with its material and its light."""
        name = plugin.id or Path(plugin.string("filename", plugin.type).replace("\\", "/")).stem
        look = self._materials.of_shape(plugin)
        mesh = _placed(_BUILDERS[plugin.type](self, plugin), plugin)
        if look.inside_out:
            mesh = _turned(mesh)
        emission = self._emission(plugin, self._materials)
        if emission > 0 and look.material.has_holes:
            plugin.note("the holes of the lamp's mask are dark, in Mitsuba they shine")
        plugin.note_unused()
        uv = _project_uv(mesh.uv, look)
        try:
            return Surface(
                mesh.vertices, mesh.faces, look.material, uv=uv, normals=mesh.normals, emission=emission, name=name
            )
        except InputError as error:
            raise plugin.fail(f"{plugin.string('filename', '')}: {error}".removeprefix(": ")) from None

    def _emission(self, plugin: Plugin, materials: Materials) -> float:
        """Radiance of an area light on the shape."""
        emitters = plugin.nested("emitter")
        if len(emitters) > 1:
            raise plugin.fail(f"has {len(emitters)} emitters, expected one")
        if not emitters:
            return 0.0
        emitter = emitters[0]
        if emitter.type in _BEAMS:
            plugin.note(f"emitter {emitter.type} on a surface is left out, ambient light lacks it")
            return 0.0
        if emitter.type != "area":
            raise emitter.fail(f"emitter {emitter.type!r} on a shape is not supported, expected area")
        radiance = materials.mean(emitter, "radiance", 1.0)
        emitter.ignore(("sampling_weight",))
        emitter.note_unused()
        return radiance

    def file(self, plugin: Plugin, kind: str) -> Mesh:
        """Return a mesh file with the uv and vertex normals that it carries, v as the file has it."""
        filename = plugin.string("filename")
        path = self._document.file(plugin.element, filename, "mesh")
        index = plugin.integer("shape_index", 0) if kind == "serialized" else 0
        key = path.resolve(), index
        if key not in self._files:
            try:
                self._files[key] = _read(path, kind) if kind != "serialized" else _read_serialized(path, index)
            except InputError as error:
                raise plugin.fail(f"{filename}: {str(error).removeprefix(f'{path}: ')}") from None
            except Exception as error:  # what trimesh works out only when it is asked for
                reason = (str(error).splitlines() or [type(error).__name__])[0]
                raise plugin.fail(f"{filename}: broken .{kind} file ({reason})") from None
        mesh = self._files[key]
        if len(mesh.faces) == 0:
            raise plugin.fail(f"{filename}: holds no triangles")
        check_faces(mesh.faces, len(mesh.vertices), str(path))
        for note in mesh.notes:
            plugin.note(f"{filename}: {note}")
        return mesh


def _read(path: Path, kind: str) -> Mesh:
    """All parts of an .obj or .ply file as one mesh; materials in the file are not looked at."""
    import trimesh

    if kind == "ply":
        meshes = [Mesh(one.vertices, one.faces, one.uv, one.normals) for one in load_ply(path, as_mitsuba=True)]
    else:
        loaded = load_trimesh(path, f".{kind}", skip_materials=True)
        # trimesh keeps the normals of a file in the cache, where its own exporters look for them too; None if absent.
        meshes = [
            Mesh(part.vertices, part.faces, getattr(part.visual, "uv", None), part._cache["vertex_normals"])
            for part in loaded.geometry.values()
            if isinstance(part, trimesh.Trimesh) and len(part.faces)
        ]
    if not meshes:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    check_vertices(np.concatenate([mesh.vertices for mesh in meshes]), path.name)
    return _joined(meshes)


def _joined(meshes: list[Mesh]) -> Mesh:
    """Return parts as one mesh. Faces that lack what others have, which Mitsuba leaves to chance, are noted: uv are 0,
    normals the faces' own."""
    notes = []
    for what, words in (("uv", "texture coordinates, (0, 0) is taken"), ("normals", "vertex normals, they are flat")):
        counts = [len(mesh.faces) for mesh in meshes if getattr(mesh, what) is None]
        if 0 < len(counts) < len(meshes):
            notes.append(f"{sum(counts)} of {sum(len(mesh.faces) for mesh in meshes)} faces have no {words}")
            meshes = [_filled(mesh, what) if getattr(mesh, what) is None else mesh for mesh in meshes]
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=False)])
    uvs = [mesh.uv for mesh in meshes if mesh.uv is not None]
    normals = [mesh.normals for mesh in meshes if mesh.normals is not None]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        faces,
        np.concatenate(uvs) if uvs else None,
        np.concatenate(normals) if normals else None,
        notes=tuple(notes),
    )


def _filled(mesh: Mesh, what: str) -> Mesh:
    """Return a mesh with uv of 0, or with the normals of its faces at corners of their own."""
    if what == "uv":
        return replace(mesh, uv=np.zeros((len(mesh.vertices), 2)))
    corners = mesh.faces.ravel()
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals[~normals.any(axis=1)] = 0, 0, 1  # of a face without area, which is not seen
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = None if mesh.uv is None else mesh.uv[corners]
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Mesh(mesh.vertices[corners], faces, uv, np.repeat(normals, 3, axis=0))


def _read_serialized(path: Path, index: int) -> Mesh:
    """One mesh of a .serialized file."""
    found = read_serialized(path, index)
    check_vertices(found.vertices, path.name)
    return Mesh(found.vertices, found.faces, found.uv, found.normals)


def _obj(builder: Shapes, plugin: Plugin) -> Mesh:
    return _from_file(builder.file(plugin, "obj"), plugin, flip_v=True)


def _ply(builder: Shapes, plugin: Plugin) -> Mesh:
    return _from_file(builder.file(plugin, "ply"), plugin, flip_v=False)


def _serialized(builder: Shapes, plugin: Plugin) -> Mesh:
    plugin.ignore(("max_smooth_angle",))
    return _from_file(builder.file(plugin, "serialized"), plugin, flip_v=False)


def _from_file(mesh: Mesh, plugin: Plugin, *, flip_v: bool) -> Mesh:
    """face_normals drops vertex normals; a file without any gets smooth ones, as in Mitsuba."""
    if mesh.uv is not None and plugin.boolean("flip_tex_coords", flip_v):
        mesh = replace(mesh, uv=_flipped_v(mesh.uv))
    plugin.ignore(("flip_tex_coords",))
    if plugin.boolean("face_normals", False):
        return replace(mesh, normals=None, keeps_side=False)
    return replace(mesh, keeps_side=mesh.normals is not None, smooth=mesh.normals is None)


def _rectangle(builder: Shapes, plugin: Plugin) -> Mesh:
    return Mesh(*shapes.rectangle())


def _cube(builder: Shapes, plugin: Plugin) -> Mesh:
    vertices, faces, _ = shapes.box()
    directions = np.repeat(np.array(_CUBE_UV, dtype=float), 4, axis=0)
    return Mesh(vertices, faces, (1 + np.einsum("nij,nj->ni", directions, vertices)) / 2)


def _sphere(builder: Shapes, plugin: Plugin) -> Mesh:
    centre, radius = plugin.point("center", (0, 0, 0)), _positive(plugin, "radius")
    vertices, faces, uv = shapes.sphere(1.0, SUBDIVISIONS)
    axes = plugin.transform("to_world")[:3, :3]
    gram = axes.T @ axes
    if not np.allclose(gram, gram[0, 0] * np.eye(3), rtol=1e-4, atol=1e-4 * gram[0, 0]):
        plugin.note("to_world makes an ellipsoid of the sphere; Mitsuba keeps a sphere of the length of its x axis")
    # Mitsuba turns a mirrored sphere inside out, alone among its shapes.
    return Mesh(centre + radius * vertices, faces, _flipped_v(uv), vertices, keeps_side=False)


def _disk(builder: Shapes, plugin: Plugin) -> Mesh:
    vertices, faces, uv = shapes.disk(1.0, SEGMENTS)
    return Mesh(vertices, faces, _flipped_v(uv))


def _cylinder(builder: Shapes, plugin: Plugin) -> Mesh:
    p0, p1, radius = plugin.point("p0", (0, 0, 0)), plugin.point("p1", (0, 0, 1)), _positive(plugin, "radius")
    length = np.linalg.norm(p1 - p0)
    if length == 0:
        raise plugin.fail("p0 and p1 are the same point")
    vertices, faces, uv = shapes.cylinder(p0, p1, radius, segments=SEGMENTS)
    axis = (p1 - p0) / length
    spokes = (vertices - p0) - np.outer((vertices - p0) @ axis, axis)
    return Mesh(vertices, faces, _flipped_v(uv), spokes / radius)


_BUILDERS: dict[str, Callable[[Shapes, Plugin], Mesh]] = {
    "obj": _obj,
    "ply": _ply,
    "serialized": _serialized,
    "rectangle": _rectangle,
    "cube": _cube,
    "sphere": _sphere,
    "disk": _disk,
    "cylinder": _cylinder,
}
_FILES = ("obj", "ply", "serialized")
_CONTAINERS = ("shapegroup", "instance", "merge")
# Emitters on surfaces that shine into some directions alone.
_BEAMS = ("directionalarea", "angulararea")
_CURVES = "write the strands as thin cylinders or a mesh"
_WAYS_ROUND = {
    **dict.fromkeys(("hair", "linearcurve", "bsplinecurve"), _CURVES),
    **dict.fromkeys(("heightfield", "sdfgrid", "deformable"), "write it as .obj or .ply"),
    **dict.fromkeys(("ellipsoids", "ellipsoidsmesh"), "write them as spheres or meshes"),
}


def shows_open_back(surface: Surface, camera: Camera) -> bool:
    """Return whether a camera looks at the back of a mesh that has an edge, as a sheet or a vessel has."""
    x, y, z = ((surface.vertices - camera.origin) @ camera.rotation).T
    across, down = camera.width / 2 / camera.focal_px * z, camera.height / 2 / camera.focal_px * z
    inside = np.stack((across - x, across + x, down - y, down + y, z)) > 0
    in_view = inside[:, surface.faces].any(axis=2).all(axis=0)  # not wholly beyond one side of the view
    a, b, c = surface.vertices[surface.faces[in_view]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    to_camera = camera.origin - a
    reach = np.linalg.norm(normals, axis=1) * np.linalg.norm(to_camera, axis=1)
    if not (np.einsum("ij,ij->i", normals, to_camera) < -1e-9 * reach).any():
        return False
    # one number a point and an edge: to sort rows takes a hundred times as long
    points, corners = np.unique(surface.vertices @ (1.0, math.pi, math.e), return_inverse=True)
    corners = np.sort(corners.ravel()[surface.faces], axis=1)
    edges = np.concatenate([corners[:, i] * len(points) + corners[:, j] for i, j in ((0, 1), (1, 2), (0, 2))])
    return bool((np.unique(edges, return_counts=True)[1] == 1).any())


def _is_unseen(plugin: Plugin) -> bool:
    """Return whether a shape is a border that light does not see."""
    return [inner.type for inner in plugin.nested("bsdf")] == ["null"]


def _parts(plugin: Plugin) -> list[Plugin]:
    """Return the shapes in a group or merge, or of the group that an instance names."""
    parts = plugin.nested("shape")
    if plugin.type != "instance":
        for part in parts:
            if part.type in ("instance", "shapegroup"):
                raise part.fail(f"a {part.type} inside a {plugin.type}, expected shapes")
        return parts
    if [part.type for part in parts] != ["shapegroup"]:
        raise plugin.fail('expected <ref id="..."/> of one shapegroup')
    return _parts(parts[0])


def _moved(surface: Surface, matrix: np.ndarray) -> Surface:
    """Return a surface moved as a whole: its outside stays outside."""
    faces = surface.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else surface.faces
    normals = None if surface.normals is None else shapes.transform_normals(surface.normals, matrix)
    return replace(surface, vertices=shapes.transform(surface.vertices, matrix), faces=faces, normals=normals)


def _turned(mesh: Mesh) -> Mesh:
    """Return a mesh with its inside out."""
    return replace(mesh, faces=mesh.faces[:, ::-1], normals=None if mesh.normals is None else -mesh.normals)


def _positive(plugin: Plugin, name: str) -> float:
    value = plugin.number(name, 1.0)
    if value <= 0:
        raise plugin.fail(f"{name} {value:g} is not above 0")
    return value


def _placed(mesh: Mesh, plugin: Plugin) -> Mesh:
    """Return the mesh moved by to_world, its faces counterclockwise seen from the side that Mitsuba calls outside."""
    matrix = plugin.transform("to_world")
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    vertices, faces, normals = shapes.transform(mesh.vertices, matrix), mesh.faces, mesh.normals
    if normals is not None:
        normals = shapes.transform_normals(normals, matrix)
        if mirrored and not mesh.keeps_side:
            normals = -normals
    if mirrored and mesh.keeps_side:
        faces = faces[:, ::-1]
    if mesh.smooth and np.isfinite(vertices).all():
        normals = _smooth_normals(vertices, faces)
    if normals is not None:
        normals = shapes.filled_normals(normals, vertices, faces)
    mesh = replace(mesh, vertices=vertices, faces=faces, normals=normals)
    return _turned(mesh) if plugin.boolean("flip_normals", False) else mesh


def _smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertex normals as the mean of the faces around, weighted by the angle each spans."""
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False).vertex_normals


def _project_uv(uv: np.ndarray | None, look: Look) -> np.ndarray | None:
    """Mitsuba's uv, moved as the textures ask, with v upwards as this project has it."""
    if uv is None:
        return None
    if look.to_uv is not None:
        uv = uv @ look.to_uv[:2, :2].T + look.to_uv[:2, 2]
    return _flipped_v(uv)


def _flipped_v(uv: np.ndarray) -> np.ndarray:
    return np.column_stack((uv[:, 0], 1 - uv[:, 1]))
