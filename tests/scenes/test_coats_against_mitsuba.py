"""Materials of Mitsuba files reflect as much as Mitsuba's own, where they become another kind or another albedo."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from render.backend.llvm import start_mitsuba
from scenes.model import Material, Texture
from tests.scenes.xml_files import image, load, material

mi = start_mitsuba()
import drjit as dr  # noqa: E402


def reflectance(bsdf: object, degrees: float) -> float:
    """Return pi times the part of light from an angle that goes back there."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(math.sin(math.radians(degrees)), 0, math.cos(math.radians(degrees)))
    return float(bsdf.eval(mi.BSDFContext(), si, si.wi)[0][0]) / math.cos(math.radians(degrees)) * math.pi


def as_rendered(made: Material) -> object:
    described: dict[str, object] = {"type": made.kind}
    if made.kind == "diffuse":
        return mi.load_dict(described | {"reflectance": {"type": "rgb", "value": made.albedo}})
    described |= {"int_ior": made.ior, "ext_ior": 1.0, "diffuse_reflectance": {"type": "rgb", "value": made.albedo}}
    if made.kind == "roughplastic":
        described |= {"alpha": made.roughness, "distribution": made.distribution}
    return mi.load_dict(described)


def both(folder: Path, kind: str, values: str) -> tuple[Material, object, object]:
    xml = f'type="{kind}">{values}</bsdf>'
    made = material(folder, f"<bsdf {xml}")
    return made, as_rendered(made), mi.load_string(f'<bsdf version="3.0.0" {xml}')


@pytest.mark.parametrize("albedo", [0.2, 0.5, 0.9])
@pytest.mark.parametrize(("kind", "alpha", "within"), [("plastic", 0, 1e-3), ("roughplastic", 0.05, 0.02)])
def test_internal_scattering_darkens_a_nonlinear_plastic(
    tmp_path: Path, kind: str, alpha: float, within: float, albedo: float
) -> None:
    values = f'<boolean name="nonlinear" value="true"/><rgb name="diffuse_reflectance" value="{albedo}"/>'
    values += f'<float name="alpha" value="{alpha}"/>' if alpha else ""
    made, ours, theirs = both(tmp_path, kind, values)
    assert made.albedo < albedo
    assert reflectance(ours, 40) == pytest.approx(reflectance(theirs, 40), rel=within)


def test_internal_scattering_darkens_every_texel(tmp_path: Path) -> None:
    image(tmp_path, "t.png", np.array([[0, 128], [200, 255]]))
    texture = '<texture type="bitmap" name="diffuse_reflectance"><string name="filename" value="t.png"/></texture>'
    xml = f'<bsdf type="plastic"><boolean name="nonlinear" value="{{}}"/>{texture}</bsdf>'
    plain, darker = (material(tmp_path, xml.format(value)).albedo for value in ("false", "true"))
    assert isinstance(darker, Texture) and darker.image.max() == pytest.approx(1)
    np.testing.assert_allclose(darker.image, plain.image * 0.4093 / (1 - 0.5907 * plain.image), rtol=2e-3)


@pytest.mark.parametrize("albedo", [0.2, 0.5])
@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_principled_is_as_bright_as_mitsubas(tmp_path: Path, roughness: float, albedo: float) -> None:
    values = f'<rgb name="base_color" value="{albedo}"/><float name="roughness" value="{roughness}"/>'
    _, ours, theirs = both(tmp_path, "principled", values)
    for degrees in (0, 15, 30, 45):
        assert reflectance(ours, degrees) == pytest.approx(reflectance(theirs, degrees), rel=0.05), degrees


def test_a_base_that_its_coat_would_take_over_1_is_clipped_with_a_note(tmp_path: Path) -> None:
    values = '<rgb name="base_color" value="0.98"/><float name="roughness" value="0.3"/>'
    scene = load(tmp_path, f'<shape type="rectangle"><bsdf type="principled">{values}</bsdf></shape>')
    assert scene.surfaces[0].material.albedo == 1
    assert sum("base_color below its coat is clipped to 1" in note for note in scene.notes) == 1


@pytest.mark.parametrize(("metallic", "kind", "noted"), [(0.4, "roughplastic", 1), (0.6, "roughconductor", 1)])
def test_a_surface_that_is_partly_metal_is_named(tmp_path: Path, metallic: float, kind: str, noted: int) -> None:
    values = f'<float name="metallic" value="{metallic}"/>'
    scene = load(tmp_path, f'<shape type="rectangle"><bsdf type="principled" id="part">{values}</bsdf></shape>')
    assert scene.surfaces[0].material.kind == kind
    expected = f"metallic {metallic} is taken as {round(metallic)}: a surface is all metal, or none: part"
    assert sum(note == expected for note in scene.notes) == noted


def test_two_widths_of_a_highlight_keep_its_peak(tmp_path: Path) -> None:
    widths = '<float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.4"/>'
    assert material(tmp_path, f'<bsdf type="roughplastic">{widths}</bsdf>').roughness == pytest.approx(0.2)
