"""Reads a Mitsuba scene file (versions 0.6 to 3) as a Scene, without Mitsuba."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from scenes.errors import InputError
from scenes.io.mitsuba.bsdf import Materials
from scenes.io.mitsuba.clipping import is_cut
from scenes.io.mitsuba.nodes import Document, LocatedError
from scenes.io.mitsuba.plugin import VALUE_TAGS, Plugin, snake_case
from scenes.io.mitsuba.shapes import Shapes, shows_open_back
from scenes.model import Ambient, Camera, Scene, Surface, Texture

# How far a matrix may be from a rotation and still be one that was written with few digits.
ORTHONORMAL_TOLERANCE = 1e-3
CLIPS_M = {"near_clip": 1e-2, "far_clip": 1e4}  # and where they are by default
# Named in the notes and left out: no triangle carries them, and the scene's own lights are ambient light only.
_LEFT_OUT_EMITTERS = (
    *("point", "spot", "directional", "directionalarea", "projector", "collimated"),
    *("sky", "sun", "sunsky", "timed_sunsky"),
)
_NO_MEDIA = "is not supported, light in fog or inside bodies is not followed; remove it"
_DEFINITIONS = ("bsdf", "texture", "integrator", "sampler", "film", "rfilter", *VALUE_TAGS)
# Of a 36 x 24 mm frame, which `focal_length` refers to.
_FRAME_DIAGONAL_MM = math.hypot(36, 24)


def load_mitsuba_xml(path: Path, *, width: int | None = None, height: int | None = None) -> Scene:
    """Read a scene file; lengths are metres, `width` and `height` [pixels] replace the film's.

    What had to be changed, assumed or left out is in `Scene.notes`. Raises InputError with one line that begins with
    the file when something is missing, broken or has no counterpart here.
    """
    path = Path(path)
    try:
        return _scene(Document(path), width, height)
    except InputError as error:
        message = str(error) if isinstance(error, LocatedError) else f"{path}: {error}"
        raise InputError(re.sub(r"\s*[\r\n]+\s*", " ", message)) from None


def _scene(document: Document, width: int | None, height: int | None) -> Scene:
    materials = Materials(document)
    shapes = Shapes(document, materials)
    found: dict[str, list[Plugin]] = {"shape": [], "sensor": [], "emitter": []}
    for element in document.elements:
        if element.tag in found:
            found[element.tag].append(Plugin.of(document, element))
        elif element.tag in ("medium", "volume", "phase", "subsurface"):
            raise document.error(element, _NO_MEDIA)
        elif element.tag not in _DEFINITIONS:
            raise document.error(element, "unknown element in a scene")
        elif element.tag == "integrator":
            _note_hidden(document, element)
    if not found["shape"]:
        raise InputError("holds no shapes")
    # what has no counterpart is told before meshes and images are read, which may take minutes
    for plugin in found["shape"]:
        shapes.check(plugin)
    _light_around(document, found["emitter"])
    camera = _camera(document, found["sensor"]).resized(width, height)
    ambient = _ambient(document, materials, found["emitter"])
    surfaces: list[Surface] = [surface for plugin in found["shape"] for surface in shapes.surfaces(plugin)]
    if not surfaces:
        raise InputError("holds no shapes that can be seen")
    for surface in surfaces:
        if materials.is_one_sided(surface.material) and shows_open_back(surface, camera):
            document.notes.add("reflects from both sides, in Mitsuba the back without twosided is black", surface.name)
    _note_cut(document, found["sensor"][0], camera, surfaces)
    stem = document.path.stem
    name = document.path.resolve().parent.name if stem == "scene" else stem
    return Scene(name or stem, tuple(surfaces), camera, ambient=ambient, notes=document.notes.lines())


def _note_hidden(document: Document, integrator: Element) -> None:
    """Say that lamps are seen here which an integrator, or one inside it, hides from the camera."""
    for flag in integrator.iter("boolean"):
        hides = snake_case(flag.get("name", "")) == "hide_emitters"
        if hides and flag.get("value", "").strip().lower() == "true":
            document.notes.add("hide_emitters is left out, the camera sees lamps and the light around the scene")


def _camera(document: Document, sensors: list[Plugin]) -> Camera:
    """Read the first sensor as a pinhole camera."""
    if not sensors:
        raise InputError('holds no sensor, expected a <sensor type="perspective">')
    sensor = sensors[0]
    if len(sensors) > 1:
        sensor.note(f"{len(sensors)} sensors, the first is used")
    if sensor.type == "thinlens":
        sensor.note("thinlens is taken as a pinhole: no depth of field")
    elif sensor.type != "perspective":
        raise sensor.fail(f"sensor {sensor.type!r} is not supported, write perspective (or thinlens)")
    sensor.refuse("medium", "volume", "phase")
    width, height = _film_size(sensor)
    fov = _horizontal_fov(sensor, width, height)
    pose = _rigid(sensor, "camera")[0]
    # Mitsuba's camera looks along z with x to the LEFT and y up; half a turn about z gives right and down.
    pose[:3, :2] *= -1
    if any(sensor.number(f"principal_point_offset_{axis}", 0.0) for axis in "xy"):
        sensor.note("principal_point_offset is left out, the axis stays in the image centre")
    lens = ("aperture_radius", "focus_distance")
    sensor.ignore((*CLIPS_M, "shutter_open", "shutter_close", *lens))
    sensor.note_unused()
    try:
        return Camera(pose, fov, width, height)
    except InputError as error:
        raise sensor.fail(str(error)) from None


def _note_cut(document: Document, sensor: Plugin, camera: Camera, surfaces: list[Surface]) -> None:
    """Name what Mitsuba's camera cuts off: what is nearer than one plane, and beyond another."""
    near_m, far_m = (sensor.number(name, default) for name, default in CLIPS_M.items())
    for surface in surfaces:
        if is_cut(surface, camera, near_m, far_m):
            text = (
                f"is seen nearer than near_clip {near_m:g} or beyond far_clip {far_m:g}, in Mitsuba it is cut off there"
            )
            document.notes.add(text, surface.name)


