"""Paths that begin at the laser, on polished surfaces: light that these throw on what the camera sees.

A path L, x1, x2, ..., xk, x1 polished, is light of the pixel that shows xk. Paths are spread evenly, n a pixel, over an
image that the laser would take (`render.indirect.glossy`). With W the weight of the path up to xk (reflectance over
density) and f the reflectance there, one of them adds to the pixel

    X = c W f cos I / (n d^2) (o / (cos a)^3) prod_m [cos_s / cos_g](in) [cos_g / cos_s](out),

where d is the way from xk to the camera, cos the cosine of that way, a its angle to the optical axis, I the laser's
intensity, and o the solid angle of the laser's pixel in that of a pixel on the axis: a pixel of an image plane sees
(cos a)^3 of it. Shading normals s instead of true ones g make reflection unsymmetrical (Veach 1997, section 5.3): the
product runs over x1 (in from the laser) to xk (out to the camera). c is the share that other paths leave to these
(`render.indirect.glossy`). X is less by what glass on the way stops; solid glass spreads the laser's light otherwise
(`render.scene.rays.spreading`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Generators, UInts
from render.indirect.glossy import (
    RATIO,
    finite_ratio,
    glossy_of,
    is_glossy,
    laser_rays,
    light_share,
    lobe_density,
    ratio_at_camera,
    ratio_of_light_path,
    reversal_of_sample,
)
from render.indirect.retro_paths import has_retro_paths, retro_ratio
from render.scene.rays import (
    first_opaque,
    in_beam,
    pixel_of,
    sample_bsdf,
    segment,
    shading_ratio,
    spawn,
    to_camera,
)
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi, upload

LIGHT_PATHS_PER_LAUNCH = 1 << 17  # of one launch


class LightPathSplats(NamedTuple):
    """Light that some paths throw on other pixels: flat pixel, path [m], radiance over the number of paths, batch."""

    pixel: np.ndarray
    path_m: np.ndarray
    radiance: np.ndarray
    batch: np.ndarray


def trace_light_paths(
    world: TracedScene, paths: float, batches: int, bounces: int, seed: int
) -> Iterator[LightPathSplats]:
    """Trace RATIO times `paths` paths for every polished pixel, fewer for others, launch by launch.

    A flood's intensity is the same everywhere.
    """
    glossy = glossy_of(world)
    if glossy is None:
        return
    sampling_density = np.array(glossy.sampling_density, np.float64)[: int(glossy.width[0]) * int(glossy.height[0])]
    counts = np.ceil(RATIO * paths * sampling_density).astype(np.int64)
    ends = np.cumsum(counts)
    parts = np.linspace(0, ends[-1], math.ceil(ends[-1] / LIGHT_PATHS_PER_LAUNCH) + 1).astype(np.int64)
    keys = [dr.opaque(UInt32, int(number)) for number in np.random.SeedSequence(seed).generate_state(2)]
    for begin, end in pairwise(parts):
        lane = np.arange(begin, end)
        pixel = np.searchsorted(ends, lane, side="right")
        number = lane - (ends - counts)[pixel]
        batch = (number + pixel) % batches
        columns = [upload(UInt32, column) for column in (pixel, lane, number // batches, batch)]
        found = _trace_launch(world, columns, keys, bounces)
        dr.eval(found)
        target, path, radiance = (values.numpy() for values in found)
        kept = np.flatnonzero(radiance)
        radiance = radiance[kept].astype(np.float64) / counts[pixel[kept % len(lane)]]
        yield LightPathSplats(target[kept].astype(np.int64), path[kept], radiance, batch[kept % len(lane)])


def _trace_launch(world: TracedScene, columns: Sequence[Array], keys: Sequence[Array], bounces: int) -> tuple:
    """Trace light paths; return target pixels, paths and radiances, (bounces - 1) x lanes flat."""
    lanes = dr.width(columns[0])
    targets = dr.zeros(UInt32, lanes * (bounces - 1))
    paths, values = dr.zeros(Float, lanes * (bounces - 1)), dr.zeros(Float, lanes * (bounces - 1))
    dr.eval(targets, paths, values)
    numbers = dr.opaque(UInt32, lanes), dr.opaque(UInt32, bounces - 1)
    given = tuple(columns), tuple(keys), numbers, (targets, paths, values)
    key = "light paths", bounces, has_retro_paths(world)
    return world.recordings.call(world, key, _light_paths, *given)


@dr.syntax
def _light_paths(
    world: TracedScene, columns: tuple, keys: tuple, numbers: tuple, found: tuple
) -> tuple[Array, Array, Array]:
    (pixel, lane, number, batch), (stride, last), (targets, paths, values) = columns, numbers, found
    lanes, place = dr.width(lane), dr.arange(UInt32, dr.width(lane))
    key = mi.sample_tea_32(lane ^ keys[0], keys[1])
    random = mi.PCG32(initstate=mi.UInt64(key[0]), initseq=mi.UInt64(key[1]))
    si, path, sample, value, active = _sample_first_vertex(world, pixel, number, batch, keys, random)
    begun, start, ratio = Bool(True), mi.SurfaceInteraction3f(si), dr.zeros(Float, lanes)
    slot, way_back = dr.zeros(UInt32, lanes), dr.full(Float, 1, lanes)
    while active:
        towards, before = spawn(si, si.to_world(sample.wo)), mi.Point3f(si.p)
        si, transmission, leg, _ = first_opaque(world, towards, active, before)
        active &= si.is_valid()
        path += leg
        value *= transmission
        if begun:
            ratio = finite_ratio(ratio_of_light_path(world, pixel, start, towards.d, active))
            begun = Bool(False)
        target, seen = pixel_of(world, si.p)
        # the camera has to see it; the laser need not shine on it
        passed, back = segment(world, si, world.eye, active & seen, spread=False)
        local, distance = to_camera(world, si.p - world.eye), dr.norm(world.eye - si.p)
        out = si.to_local((world.eye - si.p) / distance)
        light = si.bsdf().eval(mi.BSDFContext(), si, out, active)[0] * value
        light *= passed / dr.square(distance)
        own, other = finite_ratio(ratio * ratio_at_camera(world, si, -towards.d, active)), Float(0)
        if dr.hint(has_retro_paths(world), mode="scalar"):
            start_way = dr.normalize(start.p - before)
            other = dr.select(slot == 1, retro_ratio(world, si, before, start_way, way_back, active), 0)
        light *= light_share(own, other)
        light *= shading_ratio(si, si.wi) / shading_ratio(si, out) * (distance / local.z) ** 3
        light = dr.select(active & seen & dr.isfinite(light), dr.maximum(light, 0), 0)
        dr.scatter(targets, target, slot * stride + place, active)
        dr.scatter(paths, path + back, slot * stride + place, active)
        dr.scatter(values, light, slot * stride + place, active)
        slot += 1
        active &= slot < last
        sample, again = sample_bsdf(si, random, active)
        through = again[0]
        survive = dr.clip(through, 0.05, 0.95)
        active &= (through > 0) & (random.next_float32() < survive)
        value *= through / survive * shading_ratio(si, si.wi) / shading_ratio(si, sample.wo)
        active &= dr.isfinite(value)
        if dr.hint(has_retro_paths(world), mode="scalar"):
            smooth = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
            way_back = dr.select(smooth, dr.inf, lobe_density(si, sample.wo, si.wi, active & ~smooth))
        ratio = finite_ratio(ratio / reversal_of_sample(si, sample, active))
    return targets, paths, values


def _sample_first_vertex(
    world: TracedScene, pixel: UInts, number: UInts, batch: UInts, keys: Sequence[Array], random: Generators
) -> tuple[Array, ...]:
    """Sample x1: the vertex, the path to it, a sample of where light goes from there, its value, and whether there is
    any."""
    glossy, intensity = glossy_of(world), dr.gather(Float, world.intensity, UInt32(0))
    assert glossy is not None
    jitter = mi.Point2f(random.next_float32(), random.next_float32())
    ray, solid_angle = laser_rays(world, pixel, jitter.x, jitter.y, glossy)
    si, _, path, _ = first_opaque(world, ray, dr.full(Bool, True, dr.width(pixel)))
    active = is_glossy(world, si, si.is_valid()) & in_beam(world, si.p, pixel)
    # one randomised (0, 2)-sequence a pixel and batch
    shift = mi.sample_tea_32(pixel ^ keys[1], batch ^ keys[0])
    first = mi.radical_inverse_2(number, shift[0]), mi.sobol_2(number, shift[1])
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, random.next_float32(), mi.Point2f(*first), active)
    if world.sees_through:
        intensity *= segment(world, si, world.laser, active)[0]
    value = intensity * weight[0] * solid_angle * shading_ratio(si, si.wi) / shading_ratio(si, sample.wo)
    return si, path, sample, value, active & (value > 0)
