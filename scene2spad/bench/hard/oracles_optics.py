"""Closed forms with glass, mirrors, closed rooms and a sensor: the second route to what the renderer says."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from scene2spad.bench.hard.oracles import Moments, moments, pixel_samples
from scenes import Camera, Laser, Scene
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.sensor.model import Sensor
from spad.sensor.pulse import Pulse


def fresnel(cosine: np.ndarray | float, ior: float) -> np.ndarray:
    """Return unpolarised reflectance of an interface from air to glass: the mean of both polarisations' squares."""
    cosine = np.asarray(cosine, float)
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    across = (cosine - ior * inside) / (cosine + ior * inside)
    along = (inside - ior * cosine) / (inside + ior * cosine)
    return (across**2 + along**2) / 2


def pane_transmission(cosine: np.ndarray | float, ior: float) -> np.ndarray:
    """Return a thin pane with all its inner reflections lets (1 - F) / (1 + F) through; the rest, 2 F / (1 + F),
    returns."""
    reflectance = fresnel(cosine, ior)
    return (1 - reflectance) / (1 + reflectance)


def mirror_return(
    view: Camera, laser: Laser, toward: np.ndarray, reflectance: float, one_way_m: float
) -> tuple[tuple[int, int], float]:
    """Return pixel (row, column) that looks `toward` a laser's mirror image, and its pixel-mean radiance [1/(m^2 sr)].

    The image at unfolded distance D sends the irradiance R I / D^2 from one direction, at an angle a to the axis. A
    pixel's mean is that over its square, as wide as the focal length over F: radiance R I F^2 / (D^2 cos^3 a).
    """
    x, y, z = view.rotation.T @ np.asarray(toward, float) / np.linalg.norm(toward)
    column = math.floor(x / z * view.focal_px + view.width / 2)
    row = math.floor(y / z * view.focal_px + view.height / 2)
    per_pixel = laser.intensity(view)[row, column] * view.focal_px**2 / z**3
    return (row, column), float(reflectance * per_pixel / one_way_m**2)


def caustic_moments(
    scene: Scene, *, wall_m: float, panel_m: float, depths_m: tuple[float, float], reflectance: float, albedo: float
) -> Moments:
    """Return what a polished panel at x = panel, upright and along the axis, throws from a laser at the camera on the
    wall.

    The laser's mirror image at (2 panel, 0, 0) lights the wall with I R cos / D^2, D the unfolded distance:
    L = albedo/pi R I cos / D^2 at path D + |x|. NaN where the panel does not mirror all of a pixel.
    """
    directions, weight = pixel_samples(scene.camera, 4)
    point = directions * (wall_m / -directions[..., 2])[..., None]
    way = point - (2 * panel_m, 0, 0)
    distance = np.linalg.norm(way, axis=-1)
    depth = wall_m * panel_m / (2 * panel_m - point[..., 0])
    # in the panel, where the laser shines on it
    lit = (depth > depths_m[0]) & (depth < depths_m[1])
    mirrored = np.stack((np.full_like(depth, panel_m), point[..., 1] * depth / wall_m, -depth), axis=-1)
    lit &= -mirrored[..., 2] > np.linalg.norm(mirrored, axis=-1) * scene.laser.cos_half_angle(scene.camera)
    intensity = scene.laser.intensity(scene.camera)[..., None]
    radiance = np.where(lit, albedo / np.pi * reflectance * intensity * (wall_m / distance) / distance**2, np.nan)
    return moments(radiance, distance + np.linalg.norm(point, axis=-1), weight)


def slab_moments(
    scene: Scene, *, wall_m: float, thickness_m: float, ior: float, albedo: float, per_side: int = 4
) -> Moments:
    """Return a frontal wall seen through a frontal slab of glass, laser at the camera, every ray refracted.

    A ray at the angle theta meets the wall at h = (d - t) tan(theta) + t tan(theta'), sin(theta) = n sin(theta'). The
    cone between theta and theta + dtheta lights the ring 2 pi h dh: E = I (1 - F)^2 sin(theta) / (h dh/dtheta), at
    normal incidence I (1 - F)^2 / (d - t + t/n)^2. L = albedo/pi E (1 - F)^2; path 2 ((d - t) / cos + n t / cos').
    """
    directions, weight = pixel_samples(scene.camera, per_side)
    cosine = -directions[..., 2]
    sine = np.sqrt(1 - cosine**2)
    inside = np.sqrt(1 - (sine / ior) ** 2)
    air = wall_m - thickness_m
    # h / sin(theta) and dh/dtheta: neither vanishes on the axis
    spread = air / cosine + thickness_m / (ior * inside)
    growth = air / cosine**2 + thickness_m * cosine / (ior * inside**3)
    passed = (1 - fresnel(cosine, ior)) ** 4
    intensity = scene.laser.intensity(scene.camera)[..., None]
    radiance = albedo / np.pi * intensity * passed / (spread * growth)
    return moments(radiance, 2 * (air / cosine + ior * thickness_m / inside), weight)


