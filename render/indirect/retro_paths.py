"""Light that comes back over the polished surface that the camera looks at: laser, x3, x2, x1, camera.

A laser beside the camera lights a wall by way of the metal in which the camera sees that wall. Such light is bright,
and both other ways find it by chance alone: a path from the camera that left x1 for the wall x2 has to meet the metal
again where it sends light to the laser, and so has a path that begins at the laser on x3. But x1 tells where that is:
around the mirror image L' of the laser in the plane of x1. So from x2 one more direction is sampled, with the density
per solid angle

    q = w^2 cos a / (pi (w^2 cos^2 a + sin^2 a)^2),   w = 2 alpha / (1 + d2 / dL),

a being its angle with the way to L', alpha the roughness of x1, d2 and dL the distances of x1 from x2 and the laser:
slopes as those of GGX normals, as wide as the highlight of x1 seen from x2. Of the paths camera, x1, x2, x3, laser this
way keeps q / (q + p (1 + r)), where p is the density of the lobes of x2 in that direction and r the ratio a / b of
`render.indirect.glossy`. Paths from the camera keep 1 / (1 + r + q / p), and paths from the laser r / (1 + r + q / p):
the balance heuristic of three ways (Veach 1997, eq. 9.8).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Generators, Interactions, LobeSamples, Masks, UInts, Vectors
from render.indirect.glossy import finite_ratio, has_light_paths, ratio_at_laser, reversal
from render.indirect.light_vertices import Connection, connects_suffixes
from render.scene.rays import first_opaque, laser_light, shape_index, spawn
from render.scene.traced_scene import Float, TracedScene, dr, mi


def has_retro_paths(world: TracedScene) -> bool:
    """Return whether directions back to polished surfaces are sampled: where these outshine paint, and a flood laser
    lights what the camera sees of them."""
    return world.has_glints and has_light_paths(world) and not connects_suffixes(world)


def _lobe(world: TracedScene, x1: Interactions, x2: Vectors, active: Masks) -> tuple[Array, Array, Array]:
    """Return the way from x2 to the laser's image in the plane of x1, the width w, and where x1 is polished."""
    index = shape_index(x1)
    normal = mi.Vector3f(x1.sh_frame.n)
    to_laser = world.laser - x1.p
    axis = dr.normalize(world.laser - 2 * dr.dot(to_laser, normal) * normal - x2)
    active = active & (dr.gather(Float, world.peak, index, active) > 0) & (dr.dot(axis, x1.p - x2) > 0)
    roughness = dr.gather(Float, world.roughness, index, active)
    return axis, 2 * roughness / (1 + dr.norm(x1.p - x2) * dr.rsqrt(dr.squared_norm(to_laser))), active


def retro_density(world: TracedScene, x1: Interactions, x2: Vectors, direction: Vectors, active: Masks) -> Array:
    """Return the density q per solid angle of a direction from x2 that was reached from x1; 0 where there is none."""
    axis, width, active = _lobe(world, x1, x2, active)
    cosine, sine2 = dr.dot(axis, direction), dr.squared_norm(dr.cross(axis, direction))
    spread = dr.square(width * cosine) + sine2
    active &= (cosine > 0) & (spread > 0)
    return dr.select(active, dr.square(width) * cosine / (math.pi * dr.square(spread)), 0)


def retro_direction(world: TracedScene, x1: Interactions, x2: Vectors, random: Generators, active: Masks) -> Array:
    """Sample a direction from x2 with `retro_density`."""
    axis, width, _ = _lobe(world, x1, x2, active)
    number, turn = random.next_float32(), random.next_float32()
    tangent = width * dr.sqrt(number / (1 - number))
    sine, cosine = dr.sincos(2 * math.pi * turn)
    return mi.Frame3f(axis).to_world(dr.normalize(mi.Vector3f(tangent * cosine, tangent * sine, 1)))


def retro_ratio(
    world: TracedScene, x1: Interactions, x2: Vectors, direction: Vectors, density: Floats, active: Masks
) -> Array:
    """Return q / p of a direction from x2, p being the `density` of the lobes of x2; 0 where that is 0."""
    return finite_ratio(retro_density(world, x1, x2, direction, active) / density)


class ReachedVertex(NamedTuple):
    """x2, and how a path from the camera reached it: over x1, by a sample of its lobes; the pixel's factor of light
    that x2 reflects, `ratio_at_camera` of x1, the way between both [m], and where all this can be read backwards."""

    x1: Interactions
    sample: LobeSamples
    reach: Floats
    ratio: Floats
    leg: Floats
    x2: Interactions
    readable: Masks


def connect_retro(
    world: TracedScene, reached: ReachedVertex, onward: LobeSamples, pixel: UInts, random: Generators
) -> tuple[Array, tuple[Connection, ...]]:
    """Return `retro_ratio` of the `onward` sample of x2, and the laser's light that comes back over the surface of x1:
    one connection of the pixel. None and none where `has_retro_paths` is false."""
    if not has_retro_paths(world):
        return None, ()
    x1, x2, readable = reached.x1, reached.x2, reached.readable
    smooth = mi.has_flag(onward.sampled_type, mi.BSDFFlags.Delta)
    own = retro_ratio(world, x1, x2.p, x2.to_world(onward.wo), onward.pdf, readable & ~smooth)
    direction = retro_direction(world, x1, x2.p, random, readable)
    sampled = retro_density(world, x1, x2.p, direction, readable)
    out = x2.to_local(direction)
    active = readable & (sampled > 0)  # a copy: &= would change the caller's
    value, density = x2.bsdf().eval_pdf(mi.BSDFContext(), x2, out, active)
    active &= value[0] > 0
    x3, passed, leg, _ = first_opaque(world, spawn(x2, direction), active, x2.p)
    active &= x3.is_valid()
    to_laser, irradiance, path = laser_light(world, x3, pixel, active, seen_by_camera=None)
    active &= irradiance > 0
    light = x3.bsdf().eval(mi.BSDFContext(), x3, x3.to_local(to_laser), active)[0] * irradiance
    before = finite_ratio(reached.ratio * reversal(x2, out, density, active))
    other = finite_ratio(before * ratio_at_laser(world, x3, -direction, active))
    radiance = reached.reach * value[0] * passed * light / (sampled + density * (1 + other))
    radiance = dr.select(active & dr.isfinite(radiance), radiance, 0)
    diffuse = mi.has_flag(reached.sample.sampled_type, mi.BSDFFlags.DiffuseReflection)
    towards = x1.to_world(reached.sample.wo)
    return own, (Connection(radiance, reached.leg + leg + path, towards, diffuse),)
