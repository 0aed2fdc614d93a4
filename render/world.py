"""A `Scene` as the ray tracer holds it: a Mitsuba scene, and the camera and laser as Dr.Jit arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from render.llvm import start_mitsuba
from scenes.model import Material, Scene, Surface, Texture

mi = start_mitsuba()
import drjit as dr  # noqa: E402  (other modules take dr and mi from here: only now has an LLVM been chosen)

Float, UInt32, Bool = mi.Float, mi.UInt32, mi.Bool
ALIGNMENT = 64  # bytes
OPACITY = "opacity"
FACE_ALBEDO = "face_albedo"
PALETTE = 64  # albedos in one row of a plastic mesh: its size is part of the kernel
MAX_LAYERS = 64


class World:
    """A scene ready to trace: merged meshes, tables of their materials, the laser's intensity per pixel.

    The traced world has the scene's axes and the camera at its origin, where float32 resolves best.
    Surfaces whose materials differ in nothing but a plain albedo share one mesh, with an albedo per face: the number of
    meshes decides which kernels are compiled, so scenes of a set with the same kinds of material share their kernels.
    `groups[i]` are the surfaces of mesh i, `shape_ids[i]` its registered index; `solid_indices` those of solid glass.
    Tables per registered shape: index of refraction of solid and thin glass (0: none), albedo of conductors (-1: none).
    Not a dataclass: Dr.Jit would take its fields for variables of every loop that mentions it.
    """

    def __init__(self, scene: Scene, *, cutouts_by_mitsuba: bool = False) -> None:
        groups: dict[tuple, list[Surface]] = {}
        for surface in scene.surfaces:
            groups.setdefault(_merge_key(surface), []).append(surface)
        self.groups = tuple(tuple(group) for group in groups.values())
        materials = [group[0].material for group in self.groups]
        self.scene = scene
        self.has_glass = any(m.is_glass for m in materials)
        self.has_cutouts = any(_has_cutouts(m) for m in materials)
        masks = "mitsuba" if cutouts_by_mitsuba else "ours" if self.has_cutouts else "none"
        origin = scene.camera.origin
        meshes = {f"mesh{i}": _mesh(f"mesh{i}", group, origin, masks) for i, group in enumerate(self.groups)}
        environment = _environment(scene)
        lights = {} if environment is None else {"environment": environment}
        # optimize=False: equal objects must not be merged, since shapes are told apart by their registry index
        # robust: without it a ray through the shared edge of two triangles can miss both (OptiX is so by itself)
        robust = {"embree_use_robust_intersections": True} if mi.variant().startswith("llvm") else {}
        described = {"type": "scene", **robust, **meshes, **lights}
        self.traced = mi.load_dict(described, optimize=False)
        self.shape_ids = np.array([int(dr.reinterpret_array(UInt32, mi.ShapePtr(m))[0]) for m in meshes.values()])
        self.solid_ior = self.table([m.ior if m.kind == "dielectric" else 0 for m in materials])
        self.thin_ior = self.table([m.ior if m.kind == "thindielectric" else 0 for m in materials])
        # coated surfaces trace paths of their own, and share none (`render.paths`)
        self.has_own = any(m.kind in ("conductor", "plastic", "roughplastic") for m in materials)
        self.shares = self.table([m.kind not in ("plastic", "roughplastic") for m in materials])
        self.albedo = self.table([_specular_albedo(m) for m in materials])
        self.solid_indices = sorted({m.ior for m in materials if m.kind == "dielectric"})
        self.solid_index = dr.opaque(Float, max(self.solid_indices, default=1.0))
        self.intensity = upload(Float, scene.laser.intensity(scene.camera))
        # What differs between the views of a set is opaque: a literal would compile every kernel again.
        camera = scene.camera
        self.laser = _opaque(scene.laser.position(camera) - origin)
        self.axes = tuple(_opaque(column) for column in camera.rotation.T)
        self.focal_px = dr.opaque(Float, camera.focal_px)
        self.width, self.height = dr.opaque(UInt32, camera.width), dr.opaque(UInt32, camera.height)
        # the corner pixels' rays lie on the rim of the smallest cone
        self.half_angle = dr.opaque(Float, math.acos(scene.laser.cos_half_angle(camera)) * (1 + 1e-5))

    def table(self, values: list[float]) -> Any:
        """One value a mesh as an array over registered shapes, to be read at `shape_index`."""
        table = np.zeros(self.shape_ids.max() + 2)  # never of size one: its kernels would differ
        table[self.shape_ids] = values
        return upload(Float, table)

    @property
    def sees_through(self) -> bool:
        return self.has_glass or self.has_cutouts


def upload(kind: type, values: np.ndarray) -> Any:
    """Values as a flat Dr.Jit array of `kind` (Float, UInt32, Bool) in memory aligned to 64 bytes.

    Dr.Jit uses a numpy array's own memory, and compiles one kernel for aligned and another for unaligned input.
    """
    dtype = np.dtype({Float: np.float32, UInt32: np.uint32, Bool: np.bool_, mi.Int32: np.int32}[kind])
    size = np.size(values)
    memory = np.empty(size * dtype.itemsize + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    aligned = memory[start : start + size * dtype.itemsize].view(dtype)
    aligned[:] = np.ravel(values)
    return kind(aligned)


def _opaque(vector: np.ndarray) -> Any:
    return mi.Vector3f(*(dr.opaque(Float, float(v)) for v in vector))


_PARAMETERS = {
    "diffuse": (),
    "plastic": ("specular", "ior"),
    "roughplastic": ("specular", "ior", "roughness"),
    "conductor": ("specular", "eta", "k"),
    "roughconductor": ("specular", "eta", "k", "roughness"),
    "dielectric": ("ior",),
    "thindielectric": ("ior",),
}


def _merge_key(surface: Surface) -> tuple:
    """Surfaces with equal keys share a mesh: equal materials but for a plain albedo, which each face keeps."""
    material = surface.material
    kind = "diffuse" if material.kind == "roughdiffuse" else material.kind
    albedo = id(material.albedo) if isinstance(material.albedo, Texture) else None
    opacity: float = material.opacity
    if isinstance(opacity, Texture):
        opacity, albedo = id(opacity), albedo or material.albedo
    parameters = tuple(getattr(material, name) for name in _PARAMETERS[kind])
    return kind, parameters, albedo, opacity, surface.emission, surface.normals is not None


def _has_cutouts(material: Material) -> bool:
    return material.lets_light_through and not material.is_glass


def _specular_albedo(material: Material) -> float:
    """Scaled reflectance of a conductor at normal incidence; -1 for what has a diffuse reflectance of its own."""
    if material.kind not in ("conductor", "roughconductor"):
        return -1.0
    eta, k = material.eta, material.k
    return material.specular * ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)


def _mesh(name: str, surfaces: tuple[Surface, ...], origin: np.ndarray, masks: str) -> Any:
    """One mesh of surfaces that share a material; cut-outs by `masks`: none, ours (an attribute), or Mitsuba's BSDF."""
    material, emission = surfaces[0].material, surfaces[0].emission
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    vertices = np.concatenate([s.vertices for s in surfaces]) - origin
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts[:-1], strict=True)])
    props = mi.Properties()
    albedo, palette = _albedo(surfaces)
    bsdf = _bsdf(material, albedo)
    if masks == "mitsuba" and _has_cutouts(material):
        bsdf = {"type": "mask", "opacity": _texture(material.opacity), "nested": bsdf}
    props["bsdf"] = mi.load_dict(bsdf)
    if emission > 0:
        props["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": emission}})
    smooth = surfaces[0].normals is not None
    mesh = mi.Mesh(name, len(vertices), len(faces), props, has_vertex_normals=smooth, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = upload(Float, vertices)
    params["faces"] = upload(UInt32, faces)
    if palette is None:
        uv = np.concatenate([np.zeros((len(s.vertices), 2)) if s.uv is None else s.uv for s in surfaces])
    else:
        uv = np.repeat(palette, np.diff(starts), axis=0)
    # Mitsuba's v runs down the image, ours up
    params["vertex_texcoords"] = upload(Float, np.column_stack((uv[:, 0], 1 - uv[:, 1])))
    if smooth:
        params["vertex_normals"] = upload(Float, np.concatenate([s.normals for s in surfaces]))
    params.update()
    if albedo is not None and albedo["type"] == "mesh_attribute":
        values = np.repeat([s.material.albedo for s in surfaces], [len(s.faces) for s in surfaces])
        mesh.add_attribute(FACE_ALBEDO, 1, values.astype(np.float32))
    if masks == "ours":
        mesh.add_texture_attribute(OPACITY, mi.load_dict(_texture(material.opacity)))
    return mesh


def _albedo(surfaces: tuple[Surface, ...]) -> tuple[dict[str, Any] | None, np.ndarray | None]:
    """Mitsuba's texture for the albedo of one mesh, and texture coordinates (surfaces, 2) where they pick it.

    A plain albedo is an attribute of the faces, but Mitsuba's plastics need a texture with a mean: theirs is a palette.
    """
    material = surfaces[0].material
    if material.kind not in ("diffuse", "roughdiffuse", "plastic", "roughplastic"):
        return None, None
    if isinstance(material.albedo, Texture):
        return _texture(material.albedo), None
    if material.kind in ("diffuse", "roughdiffuse"):
        return {"type": "mesh_attribute", "name": FACE_ALBEDO}, None
    if isinstance(material.opacity, Texture):  # its coordinates are taken: such a surface has a mesh of its own
        return _texture(material.albedo), None
    values = np.array([s.material.albedo for s in surfaces])
    texels = np.full(-(-len(values) // PALETTE) * PALETTE, values.mean(), dtype=np.float32)
    texels[: len(values)] = values
    u = (np.arange(len(values)) + 0.5) / len(texels)
    palette = {"type": "bitmap", "bitmap": mi.Bitmap(texels[None, :, None]), "raw": True, "filter_type": "nearest"}
    return palette, np.column_stack((u, np.full(len(u), 0.5)))


def _texture(value: float | Texture) -> dict[str, Any]:
    if not isinstance(value, Texture):
        return {"type": "uniform", "value": float(value)}
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.array(value.image[..., None])),
        "raw": True,
        "filter_type": "bilinear",
    }


def _bsdf(material: Material, albedo: dict[str, Any] | None) -> dict[str, Any]:
    """Mitsuba's name for a material. Glass and cut-outs are the tracer's business, not the BSDF's."""
    kind = material.kind
    if kind in ("diffuse", "roughdiffuse"):
        inner = {"type": "diffuse", "reflectance": albedo}
    elif kind in ("plastic", "roughplastic"):
        inner = {
            "type": kind,
            "diffuse_reflectance": albedo,
            "specular_reflectance": material.specular,
            "int_ior": material.ior,
            "ext_ior": 1.0,
        }
    elif kind in ("conductor", "roughconductor"):
        inner = {"type": kind, "specular_reflectance": material.specular, "eta": material.eta, "k": material.k}
    else:
        return {
            "type": "thindielectric" if kind == "thindielectric" else "dielectric",
            "int_ior": material.ior,
            "ext_ior": 1.0,
        }
    if kind.startswith("rough") and kind != "roughdiffuse":
        inner |= {"alpha": material.roughness, "distribution": "ggx"}
    return {"type": "twosided", "nested": inner}


def _environment(scene: Scene) -> dict[str, Any] | None:
    ambient = scene.ambient
    if ambient.environment is not None:
        image = np.repeat(ambient.environment.image[..., None], 3, axis=-1)
        return {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": mi.ScalarTransform4f(ambient.pose)}
    if ambient.radiance > 0:
        return {"type": "constant", "radiance": {"type": "rgb", "value": ambient.radiance}}
    return None


def camera_rays(world: World, x: Any, y: Any) -> tuple[Any, Any]:
    """Rays from the camera's centre through raster positions, and their camera-frame directions with z = 1."""
    local = mi.Vector3f(
        (x - Float(world.width) / 2) / world.focal_px, (y - Float(world.height) / 2) / world.focal_px, 1
    )
    return mi.Ray3f(mi.Point3f(0), dr.normalize(to_world(world, local))), local


def to_world(world: World, local: Any) -> Any:
    """A camera-frame vector in the world."""
    right, down, forward = world.axes
    return right * local.x + down * local.y + forward * local.z


def to_camera(world: World, vector: Any) -> Any:
    """A world vector in the camera's frame."""
    return mi.Vector3f(*(dr.dot(axis, vector) for axis in world.axes))


def shape_index(si: Any) -> Any:
    return dr.reinterpret_array(UInt32, si.shape)


def spawn(si: Any, direction: Any) -> Any:
    """A ray that leaves a surface from a little off it: a share of its distance to the camera, which is the origin.

    Mitsuba's `spawn_ray` keeps off 90 um more, whatever the scene's size: in one of millimetres that is a gap.
    """
    off = dr.mulsign(mi.math.RayEpsilon * dr.max(dr.abs(si.p)), dr.dot(si.n, direction))
    return mi.Ray3f(dr.fma(off, si.n, si.p), direction)


def first_opaque(world: World, ray: Any, active: Any, origin: Any = None) -> tuple[Any, Any, Any, Any]:
    """The first surface that stops light, past glass and the holes of cut-outs, in a straight line.

    `origin` is the surface point that the ray was spawned from, a little off its own start; None is the camera.
    Returns the interaction, the transmission of the glass on the way, the optical path (the index of refraction counted
    inside solid glass, as its group index) and the geometric distance [m]. A cut-out stops light where its opacity is
    1/2 or more. Refraction's change of direction is left out: exact for a co-located laser at normal incidence, a plan
    says so otherwise.
    """
    if not world.sees_through:
        si = world.traced.ray_intersect(ray, active)
        distance = si.t if origin is None else dr.norm(si.p - origin)
        return si, Float(1), distance, distance
    start = ray.o if origin is None else origin
    return _pass_layers(world, ray, start, active, Float(dr.inf), origin is None)[:4]


@dr.syntax
def _pass_layers(world: World, ray: Any, origin: Any, active: Any, limit: Any, in_air: bool) -> tuple[Any, ...]:
    """`first_opaque` with layers, no farther than `limit`; where nothing stops the ray the paths run to the limit.

    A camera starts `in_air`, and every interface of solid glass then leads in or out, whichever way its faces point. A
    ray that starts at a surface may start inside glass: the side of its first interface tells. A ray that meets more
    than MAX_LAYERS is lost. The fifth result is the distance by which glass shortens the geometric spreading, the sum
    of t (1 - 1/n) (see `spreading`).
    """
    lanes = dr.width(ray.d)
    transmission, optical, distance = dr.full(Float, 1, lanes), dr.zeros(Float, lanes), dr.zeros(Float, lanes)
    shortening = dr.zeros(Float, lanes)
    medium = dr.full(Float, 1 if in_air else 0, lanes)  # index of refraction on the way, 0 = not known yet
    layer = dr.zeros(UInt32, lanes)
    ray, start = mi.Ray3f(ray), mi.Point3f(origin)
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.t = dr.full(Float, dr.inf, lanes)
    searching = Bool(active)
    while searching:
        ray.maxt = limit - dr.dot(ray.o - start, ray.d)
        si = world.traced.ray_intersect(ray, searching)
        hit = searching & si.is_valid()
        solid = dr.gather(Float, world.solid_ior, shape_index(si), hit)
        thin = dr.gather(Float, world.thin_ior, shape_index(si), hit)
        passing = hit & ((solid > 0) | (thin > 0))
        cosine = dr.dot(ray.d, si.n)
        fresnel = mi.fresnel(dr.abs(cosine), dr.maximum(dr.maximum(solid, thin), 1.0001))[0]
        # one interface lets 1 - F through; a thin pane, with all its inner reflections, (1 - F) / (1 + F)
        crossing = dr.select(thin > 0, (1 - fresnel) / (1 + fresnel), 1 - fresnel)
        transmission = dr.select(passing, transmission * crossing, transmission)
        interface = passing & (solid > 0)
        medium = dr.select(interface & (medium == 0), dr.select(cosine > 0, solid, 1), medium)
        # measured from the start: every new ray begins a little off the surface
        reached = dr.select(hit, dr.dot(si.p - start, ray.d), limit)
        optical += (reached - distance) * dr.maximum(medium, 1)
        shortening += dr.select(medium > 1, (reached - distance) * (1 - dr.rcp(medium)), 0)
        distance = reached
        medium = dr.select(interface, dr.select(medium == 1, solid, 1), medium)
        if dr.hint(world.has_cutouts, mode="scalar"):
            passing |= hit & ~passing & (si.shape.eval_attribute_1(OPACITY, si, hit) < 0.5)
        ray = spawn(si, ray.d)
        layer += 1
        searching = passing & (layer < MAX_LAYERS)
        lost = passing & ~searching
        si.t = dr.select(lost, dr.inf, si.t)
        transmission = dr.select(lost, 0, transmission)
    return si, transmission, optical, distance, shortening


def laser_leg(
    world: World, si: Any, pixel: Any, active: Any, *, seen_by_camera: tuple[Any, Any] | None
) -> tuple[Any, Any]:
    """What the laser does at a surface: radiance scattered towards `si.wi` [1/(m^2 sr)] and the laser leg's path [m].

    L = f(wi, wo) cos I(w) T / d^2.
    """
    direction, irradiance, path = laser_light(world, si, pixel, active, seen_by_camera=seen_by_camera)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(direction), active)
    radiance = value[0] * irradiance
    return dr.select(active & dr.isfinite(radiance), radiance, 0), path


def laser_light(
    world: World, si: Any, pixel: Any, active: Any, *, seen_by_camera: tuple[Any, Any] | None
) -> tuple[Any, Any, Any]:
    """Direction to the laser, irradiance I(w) T / d^2 [1/m^2] across it, and the laser leg's path [m] at a surface.

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


def spreading(distance: Any, shortening: Any) -> Any:
    """Factor on 1 / distance^2 where solid glass on the way changes how a point's light spreads.

    A thin cone of half angle a around the normal of a slab (thickness t, index n) runs inside it at a/n, and leaves it
    with a radius t a (1 - 1/n) smaller than without: it spreads as if the distance d were d - t (1 - 1/n), whatever the
    order of air and glass. The irradiance is I T / (d - sum t (1 - 1/n))^2, exact at normal incidence. The radiance
    that a camera sees through a flat slab does not change.
    """
    return dr.square(distance / dr.maximum(distance - shortening, 1e-3 * distance))


def in_beam(world: World, point: Any, pixel: Any) -> Any:
    """Whether the laser shines on a point: in its cone (flood), or in the row (line) or pixel (scan) being measured."""
    laser = world.scene.laser
    if laser.mode == "flood":
        aim = to_camera(world, mi.Vector3f(point) - world.laser)
        return dr.atan2(dr.norm(mi.Vector2f(aim.x, aim.y)), aim.z) <= world.half_angle
    local = to_camera(world, mi.Vector3f(point))
    row = dr.floor(local.y / local.z * world.focal_px + Float(world.height) / 2)
    column = dr.floor(local.x / local.z * world.focal_px + Float(world.width) / 2)
    same = (local.z > 0) & (row == Float(pixel // world.width))
    return same & (column == Float(pixel % world.width)) if laser.mode == "scan" else same


def segment(world: World, si: Any, point: Any, active: Any) -> tuple[Any, Any]:
    """Transmission of the straight way from a surface to a point, 0 where it is blocked, and its optical path [m].

    The transmission includes the glass's `spreading`: it is what f cos I / distance^2 is to be multiplied by.
    """
    distance = dr.norm(point - si.p)
    if not world.sees_through:
        ray = spawn(si, point - si.p)
        way = point - ray.o
        length = dr.norm(way)
        ray = mi.Ray3f(ray.o, way / length, length * (1 - mi.math.ShadowEpsilon), 0, mi.Color0f())
        return dr.select(world.traced.ray_test(ray, active), Float(0), Float(1)), distance
    short = distance * (1 - 1e-4)  # not as far as a surface that the point may lie on
    ray = spawn(si, (point - si.p) / distance)
    transmission, optical, shortening = passage(world, ray, si.p, short, active, in_air=False)
    return transmission * spreading(distance, shortening), optical + (distance - short)


def passage(world: World, ray: Any, origin: Any, limit: Any, active: Any, *, in_air: bool) -> tuple[Any, Any, Any]:
    """Transmission (0: blocked), optical path and shortening (`spreading`) [m] from `origin` along `ray` to `limit`.

    `ray` starts at or a little off `origin`; `in_air` says that it starts outside of all glass, else its first
    interface tells.
    """
    if not world.sees_through:
        ray = mi.Ray3f(ray)
        ray.maxt = limit
        return dr.select(world.traced.ray_test(ray, active), Float(0), Float(1)), limit, Float(0)
    end, transmission, optical, _, shortening = _pass_layers(world, ray, origin, active, limit, in_air)
    return dr.select(end.is_valid(), 0, transmission), optical, shortening
