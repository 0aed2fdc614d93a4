"""Mesh files as scenes: set down, scaled, coloured, repaired, or refused in one line."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from scenes import InputError, Scene, Surface, Texture
from scenes.io.mesh_formats.meshes import load_mesh

DATA = Path(os.environ.get("SCENE2SPAD_DATA", Path(__file__).parents[2].parent / "shared/data"))
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def cube(path: Path, edge: float = 1.0) -> Path:
    box = trimesh.creation.box((edge, edge, edge))
    box.apply_translation((7, 8, 9))
    box.export(path)
    return path


def model(scene: Scene) -> list[Surface]:
    return [s for s in scene.surfaces if s.name not in ("floor", "wall")]


def points(scene: Scene) -> np.ndarray:
    return np.concatenate([s.vertices for s in model(scene)])


def refusal(path: Path) -> str:
    """The one line that `load_mesh` refuses `path` with."""
    with pytest.raises(InputError) as caught:
        load_mesh(path)
    message = str(caught.value)
    assert "\n" not in message and path.name in message
    return message


# --- Set down --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb", "OBJ"])
def test_a_cube_of_every_format_stands_on_the_floor(tmp_path, kind):
    path = cube(tmp_path / f"cube.{kind.lower()}")
    path = path.rename(tmp_path / f"cube.{kind}") if kind.isupper() else path
    scene = load_mesh(path, width=64, height=48)
    assert scene.name == "cube" and [s.name for s in scene.surfaces] == ["cube", "floor", "wall"]
    assert points(scene).min(axis=0) == pytest.approx((-0.5, 0, -0.5))
    assert points(scene).max(axis=0) == pytest.approx((0.5, 1, 0.5))
    assert len(model(scene)[0].faces) == 12
    assert model(scene)[0].material.albedo == 0.6
    assert model(scene)[0].normals is None
    assert (scene.camera.width, scene.camera.height) == (64, 48)
    assert any("1 m kept" in note for note in scene.notes)
    assert any("z taken as up" in note for note in scene.notes) == (kind == "stl")


def test_stl_is_turned_so_that_z_is_up_and_stays_right_handed(tmp_path):
    box = trimesh.creation.box((0.4, 0.6, 1.0))
    box.apply_translation((0, 0.3, 0))
    box.export(tmp_path / "tall.stl")
    scene = load_mesh(tmp_path / "tall.stl")
    assert np.ptp(points(scene), axis=0) == pytest.approx((0.4, 1.0, 0.6))
    surface = model(scene)[0]
    made = trimesh.Trimesh(surface.vertices, surface.faces)
    assert made.volume == pytest.approx(0.24), "faces still point outwards"


@pytest.mark.parametrize(
    ("edge", "expected", "note"),
    [(0.19, 1.0, "scaled by 5.26: 0.19 to 1.0 m"), (0.25, 0.25, "0.25 m kept"), (2.4, 2.4, "2.4 m kept")]
    + [(6.4, 1.0, "scaled by 0.156: 6.4 to 1.0 m"), (1000, 1.0, "scaled by 0.001: 1000 to 1.0 m")],
)
def test_size_is_kept_where_sensible_and_one_metre_otherwise(tmp_path, edge, expected, note):
    scene = load_mesh(cube(tmp_path / "c.ply", edge))
    assert np.ptp(points(scene), axis=0) == pytest.approx(expected, rel=1e-5)
    assert any(note in line for line in scene.notes)


def test_camera_looks_at_the_middle_from_the_front_a_little_aside_and_above(tmp_path):
    camera = load_mesh(cube(tmp_path / "c.obj")).camera
    towards = np.array((0, 0.5, 0)) - camera.origin
    distance = np.linalg.norm(towards)
    assert camera.rotation[:, 2] == pytest.approx(towards / distance)
    assert math.degrees(math.atan2(camera.origin[0], camera.origin[2])) == pytest.approx(30)
    assert math.degrees(math.asin(-towards[1] / distance)) == pytest.approx(15)
    assert camera.fov_deg == 40
    # the bounding sphere seen from there takes 70 % of the image height
    angular = math.tan(math.asin(math.sqrt(0.75) / distance)) * camera.focal_px
    assert 2 * angular == pytest.approx(0.7 * camera.height)


@pytest.mark.parametrize(("width", "height"), [(128, 96), (64, 64), (40, 160), (200, 20), (1, 1)])
def test_floor_and_wall_cover_the_whole_image(tmp_path, width, height):
    scene = load_mesh(cube(tmp_path / "c.obj"), width=width, height=height)
    floor, wall = scene.surfaces[-2:]
    wall_z = points(scene)[:, 2].min() - 1
    assert wall.vertices[:, 2] == pytest.approx(wall_z) and floor.vertices[:, 1] == pytest.approx(0)
    assert (np.ptp(floor.vertices[:, ::2], axis=0) >= 4).all()
    x, y = np.meshgrid(np.linspace(0, width, 41), np.linspace(0, height, 41))
    rays, origin = scene.camera.rays(x, y).reshape(-1, 3), scene.camera.origin
    for ray in rays:
        reached = [
            origin + ray * t
            for t in (-origin[1] / ray[1] if ray[1] < 0 else -1, (wall_z - origin[2]) / ray[2] if ray[2] < 0 else -1)
            if t > 0
        ]
        nearest = min(reached, key=lambda p: np.linalg.norm(p - origin))
        plate = floor if abs(nearest[1]) < 1e-9 else wall
        inside = nearest >= plate.vertices.min(axis=0) - 1e-9
        assert inside.all() and (nearest <= plate.vertices.max(axis=0) + 1e-9).all()


def test_backdrop_faces_the_room_and_shares_its_material(tmp_path):
    floor, wall = load_mesh(cube(tmp_path / "c.obj")).surfaces[-2:]
    assert floor.material is wall.material and 0.5 <= floor.material.albedo <= 0.6
    for plate, axis in ((floor, 1), (wall, 2)):
        a, b, c = plate.vertices[plate.faces].transpose(1, 0, 2)
        assert (np.cross(b - a, c - a)[:, axis] > 0).all()


def test_parts_keep_their_transforms_and_a_mirrored_one_its_outside(tmp_path):
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    group = trimesh.Scene()
    group.add_geometry(box, node_name="low")
    mirror = np.diag((-1.0, 1, 1, 1))
    mirror[1, 3] = 1
    group.add_geometry(box.copy(), node_name="high", transform=mirror)
    group.export(tmp_path / "two.glb")
    scene = load_mesh(tmp_path / "two.glb")
    assert len(model(scene)) == 2 and len({s.name for s in model(scene)}) == 2
    assert sorted(s.vertices[:, 1].min() for s in model(scene)) == pytest.approx([0, 1])
    assert [trimesh.Trimesh(s.vertices, s.faces).volume for s in model(scene)] == pytest.approx([0.125, 0.125])
    assert model(scene)[0].material is model(scene)[1].material


def test_polygons_are_triangulated_and_a_level_sheet_is_lifted_off_the_floor(tmp_path):
    sheet = "v 0 0 0\nv 0 0 1\nv 1 0 1\nv 1 0 0\nv 0.5 0 -0.5\nf 1 2 3 4 5\n"
    scene = load_mesh(write(tmp_path / "sheet.obj", sheet))
    assert len(model(scene)[0].faces) == 3
    assert points(scene)[:, 1] == pytest.approx(1e-3)
    assert any("lifted" in note for note in scene.notes)


def test_normals_of_the_file_are_kept(tmp_path):
    text = TRIANGLE + "vn 0 0 1\nvn 0 0.6 0.8\nf 1//1 2//1 3//2\n"
    normals = model(load_mesh(write(tmp_path / "n.obj", text)))[0].normals
    assert sorted(normals.tolist()) == [[0, 0, 1], [0, 0, 1], pytest.approx([0, 0.6, 0.8])]


@pytest.mark.parametrize("none", ["0 0 0", "nan nan nan"])
def test_a_normal_of_no_direction_leaves_the_others_as_they_are(tmp_path, none):
    """It took all of them from the mesh, even that of a vertex that no face uses."""
    head = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
    )
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    rows = f"0 0 0 {none}\n1 0 0 0.6 0 0.8\n1 1 0 0 0.6 0.8\n0 1 0 0 0 1\n9 9 9 {none}\n3 0 1 2\n3 0 2 3\n"
    normals = model(load_mesh(write(tmp_path / "n.ply", head + faces + rows)))[0].normals
    assert normals == pytest.approx(np.array([(0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8), (0, 0, 1)]), abs=1e-6)


# --- Colours ---------------------------------------------------------------------------------------------------------


def textured_obj(folder: Path, mtl: str) -> Path:
    write(folder / "wood.mtl", mtl)
    return write(folder / "quad.obj", "mtllib wood.mtl\n" + QUAD + "usemtl old wood\nf 1/1 2/2 3/3 4/4\n")


def test_obj_texture_becomes_the_albedo_the_right_way_up(tmp_path):
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[0] = 188  # the top row: sRGB 188 is 0.503 linear
    Image.fromarray(pixels).save(tmp_path / "old wood.png")
    scene = load_mesh(textured_obj(tmp_path, "newmtl old wood\nKd 1 1 1\nmap_Kd old wood.png\n"))
    surface = model(scene)[0]
    assert isinstance(surface.material.albedo, Texture)
    assert surface.material.albedo.image[0] == pytest.approx(0.5029, abs=1e-3)
    assert surface.material.albedo.image[1:] == pytest.approx(0)
    highest = surface.vertices[:, 1].argmax()
    assert surface.uv[highest, 1] == pytest.approx(1), "v is upwards, as the texture's top row is"


def test_map_options_and_backslashes(tmp_path):
    (tmp_path / "maps").mkdir()
    Image.fromarray(np.full((2, 2, 3), 255, np.uint8)).save(tmp_path / "maps/w.png")
    scene = load_mesh(textured_obj(tmp_path, "newmtl old wood\nmap_Kd -s 1 1 1 maps\\w.png\n"))
    assert model(scene)[0].material.albedo.image == pytest.approx(1)


def test_obj_colour_is_the_luminance_of_kd_as_it_is(tmp_path):
    scene = load_mesh(textured_obj(tmp_path, "newmtl old wood\nKd 1 0 0.5\n"))
    assert model(scene)[0].material.albedo == pytest.approx(0.2126 + 0.0722 * 0.5)


def test_obj_without_its_material_file_is_noted(tmp_path):
    path = textured_obj(tmp_path, "")
    (tmp_path / "wood.mtl").unlink()
    scene = load_mesh(path)
    assert model(scene)[0].material.albedo == 0.6
    assert any("wood.mtl not found" in note for note in scene.notes)


def test_several_materials_make_several_surfaces(tmp_path):
    write(tmp_path / "m.mtl", "newmtl a\nKd 1 1 1\nnewmtl b\nKd 0 0 0\nnewmtl c\nKd 1 1 1\n")
    faces = "usemtl a\nf 1 2 3\nusemtl b\nf 1 2 4\nusemtl c\nf 2 3 4\n"
    scene = load_mesh(write(tmp_path / "m.obj", "mtllib m.mtl\n" + TRIANGLE + "v 0 0 1\n" + faces))
    albedo = {s.name: s.material.albedo for s in model(scene)}
    assert albedo == {"a": pytest.approx(1), "b": 0.0, "c": pytest.approx(1)}
    assert len({id(s.material) for s in model(scene)}) == 2


def test_missing_or_broken_textures_are_refused_by_name(tmp_path):
    path = textured_obj(tmp_path, "newmtl old wood\nmap_Kd gone.png\n")
    with pytest.raises(InputError, match=r"^[^\n]*wood\.mtl: texture [^\n]*'gone\.png' not found [^\n]*$"):
        load_mesh(path)
    write(tmp_path / "gone.png", "not an image")
    with pytest.raises(InputError, match=r"^[^\n]*gone\.png: [^\n]*$"):
        load_mesh(path)
    textured_obj(tmp_path, "newmtl old wood\nKd red\n")
    with pytest.raises(InputError, match=r"^[^\n]*wood\.mtl: Kd 'red', expected three numbers$"):
        load_mesh(path)


def test_glb_base_colour_and_texture(tmp_path):
    box = trimesh.creation.box()
    paint = trimesh.visual.material.PBRMaterial(baseColorFactor=(0, 1.0, 0, 1.0))
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] + 0.5, material=paint)
    box.export(tmp_path / "green.glb")
    assert model(load_mesh(tmp_path / "green.glb"))[0].material.albedo == pytest.approx(0.7152)
    paint.baseColorTexture = Image.fromarray(np.full((2, 2, 3), 188, np.uint8))
    box.export(tmp_path / "image.glb")
    albedo = model(load_mesh(tmp_path / "image.glb"))[0].material.albedo
    assert albedo.image == pytest.approx(0.7152 * 0.5029, abs=1e-3)


@pytest.mark.parametrize(("kind", "linear"), [("ply", 0.5029), ("glb", 188 / 255)])
def test_vertex_colours_become_one_mean_albedo(tmp_path, kind, linear):
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.full((8, 4), (188, 188, 188, 255), np.uint8)
    box.export(tmp_path / f"c.{kind}")
    scene = load_mesh(tmp_path / f"c.{kind}")
    assert model(scene)[0].material.albedo == pytest.approx(linear, abs=1e-3)
    assert any("mean albedo" in note for note in scene.notes)


# --- Repairs and refusals --------------------------------------------------------------------------------------------


def test_useless_faces_and_vertices_are_dropped_and_counted(tmp_path):
    text = TRIANGLE + "v 2 0 0\nv 9 9 9\nf 1 2 3\nf 1 3 2\nf 1 2 4\nf 1 1 2\n"
    box = trimesh.Trimesh(
        [(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (90, 9, 9)],
        [(0, 1, 2), (0, 2, 1), (0, 1, 3), (0, 0, 1)],
        process=False,
    )
    box.export(tmp_path / "untidy.ply")
    for path in (write(tmp_path / "untidy.obj", text), tmp_path / "untidy.ply"):
        scene = load_mesh(path)
        assert len(model(scene)[0].faces) == 1 and len(points(scene)) == 3
        assert "untidy: degenerate faces dropped: 2" in scene.notes
        assert "untidy: duplicate faces dropped: 1" in scene.notes
        assert "largest extent 2 m kept" in scene.notes, "a vertex that no face uses does not decide the size"
    assert "untidy: unreferenced vertices dropped: 1" in scene.notes


def test_a_clean_mesh_has_no_repair_notes(tmp_path):
    notes = load_mesh(cube(tmp_path / "c.obj")).notes
    assert not any("dropped" in note for note in notes)


def test_trimesh_says_nothing_on_stdout(tmp_path, capsys):
    load_mesh(cube(tmp_path / "c.glb"))
    refusal(write(tmp_path / "broken.glb", "nonsense"))
    assert capsys.readouterr().out == ""


def test_refuses_a_missing_file_a_folder_and_an_unknown_kind(tmp_path):
    assert "not found" in refusal(tmp_path / "gone.obj")
    (tmp_path / "folder.obj").mkdir()
    assert "not found" in refusal(tmp_path / "folder.obj")
    assert ".obj .ply .stl .glb" in refusal(write(tmp_path / "cube.fbx", "x"))
    assert "(none)" in refusal(write(tmp_path / "cube", "x"))


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("nan.obj", TRIANGLE + "v nan 0 0\nf 1 2 4\n", "1 of 3 vertices of nan.obj are NaN"),
        ("inf.obj", TRIANGLE + "v inf 0 0\nf 1 2 4\n", "NaN or infinite"),
        ("points.obj", TRIANGLE, "no faces"),
        ("lines.obj", TRIANGLE + "l 1 2 3\n", "no faces"),
        ("empty.obj", "", "empty"),
        ("comment.obj", "# nothing\n", "empty"),
        ("index.obj", TRIANGLE + "f 1 2 9\n", "broken .obj"),
        ("negative.obj", TRIANGLE + "f 1 2 -9\n", "broken .obj"),
        ("word.obj", TRIANGLE + "f 1 2 x\n", "broken .obj"),
        ("flat.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "not x y z"),
        ("needle.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "all of its faces are degenerate"),
        ("dot.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "largest extent is 0"),
        ("vast.obj", "v -1e308 0 0\nv 1e308 0 0\nv 0 1 0\nf 1 2 3\n", "1e+308, expected 1e+12 at the most"),
        ("empty.ply", "", "empty"),
        ("garbage.ply", "no mesh\n", "broken .ply"),
        ("garbage.stl", "no mesh\n", "is no STL"),
        ("empty.stl", "", "empty"),
        ("garbage.glb", "no mesh, but long enough for a header\n", "broken .glb"),
        ("empty.glb", "", "empty"),
    ],
)
def test_refuses_bad_content_in_one_line(tmp_path, name, text, words):
    assert words in refusal(write(tmp_path / name, text))


@pytest.mark.parametrize("kind", ["ply", "stl", "glb"])
@pytest.mark.parametrize("fraction", [0.3, 0.7, 0.95])
def test_refuses_a_truncated_file(tmp_path, kind, fraction):
    path = cube(tmp_path / f"cut.{kind}")
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    refusal(path)


def test_refuses_nan_in_binary_files_and_point_clouds(tmp_path):
    box = trimesh.creation.box()
    vertices = box.vertices.copy()
    vertices[3, 1] = math.nan
    for kind in ("ply", "stl"):
        trimesh.Trimesh(vertices, box.faces, process=False).export(tmp_path / f"nan.{kind}")
        assert "NaN" in refusal(tmp_path / f"nan.{kind}")
    trimesh.PointCloud(box.vertices).export(tmp_path / "cloud.ply")
    assert "no faces" in refusal(tmp_path / "cloud.ply")


def test_reads_old_encodings_in_comments(tmp_path):
    (tmp_path / "latin.obj").write_bytes("# façade\n".encode("latin-1") + (TRIANGLE + "f 1 2 3\n").encode())
    assert load_mesh(tmp_path / "latin.obj").triangles == 5


@pytest.mark.parametrize("marked", ["a.obj", "a.mtl", "a.ply", "a.stl"])
def test_a_byte_order_mark_changes_nothing(tmp_path, marked):
    """It hid the first word of its file: the first vertex of a mesh, or the first material, was lost."""
    trimesh.creation.box((1, 1, 0.5)).export(tmp_path / "a.ply", encoding="ascii")
    trimesh.creation.box((1, 1, 0.5)).export(tmp_path / "a.stl", file_type="stl_ascii")
    write(tmp_path / "a.mtl", "newmtl a\nKd 0.25 0.25 0.25\n")
    path = write(tmp_path / "a.obj", "v -1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nmtllib a.mtl\nusemtl a\nf 1 2 3\n")
    path = path if marked == "a.mtl" else tmp_path / marked
    scene = load_mesh(path)
    (tmp_path / marked).write_bytes(b"\xef\xbb\xbf" + (tmp_path / marked).read_bytes())
    assert load_mesh(path).digest() == scene.digest()


def test_a_word_in_a_normal_of_a_text_stl_is_passed_over_in_silence(tmp_path):
    """Keep stderr silent: normals are not used, and without a handler a traceback of trimesh went there."""
    text = trimesh.exchange.stl.export_stl_ascii(trimesh.creation.box())
    write(tmp_path / "a.stl", text.replace("facet normal ", "facet normal up", 1))
    code = "import sys; from scenes.io.mesh_formats.meshes import load_mesh; print(load_mesh(sys.argv[1]).triangles)"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.stl")], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("16\n", "")


# --- Well-known models -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "faces", "scaled"), [("spot", 5856, False), ("suzanne", 968, True), ("teapot", 6320, True)]
)
def test_well_known_models(name, faces, scaled):
    path = DATA / "meshes" / f"{name}.obj"
    if not path.is_file():
        pytest.skip(f"{path.name} not there: set SCENE2SPAD_DATA to the folder that holds meshes/")
    scene = load_mesh(path)
    assert points(scene)[:, 1].min() == pytest.approx(0, abs=1e-9)
    assert abs(sum(len(s.faces) for s in model(scene)) - faces) <= 5
    assert (np.ptp(points(scene), axis=0).max() == pytest.approx(1)) == scaled
