"""What tests ask of a scene's triangles, in numpy: first hits of rays, edges that one face alone has."""

import numpy as np

from scenes import Scene, Surface


def hit_distances(scene: Scene, rays: np.ndarray) -> np.ndarray:
    """Distance from the camera to the first triangle along each ray (n, 3), inf for none (Moeller and Trumbore)."""
    a, b, c = np.concatenate([s.vertices[s.faces] for s in scene.surfaces]).transpose(1, 0, 2)
    side, other, start = b - a, c - a, scene.camera.origin - a
    # every triple product as a ray times one vector per triangle
    to_det, to_u, to_v = (-np.cross(side, other), np.cross(other, start), np.cross(start, side))
    along = (other * to_v).sum(axis=1)
    nearest = []
    for some in np.array_split(rays, max(1, len(rays) // 32)):
        det = some @ to_det.T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = some @ to_u.T / det, some @ to_v.T / det, along / det
            # a hair of slack: a ray through the edge that two walls share must not slip between them
            hit = (np.abs(det) > 1e-12) & (u > -1e-9) & (v > -1e-9) & (u + v < 1 + 1e-9) & (t > 1e-6)
        nearest.append(np.where(hit, t, np.inf).min(axis=1))
    return np.concatenate(nearest)


def open_edges(surfaces: list[Surface]) -> int:
    """Directed edges that no neighbour runs the other way, vertices within 0.1 um being one: 0 for closed bodies."""
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    points = np.concatenate([s.vertices for s in surfaces])
    _, same = np.unique(np.round(points, 7) + 0.0, axis=0, return_inverse=True)
    faces = same.ravel()[np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=True)])]
    edges = faces[:, ((0, 1), (1, 2), (2, 0))]
    edges = edges[(edges[..., 0] != edges[..., 1]).all(axis=1)].reshape(-1, 2)  # poles have faces without area
    ways = [edges @ (len(points), 1), edges @ (1, len(points))]
    names = np.unique(np.concatenate(ways))
    there, back = (np.bincount(np.searchsorted(names, way), minlength=len(names)) for way in ways)
    return int((there != back).sum())


def volume(surface: Surface) -> float:
    """Volume of a closed body whose faces look outwards."""
    a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)
