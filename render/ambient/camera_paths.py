"""Trace paths of ambient light that begin at the camera.

L(p) = E[sum over the path's vertices of its weight and the light emitted there], with multiple importance sampling
(balance heuristic) between lights and reflectance at every surface. Light that a lamp throws on a surface by way of a
mirror, or of glass that bends it, is met by rare chance: of lamps that are surfaces such light is left to the paths
that begin there (`render.ambient.light_paths`), unless the camera, too, sees what it falls on by way of a mirror.
"""

from __future__ import annotations

from render.ambient.panes import has_lit_mirrors, mirrored_direction, pane_event, shines, straight_transmission
from render.backend.drjit_types import Array, Floats, Masks, Rays, UInts
from render.scene.rays import MAX_LAYERS, camera_rays, spawn
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr, mi

SETS = 8  # of a pixel's paths: positions in the pixel are even within each, and the noise is told by their differences
# Surfaces that every path may meet; from then on it goes on by chance where its weight has fallen below MIN_WEIGHT
# (in rooms a tenth to a quarter of the noise's square, at 1.4 times the cost, of going on with the weight itself).
CERTAIN, MIN_WEIGHT, MAX_LIKELY = 3, 1 / 6, 0.95
# After so many a path that still carries much is between white walls, where the weight of what goes on would grow.
MANY, MAX_LIKELY_LATE = 16, 0.995


def camera_paths(
    world: TracedScene, pixel: UInts, sample: UInts, seed: UInts, key: UInts, bounces: UInts
) -> tuple[Array, Array, Array]:
    """Light of camera rays of pixels, each with its number in its pixel: seen where emitted; reflected; and the weight
    that each path still has where `bounces` end it.

    Sample s belongs to set s modulo SETS. Positions in a pixel are a randomised (0, 2)-sequence in each set, as lamps
    may be smaller than a pixel. `key` tells a launch's other random numbers apart.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed + key, dr.width(pixel))
    shift = mi.sample_tea_32(pixel * SETS + sample % SETS, seed)
    right, down = mi.radical_inverse_2(sample // SETS, shift[0]), mi.sobol_2(sample // SETS, shift[1])
    x, y = Float(pixel % world.width) + right, Float(pixel // world.width) + down
    found = _traced(world, sampler, camera_rays(world, x, y)[0], bounces)
    # a path across a face without a normal says nothing, as in `render.indirect.accumulators`
    return tuple(dr.select(dr.isfinite(light), light, 0) for light in found)


@dr.syntax
def _traced(world: TracedScene, sampler: Array, ray: Rays, most: UInts) -> tuple[Array, Array, Array]:
    """Light back along each ray: what it meets, what surfaces reflect; and its weight where `most` surfaces end it."""
    scene, context = world.mi_scene, mi.BSDFContext()
    lanes = dr.width(ray.d)
    (seen, light, cut), weight = (dr.zeros(Float, lanes) for _ in range(3)), dr.full(Float, 1, lanes)
    before = dr.zeros(mi.Interaction3f, lanes)  # the surface that the ray left, past all that it went straight through
    density = dr.full(Float, 1, lanes)  # of the ray's direction there; 0: no light could be sampled that way
    density = dr.select(weight > 0, 0, density)
    met, layer = dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes)
    # whether a mirror was the surface that the ray left, and the first one; whether another has scattered it before
    mirrored, mirrored_first, scattered = (dr.full(Bool, False, lanes) for _ in range(3))
    ray, active = mi.Ray3f(ray), dr.full(Bool, True, lanes)
    while active:
        si = scene.ray_intersect(ray, active)
        emitter = si.emitter(scene, active)
        to_light = mi.DirectionSample3f(scene, si, before)
        chosen = active & (density > 0) & (emitter != None)  # noqa: E711 (an array of pointers)
        of_lights = scene.pdf_emitter_direction(before, to_light, chosen)
        fraction = dr.select(chosen, density / (density + of_lights), 1)
        there = active & shines(world, si.shape, si, active & si.is_valid())
        found = dr.select(there, weight * fraction * emitter.eval(si, active)[0], 0)
        if dr.hint(has_lit_mirrors(world), mode="scalar"):
            found = dr.select(si.is_valid() & mirrored & scattered & ~mirrored_first, 0, found)
        seen += dr.select(met == 0, found, 0)
        light += dr.select(met == 0, 0, found)

        hit = active & si.is_valid()
        passing, by_pane = pane_event(world, si, ray, sampler.next_1d(active), hit)
        surface = hit & ~passing & ~by_pane
        bsdf = si.bsdf()
        going_on = met + 1 < most
        lit = surface & going_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample, emitted = scene.sample_emitter_direction(si, sampler.next_2d(lit), False, lit)
        lit &= (sample.pdf > 0) & shines(world, sample.emitter.get_shape(), sample, lit)
        value, of_bsdf = bsdf.eval_pdf(context, si, si.to_local(sample.d), lit)
        lit &= value[0] > 0
        fraction = dr.select(sample.delta, 1, sample.pdf / (sample.pdf + of_bsdf))
        light += dr.select(
            lit, weight * value[0] * emitted[0] * fraction * straight_transmission(world, si, sample.p, lit), 0
        )

        bounce, reflected = bsdf.sample(context, si, sampler.next_1d(surface), sampler.next_2d(surface), surface)
        onward = si.to_world(bounce.wo)
        direction = dr.select(passing, ray.d, dr.select(by_pane, mirrored_direction(ray, si), onward))
        weight = dr.select(surface, weight * reflected[0], weight)
        cut += dr.select(hit & ~passing & ~going_on, weight, 0)
        smooth = surface & ~mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta)
        mirrored = dr.select(passing, mirrored, ~smooth)
        mirrored_first |= (met == 0) & hit & ~passing & ~smooth
        scattered |= smooth
        density = dr.select(smooth, bounce.pdf, dr.select(passing, density, 0))
        before.p = dr.select(passing, before.p, si.p)
        met += dr.select(passing, UInt32(0), UInt32(1))
        layer += dr.select(passing, UInt32(1), UInt32(0))
        likely = survival(weight, met, passing)
        active = hit & going_on & (layer < MAX_LAYERS) & (sampler.next_1d(active) < likely)
        weight /= dr.maximum(likely, 1e-9)
        active &= weight > 0
        ray = spawn(si, direction)
    return seen, light, cut


def survival(weight: Floats, met: UInts, passing: Masks) -> Array:
    """Return the probability with which a path goes on, of its weight and the number of surfaces that it has met."""
    most = dr.select(met < MANY, Float(MAX_LIKELY), Float(MAX_LIKELY_LATE))
    return dr.select((met >= CERTAIN) & ~passing, dr.minimum(weight / MIN_WEIGHT, most), 1)
