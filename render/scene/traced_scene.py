"""A `Scene` as the ray tracer holds it: a Mitsuba scene, and the camera and laser as Dr.Jit arrays."""

from __future__ import annotations

import copy
import math
import weakref
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from render.backend.drjit_types import Array
from render.backend.llvm import start_mitsuba
from render.backend.malloc import retain_freed_memory
from scenes.model import Camera, Material, Scene, Surface, Texture

mi = start_mitsuba()
import drjit as dr  # noqa: E402  (other modules take dr and mi from here: only now has an LLVM been chosen)

retain_freed_memory()

Float, UInt32, Bool = mi.Float, mi.UInt32, mi.Bool
ALIGNMENT = 64  # bytes
OPACITY = "opacity"
MIN_GLINT_RADIANCE = 1.0  # 1/sr, three times white paint: direct light is refined at brighter highlights
LIGHT_PATH_PEAK = 0.05  # 1/sr: of surfaces with brighter highlights paths may begin at the laser
FACE_ALBEDO = "face_albedo"
# u of albedo 0 on a plastic's ramp, and how much more albedo 1 has; the ramp's mean, 1/2 whatever the albedo, only says
# how often paths follow the coat
RAMP_FROM, RAMP = 0.25, 0.5
# not by the texture units of a GPU, which round places between texels to 1/256
BITMAP = {"type": "bitmap", "raw": True, "filter_type": "bilinear", "accel": False}


