"""Camera rays that solid glass bends, and the bundle of light around each: direct light of a co-located laser.

Light that a laser at the camera's centre sends to a point seen through glass runs along the camera's ray. So a ray is
traced by Snell's law, with Fresnel's transmission at each interface, total reflection where there is no other way, and
the optical path (the index counted as the group index) along the bent way. The irradiance is what the laser sends into
a thin bundle around the ray, over the bundle's cross-section where it arrives.
"""

from __future__ import annotations

from typing import NamedTuple

from render.backend.drjit_types import Array, Floats, Masks, Rays
from render.scene.rays import MAX_LAYERS, camera_rays, pane_transmittance, shape_index, spawn
from render.scene.traced_scene import OPACITY, Bool, Float, TracedScene, UInt32, dr, mi

# Half the distance between a bundle's rays, per unit of the image plane at distance 1: less is lost in float32.
MIN_HALF_WIDTH = 5e-4
MAX_GAIN = 1e4  # of irradiance by focusing: a focus of a thin bundle has no area
# How much a bundle's two halves may differ, in shares of it, and still be one of parallel borders.
MAX_UNEVENNESS = 0.25


class BentRays(NamedTuple):
    """Where rays end that glass bends.

    interaction    the first surface that stops the light
    direction      of the ray that arrives there
    transmission   of all glass on the way, one way
    optical_m      optical path from the camera
    medium         index of refraction around the end
    interfaces     of solid glass that were passed; 0: the ray is straight
    start          last point at which the way was bent, `before_m` is the optical path up to there
    apparent_m     sum of t / n, by which light spreads at normal incidence (`render.scene.rays.spreading`)
    """

    interaction: Array
    direction: Array
    transmission: Array
    optical_m: Array
    medium: Array
    interfaces: Array
    start: Array
    before_m: Array
    apparent_m: Array


def refracted_hit(world: TracedScene, ray: Rays, active: Masks) -> BentRays:
    """Return where rays from the camera end by Snell's law; the camera is in air.

    Every interface of solid glass leads in or out, whichever way its faces point; their shading normals bend the light,
    as these describe the body that a mesh stands for. Of light that an interface divides the refracted part is
    followed. Rays that meet more than MAX_LAYERS are lost.
    """
    return BentRays(*_refract(world, ray, active))


@dr.syntax
def _refract(world: TracedScene, ray: Rays, active: Masks) -> tuple[Array, ...]:
    lanes = dr.width(ray.d)
    transmission = dr.full(Float, 1, lanes)
    apparent, medium = dr.zeros(Float, lanes), dr.full(Float, 1, lanes)
    interfaces, layer = dr.zeros(UInt32, lanes), dr.zeros(UInt32, lanes)
    ray = mi.Ray3f(ray)
    start = mi.Point3f(ray.o) + dr.zeros(mi.Vector3f, lanes)
    before = dr.zeros(Float, lanes)
    found = dr.zeros(mi.PreliminaryIntersection3f, lanes)
    found.t = dr.full(Float, dr.inf, lanes)
    searching = Bool(active)
    while searching:
        found = world.mi_scene.ray_intersect_preliminary(ray, coherent=False, active=searching)
        hit = searching & found.is_valid()
        solid = dr.gather(Float, world.solid_ior, shape_index(found), hit)
        thin = dr.gather(Float, world.thin_ior, shape_index(found), hit)
        si = found.compute_surface_interaction(ray, mi.RayFlags.All, hit)
        interface, pane = hit & (solid > 0), hit & (thin > 0)
        passing = interface | pane
        if dr.hint(world.has_cutouts, mode="scalar"):
            passing |= hit & ~passing & (si.shape.eval_attribute_1(OPACITY, si, hit) < 0.5)
        # a shading normal that is seen from behind describes no surface here
        normal = mi.Vector3f(si.sh_frame.n)
        usable = dr.dot(normal, ray.d) * dr.dot(si.n, ray.d) > 0
        normal = dr.select(usable, normal, mi.Vector3f(si.n))
        normal = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
        cosine = -dr.dot(normal, ray.d)
        onward = dr.select(medium == 1, solid, 1)
        ratio = medium / dr.maximum(onward, 1)
        squared = 1 - dr.square(ratio) * (1 - dr.square(cosine))
        total = interface & (squared <= 0)
        inside = dr.sqrt(dr.maximum(squared, 0))
        crossed = interface & ~total
        index = dr.select(medium == 1, dr.maximum(solid, 1.0001), dr.rcp(dr.maximum(medium, 1.0001)))
        fresnel = mi.fresnel(cosine, index)[0]
        of_pane = mi.fresnel(cosine, dr.maximum(thin, 1.0001))[0]
        transmission *= dr.select(crossed, 1 - fresnel, dr.select(pane, pane_transmittance(of_pane), 1))
        length = dr.select(passing, dr.norm(si.p - start), 0)
        before += length * medium
        apparent += length / medium
        bent = dr.normalize(ratio * ray.d + (ratio * cosine - inside) * normal)
        mirrored = dr.normalize(ray.d + 2 * cosine * normal)
        direction = dr.select(crossed, bent, dr.select(total, mirrored, ray.d))
        medium = dr.select(crossed, onward, medium)
        interfaces += dr.select(interface, UInt32(1), UInt32(0))
        start = dr.select(passing, mi.Point3f(si.p), start)
        away = spawn(si, direction)
        ray.o = dr.select(passing, away.o, ray.o)
        ray.d = dr.select(passing, direction, ray.d)
        layer += 1
        searching = passing & (layer < MAX_LAYERS)
        lost = passing & ~searching
        found.t = dr.select(lost, dr.inf, found.t)
        transmission = dr.select(lost, 0, transmission)
    si = found.compute_surface_interaction(ray, mi.RayFlags.All, active & found.is_valid())
    last = dr.select(si.is_valid(), dr.norm(si.p - start), 0)
    optical = before + last * medium
    apparent += last / medium
    return si, mi.Vector3f(ray.d), transmission, optical, medium, interfaces, start, before, apparent


