"""Ways by plane mirrors, folded: from a point toward the laser's image, mirror by mirror."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts, Vectors
from render.scene.rays import passage_to_face, shape_index
from render.scene.traced_scene import OPACITY, Bool, Float, TracedScene, UInt32, dr, mi, upload
from render.specular.mirrors import COATED, Mirrors


class MirrorTables(NamedTuple):
    """Planes and, per registered shape, what decides a smooth reflectance, as Dr.Jit arrays."""

    normal: Vectors
    offset: Floats
    shape: UInts
    scale: Floats
    ior: Floats
    eta: Floats
    k: Floats
    kind: Floats


def mirror_tables(world: TracedScene, mirrors: Mirrors) -> MirrorTables:
    """Upload what `reflectance` and `connect_to_image` look up."""
    # one row more: an array of a single value would compile other kernels
    columns = np.vstack((np.column_stack((mirrors.normal, mirrors.offset)), np.zeros(4)))
    normal = mi.Vector3f(*(upload(Float, column) for column in columns[:, :3].T))
    offset = upload(Float, columns[:, 3] + columns[:, :3] @ world.eye_m)
    materials = [group[0].material for group in world.groups]
    scale = [m.specular if m.kind in ("conductor", "plastic") else 1 for m in materials]
    kinds = [COATED.index(m.kind) if m.kind in COATED else -1 for m in materials]
    of_shapes = scale, [m.ior for m in materials], [m.eta for m in materials], [m.k for m in materials], kinds
    columns_of_shapes = (world.table(list(values)) for values in of_shapes)
    return MirrorTables(normal, offset, upload(UInt32, np.append(mirrors.shape, 0)), *columns_of_shapes)


def reflectance(tables: MirrorTables, shape: Array, cosine: Floats, active: Masks) -> Array:
    """Compute the unpolarised Fresnel reflectance: a metal's, one interface's, or 2F / (1 + F) of a thin pane."""
    kind = dr.gather(Float, tables.kind, shape, active)
    cosine = dr.minimum(dr.abs(cosine), 1)
    index = mi.Complex2f(dr.gather(Float, tables.eta, shape, active), dr.gather(Float, tables.k, shape, active))
    metal = mi.fresnel_conductor(cosine, index)
    glass = mi.fresnel(cosine, dr.maximum(dr.gather(Float, tables.ior, shape, active), 1.0001))[0]
    glass = dr.select(kind == COATED.index("thindielectric"), 2 * glass / (1 + glass), glass)
    scale = dr.gather(Float, tables.scale, shape, active)
    return scale * dr.select(kind == COATED.index("conductor"), metal, glass)


def connect_to_image(
    world: TracedScene,
    tables: MirrorTables,
    ends: tuple[Array, Array, Array],
    sequence: Sequence[Array],
    active: Masks,
    in_air: bool,
) -> tuple[Array, Array, Array, Array]:
    """Follow the way from a start toward the laser's image, folded by the planes of `sequence`.

    Returns the product of reflectances and transmissions (0: the way does not exist or is blocked), the delay and the
    shortening of the spreading by glass [m], and the last mirror point, which the laser shines on. `ends` are
    the start, how far off its surface rays start, and the image.
    """
    start, lift, target = ends
    along = target - start
    left = dr.norm(along)
    direction = along / left
    scale = left + dr.norm(start - world.eye)
    position, lit = mi.Point3f(start), Bool(active)
    weight, delay, shortening = Float(1), Float(0), Float(0)
    for number, plane in enumerate((*sequence, None)):
        step, normal = left, None
        if plane is not None:
            normal = dr.gather(mi.Vector3f, tables.normal, plane, lit)
            cosine = dr.dot(normal, direction)
            step = (dr.gather(Float, tables.offset, plane, lit) - dr.dot(normal, mi.Vector3f(position))) / cosine
            lit &= (step > 0) & (step < left)
        gap = dr.minimum(1e-5 * scale, 0.1 * step)
        # from a little off this surface to a little before the next one
        begin = position + lift + gap * direction
        way = position + (step - gap) * direction - begin
        limit = dr.norm(way)
        ray = mi.Ray3f(begin, way / limit)
        at_start = in_air and number == 0
        passed, optical, short, reflects = passage_to_face(world, ray, begin, limit, lit, normal, in_air=at_start)
        weight *= passed
        delay += optical - limit
        shortening += short
        if plane is None:
            break
        lit &= reflects
        position = position + step * direction
        # is there a face at that point of its plane?
        probe = dr.minimum(1e-4 * scale, 0.3 * step)
        ray = mi.Ray3f(position - probe * direction, direction)
        ray.maxt = 2 * probe
        si = world.mi_scene.ray_intersect(ray, lit)
        shape = dr.gather(UInt32, tables.shape, plane, lit)
        lit &= si.is_valid() & (shape_index(si) == shape)
        if world.has_cutouts:
            lit &= si.shape.eval_attribute_1(OPACITY, si, lit) >= 0.5
        weight *= reflectance(tables, shape, cosine, lit)
        lift = normal * dr.select(cosine > 0, -4e-6, 4e-6) * scale
        direction = direction - 2 * cosine * normal
        left -= step
    lit &= weight > 0
    return dr.select(lit, weight, 0), dr.select(lit, delay, 0), dr.select(lit, shortening, 0), position
