"""scenes.io.mitsuba.bsdf: the materials of a Mitsuba scene file, against Mitsuba itself and against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from xml_files import GREY, LUMINANCE, first_hit, image, load, material, meshes, refusal, texel, write

from scenes.io.mitsuba.scene_file import load_mitsuba_xml
from scenes.io.textures import luminance, srgb_to_linear

AIR = 1.000277


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (GREY, LUMINANCE),
        ('<rgb name="reflectance" value="0.2, 0.4, 0.6"/>', LUMINANCE),
        ('<rgb name="reflectance" value="0.3"/>', 0.3),
        ('<rgb name="reflectance" value="#808080"/>', float(srgb_to_linear(128 / 255))),
        ('<srgb name="reflectance" value="0.5 0.5 0.5"/>', float(srgb_to_linear(0.5))),
        ('<spectrum name="reflectance" value="0.25"/>', 0.25),
        ('<spectrum name="reflectance" value="400:0.3, 500:0.3 600:0.3"/>', 0.3),
        ('<float name="reflectance" value="0.7"/>', 0.7),
        ("", 0.5),
    ],
)
def test_colours_become_one_number(tmp_path: Path, value: str, expected: float) -> None:
    assert material(tmp_path, f'<bsdf type="diffuse">{value}</bsdf>').albedo == pytest.approx(expected)


@pytest.mark.parametrize(
    ("bsdf", "expected"),
    [
        (f'<bsdf type="twosided"><bsdf type="diffuse">{GREY}</bsdf></bsdf>', {"kind": "diffuse", "albedo": LUMINANCE}),
        (
            f'<bsdf type="roughdiffuse">{GREY}<float name="alpha" value="0.3"/></bsdf>',
            {"kind": "roughdiffuse", "roughness": 0.3, "albedo": LUMINANCE},
        ),
        ('<bsdf type="plastic"/>', {"kind": "plastic", "albedo": 0.5, "ior": 1.49 / AIR, "specular": 1}),
        (
            '<bsdf type="roughplastic"><float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>'
            '<float name="alpha" value="0.2"/><rgb name="diffuseReflectance" value="0.1"/></bsdf>',
            {"kind": "roughplastic", "ior": 1.5, "roughness": 0.2, "albedo": 0.1},
        ),
        ('<bsdf type="conductor"/>', {"kind": "conductor", "eta": 0, "k": 1}),
        (
            '<bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0"/></bsdf>',
            {"kind": "conductor", "eta": 0.156, "k": 3.602},
        ),
        (
            '<bsdf type="roughconductor"><rgb name="eta" value="2"/><rgb name="k" value="4"/><float name="extEta" '
            'value="2"/><float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.3"/></bsdf>',
            {"kind": "roughconductor", "eta": 1, "k": 2, "roughness": 0.03**0.5},
        ),
        ('<bsdf type="dielectric"/>', {"kind": "dielectric", "ior": 1.5046 / AIR}),
        (
            '<bsdf type="thindielectric"><string name="int_ior" value="diamond"/><string name="ext_ior" value="water"/>'
            "</bsdf>",
            {"kind": "thindielectric", "ior": 2.419 / 1.333},
        ),
        (
            '<bsdf type="mask"><float name="opacity" value="1"/><bsdf type="dielectric"/></bsdf>',
            {"kind": "dielectric", "opacity": 1},
        ),
    ],
)
def test_bsdfs(tmp_path: Path, bsdf: str, expected: dict) -> None:
    made = material(tmp_path, bsdf)
    assert {key: getattr(made, key) for key in expected} == pytest.approx(expected)


def test_conductor_defaults_differ_by_version(tmp_path: Path) -> None:
    """0.6 takes copper where nothing is said, 3 a perfect mirror; 0.6 also knows air outside."""
    copper = material(tmp_path, '<bsdf type="conductor"/>', version="0.6.0")
    assert (copper.eta, copper.k) == pytest.approx((0.238 / AIR, 3.626 / AIR))


@pytest.mark.parametrize(
    ("metal", "reflectance"), [("Au", 0.95), ("Ag", 0.98), ("Cu", 0.93), ("Al", 0.905), ("Cr", 0.55)]
)
def test_metals_reflect_as_metals_do(tmp_path: Path, metal: str, reflectance: float) -> None:
    made = material(tmp_path, f'<bsdf type="conductor"><string name="material" value="{metal}"/></bsdf>')
    fresnel = ((made.eta - 1) ** 2 + made.k**2) / ((made.eta + 1) ** 2 + made.k**2)
    assert fresnel == pytest.approx(reflectance, abs=0.025)


@pytest.mark.parametrize("kind", ["roughplastic", "roughconductor"])
def test_microfacets_are_what_the_file_says(tmp_path: Path, kind: str) -> None:
    """Beckmann, where nothing is said too: that is the format's default."""
    for message, expected in (("", "beckmann"), ("beckmann", "beckmann"), ("ggx", "ggx")):
        line = f'<string name="distribution" value="{message}"/>' if message else ""
        found = material(tmp_path, f'<bsdf type="{kind}">{line}<float name="alpha" value="0.3"/></bsdf>')
        assert (found.kind, found.roughness, found.distribution) == (kind, 0.3, expected)


