"""Scenes by name and by file: the analytic ones hit by their closed form, the rest by their right reader."""

import math
import subprocess
import sys

import numpy as np
import pytest

from scenes import InputError
from scenes.library.catalog import SCENES, load_scene


def size(scene):
    return scene.camera.width, scene.camera.height


def areas(surface):
    a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("name", SCENES)
def test_every_name_gives_a_scene_of_that_name_and_size(name):
    scene = load_scene(name)
    assert scene.name == name and size(scene) == (128, 96)
    assert SCENES[name] and "\n" not in SCENES[name]
    assert load_scene(name).digest() == scene.digest()


def test_one_size_alone_keeps_the_proportions():
    assert size(load_scene("plane", width=64)) == (64, 48)
    assert size(load_scene("plane", height=24)) == (32, 24)
    assert size(load_scene("plane", width=20, height=50)) == (20, 50)
    assert size(load_scene("living-room", width=32)) == (32, 24)


def test_only_procedural_scenes_follow_the_seed():
    assert load_scene("living-room", seed=1).digest() != load_scene("living-room").digest()
    assert load_scene("corner", seed=1).digest() == load_scene("corner").digest()


def test_plane_is_frontal_at_three_metres_and_fills_the_image():
    scene = load_scene("plane", width=20, height=100)
    (wall,) = scene.surfaces
    assert scene.camera.origin.tolist() == [0, 0, 0]
    assert wall.vertices[:, 2] == pytest.approx(-3) and (areas(wall)[:, 2] > 0).all()
    assert wall.material.kind == "diffuse" and wall.material.albedo == 0.5
    rays = scene.camera.rays()
    reach = np.abs(rays[..., :2] / rays[..., 2:]).max() * 3
    assert reach < wall.vertices[:, :2].max()


def test_sphere_has_its_radius_and_outward_normals():
    (ball,) = load_scene("sphere").surfaces
    centre = np.array((0, 0, -3))
    assert np.linalg.norm(ball.vertices - centre, axis=1) == pytest.approx(0.5)
    assert ball.normals == pytest.approx((ball.vertices - centre) / 0.5)
    assert np.linalg.norm(areas(ball), axis=1).sum() == pytest.approx(math.pi, rel=1e-3)
    assert load_scene("sphere").triangles == len(ball.faces)


def test_corner_is_a_right_angle_open_to_the_camera():
    left, right = load_scene("corner").surfaces
    assert left.material is right.material
    normals = [areas(s).sum(axis=0) for s in (left, right)]
    assert [np.linalg.norm(n) for n in normals] == pytest.approx([8, 8])
    assert normals[0] @ normals[1] == pytest.approx(0, abs=1e-9)
    assert normals[0] / 8 == pytest.approx((math.sqrt(0.5), 0, math.sqrt(0.5)))
    edge = {tuple(v) for v in np.round(left.vertices, 9)} & {tuple(v) for v in np.round(right.vertices, 9)}
    assert edge == {(0, -2, -3), (0, 2, -3)}


def test_mesh_files_are_found_by_extension(tmp_path):
    path = tmp_path / "triangle.OBJ"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert size(load_scene(str(path))) == (128, 96)
    scene = load_scene(path, height=24)
    assert scene.name == "triangle" and size(scene) == (32, 24)


def test_xml_keeps_its_film_size_unless_told(tmp_path):
    path = tmp_path / "room.xml"
    film = '<film type="hdrfilm"><integer name="width" value="40"/><integer name="height" value="20"/></film>'
    sensor = f'<sensor type="perspective"><float name="fov" value="45"/>{film}</sensor>'
    path.write_text(f'<scene version="3.0.0">{sensor}<shape type="sphere"/></scene>')
    assert size(load_scene(str(path))) == (40, 20)
    assert size(load_scene(str(path), width=20)) == (20, 10)


@pytest.mark.parametrize("spec", ["kitchen", "", "scene.fbx", "living_room", "obj"])
def test_unknown_names_and_extensions_list_what_there_is(spec):
    with pytest.raises(InputError) as caught:
        load_scene(spec)
    message = str(caught.value)
    assert "\n" not in message and repr(spec) in message
    assert all(word in message for word in (*SCENES, ".obj", ".ply", ".stl", ".glb", ".xml"))


