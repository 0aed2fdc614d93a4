"""Share reflected ambient light among neighbouring pixels of one surface: a joint bilateral filter of irradiance."""

from __future__ import annotations

import numpy as np

from render.backend.drjit_types import UInts
from render.direct.integrator import Layers
from render.scene.traced_scene import Float, UInt32, dr, mi, recorded, upload
from scenes.model import Camera

# A Gaussian of so many pixels, ended at that radius, of points that lie within a share of the distance of the tangent
# plane, weighted by the cosine between normals to this power of 2.
FILTER_SIGMA, FILTER_RADIUS, FILTER_PLANE, FILTER_NORMAL_DOUBLED = 2.0, 4, 0.02, 4


def bilateral_filter(light: np.ndarray, layers: Layers, camera: Camera) -> np.ndarray:
    """Return reflected light (..., H, W) whose irradiance neighbouring pixels of one surface share: a joint bilateral
    filter.

    L_i = a_i sum_j w_ij L_j / sum_j w_ij a_j, with the albedos a and w_ij = exp(-|ij|^2 / 2 sigma^2) (n_i . n_j)^16
    exp(-(n_i . (x_i - x_j) / (share of d_i))^2). Light on surfaces of even irradiance is kept whatever their albedo;
    edges of shadows and glossy reflections are blurred over some FILTER_SIGMA pixels. Where nothing is hit, or the
    albedo is 0, light stays what it is.
    """
    there = np.isfinite(layers.depth_m) & (layers.albedo > 0)
    depth = np.where(there, layers.depth_m, 0)
    albedo = np.where(there, layers.albedo, 0)
    point = np.moveaxis(camera.rays() * depth[..., None], -1, 0)
    normal = np.moveaxis(layers.normal, -1, 0)
    columns = [upload(Float, column) for column in (albedo, depth, *point, *normal)]
    lights = [upload(Float, part) for part in light.reshape(-1, there.size)]
    pixel = dr.arange(UInt32, there.size)
    dr.eval(pixel)
    found = _bilateral_filter(
        pixel, columns, lights, *(dr.opaque(UInt32, side) for side in (camera.width, camera.height))
    )
    dr.eval(found)
    return np.stack([part.numpy() for part in found]).reshape(light.shape).astype(np.float64)


@recorded
def _bilateral_filter(pixel: UInts, columns: list, lights: list, width: UInts, height: UInts) -> list:
    """Apply `bilateral_filter` to each pixel; pixels with an albedo hit a surface."""
    albedo = columns[0]
    albedos, *totals = _sums(pixel, columns, lights, width, height)
    fraction = albedo / dr.select(albedos > 0, albedos, 1)
    return [dr.select(albedo > 0, total * fraction, own) for total, own in zip(totals, lights, strict=True)]


@dr.syntax
def _sums(pixel: UInts, columns: list, lights: list, width: UInts, height: UInts) -> list:
    """Compute weighted sums over each pixel's neighbours of the albedo and of all lights."""
    side, tap = 2 * FILTER_RADIUS + 1, dr.zeros(UInt32, dr.width(pixel))
    sums = [dr.zeros(Float, dr.width(pixel)) for _ in range(1 + len(lights))]
    while tap < side * side:
        right, down = mi.Int32(tap % side) - FILTER_RADIUS, mi.Int32(tap // side) - FILTER_RADIUS
        sums = _with_neighbour(sums, pixel, columns, lights, (right, down), (mi.Int32(width), mi.Int32(height)))
        tap += 1
    return sums


def _with_neighbour(sums: list, pixel: UInts, columns: list, lights: list, way: tuple, size: tuple) -> list:
    """Add the albedo and the lights of the neighbour in direction `way` to the sums."""
    albedo, depth, point, normal = columns[0], columns[1], mi.Vector3f(*columns[2:5]), mi.Vector3f(*columns[5:])
    (right, down), (width, height) = way, size
    column, row = mi.Int32(pixel) % width + right, mi.Int32(pixel) // width + down
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    away2 = right * right + down * down
    inside &= away2 <= FILTER_RADIUS**2
    other = UInt32(row * width + column)
    its_albedo, _, *its = (dr.gather(Float, values, other, inside) for values in columns)
    off = dr.dot(mi.Vector3f(*its[:3]) - point, normal) / (FILTER_PLANE * dr.select(albedo > 0, depth, 1))
    alike = dr.maximum(dr.dot(mi.Vector3f(*its[3:]), normal), 0)
    for _ in range(FILTER_NORMAL_DOUBLED):
        alike *= alike
    weight = dr.exp(-Float(away2) / (2 * FILTER_SIGMA**2) - off * off) * alike
    weight = dr.select(inside & (its_albedo > 0), weight, 0)
    its_lights = (dr.gather(Float, values, other, inside) for values in lights)
    return [total + weight * more for total, more in zip(sums, (its_albedo, *its_lights), strict=True)]