def test_one_material_object_for_all_its_shapes(tmp_path: Path) -> None:
    body = f'<bsdf type="diffuse" id="m">{GREY}</bsdf><alias id="m" as="n"/><rgb id="white" name="x" value="0.9"/>'
    body += '<shape type="sphere"><ref id="m"/></shape><shape type="cube"><ref name="bsdf" id="n"/></shape>'
    body += "<shape type='cube'/><shape type='disk'/>"
    body += '<shape type="cube"><bsdf type="diffuse"><ref name="reflectance" id="white"/></bsdf></shape>'
    found = [surface.material for surface in load(tmp_path, body).surfaces]
    assert found[0] is found[1] and found[2] is found[3] and found[0].name == "m"
    assert found[4].albedo == pytest.approx(0.9)


def test_textures_are_shared_scaled_and_masked(tmp_path: Path) -> None:
    rgba = np.zeros((2, 2, 4))
    rgba[..., :3], rgba[0, 0, 3], rgba[1, 1, 3] = 128, 255, 51
    image(tmp_path, "leaf.png", rgba)
    file = (
        '<string name="filename" value="leaf.png"/><float name="uscale" value="3"/><float name="voffset" value="0.5"/>'
    )
    leaf = f'<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{file}</texture></bsdf>'
    alpha = f'{file}<string name="channel" value="a"/>'
    mask = f'<bsdf type="mask"><texture type="bitmap" name="opacity">{alpha}</texture>{leaf}</bsdf>'
    scene = load(tmp_path, f'<shape type="rectangle">{mask}</shape><shape type="rectangle">{leaf}</shape>')
    one, two = scene.surfaces
    np.testing.assert_allclose(one.material.opacity.image, [[1, 0], [0, 0.2]], atol=1e-6)
    np.testing.assert_allclose(one.material.albedo.image, srgb_to_linear(128 / 255), rtol=1e-6)
    assert one.material.albedo is two.material.albedo and scene.notes == ()
    # The rectangle's own v runs downwards in Mitsuba's images: v -> 1 - (v + 0.5).
    np.testing.assert_allclose(one.uv, [(0, 0.5), (3, 0.5), (3, -0.5), (0, -0.5)])


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("pixel", [[128, 128, 128], [255, 128, 0, 51]])
def test_an_opacity_image_is_its_luminance_as_in_mitsuba(tmp_path: Path, pixel: list[int], raw: bool) -> None:
    """Mitsuba linearises it unless it is raw, and leaves its alpha out (`mi.load_dict` of such a mask says 0.367)."""
    image(tmp_path, "t.png", np.broadcast_to(pixel, (2, 2, len(pixel))))
    values = f'<string name="filename" value="t.png"/><boolean name="raw" value="{str(raw).lower()}"/>'
    texture = f'<texture type="bitmap" name="opacity">{values}</texture>'
    opacity = material(tmp_path, f'<bsdf type="mask">{texture}<bsdf type="diffuse"/></bsdf>').opacity
    levels = np.array(pixel[:3]) / 255
    expected = luminance(levels if raw else srgb_to_linear(levels))
    np.testing.assert_allclose(opacity.image, expected, rtol=1e-6)
    assert len(pixel) == 3 or expected == pytest.approx(0.57165 if raw else 0.36705, abs=2e-4)


