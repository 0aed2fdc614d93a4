"""The triangles of a PLY, with what its vertices, faces and corners carry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.arrays import check_faces
from scenes.errors import InputError, require
from scenes.io.inputs import read_bytes
from scenes.io.mesh_formats import MAX_FRACTION, MAX_LEVEL, NotReadError
from scenes.io.mesh_formats.mesh_files import MAX_TRIANGLES, check_kind, check_vertices
from scenes.io.mesh_formats.mtl import without_mark
from scenes.io.mesh_formats.ply import Element, Lists, Ply, read_ply
from scenes.io.mesh_formats.polygons import triangulated

_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_NO_TEXTURE = -1  # as texnumber


@dataclass(frozen=True)
class PlyMesh:
    """Triangles of a PLY under one texture. What the file lacks is None.

    colours  (n, 3), shares of white, of each vertex or face, as `coloured` says
    image    name of the texture
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    normals: np.ndarray | None
    colours: np.ndarray | None
    coloured: str
    image: str | None = None


@dataclass(frozen=True)
class _Polygons:
    """Polygons of a file: vertices of all their corners in one array, how many corners each has, and what else.

    uv       of the corners (corners, 2)
    colours  (polygons, 3)
    texture  number of the texture of each polygon
    """

    corners: np.ndarray
    lengths: np.ndarray
    uv: np.ndarray | None
    colours: np.ndarray | None
    texture: np.ndarray


def load_ply(path: Path, *, as_mitsuba: bool = False) -> list[PlyMesh]:
    """Return the triangles of a PLY, one mesh a texture; none where it has no faces.

    as_mitsuba  cut polygons into fans from their first corner, even those with dents; look at no texture

    Vertices whose corners have texture coordinates of their own are there once for each of these. Raises InputError in
    one line that begins with the file where it is missing, cut short, or not consistent with what it declares.
    """
    content = without_mark(read_bytes(path, "mesh file"))
    try:
        check_kind(content, ".ply")
        try:
            ply = read_ply(content)
            return _meshes(replace(ply, textures=[]) if as_mitsuba else ply, path.name, as_mitsuba)
        except NotReadError:
            raise
        except InputError as error:
            raise InputError(f"broken .ply file ({error})") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _meshes(ply: Ply, name: str, fans: bool) -> list[PlyMesh]:
    vertex, polygons = ply.elements.get("vertex"), _polygons(ply)
    if vertex is None or polygons is None or not len(polygons.corners):
        return []
    points = vertex.numbers("x", "y", "z")
    if points is None:
        raise InputError("its vertices have no x, y and z")
    check_vertices(points, name)
    check_faces(polygons.corners, len(points), name)
    found = int((polygons.lengths - 2).sum())
    if found > MAX_TRIANGLES:
        raise NotReadError(f"{found} triangles, expected {MAX_TRIANGLES} at most")
    places, owners = triangulated(points, polygons.corners, polygons.lengths, fans=fans)
    textures = np.unique(polygons.texture)
    parts = [polygons.texture[owners] == number for number in textures]
    return [
        replace(_mesh(vertex, points, polygons, places[part], owners[part]), image=_image(ply, number))
        for part, number in zip(parts, textures.tolist(), strict=True)
    ]


def _image(ply: Ply, number: int) -> str | None:
    """Return the name of a texture, by its number."""
    if number == _NO_TEXTURE or not ply.textures:
        return None
    require(0 <= number < len(ply.textures), f"a face's texnumber is {number}, {len(ply.textures)} textures are named")
    return ply.textures[number]


def _mesh(vertex: Element, points: np.ndarray, polygons: _Polygons, places: np.ndarray, owners: np.ndarray) -> PlyMesh:
    """Return the mesh of triangles, each by its three places among the corners of polygons; `owners` are these."""
    corners = polygons.corners[places]
    colours, coloured = _row_colours(vertex), "vertex"
    if colours is None and polygons.colours is not None:
        colours, coloured = polygons.colours[owners], "face"
    normals = vertex.numbers("nx", "ny", "nz")
    uv = next((found for names in _COORDINATES if (found := vertex.numbers(*names)) is not None), None)
    used: np.ndarray | slice = slice(None)
    if polygons.uv is not None and (polygons.texture[owners] != _NO_TEXTURE).all():
        used, first, corners = _split(corners, polygons.uv[places])
        uv = polygons.uv[places].reshape(-1, 2)[first]
    elif len(owners) < int((polygons.lengths - 2).sum()):
        used, corners = np.unique(corners, return_inverse=True)
        uv = None if uv is None else uv[used]
    normals = None if normals is None else normals[used]
    colours = colours[used] if colours is not None and coloured == "vertex" else colours
    return PlyMesh(points[used], corners.reshape(-1, 3), uv, normals, colours, coloured)