class SphereLight(NamedTuple):
    """Indirect light of 2 to B surfaces in an integrating sphere: radiance everywhere; per pixel the mean path [m] and
    the path's variance over the light of one pixel [m^2]."""

    radiance: float
    mean_path_m: np.ndarray
    variance_m2: np.ndarray


def integrating_sphere(scene: Scene, *, radius_m: float, offset_m: float, albedo: float, bounces: int) -> SphereLight:
    """Return a Lambertian sphere around an isotropic laser, the camera at the offset from the centre on its own axis.

    The form factor between any two points is dA / (4 pi r^2), and so is what the laser sends: every surface is lit
    evenly, the k-th by albedo^(k-1) / (4 pi r^2), so that L_k = albedo^k / (4 pi^2 r^2). Each of the k - 1 legs between
    surfaces is a chord to a uniform point: density c / (2 r^2), mean 4 r/3, variance 2 r^2/9, independent of the
    others. The laser's leg is r, the camera's belongs to the pixel.
    """
    orders = np.arange(2, bounces + 1)
    energy = albedo ** orders.astype(float)
    directions, weight = pixel_samples(scene.camera, 6)
    cosine = -directions[..., 2]
    last = offset_m * cosine + np.sqrt(radius_m**2 - offset_m**2 * (1 - cosine**2))
    last_mean = (last * weight).sum(-1)
    fraction = energy / energy.sum()
    chords = (fraction * (orders - 1)).sum()
    chord_variance = (fraction * (orders - 1 - chords) ** 2).sum() * (
        4 * radius_m / 3
    ) ** 2 + chords * 2 * radius_m**2 / 9
    return SphereLight(
        math.fsum(energy) / (4 * np.pi**2 * radius_m**2),
        radius_m + chords * 4 * radius_m / 3 + last_mean,
        chord_variance + ((last - last_mean[..., None]) ** 2 * weight).sum(-1),
    )


def two_chords_longer_than(length_m: float, radius_m: float) -> float:
    """Return probability that two independent chords of a sphere, each of density c / (2 r^2) up to 2 r, sum to
    more."""
    node, weight = np.polynomial.legendre.leggauss(64)
    low = max(0.0, length_m - 2 * radius_m)
    first = low + (2 * radius_m - low) * (node + 1) / 2
    rest = np.clip(length_m - first, 0, 2 * radius_m)
    longer = first / (2 * radius_m**2) * (1 - (rest / (2 * radius_m)) ** 2)
    return float((longer * weight).sum() * (2 * radius_m - low) / 2)


class WallCounts(NamedTuple):
    """Image-mean signal per bin of unit total, and the share of it that arrives after the period."""

    histogram: np.ndarray
    wrapped: float


def wall_on_sensor(scene: Scene, sensor: Sensor, *, distance_m: float, per_side: int = 6) -> WallCounts:
    """Return a frontal wall on a sensor with a Gaussian pulse: the pulse's integral over bins of time, wrapped at the
    period.

    A ray at the cosine c from the axis has weight c^3 and path 2 d / c.
    """
    directions, weight = pixel_samples(scene.camera, per_side)
    pulse, cosine = sensor.pulse, -directions[..., 2]
    assert isinstance(pulse, Pulse)  # the integral below is a Gaussian's
    time = (2 * distance_m / cosine / SPEED_OF_LIGHT_M_PER_S).ravel()
    fraction = (cosine**3 * weight).ravel() / (cosine**3 * weight).sum()
    period = sensor.bins_per_period
    first = math.floor((time.min() - pulse.reach_s) / sensor.bin_width_s)
    last = math.ceil((time.max() + pulse.reach_s) / sensor.bin_width_s)
    edges = np.arange(first, last + 1)
    arrived = ndtr((edges[:, None] * sensor.bin_width_s - time) / pulse.sigma_s) @ fraction
    mass = np.diff(arrived)
    histogram = np.zeros(period)
    np.add.at(histogram, edges[:-1] % period, mass)
    return WallCounts(histogram[: sensor.bins], float(mass[edges[:-1] >= period].sum()))
