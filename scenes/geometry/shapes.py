"""Simple shapes as triangles: small pure functions returning (vertices (n, 3), faces (m, 3), uv (n, 2)).

Faces are counterclockwise seen from outside. Texture coordinates follow the project: u to the right, v upwards.
Curved shapes are inscribed: their vertices lie on the true surface, so their area is a little too small (stated each).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache

import numpy as np

Shape = tuple[np.ndarray, np.ndarray, np.ndarray]


def rectangle() -> Shape:
    """Return the square [-1, 1]^2 at z = 0, facing +z."""
    vertices = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype=np.float64)
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int64)
    return vertices, faces, (vertices[:, :2] + 1) / 2


def box(size: Iterable[float] = (2.0, 2.0, 2.0)) -> Shape:
    """Return a box centred on the origin with edges `size` (x, y, z).

    Each side has its own four vertices and uv 0 to 1, upright along +y on the walls.
    """
    vertices, faces, uv = _unit_box()
    return vertices * (np.asarray(tuple(size), dtype=np.float64) / 2), faces.copy(), uv.copy()


@cache
def _unit_box() -> Shape:
    square, faces, uv = rectangle()
    x, y, z = np.eye(3)
    # Image right and image up of each side; right x up points outwards.
    sides = ((x, y), (-x, y), (-z, y), (z, y), (x, -z), (x, z))
    corners = [square[:, :1] * right + square[:, 1:2] * up + np.cross(right, up) for right, up in sides]
    quads = np.concatenate([faces + 4 * side for side in range(6)])
    return np.concatenate(corners), quads, np.tile(uv, (6, 1))


def disk(radius: float = 1.0, segments: int = 64) -> Shape:
    """Return a disk at z = 0 facing +z; u runs from the centre to the rim, v backwards around it (1 at +x).

    Its area is too small by 1 - sin(a)/a with a = 2 pi/segments: 1.6e-3 at 64 segments, 4e-4 at 128.
    """
    turn = np.arange(segments + 1) / segments
    rim = np.column_stack((np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn), np.zeros(segments + 1)))
    rim[-1] = rim[0]
    # One copy of the centre per segment, so that v does not jump inside a triangle.
    vertices = radius * np.concatenate((rim, np.zeros((segments, 3))))
    uv = np.concatenate(
        (
            np.column_stack((np.ones(segments + 1), 1 - turn)),
            np.column_stack((np.zeros(segments), 1 - (turn[:-1] + turn[1:]) / 2)),
        )
    )
    i = np.arange(segments)
    return vertices, np.column_stack((i, i + 1, segments + 1 + i)), uv


def cylinder(
    p0: Iterable[float], p1: Iterable[float], radius: float, *, segments: int = 64, caps: bool = False
) -> Shape:
    """Return the wall of a round cylinder from p0 to p1 and, asked for, its two caps; u around, v from p1 (0) to p0
    (1).

    The wall's area is too small by 1 - sin(a)/a with a = pi/segments: 4e-4 at 64 segments.
    """
    p0, p1 = (np.asarray(tuple(p), dtype=np.float64) for p in (p0, p1))
    length = float(np.linalg.norm(p1 - p0))
    frame = axis_frame((p1 - p0) / length)
    turn = np.arange(segments + 1) / segments
    ring = np.column_stack((np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn), np.zeros(segments + 1)))
    ring[-1] = ring[0]
    ring *= radius
    top = ring + np.array((0, 0, length))
    i = np.arange(segments)
    j = i + segments + 1
    wall = np.concatenate((np.column_stack((i, i + 1, j + 1)), np.column_stack((i, j + 1, j))))
    uv = np.concatenate((np.column_stack((turn, np.ones_like(turn))), np.column_stack((turn, np.zeros_like(turn)))))
    vertices, faces = np.concatenate((ring, top)), wall
    if caps:
        cap, cap_faces, cap_uv = disk(radius, segments)
        first = len(vertices)
        vertices = np.concatenate((vertices, cap, cap + np.array((0, 0, length))))
        faces = np.concatenate((faces, cap_faces[:, ::-1] + first, cap_faces + first + len(cap)))
        uv = np.concatenate((uv, cap_uv, cap_uv))
    return vertices @ frame.T + p0, faces, uv


def sphere(radius: float = 1.0, subdivisions: int = 5) -> Shape:
    """Return a sphere from a repeatedly divided icosahedron; z is the polar axis, u the longitude, v from -z (0) to +z
    (1).

    Vertices are doubled along the seam u = 0 and at the poles. With 5 subdivisions (20,480 faces) the area is too
    small by 3.0e-4, the volume by 5.4e-4, and no point of a face lies deeper than 2.9e-4 radii under the true sphere.
    """
    points, faces, uv = _unit_sphere(subdivisions)
    return radius * points, faces.copy(), uv.copy()


@cache
def _unit_sphere(subdivisions: int) -> Shape:
    points, faces = _icosphere(subdivisions)
    u = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) % 1.0
    v = 1 - np.arccos(np.clip(points[:, 2], -1, 1)) / np.pi
    corner_u = u[faces]
    pole = np.hypot(points[:, 0], points[:, 1])[faces] < 1e-9
    away = np.where(pole, np.nan, corner_u)
    wraps = np.nanmax(away, axis=1) - np.nanmin(away, axis=1) > 0.5
    corner_u += wraps[:, None] & (corner_u < 0.5)
    mean_u = np.where(pole, 0, corner_u).sum(axis=1) / (~pole).sum(axis=1)
    corner_u = np.where(pole, mean_u[:, None], corner_u)
    # A corner is known by its point and its u: equal pairs share a vertex.
    keys = np.column_stack((faces.ravel(), np.round(corner_u.ravel() * 1e9).astype(np.int64)))
    unique, inverse = np.unique(keys, axis=0, return_inverse=True)
    uv = np.column_stack((unique[:, 1] * 1e-9, v[unique[:, 0]]))
    return points[unique[:, 0]], inverse.reshape(-1, 3).astype(np.int64), uv


def axis_frame(direction: np.ndarray) -> np.ndarray:
    """Return rotation whose third column is the unit vector `direction`, the others as in Duff et al. 2017, JCGT
    6(1)."""
    x, y, z = direction
    sign = math.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([(1 + sign * x * x * a, b, x), (sign * b, sign + y * y * a, y), (-sign * x, -y, z)])


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return two triangles a cell of a grid of rows x columns vertices, counterclockwise with columns right and rows
    up."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, up = corner + 1, corner + columns
    return np.stack((corner, right, up + 1, corner, up + 1, up), axis=-1).reshape(-1, 3)


def transform(vertices: np.ndarray, matrix4: np.ndarray) -> np.ndarray:
    """Return points moved by an affine 4x4 matrix."""
    matrix4 = np.asarray(matrix4, dtype=np.float64)
    return np.asarray(vertices, dtype=np.float64) @ matrix4[:3, :3].T + matrix4[:3, 3]


def transform_normals(normals: np.ndarray, matrix4: np.ndarray) -> np.ndarray:
    """Return normals moved by the inverse transpose of a 4x4 matrix, at unit length (a zero normal stays zero)."""
    moved = np.asarray(normals, dtype=np.float64) @ np.linalg.inv(np.asarray(matrix4, dtype=np.float64)[:3, :3])
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    return moved / np.where(length > 0, length, 1)


def filled_normals(normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return vertex normals with those of length 0 replaced by the mean of the faces around, weighted by area."""
    none = np.linalg.norm(normals, axis=1) == 0
    if not none.any():
        return normals
    a, b, c = (vertices[corner] for corner in faces.T)
    around = np.zeros_like(normals)
    for corner in faces.T:
        np.add.at(around, corner, np.cross(b - a, c - a))
    length = np.linalg.norm(around, axis=1, keepdims=True)
    around = np.where(length > 0, around / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
    return np.where(none[:, None], around, normals)


def _icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Build a unit icosahedron with a vertex on each pole, every face split in four `subdivisions` times."""
    longitude = np.arange(5) * 2 * np.pi / 5
    z = 1 / math.sqrt(5)
    upper = np.column_stack((2 * z * np.cos(longitude), 2 * z * np.sin(longitude), np.full(5, z)))
    lower = np.column_stack(
        (2 * z * np.cos(longitude + np.pi / 5), 2 * z * np.sin(longitude + np.pi / 5), np.full(5, -z))
    )
    points = np.concatenate(([(0, 0, 1)], upper, lower, [(0, 0, -1)]))
    i, j = np.arange(5), (np.arange(5) + 1) % 5
    top, bottom = np.zeros(5, np.int64), np.full(5, 11)
    bands = ((top, 1 + i, 1 + j), (1 + i, 6 + i, 1 + j), (1 + j, 6 + i, 6 + j), (6 + i, bottom, 6 + j))
    faces = np.concatenate([np.column_stack(band) for band in bands])
    for _ in range(subdivisions):
        points, faces = _split(points, faces)
    return points, faces


def _split(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every triangle into four, the new vertices on the unit sphere."""
    edges = np.sort(faces[:, ((0, 1), (1, 2), (2, 0))].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middle = points[unique].sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ca = (inverse.reshape(-1, 3) + len(points)).T
    a, b, c = faces.T
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate((points, middle)), np.concatenate([np.column_stack(q) for q in quarters])