@pytest.mark.parametrize(("opacity", "taken"), [("0.3", "0"), ("0.7", "1"), ("0", None), ("1", None)])
def test_an_opacity_that_is_rounded_is_noted(tmp_path: Path, opacity: str, taken: str | None) -> None:
    bsdf = f'<bsdf type="mask"><float name="opacity" value="{opacity}"/><bsdf type="diffuse"/></bsdf>'
    notes = load(tmp_path, f'<shape type="rectangle">{bsdf}</shape>').notes
    assert [f"opacity {opacity} is taken as {taken}" in note for note in notes] == ([] if taken is None else [True])


@pytest.mark.parametrize("opacity", [0, 1])
def test_holes_of_a_lamp_are_noted_as_mitsuba_lets_them_shine(tmp_path: Path, opacity: int) -> None:
    bsdf = f'<bsdf type="mask"><float name="opacity" value="{opacity}"/><bsdf type="diffuse"/></bsdf>'
    notes = load(tmp_path, f'<shape type="rectangle">{bsdf}<emitter type="area"/></shape>').notes
    assert any("holes of the lamp" in note for note in notes) == (opacity == 0)


@pytest.mark.parametrize(
    ("steps", "noted"),
    [
        ('<rotate z="1" angle="30"/><scale x="2" y="3"/><translate x="0.2"/>', False),
        ('<rotate x="1" angle="40"/><translate x="0.2" y="0.1"/>', False),
        ('<rotate y="1" angle="50"/><scale value="1.5"/>', False),
        ('<matrix value="2 0.5 0.3 0.1 0 3 0.6 0.2 0 0 1 0 0 0 0 1"/>', False),
        ('<matrix value="2 0.45 0.3 0 3 0.6 0 0 1"/>', True),
        ('<translate z="0.5"/><matrix value="2, 0.5, 0.3 0, 3, 0.7 0, 0, 1"/><translate x="0.1"/>', True),
        ('<matrix value="2 0.45 0 0 3 0 0 0 1"/>', False),
    ],
)
def test_to_uv_and_checkerboard_are_mitsubas(tmp_path: Path, mitsuba: object, steps: str, noted: bool) -> None:
    texture = (
        '<texture type="checkerboard" name="reflectance"><rgb name="color0" value="0.1"/>'
        f'<rgb name="color1" value="0.8"/><transform name="to_uv">{steps}</transform></texture>'
    )
    path = write(tmp_path, f'<shape type="rectangle"><bsdf type="diffuse">{texture}</bsdf></shape>')
    scene = load_mitsuba_xml(path)
    surface = scene.surfaces[0]
    assert [("third column of a 3x3 <matrix> is no shift" in note) for note in scene.notes] == ([True] if noted else [])
    rays = [((x, y, 3), (0, 0, -1)) for x in np.linspace(-0.9, 0.95, 6) for y in np.linspace(-0.95, 0.9, 6)]
    for ray, hit in zip(rays, mitsuba(path, rays=rays)["hits"], strict=True):
        assert texel(surface.material.albedo, first_hit(surface, *ray)[3]) == pytest.approx(hit[2][0])


