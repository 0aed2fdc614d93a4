"""Rays in a `TracedScene`: from the camera, past glass and cut-outs, to the laser, and what its light does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Generators, Interactions, Masks, Rays, UInts, Vectors
from render.scene.traced_scene import OPACITY, Bool, Float, TracedScene, UInt32, dr, mi

MAX_LAYERS = 64  # of glass and cut-outs that one ray passes
MIN_SHADING_COSINE = 1e-4
# Of the largest coordinate from the camera: float32 hardly tells apart what is closer.
TOUCHING = 5e-7
PARALLEL = 1 - 1e-6  # cosine between two faces of a slab, as float32 rounds it
PLAIN_GOLDEN = 2654435769  # fraction of the golden ratio, (sqrt(5) - 1) / 2, in units of 2^-32
BEFORE_END = 1e-4  # of a ray's length: so far before its end nothing stops it


def camera_rays(world: TracedScene, x: Floats, y: Floats, eye: Vectors = None) -> tuple[Array, Array]:
    """Return rays from the camera's centre through raster positions, and their camera-frame directions with z = 1; from
    another `eye` that looks as the camera does, if there is one."""
    local = mi.Vector3f(
        (x - Float(world.width) / 2) / world.focal_px, (y - Float(world.height) / 2) / world.focal_px, 1
    )
    return mi.Ray3f(mi.Point3f(world.eye if eye is None else eye), dr.normalize(to_world(world, local))), local


def to_world(world: TracedScene, local: Vectors) -> Array:
    """Return a camera-frame vector in the world."""
    right, down, forward = world.axes
    return right * local.x + down * local.y + forward * local.z


def to_camera(world: TracedScene, vector: Vectors) -> Array:
    """Return a world vector in the camera's frame."""
    return mi.Vector3f(*(dr.dot(axis, vector) for axis in world.axes))


def shape_index(si: Interactions) -> Array:
    return dr.reinterpret_array(UInt32, si.shape)


_KEPT = ("p", "n", "uv", "sh_frame", "shape", "prim_index", "wi")


def parts_of(si: Interactions) -> tuple[Array, ...]:
    """Return what reflectance and rays need of an interaction; the last part says from where it is seen."""
    return tuple(getattr(si, name) for name in _KEPT)


def interaction_from_parts(parts: Sequence[Array]) -> Array:
    """Return the interaction with these parts alone; the last one may be left out."""
    few = dr.zeros(mi.SurfaceInteraction3f, dr.width(parts[0]))
    for name, part in zip(_KEPT, parts, strict=False):
        setattr(few, name, part)
    return few


def gather_vector(source: Vectors, index: UInts, active: Masks) -> Array:
    """Return the vectors with these numbers."""
    return mi.Vector3f(*(dr.gather(Float, component, index, active) for component in source))


def kept(si: Interactions) -> Array:
    """Return the interaction with what is needed of it alone: most of a launch's memory is interactions."""
    return interaction_from_parts(parts_of(si))


def spawn(si: Interactions, direction: Vectors) -> Array:
    """Return a ray that leaves a surface from a little off it: a share of its distance to the origin, as float32
    rounds.

    Mitsuba's `spawn_ray` keeps off 90 um more, whatever the scene's size: in one of millimetres that is a gap.
    """
    off = dr.mulsign(mi.math.RayEpsilon * dr.max(dr.abs(si.p)), dr.dot(si.n, direction))
    return mi.Ray3f(dr.fma(off, si.n, si.p), direction)


def ray_to(si: Interactions, point: Vectors) -> Array:
    """Return the ray from a surface to a little before a point: not as far as a surface that the point may lie on, nor
    as what a ray from there would miss."""
    start = spawn(si, point - si.p).o
    way = point - start
    length = dr.norm(way)
    short = length - dr.maximum(BEFORE_END * length, mi.math.RayEpsilon * dr.max(dr.abs(point)))
    return mi.Ray3f(start, way / length, short, 0, mi.Color0f())


