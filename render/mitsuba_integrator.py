"""The renderer as an integrator of Mitsuba: `scene2spad` in XML and `mi.load_dict`, with dense output.

Mitsuba's scene is read into a `Scene`, so what is rendered is what `render` renders: the pulse of a flood laser at the
camera. Lights of the scene add nothing, since the output holds the laser's light alone.
"""

from __future__ import annotations

import sys

import numpy as np

from render.backend.drjit_types import Array
from render.backend.llvm import start_mitsuba
from render.settings import MAX_BOUNCES, RenderSettings
from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError, listed, require
from scenes.io.mitsuba.clipping import is_cut
from scenes.io.textures import luminance
from scenes.limits import require_memory
from scenes.model import Camera, Material, Scene, Surface

NAME = "scene2spad"
TEMPORAL_BINS = 1024
BIN_WIDTH_OPL_M = SPEED_OF_LIGHT_M_PER_S * 100e-9 / TEMPORAL_BINS  # of the reference sensor: 100 ns in 1,024 bins
VARIANTS = ("_mono", "_rgb")
_registered: set[str] = set()  # names, which may be registered again for another variant
ENTRIES = 1 << 22  # returns, each as often as it has bins, that are binned at once


def register_integrator(name: str = NAME) -> None:
    """Register the renderer as an integrator plugin with Mitsuba's present variant.

    Call it after `mi.set_variant`, with a variant in mono or rgb; without a variant one is set. The plugin takes
    `temporal_bins` (1,024), `bin_width_opl` [m of optical path] (0.0293), `start_opl` [m] (0), `max_depth` (surfaces
    that light meets plus one, as in Mitsuba; the plan chooses if it is left out) and `error` (0.02). `mi.render(scene)`
    then returns a tensor (height, width, temporal_bins): radiance per joule of the pulse that arrives in the bin
    [1/(m^2 sr)]. Light outside the bins is left out. Meshes, `diffuse` (uniform) and `conductor` are read.

    Raises
    ------
    InputError
        For another variant, and a name that is no text or a plugin of Mitsuba's own; and by the render for a shape,
        material or camera that has no counterpart here. `mi.render` and `mi.load_dict` raise a RuntimeError of their
        own in its place, whose first line they write: the first has it as its `__cause__`, the second ends with its
        words. `scene.integrator().render(scene)` raises it as it is.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> s2s.register_integrator()
    >>> import mitsuba as mi
    >>> integrator = mi.load_dict({"type": "scene2spad", "temporal_bins": 512, "error": 0.05})
    """
    require(isinstance(name, str) and bool(name), f"register_integrator: name {name!r}, expected text")
    if "mitsuba" not in sys.modules or sys.modules["mitsuba"].variant() is None:
        start_mitsuba()
    import mitsuba as mi

    variant = str(mi.variant())
    require(variant.endswith(VARIANTS), f"variant {variant}: the integrator knows those in mono and rgb")

    known = mi.PluginManager.instance().plugin_type(name)
    free = name in _registered or known == mi.ObjectType.Unknown
    require(free, f"register_integrator: {name!r} is a plugin of Mitsuba already ({known.name}), choose another name")
    mi.register_integrator(name, _integrator_class(name, variant))
    _registered.add(name)