def test_the_nearest_texel_is_mitsubas(tmp_path: Path, mitsuba: object) -> None:
    """A small image without interpolation keeps its edges; a large one is interpolated, and a note says so."""
    levels = np.random.default_rng(0).integers(20, 250, (5, 3))
    image(tmp_path, "t.png", levels)
    file = '<string name="filename" value="{}"/><string name="filter_type" value="nearest"/>'
    bsdf = '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{}</texture></bsdf>'
    path = write(tmp_path, f'<shape type="rectangle">{bsdf.format(file.format("t.png"))}</shape>')
    scene = load_mitsuba_xml(path)
    (surface,) = scene.surfaces
    assert scene.notes == () and len(np.unique(surface.material.albedo.image)) == len(np.unique(levels))
    rays = [((x, y, 3), (0, 0, -1)) for x in np.linspace(-0.9, 0.93, 9) for y in np.linspace(-0.93, 0.9, 9)]
    for ray, hit in zip(rays, mitsuba(path, rays=rays)["hits"], strict=True):
        assert texel(surface.material.albedo, first_hit(surface, *ray)[3]) == pytest.approx(hit[2][0], rel=1e-4)
    image(tmp_path, "large.png", np.full((2, 800), 99))
    notes = load(tmp_path, f'<shape type="rectangle">{bsdf.format(file.format("large.png"))}</shape>').notes
    assert len(notes) == 1 and "nearest is taken as bilinear" in notes[0]


def test_a_texture_that_clamps_does_so(tmp_path: Path) -> None:
    """One file, that repeats on one shape and clamps on the other."""
    image(tmp_path, "t.png", [[0, 255]])
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.png"/>{}</texture>'
    shape = f'<shape type="rectangle"><bsdf type="diffuse">{texture}</bsdf></shape>'
    clamp = '<string name="wrap_mode" value="clamp"/>'
    scene = load(tmp_path, shape.format(clamp) + shape.format(""))
    assert [surface.material.albedo.clamps for surface in scene.surfaces] == [True, False] and scene.notes == ()


def test_what_is_changed_or_left_out_is_noted(tmp_path: Path) -> None:
    image(tmp_path, "t.png", np.full((2, 2), 255))
    texture = '<texture type="bitmap" name="{}"><string name="filename" value="t.png"/>{}</texture>'
    mirror = '<string name="wrap_mode" value="mirror"/>'
    bsdfs = [
        '<bsdf type="diffuse" id="white"><rgb name="reflectance" value="1.5"/></bsdf>',
        f'<bsdf type="bumpmap" id="bumpy">{texture.format("", mirror)}<bsdf type="diffuse"/></bsdf>',
        '<bsdf type="roughplastic" id="old"><string name="distribution" value="phong"/>'
        '<boolean name="nonlinear" value="true"/></bsdf>',
        f'<bsdf type="plastic" id="mean">{texture.format("specular_reflectance", mirror)}</bsdf>',
        '<bsdf type="twosided" id="two"><bsdf type="diffuse"/><bsdf type="plastic"/></bsdf>',
        '<bsdf type="diffuse" id="typo"><rgb name="reflectence" value="0.1"/></bsdf>',
        '<bsdf type="dielectric" id="tint"><rgb name="specular_transmittance" value="0.5"/></bsdf>',
    ]
    body = '<path value="x"/>' + "".join(f'<shape type="rectangle">{bsdf}</shape>' for bsdf in bsdfs)
    scene = load(tmp_path, body)
    assert scene.surfaces[0].material.albedo == 1
    expected = [
        "over 1 is clipped to 1: white",
        "bumpmap is left out",
        "phong microfacets are taken as beckmann with the same alpha: old",
    ]
    expected += ["its mean is used: mean", "taken as repeat: mean", "back side", "reflectence is not used: typo"]
    expected += ["specular_transmittance is left out", "<path>"]
    for words in expected:
        assert sum(words in note for note in scene.notes) == 1, words
    assert len(scene.notes) == len(expected) and all("\n" not in note for note in scene.notes)


