"""Units of an image's indirect light: where its paths are counted from, and the light that its amount is compared with.

Both are the direct light's, that which mirrors show among it. Where no pixel, or hardly any, has such light, a pilot's
indirect light takes its place: of a laser behind a corner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.direct.integrator import centre_layers
from render.indirect.camera_paths import energy_by_bounces
from render.indirect.integrator import IndirectTask, indirect_light, path_grid
from render.indirect.launch_layout import block_order
from render.indirect.light_vertices import sample_light_vertices
from render.indirect.schedule import uniform
from render.planning import pilot_pixels
from render.scene.traced_scene import TracedScene, UInt32, dr
from render.settings import MIN_SPP, Plan
from render.transient.samples import SampleBuffer, Samples

# Direct light in fewer of the pixels, and so many times darker than the mean indirect light, sets no scale: sums of
# fixed point hold samples of up to 2^17 times their scale.
FEW_LIT, FAINT = 1 / 16, 2.0**10
PILOT_SPP = 16, 256  # paths a pixel of the pilot, more where the first ones find nothing
BRIGHTEST = 16.0  # radiance of the brightest pixel, in units of the mean: a guess
LIT_LANES = 1 << 13  # paths for as many of which light vertices tell how bright the laser is


class LightScale(NamedTuple):
    """Units of indirect light.

    origin_m   path length of every flat pixel from which its cells widen: the direct return's, or where there is none
               that by way of what the pixel sees
    brightest  radiance that sets the fixed-point scale; 0 where no path finds light
    light      samples whose power and radiance error targets and clamps are counted in
    reasons    what is unusual about them, one line each
    """

    origin_m: np.ndarray
    brightest: float
    light: Samples
    reasons: tuple[str, ...] = ()


def light_scale(world: TracedScene, plan: Plan, direct: Samples, seed: int) -> LightScale:
    """Return the units of indirect light: those of direct light, or of a pilot where that is missing."""
    pixels = world.scene.camera.height * world.scene.camera.width
    origin_m, brightest = mean_path(direct, pixels)
    lit = origin_m > 0
    if not lit.all():
        origin_m = np.where(lit, origin_m, nearest_path(world))
    if lit.mean() >= FEW_LIT:
        return LightScale(origin_m, brightest, direct)
    indirect, paths = _mean_indirect(world, plan.bounces, seed)
    if indirect <= FAINT * brightest:
        reason = f"indirect light: none, {paths} paths of a pilot found no light, and no pixel is lit directly"
        return LightScale(origin_m, brightest, direct, () if brightest > 0 else (reason,))
    brightest = max(BRIGHTEST * indirect, _brightest_lit(world))
    grid = path_grid(world, origin_m, brightest, plan.bounces, plan.indirect_tolerance_m, plan.indirect_growth)
    blocks, light = block_order(np.arange(pixels), world.scene.camera.width), SampleBuffer()
    schedule = uniform(blocks, MIN_SPP, reuses_paths=False)
    indirect_light(IndirectTask(world, schedule, plan.bounces, seed, grid), np.empty(0, np.int64), light.add)
    reason = "indirect light: hardly any direct light is in view; its amount is compared with that of a pilot"
    return LightScale(origin_m, brightest, light.finished(), (reason,))


def _mean_indirect(world: TracedScene, bounces: int, seed: int) -> tuple[float, int]:
    """Estimate the mean indirect radiance of a pixel by the paths of a pilot; return it and their number."""
    chosen, energy, paths = pilot_pixels(world, seed), 0.0, 0
    for number, spp in enumerate(PILOT_SPP):
        energy = float(energy_by_bounces(world, chosen, spp, bounces, seed + number)[0].sum())
        paths += spp * len(chosen)
        if energy > 0:
            break
    return energy / len(chosen), paths


def _brightest_lit(world: TracedScene) -> float:
    """Return what a white surface scatters where a flood laser is brightest: a few paths of a pilot may miss the spot
    that others find, and sums would hold too little of it."""
    if world.scene.laser.mode != "flood":
        return 0.0
    key = dr.opaque(UInt32, 0), dr.opaque(UInt32, 1)
    return float(sample_light_vertices(world, LIT_LANES, 1, key).all().irradiance.numpy().max()) / math.pi


def mean_path(samples: Samples, pixels: int) -> tuple[np.ndarray, float]:
    """Return radiance-weighted mean path of each pixel [m], 0 where there is none; and the brightest pixel's
    radiance."""
    total = np.bincount(samples.pixel, weights=samples.radiance, minlength=pixels)
    moment = np.bincount(samples.pixel, weights=samples.radiance * samples.path_m, minlength=pixels)
    return np.divide(moment, total, out=np.zeros(pixels), where=total > 0), float(total.max(initial=0))


def nearest_path(world: TracedScene) -> np.ndarray:
    """Return the shortest path from the laser by way of the surface at every pixel's centre to the camera [m].

    Pixels that look into the void have that of the nearest surface; all of them the laser's distance and back where
    there is none.
    """
    camera = world.scene.camera
    laser, depth_m = world.scene.laser.position(camera), centre_layers(world).depth_m.astype(np.float64)
    point = camera.origin + camera.rays() * depth_m[..., None]
    path_m = (depth_m + np.linalg.norm(point - laser, axis=-1)).ravel()
    hit = np.isfinite(path_m)
    low, high = world.scene.bounds()
    fallback_m = path_m[hit].min() if hit.any() else 2 * float(np.linalg.norm(high - low))
    return np.where(hit, path_m, fallback_m)
