"""Random slanted planes as transients in closed form: a training set that needs no renderer.

A scene is one plane behind another that covers a part of the view, each of its own albedo, under a scanning laser: one
return a pixel, of radiance albedo cos / (pi d^2), uniform over the depths that the pixel's footprint spans.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from csph.training.views import Views
from render.transient import Transient
from scenes.errors import require
from scenes.random_streams import Stream

NEAR_M, FAR_M = 0.6, 8.0  # of the point that a plane has on the camera's axis
BEYOND_M = 12.0  # no plane is seen from here on
FOV_DEG = 60.0


class Plane(NamedTuple):
    """normal (3,) towards the camera, which looks along +z; `height_m` of the camera over the plane; albedo."""

    normal: np.ndarray
    height_m: float
    albedo: float

    def facing(self, rays: np.ndarray) -> np.ndarray:
        """Return cosine of incidence, negative from behind."""
        return -(rays @ self.normal)

    def distance_m(self, rays: np.ndarray) -> np.ndarray:
        """Return along unit rays; infinite where the plane is not met before BEYOND_M."""
        facing = self.facing(rays)
        distance = self.height_m / np.maximum(facing, 1e-6)
        return np.where((facing > 0) & (distance < BEYOND_M), distance, np.inf)


def random_planes(count: int, *, size: int = 64, seed: int = 0) -> Views:
    """Return `count` scenes of two random planes, size x size pixels.

    Raises InputError for a count below 1, or a size below 2: a pixel as wide as the view often sees no plane in full.
    """
    require(count >= 1, f"planes: {count} scenes, expected 1 or more")
    require(size >= 2, f"planes: images of {size} x {size} pixels, expected 2 x 2 or more")
    scenes = [
        _scene(size, np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.PLANES, number))))
        for number in range(count)
    ]
    return Views(tuple(scenes), tuple(f"planes/{number}" for number in range(count)))


def _plane(rng: np.random.Generator) -> Plane:
    normal = np.array([*rng.normal(0, 0.45, 2), -1.0])
    normal /= np.linalg.norm(normal)
    depth = math.exp(rng.uniform(math.log(NEAR_M), math.log(FAR_M)))
    return Plane(normal, -depth * normal[2], rng.uniform(0.15, 0.9))


def _rays(edges: np.ndarray) -> np.ndarray:
    rays = np.stack([*np.meshgrid(edges, edges), np.ones((len(edges), len(edges)))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _scene(size: int, rng: np.random.Generator) -> Transient:
    side = math.tan(math.radians(FOV_DEG) / 2)
    edges = np.linspace(-side, side, size + 1)
    centres, corners = _rays((edges[1:] + edges[:-1]) / 2), _rays(edges)
    front, behind = _plane(rng), _plane(rng)
    towards, shift = rng.normal(size=2), rng.normal(0, 0.3)
    covered = centres[..., :2] @ (towards / np.linalg.norm(towards)) > shift
    depth, spread, radiance, albedo = np.full((size, size), np.inf), *np.zeros((3, size, size))
    for plane, where in ((front, covered), (behind, True)):
        distance, around = plane.distance_m(centres), plane.distance_m(corners)
        four = np.stack([around[:-1, :-1], around[1:, :-1], around[:-1, 1:], around[1:, 1:]])
        seen = where & (distance < depth) & np.isfinite(four).all(0)
        depth[seen] = distance[seen]
        spread[seen] = np.ptp(four[:, seen], axis=0)
        radiance[seen] = (plane.albedo * plane.facing(centres) / math.pi)[seen] / distance[seen] ** 2
        albedo[seen] = plane.albedo
    return _transient(depth, spread, radiance, albedo)


def _transient(depth: np.ndarray, spread: np.ndarray, radiance: np.ndarray, albedo: np.ndarray) -> Transient:
    """One return a pixel, laid symmetrically about the pixel centre's depth; none where depth is infinite."""
    met = np.isfinite(depth)
    spread = np.minimum(spread, 2 * depth)  # a wide pixel of a steep plane: nothing returns from behind the camera
    size = depth.shape[0]
    columns = {
        "path_near_m": 2 * depth[met] - spread[met],
        "path_far_m": 2 * depth[met] + spread[met],
        "radiance": radiance[met],
    }
    return Transient(
        size,
        size,
        np.concatenate(([0], np.cumsum(met.ravel()))),
        **{name: values.astype(np.float32) for name, values in columns.items()},
        bounces=np.ones(int(met.sum()), np.uint8),
        depth_m=np.where(met, depth, np.nan).astype(np.float32),
        normal=np.zeros((size, size, 3), np.float16),
        albedo=albedo.astype(np.float16),
        ambient=albedo.astype(np.float32),
        mixed=np.zeros((size, size), bool),
        error=np.zeros((size, size), np.float32),
        meta={"scene": "planes"},
    )


def wall(depth_m: float, size: int = 32) -> Transient:
    """Return a wall of `size` x `size` pixels all of which are `depth_m` away: one return a pixel, of one length."""
    require(depth_m > 0 and size >= 1, f"wall: {size} pixels at {depth_m:g} m, expected positive numbers")
    even = np.ones((size, size))
    return _transient(depth_m * even, 0 * even, even, 0.5 * even)