def pane_transmittance(fresnel: Floats) -> Array:
    """Return what a thin pane lets through, with all its inner reflections: (1 - F) / (1 + F)."""
    return (1 - fresnel) / (1 + fresnel)


def tangent_motion(local: Vectors, normal: Vectors, distance: Floats) -> list[tuple[Array, Array]]:
    """Return how a ray's distance, and its end [m], change per unit of camera-frame x, and of y (z = 1).

    On the tangent plane n . (p - C) = const the distance along l = (x, y, 1) is rho = const |l| / (n . l), so
    drho/dx = rho (x / |l|^2 - n_x / (n . l)), and dp/dx = (drho/dx) r + rho (e_x / |l| - l x / |l|^3).
    """
    inverse, length2, along = dr.rcp(dr.dot(normal, local)), dr.squared_norm(local), dr.normalize(local)
    motion = []
    for axis, unit in enumerate((mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0))):
        slope = distance * (local[axis] / length2 - normal[axis] * inverse)
        sideways = distance * (unit - along * (local[axis] * dr.rsqrt(length2))) * dr.rsqrt(length2)
        motion.append((slope, along * slope + sideways))
    return motion


def sample_bsdf(si: Interactions, random: Generators, active: Masks) -> tuple[Array, Array]:
    """Sample a direction of a surface's lobes, and its weight: reflectance times cosine over density."""
    first, second = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
    return si.bsdf().sample(mi.BSDFContext(), si, first, second, active)


def first_opaque(
    world: TracedScene, ray: Rays, active: Masks, origin: Vectors = None, *, scattered: bool = False
) -> tuple[Array, Array, Array, Array]:
    """Return the first surface that stops light, past glass and the holes of cut-outs, in a straight line.

    `origin` is the surface point that the ray was spawned from, a little off its own start; None is the camera, or the
    laser. Neighbouring lanes then have neighbouring rays, unless `scattered`: told so, Embree is three times as fast.
    Returns the interaction, the transmission of the glass on the way, the optical path (the index of refraction counted
    inside solid glass, as its group index) and the geometric distance [m]. A cut-out stops light where its opacity is
    1/2 or more. Refraction's change of direction is left out: exact for a co-located laser at normal incidence, a plan
    says so otherwise.
    """
    coherent = origin is None and not scattered
    if not world.sees_through:
        si = world.mi_scene.ray_intersect(ray, mi.RayFlags.All, coherent=coherent, active=active)
        distance = si.t if origin is None else dr.norm(si.p - origin)
        return si, Float(1), distance, distance
    start = ray.o if origin is None else origin
    return _pass_layers(world, ray, start, active, origin is None, coherent)[:4]


def glass_faces(world: TracedScene, ray: Rays) -> Array:
    """Count the faces of glass that a camera ray passes, two of a slab, before what stops it."""
    return _pass_layers(world, ray, ray.o, Bool(True), True, True).faces


def glass_ahead(world: TracedScene, ray: Rays, number: UInts) -> tuple[Array, Array, Array, Array, Array]:
    """Find the place where a camera ray meets the face of glass of this number, from 0 on.

    Returns the interaction, transmission, optical path and geometric distance, as `first_opaque` does, and whether
    there is such a face and light that it reflects goes in a straight line (`Layers.reflects`).
    """
    found = _pass_layers(world, ray, ray.o, Bool(True), True, True, (None, number))
    solid, thin = _glass_of(world, found.si, found.si.is_valid())
    return *found[:4], ((solid > 0) | (thin > 0)) & found.reflects(found.si.n)


def _glass_of(world: TracedScene, si: Interactions, active: Masks) -> tuple[Array, Array]:
    """Return the index of refraction of what was hit as solid glass, and as thin glass; 0: it is none."""
    return tuple(dr.gather(Float, table, shape_index(si), active) for table in (world.solid_ior, world.thin_ior))


def _crossing(cosine: Floats, solid: Floats, thin: Floats) -> Array:
    """Return what a face of glass lets pass."""
    fresnel = mi.fresnel(dr.abs(cosine), dr.maximum(dr.maximum(solid, thin), 1.0001))[0]
    return dr.select(thin > 0, pane_transmittance(fresnel), 1 - fresnel)