class Bundle(NamedTuple):
    """The thin bundle of light around a ray, where it arrives.

    irradiance  per unit of radiant intensity, across the arriving ray, transmission left out [1/m^2]
    slope_x_m, slope_y_m  change of the optical path along the tangent plane per unit of camera-frame x and y (z = 1)
    even        whether the rays around pass the same glass, and the bundle's halves are alike
    """

    irradiance: Array
    slope_x_m: Array
    slope_y_m: Array
    even: Array


def bundle_of(world: TracedScene, centre: BentRays, x: Floats, y: Floats, step: Floats, active: Masks) -> Bundle:
    """Follow four rays beside the one through the raster position (x, y), half a cell of width `step` (z = 1) away, to
    the tangent plane of the point where it ends.

    Where one of them passes other glass, or the borders' bundle is uneven, the light spreads as through flat glass at
    normal incidence.
    """
    half = dr.maximum(step / 2, MIN_HALF_WIDTH)
    off = half * world.focal_px
    point, normal = mi.Vector3f(centre.interaction.p), mi.Vector3f(centre.interaction.n)
    even, slopes, sides = Bool(active), [], []
    for axis in range(2):
        ends, paths = [], []
        for sign in (-1, 1):
            shift = sign * off
            ray, local = camera_rays(world, x + (shift if axis == 0 else 0), y + (shift if axis == 1 else 0))
            beside = refracted_hit(world, ray, active)
            way = dr.dot(normal, point - mi.Vector3f(beside.start)) / dr.dot(normal, beside.direction)
            even &= (beside.interfaces == centre.interfaces) & (way > 0) & dr.isfinite(way)
            even &= beside.medium == centre.medium
            ends.append(mi.Vector3f(beside.start) + way * beside.direction)
            paths.append(beside.before_m + way * beside.medium)
        side = (ends[1] - ends[0]) / (2 * half)
        even &= dr.norm(ends[1] + ends[0] - 2 * point) <= MAX_UNEVENNESS * dr.norm(ends[1] - ends[0])
        sides.append(side)
        slopes.append((paths[1] - paths[0]) / (2 * half))
    _, local = camera_rays(world, x, y)
    per_solid_angle = dr.abs(dr.dot(dr.cross(*sides), centre.direction)) * dr.norm(local) ** 3
    area = dr.select(even, per_solid_angle, dr.square(centre.apparent_m))
    area = dr.maximum(area, dr.square(centre.optical_m) / MAX_GAIN)
    return Bundle(dr.rcp(area), dr.select(even, slopes[0], 0), dr.select(even, slopes[1], 0), even)
