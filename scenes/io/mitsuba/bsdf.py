"""Mitsuba's bsdf and texture plugins as materials and textures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scenes.errors import InputError
from scenes.io.mitsuba.nodes import Document
from scenes.io.mitsuba.plugin import Plugin
from scenes.io.mitsuba.textures import Textures, Uv, clipped
from scenes.model import DISTRIBUTIONS, Material, Texture
from scenes.optics.refractive_indices import CONDUCTORS, INDICES
from scenes.optics.rough_coats import uncoated, with_inner_scattering

MAX_NESTING = 16
MIN_ALPHA = 1e-3
MIN_CONTRAST = 1e-3  # of indices: below, a surface reflects less than 3e-7 of light

Values = dict[str, Any]  # keyword arguments of a Material


@dataclass(frozen=True, eq=False)
class Look:
    """A material and how its textures want the mesh's texture coordinates moved (3x3, v downwards as in Mitsuba).

    `inside_out`: the denser medium is outside, as of a bubble in water, so that the faces must be turned round.
    `one_sided`: in Mitsuba its back is black.
    """

    material: Material
    to_uv: np.ndarray | None = None
    inside_out: bool = False
    one_sided: bool = True


class Materials(Textures):
    """Builds every bsdf once: shapes that refer to the same element share one Material object."""

    def __init__(self, document: Document, *, reads_images: bool = True) -> None:
        super().__init__(document, reads_images=reads_images)
        self._looks: dict[Plugin, Look] = {}
        # a lamp without a bsdf is black in Mitsuba
        blank = {albedo: Material("diffuse", albedo=albedo, name="default") for albedo in (0.5, 0.0)}
        self._defaults = {albedo: Look(made, one_sided=albedo > 0) for albedo, made in blank.items()}

    def of_shape(self, shape: Plugin) -> Look:
        """Return the look of a shape; without a bsdf it is diffuse grey as in Mitsuba, and black where it is a lamp."""
        bsdfs = shape.nested("bsdf")
        if len(bsdfs) > 1:
            raise shape.fail(f"has {len(bsdfs)} bsdfs, expected one")
        return self.look(bsdfs[0]) if bsdfs else self._defaults[0.0 if shape.nested("emitter") else 0.5]

    def look(self, plugin: Plugin) -> Look:
        if plugin not in self._looks:
            self._looks[plugin] = self._build(plugin)
        return self._looks[plugin]

    def _build(self, plugin: Plugin) -> Look:
        uv = Uv()
        inner, opacity, twosided = self._unwrap(plugin, uv)
        if inner.type not in _KINDS:
            raise inner.fail(_no_counterpart(inner.type))
        values = _KINDS[inner.type](self, inner, uv)
        inner.note_unused()
        values.setdefault("kind", inner.type)
        inside_out = values.pop("inside_out", False)
        name = plugin.id or inner.id or inner.type
        try:
            material = Material(**values, opacity=1.0 if opacity is None else opacity, name=name)
        except InputError as error:
            raise inner.fail(str(error)) from None
        return Look(material, uv.matrix, inside_out, not (twosided or material.is_glass or material.albedo == 0))

    def is_one_sided(self, material: Material) -> bool:
        """Return whether a material that was built here is black from behind in Mitsuba."""
        looks = (*self._looks.values(), *self._defaults.values())
        return any(look.material is material and look.one_sided for look in looks)

    def _unwrap(self, plugin: Plugin, uv: Uv) -> tuple[Plugin, float | Texture | None, bool]:
        """Find the innermost bsdf, the opacity of a mask around it, and whether both of its sides reflect."""
        opacity, twosided = None, False
        for _ in range(MAX_NESTING):
            if plugin.type in ("bumpmap", "normalmap"):
                plugin.note(f"{plugin.type} is left out, the surface keeps its own normals")
            elif plugin.type == "mask":
                if opacity is not None:
                    raise plugin.fail("a mask inside a mask, expected one")
                opacity = self.fraction(plugin, "opacity", 0.5, uv)
                if not isinstance(opacity, Texture) and 0 < opacity < 1:
                    taken = "1: no light passes" if opacity >= 0.5 else "0: all light passes"
                    plugin.note(f"opacity {opacity:g} is taken as {taken}")
                plugin.note_unused()
            elif plugin.type != "twosided":
                return plugin, opacity, twosided
            twosided = twosided or plugin.type == "twosided"
            inside = plugin.nested("bsdf")
            if not inside or (len(inside) > 1 and plugin.type != "twosided"):
                raise plugin.fail(f"holds {len(inside)} bsdfs, expected one")
            if len(inside) > 1:
                plugin.note("the back side takes the material of the front side")
            plugin = inside[0]
        raise plugin.fail(f"bsdfs are nested more than {MAX_NESTING} deep")


def _no_counterpart(kind: str) -> str:
    """Say that a bsdf is not supported, with the way round."""
    if kind in _WAYS_ROUND:
        return f"bsdf {kind!r} is not supported, {_WAYS_ROUND[kind]}"
    return f"bsdf {kind!r} is not supported, expected one of {', '.join(_KINDS)} or a wrapper"


def _index(plugin: Plugin, name: str, default: str) -> float:
    """Read a refractive index by number or by name."""
    element = plugin.value(name)
    if element is not None and element.tag != "string":
        return plugin.number(name)
    material = plugin.string(name, default)
    if material not in INDICES:
        raise plugin.fail(f"{name} {material!r} is unknown, expected a number or one of {', '.join(INDICES)}")
    return INDICES[material]


def _relative_index(plugin: Plugin, inside: str) -> float:
    """int_ior / ext_ior, positive and not 1."""
    int_ior, ext_ior = _index(plugin, "int_ior", inside), _index(plugin, "ext_ior", "air")
    if int_ior <= 0 or ext_ior <= 0:
        raise plugin.fail(f"int_ior {int_ior:g} and ext_ior {ext_ior:g}, expected both above 0")
    if abs(int_ior / ext_ior - 1) < MIN_CONTRAST:
        raise plugin.fail(f"int_ior {int_ior:g} and ext_ior {ext_ior:g} are alike, light is not bent; remove the shape")
    return int_ior / ext_ior


def _microfacets(materials: Materials, plugin: Plugin, default: float) -> Values:
    """Alpha and distribution of the normals; one number stands for two directions and for a texture."""
    plugin.ignore(("sample_visible",))
    distribution = plugin.string("distribution", "beckmann")
    if distribution == "phong":
        plugin.note("phong microfacets are taken as beckmann with the same alpha")
        distribution = "beckmann"
    elif distribution not in DISTRIBUTIONS:
        raise plugin.fail(f"distribution {distribution!r}, expected one of {', '.join(DISTRIBUTIONS)}")
    if plugin.has("alpha_u") or plugin.has("alpha_v"):
        plugin.note("alpha_u and alpha_v are replaced by their geometric mean, which keeps the highlight's peak")
        across, along = plugin.number("alpha_u", default), plugin.number("alpha_v", default)
        if min(across, along) < 0:
            raise plugin.fail(f"alpha_u {across:g} and alpha_v {along:g}, expected neither below 0")
        alpha = math.sqrt(across * along)
    else:
        alpha = materials.mean(plugin, "alpha", default)
    return {"roughness": alpha, "distribution": distribution}


def _rough(values: Values, smooth: str, rough: Values) -> Values:
    """`values` with what makes them rough; alpha 0 is the smooth kind."""
    return values | ({"kind": smooth} if rough["roughness"] == 0 else rough)


def _diffuse(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    given = plugin.has("reflectance") or plugin.nested_as("reflectance") is not None
    name = "diffuse_reflectance" if plugin.document.legacy and not given else "reflectance"  # version 0.6 knows both
    return {"albedo": materials.fraction(plugin, name, 0.5, uv)}


def _rough_diffuse(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    plugin.ignore(("use_fast_approx",))
    return _rough(_diffuse(materials, plugin, uv), "diffuse", {"roughness": materials.mean(plugin, "alpha", 0.2)})


def _plastic(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    index = _relative_index(plugin, "polypropylene")
    if index < 1:
        raise plugin.fail(f"int_ior / ext_ior is {index:g}, and a coat is denser than what is around it; write diffuse")
    return {
        "albedo": materials.fraction(plugin, "diffuse_reflectance", 0.5, uv),
        "specular": clipped(plugin, "specular_reflectance", materials.mean(plugin, "specular_reflectance", 1.0)),
        "ior": index,
    }


def _smooth_plastic(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    return _nonlinear(plugin, _plastic(materials, plugin, uv))


def _rough_plastic(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    rough = _microfacets(materials, plugin, 0.1)
    return _nonlinear(plugin, _rough(_plastic(materials, plugin, uv), "plastic", rough))


def _nonlinear(plugin: Plugin, values: Values) -> Values:
    """Return a plastic's values with the albedo that internal scattering leaves, where the plugin asks for it."""
    if not plugin.boolean("nonlinear", False):
        return values
    coat = values["ior"], values.get("roughness", 0.0), values.get("distribution", "beckmann")
    return values | {"albedo": _changed(values["albedo"], lambda albedo: with_inner_scattering(albedo, *coat))}