class Layers(NamedTuple):
    """Hold what a ray passes and what stops it, as `first_opaque` has it.

    shortening  distance by which glass shortens the geometric spreading, the sum of t (1 - 1/n): `spreading`
    medium      index of refraction before the end; 0: no face told it
    entry       normal of the last face of solid glass passed
    faces       number of faces of glass passed
    """

    si: Interactions
    transmission: Floats
    optical: Floats
    distance: Floats
    shortening: Floats
    medium: Floats
    entry: Vectors
    faces: UInts

    def reflects(self, normal: Vectors) -> Array:
        """Tell whether the way reflected at the end, by a face of glass of this normal, is the straight one: a ray
        inside glass has to leave it by a face parallel to that by which it came in."""
        return (self.medium <= 1) | (dr.abs(dr.dot(self.entry, normal)) > PARALLEL)


@dr.syntax
def _pass_layers(
    world: TracedScene,
    ray: Rays,
    origin: Vectors,
    active: Masks,
    in_air: bool,
    coherent: bool,
    ends: tuple[Floats | None, UInts | int] = (None, MAX_LAYERS),
) -> Layers:
    """Trace `first_opaque` through layers, up to the `ends`: a limit, where paths run to if nothing stops the ray, and
    the face of glass of some number. A camera starts `in_air`, and every interface of solid glass then leads in or out,
    whichever way its faces point. Else the ray may start in glass: the side of its first interface tells."""
    lanes = dr.width(ray.d)
    transmission, optical, distance = dr.full(Float, 1, lanes), dr.zeros(Float, lanes), dr.zeros(Float, lanes)
    shortening, entry = dr.zeros(Float, lanes), dr.zeros(mi.Normal3f, lanes)
    medium = dr.full(Float, 1 if in_air else 0, lanes)  # index of refraction on the way, 0 = not known yet
    layer, faces = dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes)
    ray, start, line = mi.Ray3f(ray), mi.Point3f(origin), mi.Vector3f(ray.d)
    bounded, limit, last = ends[0] is not None, Float(dr.inf) if ends[0] is None else ends[0], UInt32(ends[1])
    end = start + line * limit if bounded else start
    found = dr.zeros(mi.PreliminaryIntersection3f, lanes)
    found.t = dr.full(Float, dr.inf, lanes)
    searching = Bool(active)
    while searching:
        ray.maxt = limit - dr.dot(ray.o - start, line)
        found = world.mi_scene.ray_intersect_preliminary(ray, coherent=coherent, active=searching)
        hit = searching & found.is_valid()
        solid, thin = _glass_of(world, found, hit)
        of_glass = hit & ((solid > 0) | (thin > 0))
        glass = of_glass & (faces != last)
        faces += dr.select(glass, UInt32(1), UInt32(0))
        # all about a point is worked out where light may pass, and in the end where it does not
        si = found.compute_surface_interaction(ray, mi.RayFlags.All, hit if world.has_cutouts else glass)
        cosine = dr.dot(ray.d, si.n)
        transmission = dr.select(glass, transmission * _crossing(cosine, solid, thin), transmission)
        interface = glass & (solid > 0)
        medium = dr.select(interface & (medium == 0), dr.select(cosine > 0, solid, 1), medium)
        passing = Bool(glass)
        if dr.hint(world.has_cutouts, mode="scalar"):
            passing |= hit & ~of_glass & (si.shape.eval_attribute_1(OPACITY, si, hit) < 0.5)
        # measured from the start: every new ray begins a little off the surface
        reached = dr.select(passing, dr.dot(si.p - start, line), distance)
        optical += (reached - distance) * dr.maximum(medium, 1)
        shortening += dr.select(medium > 1, (reached - distance) * (1 - dr.rcp(medium)), 0)
        distance = reached
        medium = dr.select(interface, dr.select(medium == 1, solid, 1), medium)
        entry = dr.select(interface, si.n, entry)
        ray.o = dr.select(passing, spawn(si, line).o, ray.o)
        if dr.hint(bounded, mode="scalar"):  # it begins beside its line: so what the end lies on does not stop it
            ray.d = dr.select(passing, dr.normalize(end - ray.o), ray.d)
        layer += 1
        searching = passing & (layer < MAX_LAYERS)
        lost = passing & ~searching  # among more layers
        found.t = dr.select(lost, dr.inf, found.t)
        transmission = dr.select(lost, 0, transmission)
    si = found.compute_surface_interaction(ray, mi.RayFlags.All, active & found.is_valid())
    reached = dr.select(si.is_valid(), dr.dot(si.p - start, line), limit)
    optical += (reached - distance) * dr.maximum(medium, 1)
    shortening += dr.select(medium > 1, (reached - distance) * (1 - dr.rcp(medium)), 0)
    return Layers(si, transmission, optical, reached, shortening, medium, entry, faces)