def _integrator_class(name: str, variant: str) -> type:
    """Make the plugin's class, whose base is that of the variant."""
    import mitsuba as mi

    class TransientIntegrator(mi.CppADIntegrator):
        """Dense transient of the scene, by this renderer."""

        def __init__(self, props: Array) -> None:
            super().__init__(props)
            self.bins = int(props.get("temporal_bins", TEMPORAL_BINS))
            self.width_m = float(props.get("bin_width_opl", BIN_WIDTH_OPL_M))
            self.start_m = float(props.get("start_opl", 0.0))
            depth = int(props.get("max_depth", -1))
            error = float(props["error"]) if "error" in props else None
            require(self.bins > 0, f"{name}: temporal_bins {self.bins} is not positive")
            require(0 < self.width_m < np.inf, f"{name}: bin_width_opl {self.width_m:g} m is not a positive length")
            good = depth == -1 or 2 <= depth <= MAX_BOUNCES + 1
            require(good, f"{name}: max_depth {depth}, expected -1 or 2 to {MAX_BOUNCES + 1}")
            self.settings = RenderSettings(bounces=None if depth < 0 else depth - 1, error=error)

        def render(
            self,
            scene: Array,
            sensor: Array = 0,
            seed: Array = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Array:
            """Return the tensor (height, width, bins). `spp` is chosen by the plan and not looked at."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            ours = scene_from_mitsuba(scene, sensor)
            transient = _rendered(ours, self.settings, int(np.asarray(seed).ravel()[0]), variant)
            return mi.TensorXf(dense_path_histogram(transient, self.bins, self.width_m, self.start_m))

        def to_string(self) -> str:
            return f"{name}[temporal_bins={self.bins}, bin_width_opl={self.width_m:g} m, start_opl={self.start_m:g} m]"

    return TransientIntegrator


def _rendered(scene: Scene, settings: RenderSettings, seed: int, variant: str) -> Transient:
    """Render under our own variant, and set the user's again."""
    import mitsuba as mi

    level = mi.log_level()
    try:
        start_mitsuba()
        from render.engine import render

        return render(scene, settings, seed=seed)
    finally:
        mi.set_variant(variant)
        mi.set_log_level(level)


def scene_from_mitsuba(scene: Array, sensor: Array) -> Scene:
    """Read a loaded Mitsuba scene: meshes, uniform diffuse or conducting materials, a perspective camera.

    Materials whose back is black in Mitsuba reflect from both sides, and what its clipping planes cut is seen, with a
    line in its log each. Raises InputError in one line that names what has no counterpart here.
    """
    import mitsuba as mi

    surfaces = tuple(_surface(shape) for shape in scene.shapes())
    require(len(surfaces) > 0, "the scene holds no shapes")
    one_sided = [shape.id() for shape in scene.shapes() if shape.bsdf().class_name() != "TwoSidedBRDF"]
    if one_sided:
        mi.Log(mi.LogLevel.Warn, f"{NAME}: shapes without twosided reflect from both sides here: {listed(one_sided)}")
    camera = _camera(sensor)
    near_m, far_m = float(sensor.near_clip()), float(sensor.far_clip())
    cut = [surface.name for surface in surfaces if is_cut(surface, camera, near_m, far_m)]
    if cut:
        limits = f"near_clip {near_m:g} or beyond far_clip {far_m:g}"
        mi.Log(mi.LogLevel.Warn, f"{NAME}: shapes are seen here nearer than {limits}: {listed(cut)}")
    return Scene("mitsuba", surfaces, camera)


def _camera(sensor: Array) -> Camera:
    import mitsuba as mi

    kind = sensor.class_name()
    require(kind == "PerspectiveCamera", f"sensor {kind} is not supported, expected perspective")
    params, film = mi.traverse(sensor), sensor.film()
    width, height = (int(n) for n in film.size())
    require(tuple(film.crop_size()) == (width, height), "the film's crop window is not supported")
    for axis in "xy":
        offset = float(np.asarray(params[f"principal_point_offset_{axis}"]).ravel()[0])
        require(offset == 0, f"principal_point_offset_{axis} {offset:g} is not supported, expected 0")
    pose = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
    # Mitsuba's camera looks along z with x to the LEFT and y up; half a turn about z gives right and down.
    pose[:3, :2] *= -1
    return Camera(pose, float(np.asarray(params["x_fov"]).ravel()[0]), width, height)


def _surface(shape: Array) -> Surface:
    name = shape.id()
    if not shape.is_mesh():
        raise InputError(f"shape {name} is a {shape.class_name()}, expected a mesh: write it as triangles")
    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    faces = np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)
    smooth = shape.has_vertex_normals() and not shape.has_face_normals()
    normals = np.array(shape.vertex_normals_buffer(), np.float64).reshape(-1, 3) if smooth else None
    return Surface(vertices, faces, _material(shape.bsdf(), name), normals=normals, name=name)


