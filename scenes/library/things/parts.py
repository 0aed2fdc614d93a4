"""Building blocks of procedural scenes: boxes, turned and swept shapes, sheets, and pieces that are set down.

A piece of furniture is built around its own origin, standing on y = 0 with its front towards +z. Lengths are metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from scenes.geometry import shapes
from scenes.geometry.shapes import grid_faces
from scenes.model import Material, Surface

Random = np.random.Generator
Vector: TypeAlias = Sequence[float] | np.ndarray
Palette = dict[str, Material]  # one object per paint, cloth or wood, shared by all that is made of it


@dataclass(frozen=True, eq=False)
class Piece:
    """Something that can be set down as a whole, and the level places on it that smaller things may stand on.

    tops: rows of x, z, half width, half depth and height y of each such place.
    """

    surfaces: tuple[Surface, ...]
    tops: tuple[tuple[float, float, float, float, float], ...] = ()

    @cached_property
    def low(self) -> np.ndarray:
        return np.min([s.vertices.min(axis=0) for s in self.surfaces], axis=0)

    @cached_property
    def high(self) -> np.ndarray:
        return np.max([s.vertices.max(axis=0) for s in self.surfaces], axis=0)


def box(low: Vector, high: Vector) -> shapes.Shape:
    """Return an axis-aligned box between two corners."""
    ends = np.asarray(low, float), np.asarray(high, float)
    vertices, faces, uv = shapes.box(ends[1] - ends[0])
    return vertices + (ends[0] + ends[1]) / 2, faces, uv


def post(x: float, z: float, half: float, bottom: float, top: float) -> shapes.Shape:
    """Return an upright square post around (x, z)."""
    return box((x - half, bottom, z - half), (x + half, top, z + half))


def panel(centre: Vector, half_right: Vector, half_up: Vector, tile_m: float | None = None) -> shapes.Shape:
    """Return a rectangle seen from the side where its first half edge points right and its second up.

    Its texture fills it once, or repeats every `tile_m` metres.
    """
    right, up = np.asarray(half_right, float), np.asarray(half_up, float)
    square, faces, uv = shapes.rectangle()
    if tile_m is not None:
        uv = uv * (2 * np.linalg.norm(right) / tile_m, 2 * np.linalg.norm(up) / tile_m)
    return np.asarray(centre, float) + square[:, :1] * right + square[:, 1:2] * up, faces, uv


def joined(name: str, material: Material, *parts: shapes.Shape, emission: float = 0.0) -> Surface:
    """Return several shapes as one surface."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts[:-1]])
    return Surface(
        np.concatenate([vertices for vertices, _, _ in parts]),
        np.concatenate([faces + start for start, (_, faces, _) in zip(starts, parts, strict=True)]),
        material,
        uv=np.concatenate([uv for _, _, uv in parts]),
        emission=emission,
        name=name,
    )


