"""Constructs of public Mitsuba scene files: each is taken, or refused in one line that names it and a way round."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from xml_files import RECTANGLE, SENSOR, load, meshes, refusal, write

from scene2spad.cli import main
from scenes.io.mitsuba import shapes as mitsuba_shapes
from scenes.io.mitsuba.scene_file import load_mitsuba_xml

DOCUMENT = Path(__file__).parents[2] / "docs" / "own-scenes.md"


def shape(inside: str = "", kind: str = "rectangle") -> str:
    return f'<shape type="{kind}">{inside}</shape>'


def bsdf(kind: str, inside: str = "", attributes: str = "") -> str:
    return f'<bsdf type="{kind}" {attributes}>{inside}</bsdf>'


def of_file(kind: str, name: str) -> str:
    return shape(f'<string name="filename" value="{name}"/>', kind)


def camera(kind: str, inside: str = "") -> str:
    return f'<sensor type="{kind}">{inside}</sensor>'


DIFFUSE = bsdf("diffuse")
DENSE_OUTSIDE = '<float name="int_ior" value="1"/><float name="ext_ior" value="1.33"/>'
GROUP = f'<shape type="shapegroup" id="g">{RECTANGLE}</shape>'
INSTANCE = shape('<ref id="g"/><transform name="to_world"><translate z="-2"/></transform>', "instance")
EMITTER = '<emitter type="{}"/>'
CROP = "".join(f'<integer name="{n}" value="4"/>' for n in ("width", "height", "crop_width", "crop_height"))
BITMAP = '<texture type="bitmap" name="{}"><string name="filename" value="t.png"/></texture>'

# construct as docs/own-scenes.md writes it: (body, its version, words of a note or None)
TAKEN = {
    "obj": (of_file("obj", "flat.obj"), "3.0.0", None),
    "ply": (of_file("ply", "mesh.ply"), "3.0.0", None),
    "serialized": (of_file("serialized", "a.serialized"), "0.6.0", None),
    "rectangle": (RECTANGLE, "3.0.0", None),
    "cube": (shape(kind="cube"), "3.0.0", None),
    "sphere": (shape(kind="sphere"), "3.0.0", None),
    "disk": (shape(kind="disk"), "3.0.0", None),
    "cylinder": (shape(kind="cylinder"), "3.0.0", None),
    "shapegroup": (GROUP + INSTANCE, "3.0.0", None),
    "instance": (GROUP + INSTANCE + INSTANCE, "3.0.0", None),
    "merge": (shape(RECTANGLE + shape(kind="cube"), "merge"), "3.0.0", None),
    "thindielectric": (shape(bsdf("thindielectric")), "3.0.0", None),
    "dielectric": (shape(bsdf("dielectric")), "3.0.0", None),
    "int_ior": (shape(bsdf("dielectric", DENSE_OUTSIDE)), "3.0.0", "denser medium is outside"),
    "phong": (shape(bsdf("phong")), "0.6.0", "phong is taken as rough plastic"),
    "principled": (shape(bsdf("principled")), "3.0.0", "principled is taken as rough plastic"),
    "roughconductor": (shape(bsdf("roughconductor")), "3.0.0", None),
    "roughplastic": (shape(bsdf("roughplastic")), "3.0.0", None),
    "twosided": (shape(bsdf("twosided", DIFFUSE)), "3.0.0", None),
    "bumpmap": (shape(bsdf("bumpmap", BITMAP.format("map") + DIFFUSE)), "3.0.0", "bumpmap is left out"),
    "normalmap": (shape(bsdf("normalmap", BITMAP.format("normalmap") + DIFFUSE)), "3.0.0", "normalmap is left out"),
    "mask": (shape(bsdf("mask", DIFFUSE)), "3.0.0", "opacity 0.5 is taken as 1"),
    "null": (shape(bsdf("null")) + RECTANGLE, "3.0.0", "a null bsdf lets all light pass"),
    "bitmap": (shape(bsdf("diffuse", BITMAP.format("reflectance"))), "3.0.0", None),
    "checkerboard": (shape(bsdf("diffuse", '<texture type="checkerboard" name="reflectance"/>')), "3.0.0", None),
    "spectrum": (shape(bsdf("diffuse", '<spectrum name="reflectance" filename="a.spd"/>')), "0.6.0", "spectrum file"),
    "blackbody": (
        shape('<emitter type="area"><blackbody name="radiance" temperature="3000K"/></emitter>'),
        "0.6.0",
        "black body",
    ),
    "area": (shape('<emitter type="area"/>'), "3.0.0", None),
    "constant": (RECTANGLE + EMITTER.format("constant"), "3.0.0", None),
    "envmap": (
        f'{RECTANGLE}<emitter type="envmap"><string name="filename" value="t.png"/></emitter>',
        "3.0.0",
        None,
    ),
    "directionalarea": (shape(EMITTER.format("directionalarea")), "3.0.0", "is left out, ambient light lacks it"),
    "angulararea": (shape(EMITTER.format("angulararea")), "3.0.0", "is left out, ambient light lacks it"),
    **{
        kind: (RECTANGLE + EMITTER.format(kind), "3.0.0", "emitters left out")
        for kind in ("point", "spot", "directional", "projector", "sunsky")
    },
    "default": (
        '<default name="size" value="2"/>' + shape('<float name="radius" value="$size"/>', "sphere"),
        "3.0.0",
        None,
    ),
    "include": ('<include filename="part.xml"/>', "3.0.0", None),
    "ref": (bsdf("diffuse", attributes='id="m"') + shape('<ref id="m"/>'), "3.0.0", None),
    "alias": (bsdf("diffuse", attributes='id="m"') + '<alias id="m" as="n"/>' + shape('<ref id="n"/>'), "3.0.0", None),
    "toWorld": (shape('<transform name="toWorld"><translate z="-3"/></transform>'), "0.6.0", None),
}

SENSORS = {
    "perspective": SENSOR,
    "thinlens": camera("thinlens", '<float name="fov" value="40"/>'),
    "crop_width": camera("perspective", f'<float name="fov" value="40"/><film type="hdrfilm">{CROP}</film>'),
}

# construct: (body, its version, words of the way round)
REFUSED = {
    "roughdielectric": (shape(bsdf("roughdielectric")), "3.0.0", "write dielectric, or diffuse for frosted glass"),
    "blendbsdf": (shape(bsdf("blendbsdf", DIFFUSE + DIFFUSE)), "3.0.0", "write the stronger of its two bsdfs alone"),
    "mixturebsdf": (shape(bsdf("mixturebsdf", DIFFUSE + DIFFUSE)), "0.6.0", "write the stronger of its bsdfs alone"),
    "coating": (shape(bsdf("coating", DIFFUSE)), "0.6.0", "write plastic"),
    "ward": (shape(bsdf("ward")), "0.6.0", "write roughconductor or roughplastic"),
    "hk": (shape(bsdf("hk")), "0.6.0", "write diffuse"),
    "difftrans": (shape(bsdf("difftrans")), "0.6.0", "write diffuse"),
    "principledthin": (shape(bsdf("principledthin")), "3.0.0", "write diffuse, or thindielectric"),
    "measured": (shape(bsdf("measured")), "3.0.0", "write the roughconductor or roughplastic"),
    "hair": (shape(kind="hair"), "0.6.0", "write the strands as thin cylinders"),
    "bsplinecurve": (shape(kind="bsplinecurve"), "3.0.0", "write the strands as thin cylinders"),
    "linearcurve": (shape(kind="linearcurve"), "3.0.0", "write the strands as thin cylinders"),
    "heightfield": (shape(kind="heightfield"), "0.6.0", "write it as .obj or .ply"),
    "sdfgrid": (shape(kind="sdfgrid"), "3.0.0", "write it as .obj or .ply"),
    "medium": (shape('<medium type="homogeneous" name="interior"/>'), "3.0.0", "remove it"),
    "volume": (RECTANGLE + '<volume type="gridvolume" name="v"/>', "3.0.0", "remove it"),
    "subsurface": (shape('<subsurface type="dipole"/>'), "0.6.0", "remove it"),
    "orthographic": (RECTANGLE, "3.0.0", "write perspective"),
    ".hdr": (
        f'{RECTANGLE}<emitter type="envmap"><string name="filename" value="sky.hdr"/></emitter>',
        "3.0.0",
        "convert it to .exr",
    ),
    "DOCTYPE": (RECTANGLE, "3.0.0", "write the values out"),
}


def serialized() -> bytes:
    """One triangle as a .serialized file of version 4."""
    body = struct.pack("<I", 0x2000) + b"t\0" + struct.pack("<QQ", 3, 1)
    body += np.eye(3).tobytes() + np.arange(3, dtype="<u4").tobytes()
    mesh = struct.pack("<HH", 0x041C, 4) + zlib.compress(body)
    return mesh + struct.pack("<QI", 0, 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files that the constructs name."""
    from PIL import Image

    meshes(tmp_path)
    Image.fromarray(np.full((4, 4, 3), 128, np.uint8)).save(tmp_path / "t.png")
    (tmp_path / "a.serialized").write_bytes(serialized())
    (tmp_path / "a.spd").write_text("# nm, value\n400 0.2\n500 0.4\n700 0.4\n")
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{RECTANGLE}</scene>')
    return tmp_path


