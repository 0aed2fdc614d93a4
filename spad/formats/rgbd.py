"""RGB-D images: the simulation of the ICCV 2023 paper's supplement S.5.1, in two conventions.

`transient_from_rgbd` makes a transient, one return a depth sample: the pulse's centroid at 2 d / c, radiance
albedo cos(theta) / (pi d^2), everything else as for a rendered scene. `published_from_rgbd` follows the paper's code:
one return a pixel at the rounded bin, albedo / d^2 without a cosine, c = 3e8 m/s.
"""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np

from render.transient import Transient
from scenes.errors import InputError, require, require_kind, require_number, require_whole
from scenes.json_types import JsonObject
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse, SampledPulse

log = logging.getLogger(__name__)

PUBLISHED_SPEED_OF_LIGHT_M_PER_S = 3e8
MIXED_M = 0.05
FAR_M = 1e3  # depths beyond are likely in millimetres, as 16-bit images hold them
ONE_SURFACE = 0.01  # samples whose depths differ by at most this share of their mean lie on one surface


class Expected(NamedTuple):
    """Expected primary detections of an RGB-D image.

    rates        (H, W, T) float64 per exposure
    depth_m      (H, W) float64: the label that the convention trains and tests on
    signal, background   (H, W) float64 per exposure
    """

    rates: np.ndarray
    depth_m: np.ndarray
    signal: np.ndarray
    background: np.ndarray


def _alike(*images: np.ndarray) -> list[np.ndarray]:
    try:
        given = [np.ma.asarray(image) for image in images]
    except (TypeError, ValueError) as error:
        raise InputError(f"RGB-D images: not an array of numbers ({error})") from None
    for image in given:
        require(image.dtype.kind in "uif", f"RGB-D images: not an array of numbers (of {image.dtype})")
    arrays = [np.ma.filled(image.astype(np.float64), np.nan) for image in given]
    shapes = {array.shape for array in arrays}
    if len(shapes) != 1 or arrays[0].ndim != 2 or not arrays[0].size:
        raise InputError(f"RGB-D images of shapes {sorted(shapes)}, expected one of (H, W) for all")
    return arrays


def _check_values(depth: np.ndarray, albedo: np.ndarray, ambient: np.ndarray) -> None:
    good = np.isfinite(albedo) & np.isfinite(ambient) & (albedo >= 0) & (ambient >= 0)
    require(bool(good.all()), "RGB-D images: albedo and ambient light must be finite and 0 or more")
    least = float(depth.min(initial=0.0, where=depth < 0))
    require(least >= 0, f"RGB-D images: a depth of {least:g} m, expected 0 or more, or none (NaN)")
    seen = np.isfinite(depth) & (depth > 0)
    if not seen.any():
        log.warning("RGB-D images: no depth is finite and above 0, nothing is seen")
    farthest = float(depth.max(where=seen, initial=0.0))
    if farthest > FAR_M:
        log.warning("RGB-D images: depths of up to %.5g m: are they in millimetres? Metres are expected", farthest)


