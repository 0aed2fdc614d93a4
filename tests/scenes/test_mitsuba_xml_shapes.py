"""scenes.io.mitsuba.shapes: the shapes of a Mitsuba scene file, against Mitsuba itself and against closed forms."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from xml_files import GREY, LUMINANCE, OBJ, PLY, first_hit, image, load, meshes, refusal, texel, write

from scenes.geometry import shapes
from scenes.io.mitsuba.scene_file import load_mitsuba_xml

DOWN = [((0.3, 0.2, 5), (0, 0, -1)), ((0.2, 0.35, 5), (0, 0, -1)), ((0.6, 0.3, 5), (0, 0, -1))]
SIDES = [((-0.3, 0.2, 5), (0, 0, -1)), ((5, 0.3, 0.4), (-1, 0, 0)), ((-0.3, -5, 0.4), (0, 1, 0))]
SIDES += [((0.2, 0.3, -5), (0, 0, 1)), ((-5, 0.3, 0.4), (1, 0, 0)), ((0.3, 5, -0.4), (0, -1, 0))]
MIRROR = '<transform name="to_world"><scale x="-1"/></transform>'
SHAPES = [
    ("rectangle", "", SIDES[:1]),
    ("cube", "", SIDES),
    ("sphere", "", SIDES),
    ("disk", "", SIDES[:1]),
    ("cylinder", "", SIDES[1:3]),
    ("sphere", '<point name="center" x="0.1" y="0.2" z="0"/><float name="radius" value="1.5"/>', SIDES),
    (
        "cylinder",
        '<point name="p0" value="0 -1 0"/><point name="p1" x="0.2" y="2" z="0"/><float name="radius" value="0.7"/>',
        SIDES[:2],
    ),
    ("obj", '<string name="filename" value="flat.obj"/>', DOWN),
    ("obj", '<string name="filename" value="quad.obj"/>', DOWN),
    ("obj", '<string name="filename" value="quad.obj"/><boolean name="flip_tex_coords" value="false"/>', DOWN),
    ("obj", '<string name="filename" value="quad.obj"/><boolean name="face_normals" value="true"/>', DOWN),
    ("ply", '<string name="filename" value="mesh.ply"/>', DOWN),
    ("ply", '<string name="filename" value="mesh.ply"/><boolean name="flip_tex_coords" value="true"/>', DOWN),
]
TURN = '<transform name="to_world"><rotate y="1" angle="20"/><scale value="1 1.1 0.9"/><translate z="0.1"/></transform>'


@pytest.mark.parametrize("change", ["", MIRROR, '<boolean name="flip_normals" value="true"/>', TURN])
@pytest.mark.parametrize(("kind", "values", "rays"), SHAPES)
def test_shapes_are_mitsubas(tmp_path: Path, mitsuba: object, kind: str, values: str, rays: list, change: str) -> None:
    """Box, points, shading normals, the lit side and the texture's place, all where Mitsuba has them."""
    if change == TURN and kind in ("sphere", "cylinder", "disk"):
        change = change.replace("1 1.1 0.9", "1.1")
    if change == MIRROR:
        rays = [((-o[0], *o[1:]), (-d[0], *d[1:])) for o, d in rays]
    meshes(tmp_path)
    image(tmp_path, "t.png", np.arange(0, 240, 2.5).reshape(8, 12))
    bitmap = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.png"/>{}</texture>'
    bitmap = bitmap.format('<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>')
    body = (
        f'<shape type="{kind}">{values}{change}<bsdf type="twosided"><bsdf type="diffuse">{bitmap}</bsdf></bsdf>'
        '<emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>'
    )
    path = write(tmp_path, body)
    surface = load_mitsuba_xml(path).surfaces[0]
    answer = mitsuba(path, rays=rays)
    box = [surface.vertices.min(axis=0), surface.vertices.max(axis=0)]
    np.testing.assert_allclose(box, answer["bbox"], atol=4e-4 * 1.5 if surface.normals is not None else 1e-6)
    for (origin, direction), (point, normal, albedo, light) in zip(rays, answer["hits"], strict=True):
        ours, shading, face, uv = first_hit(surface, origin, direction)
        np.testing.assert_allclose(ours, point, atol=1e-3)
        np.testing.assert_allclose(shading, normal, atol=2e-3)
        assert texel(surface.material.albedo, uv) == pytest.approx(albedo[0], abs=1e-4)
        assert surface.emission * (face @ direction < 0) == pytest.approx(light)


def test_bare_obj_gets_smooth_normals_unless_asked(tmp_path: Path, mitsuba: object) -> None:
    meshes(tmp_path)
    body = '<shape type="obj"><string name="filename" value="bare.obj"/>{}</shape>'
    path = write(tmp_path, body.format(""))
    surface = load_mitsuba_xml(path).surfaces[0]
    assert surface.uv is None
    for ray, hit in zip(DOWN, mitsuba(path, rays=DOWN)["hits"], strict=True):
        np.testing.assert_allclose(first_hit(surface, *ray)[1], hit[1], atol=1e-5)
    flat = load(tmp_path, body.format('<boolean name="faceNormals" value="true"/>'), version="0.6.0")
    assert flat.surfaces[0].normals is None


