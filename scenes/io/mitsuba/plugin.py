"""One element of a Mitsuba scene file as a plugin with typed values. Knows no plugin by name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from xml.etree.ElementTree import Element

import numpy as np

from scenes.errors import InputError
from scenes.geometry.shapes import axis_frame
from scenes.io.inputs import read_text
from scenes.io.mitsuba.nodes import Document
from scenes.io.textures import luminance, srgb_to_linear
from scenes.optics.blackbody import seen_mean, seen_radiance_w_per_m2_sr_nm

COLOUR_TAGS = ("float", "integer", "rgb", "srgb", "spectrum")
# Of a matrix: what is beyond leaves the range of numbers when matrices are multiplied, inverted or decomposed.
MAX_ENTRY = 1e15
AXIS_TOLERANCE = 1e-3  # of the length of an axis of rotation
MAX_SPECTRUM_BYTES = 1 << 20
VALUE_TAGS = (*COLOUR_TAGS, "boolean", "string", "vector", "point", "blackbody", "transform")
PLUGIN_TAGS = (
    *("bsdf", "shape", "emitter", "texture", "sensor", "film", "sampler", "rfilter", "integrator"),
    *("medium", "volume", "phase", "subsurface"),
)


class Plugin:
    """An XML element that stands for a plugin: its values by snake_case name, and its nested plugins.

    Every reader takes a default; without one the value must be there.
    """

    @classmethod
    def of(cls, document: Document, element: Element) -> Plugin:
        """Return the one Plugin object of an element, so that references share it."""
        return document.shared(element, lambda: cls(element, document))

    def __init__(self, element: Element, document: Document) -> None:
        self.element = element
        self.document = document
        self.tag = element.tag
        self.type = document.need(element, "type")
        self.id = element.get("id", "")
        self._owner = ""
        self._values: dict[str, Element] = {}
        self._nested: list[tuple[str, Element]] = []
        self._given: set[str] = set()  # names of values and textures
        self._used: set[str] = set()
        for child in element:
            self._add(child)

    def _add(self, child: Element) -> None:
        target = child
        if child.tag == "default":
            return  # its value has been filled in
        if child.tag == "ref":
            target = self.document.target(child, self.document.need(child, "id"))
        name = snake_case(child.get("name", ""))
        if name and target.tag in ("texture", *VALUE_TAGS):
            if name in self._given:
                raise self.fail(f"{name} is given twice")
            self._given.add(name)
        if target.tag in PLUGIN_TAGS:
            self._nested.append((name, target))
        elif target.tag in VALUE_TAGS:
            if not name:
                raise self.document.error(child, f'lacks name="..." inside {self.label}')
            self._values[name] = target
        else:
            raise self.fail(f"unknown element <{target.tag}>")

    @property
    def label(self) -> str:
        return f'<{self.tag} type="{self.type}"' + (f' id="{self.id}">' if self.id else ">")

    @property
    def name(self) -> str:
        """Return the plugin's name in notes: its id, or that of the plugin it is nested in."""
        return self.id or self._owner or self.type

    def fail(self, message: str) -> InputError:
        return self.document.error(self.element, message)

    def note(self, text: str) -> None:
        self.document.notes.add(text, self.name)

    def nested(self, *tags: str) -> list[Plugin]:
        """Return nested plugins of these tags, references followed."""
        return [self._inner(element) for _, element in self._nested if element.tag in tags]

    def nested_as(self, name: str) -> Plugin | None:
        """Return the nested plugin given as the parameter `name`."""
        self._used.add(name)
        found = [element for key, element in self._nested if key == name]
        return self._inner(found[0]) if found else None

    def _inner(self, element: Element) -> Plugin:
        plugin = Plugin.of(self.document, element)
        plugin._owner = plugin._owner or self.name
        return plugin

    def refuse(self, *tags: str) -> None:
        """Raise one line about the first nested plugin that this project has no model for."""
        for plugin in self.nested(*tags):
            raise self.fail(f'<{plugin.tag} type="{plugin.type}"> is not supported, remove it')

    def has(self, name: str) -> bool:
        return name in self._values

    def value(self, name: str) -> Element | None:
        self._used.add(name)
        return self._values.get(name)

    def ignore(self, names: Iterable[str]) -> None:
        """Mark values as known and without a meaning here."""
        self._used.update(names)

    def note_left_out(self, *tags: str, why: str) -> None:
        """Say which nested plugins of these tags have no effect here, and why."""
        for inner in self.nested(*tags):
            self.note(f"<{inner.tag}> in a {self.type} is left out, {why}")

    def note_unused(self) -> None:
        """Say which values nobody asked for: a mistyped name must not go unnoticed."""
        for name in (*self._values, *(name for name, element in self._nested if element.tag == "texture")):
            if name not in self._used:
                self.note(f"parameter {name} is not used" if name else "a texture without a name is not used")

    def _text(self, name: str, tags: tuple[str, ...], default: object) -> str | None:
        element = self.value(name)
        if element is None:
            if default is None:
                raise self.fail(f'lacks <{tags[0]} name="{name}" .../>')
            return None
        if element.tag not in tags:
            raise self.fail(f"{name} is a <{element.tag}>, expected <{tags[0]}>")
        return self.document.need(element, "value").strip()

    def number(self, name: str, default: float | None = None) -> float:
        text = self._text(name, ("float", "integer"), default)
        return float(default or 0) if text is None else self.numbers(text, name, 1)[0]

    def integer(self, name: str, default: int | None = None) -> int:
        value = self.number(name, default)
        if value != int(value):
            raise self.fail(f"{name} {value:g} is not a whole number")
        return int(value)

    def string(self, name: str, default: str | None = None) -> str:
        text = self._text(name, ("string",), default)
        return str(default) if text is None else text

    def boolean(self, name: str, default: bool) -> bool:
        text = self._text(name, ("boolean",), default)
        if text is None:
            return default
        if text.lower() not in ("true", "false"):
            raise self.fail(f"{name} is {text!r}, expected true or false")
        return text.lower() == "true"

    def point(self, name: str, default: tuple[float, float, float]) -> np.ndarray:
        element = self.value(name)
        return np.array(default, dtype=float) if element is None else self._xyz(element, 0.0)

    def colour(self, name: str, default: float | None = None) -> float:
        """Return the luminance of a number or colour, linear."""
        element = self.value(name)
        if element is None:
            if default is None:
                raise self.fail(f'lacks <rgb name="{name}" .../>')
            return default
        return self._luminance(name, element)

    def _luminance(self, name: str, element: Element) -> float:
        if element.tag == "blackbody" or element.get("type") == "blackbody":
            return self._blackbody(name, element)
        if element.tag not in COLOUR_TAGS:
            raise self.fail(f"{name} is a <{element.tag}>, expected <rgb>, <spectrum> or <float>")
        if element.get("type"):
            raise self.fail(f"{name} is a <spectrum> from a plugin, write plain values or <rgb>")
        if element.get("filename"):
            return self._mean_of_file(name, element)
        text = self.document.need(element, "value").strip()
        if element.tag == "spectrum" and ":" in text:
            return seen_mean(
                [self.numbers(pair.replace(":", " "), name, 2) for pair in re.split(r"[\s,]+", text) if pair]
            )
        if element.tag in ("rgb", "srgb"):
            encoded = element.tag == "srgb" or text.startswith("#")
            values = np.array(self._hex(name, text) if text.startswith("#") else self.numbers(text, name, 1, 3))
            return float(luminance(np.broadcast_to(srgb_to_linear(values) if encoded else values, 3)))
        return self.numbers(text, name, 1)[0]

    def _mean_of_file(self, name: str, element: Element) -> float:
        """Return the mean of a .spd file, as seen: a wavelength and a value a line, # begins a comment."""
        path = self.document.file(element, self.document.need(element, "filename"), "spectrum")
        text = read_text(path, "spectrum", most_bytes=MAX_SPECTRUM_BYTES)
        lines = (line.partition("#")[0].strip() for line in text.splitlines())
        pairs = [self.numbers(line, f"{name} in {path.name}", 2) for line in lines if line]
        if not pairs:
            raise self.fail(f"{path.name}: holds no wavelengths")
        self.note(f"{name} is the mean of its spectrum file")
        return seen_mean(pairs)

    def _blackbody(self, name: str, element: Element) -> float:
        """Radiance [W/(m^2 sr nm)] of <blackbody temperature="5000K"/> (version 0.6), or of version 3's spectrum."""
        inside = {child.get("name"): child.get("value", "") for child in element}
        text = element.get("temperature") or inside.get("temperature") or ""
        temperature = self.numbers(re.sub(r"\s*[kK]\s*$", "", text), f"temperature of {name}", 1)[0]
        if not 100 <= temperature <= 1e5:
            raise self.fail(f"temperature of {name} is {temperature:g} K, expected 100 to 100,000")
        scale = element.get("scale") or inside.get("scale") or "1"
        self.note("a black body's radiance is its mean over the eye's response, in W/(m2 sr nm)")
        return self.numbers(scale, f"scale of {name}", 1)[0] * seen_radiance_w_per_m2_sr_nm(temperature)

    def _hex(self, name: str, text: str) -> list[float]:
        if not re.fullmatch(r"#[0-9a-fA-F]{6}", text):
            raise self.fail(f"{name} is {text!r}, expected #rrggbb")
        return [int(text[i : i + 2], 16) / 255 for i in (1, 3, 5)]

    def numbers(self, text: str, what: str, *counts: int) -> list[float]:
        """Return finite numbers separated by blanks or commas, as many as one of `counts`."""
        parts = [part for part in re.split(r"[\s,]+", text) if part]
        try:
            values = [float(part) for part in parts]
        except ValueError:
            raise self.fail(f"{what} is {text!r}, expected {_or(counts)} numbers") from None
        if len(values) not in counts:
            raise self.fail(f"{what} has {len(values)} values, expected {_or(counts)}")
        if not all(map(math.isfinite, values)):
            raise self.fail(f"{what} is {text!r}, expected finite numbers")
        return values

    def _xyz(self, element: Element, missing: float, attribute: str = "value") -> np.ndarray:
        """Three numbers from one attribute, or from x, y and z, those left out being `missing`."""
        if element.get(attribute) is not None:
            values = self.numbers(element.get(attribute, ""), f"<{element.tag}>", 1, 3)
            return np.broadcast_to(np.array(values), 3)
        return np.array(
            [self.numbers(element.get(axis, str(missing)), f"{axis} of <{element.tag}>", 1)[0] for axis in "xyz"]
        )

    def transform(self, name: str) -> np.ndarray:
        """Return a 4x4 affine matrix; the steps of a <transform> apply from the first to the last."""
        element = self.value(name)
        matrix = np.eye(4)
        if element is None:
            return matrix
        if element.tag != "transform":
            raise self.fail(f"{name} is a <{element.tag}>, expected <transform>")
        for step in element:
            with np.errstate(over="ignore", invalid="ignore"):
                matrix = self._step(name, step) @ matrix
            largest = float(np.abs(matrix).max())
            if not largest <= MAX_ENTRY:
                raise self.fail(f"{name}: <{step.tag}> makes an entry of {largest:g}, beyond {MAX_ENTRY:g}")
        if not np.isfinite(matrix).all() or not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-9):
            raise self.fail(f"{name}: the last row of the matrix is {matrix[3].tolist()}, expected 0 0 0 1")
        if abs(np.linalg.det(matrix[:3, :3])) < 1e-30:
            raise self.fail(f"{name} squashes space flat (its determinant is 0), expected an invertible transform")
        return matrix

    def texture_transform(self) -> np.ndarray:
        """Return a texture's to_uv, or version 0.6's scales and offsets, as a 3x3 matrix."""
        if self.has("to_uv"):
            full = self.transform("to_uv")
            matrix = np.eye(3)
            matrix[:2, :2] = full[:2, :2]
            matrix[:2, 2] = full[:2, 3]
            self._note_third_column()
            return matrix
        both = self.number("uvscale", 1.0)
        scale = self.number("uscale", both), self.number("vscale", both)
        offset = self.number("uoffset", 0.0), self.number("voffset", 0.0)
        return np.array([(scale[0], 0, offset[0]), (0, scale[1], offset[1]), (0, 0, 1)])

    def _note_third_column(self) -> None:
        """Say where the third column of a 3x3 matrix in to_uv, its shift by the looks of it, moves no texture."""
        transform = self.value("to_uv")
        for step in [] if transform is None else transform:
            values = step.get("value", "").replace(",", " ").split() if step.tag == "matrix" else []
            if len(values) == 9 and (float(values[2]) or float(values[5])):
                words = "the third column of a 3x3 <matrix> is no shift, as in Mitsuba 3; write <translate>"
                self.note(f"to_uv: {words}")

    def _step(self, name: str, step: Element) -> np.ndarray:
        matrix = np.eye(4)
        kind = step.tag.lower().replace("_", "")
        if kind == "translate":
            matrix[:3, 3] = self._xyz(step, 0.0)
        elif kind == "scale":
            matrix[:3, :3] = np.diag(self._xyz(step, 1.0))
        elif kind == "rotate":
            angle = self.numbers(self.document.need(step, "angle"), "angle", 1)[0]
            matrix[:3, :3] = self._rotation(self._xyz(step, 0.0), math.radians(angle))
        elif kind == "matrix":
            values = self.numbers(self.document.need(step, "value"), f"<matrix> of {name}", 16, 9)
            size = 4 if len(values) == 16 else 3
            matrix[:size, :size] = np.reshape(values, (size, size))
        elif kind == "lookat":
            matrix = self._look_at(step)
        else:
            raise self.fail(f"{name}: unknown step <{step.tag}>, expected translate, rotate, scale, matrix or lookat")
        return matrix

    def _rotation(self, axis: np.ndarray, angle: float) -> np.ndarray:
        """Rotation about an axis by an angle in radians (Rodrigues)."""
        length = math.hypot(*axis)  # of large numbers, too, whose squares are beyond all
        if length == 0:
            raise self.fail("<rotate> has no axis, expected x, y or z")
        if abs(length - 1) > AXIS_TOLERANCE and not self.document.legacy:
            self.note("the axis of a <rotate> is taken at unit length, which Mitsuba 3 does not do")
        x, y, z = axis / length
        cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
        return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

    def _look_at(self, step: Element) -> np.ndarray:
        """Mitsuba's camera frame: columns left, up, forward, origin."""
        origin, target = (np.array(self.numbers(self.document.need(step, key), key, 3)) for key in ("origin", "target"))
        forward = target - origin
        if not forward.any():
            raise self.fail(f"<{step.tag}>: origin and target are the same point")
        forward = forward / math.hypot(*forward)
        up = np.array(self.numbers(step.get("up", "0 0 0"), "up", 3))
        up = up / math.hypot(*up) if up.any() else axis_frame(forward)[:, 0]
        left = np.cross(up, forward)
        if np.linalg.norm(left) < 1e-9:
            raise self.fail(f"<{step.tag}>: up is along the viewing direction")
        left = left / np.linalg.norm(left)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack((left, np.cross(forward, left), forward, origin))
        return matrix


def snake_case(name: str) -> str:
    """Return Mitsuba 0.6's camelCase names as Mitsuba 3's: toWorld, intIOR -> to_world, int_ior."""
    return re.sub(r"(?<=[a-z0-9])([A-Z]+)", r"_\1", name).lower()


def _or(counts: Iterable[int]) -> str:
    return " or ".join(map(str, counts))