def listed_in_document() -> dict[str, str]:
    """Constructs in backticks of the table's first column, and what the second says of them."""
    rows = re.findall(r"^\| (.*?) \| (.*?) \|$", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    return {name: result for names, result in rows for name in re.findall(r"`<?([.\w]+)[^`]*`", names)}


@pytest.mark.parametrize("construct", TAKEN)
def test_constructs_that_are_taken(folder: Path, construct: str) -> None:
    body, version, words = TAKEN[construct]
    scene = load(folder, body, version=version)
    assert scene.triangles > 0
    assert words is None or sum(words in note for note in scene.notes) == 1
    assert not listed_in_document()[construct].startswith("refused")


@pytest.mark.parametrize("construct", SENSORS)
def test_sensors_that_are_taken(folder: Path, construct: str) -> None:
    scene = load(folder, RECTANGLE, sensor=SENSORS[construct])
    assert scene.camera.width > 0 and not listed_in_document()[construct].startswith("refused")


@pytest.mark.parametrize("construct", REFUSED)
def test_constructs_that_are_refused_before_meshes_are_read(folder: Path, construct: str, monkeypatch) -> None:
    """One line names the construct and the way round, whatever comes before it in the file."""
    body, version, way_round = REFUSED[construct]
    sensor = camera("orthographic") if construct == "orthographic" else SENSOR
    if construct == "DOCTYPE":
        path = folder / "d.xml"
        path.write_text(f'<!DOCTYPE scene []><scene version="3.0.0">{RECTANGLE}{SENSOR}</scene>')
        with pytest.raises(ValueError, match=r"DOCTYPE.*write the values out"):
            load_mitsuba_xml(path)
    else:
        monkeypatch.setattr(mitsuba_shapes, "_read", lambda *_: pytest.fail("a mesh was read first"))
        message = refusal(folder, of_file("obj", "flat.obj") + body, version=version, sensor=sensor)
        assert construct in message and way_round in message
    assert listed_in_document()[construct].startswith("refused")


def test_the_list_is_as_long_as_it_says() -> None:
    assert len(TAKEN) + len(SENSORS) + len(REFUSED) >= 60


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (bsdf("diffuse", '<texture type="noise" name="reflectance"/>'), "bake it into a bitmap"),
        (bsdf("diffuse", BITMAP.format("reflectance").replace("t.png", "none.png")), "texture 'none.png' not found"),
        ('<emitter type="laser"/>', "emitter 'laser' on a shape"),
        ('<float name="radius" value="0"/>', "radius 0"),
    ],
)
def test_faults_inside_shapes_show_before_meshes_are_read(folder: Path, body: str, words: str, monkeypatch) -> None:
    monkeypatch.setattr(mitsuba_shapes, "_read", lambda *_: pytest.fail("a mesh was read first"))
    assert words in refusal(folder, of_file("obj", "flat.obj") + shape(body, "sphere"))


