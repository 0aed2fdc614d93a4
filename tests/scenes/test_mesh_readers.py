"""Mesh files as their formats mean them, where trimesh reads something else: indices, units, colours, coordinates."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scenes import InputError, Scene, Surface
from scenes.io.mesh_formats import mesh_colours
from scenes.io.mesh_formats.glb import plain_glb
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.textures import luminance, srgb_to_linear
from scenes.placing import Placing
from tests.scenes.glb_files import CORNERS, RAMP, TEXTURED, UV, glb, png, written

AS_FILE = Placing(scale=1, bare=True)
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def only(scene: Scene) -> Surface:
    assert len(scene.surfaces) == 1
    return scene.surfaces[0]


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_mesh(path, placing=AS_FILE)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


# --- OBJ -------------------------------------------------------------------------------------------------------------


def test_relative_indices_count_from_their_line(tmp_path: Path) -> None:
    second = SQUARE.replace(" 0\n", " 2\n")
    text = f"{SQUARE}vt 0 0\nf -4/-1 -3/-1 -2/-1 -1/-1\n{second}vt 1 1\nf -4/-1 -3/-1 -2/-1 -1/-1 # the last\n"
    surface = only(load_mesh(written(tmp_path / "a.obj", text), placing=AS_FILE))
    assert len(surface.faces) == 4 and np.ptp(surface.vertices, axis=0) == pytest.approx((1, 1, 2))
    near = surface.vertices[:, 2] < 0
    assert (surface.uv[near] == 0).all() and (surface.uv[~near] == 1).all()


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1 2 0", "f -5 -4 -3", "f 1/1 0/1 2/1"])
def test_an_index_of_no_vertex_is_refused_with_its_line(tmp_path: Path, face: str) -> None:
    assert "line 5: a face's index" in refusal(written(tmp_path / "a.obj", f"{SQUARE}{face}\n"))


def test_indents_tabs_and_comments_change_nothing(tmp_path: Path) -> None:
    written(tmp_path / "a.mtl", "newmtl a\nKd 0.5 0.5 0.5\n")
    text = f"# mtllib b.mtl\n  mtllib a.mtl\n{SQUARE}".replace("v ", "v\t") + "usemtl a\n\tf 1 2 3\n  f 1 3 \\\n 4\n"
    surface = only(load_mesh(written(tmp_path / "a.obj", text), placing=AS_FILE))
    assert len(surface.faces) == 2
    assert surface.material.albedo == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("words", "metres"),
    [
        ("units: microns", 0.9),
        ("unit mesh", 0.9),
        ("units in use", 0.9),
        ("units: metric", 0.9),
        ("units: m", 900),
        ("Unit = metres", 900),
        ("units=in", 900 * 0.0254),
        ("units in cm", 9),
        ("System units: inches, exported in meters", 0.9),
        ("units: inches (1 inch = 25.4 mm)", 0.9),
        ("units: m, metres that is", 900),
    ],
)
def test_a_unit_is_a_whole_word(tmp_path: Path, words: str, metres: float) -> None:
    """A comment that names no unit, or two, leaves 900 of them to be millimetres."""
    path = written(tmp_path / "a.obj", f"# {words}\nv 0 0 0\nv 900 0 0\nv 0 900 0\nf 1 2 3\n")
    assert np.ptp(load_mesh(path, placing=Placing(bare=True)).surfaces[0].vertices, axis=0).max() == pytest.approx(
        metres
    )


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("f 1 2 99", "line 5: a face's index 99, 4 are there"),
        ("v 0,0 0,0 0,0\nf 1 2 3", "line 5: 'v 0,0 0,0 0,0' is not x y z"),
        ("v 0 1\nf 1 2 5", "line 5: 'v 0 1' is not x y z"),
        ("f 1 2 x", "line 5: 'f 1 2 x' is not numbers of vertices"),
        ("vn 0 0 1\nf 1//1 2//1 3//2", "line 6: a face's index 2, 1 are there"),
    ],
)
def test_a_line_of_an_obj_that_cannot_be_read_is_named(tmp_path: Path, lines: str, message: str) -> None:
    assert message in refusal(written(tmp_path / "a.obj", f"{SQUARE}{lines}\n"))


def test_a_comment_behind_a_face_changes_nothing(tmp_path: Path) -> None:
    path = written(tmp_path / "a.obj", f"{SQUARE}usemtl oak #2\nf 1 2 3 # one\nf 1 3 4 # two\n")
    assert len(only(load_mesh(path, placing=AS_FILE)).faces) == 2


@pytest.mark.parametrize("named", ["mtllib a.mtl b.mtl", "mtllib a.mtl\nmtllib b.mtl", "mtllib my own.mtl"])
def test_every_material_file_is_read(tmp_path: Path, named: str) -> None:
    """Several on a line or on lines of their own, or one with a blank in its name."""
    a, b = "newmtl a\nKd 0 0 0\n", "newmtl b\nKd 1 1 1\n"
    for name, text in (("a.mtl", a), ("b.mtl", b), ("my own.mtl", a + b)):
        written(tmp_path / name, text)
    text = f"{named}\n{SQUARE}usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n"
    scene = load_mesh(written(tmp_path / "a.obj", text), placing=AS_FILE)
    assert sorted(surface.material.albedo for surface in scene.surfaces) == [0, 1]
    assert scene.notes == ("largest extent 1 m kept",)


def test_faces_of_a_very_small_body_are_no_degenerate_ones(tmp_path: Path) -> None:
    """A square of one micrometre has an area of 1e-12 m^2; a needle of no width is degenerate at any size."""
    text = SQUARE.replace(" 1", " 1e-6") + "v 5e-7 0 0\nf 1 2 3\nf 1 3 4\nf 1 5 2\n"
    scene = load_mesh(written(tmp_path / "a.obj", text), placing=AS_FILE)
    assert len(only(scene).faces) == 2 and "a: degenerate faces dropped: 1" in " ".join(scene.notes)


def test_cut_outs_of_an_obj_are_noted(tmp_path: Path) -> None:
    written(tmp_path / "a.mtl", "newmtl a\nKd 0.5 0.5 0.5\nmap_d leaf.png\n")
    scene = load_mesh(written(tmp_path / "a.obj", f"mtllib a.mtl\n{SQUARE}usemtl a\nf 1 2 3 4\n"), placing=AS_FILE)
    assert "a: alpha (map_d) is left out, its surface is opaque" in scene.notes


@pytest.mark.parametrize(
    ("line", "opacity"), [("d 0.25", "0.25"), ("d -halo 0.5", "0.5"), ("Tr 0.75", "0.25"), ("d 1\nTr 1", None)]
)
def test_a_clear_material_of_an_obj_is_noted(tmp_path: Path, line: str, opacity: str | None) -> None:
    written(tmp_path / "a.mtl", f"newmtl a\nKd 0.5 0.5 0.5\n{line}\n")
    scene = load_mesh(written(tmp_path / "a.obj", f"mtllib a.mtl\n{SQUARE}usemtl a\nf 1 2 3 4\n"), placing=AS_FILE)
    found = [note for note in scene.notes if "opacity" in note]
    assert found == ([] if opacity is None else [f"a: opacity {opacity} is left out, its surface is opaque"])


def test_a_texture_without_coordinates_is_noted(tmp_path: Path) -> None:
    written(tmp_path / "t.png", png(RAMP))
    written(tmp_path / "a.mtl", "newmtl a\nKd 0.5 0.5 0.5\nmap_Kd t.png\n")
    obj = written(tmp_path / "a.obj", f"mtllib a.mtl\n{SQUARE}usemtl a\nf 1 2 3 4\n")
    for path in (obj, glb(tmp_path / "b.glb", {"POSITION": CORNERS}, TEXTURED)):
        notes = load_mesh(path, placing=AS_FILE).notes
        assert f"{path.stem}: its texture is left out, it has no texture coordinates" in notes


# --- PLY -------------------------------------------------------------------------------------------------------------


def ply(comment: str = "", colour: str = "") -> str:
    kinds = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) if colour else ""
    rows = "".join(f"{x} {y} 0 {x} {y} {colour}\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    coordinates = "".join(f"property float {name}\n" for name in "xyzuv")
    head = f"ply\nformat ascii 1.0\n{comment}element vertex 3\n{coordinates}{kinds}element face 1\n"
    return f"{head}property list uchar int vertex_index\nend_header\n{rows}3 0 1 2\n"


def test_coordinates_without_a_texture_are_no_colour(tmp_path: Path) -> None:
    scene = load_mesh(written(tmp_path / "a.ply", ply()), placing=AS_FILE)
    assert only(scene).material.albedo == 0.6 and any("no colour" in note for note in scene.notes)
    scene = load_mesh(written(tmp_path / "b.ply", ply(colour="128 128 128")), placing=AS_FILE)
    assert only(scene).material.albedo == pytest.approx(float(srgb_to_linear(128 / 255)))


def test_a_ply_without_its_texture_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "a.ply", ply("comment TextureFile skin.png\n"))
    assert "skin.png" in refusal(path)
    written(tmp_path / "skin.png", b"no image")
    with pytest.raises(InputError, match=r"skin\.png: not an image"):
        load_mesh(path)
    assert capfd.readouterr().err == ""
    Image.new("RGB", (4, 4), (128, 128, 128)).save(tmp_path / "skin.png")
    pixels = only(load_mesh(path, placing=AS_FILE)).material.albedo.image
    assert pixels == pytest.approx(np.full((4, 4), srgb_to_linear(128 / 255)))


def test_comments_of_a_ply_are_in_any_encoding(tmp_path: Path) -> None:
    text = ply("comment Größe\n").encode("latin-1")
    assert only(load_mesh(written(tmp_path / "a.ply", text), placing=AS_FILE)).faces.shape == (1, 3)


@pytest.mark.parametrize(
    ("kind", "values", "levels"),
    [
        ("uchar", "128 128 128", 128 / 255),
        ("ushort", "32896 32896 32896", 32896 / 65535),
        ("ushort", "300 300 300", 300 / 65535),
        ("int", "128 128 128", 128 / 255),
        ("float", "0.5 0.5 0.5", 0.5),
        ("double", "128 128 128", 128 / 255),
    ],
)
@pytest.mark.parametrize("prefix", ["", "diffuse_"])
def test_colours_of_a_ply_are_shares_of_what_their_type_holds(
    tmp_path: Path, kind: str, values: str, levels: float, prefix: str
) -> None:
    text = ply(colour=values).replace("uchar red", f"uchar {prefix}red")
    for name in ("red", "green", "blue"):
        text = re.sub(rf"property uchar (?:diffuse_)?{name}", f"property {kind} {prefix}{name}", text)
    scene = load_mesh(written(tmp_path / "a.ply", text), placing=AS_FILE)
    assert only(scene).material.albedo == pytest.approx(float(srgb_to_linear(levels)), rel=1e-6)


def test_a_grey_image_of_16_bits_is_read_whole(tmp_path: Path) -> None:
    """Pillow clips such levels at 255 where it makes them RGB."""
    deep = RAMP.astype(np.uint16) * 257
    written(tmp_path / "deep.png", png(deep))
    named = written(tmp_path / "a.ply", ply("comment TextureFile deep.png\n"))
    inside = glb(tmp_path / "a.glb", {"POSITION": CORNERS, "TEXCOORD_0": UV}, TEXTURED, png(deep))
    for path in (named, inside):
        albedo = only(load_mesh(path, placing=AS_FILE)).material.albedo
        np.testing.assert_allclose(albedo.image, srgb_to_linear(RAMP / 255), rtol=1e-5)


# --- GLB -------------------------------------------------------------------------------------------------------------


def transformed(**transform: object) -> dict:
    """Return a material whose texture has a KHR_texture_transform."""
    base = {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": transform}}
    return {"pbrMetallicRoughness": {"baseColorTexture": base}}


def second_set(**base: object) -> dict:
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1, **base}}}


@pytest.mark.parametrize(
    ("attributes", "material"),
    [
        ({"TEXCOORD_0": (UV * 65535).astype(np.uint16)}, TEXTURED),
        ({"TEXCOORD_0": (UV * 255).astype(np.uint8)}, TEXTURED),
        ({"TEXCOORD_0": UV, "POSITION": (CORNERS * 32767).astype(np.int16)}, TEXTURED),
        ({"TEXCOORD_0": 3 * UV, "TEXCOORD_1": UV}, second_set()),
        ({"TEXCOORD_0": 3 * UV, "TEXCOORD_1": UV / 2 - 1}, transformed(scale=[2, 2], offset=[2, 2])),
        (
            {"TEXCOORD_0": (UV / (4, 1) + (0.5, 0)).astype(np.float32)},
            transformed(scale=[4, 1], offset=[-2, 0], texCoord=0),
        ),
        ({"TEXCOORD_0": (UV * 128).astype(np.uint8)}, transformed(scale=[255 / 128] * 2, texCoord=0)),
    ],
)
def test_coordinates_of_a_glb_are_those_that_they_stand_for(tmp_path: Path, attributes: dict, material: dict) -> None:
    """Whole numbers, another set, and a transform of the texture, against the same square as plain floats."""
    plain = only(load_mesh(glb(tmp_path / "a.glb", {"POSITION": CORNERS, "TEXCOORD_0": UV}, TEXTURED), placing=AS_FILE))
    path = glb(tmp_path / "b.glb", {"POSITION": CORNERS} | attributes, material)
    found = only(load_mesh(path, placing=AS_FILE))
    np.testing.assert_allclose(found.uv, plain.uv, atol=1e-5)
    np.testing.assert_allclose(found.vertices, plain.vertices, atol=1e-6)
    assert found.faces.tolist() == plain.faces.tolist()
    np.testing.assert_array_equal(found.material.albedo.image, plain.material.albedo.image)


def test_a_glb_whose_coordinates_were_moved_says_nothing_of_a_move(tmp_path: Path) -> None:
    """Whatever reads it on finds floats of the first set, within the file."""
    attributes = {"POSITION": (CORNERS * 32767).astype(np.int16), "TEXCOORD_0": UV, "TEXCOORD_1": UV}
    content = plain_glb(glb(tmp_path / "a.glb", attributes, transformed(scale=[2, 2])).read_bytes())
    size = struct.unpack_from("<I", content, 12)[0]
    header = json.loads(content[20 : 20 + size])
    base = header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    assert base == {"index": 0, "extensions": {}}
    ends = [view["byteOffset"] + view["byteLength"] for view in header["bufferViews"]]
    assert max(ends) <= header["buffers"][0]["byteLength"] <= struct.unpack_from("<I", content, 20 + size)[0]


def test_a_set_of_coordinates_that_is_not_there_is_noted(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS, "TEXCOORD_0": UV}, second_set())
    notes = load_mesh(path, placing=AS_FILE).notes
    assert "a: its texture is left out, it has no texture coordinates" in notes


@pytest.mark.parametrize(
    ("attributes", "material", "primitive", "words"),
    [
        ({"TEXCOORD_0": UV}, transformed(rotation="0.5", texCoord=0), {}, "KHR_texture_transform '0.5' is not a"),
        ({}, None, {"mode": 6}, "triangle fan"),
    ],
)
def test_what_would_be_read_as_something_else_is_refused(
    tmp_path: Path, attributes: dict, material: dict | None, primitive: dict, words: str
) -> None:
    assert words in refusal(glb(tmp_path / "a.glb", {"POSITION": CORNERS} | attributes, material, **primitive))


@pytest.mark.parametrize("kind", [np.float32, np.uint8, np.uint16])
@pytest.mark.parametrize("factor", [None, 0.8])
def test_colours_per_vertex_count_whatever_their_type_and_material(
    tmp_path: Path, kind: type, factor: float | None
) -> None:
    most = 1 if kind is np.float32 else np.iinfo(kind).max
    colours = np.broadcast_to(np.array((0.21, 0.43, 0.64, 1)) * most, (4, 4)).astype(kind)
    material = None if factor is None else {"pbrMetallicRoughness": {"baseColorFactor": [factor] * 3 + [1]}}
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS, "COLOR_0": colours}, material)
    expected = float(luminance(np.array((0.21, 0.43, 0.64)))) * (factor or 1)
    assert only(load_mesh(path, placing=AS_FILE)).material.albedo == pytest.approx(expected, abs=3e-3)


def test_a_textures_tint_is_that_of_its_vertices_and_alpha_is_noted(tmp_path: Path) -> None:
    values = {"POSITION": CORNERS, "TEXCOORD_0": UV}
    plain = only(load_mesh(glb(tmp_path / "a.glb", values, TEXTURED), placing=AS_FILE)).material.albedo.image
    tinted = glb(tmp_path / "b.glb", values | {"COLOR_0": np.full((4, 4), 0.5, np.float32)}, TEXTURED)
    assert only(load_mesh(tinted, placing=AS_FILE)).material.albedo.image == pytest.approx(plain / 2)
    cut = load_mesh(glb(tmp_path / "c.glb", values, TEXTURED | {"alphaMode": "MASK"}), placing=AS_FILE)
    assert any("alpha is left out" in note for note in cut.notes)


def test_a_texture_beyond_the_limit_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_colours, "MAX_PIXELS", 63)
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS, "TEXCOORD_0": UV}, TEXTURED)
    assert "has 64 pixels, the limit is 63" in refusal(path)


@pytest.mark.parametrize(
    ("name", "way_round"),
    [
        ("EXT_mesh_gpu_instancing", "write its instances out as nodes"),
        ("KHR_node_visibility", None),
        ("EXT_meshopt_compression", "export it uncompressed"),
        ("KHR_draco_mesh_compression", "export it uncompressed"),
        ("FOO_unknown", "export it without"),
        ("KHR_mesh_quantization", None),
        ("KHR_texture_transform", None),
        ("KHR_materials_clearcoat", None),
    ],
)
def test_extensions_that_a_glb_needs_are_read_or_refused(tmp_path: Path, name: str, way_round: str | None) -> None:
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS})
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    text = json.dumps(json.loads(content[20 : 20 + size]) | {"extensionsRequired": [name]}).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + size :]
    head = b"glTF" + struct.pack("<IIII", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    written(path, head + text + rest)
    if way_round is None:
        assert load_mesh(path, placing=AS_FILE).triangles == 2
    else:
        assert f"needs the glTF extension {name}, which is not read; {way_round}" in refusal(path)


def test_extensions_that_a_glb_only_uses_are_noted(tmp_path: Path) -> None:
    names = ("KHR_materials_transmission", "KHR_materials_sheen", "KHR_materials_pbrSpecularGlossiness")
    clear = {"extensions": {name: {} for name in names}}
    path = glb(tmp_path / "a.glb", {"POSITION": CORNERS}, clear, extensions={"EXT_mesh_gpu_instancing": {}})
    notes = load_mesh(path, placing=AS_FILE).notes
    assert notes[:3] == (
        "EXT_mesh_gpu_instancing is left out: each of 1 nodes is there once",
        "KHR_materials_transmission left out: its surfaces are opaque",
        "KHR_materials_sheen left out: its surfaces are diffuse",
    )


def test_metal_and_glow_of_a_glb_are_noted(tmp_path: Path) -> None:
    def notes(**material: object) -> list[str]:
        path = glb(tmp_path / "a.glb", {"POSITION": CORNERS}, {"name": "brass", **material})
        return [note for note in load_mesh(path, placing=AS_FILE).notes if note.endswith(": brass")]

    metal, glow = notes(pbrMetallicRoughness={}, emissiveFactor=[0, 1, 0])
    assert metal.startswith("metallicFactor") and glow.startswith("emissiveFactor")
    assert notes(pbrMetallicRoughness={"metallicFactor": 0}, emissiveFactor=[0, 0, 0]) == []