@pytest.mark.parametrize(
    ("bsdf", "words"),
    [
        ('<bsdf type="principled"><float name="spec_trans" value="1"/></bsdf>', "spec_trans 1"),
        ('<bsdf type="blendbsdf"/>', "'blendbsdf'"),
        ('<bsdf type="mask"><bsdf type="dielectric"/></bsdf>', "glass has opacity 1 here"),
        ('<bsdf type="roughdielectric"/>', "'roughdielectric'"),
        ('<bsdf type="twosided"/>', "0 bsdfs"),
        (16 * '<bsdf type="twosided">' + '<bsdf type="diffuse"/>' + 16 * "</bsdf>", "nested more than"),
        ('<bsdf type="twosided" id="me"><ref id="me"/></bsdf>', "nested more than"),
        ('<bsdf type="mask"><bsdf type="mask"><bsdf type="diffuse"/></bsdf></bsdf>', "mask inside a mask"),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="1 2"/></bsdf>', "2 values, expected 1 or 3"),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="-1"/></bsdf>', "albedo"),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="#12"/></bsdf>', "#rrggbb"),
        ('<bsdf type="diffuse"><spectrum name="reflectance" filename="a.spd"/></bsdf>', "'a.spd' not found"),
        ('<bsdf type="diffuse"><spectrum name="reflectance" type="d65"/></bsdf>', "from a plugin"),
        ('<bsdf type="diffuse"><spectrum name="reflectance" value="400:0.1 500"/></bsdf>', "expected 2"),
        ('<bsdf type="diffuse"><texture name="reflectance" type="noise"/></bsdf>', "'noise'"),
        ('<bsdf type="diffuse"><texture name="reflectance" type="bitmap"/></bsdf>', "filename"),
        (
            '<bsdf type="diffuse"><texture name="reflectance" type="bitmap"><string name="filename" value="n.png"/>'
            "</texture></bsdf>",
            "texture 'n.png' not found",
        ),
        (
            '<bsdf type="diffuse"><texture name="reflectance" type="bitmap"><string name="filename" value="bad.png"/>'
            "</texture></bsdf>",
            "not an image",
        ),
        ('<bsdf type="conductor"><string name="material" value="Unobtainium"/></bsdf>', "'Unobtainium'"),
        ('<bsdf type="conductor"><float name="eta" value="1"/></bsdf>', "both eta and k"),
        ('<bsdf type="dielectric"><float name="int_ior" value="1"/></bsdf>', "light is not bent; remove"),
        ('<bsdf type="dielectric"><string name="int_ior" value="jelly"/></bsdf>', "'jelly'"),
        ('<bsdf type="roughplastic"><float name="alpha" value="3"/></bsdf>', "roughness 3"),
        (
            '<bsdf type="roughconductor"><string name="distribution" value="hills"/></bsdf>',
            "distribution 'hills', expected one of ggx, beckmann",
        ),
    ],
)
def test_bad_materials_are_refused(tmp_path: Path, bsdf: str, words: str) -> None:
    (tmp_path / "bad.png").write_text("no image")
    assert words in refusal(tmp_path, f'<shape type="rectangle">{bsdf}</shape>')


def test_two_uv_transforms_and_missing_uv_are_refused(tmp_path: Path) -> None:
    meshes(tmp_path)
    checks = '<texture type="checkerboard" name="{}">{}</texture>'
    inner = f'<bsdf type="diffuse">{checks.format("reflectance", "")}</bsdf>'
    scaled = checks.format("opacity", '<float name="uscale" value="2"/>')
    masked = f'<shape type="rectangle"><bsdf type="mask">{scaled}{inner}</bsdf></shape>'
    assert "different to_uv" in refusal(tmp_path, masked)
    bare = f'<shape type="obj"><string name="filename" value="bare.obj"/>{inner}</shape>'
    assert "bare.obj: mesh bare: its material has a texture" in refusal(tmp_path, bare)


def test_textures_that_nobody_asks_for_are_noted_and_doubled_ones_refused(tmp_path: Path) -> None:
    """A mistyped name leaves the default colour, or the default light."""
    image(tmp_path, "a.png", np.full((2, 2, 3), 200))
    bitmap = '<texture type="bitmap"{}><string name="filename" value="a.png"/></texture>'
    named = [bitmap.format(f' name="{name}"') for name in ("reflectance", "difuse_reflectance", "radience")]
    shape = '<shape type="rectangle">{}</shape>'
    for inside, words in (
        (f'<bsdf type="diffuse">{named[1]}</bsdf>', "parameter difuse_reflectance is not used"),
        (f'<bsdf type="mask">{bitmap.format("")}<bsdf type="diffuse"/></bsdf>', "a texture without a name is not used"),
        (f'<emitter type="area">{named[2]}</emitter>', "parameter radience is not used"),
    ):
        assert any(words in note for note in load(tmp_path, shape.format(inside)).notes)
    assert load(tmp_path, shape.format(f'<bsdf type="diffuse">{named[0]}</bsdf>')).notes == ()
    for other in (named[0], GREY):
        assert "reflectance is given twice" in refusal(
            tmp_path, shape.format(f'<bsdf type="diffuse">{named[0]}{other}</bsdf>')
        )


