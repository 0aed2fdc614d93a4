"""Direct light, integrated: each ray's footprint on the tangent plane spreads its energy over path lengths."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from render.returns import Samples, concatenate, merge
from render.world import (
    Bool,
    Float,
    UInt32,
    World,
    camera_rays,
    dr,
    first_opaque,
    laser_leg,
    mi,
    shape_index,
    to_camera,
)

LANES = 1 << 21
MIXED_GAP_M = 0.05
# The tangent plane's footprint is unbounded near grazing: beyond this share of the path it describes no mesh.
WIDEST_SPREAD = 0.25


class DirectLight(NamedTuple):
    """Samples of direct light; per pixel the `mixed` flag; how many footprints were clipped; rays cast."""

    samples: Samples
    mixed: np.ndarray
    clipped: int
    rays: int


class Layers(NamedTuple):
    """What the pixel-centre ray meets: radial depth [m] (NaN: nothing), world normal toward the camera, albedo."""

    depth_m: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray


def direct_light(world: World, pixels: np.ndarray, grid: int, tolerance_m: float = 1e-4) -> DirectLight:
    """Direct returns of the given flat pixel indices, grid x grid footprints each, merged within `tolerance_m`.

    A cell of a pixel, seen on the tangent plane of the point its centre hits, spans path lengths
    p(x, y) = rho + |p - L|. To first order p is linear over the cell, so its distribution is a trapezoid of variance
    (a^2 + b^2) / 3 with half spans a = |dp/dx| dx/2, b = |dp/dy| dy/2; the cell's return is uniform over
    p +- sqrt(a^2 + b^2), which has the same mean and variance. Its radiance is f cos I / d^2 (`laser_leg`), divided by
    the number of cells.
    """
    per_chunk = max(1, LANES // grid**2)
    parts = [_chunk(world, pixels[i : i + per_chunk], grid, tolerance_m) for i in range(0, len(pixels), per_chunk)]
    mixed = np.concatenate([part.mixed for part in parts])
    samples = concatenate([part.samples for part in parts])
    return DirectLight(samples, mixed, sum(p.clipped for p in parts), sum(p.rays for p in parts))


def _chunk(world: World, pixels: np.ndarray, grid: int, tolerance_m: float) -> DirectLight:
    cells = grid * grid
    lane = dr.arange(UInt32, len(pixels) * cells)
    pixel = dr.gather(UInt32, UInt32(pixels.astype(np.uint32)), lane // dr.opaque(UInt32, cells))
    cell = lane % dr.opaque(UInt32, cells)
    side = dr.opaque(UInt32, grid)
    width = world.width
    pitch = 1 / Float(side)
    x = Float(pixel % width) + (Float(cell % side) + 0.5) * pitch
    y = Float(pixel // width) + (Float(cell // side) + 0.5) * pitch

    ray, local = camera_rays(world, x, y)
    si, transmission, optical, distance = first_opaque(world, ray, Bool(True))
    hit = si.is_valid()
    value, leg = laser_leg(world, si, pixel, hit, seen_by_camera=(transmission, optical))
    path = optical + leg
    span = _half_spans(world, ray, local, si, distance, pitch / world.focal_px)
    limit = WIDEST_SPREAD * path
    spread = dr.sqrt(dr.square(span.x) + dr.square(span.y))
    clipped = hit & ~(spread <= limit)
    spread = dr.select(clipped, limit, spread)
    radiance = dr.select(hit, value * transmission / cells, 0)
    # what separates two surfaces is their distance from the camera, not the path: half of it for a co-located laser
    reach = 0.5 * (span.x + span.y)
    dr.eval(path, spread, radiance, distance, reach, hit, clipped)

    shape = (len(pixels), cells)
    lit = np.array(hit).astype(bool)
    mixed = _mixed(np.array(distance).reshape(shape), np.array(reach).reshape(shape), lit.reshape(shape))
    samples = Samples(
        np.repeat(pixels, cells)[lit],
        np.array(path, dtype=np.float64)[lit],
        np.array(spread, dtype=np.float64)[lit],
        np.array(radiance, dtype=np.float64)[lit],
        np.ones(int(lit.sum()), dtype=np.uint8),
    )
    return DirectLight(merge(samples, tolerance_m), mixed, int(np.array(clipped).sum()), len(pixels) * cells)


def _half_spans(world: World, ray: Any, local: Any, si: Any, distance: Any, pitch: Any) -> Any:
    """Half spans of the path length over a cell of angular size `pitch` along image x and y [m], (2,).

    On the tangent plane n . (p - C) = const the distance along l = (x, y, 1) is rho = const |l| / (n . l), so
    drho/dx = rho (x / |l|^2 - n_x / (n . l)), and dp/dx = (drho/dx) r + rho (e_x / |l| - l x / |l|^3).
    """
    normal = to_camera(world, si.n)
    inverse = dr.rcp(dr.dot(normal, local))
    length2 = dr.squared_norm(local)
    along = dr.normalize(local)
    to_point = along
    if not world.scene.laser.is_colocated:
        to_point = dr.normalize(to_camera(world, si.p - world.laser))
    spans = []
    for axis in range(2):
        slope = distance * (local[axis] / length2 - normal[axis] * inverse)
        unit = mi.Vector3f(1, 0, 0) if axis == 0 else mi.Vector3f(0, 1, 0)
        sideways = distance * (unit - along * (local[axis] * dr.rsqrt(length2))) * dr.rsqrt(length2)
        along_laser = dr.dot(to_point, along * slope + sideways)
        spans.append(dr.abs(slope + along_laser) * pitch / 2)
    return mi.Vector2f(*spans)


def _mixed(distance: np.ndarray, reach: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Pixels whose footprints leave a gap of more than 50 mm or see past an edge into nothing; (pixels, cells) each."""
    distance = np.where(hit, distance, 0)
    reach = np.where(np.isfinite(reach), reach, WIDEST_SPREAD * distance)
    near, far = distance - reach, distance + reach
    order = np.argsort(near, axis=1)
    near, far = np.take_along_axis(near, order, 1), np.take_along_axis(far, order, 1)
    gap = (near[:, 1:] - np.maximum.accumulate(far, axis=1)[:, :-1] > MIXED_GAP_M).any(axis=1)
    covered = hit.all(axis=1)
    return np.where(covered, gap, hit.any(axis=1))


def centre_layers(world: World) -> Layers:
    """Depth, normal and albedo at every pixel centre, (H, W)."""
    camera = world.scene.camera
    pixel = dr.arange(UInt32, camera.height * camera.width)
    ray, _ = camera_rays(world, Float(pixel % world.width) + 0.5, Float(pixel // world.width) + 0.5)
    si, _, _, distance = first_opaque(world, ray, Bool(True))
    hit = si.is_valid()
    diffuse = si.bsdf().eval_diffuse_reflectance(si, hit)[0]
    specular = dr.gather(Float, world.albedo, shape_index(si), hit)
    albedo = dr.select(hit, dr.select(specular >= 0, specular, diffuse), 0)
    normal = si.n * dr.select(hit, dr.select(dr.dot(si.n, ray.d) > 0, -1, 1), 0)
    depth = dr.select(hit, distance, dr.nan)
    dr.eval(depth, normal, albedo)
    shape = (camera.height, camera.width)
    return Layers(
        np.array(depth, dtype=np.float32).reshape(shape),
        np.array(normal, dtype=np.float32).T.reshape(*shape, 3).astype(np.float16),
        np.array(albedo, dtype=np.float32).reshape(shape).astype(np.float16),
    )