def transient_from_rgbd(
    depth_m: np.ndarray,
    albedo: np.ndarray,
    ambient: np.ndarray,
    *,
    fov_deg: float | None = None,
    block: int = 1,
    meta: JsonObject | None = None,
) -> Transient:
    """Return RGB-D images as a transient of point returns at path 2 d, lit by a radiant intensity of 1 W/sr at the
    camera.

    With `block` b the images are b times finer than the sensor: a pixel sees the returns of its b x b samples, each
    1 / b^2 of its footprint, so that an edge gives two returns and no depth in between. Labels (depth and albedo) are
    those at the pixel's centre: of its sample where b is odd. Where b is even the centre is the corner of four samples,
    and labels are their mean where their depths differ by at most 1 % of it, else those of the lower right one. Ambient
    light is the mean. `fov_deg` is the full horizontal angle that the cosine of incidence is taken with, from the depth
    image itself; None for surfaces that face the camera. Samples without depth (not finite, or 0) return nothing; a
    pixel with samples more than 50 mm apart, or partly nowhere, is mixed.
    `depth_m` [m], `albedo` and `ambient` [W/(m2 sr nm)] are (H, W). Raises InputError for images of other shapes or
    without numbers, sides that `block` does not divide, negative depth, and albedo or ambient light that is
    negative or not finite. No depth, and depth beyond 1 km (millimetres?), are warned of. `Transient` has an example.
    """
    depth, albedo, ambient = _alike(depth_m, albedo, ambient)
    block = require_whole(block, "RGB-D images: block")
    require(
        block >= 1 and all(side % block == 0 for side in depth.shape),
        f"RGB-D images of {depth.shape[0]} x {depth.shape[1]} are no whole number of blocks of {block}",
    )
    _check_values(depth, albedo, ambient)
    require_kind({} if meta is None else meta, dict, "RGB-D images: meta")
    seen = np.isfinite(depth) & (depth > 0)
    depth = np.where(seen, depth, np.nan)
    cosine = np.ones_like(depth) if fov_deg is None else cosine_of_incidence(depth, fov_deg)
    radiance = np.where(seen, albedo * cosine / (np.pi * np.where(seen, depth, 1) ** 2), 0) / block**2
    height, width = depth.shape[0] // block, depth.shape[1] // block

    order = np.argsort(_blocks(depth, block), axis=1)  # NaN last
    samples, energy = (np.take_along_axis(_blocks(image, block), order, axis=1) for image in (depth, radiance))
    kept = np.isfinite(samples)
    number = kept.sum(axis=1)
    extent = np.where(number > 0, np.nan_to_num(samples).max(axis=1) - np.nan_to_num(samples[:, 0]), 0)
    path, shape = (2 * samples[kept]).astype(np.float32), (height, width)
    depth_label, albedo_label = _at_centres(depth, albedo, block)
    return Transient(
        height,
        width,
        np.concatenate(([0], np.cumsum(number))).astype(np.int64),
        path,
        path,
        energy[kept].astype(np.float32),
        np.ones(len(path), np.uint8),
        depth_m=depth_label.astype(np.float32),
        normal=np.zeros((*shape, 3), np.float16),
        albedo=albedo_label.astype(np.float16),
        ambient=_blocks(ambient, block).mean(axis=1).reshape(shape).astype(np.float32),
        mixed=((extent > MIXED_M) | (number % block**2 > 0)).reshape(shape),
        error=np.zeros(shape, np.float32),
        meta={"scene": "RGB-D", **(meta or {})},
    )


