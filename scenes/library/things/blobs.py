"""Free-form things as implicit surfaces made triangles by marching cubes: toys, bags, stones, antlers, roots."""

from __future__ import annotations

import numpy as np

from scenes.geometry import shapes
from scenes.library.things.parts import Random

CELLS = 26  # marching-cubes cells along the longest edge
LEVEL = 1.0
REACH = 1.8  # there a ball's field is 1e-4


def blend(points: np.ndarray, radii: np.ndarray, cells: int = CELLS) -> shapes.Shape:
    """Return the surface f(x) = sum_i exp(4 (1 - |x - c_i|^2 / r_i^2)) = 1: balls that melt into each other where they
    meet.

    points (n, 3), radii (n,). A lone ball keeps its radius. Faces look outwards; texture coordinates are the longitude
    and height. Shading normals are left to the caller: vertices are shared, so means over faces are smooth.
    """
    from skimage.measure import marching_cubes

    reach = 1.25 * radii[:, None]
    low, high = (points - reach).min(axis=0), (points + reach).max(axis=0)
    step = float((high - low).max()) / cells
    counts = np.ceil((high - low) / step).astype(int) + 1
    axes = [low[i] + step * np.arange(counts[i]) for i in range(3)]
    # one ball's field is a product of three one-dimensional ones, and next to nothing beyond REACH radii
    x, y, z = (_falls(axes[i] - points[:, i, None], radii[:, None], step) for i in range(3))
    across = (y[:, :, None] * z[:, None, :]).reshape(len(points), -1)
    field = (np.exp(4.0) * x.T @ across).reshape(counts)
    vertices, faces, _, _ = marching_cubes(field, LEVEL, spacing=(step, step, step), gradient_direction="ascent")
    vertices = vertices.astype(np.float64) + low
    middle = vertices.mean(axis=0)
    u = np.arctan2(vertices[:, 2] - middle[2], vertices[:, 0] - middle[0]) / (2 * np.pi) + 0.5
    v = (vertices[:, 1] - vertices[:, 1].min()) / max(np.ptp(vertices[:, 1]), 1e-9)
    return vertices, faces.astype(np.int64), np.column_stack((u, v))


def _falls(away: np.ndarray, radius: np.ndarray, step: float) -> np.ndarray:
    """One-dimensional field at distances from a ball's centre; 0 from a grid step beyond its reach on."""
    return np.where(np.abs(away) < REACH * radius + step, np.exp(-4 * (away / radius) ** 2), 0.0)


def standing(shape: shapes.Shape, height: float) -> shapes.Shape:
    """Return a shape scaled to that height, on y = 0, its middle at x = z = 0."""
    vertices, faces, uv = shape
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    base = np.array(((low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2))
    return (vertices - base) * (height / (high[1] - low[1])), faces, uv


def toy(rng: Random, height: float) -> shapes.Shape:
    """Return a sitting soft animal: belly, head, ears, arms and legs."""
    ear = rng.uniform(0.1, 0.2)
    apart = rng.uniform(0.16, 0.26)
    balls: list[tuple[float, float, float, float]] = [(0, 0.32, 0, 0.3), (0, 0.75, 0.02, 0.22), (0, 0.7, 0.2, 0.1)]
    for side in (-1, 1):
        balls += [(side * apart, 0.95 + rng.uniform(0, 0.12), 0, ear), (side * 0.3, 0.42, 0.12, 0.12)]
        balls += [(side * 0.36, 0.33, 0.24, 0.1), (side * 0.2, 0.1, 0.3, 0.14), (side * 0.24, 0.1, 0.46, 0.12)]
    table = np.array(balls)
    return standing(blend(table[:, :3], table[:, 3]), height)


def bag(rng: Random, height: float) -> shapes.Shape:
    """Return a sack, cushion or heap of clothes: a few balls side by side."""
    count = int(rng.integers(5, 9))
    points = rng.uniform((-0.5, 0, -0.35), (0.5, 0.5, 0.35), (count, 3))
    return standing(blend(points, rng.uniform(0.25, 0.42, count), 22), height)


def stone(rng: Random, height: float) -> shapes.Shape:
    """Return a lump or a modern sculpture: balls in a winding column."""
    count = int(rng.integers(4, 9))
    turn = rng.uniform(0, 2 * np.pi) + np.arange(count) * rng.uniform(0.5, 1.6)
    sway = rng.uniform(0.05, 0.35)
    points = np.column_stack((sway * np.cos(turn), 0.35 * np.arange(count), sway * np.sin(turn)))
    return standing(blend(points, rng.uniform(0.25, 0.5, count), 30), height)


def branching(rng: Random, height: float, tines: int = 5, thick: float = 0.05) -> shapes.Shape:
    """Return an antler or a root: a bent beam with tines, ever thinner, of overlapping balls."""
    t = np.linspace(0, 1, 60)
    bend = rng.uniform(0.25, 0.5)
    beam = np.column_stack((bend * t**2, t, 0.2 * np.sin(2.5 * t) * rng.uniform(-1, 1)))
    points, radii = [beam], [thick * (1.0 - 0.6 * t)]
    for _ in range(tines):
        root = int(rng.integers(9, 50))
        direction = rng.normal(0, 1, 3) * (1, 0.3, 1) + (0.3, 0.9, 0)
        direction *= rng.uniform(0.22, 0.42) / np.linalg.norm(direction)
        s = np.linspace(0, 1, 34)[1:, None]
        points.append(beam[root] + s * direction + s**2 * (0, 0.1, 0))
        radii.append(thick * (0.7 - 0.35 * s[:, 0]))
    return standing(blend(np.concatenate(points), np.concatenate(radii), 48), height)


def rounded_box(
    size: np.ndarray | tuple[float, float, float], power: float = 4.0, subdivisions: int = 3
) -> shapes.Shape:
    """Return a superellipsoid |x/a|^p + |y/b|^p + |z/c|^p = 1 with edges `size`, standing on y = 0: pillows,
    cushions."""
    directions, faces, uv = shapes.sphere(1.0, subdivisions)
    radius = (np.abs(directions) ** power).sum(axis=1, keepdims=True) ** (-1 / power)
    half = np.asarray(size, float) / 2
    return directions * radius * half + (0, half[1], 0), faces, uv
