"""Let ambient light straight through thin panes and cut-outs, or mirror it."""

from __future__ import annotations

from render.backend.drjit_types import Array, Interactions, LobeSamples, Masks, Rays, Vectors
from render.scene.rays import MAX_LAYERS, pane_transmittance, ray_to, shape_index, spawn
from render.scene.traced_scene import OPACITY, Bool, Float, TracedScene, UInt32, dr, mi

MIRRORS = {"conductor", "plastic", "dielectric", "thindielectric"}  # materials with a lobe of no width


def has_lit_mirrors(world: TracedScene) -> bool:
    """Tell whether lamps can throw light by way of mirrors, or of glass: there are both."""
    lamps = any(not emitter.is_environment() for emitter in world.mi_scene.emitters())
    return lamps and any(surface.material.kind in MIRRORS for surface in world.scene.surfaces)


def pane_event(world: TracedScene, si: Interactions, ray: Rays, sample: LobeSamples, hit: Masks) -> tuple[Array, Array]:
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


def shines(world: TracedScene, shape: Array, place: Interactions | LobeSamples, active: Masks) -> Array:
    """Return whether a lamp shines at a place of its shape, or a sample there: the holes of a cut-out are dark."""
    if not world.has_cutouts:
        return Bool(True)
    there = dr.zeros(mi.SurfaceInteraction3f, dr.width(place.uv))
    there.uv = place.uv
    on_shape = active & (shape != None)  # noqa: E711 (an array of pointers)
    return ~on_shape | (shape.eval_attribute_1(OPACITY, there, on_shape) >= 0.5)


def mirrored_direction(ray: Rays, si: Interactions) -> Array:
    """Return the direction of a ray that a plane face mirrors."""
    return ray.d - 2 * dr.dot(ray.d, si.n) * si.n


def _transmission(ior: Array, ray: Rays, si: Interactions) -> Array:
    """Compute the transmittance of the thin pane that a ray hits."""
    return pane_transmittance(mi.fresnel(dr.abs(dr.dot(ray.d, si.n)), dr.maximum(ior, 1.0001))[0])


@dr.syntax
def straight_transmission(world: TracedScene, si: Interactions, point: Vectors, active: Masks) -> Array:
    """Compute the transmission of the straight way from a surface to a point; solid glass, which bends light, blocks
    it."""
    ray = ray_to(si, point)
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
            # it begins a little beside the line, and is aimed again: what the end lies on does not stop it
            onward = spawn(other, ray.d)
            way = end - onward.o
            searching &= dr.dot(way, ray.d) > 0
            ray = mi.Ray3f(onward.o, dr.normalize(way), dr.norm(way), 0, mi.Color0f())
    return transmission