class TracedScene:
    """A scene ready to trace: merged meshes, tables of their materials, the laser's intensity per pixel.

    The traced world has the scene's axes. Its origin is the camera, where float32 resolves best; or, of a place that
    several cameras look at (`origin_in_scene`), the middle of the scene: then `with_camera` gives the world of another
    camera without building anything again. `eye` is the camera in the traced world.
    Surfaces whose materials differ in nothing but a plain albedo share one mesh, with an albedo per face: the number of
    meshes decides which kernels are compiled, so scenes of a set with the same kinds of material share their kernels.
    `groups[i]` are the surfaces of mesh i, `shape_ids[i]` its registered index; `solid_indices` those of solid glass.
    Tables per registered shape: index of refraction of solid and thin glass (0: none), albedo of conductors (-1: none),
    `peak` of the highlight (0: none that matters).
    `plastics` are its plain coated materials, which the next world of a set may be given: their tables take longer than
    all its other parts.
    Not a dataclass: Dr.Jit would take its fields for variables of every loop that mentions it.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        origin_in_scene: bool = False,
        cutouts_by_mitsuba: bool = False,
        plastics: Mapping[tuple, Array] | None = None,
    ) -> None:
        groups: dict[tuple, list[Surface]] = {}
        for surface in scene.surfaces:
            groups.setdefault(_merge_key(surface), []).append(surface)
        self.groups = tuple(tuple(group) for group in groups.values())
        materials = [group[0].material for group in self.groups]
        self.has_glass = any(m.is_glass for m in materials)
        self.has_cutouts = any(m.has_holes for m in materials)
        masks = "mitsuba" if cutouts_by_mitsuba else "ours" if self.has_cutouts else "none"
        self.origin = np.mean(scene.bounds(), axis=0) if origin_in_scene else scene.camera.origin
        self.plastics: dict[tuple, Any] = {}
        meshes = {}
        for i, group in enumerate(self.groups):
            bsdf = self._reflectance(group[0].material, masks, plastics or {})
            meshes[f"mesh{i}"] = _mesh(f"mesh{i}", group, self.origin, bsdf, masks)
        # lights are chosen by their power, half the time the environment: walls may stop any of its light, or none
        environment = _environment(scene, sum(map(_power, self.groups)) or 1.0)
        lights = {} if environment is None else {"environment": environment}
        # optimize=False: equal objects must not be merged, since shapes are told apart by their registry index
        # robust: without it a ray through the shared edge of two triangles can miss both (OptiX is so by itself)
        robust = {"embree_use_robust_intersections": True} if mi.variant().startswith("llvm") else {}
        described = {"type": "scene", **robust, **meshes, **lights}
        self.mi_scene = mi.load_dict(described, optimize=False)
        self.shape_ids = np.array([int(dr.reinterpret_array(UInt32, mi.ShapePtr(m))[0]) for m in meshes.values()])
        self.solid_ior = self.table([m.ior if m.kind == "dielectric" else 0 for m in materials])
        self.thin_ior = self.table([m.ior if m.kind == "thindielectric" else 0 for m in materials])
        # what these reflect depends on where they are seen from
        rough_lobes = [float(m.kind in ("roughplastic", "roughconductor")) for m in materials]
        self.has_rough_lobes, self.rough_lobes = any(rough_lobes), self.table(rough_lobes)
        # what these show is traced apart (`render.specular`)
        mirrors = [float(m.kind == "conductor") for m in materials]
        self.has_mirrors, self.mirrors = any(mirrors), self.table(mirrors)
        self.has_mixed_lobes = any(m.kind not in ("diffuse", "roughdiffuse") for m in materials)
        # paths that meet smooth plastic share none of it (`render.indirect.reuse`)
        self.allows_reuse = self.table([m.kind != "plastic" for m in materials])
        self.albedo = self.table([_specular_albedo(m) for m in materials])
        # highlights that outshine paint and may be narrower than what a ray stands for (`render.direct.edges`)
        peaks = [_peak(m) for m in materials]
        self.has_glints = max(peaks, default=0) > MIN_GLINT_RADIANCE
        self.peak = self.table([peak if peak > MIN_GLINT_RADIANCE else 0 for peak in peaks])
        self.has_glossy = max(peaks, default=0) > LIGHT_PATH_PEAK
        self.glossy_materials = self.table([peak > LIGHT_PATH_PEAK for peak in peaks])
        self.roughness = self.table([m.roughness for m in materials])
        self.solid_indices = sorted({m.ior for m in materials if m.kind == "dielectric"})
        self.solid_index = dr.opaque(Float, max(self.solid_indices, default=1.0))
        self.refracts = False  # `render.scene.refraction`
        self.recordings = Recordings()
        self._bind_camera(scene)

    def refracting(self, bent: bool) -> TracedScene:
        """Return the same world in which solid glass bends direct light, or does not."""
        other = copy.copy(self)
        other.refracts, other.responses = bent, self.responses if bent == self.refracts else {}
        return other

    def with_camera(self, camera: Camera) -> TracedScene:
        """Return the same surfaces and lights before another camera and laser; nothing is built or recorded again."""
        other = copy.copy(self)
        other._bind_camera(replace(self.scene, camera=camera))
        return other

    def _bind_camera(self, scene: Scene) -> None:
        self.scene, camera = scene, scene.camera
        self.responses: dict[tuple, np.ndarray] = {}  # `render.planning.pilot_response`
        self.glossy: Any = None  # `render.indirect.glossy.glossy_of`
        size = camera.width * camera.height + 5  # of no launch's size: pilots have a lane a pixel (`_Given`)
        self.intensity = upload(Float, scene.laser.intensity(camera), size)
        self.eye_m = camera.origin - self.origin
        self.eye = _opaque(self.eye_m)
        self.laser = _opaque(scene.laser.position(camera) - self.origin)
        self.axes = tuple(_opaque(column) for column in camera.rotation.T)
        self.focal_px = dr.opaque(Float, camera.focal_px)  # a literal would compile every kernel again for each view
        self.width, self.height = dr.opaque(UInt32, camera.width), dr.opaque(UInt32, camera.height)
        # the corner pixels' rays lie on the rim of the smallest cone
        self.half_angle = dr.opaque(Float, scene.laser.half_angle(camera) * (1 + 1e-5))

    def _reflectance(self, material: Material, masks: str, known: Mapping[tuple, Array]) -> Array:
        """Make Mitsuba's BSDF of a material, taken from those known if it is a plain, whole plastic that is among
        them."""
        bsdf = _bsdf(material, _albedo(material))
        if masks == "mitsuba" and material.has_holes:
            bsdf = {"type": "mask", "opacity": _texture(material.opacity), "nested": bsdf}
        if material.has_holes or not _is_on_ramp(material):
            return mi.load_dict(bsdf)
        key = material.kind, *(getattr(material, name) for name in _PARAMETERS[material.kind])
        self.plastics[key] = self.plastics.get(key) or known.get(key) or mi.load_dict(bsdf)
        return self.plastics[key]

    def table(self, values: list[float]) -> Array:
        """Return one value a mesh as an array over registered shapes, to be read at `shape_index`."""
        table = np.zeros(6 * (self.shape_ids.max() // 6 + 1))  # of no launch's size (`footprints`), nor one
        table[self.shape_ids] = values
        return upload(Float, table)

    def arrays(self) -> dict[str, Array | tuple[Array, ...]]:
        """Return everything of the world that lives in Dr.Jit: a recording has to be told its inputs."""
        held = {
            name: value
            for name, value in vars(self).items()
            if dr.is_array_v(value)
            or (isinstance(value, tuple) and value and all(dr.is_array_v(part) for part in value))
        }
        return {**held, "traced": self.mi_scene}

    def with_arrays(self, arrays: dict[str, Array | tuple[Array, ...]]) -> TracedScene:
        """Return a copy with other Dr.Jit arrays: a recording refuses those that are not among its arguments."""
        other = copy.copy(self)
        vars(other).update(arrays)
        return other

    @property
    def sees_through(self) -> bool:
        return self.has_glass or self.has_cutouts


# What does not depend on a world is recorded once for all; see `Recordings`.
recorded = partial(dr.freeze, warn_after=1000)


class Recordings:
    """Kernels of a world that were traced once and are replayed (`recorded`); `world` is the one that asks."""

    def __init__(self) -> None:
        self.calls: dict[Any, Callable] = {}
        self.world: weakref.ref[TracedScene] | None = None

    def call(self, world: TracedScene, key: Hashable, work: Callable, *arguments: Array) -> Array:
        """Return `work(world, *arguments)`, recorded at the first call of `key` for this world's surfaces, then
        replayed.

        What Python and Dr.Jit need to trace a small launch takes longer than its rays. `arguments` are Dr.Jit arrays.
        """
        if key not in self.calls:
            # weakly: a world held by its own recording would stay among the scenes that Dr.Jit compiles calls for
            owner = weakref.ref(self)
            self.calls[key] = recorded(lambda arrays, *given: work(_asking(owner).with_arrays(arrays), *given))
        self.world = weakref.ref(world)
        return self.calls[key](world.arrays(), *arguments)


def _asking(owner: weakref.ref[Recordings]) -> TracedScene:
    """Return the world that asks for a recording; it is alive while it asks."""
    recordings = owner()
    world = None if recordings is None or recordings.world is None else recordings.world()
    assert world is not None
    return world


_NUMPY = {Float: np.float32, UInt32: np.uint32, mi.UInt64: np.uint64, Bool: np.bool_, mi.Int32: np.int32}


def upload(kind: type, values: np.ndarray, size: int | None = None) -> Array:
    """Return values as a flat Dr.Jit array of `kind` (one of _NUMPY), copied to aligned memory; the last one is
    repeated up to `size`."""
    count = np.size(values)
    memory = aligned(size or count, _NUMPY[kind])
    memory[:count] = np.ravel(values)
    memory[count:] = memory[count - 1 : count]
    return kind(memory)


def aligned(size: int, dtype: type) -> np.ndarray:
    """Return an empty flat array in memory aligned to 64 bytes.

    On the CPU Dr.Jit uses a numpy array's own memory, and compiles one kernel for aligned and another for unaligned
    input.
    """
    count = size * np.dtype(dtype).itemsize
    memory = np.empty(count + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + count].view(dtype)


def _opaque(vector: np.ndarray) -> Array:
    return mi.Vector3f(*(dr.opaque(Float, float(v)) for v in vector))


_PARAMETERS = {
    "diffuse": (),
    "plastic": ("specular", "ior"),
    "roughplastic": ("specular", "ior", "roughness", "distribution"),
    "conductor": ("specular", "eta", "k"),
    "roughconductor": ("specular", "eta", "k", "roughness", "distribution"),
    "dielectric": ("ior",),
    "thindielectric": ("ior",),
}


def _merge_key(surface: Surface) -> tuple:
    """Make a key by which surfaces share a mesh: equal materials but for a plain albedo, which each face keeps."""
    material = surface.material
    kind = "diffuse" if material.kind == "roughdiffuse" else material.kind
    albedo: object = id(material.albedo) if isinstance(material.albedo, Texture) else None
    opacity: float | Texture = material.opacity
    if isinstance(opacity, Texture):
        opacity, albedo = id(opacity), albedo or material.albedo
    parameters = tuple(getattr(material, name) for name in _PARAMETERS[kind])
    return kind, parameters, albedo, opacity, surface.emission, surface.normals is not None


def _specular_albedo(material: Material) -> float:
    """Compute the scaled reflectance of a conductor at normal incidence; -1 for what has a diffuse reflectance of its
    own."""
    if material.kind not in ("conductor", "roughconductor"):
        return -1.0
    eta, k = material.eta, material.k
    return material.specular * ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)


def _peak(material: Material) -> float:
    """Compute f cos of a rough lobe at the middle of its highlight seen along the light, F_0 / (4 pi alpha^2) [1/sr]
    (GGX or Beckmann with all cosines 1); 0 for other lobes."""
    if material.kind == "roughconductor":
        mirrored = _specular_albedo(material)
    elif material.kind == "roughplastic":
        mirrored = material.specular * ((material.ior - 1) / (material.ior + 1)) ** 2
    else:
        return 0.0
    return mirrored / (4 * math.pi * material.roughness**2)


def _mesh(name: str, surfaces: tuple[Surface, ...], origin: np.ndarray, bsdf: Array, masks: str) -> Array:
    """Make one mesh of surfaces that share a material; cut-outs by `masks`: none, ours (an attribute), or the BSDF's
    own."""
    material = surfaces[0].material
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    vertices = np.concatenate([s.vertices for s in surfaces]) - origin
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts[:-1], strict=True)])
    props = mi.Properties()
    props["bsdf"] = bsdf
    power = _power(surfaces)
    if power > 0:  # not of degenerate faces alone
        radiance = {"type": "rgb", "value": surfaces[0].emission}
        props["emitter"] = mi.load_dict({"type": "area", "radiance": radiance, "sampling_weight": power})
    smooth = surfaces[0].normals is not None
    mesh = mi.Mesh(name, len(vertices), len(faces), props, has_vertex_normals=smooth, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = upload(Float, vertices)
    params["faces"] = upload(UInt32, faces)
    if _is_on_ramp(material):
        albedo = np.repeat([s.material.albedo for s in surfaces], np.diff(starts))
        uv = np.column_stack((RAMP_FROM + RAMP * albedo, np.full(len(albedo), 0.5)))
    else:
        uv = np.concatenate([np.zeros((len(s.vertices), 2)) if s.uv is None else s.uv for s in surfaces])
    # Mitsuba's v runs down the image, ours up
    params["vertex_texcoords"] = upload(Float, np.column_stack((uv[:, 0], 1 - uv[:, 1])))
    if smooth:
        params["vertex_normals"] = upload(Float, np.concatenate([s.normals for s in surfaces]))
    params.update()
    if _is_on_faces(material):
        values = np.repeat([s.material.albedo for s in surfaces], [len(s.faces) for s in surfaces])
        mesh.add_attribute(FACE_ALBEDO, 1, values.astype(np.float32))
    if masks == "ours":
        mesh.add_texture_attribute(OPACITY, mi.load_dict(_texture(material.opacity)))
    return mesh


def _is_on_faces(material: Material) -> bool:
    """Return whether a material's albedo is stored as an attribute of the mesh's faces."""
    return material.kind in ("diffuse", "roughdiffuse") and not isinstance(material.albedo, Texture)


def _is_on_ramp(material: Material) -> bool:
    """Return whether a material's albedo is stored as a texture coordinate on a ramp.

    Mitsuba's plastics need a texture with a mean, which an attribute has not. With textured opacity the coordinates are
    taken; such a surface has a mesh of its own.
    """
    plain = not isinstance(material.albedo, Texture) and not isinstance(material.opacity, Texture)
    return material.kind in ("plastic", "roughplastic") and plain


def _albedo(material: Material) -> dict[str, object] | None:
    """Describe Mitsuba's texture for the albedo of a mesh; None where the material has no albedo."""
    if material.kind not in ("diffuse", "roughdiffuse", "plastic", "roughplastic"):
        return None
    if _is_on_faces(material):
        return {"type": "mesh_attribute", "name": FACE_ALBEDO}
    if _is_on_ramp(material):
        # two texels, whose centres are at a quarter and at three quarters
        ramp = mi.Bitmap(np.array([[[0], [1]]], np.float32))
        return {**BITMAP, "bitmap": ramp, "wrap_mode": "clamp"}
    return _texture(material.albedo)


