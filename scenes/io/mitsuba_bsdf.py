"""Mitsuba's bsdf and texture plugins as materials and textures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.errors import InputError
from scenes.io.mitsuba_nodes import Document
from scenes.io.mitsuba_plugin import Plugin
from scenes.io.textures import load_texture
from scenes.model import DISTRIBUTIONS, Material, Texture

MAX_NESTING = 16
CHECKERBOARD_PIXELS = 256

# Refractive indices at the sodium line, the names that the file format knows and that exported scenes use.
INDICES = {
    "vacuum": 1.0,
    "air": 1.000277,
    "water": 1.3330,
    "polypropylene": 1.49,
    "bk7": 1.5046,
    "diamond": 2.419,
}

# n and k at 650 nm, interpolated linearly in the tables of: Johnson and Christy, Phys. Rev. B 6, 4370 (1972) for gold,
# silver and copper; Johnson and Christy, Phys. Rev. B 9, 5056 (1974) for chromium; Rakic, Appl. Opt. 34, 4755 (1995)
# for aluminium. "none" is the format's name of a perfect mirror.
CONDUCTORS = {
    "none": (0.0, 1.0),
    "Au": (0.156, 3.602),
    "Ag": (0.052, 4.409),
    "Cu": (0.238, 3.626),
    "Cr": (3.107, 3.331),
    "Al": (1.558, 7.712),
}


@dataclass(frozen=True, eq=False)
class Look:
    """A material and how its textures want the mesh's texture coordinates moved (3x3, v downwards as in Mitsuba)."""

    material: Material
    to_uv: np.ndarray | None = None


class _Uv:
    """The one texture transform that all textures of a material must share, since a mesh has one set of uv."""

    def __init__(self) -> None:
        self.matrix: np.ndarray | None = None

    def agree(self, plugin: Plugin, matrix: np.ndarray) -> None:
        if self.matrix is not None and not np.allclose(self.matrix, matrix):
            raise plugin.fail("two textures of one material have different to_uv, expected the same")
        self.matrix = matrix