def laser_leg(
    world: TracedScene, si: Interactions, pixel: UInts, active: Masks, *, seen_by_camera: tuple[Array, Array] | None
) -> tuple[Array, Array, Array, Array]:
    """Return what the laser does at a surface: radiance scattered towards `si.wi` [1/(m^2 sr)], and the laser leg's
    path [m].

    L = f(wi, wo) cos I(w) T / d^2. Between them the direction to the laser and the irradiance I(w) T / d^2 across it.
    """
    direction, irradiance, path = laser_light(world, si, pixel, active, seen_by_camera=seen_by_camera)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(direction), active)
    radiance = value[0] * irradiance
    return dr.select(active & dr.isfinite(radiance), radiance, 0), direction, irradiance, path


def laser_light(
    world: TracedScene, si: Interactions, pixel: UInts, active: Masks, *, seen_by_camera: tuple[Array, Array] | None
) -> tuple[Array, Array, Array]:
    """Return direction to the laser, irradiance I(w) T / d^2 [1/m^2] across it, and the laser leg's path [m] at a
    surface.

    With `seen_by_camera` = (transmission, optical path) the point was reached by a straight camera ray, along which a
    co-located laser sees it too: no shadow ray is needed. Solid glass on the way shortens d (`spreading`).
    """
    laser = world.scene.laser
    to_laser = world.laser - si.p
    distance2 = dr.squared_norm(to_laser)
    direction = to_laser * dr.rsqrt(distance2)
    lit = active & (distance2 > 0)
    if laser.mode == "flood" or seen_by_camera is None:
        lit &= in_beam(world, si.p, pixel)
    # with glasses of several indices the optical path does not tell how much of each was crossed: trace it
    if laser.is_colocated and seen_by_camera is not None and len(world.solid_indices) < 2:
        transmission, path = seen_by_camera
        if world.solid_indices:
            distance = dr.sqrt(distance2)
            # t = (optical - d) / (n - 1), so t (1 - 1/n) = (optical - d) / n
            transmission = transmission * spreading(distance, (path - distance) / world.solid_index)
    else:
        transmission, path = segment(world, si, world.laser, lit)
    intensity = dr.gather(Float, world.intensity, pixel, lit)
    return direction, dr.select(lit, intensity * transmission / distance2, 0), path


def spreading(distance: Floats, shortening: Floats) -> Array:
    """Return factor on 1 / distance^2 where solid glass on the way changes how a point's light spreads.

    A thin cone of half angle a around the normal of a slab (thickness t, index n) runs inside it at a/n, and leaves it
    with a radius t a (1 - 1/n) smaller than without: it spreads as if the distance d were d - t (1 - 1/n), whatever the
    order of air and glass. The irradiance is I T / (d - sum t (1 - 1/n))^2, exact at normal incidence. The radiance
    that a camera sees through a flat slab does not change.
    """
    return dr.square(distance / dr.maximum(distance - shortening, 1e-3 * distance))