def placed(surfaces: list[Surface], x: float, z: float, *, y: float = 0.0, turn_deg: float = 0.0) -> list[Surface]:
    """Return a piece of furniture turned about the vertical (positive: its front from +z towards +x) and set down."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    pose = np.array(((c, 0, s, x), (0, 1, 0, y), (-s, 0, c, z), (0, 0, 0, 1)))
    moved = []
    for surface in surfaces:
        normals = None if surface.normals is None else shapes.transform_normals(surface.normals, pose)
        moved.append(replace(surface, vertices=shapes.transform(surface.vertices, pose), normals=normals))
    return moved


def smooth_normals(points: np.ndarray, key: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return area-weighted normals per vertex; vertices of equal `key` (the doubled seam of a sphere) share one
    normal."""
    _, same = np.unique(np.round(key, 9) + 0.0, axis=0, return_inverse=True)
    a, b, c = points[faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    total = np.zeros((same.max() + 1, 3))
    for corner in faces.T:
        np.add.at(total, same.ravel()[corner], across)
    normals = total[same.ravel()]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def lathe(profile: Sequence[Vector], segments: int = 24) -> shapes.Shape:
    """Return the surface that a profile of (radius, height) points sweeps around the y axis; u around, v along the
    profile.

    A profile that rises has its outside outside. Points lie on the true surface of revolution.
    """
    points = np.asarray(profile, float)
    turn = np.linspace(0, 2 * np.pi, segments + 1)
    turn[-1] = 0.0
    ring = np.column_stack((np.cos(turn), np.sin(turn)))
    radius, height = np.repeat(points[:, 0], segments + 1), np.repeat(points[:, 1], segments + 1)
    around = np.tile(ring, (len(points), 1))
    vertices = np.column_stack((radius * around[:, 0], height, -radius * around[:, 1]))
    v, u = np.meshgrid(np.linspace(0, 1, len(points)), np.linspace(0, 1, segments + 1), indexing="ij")
    return vertices, grid_faces(len(points), segments + 1), np.column_stack((u.ravel(), v.ravel()))


def creased(profile: Sequence[Vector], sharpest_deg: float = 35.0) -> list[Vector]:
    """Return a profile for `lathe` whose sharp corners are there twice, so that each side has shading normals of its
    own."""
    points = np.asarray(profile, float)
    along = np.arctan2(*np.diff(points, axis=0).T[::-1])
    bend = np.abs((np.diff(along) + np.pi) % (2 * np.pi) - np.pi)
    twice = np.concatenate(([False], bend > math.radians(sharpest_deg), [False]))
    return [tuple(point) for point in np.repeat(points, 1 + twice, axis=0)]


def solid(profile: Sequence[Vector], segments: int = 24) -> shapes.Shape:
    """Return `lathe` with creases: a turned body, closed where its profile begins and ends on the axis."""
    return lathe(creased(profile), segments)


def tube(points: np.ndarray, radius: float, segments: int = 8) -> shapes.Shape:
    """Return a round wire of that radius along a polyline (n, 3), without caps; its frame is carried along without
    twist."""
    points = np.asarray(points, float)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    frame = shapes.axis_frame(along[0])
    across = [frame[:, 0]]
    for direction in along[1:]:
        side = across[-1] - direction * (direction @ across[-1])
        across.append(side / np.linalg.norm(side))
    first = np.array(across)
    second = np.cross(along, first)
    turn = np.linspace(0, 2 * np.pi, segments + 1)
    turn[-1] = 0.0
    rings = points[:, None] + radius * (
        np.cos(turn)[:, None] * first[:, None] + np.sin(turn)[:, None] * second[:, None]
    )
    v, u = np.meshgrid(np.linspace(0, 1, len(points)), np.linspace(0, 1, segments + 1), indexing="ij")
    return rings.reshape(-1, 3), grid_faces(len(points), segments + 1), np.column_stack((u.ravel(), v.ravel()))


def rod(points: np.ndarray, radius: float, segments: int = 12) -> shapes.Shape:
    """Return `tube` with flat caps: a closed body."""
    vertices, faces, uv = tube(points, radius, segments)
    ends = np.asarray(points, float)[[0, -1]]
    first, last = np.arange(segments + 1), np.arange(-segments - 1, 0) + len(vertices)
    start = len(vertices)
    rims = np.concatenate((vertices[first], vertices[last], ends))
    around, middle = np.arange(segments), 2 * (segments + 1)
    low = np.column_stack((around + 1, around, np.full(segments, middle)))
    high = np.column_stack((around, around + 1, np.full(segments, middle + 1))) + (segments + 1, segments + 1, 0)
    caps = np.concatenate((low, high)) + start
    return (
        np.concatenate((vertices, rims)),
        np.concatenate((faces, caps)),
        np.concatenate((uv, np.zeros((len(rims), 2)))),
    )


def cloth(points: np.ndarray, thickness: Vector) -> shapes.Shape:
    """Return a `sheet` seen from its front, its back moved by `thickness`, and the seams between them: a closed
    body."""
    front = np.asarray(points, float)
    back = front + np.asarray(thickness, float)
    around = np.concatenate((front, back[::-1], front[:1]))
    sides = (np.stack((back[:, 0], front[:, 0]), axis=1), np.stack((front[:, -1], back[:, -1]), axis=1))
    parts = [sheet(around), *map(sheet, sides)]
    starts = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts[:-1]])
    faces = [faces + start for start, (_, faces, _) in zip(starts, parts, strict=True)]
    return np.concatenate([p[0] for p in parts]), np.concatenate(faces), np.concatenate([p[2] for p in parts])


def sheet(points: np.ndarray) -> shapes.Shape:
    """Return a grid of points (rows, columns, 3) as triangles, seen from where columns run right and rows run up."""
    rows, columns = points.shape[:2]
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return (
        points.reshape(-1, 3).astype(float),
        grid_faces(rows, columns),
        np.column_stack((u.ravel(), v.ravel())),
    )


def turned(shape: shapes.Shape, axis: str, degrees: float, by: Vector = (0.0, 0.0, 0.0)) -> shapes.Shape:
    """Return a shape turned about an axis through the origin (right-handed), then moved."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[i, i], rotation[i, j], rotation[j, i], rotation[j, j] = c, -s, s, c
    vertices, faces, uv = shape
    return vertices @ rotation.T + np.asarray(by, float), faces, uv


def moved(shape: shapes.Shape, by: Vector) -> shapes.Shape:
    return shape[0] + np.asarray(by, float), shape[1], shape[2]


def with_normals(surfaces: Sequence[Surface], brightness: float = 1.0) -> list[Surface]:
    """Return the surfaces with shading normals, area-weighted means over the faces that share a vertex; their emission
    scaled.

    Where corners have vertices of their own, as on a box, that is the face's own normal. Surfaces that have normals
    keep them. All are worked on at once: a room has a hundred small ones.
    """
    bare = [surface for surface in surfaces if surface.normals is None]
    found = iter(_mean_normals(bare) if bare else ())
    shaded = []
    for surface in surfaces:
        normals = next(found) if surface.normals is None else surface.normals
        shaded.append(replace(surface, normals=normals, emission=brightness * surface.emission))
    return shaded


def _mean_normals(surfaces: Sequence[Surface]) -> list[np.ndarray]:
    starts = np.cumsum([0] + [len(surface.vertices) for surface in surfaces])
    points = np.concatenate([surface.vertices for surface in surfaces])
    faces = np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts[:-1], strict=True)])
    a = points[faces[:, 0]]
    (ux, uy, uz), (vx, vy, vz) = (points[faces[:, 1]] - a).T, (points[faces[:, 2]] - a).T
    across = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
    total = np.column_stack(
        [sum(np.bincount(corner, part, len(points)) for corner in faces.T) for part in across],
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 0, total / np.where(length > 0, length, 1), (0.0, 1.0, 0.0))
    return np.split(normals, starts[1:-1])
