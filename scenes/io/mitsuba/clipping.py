"""Find surfaces that a camera's clipping planes would cut."""

from __future__ import annotations

import numpy as np

from scenes.model import Camera, Surface

NEAREST = 1e-3  # of the near plane: what goes through the camera itself is not looked for


def is_cut(surface: Surface, camera: Camera, near_m: float, far_m: float) -> bool:
    """Return whether a part of a surface lies in the field of view nearer than one plane, or beyond another."""
    seen = (surface.vertices - camera.origin) @ camera.rotation
    farthest_m = float(seen[:, 2].max(initial=0.0))
    triangles = seen[surface.faces]
    slices = ((NEAREST * near_m, near_m), (far_m, 2 * farthest_m))
    return any(low < high and _meets(triangles, camera, low, high) for low, high in slices)


def _meets(triangles: np.ndarray, camera: Camera, low_m: float, high_m: float) -> bool:
    """Tell whether a triangle (n, 3, 3) in the camera's frame and the view between two planes share a point: whether no
    axis separates them."""
    depth = triangles[..., 2]
    triangles = triangles[(depth.min(axis=1) < high_m) & (depth.max(axis=1) > low_m)]
    x, y = camera.width / 2 / camera.focal_px, camera.height / 2 / camera.focal_px
    rims = np.array([(x, y, 1), (-x, y, 1), (-x, -y, 1), (x, -y, 1)])
    corners = np.concatenate([low_m * rims, high_m * rims])
    sides = np.cross(rims, np.roll(rims, 1, axis=0))
    triangles = triangles[~_are_apart(triangles, corners, np.broadcast_to(sides, (len(triangles), 4, 3)))]
    edges = triangles - np.roll(triangles, 1, axis=1)
    along = np.concatenate([rims, [(1.0, 0, 0), (0, 1.0, 0)]])
    axes = np.cross(edges[:, :, None], along).reshape(len(triangles), 3 * len(along), 3)
    axes = np.concatenate([axes, np.cross(edges[:, 0], edges[:, 1])[:, None]], axis=1)
    return bool((~_are_apart(triangles, corners, axes)).any())


def _are_apart(triangles: np.ndarray, corners: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Tell, per triangle (n, 3, 3), whether one of its axes (n, a, 3) separates it from the hull of corners (c, 3)."""
    of_triangle = np.einsum("nak,nck->nac", axes, triangles)
    of_hull = np.einsum("nak,ck->nac", axes, corners)
    below = of_triangle.max(axis=2) < of_hull.min(axis=2)
    return (below | (of_triangle.min(axis=2) > of_hull.max(axis=2))).any(axis=1)