def test_smooth_normals_know_no_materials_of_the_file(tmp_path: Path, mitsuba: object) -> None:
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 0 1\nv 0 1 1\n"
    (tmp_path / "two.obj").write_text(f"{vertices}usemtl a\nf 1 2 3\nusemtl b\nf 2 4 5 3\n")
    path = write(tmp_path, '<shape type="obj"><string name="filename" value="two.obj"/></shape>')
    ray = [0.48, 0.48, 5.0], [0.0, 0.0, -1.0]
    ours = first_hit(load_mitsuba_xml(path).surfaces[0], *ray)[1]
    assert ours == pytest.approx(np.array(mitsuba(path, rays=[ray])["hits"][0][1]), abs=1e-4)


def test_normals_of_length_0_in_a_file_become_those_of_the_faces(tmp_path: Path) -> None:
    """They made the surface black."""
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 0\nvn 0 0.6 0.8\nf 1//1 2//1 3//2\n"
    (tmp_path / "none.obj").write_text(text)
    body = '<shape type="obj"><string name="filename" value="none.obj"/></shape>'
    (surface,) = load(tmp_path, body).surfaces
    found = sorted(surface.normals[surface.faces[0]].tolist())
    assert found == [[0, 0, 1], [0, 0, 1], pytest.approx([0, 0.6, 0.8])]