def in_beam(world: TracedScene, point: Array, pixel: UInts) -> Array:
    """Return whether the laser shines on a point: in its cone (flood), or in the row (line) or pixel (scan) being
    measured."""
    laser = world.scene.laser
    if laser.mode == "flood":
        aim = to_camera(world, mi.Vector3f(point) - world.laser)
        return dr.atan2(dr.norm(mi.Vector2f(aim.x, aim.y)), aim.z) <= world.half_angle
    seen_in, same = pixel_of(world, point)
    return same & (seen_in == pixel if laser.mode == "scan" else seen_in // world.width == pixel // world.width)


def pixel_of(world: TracedScene, point: Array) -> tuple[Array, Array]:
    """Return the flat pixel in whose pyramid a point lies, and whether there is one."""
    column, row, seen = raster_of(world, world.eye, point)
    column, row = dr.floor(column), dr.floor(row)
    inside = seen & (row >= 0) & (row < Float(world.height)) & (column >= 0) & (column < Float(world.width))
    return UInt32(dr.select(inside, row, 0)) * world.width + UInt32(dr.select(inside, column, 0)), inside


def raster_of(world: TracedScene, eye: Vectors, point: Array) -> tuple[Array, Array, Array]:
    """Return where an eye that looks as the camera does sees a point: in pixels from the image's corner; and whether it
    lies before it."""
    local = to_camera(world, mi.Vector3f(point) - eye)
    x, y = (local[axis] / local.z * world.focal_px for axis in range(2))
    return x + Float(world.width) / 2, y + Float(world.height) / 2, local.z > 0


def segment(
    world: TracedScene, si: Interactions, point: Array, active: Masks, *, spread: bool = True
) -> tuple[Array, Array]:
    """Return transmission of the straight way from a surface to a point, 0 where it is blocked, and its optical path
    [m].

    The transmission includes the glass's `spreading`: it is what f cos I / distance^2 is to be multiplied by; not with
    `spread` off, as for the radiance that a camera sees.
    """
    distance = dr.norm(point - si.p)
    ray = ray_to(si, point)
    if not world.sees_through:
        return dr.select(world.mi_scene.ray_test(ray, active), Float(0), Float(1)), distance
    transmission, optical, shortening = passage(world, ray, ray.o, ray.maxt, active, in_air=False)
    factor = spreading(distance, shortening) if spread else 1
    return transmission * factor, optical + (distance - ray.maxt)


def passage(
    world: TracedScene, ray: Rays, origin: Vectors, limit: Floats, active: Masks, *, in_air: bool
) -> tuple[Array, Array, Array]:
    """Return transmission (0: blocked), optical path and shortening (`spreading`) [m] from `origin` along `ray` to
    `limit`.

    `ray` starts at or a little off `origin`; `in_air` says that it starts outside of all glass, else its first
    interface tells.
    """
    return passage_to_face(world, ray, origin, limit, active, None, in_air=in_air)[:3]


def passage_to_face(
    world: TracedScene,
    ray: Rays,
    origin: Vectors,
    limit: Floats,
    active: Masks,
    normal: Vectors | None,
    *,
    in_air: bool,
) -> tuple[Array, Array, Array, Array]:
    """Return what `passage` returns, and whether the straight way is that of light which a face of glass of this
    `normal` reflects at its end (`Layers.reflects`)."""
    if not world.sees_through:
        ray = mi.Ray3f(ray)
        ray.maxt = limit
        return dr.select(world.mi_scene.ray_test(ray, active), Float(0), Float(1)), limit, Float(0), Bool(True)
    found = _pass_layers(world, ray, origin, active, in_air, in_air, (limit, MAX_LAYERS))
    reflects = Bool(True) if normal is None else found.reflects(normal)
    return dr.select(found.si.is_valid(), 0, found.transmission), found.optical, found.shortening, reflects


def shading_ratio(si: Interactions, local: Vectors) -> Array:
    """Compute the cosine to the shading normal over that to the surface's normal, of a direction in the shading
    frame."""
    shading, true = dr.abs(local.z), dr.abs(dr.dot(si.n, si.to_world(local)))
    return dr.maximum(shading, MIN_SHADING_COSINE) / dr.maximum(true, MIN_SHADING_COSINE)
