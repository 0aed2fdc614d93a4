"""The nouns of a scene: surfaces and materials, one camera, one laser, ambient light.

World frame: right-handed, metres, y up. Camera frame: x right, y down, z forward; row 0 on top; pixel (row, column)
has its centre at raster (column + 1/2, row + 1/2). All classes are frozen and validated in the constructor.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Literal, get_args

import numpy as np

from scenes.arrays import (
    check_normals,
    checked_radiance,
    finite_number,
    looking_pose,
    mesh_arrays,
    number_array,
    rigid_pose,
    three_numbers,
    vertex_array,
    whole_pixels,
)
from scenes.errors import require, require_choice, require_kind, require_kinds, tuple_of
from scenes.notebook import html_card

MaterialKind = Literal[
    "diffuse", "roughdiffuse", "plastic", "roughplastic", "conductor", "roughconductor", "dielectric", "thindielectric"
]
MicrofacetDistribution = Literal["ggx", "beckmann"]
LaserMode = Literal["flood", "line", "scan"]
Triple = Iterable[float]  # x, y, z
MATERIAL_KINDS: tuple[str, ...] = get_args(MaterialKind)
LASER_MODES: tuple[str, ...] = get_args(LaserMode)
DISTRIBUTIONS: tuple[str, ...] = get_args(MicrofacetDistribution)
# Fields that came later, left out of a hash at these values: what was there before keeps its hash.
_ADDED_AT = {"distribution": "ggx", "clamps": False}
# Metres from the origin: float32, in which rays are traced, resolves 1 m there.
MAX_COORDINATE_M = 1e7
MAX_IMAGE_SIDE = 16384  # pixels
MIN_CONE_DEG = 1e-6  # float32 holds its intensity, and places on its rim


@dataclass(frozen=True, eq=False)
class Texture:
    """A single-channel linear image mapped by texture coordinates: u to the right, v upwards, repeating or clamped.

    image: (h, w) float32, row 0 on top. `name` says where it came from. Raises InputError for values below 0.
    """

    image: np.ndarray
    name: str
    clamps: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        require_kinds(self, "texture", name=str, clamps=bool)
        image = number_array(self.image, np.float32, f"texture {self.name}")
        require(image.ndim == 2 and image.size > 0, f"texture {self.name}: shape {image.shape}, expected (h, w)")
        require(bool(np.isfinite(image).all()), f"texture {self.name}: holds NaN or infinite values")
        require(bool(image.min() >= 0), f"texture {self.name}: negative value {image.min():g}")
        image.setflags(write=False)
        object.__setattr__(self, "image", image)


def _fraction(value: float | Texture, what: str) -> float | Texture:
    """`value`, a number or a texture, if it lies in [0, 1], as a reflectance or an opacity does."""
    if not isinstance(value, Texture):
        value = finite_number(value, what)
    low, high = (value.image.min(), value.image.max()) if isinstance(value, Texture) else (value, value)
    require(bool(low >= 0 and high <= 1), f"{what}: {low:g} to {high:g} is outside [0, 1]")
    return value


@dataclass(frozen=True, eq=False)
class Material:
    """Material of a surface: how it reflects at the laser's wavelength. Raises InputError for values out of range.

    kind        the reflectance model; names and meaning are those of Mitsuba 3
    albedo      diffuse reflectance, number or texture (diffuse, roughdiffuse, plastic, roughplastic)
    roughness   alpha of the rough kinds' microfacets; Oren-Nayar alpha of roughdiffuse
    distribution  of the microfacets' normals (roughplastic, roughconductor): ggx or beckmann. At one alpha both have
                the same peak, and ggx the longer tails
    specular    scale of the specular reflectance (plastic, conductor)
    ior         interior index of refraction (plastic, dielectric)
    eta, k      complex index of a conductor; (0, 1) is a perfect mirror. Metals by name have theirs at 650 nm
    opacity     share of the surface that is there (cut-out masks), number or texture; 1 of glass
    """

    kind: MaterialKind = "diffuse"
    albedo: float | Texture = 0.5
    roughness: float = 0.1
    distribution: MicrofacetDistribution = field(default="ggx", kw_only=True)
    specular: float = 1.0
    ior: float = 1.5
    eta: float = 0.0
    k: float = 1.0
    opacity: float | Texture = 1.0
    name: str = "material"

    def __post_init__(self) -> None:
        require_kinds(self, "material", name=str)
        where = f"material {self.name}"
        require_choice(self.kind, MATERIAL_KINDS, f"{where}: kind")
        require_choice(self.distribution, DISTRIBUTIONS, f"{where}: distribution")
        for label in ("albedo", "specular", "opacity"):
            object.__setattr__(self, label, _fraction(getattr(self, label), f"{where}: {label}"))
        for label in ("roughness", "ior", "eta", "k"):
            object.__setattr__(self, label, finite_number(getattr(self, label), f"{where}: {label}"))
        require(0 < self.roughness <= 1, f"{where}: roughness {self.roughness:g} is outside (0, 1]")
        require(1 < self.ior <= 5, f"{where}: index of refraction {self.ior:g} is outside (1, 5]")
        require(not (self.is_glass and self.has_holes), f"{where}: glass has opacity 1 here, cut its mesh instead")
        for label in ("eta", "k"):
            require(getattr(self, label) >= 0, f"{where}: conductor {label} {getattr(self, label):g} is negative")

    @property
    def is_glass(self) -> bool:
        """Return whether light goes through the surface itself (not through holes cut in it)."""
        return self.kind in ("dielectric", "thindielectric")

    @property
    def lets_light_through(self) -> bool:
        """Return whether light goes through the surface, or through holes cut in it."""
        return self.is_glass or self.has_holes

    @property
    def has_holes(self) -> bool:
        """Return whether the opacity is below 1 anywhere."""
        return bool(np.min(self.opacity.image if isinstance(self.opacity, Texture) else self.opacity) < 1)


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh with one material; both of its sides reflect.

    vertices (n, 3) metres, faces (m, 3), optional uv (n, 2) and shading normals (n, 3) per vertex.
    `emission` is the steady spectral radiance of an area light [W/(m^2 sr nm)], on the side of the face normals.
    Raises InputError for a mesh that does not hold together, numbers that are not finite, and normals of length 0.
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: Material = field(default_factory=Material)
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None
    emission: float = 0.0
    name: str = "surface"

    def __post_init__(self) -> None:
        require_kinds(self, "mesh", name=str)
        where = f"mesh {self.name}"
        require_kinds(self, where, material=Material)
        vertices, faces = mesh_arrays(self.vertices, self.faces, MAX_COORDINATE_M, where)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        for label, width in (("uv", 2), ("normals", 3)):
            if getattr(self, label) is not None:
                array = vertex_array(getattr(self, label), width, len(vertices), label, where)
                object.__setattr__(self, label, array)
        if self.normals is not None:
            check_normals(self.normals, faces, where)
        textured = isinstance(self.material.albedo, Texture) or isinstance(self.material.opacity, Texture)
        require(self.uv is not None or not textured, f"{where}: its material has a texture, the mesh no uv coordinates")
        object.__setattr__(self, "emission", checked_radiance(self.emission, f"{where}: emission"))


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `pose` camera to world (4x4), `fov_deg` the full horizontal angle. InputError out of range."""

    pose: np.ndarray
    fov_deg: float
    width: int
    height: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", rigid_pose(self.pose, "camera pose"))
        for label, value in (("width", self.width), ("height", self.height)):
            object.__setattr__(self, label, whole_pixels(value, MAX_IMAGE_SIDE, f"camera {label}"))
        object.__setattr__(self, "fov_deg", finite_number(self.fov_deg, "camera fov"))
        require(0.01 <= self.fov_deg <= 170, f"camera fov {self.fov_deg:g} degrees is outside 0.01 to 170")

    @classmethod
    def look_at(
        cls, origin: Triple, target: Triple, *, fov_deg: float, width: int, height: int, up: Triple = (0.0, 1.0, 0.0)
    ) -> Camera:
        """Return a camera at `origin` [m] that looks at `target` [m], `up` upwards in the image, or an InputError."""
        return cls(looking_pose(origin, target, up), fov_deg, width, height)

    @property
    def origin(self) -> np.ndarray:
        """Return the camera's position in the world [m], (3,)."""
        return self.pose[:3, 3]

    @property
    def rotation(self) -> np.ndarray:
        """Camera to world, 3x3: its columns are the image's right, down and forward in the world."""
        return self.pose[:3, :3]

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, (W/2) / tan(fov/2)."""
        return 0.5 * self.width / math.tan(math.radians(self.fov_deg) / 2)

    def resized(self, width: int | None = None, height: int | None = None) -> Camera:
        """Return the same horizontal angle with another image size; one size alone keeps the proportions."""
        if width is None:
            if height is None:
                return self
            height = whole_pixels(height, MAX_IMAGE_SIDE, "camera height")
            width = max(1, round(self.width * height / self.height))
        elif height is None:
            width = whole_pixels(width, MAX_IMAGE_SIDE, "camera width")
            height = max(1, round(self.height * width / self.width))
        return replace(self, width=width, height=height)

    def rays(self, x: np.ndarray | None = None, y: np.ndarray | None = None) -> np.ndarray:
        """Return unit directions in the world, (..., 3) float64, through raster positions x, y (default: all pixel
        centres, (H, W, 3)), which broadcast to (...,)."""
        if x is None or y is None:
            x, y = np.arange(self.width) + 0.5, np.arange(self.height)[:, None] + 0.5
        local = np.ones((*np.broadcast_shapes(np.shape(x), np.shape(y)), 3))
        local[..., 0], local[..., 1] = (x - self.width / 2) / self.focal_px, (y - self.height / 2) / self.focal_px
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.rotation.T

    def pixel_solid_angle(self) -> np.ndarray:
        """Return solid angle of each pixel [sr], (H, W): the sum over corners of +-atan(x y / sqrt(1 + x^2 + y^2))."""
        x = (np.arange(self.width + 1) - self.width / 2) / self.focal_px
        y = (np.arange(self.height + 1)[:, None] - self.height / 2) / self.focal_px
        corner = np.arctan(x * y / np.sqrt(1 + x * x + y * y))
        return corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]


@dataclass(frozen=True, eq=False)
class Laser:
    """A pulsed laser, co-located with the camera or displaced by a baseline.

    mode        flood: constant radiant intensity over a circular cone; line: the image row being measured is lit;
                scan: the pixel being measured is lit
    baseline_m  laser minus camera, in the camera frame (x right, y down, z forward)
    cone_deg    full angle of the flood cone around the camera's axis; None: the smallest cone that holds the image

    Its profile I(w) [1/sr] integrates to 1 over its cone, row or pixel. A displaced line or scan beam keeps its solid
    angle and is steered onto what the pixel sees. Raises InputError for an unknown mode, and values out of range.
    """

    mode: LaserMode = "flood"
    baseline_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cone_deg: float | None = None

    def __post_init__(self) -> None:
        require_choice(self.mode, LASER_MODES, "laser mode")
        object.__setattr__(self, "baseline_m", three_numbers(self.baseline_m, "laser baseline [m]", MAX_COORDINATE_M))
        if self.cone_deg is not None:
            object.__setattr__(self, "cone_deg", finite_number(self.cone_deg, "laser cone"))
            good = MIN_CONE_DEG <= self.cone_deg <= 360
            require(good, f"laser cone {self.cone_deg:g} degrees is outside (0, 360], {MIN_CONE_DEG:g} at least")
        require(self.cone_deg is None or self.mode == "flood", f"laser mode {self.mode}: a cone is for flood only")

    @property
    def is_colocated(self) -> bool:
        """Return whether the laser is at the camera."""
        return self.baseline_m == (0.0, 0.0, 0.0)

    def position(self, camera: Camera) -> np.ndarray:
        """Return the laser's position in the world [m], (3,)."""
        return camera.origin + camera.rotation @ np.asarray(self.baseline_m)

    def half_angle(self, camera: Camera) -> float:
        """Return half angle of the flood cone [rad]."""
        if self.cone_deg is not None:
            return math.radians(self.cone_deg) / 2
        return math.acos(camera.focal_px / math.hypot(camera.focal_px, camera.width / 2, camera.height / 2))

    def cos_half_angle(self, camera: Camera) -> float:
        """Return cosine of the flood cone's half angle."""
        return math.cos(self.half_angle(camera))

    def intensity(self, camera: Camera) -> np.ndarray:
        """Return radiant intensity (H, W) of the lit cone, row or pixel while each is measured [1/sr per joule]."""
        if self.mode == "flood":  # 1 - cos without cancellation
            return np.full((camera.height, camera.width), 0.25 / math.pi / math.sin(self.half_angle(camera) / 2) ** 2)
        solid_angle = camera.pixel_solid_angle()
        if self.mode == "line":
            solid_angle = np.broadcast_to(solid_angle.sum(axis=1, keepdims=True), solid_angle.shape)
        return 1 / solid_angle