@pytest.mark.parametrize("kind", ["diffuse", "roughdiffuse"])
def test_version_06_knows_two_names_of_a_matte_colour(tmp_path: Path, kind: str) -> None:
    bsdf = f'<bsdf type="{kind}"><rgb name="diffuseReflectance" value="0.1"/></bsdf>'
    assert material(tmp_path, bsdf, version="0.6.0").albedo == pytest.approx(0.1)
    assert material(tmp_path, bsdf).albedo == 0.5


def test_a_dollar_takes_the_longest_known_name_as_in_mitsuba(tmp_path: Path, mitsuba: object) -> None:
    """Keep what follows the name: `$res_oak.png` with `res` known is the file of that resolution."""
    for name, level in (("1k_oak.png", 60), ("2k_oak.png", 200)):
        image(tmp_path, name, np.full((2, 2, 3), level))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="{}"/></texture>'
    names = '<default name="res" value="1k"/><default name="re" value="bogus"/><default name="res_o" value="2k_o"/>'
    for filename, level in (("$res_oak.png", 200), ("1k_$res_oak.png", None)):
        body = f'{names}<shape type="rectangle"><bsdf type="diffuse">{texture.format(filename)}</bsdf></shape>'
        if level is None:
            assert "'1k_2k_oak.png' not found" in refusal(tmp_path, body)
            continue
        path = write(tmp_path, body)
        albedo = load_mitsuba_xml(path).surfaces[0].material.albedo.image.mean()
        assert albedo == pytest.approx(srgb_to_linear(level / 255))
        assert mitsuba(path, rays=[((0, 0, 3), (0, 0, -1))])["hits"][0][2][0] == pytest.approx(albedo, rel=1e-3)
    one = '<default name="res" value="1k"/>'
    made = material(tmp_path, f'<bsdf type="diffuse">{one}{texture.format("$res_oak.png")}</bsdf>')
    assert made.albedo.image.mean() == pytest.approx(srgb_to_linear(60 / 255))


@pytest.mark.parametrize(
    ("spectrum", "close"),
    [
        ("400:0.2, 700:0.8", 0.02),
        ("400:0.2, 500:0.6, 700:0.3", 0.02),
        ("450:0.7, 500:0.2, 550:0.1, 600:0.6, 650:0.9, 700:0.9", 0.06),
        ("300:0.1, 400:0.1, 700:0.3, 1000:0.9, 2500:0.9", 0.02),
    ],
)
def test_a_spectrum_is_as_bright_as_its_colour_in_mitsuba(
    tmp_path: Path, mitsuba: object, spectrum: str, close: float
) -> None:
    """The last one was 3.6 times as bright: what the eye does not see counted as much as what it does."""
    body = (
        f'<shape type="rectangle"><bsdf type="diffuse"><spectrum name="reflectance" value="{spectrum}"/></bsdf></shape>'
    )
    path = write(tmp_path, body)
    colour = mitsuba(path, rays=[([0.1, 0.1, 5], [0, 0, -1])])["hits"][0][2]
    ours = load_mitsuba_xml(path).surfaces[0].material.albedo
    assert ours == pytest.approx(float(luminance(np.array(colour))), rel=close)


@pytest.mark.parametrize(("spectrum", "mean"), [("800:0.2, 900:0.8", 0.5), ("550:0.3", 0.3), ("500:0.4, 600:0.4", 0.4)])
def test_a_spectrum_that_is_hardly_seen_has_its_plain_mean(tmp_path: Path, spectrum: str, mean: float) -> None:
    body = f'<bsdf type="diffuse"><spectrum name="reflectance" value="{spectrum}"/></bsdf>'
    assert material(tmp_path, body).albedo == pytest.approx(mean)