def _film_size(sensor: Plugin) -> tuple[int, int]:
    """Width and height in pixels; Mitsuba's defaults where there is no film."""
    films = sensor.nested("film")
    if not films:
        return 768, 576
    film = films[0]
    if film.has("crop_width") or film.has("crop_height"):
        sensor.note("the film's crop window is left out")
    return film.integer("width", 768), film.integer("height", 576)


def _horizontal_fov(sensor: Plugin, width: int, height: int) -> float:
    """Return the full horizontal angle in degrees, whichever way the file gives it."""
    if width < 1 or height < 1:
        raise sensor.fail(f"film of {width} x {height} pixels, expected at least 1 x 1")
    if sensor.has("fov"):
        if sensor.has("focal_length"):
            raise sensor.fail("has both fov and focal_length, expected one")
        fov, axis = sensor.number("fov"), sensor.string("fov_axis", "x")
    else:
        fov, axis = _fov_of_focal_length(sensor), "diagonal"
        sensor.ignore(("fov_axis",))
    if not 0 < fov < 180:
        raise sensor.fail(f"fov {fov:g} degrees is outside 0 to 180")
    across = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    across |= {"smaller": min(width, height), "larger": max(width, height)}
    if axis not in across:
        raise sensor.fail(f"fov_axis {axis!r}, expected one of {', '.join(across)}")
    half = math.atan(math.tan(math.radians(fov) / 2) * width / across[axis])
    return fov if axis == "x" else math.degrees(2 * half)


def _fov_of_focal_length(sensor: Plugin) -> float:
    """Full diagonal angle in degrees of a lens on a 36 x 24 mm frame."""
    element = sensor.value("focal_length")
    text = "50mm" if element is None else element.get("value", "")
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm)?\s*", text)
    if match is None or float(match[1]) == 0:
        raise sensor.fail(f"focal_length is {text!r}, expected millimetres such as 50mm")
    return math.degrees(2 * math.atan(_FRAME_DIAGONAL_MM / (2 * float(match[1]))))


