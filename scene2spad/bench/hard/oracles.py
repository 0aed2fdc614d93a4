"""Closed forms and float64 quadratures of simple geometry: the second route to what the renderer says.

Per-pixel answers are means over the pixel's raster area, as the renderer's are. Optics are in `oracles_optics`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from scenes import Camera, Scene
from scenes.library.hard_cases import camera, groove_of, quad, wall

__all__ = [
    "camera",
    "groove_interreflection",
    "groove_scene",
    "metal",
    "moments",
    "paint",
    "plane_moments",
    "quad",
    "sphere_moments",
    "wall",
]

groove_scene = groove_of


class Moments(NamedTuple):
    """Per pixel: total radiance [1/(m^2 sr)], radiance-weighted mean path and its standard deviation [m]."""

    total: np.ndarray
    mean_m: np.ndarray
    deviation_m: np.ndarray


def pixel_samples(view: Camera, per_side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre rays of every pixel: unit directions (H, W, n, 3) and weights (n,) that sum to 1."""
    node, weight = np.polynomial.legendre.leggauss(per_side)
    return _directions(view, (node + 1) / 2), np.outer(weight / 2, weight / 2).ravel()


def midpoint_samples(view: Camera, per_side: int, pixels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return equally spaced rays, for what is not smooth: of every pixel, or (P, n, 3) of the P that a (H, W) mask
    chooses."""
    return _directions(view, (np.arange(per_side) + 0.5) / per_side, pixels), np.full(per_side**2, per_side**-2.0)


def _directions(view: Camera, node: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    if pixels is not None:
        column, row = column[pixels], row[pixels]
    offset_x, offset_y = (grid.ravel() for grid in np.meshgrid(node, node))
    return view.rays(column[..., None] + offset_x, row[..., None] + offset_y)


def moments(radiance: np.ndarray, path: np.ndarray, weight: np.ndarray) -> Moments:
    """Return moments of (H, W, n) samples of weights (n,)."""
    total = (radiance * weight).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (radiance * path * weight).sum(-1) / total
        deviation = np.sqrt((radiance * (path - mean[..., None]) ** 2 * weight).sum(-1) / total)
    return Moments(total, mean, deviation)


def plane_moments(
    scene: Scene,
    *,
    distance_m: float,
    tilt_deg: float,
    albedo: float,
    per_side: int = 6,
    transmission: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Moments:
    """Return moments of an unbounded Lambertian plane through (0, 0, -distance) under a laser at the camera.

    L = albedo / pi I cos / d^2 along the ray at distance d = n.p0 / n.r, path 2 d; times `transmission`, there and
    back, as a function of the cosine between ray and camera axis.
    """
    directions, weight = pixel_samples(scene.camera, per_side)
    normal = np.array([np.sin(np.radians(tilt_deg)), 0, np.cos(np.radians(tilt_deg))])
    cosine = -(directions @ normal)
    distance = distance_m * normal[2] / cosine
    intensity = scene.laser.intensity(scene.camera)[..., None]
    radiance = albedo / np.pi * intensity * cosine / distance**2
    if transmission is not None:
        radiance = radiance * transmission(-directions[..., 2])
    return moments(radiance, 2 * distance, weight)


def bounded_plane_moments(
    scene: Scene, *, distance_m: float, tilt_deg: float, half_size_m: float, albedo: float, per_side: int = 64
) -> Moments:
    """Return `plane_moments` of a square of that half size (in `wall`'s frame), nothing beside it."""
    directions, weight = midpoint_samples(scene.camera, per_side)
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    cosine = -(directions @ np.array([s, 0, c]))
    distance = np.where(cosine > 0, distance_m * c / np.where(cosine > 0, cosine, 1), 0)
    point = directions * distance[..., None] + (0, 0, distance_m)
    along, up = point @ np.array([c, 0, -s]), point[..., 1]
    inside = (cosine > 0) & (np.abs(along) <= half_size_m) & (np.abs(up) <= half_size_m)
    intensity = scene.laser.intensity(scene.camera)[..., None]
    radiance = np.where(inside, albedo / np.pi * intensity * cosine / np.where(inside, distance, 1) ** 2, 0)
    return moments(radiance, 2 * distance, weight)


def sphere_moments(
    scene: Scene,
    *,
    distance_m: float,
    radius_m: float,
    reflected: Callable[[np.ndarray], np.ndarray],
    per_side: int = 48,
    pixels: np.ndarray | None = None,
) -> Moments:
    """Return moments of a sphere centred at (0, 0, -distance); midpoint rule, since the limb is not smooth.

    `reflected(cosine)` is f cos of light that goes back where it came from, at this cosine to the normal.
    """
    directions, weight = midpoint_samples(scene.camera, per_side, pixels)
    along = -directions[..., 2] * distance_m
    discriminant = radius_m**2 - distance_m**2 + along**2
    hit = discriminant > 0
    distance = along - np.sqrt(np.maximum(discriminant, 0))
    normal = (directions * distance[..., None] + [0, 0, distance_m]) / radius_m
    cosine = np.where(hit, -(directions * normal).sum(-1), 0)
    intensity = scene.laser.intensity(scene.camera)[0, 0]  # a flood's is the same everywhere
    return moments(reflected(cosine) * intensity / distance**2, 2 * distance, weight)


def paint(cosine: np.ndarray, *, albedo: float) -> np.ndarray:
    """Return f cos of a Lambertian surface."""
    return albedo / np.pi * cosine


def metal(cosine: np.ndarray, *, roughness: float, eta: float, k: float) -> np.ndarray:
    """Return f cos of a rough conductor whose light goes back where it came from: F_0 D G_1^2 / (4 cos).

    GGX (Walter et al. 2007, eqs. 33 and 34), Fresnel's reflectance at normal incidence on its facets; the two ways are
    masked independently.
    """
    cosine = np.maximum(cosine, 1e-9)
    tangent2 = 1 / cosine**2 - 1
    facets = 1 / (np.pi * roughness**2 * cosine**4 * (1 + tangent2 / roughness**2) ** 2)
    masked = 2 / (1 + np.sqrt(1 + roughness**2 * tangent2))
    mirrored = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    return mirrored * facets * masked**2 / (4 * cosine)


def sphere_coverage(view: Camera, *, distance_m: float, radius_m: float, per_side: int = 48) -> np.ndarray:
    """Return share of each pixel that a sphere at (0, 0, -distance) covers."""
    directions, weight = midpoint_samples(view, per_side)
    return ((radius_m**2 - distance_m**2 + (directions[..., 2] * distance_m) ** 2 > 0) * weight).sum(-1)


class Wire(NamedTuple):
    """An upright wire, per image row, summed over columns: radiance, mean path [m]; the columns it covers."""

    radiance: np.ndarray
    mean_path_m: np.ndarray
    coverage_px: float


def upright_wire(
    scene: Scene, *, distance_m: float, x_m: float, radius_m: float, albedo: float, nodes: int = 8
) -> Wire:
    """Return a round wire (x, y, -distance), thin against D = hypot(x, distance), under a laser at the camera.

    Its image is 2 r f D / distance^2 pixels wide. At height y, rho^2 = D^2 + y^2, a strip at the angle phi around it
    has radiance albedo/pi I cos(phi) (D / rho) / rho^2 and projected width r cos(phi) dphi: the mean over the width is
    pi/4 of the central one, the mean path 2 (rho - 8 r D / (3 pi rho)). Relative error of order r / D.
    """
    view = scene.camera
    perpendicular = math.hypot(x_m, distance_m)
    coverage_px = 2 * radius_m * view.focal_px * perpendicular / distance_m**2
    node, weight = np.polynomial.legendre.leggauss(nodes)
    y = (np.arange(view.height)[:, None] + (node + 1) / 2 - view.height / 2) / view.focal_px * distance_m
    rho = np.hypot(perpendicular, y)
    intensity = float(scene.laser.intensity(view)[0, 0])
    radiance = albedo / 4 * intensity * perpendicular / rho**3 * weight / 2 * coverage_px
    path = 2 * (rho - 8 * radius_m * perpendicular / (3 * np.pi * rho))
    return Wire(radiance.sum(axis=1), (radiance * path).sum(axis=1) / radiance.sum(axis=1), coverage_px)


class Shadowed(NamedTuple):
    """Moments with the post and its shadow; radiance of the wall without post; the brightest ray's radiance; shares of
    each pixel that the post covers and that lie in its shadow; columns that edges of either run through."""

    seen: Moments
    bare: np.ndarray
    brightest: np.ndarray
    post: np.ndarray
    shadow: np.ndarray
    columns: np.ndarray


def shadowed_wall(
    scene: Scene,
    *,
    wall_m: float,
    post_m: float,
    post_x_m: tuple[float, float],
    albedo: float,
    post_albedo: float,
    per_side: int = 48,
) -> Shadowed:
    """Return a frontal wall behind an upright frontal post that is taller than the image, under a displaced laser.

    L = albedo/pi I cos_L / |x - L|^2 at path |x - C| + |x - L| where the segment from x to the laser misses the post.
    """
    directions, weight = midpoint_samples(scene.camera, per_side)
    laser = np.array(scene.laser.baseline_m) * (1, -1, -1)  # camera frame to world
    intensity = scene.laser.intensity(scene.camera)[..., None]
    low, high = post_x_m

    def lit(depth: float, reflectance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        point = directions * (depth / -directions[..., 2])[..., None]
        leg = np.linalg.norm(point - laser, axis=-1)
        cosine = (point - laser)[..., 2] / -leg
        radiance = reflectance / np.pi * intensity * cosine / leg**2
        return radiance, np.linalg.norm(point, axis=-1) + leg, point[..., 0]

    on_wall, wall_path, x = lit(wall_m, albedo)
    on_post, post_path, x_post = lit(post_m, post_albedo)
    crossing = laser[0] + (x - laser[0]) * (post_m + laser[2]) / (wall_m + laser[2])
    dark = (crossing > low) & (crossing < high)
    post = (x_post > low) & (x_post < high)
    radiance = np.where(post, on_post, np.where(dark, 0, on_wall))
    seen = moments(radiance, np.where(post, post_path, wall_path), weight)
    in_post, in_shadow = ((covered * weight).sum(-1) for covered in (post, dark & ~post))
    camera_x = [x / post_m for x in post_x_m]  # the edges in camera rays' x / z
    camera_x += [(laser[0] + (x - laser[0]) * wall_m / post_m) / wall_m for x in post_x_m]
    columns = np.floor(np.array(camera_x) * scene.camera.focal_px + scene.camera.width / 2)
    return Shadowed(
        seen,
        (on_wall * weight).sum(-1),
        np.maximum(radiance, on_wall).max(-1),
        post=in_post,
        shadow=in_shadow,
        columns=columns.astype(int),
    )


class Leaf(NamedTuple):
    """Per pixel: radiance of a disk and of the wall seen past it."""

    leaf: np.ndarray
    wall: np.ndarray


def disk_before_wall(
    scene: Scene,
    *,
    disk_m: float,
    radius_m: float,
    disk_albedo: float,
    wall_m: float,
    wall_albedo: float,
    per_side: int = 64,
) -> Leaf:
    """Return a frontal disk around the axis before a frontal wall, laser at the camera: L = albedo/pi I cos^3 / z^2."""
    directions, weight = midpoint_samples(scene.camera, per_side)
    cosine = -directions[..., 2]
    on_disk = disk_m * np.sqrt(1 - cosine**2) / cosine < radius_m
    common = scene.laser.intensity(scene.camera)[..., None] / np.pi * cosine**3 * weight
    disk = np.where(on_disk, disk_albedo * common / disk_m**2, 0).sum(-1)
    return Leaf(disk, np.where(on_disk, 0, wall_albedo * common / wall_m**2).sum(-1))


def groove_interreflection(
    scene: Scene,
    *,
    albedo: float,
    edges_m: np.ndarray,
    size_m: float = 1.0,
    opening_deg: float = 90.0,
    nodes: int = 56,
) -> np.ndarray:
    """Return image mean of light that meets both walls of `groove_of` once, per path-length bin: float64 quadrature.

    L_2 = (albedo/pi)^2 I / d_2^2 cos_L cos_1 cos_2 / r^2 dA_2 at path |C x_1| + r + |x_2 C|. The kernel peaks where the
    walls meet, so nodes across the walls are graded toward that line (u = v^3) and nodes along it toward the other
    point (y_2 - y_1 = r_0 sinh t, r_0 the distance between the two lines). By symmetry one wall is enough.
    """
    view, half = scene.camera, math.radians(opening_deg) / 2
    intensity = float(scene.laser.intensity(view)[0, 0])
    node, weight = np.polynomial.legendre.leggauss(nodes)
    v, dv = (node + 1) / 2, weight / 2
    u, du = v**3 * size_m, 3 * v**2 * dv * size_m
    y_1, dy_1 = v - 0.5, dv
    corner, up = np.array([0, 0, -3.0]), np.array([0, 1.0, 0])
    along_1, along_2 = (np.array([side * math.sin(half), 0, math.cos(half)]) for side in (-1, 1))
    normal_1, normal_2 = (np.array([side * math.cos(half), 0, math.sin(half)]) for side in (1, -1))
    histogram = np.zeros(len(edges_m) - 1)
    for u_1, du_1 in zip(u, du, strict=True):
        r_0 = np.sqrt(u_1**2 + u**2 - 2 * u_1 * u * math.cos(2 * half))[None, :, None]
        low = np.arcsinh((-0.5 - y_1)[:, None, None] / r_0)
        high = np.arcsinh((0.5 - y_1)[:, None, None] / r_0)
        t = low + (high - low) * v
        y_2 = y_1[:, None, None] + r_0 * np.sinh(t)
        dy_2 = (high - low) * dv * r_0 * np.cosh(t)
        x_1 = corner + u_1 * along_1 + y_1[:, None] * up
        x_2 = corner + u[None, :, None, None] * along_2 + y_2[..., None] * up
        between = x_2 - x_1[:, None, None]
        d_1, d_2, r = (np.linalg.norm(vector, axis=-1) for vector in (x_1, x_2, between))
        # an area element of wall 1 covers f^2 |n.p| / |z|^3 dA pixels
        image = view.focal_px**2 * np.abs(x_1 @ normal_1) / np.abs(x_1[:, 2]) ** 3 * du_1 * dy_1
        lit = intensity * np.abs(x_2 @ normal_2) / d_2**3 * albedo / np.pi * du[None, :, None] * dy_2
        kernel = np.abs(between @ normal_1) * np.abs(between @ normal_2) / r**4
        path = d_1[:, None, None] + r + d_2
        value = image[:, None, None] * albedo / np.pi * kernel * lit
        histogram += np.histogram(path, bins=edges_m, weights=value)[0]
    return 2 * histogram / (view.width * view.height)