def _blocks(image: np.ndarray, block: int) -> np.ndarray:
    """Return the samples of every pixel, (H b, W b) -> (H W, b b)."""
    height, width = (side // block for side in image.shape)
    return image.reshape(height, block, width, block).swapaxes(1, 2).reshape(height * width, block * block)


def _at_centres(depth: np.ndarray, albedo: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and albedo at the centres of pixels of b x b samples, (H b, W b) -> (H, W) each."""
    middle = block // 2
    lower_right = depth[middle::block, middle::block], albedo[middle::block, middle::block]
    if block % 2:
        return lower_right
    starts = [(down, right) for down in (middle - 1, middle) for right in (middle - 1, middle)]
    depths, albedos = (np.stack([one[down::block, right::block] for down, right in starts]) for one in (depth, albedo))
    mean = depths.mean(axis=0)  # NaN where one has no depth, and then not alike
    alike = depths.max(axis=0) - depths.min(axis=0) <= ONE_SURFACE * mean
    return np.where(alike, mean, lower_right[0]), np.where(alike, albedos.mean(axis=0), lower_right[1])


def cosine_of_incidence(depth_m: np.ndarray, fov_deg: float) -> np.ndarray:
    """Return |normal . ray| of the surface through the points depth x ray of a pinhole camera, (H, W); 1 where unknown.

    Tangents are the shorter of the differences to both neighbours, so that an edge does not count as a slope.
    """
    fov_deg = require_number(fov_deg, "RGB-D images: fov_deg")
    require(0 < fov_deg < 180, f"field of view {fov_deg:g} degrees is outside 0 to 180")
    height, width = depth_m.shape
    focal = width / 2 / math.tan(math.radians(fov_deg) / 2)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x, y, np.full_like(x, focal)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points = depth_m[..., None] * rays
    normal = np.cross(_tangent(points, 1), _tangent(points, 0))
    length = np.linalg.norm(normal, axis=-1)
    cosine = np.abs((normal * rays).sum(axis=-1)) / np.where(length > 0, length, 1)
    return np.where((length > 0) & np.isfinite(cosine), cosine, 1.0)


def _tangent(points: np.ndarray, axis: int) -> np.ndarray:
    step = np.diff(points, axis=axis)
    nothing = np.full_like(np.take(points, [0], axis=axis), np.nan)
    before, after = np.concatenate([nothing, step], axis=axis), np.concatenate([step, nothing], axis=axis)
    length = [np.nan_to_num(np.linalg.norm(part, axis=-1), nan=np.inf) for part in (before, after)]
    return np.where((length[0] < length[1])[..., None], before, after)


# Published


def published_from_rgbd(
    depth_m: np.ndarray, albedo: np.ndarray, ambient: np.ndarray, sensor: Sensor, budget: PhotonBudget
) -> Expected:
    """Return expected counts of an RGB-D image as the published code computes them: radial depth [m],
    albedo and ambient light of any scale, (H, W) each.

    beta = round(2 d / (c Delta)) modulo T, 1 or more; S = signal a / d^2 over its mean; A = dark counts + background b
    over its mean, rescaled to the asked mean; rate = S h + A / T with the largest sample of the published taps h at bin
    beta, from 1; the label is beta - 1 bins. Raises InputError for arrays of different shapes, depth that is not
    finite, bins that do not cover the period or are unequal, and a pulse of other taps.
    """
    sensor.check_equal_bins("published convention")
    depth, albedo, ambient = _alike(depth_m, albedo, ambient)
    require(bool(np.isfinite(depth).all() and (depth > 0).all()), "published convention: every pixel needs a depth")
    require(sensor.bins == sensor.bins_per_period, "published convention: the bins must cover the period")
    require(float(albedo.mean()) > 0, "published convention: the albedo is 0 everywhere")
    bins, speed = sensor.bins, PUBLISHED_SPEED_OF_LIGHT_M_PER_S
    beta = np.floor(2 * depth / (speed * sensor.bin_width_s) + 0.5).astype(np.int64) % bins
    beta = np.maximum(beta, 1)
    amplitude = albedo / depth**2
    signal = budget.signal * amplitude / amplitude.mean()
    dark = sensor.dark_rate_map_hz(*depth.shape) * sensor.exposure_s
    light = budget.background * (ambient / ambient.mean() if ambient.any() else np.ones_like(ambient))
    both = dark + light
    scale = budget.background / both.mean() if both.any() else 0.0
    taps = published_taps(sensor)
    rates = np.repeat((both * scale / bins)[..., None], bins, axis=2)
    rows, columns = np.indices(depth.shape)
    peak = int(taps.argmax())
    for tap, fraction in enumerate(taps):  # no two taps in one bin, as there are fewer than bins
        rates[rows, columns, (beta - 1 + tap - peak) % bins] += signal * fraction
    label = (beta - 1) * (speed * sensor.bin_width_s / 2)
    return Expected(rates, label, signal, both * scale)


def published_taps(sensor: Sensor) -> np.ndarray:
    """Return the pulse as the published code has it, one sample a bin and unit sum: (L,) float64.

    Measured samples in steps of a bin are taken as they are. A Gaussian of L = 2 sigma bins is sampled at
    i = 1 .. floor(8 L) around (8 L - 1) / 2 with sigma = L / 2: at 270 ps and 97.66 ps bins its centroid is 0.44 bins
    before its largest sample. Raises InputError for other pulses, jitter of detector or clock, and more taps than bins.
    """
    require(not sensor.jitters, f"published convention: no jitter of detector or clock, sensor {sensor.name} has one")
    pulse, width = sensor.pulse, sensor.bin_width_s
    if isinstance(pulse, SampledPulse) and math.isclose(pulse.sample_s, width, rel_tol=1e-9):
        taps = np.asarray(pulse.samples)
    else:
        if not isinstance(pulse, Pulse) or pulse.tail_s:
            raise InputError("published convention: the pulse must be Gaussian, or measured in steps of a bin")
        length = 2 * pulse.sigma_s / width
        sample = np.arange(1, math.floor(8 * length) + 1)
        require(len(sample) > 0, f"published convention: a pulse of {length / 2:g} bins has no sample")
        taps = np.exp(-0.5 * ((sample - (8 * length - 1) / 2) / (length / 2)) ** 2)
    require(len(taps) <= sensor.bins, f"published convention: {len(taps)} taps for {sensor.bins} bins")
    return taps / taps.sum()
