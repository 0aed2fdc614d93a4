"""Trace paths of ambient light that begin at lamps and go by way of mirrors, or of glass that bends light.

A lamp in a bulb of thick glass, or its image in a mirror, lights a wall. A path from the wall meets the mirror by rare
chance where that sends the lamp's light, and is as bright then as the lamp. A path from the lamp finds the wall. Paths
L, m1, ..., mj, x1, ..., xk are traced, whose first surfaces m are mirrors to them and whose x1 scatters light; each of
the x is joined with the camera in a straight line. With P the power that the path carries (radiance over density, at
first) and f the reflectance at x, one of n adds to the pixel that shows x

    X = P T f cos F^2 / (n d^2 cos^3 a) [cos_s / cos_g](in) [cos_g / cos_s](out),

where T is the transmission of the straight way of length d to the camera, F its focal length in pixels, and a that
way's angle to the optical axis: a pixel of the image plane sees (cos a)^3 / F^2 of solid angle. Shading normals s
instead of true ones g make reflection unsymmetrical (Veach 1997, section 5.3), at every vertex. Light of an environment
is left to the camera's paths, and so is what the camera sees by way of a mirror.
"""

from __future__ import annotations

import numpy as np

from render.ambient.camera_paths import SETS, survival
from render.ambient.panes import mirrored_direction, pane_event, shines, straight_transmission
from render.backend.drjit_types import Array, Floats, Generators, UInts
from render.indirect.path_cells import scatter_add_fixed_point
from render.scene.rays import MAX_LAYERS, pixel_of, shading_ratio, spawn, to_camera
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi

PATHS_PER_PIXEL = 0.25  # that begin at lamps, for every path of the camera
QUANTA = 2.0**32  # of a sum of fixed point, whose order does not matter, in the radiance of the brightest lamp
KEY = 0x6C616D70


def trace_light_paths(world: TracedScene, first: int, paths: int, bounces: int, seed: int) -> np.ndarray:
    """Return light by way of mirrors for camera paths `first` to `first + paths` of each pixel: sums over such paths,
    (SETS, pixels) float64, sample s in row s modulo SETS."""
    pixels = world.scene.camera.height * world.scene.camera.width
    number = max(1, round(PATHS_PER_PIXEL * pixels))
    per_quantum = QUANTA / max(surface.emission for surface in world.scene.surfaces)
    numbers = tuple(dr.opaque(UInt32, one) for one in (seed & 0xFFFFFFFF, first, number, bounces))
    scale = dr.opaque(Float, per_quantum / number)
    sums = _splats(world, dr.arange(UInt32, number * paths), numbers, pixels, scale)
    dr.eval(sums)
    return sums.numpy().reshape(SETS, pixels) / per_quantum


def _splats(
    world: TracedScene,
    lane: UInts,
    numbers: tuple[UInts, UInts, UInts, UInts],
    pixels: int,
    scale: Floats,
) -> Array:
    """Trace paths and add what the camera sees of each, (SETS * pixels,) in fixed point.

    `numbers` are the seed, the first sample, paths in a row for each sample, and the most bounces.
    """
    seed, first, number, most = numbers
    key = mi.sample_tea_32(lane, (seed + first) ^ KEY)
    random = mi.PCG32(initstate=mi.UInt64(key[0]), initseq=mi.UInt64(key[1]))
    sums = dr.zeros(mi.UInt64, SETS * pixels)
    row = ((first + lane // number) % SETS) * dr.opaque(UInt32, pixels)
    _trace(world, random, row, most, scale, sums)
    return sums


@dr.syntax
def _trace(world: TracedScene, random: Generators, row: UInts, most: UInts, scale: Floats, sums: UInts) -> None:
    """Follow paths from lamps; where one scatters light that mirrors threw, add what the camera sees to row + pixel."""
    scene, context = world.mi_scene, mi.BSDFContext(mi.TransportMode.Importance)
    lanes = dr.width(row)
    where = mi.Point2f(random.next_float32(), random.next_float32())
    way = mi.Point2f(random.next_float32(), random.next_float32())
    ray, power, emitter = scene.sample_emitter_ray(0, random.next_float32(), way, where, Bool(True))
    ray, start = mi.Ray3f(ray), power[0]
    active = (start > 0) & ~mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
    begin = emitter.sample_position(0, way, active)[0]  # by the number that placed the ray
    active &= shines(world, emitter.get_shape(), begin, active)
    weight = dr.full(Float, 1, lanes)  # of the reflectance so far
    met, layer, by_mirror = dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes), dr.full(Bool, False, lanes)
    while active:
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        passing, mirrored = pane_event(world, si, ray, random.next_float32(), hit)
        surface = hit & ~passing & ~mirrored
        arriving = shading_ratio(si, si.wi)
        bsdf = si.bsdf()

        target, seen = pixel_of(world, si.p)
        way_out = world.eye - si.p
        distance = dr.norm(way_out)
        out = si.to_local(way_out / distance)
        joined = surface & by_mirror & seen & (met + 1 < most)
        joined &= mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        light = bsdf.eval(context, si, out, joined)[0] * start * weight * arriving / shading_ratio(si, out)
        joined &= light > 0
        axial = to_camera(world, -way_out).z
        light *= straight_transmission(world, si, world.eye, joined)
        light *= dr.square(world.focal_px / distance) * (distance / axial) ** 3 * scale
        joined &= dr.isfinite(light)
        scatter_add_fixed_point(sums, light, row + target, joined)

        sample, reflected = bsdf.sample(
            context, si, random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32()), surface
        )
        specular = mirrored | (surface & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta))
        onward = dr.select(mirrored, mirrored_direction(ray, si), si.to_world(sample.wo))
        through = reflected[0] * arriving / shading_ratio(si, sample.wo)
        weight = dr.select(surface, weight * through, weight)
        # where the first surface scatters light, the camera's paths have it
        by_mirror |= specular
        met += dr.select(passing, UInt32(0), UInt32(1))
        layer += dr.select(passing, UInt32(1), UInt32(0))
        likely = survival(weight, met, passing)
        active = hit & (passing | by_mirror) & (met + 1 < most) & (layer < MAX_LAYERS) & (weight > 0)
        active &= (random.next_float32() < likely) & dr.isfinite(weight)
        weight /= dr.maximum(likely, 1e-9)
        ray = spawn(si, dr.select(passing, ray.d, onward))