def _changed(albedo: float | Texture, change: Callable[[np.ndarray], np.ndarray]) -> float | Texture:
    """Return an albedo, or a texture's every one, after a change, from 0 to 1."""
    if isinstance(albedo, Texture):
        return replace(albedo, image=np.clip(change(albedo.image), 0, 1))
    return float(np.clip(change(np.array(albedo)), 0, 1))


def _conductor(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    eta, k = _complex_index(materials, plugin)
    specular = clipped(plugin, "specular_reflectance", materials.mean(plugin, "specular_reflectance", 1.0))
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


def _rough_conductor(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    return _rough(_conductor(materials, plugin, uv), "conductor", _microfacets(materials, plugin, 0.1))


def _phong(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    """Return Phong's lobe as rough plastic of the same width.

    alpha = sqrt(2 / (exponent + 2)) (Walter et al. 2007, 5.2).
    """
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
        "roughness": min(max(math.sqrt(2 / (exponent + 2)), MIN_ALPHA), 1.0),
        "distribution": "beckmann",
    }


def _principled(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    """Return the principled bsdf (Burley 2012) as rough plastic, or as diffuse where that is nearer; as a rough
    conductor where it is mostly metal.

    alpha = roughness^2; a metal reflects its base colour at every angle; the index of a coat without one is that of
    normal reflectance 0.08 specular.
    """
    transmitted = materials.mean(plugin, "spec_trans", 0.0)
    if transmitted > 0:
        raise plugin.fail(f"spec_trans {transmitted:g}: light does not pass principled surfaces here; write dielectric")
    metallic = materials.mean(plugin, "metallic", 0.0)
    plugin.ignore(("anisotropic", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat", "clearcoat_gloss"))
    plugin.ignore(("diffuse_reflectance_sampling_rate", "specular_sampling_rate", "clearcoat_sampling_rate"))
    alpha = max(materials.mean(plugin, "roughness", 0.5) ** 2, MIN_ALPHA)
    values: Values = {"roughness": alpha, "distribution": "ggx"}
    left_out = "tints, sheen and clear coat are left out"
    if 0 < metallic < 1:
        plugin.note(f"metallic {metallic:g} is taken as {int(metallic > 0.5)}: a surface is all metal, or none")
    if metallic > 0.5:
        plugin.note(f"principled is taken as a rough conductor of its base colour: {left_out}")
        eta, k = CONDUCTORS["none"]
        colour = min(materials.mean(plugin, "base_color", 0.5), 1.0)
        return values | {"kind": "roughconductor", "eta": eta, "k": k, "specular": colour}
    root = math.sqrt(0.08 * max(materials.mean(plugin, "specular", 0.5), MIN_ALPHA))
    index = plugin.number("eta") if plugin.has("eta") else (1 + root) / (1 - root)
    base = materials.fraction(plugin, "base_color", 0.5, uv)
    return _principled_base(plugin, base, values | {"kind": "roughplastic", "ior": index}, left_out)


def _principled_base(plugin: Plugin, base: float | Texture, coat: Values, left_out: str) -> Values:
    """Return rough plastic as bright as the principled bsdf, whose coat takes no light from its base; or diffuse."""
    mean = float(base.image.mean(dtype=np.float64)) if isinstance(base, Texture) else base
    if coat["ior"] <= 1 or mean == 0:
        plugin.note(f"principled is taken as rough plastic: {left_out}")
        return coat | {"albedo": base}
    coated, albedo = uncoated(mean, coat["ior"], coat["roughness"])
    if not coated:
        plugin.note(f"principled is taken as diffuse, as rough plastic would be too dark: {left_out}")
        return {"kind": "diffuse", "albedo": _changed(base, lambda own: own + (albedo - mean))}
    plugin.note(f"principled is taken as rough plastic: {left_out}")
    brightest = float(base.image.max()) if isinstance(base, Texture) else base
    if brightest * albedo / mean > 1:
        plugin.note("base_color below its coat is clipped to 1, the surface is a little too dark")
    return coat | {"albedo": _changed(base, lambda own: own * (albedo / mean))}


def _dielectric(materials: Materials, plugin: Plugin, uv: Uv) -> Values:
    for name in ("specular_reflectance", "specular_transmittance"):
        if materials.mean(plugin, name, 1.0) != 1:
            plugin.note(f"{name} is left out, glass keeps the Fresnel shares")
    index = _relative_index(plugin, "bk7")
    if index > 1:
        return {"ior": index}
    # an interface reflects alike from both sides; which of them is denser is told by the way its faces point
    plugin.note("the denser medium is outside: the faces of the shape are turned round")
    return {"ior": 1 / index, "inside_out": plugin.type == "dielectric"}


_KINDS: dict[str, Callable[[Materials, Plugin, Uv], Values]] = {
    "diffuse": _diffuse,
    "roughdiffuse": _rough_diffuse,
    "plastic": _smooth_plastic,
    "roughplastic": _rough_plastic,
    "conductor": _conductor,
    "roughconductor": _rough_conductor,
    "dielectric": _dielectric,
    "thindielectric": _dielectric,
    "phong": _phong,
    "principled": _principled,
}
_WAYS_ROUND = {
    "roughdielectric": "no light is bent or scattered by glass here; write dielectric, or diffuse for frosted glass",
    "blendbsdf": "write the stronger of its two bsdfs alone",
    "hk": "light inside bodies is not followed; write diffuse",
    "difftrans": "light does not pass matte surfaces here; write diffuse",
    "ward": "write roughconductor or roughplastic with alpha for its two widths",
    "coating": "write plastic with the coat's index and the colour below it",
    "roughcoating": "write roughplastic with the coat's index and the colour below it",
    "mixturebsdf": "write the stronger of its bsdfs alone",
    "principledthin": "light does not pass matte sheets here; write diffuse, or thindielectric for clear ones",
    "measured": "write the roughconductor or roughplastic that is nearest",
    "null": "remove the bsdf around it",
}
