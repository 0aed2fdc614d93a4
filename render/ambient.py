"""Steady light of environment and area lights: paths from the camera to lights, whose way may lead through glass.

A window's light reaches a room through its panes, which stop the shadow rays of Mitsuba's own integrators: those find
it by chance alone. Here a straight line passes thin panes and the holes of cut-outs, to lights as to what is seen.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from render.rays import MAX_LAYERS, camera_rays, shape_index, spawn
from render.world import OPACITY, Bool, Float, UInt32, World, dr, mi

MOST_LANES = 1 << 18  # paths of one launch, where an image is not larger by itself
CERTAIN = 3  # surfaces that every path may meet; from then on it goes on with the probability of its weight
MOST_LIKELY = 0.95


class AmbientLight(NamedTuple):
    """Radiance of each pixel [W/(m^2 sr nm)], (H, W) float32, and its noise: rms over pixels by the image's mean."""

    radiance: np.ndarray
    error: float


def ambient_light(world: World, spp: int, bounces: int, seed: int) -> AmbientLight:
    """Steady spectral radiance of environment and area lights at each pixel, after up to `bounces - 1` surfaces.

    L(p) = E[sum over vertices of the path's weight and the light emitted there], with multiple importance sampling
    (balance heuristic) between lights and reflectance at every surface; unbiased. Same seed, same bytes.
    """
    camera = world.scene.camera
    pixels = camera.height * camera.width
    per_pass = min(spp, max(1, MOST_LANES // pixels))
    total, squares, left = np.zeros(pixels), np.zeros(pixels), spp
    while left > 0:
        now = min(per_pass, left)
        lane = dr.arange(UInt32, pixels * now)
        dr.eval(lane)
        numbers = [dr.opaque(UInt32, number) for number in ((seed + left) & 0xFFFFFFFF, now, bounces)]
        light = world.recordings.call(world, "ambient", _of_paths, lane, *numbers)
        of_pixel = np.array(light, np.float64).reshape(pixels, now)
        total, squares, left = total + of_pixel.sum(axis=1), squares + (of_pixel**2).sum(axis=1), left - now
    mean = total / spp
    variance = np.maximum(squares / spp - mean**2, 0) / max(spp - 1, 1)
    error = float(np.sqrt(variance.mean()) / mean.mean()) if mean.any() else 0.0
    return AmbientLight(mean.reshape(camera.height, camera.width).astype(np.float32), error)


def _of_paths(world: World, lane: Any, seed: Any, paths: Any, bounces: Any) -> Any:
    """Light of camera rays, `paths` in a row through random positions of each pixel."""
    pixel = lane // paths
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(lane))
    shift = sampler.next_2d()
    x, y = Float(pixel % world.width) + shift.x, Float(pixel // world.width) + shift.y
    return _traced(world, sampler, camera_rays(world, x, y)[0], bounces)


@dr.syntax
def _traced(world: World, sampler: Any, ray: Any, most: Any) -> Any:
    """Light that comes back along each ray."""
    scene, context = world.traced, mi.BSDFContext()
    lanes = dr.width(ray.d)
    light, weight = dr.zeros(Float, lanes), dr.full(Float, 1, lanes)
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
        share = dr.select(chosen, density / (density + of_lights), 1)
        light += dr.select(active, weight * share * emitter.eval(si, active)[0], 0)

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
        share = dr.select(sample.delta, 1, sample.pdf / (sample.pdf + of_bsdf))
        light += dr.select(lit, weight * value[0] * emitted[0] * share * _open(world, si, sample, lit), 0)

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
        likely = dr.select((met >= CERTAIN) & ~passing, dr.minimum(weight, MOST_LIKELY), 1)
        active = hit & going_on & (layer < MAX_LAYERS) & (sampler.next_1d(active) < likely)
        weight /= dr.maximum(likely, 1e-9)
        active &= weight > 0
        ray = spawn(si, direction)
    return light


def _pane(world: World, si: Any, ray: Any, sample: Any, hit: Any) -> tuple[Any, Any]:
    """Whether a ray passes straight through what it meets, thin glass or the hole of a cut-out, or glass mirrors it."""
    passing, mirrored = Bool(False), Bool(False)
    if world.has_glass:
        thin = dr.gather(Float, world.thin_ior, shape_index(si), hit)
        passing = hit & (thin > 0) & (sample < _transmission(thin, ray, si))
        mirrored = hit & (thin > 0) & ~passing
    if world.has_cutouts:
        hole = hit & (si.shape.eval_attribute_1(OPACITY, si, hit) < 0.5)
        passing, mirrored = passing | hole, mirrored & ~hole
    return passing, mirrored


def _transmission(ior: Any, ray: Any, si: Any) -> Any:
    """Of a thin pane with all its inner reflections, (1 - F) / (1 + F)."""
    fresnel = mi.fresnel(dr.abs(dr.dot(ray.d, si.n)), dr.maximum(ior, 1.0001))[0]
    return (1 - fresnel) / (1 + fresnel)


@dr.syntax
def _open(world: World, si: Any, to_light: Any, active: Any) -> Any:
    """Transmission of the straight way from a surface to a sampled light; solid glass blocks it, as it bends light."""
    ray = si.spawn_ray_to(to_light.p)
    transmission = dr.full(Float, 1, dr.width(ray.d))
    if dr.hint(not world.sees_through, mode="scalar"):
        transmission = dr.select(world.traced.ray_test(ray, active), Float(0), Float(1))
    else:
        layer, searching, end = dr.zeros(UInt32, dr.width(ray.d)), Bool(active), ray.o + ray.d * ray.maxt
        while searching:
            # most rays are stopped or meet nothing: all about a point is worked out only where it matters
            first = world.traced.ray_intersect_preliminary(ray, coherent=False, active=searching)
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