@dataclass(frozen=True, eq=False)
class Ambient:
    """Steady light that is not the laser's: a constant radiance or an environment map [W/(m^2 sr nm)].

    The map is equirectangular, placed as Mitsuba's `envmap` places it: its top row looks along +y of its own frame,
    its left and right edges meet along -z; `pose` is environment to world (4x4). Area lights belong to their `Surface`.
    Raises InputError for radiances below 0, or both at once.
    """

    radiance: float = 0.0
    environment: Texture | None = None
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        object.__setattr__(self, "radiance", checked_radiance(self.radiance, "ambient radiance"))
        if self.environment is not None:
            require_kind(self.environment, Texture, "ambient environment")
            checked_radiance(self.environment.image.max(), f"environment map {self.environment.name}: radiance")
        both = self.environment is not None and self.radiance > 0
        require(not both, "ambient light is either a constant radiance or an environment map, not both")
        object.__setattr__(self, "pose", rigid_pose(self.pose, "environment pose"))


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Everything that is there; `notes` say what a loader changed or left out. Raises InputError without surfaces.

    `help(scenes)` has an example of a scene that is built by hand from these parts.
    """

    name: str
    surfaces: tuple[Surface, ...]
    camera: Camera
    laser: Laser = field(default_factory=Laser)
    ambient: Ambient = field(default_factory=Ambient)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_kinds(self, "scene", name=str)
        where = f"scene {self.name}"
        object.__setattr__(self, "surfaces", tuple_of(self.surfaces, Surface, f"{where}: surfaces"))
        require(len(self.surfaces) > 0, f"{where}: has no surfaces")
        require_kinds(self, where, camera=Camera, laser=Laser, ambient=Ambient)
        notes = tuple_of(self.notes, str, f"{where}: notes")
        object.__setattr__(self, "notes", tuple(" ".join(note.split()) for note in notes))

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the facts."""
        seen = f"{self.camera.height} rows x {self.camera.width} columns, {self.camera.fov_deg:g} degrees wide"
        facts = {"surfaces": len(self.surfaces), "triangles": self.triangles, "camera": seen, "laser": self.laser.mode}
        return html_card(f"Scene {self.name}", facts)

    def __repr__(self) -> str:
        camera, laser = self.camera, self.laser
        seen = f"{camera.width} x {camera.height} pixels, fov {camera.fov_deg:g} deg, {laser.mode} laser"
        return f"Scene({self.name!r}, {len(self.surfaces)} surfaces, {self.triangles} triangles, {seen})"

    @property
    def triangles(self) -> int:
        """Return the number of triangles of all surfaces."""
        return sum(len(surface.faces) for surface in self.surfaces)

    @property
    def has_ambient(self) -> bool:
        """Return whether any light but the laser's is there."""
        lit = self.ambient.radiance > 0 or self.ambient.environment is not None
        return lit or any(surface.emission > 0 for surface in self.surfaces)

    def without_lights(self) -> Scene:
        """Return the same scene under no light but the laser's."""
        return replace(self, surfaces=tuple(replace(s, emission=0.0) for s in self.surfaces), ambient=Ambient())

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lowest and highest corner of all surfaces [m], (3,) each."""
        low = np.min([s.vertices.min(axis=0) for s in self.surfaces], axis=0)
        return low, np.max([s.vertices.max(axis=0) for s in self.surfaces], axis=0)

    def digest(self) -> str:
        """Return SHA-256 over everything that decides what is rendered; names and notes do not count.

        It is the hash of the parts' hashes, which textures, materials and surfaces keep: views share them.
        """
        return part_digest((self.surfaces, self.camera, self.laser, self.ambient)).hex()


def part_digest(value: object) -> bytes:
    """Return SHA-256 of a part of a scene, kept in the objects that never change."""
    kept = value.__dict__.get("_digest") if isinstance(value, (Texture, Material, Surface)) else None
    if kept is not None:
        return kept
    sha = hashlib.sha256(type(value).__name__.encode())
    if isinstance(value, tuple):
        for item in value:
            sha.update(part_digest(item))
    elif isinstance(value, np.ndarray):
        sha.update(f"{value.dtype.str}{value.shape}".encode())
        sha.update(np.ascontiguousarray(value).data)
    elif isinstance(value, (Texture, Material, Surface, Camera, Laser, Ambient)):
        for item in fields(value):
            part = getattr(value, item.name)
            if item.name != "name" and not (item.name in _ADDED_AT and part == _ADDED_AT[item.name]):
                sha.update(part_digest(part))
        if isinstance(value, (Texture, Material, Surface)):
            object.__setattr__(value, "_digest", sha.digest())
    else:
        sha.update(repr(value).encode())
    return sha.digest()