def _split(corners: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, one for each of the coordinates that its corners have, as the old vertex of each, the corner
    that each is of, and the faces by them."""
    _, kinds = np.unique(np.ascontiguousarray(uv).view(np.complex128).ravel(), return_inverse=True)
    keys = corners.ravel() * (int(kinds.max()) + 1) + kinds.ravel()
    _, first, faces = np.unique(keys, return_index=True, return_inverse=True)
    return corners.ravel()[first], first, faces


def _polygons(ply: Ply) -> _Polygons | None:
    """Return the polygons of faces, or the triangles of strips; those of fewer than three corners are left out."""
    face, strips = (ply.elements.get(name) for name in ("face", "tristrips"))
    if strips is not None and strips.rows:
        if face is not None and face.rows:
            raise NotReadError("holds faces and triangle strips (tristrips); export it with faces alone")
        triangles = _strip_triangles(_indices(strips))
        count = len(triangles)
        return _Polygons(triangles.ravel(), np.full(count, 3), None, None, np.zeros(count, np.int64))
    if face is None or not face.rows:
        return None
    indices = _indices(face)
    kept = indices.lengths >= 3
    of_corners = np.repeat(kept, indices.lengths)
    numbers = face.numbers("texnumber")
    several = len(ply.textures) > 1 and numbers is None
    require(not several, f"names {len(ply.textures)} textures, and no texnumber says which face has which")
    texture = np.zeros(face.rows, np.int64)
    if numbers is not None and ply.textures:
        texture = _whole(numbers[:, 0], "texnumber")
    uv, given = _corner_coordinates(face, indices.lengths)
    if uv is not None:
        texture = np.where(given, texture, _NO_TEXTURE)
    colours = _row_colours(face)
    return _Polygons(
        indices.values[of_corners],
        indices.lengths[kept],
        None if uv is None else uv[of_corners],
        None if colours is None else colours[kept],
        texture[kept],
    )


def _indices(element: Element) -> Lists:
    """Return the lists of vertices of faces or strips: of the usual names, or the only lists there are."""
    lists = {name: column for name, column in element.columns.items() if isinstance(column, Lists)}
    usual: list[str] = [name for name in ("vertex_indices", "vertex_index") if name in lists]
    named = ", ".join(lists) or "no lists"
    require(len(lists) == 1 or bool(usual), f"its faces have no vertex_indices, but {named}")
    found = lists[usual[0] if usual else named]
    return Lists(_whole(found.values, "vertex"), found.lengths)


def _whole(values: np.ndarray, what: str) -> np.ndarray:
    """Return numbers of a face in int64; InputError for one that is no whole number, or too large."""
    with np.errstate(invalid="ignore"):  # of those
        whole = values.astype(np.int64)
    wrong = np.flatnonzero(whole != values)
    if len(wrong):
        raise InputError(f"a face's {what} is {values[wrong[0]]:.9g}, expected a whole number")
    return whole


def _strip_triangles(strips: Lists) -> np.ndarray:
    """Return the triangles (m, 3) of strips, which -1 ends: each corner makes one with the two before it, turned round
    at every other one. Those that have a corner twice are left out: they lead from one strip to another."""
    values = np.insert(strips.values, np.cumsum(strips.lengths), -1)
    ends = np.flatnonzero(values < 0)
    inside = np.arange(len(values)) - np.concatenate(([-1], ends))[np.searchsorted(ends, np.arange(len(values)))] - 1
    last = np.flatnonzero((values >= 0) & (inside >= 2))
    a, b, c = values[last - 2], values[last - 1], values[last]
    odd = inside[last] % 2 == 1
    triangles = np.column_stack((np.where(odd, b, a), np.where(odd, a, b), c))
    return triangles[(a != b) & (b != c) & (a != c)]


def _corner_coordinates(face: Element, lengths: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the texture coordinates of all corners of faces of so many corners, and which faces have some."""
    lists = face.columns.get("texcoord")
    if not isinstance(lists, Lists) or not lists.lengths.any():
        return None, np.zeros(face.rows, bool)
    given = lists.lengths > 0
    wrong = given & (lists.lengths != 2 * lengths)
    if wrong.any():
        first = int(wrong.argmax())
        raise InputError(f"a face of {lengths[first]} corners has {lists.lengths[first]} numbers as its texcoord")
    uv = np.zeros((int(lengths.sum()), 2))
    uv[np.repeat(given, lengths)] = lists.values.reshape(-1, 2)
    return uv, given


def _row_colours(element: Element) -> np.ndarray | None:
    """Return the colours (n, 3) of an element's rows as shares of white; None where it has none.

    Whole numbers are shares of the most that their type holds, of MAX_LEVEL where they have 32 bits and none is larger.
    Fractions beyond MAX_FRACTION are levels up to MAX_LEVEL too, as some programs write them.
    """
    for names in _COLOURS:
        values = element.numbers(*names)
        if values is not None:
            kind = element.types[names[0]]
            largest = values.max(initial=0.0)
            if kind.kind == "f":
                most = MAX_LEVEL if largest > MAX_FRACTION else 1
            else:
                most = MAX_LEVEL if kind.itemsize >= 4 and largest <= MAX_LEVEL else np.iinfo(kind).max
            return np.nan_to_num(values / most)
    return None
