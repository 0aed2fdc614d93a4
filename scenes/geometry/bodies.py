"""Closed bodies in a mesh, and which sides of their faces can be seen from a point. Plain numpy and scipy."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

ROUNDING = 1e-6  # of a volume and an angle


def visible_sides(vertices: np.ndarray, faces: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the side of every face that light from `point` may reach, (F,): 1 that of its normal, -1 the other, 0
    both.

    A body is what faces with common corners make up. It is closed where each of its edges has as many faces that run
    along it one way as the other way. Light from outside a closed body reaches its outer sides alone, light from inside
    its inner sides alone. Of an open body, of one without volume and of one on which `point` lies it may reach both.

    Parameters
    ----------
    vertices : (V, 3)
    faces : (F, 3) corners; normals by the right hand
    point : (3,)
    """
    _, name = np.unique(vertices, axis=0, return_inverse=True)
    corner = name.reshape(-1)[faces]
    count = int(corner.max(initial=-1)) + 1
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    links = coo_array((np.ones(len(start)), (start, end)), shape=(count, count))
    bodies, body_of = connected_components(links, directed=False)
    body = body_of[corner[:, 0]]
    surplus = (links - links.T).tocoo()  # zero where both ways are as many
    is_open = np.bincount(body_of[surplus.row], surplus.data != 0, bodies) > 0
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    six_volumes = (a * np.cross(b, c)).sum(axis=1)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    below = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    # half the solid angle of a triangle (van Oosterom, Strackee 1983): those of a body make 2 pi around a point inside
    half_angle = np.arctan2(six_volumes, below)
    turns = np.bincount(body, half_angle, bodies) / (2 * np.pi)
    touched = np.bincount(body, np.abs(half_angle) > np.pi - ROUNDING, bodies) > 0
    touched |= np.abs(turns - np.round(turns)) > ROUNDING
    volume, most = np.bincount(body, six_volumes, bodies), np.bincount(body, np.abs(six_volumes), bodies)
    outwards = np.sign(volume) * (np.abs(volume) > ROUNDING * most)
    side = np.where(np.abs(turns) > 0.5, -outwards, outwards)
    return np.where(is_open | touched, 0, side).astype(int)[body]
