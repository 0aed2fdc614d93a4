"""A bare room with six finely meshed bodies: indirect light and round silhouettes, no thin structure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scenes.geometry import shapes
from scenes.model import Camera, Material, Scene, Surface

ROOM_M = (6.0, 3.0, 9.0)  # width, height, depth
BACK_M = 5.5  # the camera is 2.3 m before the wall behind it
EYE_M, TARGET_M = (0.0, 1.5, 3.2), (0.0, 1.2, -3.5)
FOV_DEG = 60.0
_SIDES = (
    ("far side", 0.6),
    ("near side", 0.6),
    ("right wall", 0.5),
    ("left wall", 0.5),
    ("ceiling", 0.7),
    ("floor", 0.3),
)
SUBDIVISIONS = 5  # 20 x 4^5 faces a body


def _petals(directions: np.ndarray) -> np.ndarray:
    return np.cos(5 * np.arctan2(directions[:, 1], directions[:, 0]))


# name, albedo, centre [m], radius [m], radius over the direction (x, y, z)
_BODIES: tuple[tuple[str, float, tuple[float, float, float], float, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("ball", 0.75, (-1.9, 0.6, -0.9), 0.6, lambda d: np.ones(len(d))),
    ("egg", 0.45, (1.7, 0.75, -0.6), 0.6, lambda d: 1 + 0.25 * d[:, 1]),
    ("pear", 0.6, (0.15, 0.55, 0.2), 0.45, lambda d: 1 + 0.3 * d[:, 1] * d[:, 0] ** 2 - 0.2 * d[:, 1]),
    ("star", 0.3, (0.4, 1.9, -2.0), 0.5, lambda d: 1 + 0.15 * _petals(d) * (1 - d[:, 2] ** 2)),
    ("cushion", 0.85, (-1.0, 1.7, -2.6), 0.55, lambda d: 0.8 / np.sum(np.abs(d) ** 6, axis=1) ** (1 / 6)),
    ("pebble", 0.2, (2.0, 2.0, -2.4), 0.5, lambda d: 1 + 0.12 * np.sin(4 * d[:, 0]) * np.cos(3 * d[:, 1] + d[:, 2])),
)


def gallery(*, width: int, height: int) -> Scene:
    """Return six bodies of 20,480 faces each, on the floor and hanging, in a closed room of albedo 0.3 to 0.7."""
    surfaces = list(_walls())
    directions, faces, uv = shapes.sphere(subdivisions=SUBDIVISIONS)
    for name, albedo, centre, radius, profile in _BODIES:
        points = radius * profile(directions)[:, None] * directions + np.array(centre)
        surfaces.append(Surface(points, faces, Material(name=name, albedo=albedo), uv=uv, name=name))
    camera = Camera.look_at(EYE_M, TARGET_M, fov_deg=FOV_DEG, width=width, height=height)
    return Scene("gallery", tuple(surfaces), camera)


def _walls() -> tuple[Surface, ...]:
    vertices, faces, uv = shapes.box(ROOM_M)
    vertices = vertices + (0, ROOM_M[1] / 2, BACK_M - ROOM_M[2] / 2)
    surfaces = []
    for side, (name, albedo) in enumerate(_SIDES):
        corners = slice(4 * side, 4 * side + 4)
        material = Material(name=name, albedo=albedo)
        # seen from inside: surfaces scatter on both sides
        surfaces.append(Surface(vertices[corners], faces[:2], material, uv=uv[corners], name=name))
    return tuple(surfaces)