# --- what is taken is right -----------------------------------------------------------------------------------------


def test_instances_stand_where_their_transforms_put_them(folder: Path) -> None:
    """Group's transform first, then the instance's; a mirroring one keeps the outside outside."""
    inner = '<transform name="to_world"><translate x="1"/></transform>'
    group = f'<shape type="shapegroup" id="g">{shape(inner, "cube")}</shape>'
    mirror = '<ref id="g"/><transform name="to_world"><scale x="-2"/></transform>'
    scene = load(folder, group + INSTANCE + shape(mirror, "instance"))
    assert len(scene.surfaces) == 2
    for surface, low, high in zip(scene.surfaces, [(0, -1, -3), (-4, -1, -1)], [(2, 1, -1), (0, 1, 1)], strict=True):
        np.testing.assert_allclose([surface.vertices.min(axis=0), surface.vertices.max(axis=0)], [low, high])
        corners = surface.vertices[surface.faces]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((outward * (corners.mean(axis=1) - surface.vertices.mean(axis=0))).sum(axis=1) > 0).all()


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (bsdf("diffuse"), "<bsdf> in a"),
        ('<emitter type="area"/>', "<emitter> in a"),
        ('<boolean name="flip_normals" value="true"/>', "parameter flip_normals is not used"),
    ],
)
@pytest.mark.parametrize("kind", ["instance", "merge", "shapegroup"])
def test_what_containers_hold_beside_shapes_is_noted(folder: Path, kind: str, inside: str, words: str) -> None:
    """Look, light and values beside a container's shapes change nothing, which is said."""
    whole = {"merge": shape(RECTANGLE + inside, "merge"), "instance": GROUP + INSTANCE, "shapegroup": GROUP + INSTANCE}
    body = whole[kind].replace('<ref id="g"/>', f'<ref id="g"/>{inside if kind == "instance" else ""}')
    body = body.replace(RECTANGLE + "</shape>", RECTANGLE + (inside if kind == "shapegroup" else "") + "</shape>")
    scene = load(folder, body)
    assert [words in note for note in scene.notes] == [True]
    assert scene.surfaces[0].emission == 0