def _texture(value: float | Texture) -> dict[str, object]:
    if not isinstance(value, Texture):
        return {"type": "uniform", "value": float(value)}
    wrap = "clamp" if value.clamps else "repeat"
    return {**BITMAP, "bitmap": mi.Bitmap(np.array(value.image[..., None])), "wrap_mode": wrap}


def _bsdf(material: Material, albedo: dict[str, object] | None) -> dict[str, object]:
    """Describe a material to Mitsuba. Glass and cut-outs are the tracer's business, not the BSDF's."""
    kind = material.kind
    inner: dict[str, Any]
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
        inner |= {"alpha": material.roughness, "distribution": material.distribution}
    return {"type": "twosided", "nested": inner}


def _power(surfaces: Sequence[Surface]) -> float:
    """Compute the emission weight of surfaces: radiance x area summed over those that emit."""
    power = 0.0
    for surface in surfaces:
        if surface.emission > 0:
            a, b, c = (surface.vertices[surface.faces[:, corner]] for corner in range(3))
            power += surface.emission * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return power


def _environment(scene: Scene, weight: float) -> dict[str, object] | None:
    ambient, sampled = scene.ambient, {"sampling_weight": weight}
    if ambient.environment is not None:
        image = np.repeat(ambient.environment.image[..., None], 3, axis=-1)
        pose = mi.ScalarTransform4f(ambient.pose)
        return {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": pose, **sampled}
    if ambient.radiance > 0:
        return {"type": "constant", "radiance": {"type": "rgb", "value": ambient.radiance}, **sampled}
    return None
