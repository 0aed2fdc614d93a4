"""Trace transients in the plainest way: read this first, then `render.direct` and `render.indirect`.

Two routes that share nothing with the fast ones but single rays and Mitsuba's materials. `path_traced` is a transient
path tracer with one connection to the laser at every vertex: unbiased, slow, without reuse, cells, filter or light
paths. `ray_grid` is direct light by brute force: a grid of rays in each pixel, each a point of light at its exact path.
Slow and plain on purpose. Only tests and benches import this module.
"""

from __future__ import annotations

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.scene.rays import camera_rays, first_opaque, laser_leg, spawn
from render.scene.traced_scene import Float, TracedScene, UInt32, dr, mi
from scenes.model import Scene

MAX_PATHS = 1 << 18  # of one launch


def path_traced(scene: Scene, edges_m: np.ndarray, *, bounces: int, spp: int, seed: int = 0) -> np.ndarray:
    """Estimate the radiance of each pixel over path length by plain path tracing.

    Parameters
    ----------
    scene : what to trace; no mirror and no sharp image of the laser can be found by this route
    edges_m : (T + 1,) edges of intervals of the optical path from laser over surfaces to camera [m]
    bounces : surfaces on a path, at most; 1 is direct light
    spp : paths a pixel

    Returns
    -------
    (H, W, T) float64 time-integrated radiance per joule [1/(m^2 sr)] in each interval
    """

    def jittered(number: UInts, launch: int) -> tuple[Array, Array, Array]:
        # opaque: a number in the kernel's text would compile it anew for every launch
        random = mi.PCG32(dr.width(number), initstate=dr.opaque(mi.UInt64, seed * 1_000_003 + launch))
        return random.next_float32(), random.next_float32(), random

    return _traced(scene, edges_m, jittered, bounces, spp)


def ray_grid(scene: Scene, edges_m: np.ndarray, *, grid: int) -> np.ndarray:
    """Integrate direct light by a grid x grid of rays in each pixel: (H, W, T) float64, as `path_traced` returns it."""

    def centres(number: UInts, launch: int) -> tuple[Array, Array, Array]:
        x, y = ((Float(index) + 0.5) / grid for index in (number % grid, number // grid))
        return x, y, mi.PCG32(dr.width(number))

    return _traced(scene, edges_m, centres, 1, grid * grid)


def _traced(scene: Scene, edges_m: np.ndarray, places: Array, bounces: int, spp: int) -> np.ndarray:
    """Sum over `spp` paths of every pixel, each from the place in it that `places` gives for its number."""
    world, camera = TracedScene(scene), scene.camera
    count = camera.height * camera.width
    total = np.zeros((count, len(edges_m) - 1))
    per_launch = max(1, MAX_PATHS // count)
    for launch, first in enumerate(range(0, spp, per_launch)):
        paths = min(per_launch, spp - first)
        lane = dr.arange(UInt32, count * paths)
        pixel, number = lane % count, first + lane // count
        x, y, random = places(number, launch)
        ray, _ = camera_rays(world, Float(pixel % world.width) + x, Float(pixel // world.width) + y)
        active, throughput, path, origin = mi.Bool(True), Float(1), Float(0), None
        for vertex in range(bounces):
            si, transmission, optical, _ = first_opaque(world, ray, active, origin)
            active &= si.is_valid()
            throughput, path = throughput * transmission, path + optical
            seen = (transmission, optical) if vertex == 0 else None
            light, _, _, laser_path = laser_leg(world, si, pixel, active, seen_by_camera=seen)
            _add(total, edges_m, throughput * light / spp, path + laser_path, active)
            if vertex + 1 < bounces:
                lobe, direction = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
                sample, weight = si.bsdf().sample(mi.BSDFContext(), si, lobe, direction, active)
                throughput, origin = throughput * weight[0], si.p
                ray = spawn(si, si.to_world(sample.wo))
                active &= throughput > 0
    return total.reshape(camera.height, camera.width, -1)


def _add(total: np.ndarray, edges_m: np.ndarray, light: Floats, path: Floats, active: Masks) -> None:
    """Add light to the intervals of its paths; lanes run over pixels, then over paths of a pixel."""
    values, paths = (np.array(array).astype(float) for array in (dr.select(active, light, 0), path))
    pixel = np.arange(len(values)) % len(total)
    place = np.searchsorted(edges_m, paths, side="right") - 1
    kept = (values > 0) & (place >= 0) & (place < total.shape[1])
    np.add.at(total, (pixel[kept], place[kept]), values[kept])