def test_a_mesh_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import trimesh

    meshes(tmp_path)
    reads = []
    read = trimesh.load_scene
    monkeypatch.setattr(trimesh, "load_scene", lambda *a, **k: reads.append(1) or read(*a, **k))
    shape = '<shape type="obj"><string name="filename" value="quad.obj"/></shape>'
    assert len(load(tmp_path, 3 * shape).surfaces) == 3 and len(reads) == 1


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ('<shape type="serialized"/>', 'lacks <string name="filename"'),
        ('<shape type="shapegroup"/>', "no shapes that can be seen"),
        ('<shape type="instance"/>', "of one shapegroup"),
        ('<shape type="hair"/>', "'hair'"),
        ("<shape/>", 'lacks type="..."'),
        ('<shape type="obj"/>', 'lacks <string name="filename"'),
        ('<shape type="obj"><string name="filename" value="none.obj"/></shape>', "'none.obj' not found"),
        ('<shape type="obj"><string name="filename" value="/etc/none.obj"/></shape>', "outside the scene's folder"),
        ('<shape type="obj"><string name="filename" value="../none.obj"/></shape>', "outside the scene's folder"),
        ('<shape type="obj"><string name="filename" value="link.obj"/></shape>', "outside the scene's folder"),
        (f'<shape type="obj"><string name="filename" value="{"x" * 400}"/></shape>', "cannot be looked up"),
        ('<shape type="obj"><string name="filename" value="nan.obj"/></shape>', "nan.obj: 1 of 3 vertices"),
        ('<shape type="obj"><string name="filename" value="empty.obj"/></shape>', "empty.obj: holds no triangles"),
        ('<shape type="obj"><string name="filename" value="bad.obj"/></shape>', "bad.obj: broken .obj file"),
        ('<shape type="ply"><string name="filename" value="bad.ply"/></shape>', "bad.ply: broken .ply file"),
        ('<shape type="ply"><string name="filename" value="cut.ply"/></shape>', "cut.ply: "),
        ('<shape type="sphere"><float name="radius" value="0"/></shape>', "radius 0"),
        ('<shape type="cylinder"><point name="p1" value="0 0 0"/></shape>', "same point"),
        ('<shape type="sphere"><medium type="homogeneous" name="interior"/></shape>', "homogeneous"),
        ('<shape type="sphere"><subsurface type="dipole"/></shape>', "dipole"),
        ('<shape type="sphere"><emitter type="point"/></shape>', "'point'"),
        ('<shape type="sphere"><bsdf type="diffuse"/><bsdf type="diffuse"/></shape>', "2 bsdfs"),
        ('<shape type="sphere"><ref id="none"/></shape>', "unknown id 'none'"),
        ('<shape type="sphere"><colour name="x"/></shape>', "<colour>"),
        ('<shape type="sphere"><float value="3"/></shape>', 'lacks name="..."'),
        ('<shape type="sphere"><float name="radius"/></shape>', 'lacks value="..."'),
        ('<shape type="sphere"><string name="radius" value="1"/></shape>', "is a <string>"),
        ('<shape type="sphere"><boolean name="flip_normals" value="1"/></shape>', "true or false"),
        ('<shape type="sphere"><float name="radius" value="1"/><float name="radius" value="2"/></shape>', "twice"),
        (
            '<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="-1"/></emitter></shape>',
            "emission -1",
        ),
        ("", "holds no shapes"),
        ('<medium type="homogeneous" id="m"/>', "is not supported"),
        ("<shapes/>", "unknown element"),
        ('<ref id="x"/>', "unknown element"),
    ],
)
def test_bad_shapes_are_refused(tmp_path: Path, shape: str, words: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "none.obj").write_text(OBJ + "f 1 2 3\n")
    (folder / "link.obj").symlink_to(tmp_path / "none.obj")
    (folder / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "empty.obj").write_text("v 0 0 0\n")
    (folder / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 9\n")
    (folder / "bad.ply").write_text("no ply")
    (folder / "cut.ply").write_text(PLY[:-20])
    assert words in refusal(folder, shape)


@pytest.mark.parametrize("name", ["box", "sphere", "cylinder"])
def test_closed_shapes_face_outwards_and_keep_their_volume(name: str) -> None:
    vertices, faces, uv = {
        "box": lambda: shapes.box((1, 2, 3)),
        "sphere": lambda: shapes.sphere(0.5),
        "cylinder": lambda: shapes.cylinder((1, 0, 0), (1, 2, 2), 0.5, segments=128, caps=True),
    }[name]()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    exact = {"box": 6, "sphere": math.pi / 6, "cylinder": math.pi * 0.25 * math.sqrt(8)}[name]
    assert volume == pytest.approx(exact, rel=6e-4) and len(uv) == len(vertices)
    # Vertices are doubled where uv jumps, so no triangle runs across the image.
    assert np.ptp(uv[faces], axis=1)[:, 0].max() < (1.01 if name == "box" else 0.5 if name == "sphere" else 1.01)


def test_sphere_area_is_within_its_stated_share() -> None:
    vertices, faces, _ = shapes.sphere(2.0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert 2.9e-4 < 1 - area / (16 * math.pi) < 3.1e-4
    # A half-lit sphere: the projected area decides the energy that comes back.
    shadow = np.cross(b - a, c - a)[:, 2]
    assert 1 - shadow[shadow > 0].sum() / 2 / (4 * math.pi) < 1e-3


def test_a_lamp_without_a_bsdf_is_black_as_in_mitsuba(tmp_path: Path, mitsuba: object) -> None:
    """Show its own light alone; with a bsdf it reflects as that says, and a shape that is no lamp is grey."""
    lamp = '<emitter type="area"/>'
    for inside, albedo in ((lamp, 0.0), ("", 0.5), (f'<bsdf type="diffuse">{GREY}</bsdf>{lamp}', LUMINANCE)):
        path = write(tmp_path, f'<shape type="rectangle">{inside}</shape>')
        (surface,) = load_mitsuba_xml(path).surfaces
        assert surface.material.albedo == pytest.approx(albedo)
        ((*_, seen, _),) = mitsuba(path, rays=[((0, 0, 3), (0, 0, -1))])["hits"]
        assert np.dot(seen, (0.2126, 0.7152, 0.0722)) == pytest.approx(albedo, abs=1e-3)


def test_a_black_back_that_is_seen_is_noted_once(tmp_path: Path) -> None:
    """Notes stay rare: not of closed shapes, glass or what `twosided` holds, nor of a back that nobody looks at."""
    turned = '<transform name="to_world">{}<translate z="3"/></transform>'
    back, front = turned.format(""), turned.format('<rotate y="1" angle="180"/>')
    bsdfs = {"one": '<bsdf type="diffuse"/>', "both": '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'}
    bsdfs |= {"glass": '<bsdf type="thindielectric"/>', "none": ""}
    body = "".join(f'<shape type="rectangle" id="{name}">{back}{inner}</shape>' for name, inner in bsdfs.items())
    body += f'<shape type="rectangle" id="front">{front}{bsdfs["one"]}</shape>'
    body += "".join(f'<shape type="{kind}">{back}{bsdfs["one"]}</shape>' for kind in ("sphere", "cube"))
    body += f'<shape type="cylinder" id="pipe">{back}{bsdfs["one"]}</shape>'
    (note,) = load(tmp_path, body).notes
    assert note == "reflects from both sides, in Mitsuba the back without twosided is black: one, none, pipe"


@pytest.mark.parametrize(
    ("kind", "steps", "noted"),
    [
        ("sphere", '<scale value="1 2 1"/>', True),
        ("sphere", '<rotate z="1" angle="30"/><scale x="2" y="3" z="3"/>', True),
        ("sphere", '<rotate x="1" y="0" angle="30"/><scale value="2"/><scale x="-1"/><translate x="9"/>', False),
        ("disk", '<scale value="1 2 1"/>', False),
        ("cylinder", '<scale value="1 2 1"/>', False),
    ],
)
def test_a_sphere_that_mitsuba_keeps_round_is_noted(
    tmp_path: Path, mitsuba: object, kind: str, steps: str, noted: bool
) -> None:
    """The sphere alone has another box in Mitsuba, where a scale is not the same along all axes."""
    path = write(tmp_path, f'<shape type="{kind}"><transform name="to_world">{steps}</transform></shape>')
    scene = load_mitsuba_xml(path)
    points = scene.surfaces[0].vertices
    same = np.allclose([points.min(axis=0), points.max(axis=0)], mitsuba(path)["bbox"], atol=1e-2)
    assert same != noted
    assert any("makes an ellipsoid of the sphere" in note for note in scene.notes) == noted
