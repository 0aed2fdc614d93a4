"""Steady light of environment and area lights: paths from the camera to lights, whose way may lead through glass.

A window's light reaches a room through its panes, which stop the shadow rays of Mitsuba's own integrators: those find
it by chance alone. Here a straight line passes thin panes and the holes of cut-outs, to lights as to what is seen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Interactions, LobeSamples, Masks, Rays, UInts, Vectors
from render.direct.integrator import Layers
from render.scene.rays import MAX_LAYERS, camera_rays, shape_index, spawn
from render.scene.traced_scene import OPACITY, Bool, Float, TracedScene, UInt32, dr, mi, recorded, upload
from scenes.model import Camera

MAX_LANES = 1 << 18  # paths of one launch, where an image is not larger by itself
# Surfaces that every path may meet; from then on it goes on by chance where its weight has fallen below MIN_WEIGHT
# (in rooms a tenth to a quarter of the noise's square, at 1.4 times the cost, of going on with the weight itself).
CERTAIN, MIN_WEIGHT, MAX_LIKELY = 3, 1 / 6, 0.95
SETS = 8  # of a pixel's paths: positions in the pixel are even within each, and the noise is told by their differences
FIRST_SPP, MIN_MORE, MAX_MORE = 64, 1.25, 8  # paths a pixel whose noise tells how many times as many are needed
# Pixels share reflected light: a Gaussian of so many pixels, ended at that radius, of points that lie within a share of
# the distance of the tangent plane, weighted by the cosine between normals to this power of 2.
FILTER_SIGMA, FILTER_RADIUS, FILTER_PLANE, FILTER_NORMAL_DOUBLED = 2.0, 4, 0.02, 4


class AmbientLight(NamedTuple):
    """Radiance of each pixel [W/(m^2 sr nm)], (H, W) float32, its noise (rms over pixels by the image's mean), paths.

    Where pixels share their light (`bilateral_filter`) the noise is what is left of it; how far it is blurred is not in
    it.
    """

    radiance: np.ndarray
    error: float
    spp: int


def ambient_light(
    world: TracedScene, spp: int, bounces: int, seed: int, guide_layers: Layers | None = None, *, noise: float = 0.0
) -> AmbientLight:
    """Return steady spectral radiance of environment and area lights at each pixel, after up to `bounces - 1` surfaces.

    L(p) = E[sum over vertices of the path's weight and the light emitted there], with multiple importance sampling
    (balance heuristic) between lights and reflectance at every surface; unbiased. Same seed, same bytes. With
    `guide_layers` of the pixels' centres, neighbours share what is reflected (`bilateral_filter`): far less noise,
    biased. `spp` paths a pixel; where a `noise` is enough, as many as take the `AmbientLight.error` there, `spp` at
    most.
    """
    sums, wanted = _Sums(world), spp if noise == 0 else min(spp, FIRST_SPP)
    while True:
        sums.trace(wanted, bounces, seed)
        light = sums.light(guide_layers)
        if light.error <= noise or wanted == spp:
            return light
        # the first paths underrate what is rare: by steps
        more = min(max((light.error / noise) ** 2, MIN_MORE), MAX_MORE)
        wanted = min(spp, math.ceil(more * wanted))


class _Sums:
    """Light of the paths traced so far, `spp` of each pixel, and what its noise is told by."""

    def __init__(self, world: TracedScene) -> None:
        self.world, self.camera, self.spp = world, world.scene.camera, 0
        pixels = self.camera.height * self.camera.width
        # of what is emitted where it is seen, and of what is reflected: sample s belongs to set s modulo SETS
        self.sets = np.zeros((2, SETS, pixels))

    def trace(self, spp: int, bounces: int, seed: int) -> None:
        """Trace until there are `spp` paths of each pixel."""
        pixels = self.sets.shape[2]
        per_pass = max(1, MAX_LANES // pixels)
        while self.spp < spp:
            now = min(per_pass, spp - self.spp)
            lane = dr.arange(UInt32, pixels * now)
            dr.eval(lane)
            numbers = [dr.opaque(UInt32, number) for number in (seed & 0xFFFFFFFF, self.spp, now, bounces)]
            lights = self.world.recordings.call(self.world, "ambient", _of_paths, lane, *numbers)
            for sums, light in zip(self.sets, lights, strict=True):
                values = np.array(light, np.float64).reshape(pixels, now)
                for sample in range(min(now, SETS)):
                    sums[(self.spp + sample) % SETS] += values[:, sample::SETS].sum(axis=1)
            self.spp += now

    def light(self, guide_layers: Layers | None) -> AmbientLight:
        spp, shape = self.spp, (self.camera.height, self.camera.width)
        seen, reflected = self.sets
        emitted = seen.sum(axis=0) / spp
        mean = emitted + reflected.sum(axis=0) / spp
        of_emitted, noise2 = (_variance(sums, spp) for sums in (seen, seen + reflected))
        if guide_layers is not None:
            number = np.array([[spp - spp // 2], [spp // 2]])
            halves = np.stack([reflected[half::2].sum(axis=0) for half in (0, 1)])
            smooth = bilateral_filter((halves / np.maximum(number, 1)).reshape(2, *shape), guide_layers, self.camera)
            mean = emitted + (smooth.reshape(2, -1) * number).sum(axis=0) / spp
            noise2 = of_emitted + np.square(smooth[0] - smooth[1]).mean() / 4
        # numbers below the least normal one are 0 in some threads and not in others, whose files would differ
        mean = np.where(mean < np.finfo(np.float32).tiny, 0, mean)
        error = float(np.sqrt(noise2) / mean.mean()) if mean.any() else 0.0
        return AmbientLight(mean.reshape(shape).astype(np.float32), error, spp)


def _variance(sums: np.ndarray, spp: int) -> float:
    """Estimate the variance of the mean of `spp` samples, averaged over pixels, from their sums (SETS, pixels)."""
    count = np.array([len(range(one, spp, SETS)) for one in range(min(SETS, spp))])[:, None]
    off = sums[: len(count)] / count - sums.sum(axis=0) / spp
    return float((count * np.square(off)).sum(axis=0).mean() / (max(len(count) - 1, 1) * spp))


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


def _of_paths(
    world: TracedScene, lane: UInts, seed: UInts, first: UInts, paths: UInts, bounces: UInts
) -> tuple[Array, Array]:
    """Light of camera rays, `paths` in a row of each pixel from number `first` on: seen where emitted; reflected.

    Their positions in a pixel are a randomised (0, 2)-sequence in each set, as lamps may be smaller than a pixel.
    """
    pixel, sample = lane // paths, first + lane % paths
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed + first, dr.width(lane))
    key = mi.sample_tea_32(pixel * SETS + sample % SETS, seed)
    right, down = mi.radical_inverse_2(sample // SETS, key[0]), mi.sobol_2(sample // SETS, key[1])
    x, y = Float(pixel % world.width) + right, Float(pixel // world.width) + down
    found = _traced(world, sampler, camera_rays(world, x, y)[0], bounces)
    # a path across a face without a normal says nothing, as in `render.indirect.accumulators`
    return tuple(dr.select(dr.isfinite(light), light, 0) for light in found)


@dr.syntax
def _traced(world: TracedScene, sampler: Array, ray: Rays, most: UInts) -> tuple[Array, Array]:
    """Light that comes back along each ray: what the ray itself meets, and what surfaces reflect."""
    scene, context = world.mi_scene, mi.BSDFContext()
    lanes = dr.width(ray.d)
    seen, light, weight = dr.zeros(Float, lanes), dr.zeros(Float, lanes), dr.full(Float, 1, lanes)
    before = dr.zeros(mi.Interaction3f, lanes)  # the surface that the ray left, past all that it went straight through
    density = dr.full(Float, 1, lanes)  # of the ray's direction there; 0: no light could be sampled that way
    density = dr.select(weight > 0, 0, density)
    met, layer = dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes)
    ray, active = mi.Ray3f(ray), dr.full(Bool, True, lanes)
    while active:
        si = scene.ray_intersect(ray, active)
        emitter = si.emitter(scene, active)
        to_light = mi.DirectionSample3f(scene, si, before)
        chosen = active & (density > 0) & (emitter != None)  # noqa: E711 (an array of pointers)
        of_lights = scene.pdf_emitter_direction(before, to_light, chosen)
        fraction = dr.select(chosen, density / (density + of_lights), 1)
        found = dr.select(active, weight * fraction * emitter.eval(si, active)[0], 0)
        seen += dr.select(met == 0, found, 0)
        light += dr.select(met == 0, 0, found)

        hit = active & si.is_valid()
        passing, mirrored = _pane(world, si, ray, sampler.next_1d(active), hit)
        surface = hit & ~passing & ~mirrored
        bsdf = si.bsdf()
        going_on = met + 1 < most
        lit = surface & going_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample, emitted = scene.sample_emitter_direction(si, sampler.next_2d(lit), False, lit)
        lit &= sample.pdf > 0
        value, of_bsdf = bsdf.eval_pdf(context, si, si.to_local(sample.d), lit)
        lit &= value[0] > 0
        fraction = dr.select(sample.delta, 1, sample.pdf / (sample.pdf + of_bsdf))
        light += dr.select(lit, weight * value[0] * emitted[0] * fraction * _open(world, si, sample, lit), 0)

        bounce, reflected = bsdf.sample(context, si, sampler.next_1d(surface), sampler.next_2d(surface), surface)
        onward = si.to_world(bounce.wo)
        mirror = ray.d - 2 * dr.dot(ray.d, si.n) * si.n
        direction = dr.select(passing, ray.d, dr.select(mirrored, mirror, onward))
        weight = dr.select(surface, weight * reflected[0], weight)
        smooth = surface & ~mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta)
        density = dr.select(smooth, bounce.pdf, dr.select(passing, density, 0))
        before.p = dr.select(passing, before.p, si.p)
        met += dr.select(passing, UInt32(0), UInt32(1))
        layer += dr.select(passing, UInt32(1), UInt32(0))
        likely = dr.select((met >= CERTAIN) & ~passing, dr.minimum(weight / MIN_WEIGHT, MAX_LIKELY), 1)
        active = hit & going_on & (layer < MAX_LAYERS) & (sampler.next_1d(active) < likely)
        weight /= dr.maximum(likely, 1e-9)
        active &= weight > 0
        ray = spawn(si, direction)
    return seen, light


def _pane(world: TracedScene, si: Interactions, ray: Rays, sample: LobeSamples, hit: Masks) -> tuple[Array, Array]:
    """Return whether a ray passes straight through what it hits (thin glass, the hole of a cut-out), and whether thin
    glass mirrors it."""
    passing, mirrored = Bool(False), Bool(False)
    if world.has_glass:
        thin = dr.gather(Float, world.thin_ior, shape_index(si), hit)
        passing = hit & (thin > 0) & (sample < _transmission(thin, ray, si))
        mirrored = hit & (thin > 0) & ~passing
    if world.has_cutouts:
        hole = hit & (si.shape.eval_attribute_1(OPACITY, si, hit) < 0.5)
        passing, mirrored = passing | hole, mirrored & ~hole
    return passing, mirrored


def _transmission(ior: Array, ray: Rays, si: Interactions) -> Array:
    """Compute the transmittance of a thin pane with all its inner reflections, (1 - F) / (1 + F)."""
    fresnel = mi.fresnel(dr.abs(dr.dot(ray.d, si.n)), dr.maximum(ior, 1.0001))[0]
    return (1 - fresnel) / (1 + fresnel)


@dr.syntax
def _open(world: TracedScene, si: Interactions, to_light: Vectors, active: Masks) -> Array:
    """Compute the transmission of the straight way from a surface to a sampled light; solid glass blocks it, as it
    bends light."""
    ray = si.spawn_ray_to(to_light.p)
    transmission = dr.full(Float, 1, dr.width(ray.d))
    if dr.hint(not world.sees_through, mode="scalar"):
        transmission = dr.select(world.mi_scene.ray_test(ray, active), Float(0), Float(1))
    else:
        layer, searching, end = dr.zeros(UInt32, dr.width(ray.d)), Bool(active), ray.o + ray.d * ray.maxt
        while searching:
            # most rays are stopped or meet nothing: all about a point is worked out only where it matters
            first = world.mi_scene.ray_intersect_preliminary(ray, coherent=False, active=searching)
            hit = searching & first.is_valid()
            thin = dr.gather(Float, world.thin_ior, shape_index(first), hit)
            passing = hit & (thin > 0)
            other = first.compute_surface_interaction(ray, mi.RayFlags.All, hit if world.has_cutouts else passing)
            let = dr.select(passing, _transmission(thin, ray, other), 0)
            if dr.hint(world.has_cutouts, mode="scalar"):
                hole = hit & (other.shape.eval_attribute_1(OPACITY, other, hit) < 0.5)
                passing, let = passing | hole, dr.select(hole, 1, let)
            transmission = dr.select(hit, transmission * let, transmission)
            layer += 1
            searching = passing & (layer < MAX_LAYERS)
            ray = spawn(other, ray.d)
            ray.maxt = dr.dot(end - ray.o, ray.d)
            searching &= ray.maxt > 0
    return transmission
