"""Indirect light by path tracing from the camera, each vertex connected to the laser; and steady ambient light."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from render.returns import Samples
from render.world import Bool, Float, UInt32, World, camera_rays, dr, first_opaque, laser_leg, mi

LANES = 1 << 20


def indirect_light(world: World, pixels: np.ndarray, spp: int, bounces: int, seed: int) -> Iterator[Samples]:
    """Light of 2 to `bounces` surfaces in the given flat pixels: `spp` camera paths a pixel, one sample a vertex.

    Samples come in chunks of whole pixels, so that the caller can merge before memory fills.

    Unbiased but for what `first_opaque` leaves out: a path vertex x_k adds T_k f(x_k) cos I(w) / d^2, with T_k the
    product of BSDF weights so far (Russian roulette after the second surface), at path length |C x_1| + ... + |x_k L|.
    """
    per_chunk = max(1, LANES // spp)
    seeds = np.random.SeedSequence(seed).generate_state(-(-len(pixels) // per_chunk))
    for first, chunk_seed in zip(range(0, len(pixels), per_chunk), seeds, strict=True):
        yield _chunk(world, pixels[first : first + per_chunk], spp, bounces, int(chunk_seed))


def _chunk(world: World, pixels: np.ndarray, spp: int, bounces: int, seed: int) -> Samples:
    lanes, vertices = len(pixels) * spp, bounces - 1
    paths, values = _trace(world, UInt32(pixels.astype(np.uint32)), lanes, spp, vertices, seed)
    value = np.array(values, dtype=np.float64).reshape(lanes, vertices)
    lane, vertex = np.nonzero(value > 0)
    return Samples(
        pixels[lane // spp],
        np.array(paths, dtype=np.float64).reshape(lanes, vertices)[lane, vertex],
        np.zeros(len(lane)),
        value[lane, vertex] / spp,
        (vertex + 2).astype(np.uint8),
    )


@dr.syntax
def _trace(world: World, pixels: Any, lanes: int, spp: int, vertices: int, seed: int) -> tuple[Any, Any]:
    """Path lengths and radiances, vertex-minor flat arrays of lanes x vertices, 0 where a path ended."""
    paths, values = dr.zeros(Float, lanes * vertices), dr.zeros(Float, lanes * vertices)
    lane = dr.arange(UInt32, lanes)
    pixel = dr.gather(UInt32, pixels, lane // dr.opaque(UInt32, spp))
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(dr.opaque(UInt32, seed), lanes)
    width = world.width
    jitter = sampler.next_2d()
    ray, _ = camera_rays(world, Float(pixel % width) + jitter.x, Float(pixel // width) + jitter.y)
    si, throughput, path, _ = first_opaque(world, ray, Bool(True))
    throughput = Float(throughput) + dr.zeros(Float, lanes)
    vertex, last = dr.zeros(UInt32, lanes), dr.opaque(UInt32, vertices)
    active = si.is_valid()
    while active:
        sample, weight = si.bsdf().sample(
            mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active
        )
        throughput *= weight[0]
        active &= throughput > 0
        ray, vertex_point = si.spawn_ray(si.to_world(sample.wo)), mi.Point3f(si.p)
        si, transmission, optical, _ = first_opaque(world, ray, active, vertex_point)
        throughput *= transmission
        path += optical
        active &= si.is_valid()
        value, leg = laser_leg(world, si, pixel, active, seen_by_camera=None)
        slot = lane * last + vertex
        dr.scatter(paths, path + leg, slot, active)
        dr.scatter(values, throughput * value, slot, active)
        vertex += 1
        active &= vertex < last
        # Russian roulette: paths that carry little end early, the others carry their energy on
        survive = dr.select(vertex > 1, dr.clip(throughput, 0.05, 0.95), 1)
        active &= sampler.next_1d(active) < survive
        throughput /= survive
    return paths, values


def ambient_light(world: World, spp: int, bounces: int, seed: int) -> np.ndarray:
    """Steady spectral radiance of environment and area lights at each pixel [W/(m^2 sr nm)], (H, W) float32.

    Mitsuba's own path integrator: steady light needs nothing of ours.
    """
    camera = world.scene.camera
    if world.has_cutouts:
        world = World(world.scene, cutouts_by_mitsuba=True)
    # the camera is the traced world's origin; Mitsuba's has x to the left and y up
    turned = np.eye(4)
    turned[:3, :3] = camera.rotation @ np.diag([-1.0, -1.0, 1.0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": camera.fov_deg,
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(turned),
            "near_clip": 1e-4,
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
            },
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": bounces})
    image = np.array(mi.render(world.traced, sensor=sensor, integrator=integrator, spp=spp, seed=seed))
    return np.maximum(np.nan_to_num(image.reshape(camera.height, camera.width)), 0).astype(np.float32)