class Materials:
    """Builds every bsdf once: shapes that refer to the same element share one Material object."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._looks: dict[Plugin, Look] = {}
        self._images: dict[tuple[Path, bool, str], Texture] = {}
        self._default = Look(Material("diffuse", albedo=0.5, name="default"))

    def of_shape(self, shape: Plugin) -> Look:
        """Return the look of a shape; without a bsdf it is diffuse grey as in Mitsuba."""
        bsdfs = shape.nested("bsdf")
        if len(bsdfs) > 1:
            raise shape.fail(f"has {len(bsdfs)} bsdfs, expected one")
        return self.look(bsdfs[0]) if bsdfs else self._default

    def check(self, shape: Plugin) -> None:
        """Refuse a shape whose bsdf has no counterpart here, in one line, before any file is read."""
        for plugin in shape.nested("bsdf"):
            for _ in range(MAX_NESTING):
                inside = plugin.nested("bsdf")
                if plugin.type not in _WRAPPERS or not inside:
                    break
                plugin = inside[0]
            if plugin.type not in (*_KINDS, *_WRAPPERS):
                raise plugin.fail(_no_counterpart(plugin.type))

    def look(self, plugin: Plugin) -> Look:
        if plugin not in self._looks:
            self._looks[plugin] = self._build(plugin)
        return self._looks[plugin]

    def _build(self, plugin: Plugin) -> Look:
        uv = _Uv()
        inner, opacity = self._unwrap(plugin, uv)
        if inner.type not in _KINDS:
            raise inner.fail(_no_counterpart(inner.type))
        values = _KINDS[inner.type](self, inner, uv)
        inner.note_unused()
        values.setdefault("kind", inner.type)
        name = plugin.id or inner.id or inner.type
        try:
            material = Material(**values, opacity=1.0 if opacity is None else opacity, name=name)
        except InputError as error:
            raise inner.fail(str(error)) from None
        return Look(material, uv.matrix)

    def _unwrap(self, plugin: Plugin, uv: _Uv) -> tuple[Plugin, float | Texture | None]:
        """The innermost bsdf and the opacity of a mask around it."""
        opacity = None
        for _ in range(MAX_NESTING):
            if plugin.type in ("bumpmap", "normalmap"):
                plugin.note(f"{plugin.type} is left out, the surface keeps its own normals")
            elif plugin.type == "mask":
                if opacity is not None:
                    raise plugin.fail("a mask inside a mask, expected one")
                opacity = self.fraction(plugin, "opacity", 0.5, uv, channel="alpha")
                plugin.note_unused()
            elif plugin.type != "twosided":
                return plugin, opacity
            inside = plugin.nested("bsdf")
            if not inside or (len(inside) > 1 and plugin.type != "twosided"):
                raise plugin.fail(f"holds {len(inside)} bsdfs, expected one")
            if len(inside) > 1:
                plugin.note("the back side takes the material of the front side")
            plugin = inside[0]
        raise plugin.fail(f"bsdfs are nested more than {MAX_NESTING} deep")

    def fraction(
        self, plugin: Plugin, name: str, default: float, uv: _Uv, *, channel: str = "luminance"
    ) -> float | Texture:
        """Return a reflectance or opacity: a number or a texture, clipped at 1 with a note."""
        nested = plugin.nested_as(name)
        if nested is None:
            return _clipped(plugin, name, plugin.colour(name, default))
        texture, matrix = self.texture(nested, channel)
        uv.agree(plugin, matrix)
        if texture.image.max() > 1:
            plugin.note(f"{name} over 1 is clipped to 1")
            texture = Texture(np.minimum(texture.image, 1), texture.name)
        return texture

    def mean(self, plugin: Plugin, name: str, default: float) -> float:
        """Return a number, or the mean of a texture where the model has no room for one."""
        nested = plugin.nested_as(name)
        if nested is None:
            return plugin.colour(name, default)
        plugin.note(f"{name} has a texture, its mean is used")
        return float(self.texture(nested)[0].image.mean(dtype=np.float64))

    def texture(self, plugin: Plugin, channel: str = "luminance") -> tuple[Texture, np.ndarray]:
        """Return a texture and its uv transform (3x3, Mitsuba's v)."""
        if plugin.tag != "texture":
            raise plugin.fail("expected a texture here")
        if plugin.type == "bitmap":
            texture = self._bitmap(plugin, channel)
        elif plugin.type == "checkerboard":
            texture = _checkerboard(plugin)
        else:
            raise plugin.fail(f"texture {plugin.type!r} is not supported, expected bitmap or checkerboard")
        matrix = _to_uv(plugin)
        plugin.note_unused()
        return texture, matrix

    def _bitmap(self, plugin: Plugin, channel: str) -> Texture:
        plugin.ignore(("filter_type", "max_anisotropy", "cache", "format"))
        wrap = plugin.string("wrap_mode", "repeat")
        if wrap != "repeat":
            plugin.note(f"wrap_mode {wrap} is taken as repeat")
        chosen = plugin.string("channel", "all")
        if chosen == "a":
            channel = "alpha"
        elif chosen != "all":
            plugin.note(f"channel {chosen} of the image is taken as its luminance")
        # An opacity is a share, never light: its numbers are linear whatever the file says.
        linear = plugin.boolean("raw", False) or plugin.number("gamma", 0.0) == 1 or channel == "alpha"
        path = self._document.file(plugin.element, plugin.string("filename"), "texture")
        return self.image(path, linear, channel)

    def image(self, path: Path, linear: bool, channel: str) -> Texture:
        """Return a texture file, read once."""
        key = (path.resolve(), linear, channel)
        if key not in self._images:
            self._images[key] = load_texture(path, linear=linear, channel=channel)
        return self._images[key]


def _no_counterpart(kind: str) -> str:
    """Say that a bsdf is not supported, with the way round."""
    if kind in _WAYS_ROUND:
        return f"bsdf {kind!r} is not supported, {_WAYS_ROUND[kind]}"
    return f"bsdf {kind!r} is not supported, expected one of {', '.join(_KINDS)} or a wrapper"


def _clipped(plugin: Plugin, name: str, value: float) -> float:
    if value > 1 + 1e-9:
        plugin.note(f"{name} over 1 is clipped to 1")
    return min(value, 1.0)


def _checkerboard(plugin: Plugin) -> Texture:
    """Two by two squares over the unit square, color0 at the origin."""
    dark, light = plugin.colour("color0", 0.4), plugin.colour("color1", 0.2)
    half = np.ones((CHECKERBOARD_PIXELS // 2, CHECKERBOARD_PIXELS // 2))
    try:
        return Texture(np.kron([(dark, light), (light, dark)], half), "checkerboard")
    except InputError as error:
        raise plugin.fail(str(error)) from None


def _to_uv(plugin: Plugin) -> np.ndarray:
    """to_uv, or version 0.6's scales and offsets, as a 3x3 matrix."""
    if plugin.has("to_uv"):
        full = plugin.transform("to_uv")
        matrix = np.eye(3)
        matrix[:2, :2] = full[:2, :2]
        # A 3x3 matrix keeps its shift in the third column, a 4x4 one in the fourth.
        matrix[:2, 2] = full[:2, 3] + full[:2, 2]
        return matrix
    both = plugin.number("uvscale", 1.0)
    scale = plugin.number("uscale", both), plugin.number("vscale", both)
    offset = plugin.number("uoffset", 0.0), plugin.number("voffset", 0.0)
    return np.array([(scale[0], 0, offset[0]), (0, scale[1], offset[1]), (0, 0, 1)])


def _index(plugin: Plugin, name: str, default: str) -> float:
    """A refractive index by number or by name."""
    element = plugin.value(name)
    if element is not None and element.tag != "string":
        return plugin.number(name)
    material = plugin.string(name, default)
    if material not in INDICES:
        raise plugin.fail(f"{name} {material!r} is unknown, expected a number or one of {', '.join(INDICES)}")
    return INDICES[material]


def _relative_index(plugin: Plugin, inside: str) -> float:
    """int_ior / ext_ior; light must be slower inside."""
    int_ior, ext_ior = _index(plugin, "int_ior", inside), _index(plugin, "ext_ior", "air")
    if ext_ior <= 0 or int_ior / ext_ior <= 1:
        raise plugin.fail(f"int_ior {int_ior:g} / ext_ior {ext_ior:g} is not above 1; turn the shape inside out")
    return int_ior / ext_ior


def _microfacets(materials: Materials, plugin: Plugin, default: float) -> dict[str, Any]:
    """Alpha and distribution of the normals; one number stands for two directions and for a texture."""
    plugin.ignore(("sample_visible",))
    distribution = plugin.string("distribution", "beckmann")
    if distribution == "phong":
        plugin.note("phong microfacets are taken as beckmann with the same alpha")
        distribution = "beckmann"
    elif distribution not in DISTRIBUTIONS:
        raise plugin.fail(f"distribution {distribution!r}, expected one of {', '.join(DISTRIBUTIONS)}")
    if plugin.has("alpha_u") or plugin.has("alpha_v"):
        plugin.note("alpha_u and alpha_v are replaced by their mean")
        alpha = (plugin.number("alpha_u", default) + plugin.number("alpha_v", default)) / 2
    else:
        alpha = materials.mean(plugin, "alpha", default)
    return {"roughness": alpha, "distribution": distribution}


def _rough(values: dict[str, Any], smooth: str, rough: dict[str, Any]) -> dict[str, Any]:
    """`values` with what makes them rough; alpha 0 is the smooth kind."""
    return values | ({"kind": smooth} if rough["roughness"] == 0 else rough)


def _diffuse(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    return {"albedo": materials.fraction(plugin, "reflectance", 0.5, uv)}


def _rough_diffuse(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    plugin.ignore(("use_fast_approx",))
    return _rough(_diffuse(materials, plugin, uv), "diffuse", {"roughness": materials.mean(plugin, "alpha", 0.2)})


def _plastic(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    if plugin.boolean("nonlinear", False):
        plugin.note("the colour shift of internal scattering (nonlinear) is left out")
    return {
        "albedo": materials.fraction(plugin, "diffuse_reflectance", 0.5, uv),
        "specular": _clipped(plugin, "specular_reflectance", materials.mean(plugin, "specular_reflectance", 1.0)),
        "ior": _relative_index(plugin, "polypropylene"),
    }


def _rough_plastic(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    return _rough(_plastic(materials, plugin, uv), "plastic", _microfacets(materials, plugin, 0.1))


def _conductor(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    eta, k = _complex_index(materials, plugin)
    specular = _clipped(plugin, "specular_reflectance", materials.mean(plugin, "specular_reflectance", 1.0))
    return {"eta": eta, "k": k, "specular": specular}


def _complex_index(materials: Materials, plugin: Plugin) -> tuple[float, float]:
    """n and k of a conductor, relative to the outside."""
    outside = _index(plugin, "ext_eta", "vacuum" if not plugin.document.legacy else "air")
    if outside <= 0:
        raise plugin.fail(f"ext_eta {outside:g} is not positive")
    given = [plugin.has(name) or plugin.nested_as(name) is not None for name in ("eta", "k")]
    if all(given):
        plugin.ignore(("material",))
        return materials.mean(plugin, "eta", 0.0) / outside, materials.mean(plugin, "k", 0.0) / outside
    if any(given):
        raise plugin.fail("needs both eta and k")
    material = plugin.string("material", "Cu" if plugin.document.legacy else "none")
    if material not in CONDUCTORS:
        raise plugin.fail(f"material {material!r} is unknown, expected eta and k or one of {', '.join(CONDUCTORS)}")
    if material == "none":
        return CONDUCTORS[material]
    return CONDUCTORS[material][0] / outside, CONDUCTORS[material][1] / outside


def _rough_conductor(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    return _rough(_conductor(materials, plugin, uv), "conductor", _microfacets(materials, plugin, 0.1))


def _phong(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    """Phong's lobe as rough plastic of the same width: alpha = sqrt(2 / (exponent + 2)) (Walter et al. 2007, 5.2)."""
    exponent = materials.mean(plugin, "exponent", 30.0)
    if exponent < 0:
        raise plugin.fail(f"exponent {exponent:g} is negative")
    fraction = materials.mean(plugin, "specular_reflectance", 0.2)
    fresnel = ((INDICES["polypropylene"] - 1) / (INDICES["polypropylene"] + 1)) ** 2
    plugin.note("phong is taken as rough plastic of the same width, whose highlight grows towards grazing angles")
    return {
        "kind": "roughplastic",
        "albedo": materials.fraction(plugin, "diffuse_reflectance", 0.5, uv),
        "specular": min(fraction / fresnel, 1.0),
        "ior": INDICES["polypropylene"],
        "roughness": min(max(math.sqrt(2 / (exponent + 2)), 1e-3), 1.0),
        "distribution": "beckmann",
    }


def _dielectric(materials: Materials, plugin: Plugin, uv: _Uv) -> dict[str, Any]:
    for name in ("specular_reflectance", "specular_transmittance"):
        if materials.mean(plugin, name, 1.0) != 1:
            plugin.note(f"{name} is left out, glass keeps the Fresnel shares")
    return {"ior": _relative_index(plugin, "bk7")}


_KINDS: dict[str, Callable[[Materials, Plugin, _Uv], dict[str, Any]]] = {
    "diffuse": _diffuse,
    "roughdiffuse": _rough_diffuse,
    "plastic": _plastic,
    "roughplastic": _rough_plastic,
    "conductor": _conductor,
    "roughconductor": _rough_conductor,
    "dielectric": _dielectric,
    "thindielectric": _dielectric,
    "phong": _phong,
}
_WRAPPERS = ("twosided", "mask", "bumpmap", "normalmap")
_WAYS_ROUND = {
    "roughdielectric": "no light is bent or scattered by glass here; write dielectric, or diffuse for frosted glass",
    "blendbsdf": "write the stronger of its two bsdfs alone",
    "principled": "write roughplastic or roughconductor with the same base colour and roughness",
    "hk": "light inside bodies is not followed; write diffuse",
    "difftrans": "light does not pass matte surfaces here; write diffuse",
    "ward": "write roughconductor or roughplastic with alpha for its two widths",
    "null": "remove the shape, which nothing would see",
}
