"""Shapes that are nearly all edge: foliage, rods, rings, lattices, wires, ragged silhouettes, steps.

Each maker returns one shape that fills about the unit ball around the origin, with texture coordinates in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.parts import Random, box, moved, sheet, tube

Maker = Callable[[Random], shapes.Shape]


def merged(parts: Sequence[shapes.Shape]) -> shapes.Shape:
    """Join several shapes to one; each keeps its texture coordinates."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])[:-1]
    faces = [faces + start for start, (_, faces, _) in zip(starts, parts, strict=True)]
    return np.concatenate([part[0] for part in parts]), np.concatenate(faces), np.concatenate([p[2] for p in parts])


def random_rotation(rng: Random) -> np.ndarray:
    """Draw a rotation matrix uniformly, by the QR decomposition of a Gaussian matrix (Mezzadri 2007)."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def rotated(shape: shapes.Shape, rotation: np.ndarray) -> shapes.Shape:
    """Rotate a shape about the origin."""
    return shape[0] @ rotation.T, shape[1], shape[2]


def points_in_ball(rng: Random, count: int) -> np.ndarray:
    """Draw points uniformly in the unit ball, (count, 3)."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.random((count, 1)) ** (1 / 3)


def leaf(rng: Random, length: float) -> shapes.Shape:
    """Return a pointed leaf along +x that bends down, with its two halves folded upwards."""
    s, t = np.linspace(0, 1, 7)[:, None], np.array((-1.0, 0.0, 1.0))
    half = rng.uniform(0.1, 0.35) * np.sin(np.pi * np.clip(s, 0.02, 0.98)) ** rng.uniform(0.6, 1.4)
    height = rng.uniform(-0.5, 0.3) * s**2 + rng.uniform(0.0, 0.5) * half * np.abs(t)
    return sheet(length * np.stack((s + 0 * t, height + 0 * t, half * t), axis=-1))


def foliage(rng: Random) -> shapes.Shape:
    """Return leaves scattered in a ball: from a few large ones to a bush."""
    count = int(np.exp(rng.uniform(np.log(4), np.log(70))))
    length = rng.uniform(0.8, 1.6) * count ** (-1 / 3)
    leaves = [rotated(leaf(rng, length * rng.uniform(0.6, 1.3)), random_rotation(rng)) for _ in range(count)]
    return merged([moved(one, 0.9 * at) for one, at in zip(leaves, points_in_ball(rng, count), strict=True)])


def branch(rng: Random) -> shapes.Shape:
    """Return bent twigs from one foot, with leaves along them."""
    parts = []
    for _ in range(int(rng.integers(2, 6))):
        tip, s = points_in_ball(rng, 1)[0] + (0, 0.6, 0), np.linspace(0, 1, 9)[:, None]
        line = np.array((0, -1.0, 0)) + s * (tip + (0, 1, 0)) + s * (1 - s) * rng.uniform(-0.6, 0.6, 3)
        parts.append(tube(line, rng.uniform(0.008, 0.025), 6))
        for at in line[2:]:
            parts.append(moved(rotated(leaf(rng, rng.uniform(0.15, 0.5)), random_rotation(rng)), at))
    return merged(parts)


def rods(rng: Random) -> shapes.Shape:
    """Return straight rods of any direction, from wires to poles; parallel ones now and then."""
    count, radius = int(rng.integers(2, 14)), np.exp(rng.uniform(np.log(0.008), np.log(0.08)))
    common = random_rotation(rng)[0] if rng.random() < 0.4 else None
    parts = []
    for at in points_in_ball(rng, count):
        along = random_rotation(rng)[0] if common is None else common
        half = rng.uniform(0.5, 1.0) * along
        parts.append(shapes.cylinder(0.6 * at - half, 0.6 * at + half, radius, segments=10, caps=True))
    return merged(parts)


def rings(rng: Random) -> shapes.Shape:
    """Return hoops of any size, through each other."""
    parts, angle = [], np.linspace(0, 2 * np.pi, 37)
    for _ in range(int(rng.integers(1, 6))):
        radius = rng.uniform(0.3, 0.9)
        circle = radius * np.column_stack((np.cos(angle), np.sin(angle), 0 * angle))
        hoop = tube(circle, radius * np.exp(rng.uniform(np.log(0.02), np.log(0.18))), 10)
        parts.append(moved(rotated(hoop, random_rotation(rng)), 0.3 * points_in_ball(rng, 1)[0]))
    return merged(parts)