def _rigid(plugin: Plugin, what: str) -> tuple[np.ndarray, bool]:
    """to_world as a rotation and translation, and whether it mirrored: then its first axis is turned round."""
    pose = plugin.transform("to_world")
    left, scales, right = np.linalg.svd(pose[:3, :3])
    if scales[0] / scales[2] - 1 > ORTHONORMAL_TOLERANCE:
        plugin.note(f"the {what}'s to_world stretches or shears, only its rotation is kept")
    # The nearest orthonormal matrix; an equal scale of all axes does not change a view.
    pose[:3, :3] = left @ right
    mirrored = bool(np.linalg.det(pose[:3, :3]) < 0)
    if mirrored:
        pose[:3, 0] *= -1
    return pose, mirrored and _mirror_note(plugin, what)


def _mirror_note(plugin: Plugin, what: str) -> bool:
    kept = "the view is kept right-handed, not mirrored" if what == "camera" else "its image is mirrored instead"
    plugin.note(f"the {what}'s to_world mirrors, {kept}")
    return True


def _light_around(document: Document, emitters: list[Plugin]) -> Plugin | None:
    """Read the one constant or mapped light around the scene; lights that are points are left out with a note."""
    around = []
    for emitter in emitters:
        if emitter.type in ("constant", "envmap"):
            around.append(emitter)
        elif emitter.type in _LEFT_OUT_EMITTERS:
            document.notes.add("emitters left out, ambient light comes from surfaces and surroundings", emitter.name)
        elif emitter.type == "area":
            raise emitter.fail("an area emitter belongs inside its <shape>")
        else:
            raise emitter.fail(f"emitter {emitter.type!r} is not supported, write area, constant or envmap")
    if len(around) > 1:
        raise around[1].fail(f"a second light around the scene, beside {around[0].label}; expected one")
    if around and around[0].type == "envmap":
        filename = around[0].string("filename")
        suffix = Path(filename).suffix.lower()
        if suffix in (".hdr", ".rgbe", ".pfm"):
            raise around[0].fail(f"{filename}: {suffix} images are not read, convert it to .exr")
        document.file(around[0].element, filename, "environment map")
    return around[0] if around else None


def _ambient(document: Document, materials: Materials, emitters: list[Plugin]) -> Ambient:
    """Read the light around the scene."""
    emitter = _light_around(document, emitters)
    if emitter is None:
        return Ambient()
    emitter.ignore(("sampling_weight", "mis_compensation", "to_world", "cache", "gamma"))
    ambient = _constant(materials, emitter) if emitter.type == "constant" else _envmap(document, materials, emitter)
    emitter.note_unused()
    return ambient


def _constant(materials: Materials, emitter: Plugin) -> Ambient:
    try:
        return Ambient(radiance=materials.mean(emitter, "radiance", 1.0))
    except LocatedError:
        raise
    except InputError as error:
        raise emitter.fail(str(error)) from None


def _envmap(document: Document, materials: Materials, emitter: Plugin) -> Ambient:
    path = document.file(emitter.element, emitter.string("filename"), "environment map")
    image = materials.image(path, emitter.boolean("raw", False), "luminance").image
    pose, mirrored = _rigid(emitter, "environment map")
    pose[:3, 3] = 0
    size = math.cbrt(abs(np.linalg.det(emitter.transform("to_world")[:3, :3])))
    if abs(size - 1) > ORTHONORMAL_TOLERANCE:
        # there a direction's angle to +y is acos(y / size)
        emitter.note("the scale of the environment map's to_world is left out, in Mitsuba it distorts the map")
    if mirrored:
        # Turning the map's x axis round and its columns round is the same map.
        image = image[:, ::-1]
    try:
        scaled = image * np.float32(emitter.number("scale", 1.0))
        return Ambient(environment=Texture(scaled, path.name), pose=pose)
    except InputError as error:
        raise emitter.fail(str(error)) from None