def _material(bsdf: Array, shape: str) -> Material:
    """Read a material by its parameters; those of a `twosided` are named brdf_0 and brdf_1."""
    import mitsuba as mi

    kind, params = bsdf.class_name(), mi.traverse(bsdf)
    found = {key.removeprefix("brdf_0."): params[key] for key in params.keys()}  # noqa: SIM118 (no mapping)
    require("brdf_1.reflectance.value" not in params, f"shape {shape}: two materials of twosided, expected one")
    plain = {key for key in found if not key.startswith("brdf_1.")}
    if kind in ("SmoothDiffuse", "TwoSidedBRDF") and plain == {"reflectance.value"}:
        return Material("diffuse", albedo=_grey(found["reflectance.value"]), name=shape)
    if kind in ("SmoothConductor", "TwoSidedBRDF") and {"eta.value", "k.value"} <= plain and "alpha.value" not in plain:
        eta, k = _grey(found["eta.value"]), _grey(found["k.value"])
        specular = _grey(found["specular_reflectance.value"]) if "specular_reflectance.value" in plain else 1.0
        return Material("conductor", eta=eta, k=k, specular=specular, name=shape)
    raise InputError(f"shape {shape}: {kind} has no counterpart here, expected a uniform diffuse or a conductor")


def _grey(value: Array) -> float:
    """Return a number, or the luminance of a colour."""
    values = np.asarray(value, np.float64).ravel()
    return float(luminance(values) if len(values) == 3 else values[0])


def dense_path_histogram(transient: Transient, bins: int, width_m: float, start_m: float = 0.0) -> np.ndarray:
    """Return radiance (H, W, bins) float32 [1/(m^2 sr)] by optical path, `width_m` a bin from `start_m` on.

    A return is spread evenly over its interval of path length. What lies outside the bins is left out.
    """
    pixels = transient.height * transient.width
    require_memory(12 * pixels * bins, f"a dense transient of {pixels} pixels and {bins} bins")
    data = np.zeros(pixels * bins)
    pixel = transient.return_pixel
    near_bin, far_bin = (
        np.floor(np.clip((path_m - start_m) / width_m, -1, bins)).astype(np.int32)
        for path_m in (transient.path_near_m.astype(np.float64), transient.path_far_m.astype(np.float64))
    )
    ends = np.cumsum(far_bin - near_bin + 1, dtype=np.int64)
    at = 0
    while at < transient.returns:
        part = slice(at, max(at + 1, np.searchsorted(ends, ends[at] + ENTRIES)))
        at = part.stop
        near, far = (
            (path_m[part].astype(np.float64) - start_m) / width_m
            for path_m in (transient.path_near_m, transient.path_far_m)
        )
        first = near_bin[part].astype(np.int64)
        count = far_bin[part] - first + 1
        which = np.repeat(np.arange(len(near)), count)
        column = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + first[which]
        length = far[which] - near[which]
        overlap = np.minimum(far[which], column + 1) - np.maximum(near[which], column)
        fraction = np.divide(overlap, length, out=np.ones_like(overlap), where=length > 0)
        kept = (column >= 0) & (column < bins)
        energy = fraction * transient.radiance[part].astype(np.float64)[which]
        begin, end = pixel[part.start] * bins, (pixel[at - 1] + 1) * bins  # returns are in the order of their pixels
        place = (pixel[part][which] * bins + column)[kept] - begin
        data[begin:end] += np.bincount(place, energy[kept], minlength=end - begin)
    return data.reshape(transient.height, transient.width, bins).astype(np.float32)