def lattice(rng: Random) -> shapes.Shape:
    """Return a fence or grid of bars, some of them missing."""
    columns, rows = (int(n) for n in rng.integers(2, 11, 2))
    thick = rng.uniform(0.1, 0.5) / max(columns, rows)
    upright = [box((x - thick, -1, -thick), (x + thick, 1, thick)) for x in np.linspace(-1, 1, columns)]
    level = [box((-1, y - thick, -thick), (1, y + thick, thick)) for y in np.linspace(-1, 1, rows)]
    kept = [bar for bar in (*upright, *level) if rng.random() < 0.9]
    return merged(kept or upright)


def wires(rng: Random) -> shapes.Shape:
    """Build smooth random curves, as cables hang."""
    parts, s = [], np.linspace(0, 1, 40)
    for _ in range(int(rng.integers(1, 6))):
        waves = np.stack([np.sin(np.pi * k * s + rng.uniform(0, 6.3)) / k for k in range(1, 5)])
        line = 0.9 * np.tanh(waves.T @ rng.normal(0, 0.7, (4, 3)))
        parts.append(tube(line, np.exp(rng.uniform(np.log(0.006), np.log(0.04))), 6))
    return merged(parts)


def silhouette(rng: Random) -> shapes.Shape:
    """Return a flat or slightly bent cut-out with a ragged outline: a torn sheet, a rock face, a crown of leaves."""
    count, centre = int(rng.integers(24, 120)), np.zeros((1, 2))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    radius = 0.75 + sum(
        rng.normal(0, 0.35) / k * np.cos(k * angle + rng.uniform(0, 6.3)) for k in range(1, 9)
    ) * rng.uniform(0.3, 1.0)
    radius = np.clip(radius + rng.normal(0, rng.uniform(0, 0.12), count), 0.1, 1.0)
    outline = radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    plane = np.concatenate((centre, outline))
    bend = rng.normal(0, 0.25) * (plane**2).sum(axis=1) + plane @ rng.normal(0, 0.2, 2)
    i = np.arange(count)
    faces = np.column_stack((0 * i, 1 + i, 1 + (i + 1) % count))
    return np.column_stack((plane, bend)), faces, np.clip(0.5 + plane / 2, 0, 1)


def bumps(rng: Random) -> shapes.Shape:
    """Return a lump: a sphere whose radius is a sum of random waves over it."""
    vertices, faces, uv = shapes.sphere(1.0, 4)
    waves = sum(
        rng.normal(0, 0.25) / (1 + k) * np.cos(vertices @ rng.normal(0, 2.0 + k, 3) + rng.uniform(0, 6.3))
        for k in range(6)
    )
    radius = np.clip(0.8 + waves, 0.2, 1.0)[:, None]
    return vertices * radius * rng.uniform(0.4, 1.0, 3), faces, np.clip(uv, 0, 1)


def drapery(rng: Random) -> shapes.Shape:
    """Return a wavy sheet with folds, as a curtain or crumpled paper."""
    u = np.linspace(-1, 1, 33)
    x, y = np.meshgrid(u, u)
    folds = sum(
        rng.normal(0, 0.25) / k * np.cos(k * np.pi * (x * np.cos(a) + y * np.sin(a)) + rng.uniform(0, 6.3))
        for k, a in zip(rng.uniform(0.5, 5, 4), rng.uniform(0, np.pi, 4), strict=True)
    )
    ragged = 1 + rng.uniform(0, 0.3) * np.cos(rng.uniform(2, 12) * y + rng.uniform(0, 6.3))
    points = np.stack((x * ragged, y, folds), axis=-1) * 0.85
    return points.reshape(-1, 3), shapes.grid_faces(33, 33), np.column_stack(((x.ravel() + 1) / 2, (y.ravel() + 1) / 2))


def steps(rng: Random) -> shapes.Shape:
    """Return boxes side by side at depths that differ by a few per cent to half of their size."""
    edges = np.unique(np.round(np.concatenate(([-1, 1], rng.uniform(-1, 1, int(rng.integers(1, 7))))), 3))
    rise = np.exp(rng.uniform(np.log(0.03), np.log(0.5)))
    parts = [
        box((left, -rng.uniform(0.3, 1), -0.6), (right, rng.uniform(0.3, 1), rise * rng.uniform(-1, 1)))
        for left, right in pairwise(edges)
    ]
    return merged(parts)


def blocks(rng: Random) -> shapes.Shape:
    """Return boxes of any proportion, tumbled."""
    parts = []
    for at in 0.6 * points_in_ball(rng, int(rng.integers(1, 8))):
        half = np.exp(rng.uniform(np.log(0.05), np.log(0.5), 3))
        parts.append(moved(rotated(box(-half, half), random_rotation(rng)), at))
    return merged(parts)


MAKERS: tuple[Maker, ...] = (
    foliage, branch, rods, rings, lattice, wires, silhouette, bumps, drapery, steps, blocks,
)  # fmt: skip