def test_the_transform_of_a_group_is_noted(folder: Path) -> None:
    moved = '<transform name="to_world"><translate x="5"/></transform>'
    scene = load(folder, GROUP.replace(RECTANGLE, moved + RECTANGLE) + '<shape type="instance"><ref id="g"/></shape>')
    assert any("to_world of a shapegroup" in note for note in scene.notes)
    assert scene.bounds()[1][0] == 1  # as Mitsuba's bounding box


@pytest.mark.parametrize("value", ["true", "false"])
def test_lamps_that_an_integrator_hides_are_noted(folder: Path, value: str) -> None:
    inner = f'<integrator type="path"><boolean name="hideEmitters" value="{value}"/></integrator>'
    scene = load(folder, f'{RECTANGLE}<integrator type="aov"><string name="aovs" value="d:depth"/>{inner}</integrator>')
    assert any("hide_emitters" in note for note in scene.notes) == (value == "true")


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (shape("", "instance"), "of one shapegroup"),
        (GROUP.replace(RECTANGLE, INSTANCE.replace('id="g"', 'id="h"')) + GROUP.replace('"g"', '"h"'), "an? instance"),
        (GROUP, "no shapes that can be seen"),
        (shape(bsdf("null")), "no shapes that can be seen"),
        (GROUP.replace(RECTANGLE, of_file("obj", "none.obj")) + INSTANCE, "'none.obj' not found"),
    ],
)
def test_groups_that_make_no_sense_are_refused(folder: Path, body: str, words: str) -> None:
    assert re.search(words, refusal(folder, body))


def test_glass_with_the_denser_medium_outside_is_turned_inside_out(folder: Path) -> None:
    """A bubble in water is water's surface: the inverse index, and faces that point into the bubble."""
    bubble = load(folder, shape(bsdf("dielectric", DENSE_OUTSIDE), "sphere")).surfaces[0]
    assert bubble.material.ior == pytest.approx(1.33)
    corners = bubble.vertices[bubble.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * corners.mean(axis=1)).sum(axis=1) < 0).all()
    assert ((bubble.normals * bubble.vertices).sum(axis=1) < 0).all()
    pane = load(folder, shape(bsdf("thindielectric", DENSE_OUTSIDE))).surfaces[0]
    plain = load(folder, RECTANGLE).surfaces[0]
    assert pane.material.ior == pytest.approx(1.33) and (pane.faces == plain.faces).all()


def test_principled_keeps_colour_width_and_index(folder: Path) -> None:
    colour = '<rgb name="base_color" value="0.3"/><float name="roughness" value="0.4"/>'
    plastic = load(folder, shape(bsdf("principled", colour))).surfaces[0].material
    assert (plastic.kind, plastic.albedo) == ("roughplastic", pytest.approx(0.3 / 0.84, rel=0.01))  # the coat's share
    assert plastic.roughness == pytest.approx(0.16)
    assert ((plastic.ior - 1) / (plastic.ior + 1)) ** 2 == pytest.approx(0.08 * 0.5)
    given = load(folder, shape(bsdf("principled", '<float name="eta" value="1.7"/>'))).surfaces[0].material
    assert given.ior == pytest.approx(1.7)
    metal = load(folder, shape(bsdf("principled", colour + '<float name="metallic" value="1"/>'))).surfaces[0].material
    assert (metal.kind, metal.specular, metal.eta) == ("roughconductor", pytest.approx(0.3), 0)


def test_a_spectrum_file_is_its_mean_as_the_eye_weights_it(folder: Path) -> None:
    body = shape(bsdf("diffuse", '<spectrum name="reflectance" filename="a.spd"/>'))
    assert load(folder, body).surfaces[0].material.albedo == pytest.approx(0.398, abs=1e-3)  # 2 % is below 500 nm
    (folder / "a.spd").write_text("400 0.2 1\n")
    assert "a.spd has 3 values" in refusal(folder, body)
    (folder / "a.spd").write_text("# nothing\n")
    assert "a.spd: holds no wavelengths" in refusal(folder, body)


@pytest.mark.parametrize(("size", "asked"), [(1e-3, True), (1.0, False), (2e3, True)])
def test_a_unit_that_is_hardly_metres_is_questioned(tmp_path: Path, capsys, size: float, asked: bool) -> None:
    """Depths under a centimetre or beyond a kilometre: the line names --scale."""
    move = f'<transform name="to_world"><scale value="{3 * size}"/><translate z="{size}"/></transform>'
    path = write(tmp_path, shape(move))
    out = ["--out", str(tmp_path / "a.exr"), "--bounces", "1", "--grid", "1", "--no-figure", "--width", "8"]
    assert main(["render", str(path), *out]) == 0
    said = capsys.readouterr().err
    assert ("median depth of a is" in said and "--scale" in said) == asked
