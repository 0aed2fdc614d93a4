"""Closed forms and float64 quadratures of simple geometry: the second route to what the renderer says.

Not a test module; the tests of `render` import it by path through `conftest`.
"""

from __future__ import annotations

import numpy as np

from scenes import Camera, Laser, Material, Scene, Surface


def quad(corners: list[tuple[float, float, float]], material: Material, name: str = "quad") -> Surface:
    return Surface(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]), material, name=name)


def wall(distance_m: float, albedo: float, *, tilt_deg: float = 0.0, half_size_m: float = 1.0) -> Surface:
    """A square through (0, 0, -distance), facing +z, turned about the vertical by `tilt_deg`."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    h = half_size_m
    corners = [(-h * c, -h, -distance_m + h * s), (h * c, -h, -distance_m - h * s)]
    corners += [(h * c, h, -distance_m - h * s), (-h * c, h, -distance_m + h * s)]
    return quad(corners, Material(albedo=albedo), "wall")


def camera(width: int = 32, height: int = 24, fov_deg: float = 34.0) -> Camera:
    """At the origin, looking along -z."""
    return Camera.look_at((0, 0, 0), (0, 0, -1), fov_deg=fov_deg, width=width, height=height)


def pixel_samples(view: Camera, per_side: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre rays of every pixel: unit directions (H, W, n, 3) and weights (n,) that sum to 1."""
    node, weight = np.polynomial.legendre.leggauss(per_side)
    node, weight = (node + 1) / 2, weight / 2
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    offset_x, offset_y = (grid.ravel() for grid in np.meshgrid(node, node))
    directions = view.rays(column[..., None] + offset_x, row[..., None] + offset_y)
    return directions, np.outer(weight, weight).ravel()


def moments(radiance: np.ndarray, path: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per pixel: total radiance, radiance-weighted mean path and its standard deviation, from (H, W, n) samples."""
    total = (radiance * weight).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (radiance * path * weight).sum(-1) / total
        deviation = np.sqrt((radiance * (path - mean[..., None]) ** 2 * weight).sum(-1) / total)
    return total, mean, deviation


def plane_moments(scene: Scene, *, distance_m: float, tilt_deg: float, albedo: float, per_side: int = 6):
    """Moments of an unbounded Lambertian plane through (0, 0, -distance) under a laser at the camera.

    L = albedo / pi I cos / d^2 along the ray at distance d = n.p0 / n.r, path 2 d.
    """
    directions, weight = pixel_samples(scene.camera, per_side)
    normal = np.array([np.sin(np.radians(tilt_deg)), 0, np.cos(np.radians(tilt_deg))])
    cosine = -(directions @ normal)
    distance = distance_m * normal[2] / cosine
    intensity = scene.laser.intensity(scene.camera)[..., None]
    return moments(albedo / np.pi * intensity * cosine / distance**2, 2 * distance, weight)


def sphere_moments(scene: Scene, *, distance_m: float, radius_m: float, albedo: float, per_side: int = 48):
    """Moments of a Lambertian sphere centred at (0, 0, -distance); midpoint rule, since the limb is not smooth."""
    view = scene.camera
    node = (np.arange(per_side) + 0.5) / per_side
    column, row = np.meshgrid(np.arange(view.width), np.arange(view.height))
    offset_x, offset_y = (grid.ravel() for grid in np.meshgrid(node, node))
    directions = view.rays(column[..., None] + offset_x, row[..., None] + offset_y)
    along = -directions[..., 2] * distance_m
    discriminant = radius_m**2 - distance_m**2 + along**2
    hit = discriminant > 0
    distance = along - np.sqrt(np.maximum(discriminant, 0))
    normal = (directions * distance[..., None] + [0, 0, distance_m]) / radius_m
    cosine = np.where(hit, -(directions * normal).sum(-1), 0)
    intensity = scene.laser.intensity(view)[..., None]
    weight = np.full(per_side**2, per_side**-2)
    return moments(albedo / np.pi * intensity * cosine / distance**2, 2 * distance, weight)


def groove_scene(width: int, height: int, *, albedo: float, size_m: float = 1.0) -> Scene:
    """Two squares that meet at 90 degrees in the vertical line x = 0, z = -3, open toward the camera; all in view."""
    s = size_m / np.sqrt(2)
    left = quad([(-s, -0.5, -3 + s), (0, -0.5, -3), (0, 0.5, -3), (-s, 0.5, -3 + s)], Material(albedo=albedo), "left")
    right = quad([(0, -0.5, -3), (s, -0.5, -3 + s), (s, 0.5, -3 + s), (0, 0.5, -3)], Material(albedo=albedo), "right")
    return Scene("groove", (left, right), camera(width, height, 45.0), Laser("flood"))


def groove_interreflection(scene: Scene, *, albedo: float, edges_m: np.ndarray, size_m: float = 1.0, nodes: int = 56):
    """Image mean of light that meets both walls once, per path-length bin: float64 quadrature.

    L_2 = (albedo/pi)^2 I / d_2^2 cos_L cos_1 cos_2 / r^2 dA_2 at path |C x_1| + r + |x_2 C|. The kernel peaks where the
    walls meet, so nodes across the walls are graded toward that line (u = v^3) and nodes along it toward the other
    point (y_2 - y_1 = r_0 sinh t, r_0 the distance between the two lines). By symmetry one wall is enough.
    """
    view = scene.camera
    intensity = float(scene.laser.intensity(view)[0, 0])
    node, weight = np.polynomial.legendre.leggauss(nodes)
    v, dv = (node + 1) / 2, weight / 2
    u, du = v**3 * size_m, 3 * v**2 * dv * size_m
    y_1, dy_1 = v - 0.5, dv
    corner, up = np.array([0, 0, -3.0]), np.array([0, 1.0, 0])
    along_1, along_2 = np.array([-1, 0, 1.0]) / np.sqrt(2), np.array([1, 0, 1.0]) / np.sqrt(2)
    normal_1, normal_2 = along_2, along_1  # the walls are perpendicular: each one's normal runs along the other
    histogram = np.zeros(len(edges_m) - 1)
    for u_1, du_1 in zip(u, du, strict=True):
        r_0 = np.hypot(u_1, u)[None, :, None]
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