@pytest.mark.parametrize("spec", ["gone.obj", "gone.xml"])
def test_missing_files_are_one_line(tmp_path, spec):
    with pytest.raises(InputError, match=r"^[^\n]*gone\.[^\n]*$"):
        load_scene(str(tmp_path / spec))


@pytest.mark.parametrize(("width", "height"), [(0, None), (None, -1), (64, 0), (99999, 10)])
def test_bad_sizes_are_one_line(width, height):
    for spec in ("plane", "living-room"):
        with pytest.raises(InputError, match=r"^camera (width|height) [^\n]*$"):
            load_scene(spec, width=width, height=height)


def test_no_mesh_library_is_loaded_for_a_named_scene():
    program = (
        "import sys, scenes.library.catalog as c; c.load_scene('plane'); print([m for m in %r if m in sys.modules])"
    )
    heavy = ["trimesh", "mitsuba", "torch", "drjit", "PIL"]
    result = subprocess.run([sys.executable, "-c", program % heavy], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("face", ["3 0 1 9", "3 0 1 -1"])
def test_faces_that_refer_to_nothing_are_refused_in_one_line(tmp_path, face):
    ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    ply += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    (tmp_path / "odd.ply").write_text(ply + face + "\n")
    shape = "<shape type='ply'><string name='filename' value='odd.ply'/></shape>"
    camera = "<sensor type='perspective'><float name='fov' value='40'/></sensor>"
    (tmp_path / "odd.xml").write_text(f"<scene version='3.0.0'>{camera}{shape}</scene>")
    for name in ("odd.ply", "odd.xml"):
        with pytest.raises(InputError, match="refers to vertex"):
            load_scene(str(tmp_path / name))


def test_small_files_do_not_become_large_work(tmp_path):
    """Includes that double and defaults that multiply end in one line."""
    for level in range(12):
        twice = f"<include filename='i{level + 1}.xml'/>" * 2
        (tmp_path / f"i{level}.xml").write_text(f"<scene version='3.0.0'>{twice}</scene>")
    (tmp_path / "i12.xml").write_text("<scene version='3.0.0'></scene>")
    with pytest.raises(InputError, match="more than 256 includes"):
        load_scene(str(tmp_path / "i0.xml"))
    grows = "".join(f"<default name='a{i + 1}' value='{f'$a{i} ' * 10}'/>" for i in range(9))
    (tmp_path / "grow.xml").write_text(f"<scene version='3.0.0'><default name='a0' value='x'/>{grows}</scene>")
    with pytest.raises(InputError, match="characters"):
        load_scene(str(tmp_path / "grow.xml"))


def test_a_material_library_with_tabs_is_read_and_one_that_is_missing_is_noted(tmp_path):
    (tmp_path / "one.mtl").write_text("newmtl\ta\nKd\t1 1 1\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    (tmp_path / "m.obj").write_text(f"mtllib one.mtl\nmtllib two.mtl\n{corners}usemtl a\nf 1 2 3\n")
    scene = load_scene(str(tmp_path / "m.obj"))
    assert scene.surfaces[0].material.albedo == 1 and any(
        "material file two.mtl not found" in note for note in scene.notes
    )
    (tmp_path / "m.obj").write_text(f"mtllib \n{corners}f 1 2 3\n")
    assert load_scene(str(tmp_path / "m.obj")).surfaces[0].material.albedo == 0.6


@pytest.mark.parametrize("family", ["rooms", "clutter"])
def test_views_of_endless_sets_take_no_zero_and_no_negative_seed(family):
    assert size(load_scene(f"{family}/val/0", height=24)) == (24, 24)
    for width, height in ((0, None), (16, 0)):
        with pytest.raises(InputError, match=r"^camera (width|height) 0 [^\n]*$"):
            load_scene(f"{family}/val/0", width=width, height=height)
    with pytest.raises(InputError, match=r"seed -1 is not a whole number of 0 or more"):
        load_scene(f"{family}/val/0", seed=-1)
