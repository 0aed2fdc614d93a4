"""Faces of a .ply as programs write them: of any numbers of corners, in any byte order, with what corners carry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from scenes import InputError, Scene, Surface, Texture
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.textures import srgb_to_linear
from scenes.placing import Placing
from tests.scenes.xml_files import load

AS_FILE = Placing(scale=1, bare=True)
TYPES = {"uchar": "u1", "ushort": "u2", "int": "i4", "uint": "u4", "int64": "i8", "uint64": "u8"}
TYPES |= {"float": "f4", "double": "f8"}
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# A box of 1 x 2 x 3 whose sides are two triangles, three quads and a side of a dented hexagon and what it leaves.
POINTS = np.array([(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 3)] + [(0, 0.5, 1), (0, 1.5, 1)], float)
SIDES = [(4, 6, 7), (4, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3), (0, 8, 9, 2), (0, 1, 3, 2, 9, 8)]
VOLUME, AREA = 6.0, 22.0


def ply(
    kind: str, elements: Sequence[tuple[str, Sequence[str], Sequence[Sequence[object]]]], comments: str = ""
) -> bytes:
    """Write elements by name, properties ("float x", or "list uchar int vertex_indices") and rows, whose lists are
    tuples."""
    header, body = f"ply\nformat {kind} 1.0\n{comments}", b""
    for name, properties, rows in elements:
        header += f"element {name} {len(rows)}\n" + "".join(f"property {one}\n" for one in properties)
        for row in rows:
            flat = [[len(one), *one] if isinstance(one, tuple) else [one] for one in row]
            if kind == "ascii":
                body += " ".join(str(number) for one in flat for number in one).encode() + b"\n"
                continue
            for one, words in zip(flat, map(str.split, properties), strict=True):
                types = [words[1], *[words[2]] * (len(one) - 1)] if words[0] == "list" else [words[0]]
                pairs = zip(one, types, strict=True)
                body += b"".join(np.array(value, ORDERS[kind] + TYPES[each]).tobytes() for value, each in pairs)
    return f"{header}end_header\n".encode() + body


def vertices(points: np.ndarray = POINTS) -> tuple[str, list[str], list[list[float]]]:
    return "vertex", [f"float {axis}" for axis in "xyz"], points.tolist()


def area(surface: Surface) -> float:
    a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def volume(surface: Surface) -> float:
    """Return the volume that faces enclose, below 0 where they are inside out."""
    return float(np.linalg.det(surface.vertices[surface.faces]).sum() / 6)


def written(path: Path, content: bytes) -> Scene:
    path.write_bytes(content)
    return load_mesh(path, placing=AS_FILE)


def refused(path: Path, content: bytes) -> str:
    with pytest.raises(InputError) as caught:
        written(path, content)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("kind", ORDERS)
@pytest.mark.parametrize(("count", "index"), [("uchar", "int"), ("ushort", "uchar"), ("int", "uint"), ("int64", "int")])
def test_a_body_of_mixed_polygons_has_the_volume_and_area_of_the_same_obj(
    tmp_path: Path, kind: str, count: str, index: str
) -> None:
    faces = "face", [f"list {count} {index} vertex_indices"], [[side] for side in SIDES]
    (found,) = written(tmp_path / "a.ply", ply(kind, [vertices(), faces])).surfaces
    lines = [f"v {x} {y} {z}" for x, y, z in POINTS.tolist()]
    lines += ["f " + " ".join(str(corner + 1) for corner in side) for side in SIDES]
    (same,) = written(tmp_path / "a.obj", "\n".join(lines).encode()).surfaces
    assert volume(found) == pytest.approx(VOLUME) == volume(same)
    assert area(found) == pytest.approx(AREA) == area(same)
    assert trimesh.Trimesh(found.vertices, found.faces).is_watertight


@pytest.mark.parametrize("kind", ORDERS)
@pytest.mark.parametrize("name", ["vertex_index", "vertex_indices"])
def test_other_properties_and_elements_around_the_faces_change_nothing(tmp_path: Path, kind: str, name: str) -> None:
    """A number before the list and others behind it, a list of its own, an element before and one after."""
    rows = [[7, side, 0.5, tuple(range(len(side) % 3)), 200] for side in SIDES]
    properties = ["int flags", f"list uchar int {name}", "float quality", "list uchar double marks", "uchar tag"]
    camera = "camera", ["float fov", "list uchar int viewport"], [[40.0, (0, 0, 640, 480)], [50.0, ()]]
    edges = "edge", ["int vertex1", "int vertex2", "uchar crease"], [[0, 1, 255], [1, 2, 0]]
    comments = "comment Created by a program\nobj_info num_cols 512\n"
    content = ply(kind, [camera, vertices(), ("face", properties, rows), edges], comments)
    (found,) = written(tmp_path / "a.ply", content).surfaces
    assert (volume(found), area(found)) == (pytest.approx(VOLUME), pytest.approx(AREA))


def test_line_ends_of_any_kind_and_blank_lines_change_nothing(tmp_path: Path) -> None:
    content = ply("ascii", [vertices(), ("face", ["list uchar int vertex_indices"], [[side] for side in SIDES])])
    for end in (b"\r\n", b"\r", b" \n", b"\n\n"):
        changed = content.replace(b"\n", end) if end != b"\n\n" else content.replace(b"header\n", b"header\n\n") + end
        assert volume(*written(tmp_path / "a.ply", changed).surfaces) == pytest.approx(VOLUME)
    head, body = ply("binary_big_endian", [vertices(), ("face", ["list uchar int v"], [[one] for one in SIDES])]).split(
        b"end_header\n"
    )
    changed = head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body
    assert volume(*written(tmp_path / "a.ply", changed).surfaces) == pytest.approx(VOLUME)


def test_faces_of_two_corners_are_no_surface(tmp_path: Path) -> None:
    rows = [[side] for side in ((0, 1), *SIDES, ())]
    content = ply("binary_little_endian", [vertices(), ("face", ["list uchar int vertex_indices"], rows)])
    assert area(*written(tmp_path / "a.ply", content).surfaces) == pytest.approx(AREA)
    alone = ply("binary_little_endian", [vertices(), ("face", ["list uchar int vertex_indices"], [[(0, 1)]])])
    assert "has no faces" in refused(tmp_path / "b.ply", alone)


@pytest.mark.parametrize("kind", ORDERS)
def test_strips_are_the_triangles_that_they_stand_for(tmp_path: Path, kind: str) -> None:
    """A strip around a tetrahedron, ended by -1, and two more of a second one, of which the last has a joint."""
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    strips = [[(0, 2, 1, 3, 0, 2, -1, 4, 6, 5, 7)], [(5, 7, 4, 4, 6, 7)]]
    element = "tristrips", ["list int int vertex_indices"], strips
    content = ply(kind, [vertices(np.concatenate((points, points + 2))), element])
    scene = written(tmp_path / "a.ply", content)
    (found,) = scene.surfaces
    assert len(found.faces) == 8 and not any("degenerate" in note for note in scene.notes)
    assert volume(found) == pytest.approx(2 / 6)
    both = ply(kind, [vertices(points), ("face", ["list uchar int vertex_index"], [[(0, 1, 2)]]), element])
    assert refused(tmp_path / "b.ply", both).endswith(
        "holds faces and triangle strips (tristrips); export it with faces alone"
    )


# --- What faces and corners carry ------------------------------------------------------------------------------------

ELL = np.array([(2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)], float)  # of area 3
SHEET = np.concatenate((ELL, [(2, 2)]))  # a square of 2 x 2: the L, and a square that shares three corners with it


def sheet() -> tuple[str, list[str], list[list[float]]]:
    """Return vertices with normals and colours."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    rows = [[x, y, 0, 0.6, 0, 0.8, 255, 255, 255] for x, y in SHEET.tolist()]
    return "vertex", [f"float {name}" for name in names] + ["uchar red", "uchar green", "uchar blue"], rows


def mapped(side: Sequence[int], shift: float) -> tuple[float, ...]:
    """Return coordinates at each corner: its place, in units of 4, moved by `shift`."""
    return tuple((SHEET[[*side]] / 4 + (shift, 0)).ravel().tolist())


@pytest.mark.parametrize("kind", ORDERS)
@pytest.mark.parametrize("first", [0, 2, 3])
def test_coordinates_per_corner_keep_area_place_and_normals(tmp_path: Path, kind: str, first: int) -> None:
    """The two faces have other coordinates at the corners where they meet."""
    Image.new("RGB", (4, 4), (128, 128, 128)).save(tmp_path / "skin.png")
    sides = [tuple(np.roll(np.arange(6), first).tolist()), (2, 1, 6, 3)]
    properties = ["list uchar int vertex_indices", "list uchar float texcoord", "uchar flags"]
    rows = [[side, mapped(side, shift), 1] for side, shift in zip(sides, (0, 0.5), strict=True)]
    content = ply(kind, [sheet(), ("face", properties, rows)], "comment TextureFile skin.png\n")
    (found,) = written(tmp_path / "a.ply", content).surfaces
    assert area(found) == pytest.approx(4)
    centres = found.vertices[found.faces].mean(axis=1)[:, :2] + 1  # it was set down in the middle, of x
    centres[:, 1] -= 1
    moved = found.uv[found.faces].mean(axis=1) - centres / 4
    beyond = (centres > 1).all(axis=1)
    np.testing.assert_allclose(moved, np.column_stack((np.where(beyond, 0.5, 0), 0 * beyond)), atol=1e-6)
    np.testing.assert_allclose(found.normals, np.tile((0.6, 0, 0.8), (len(found.vertices), 1)), atol=1e-6)
    assert len(found.vertices) == 7 + 3, "vertices where the coordinates agree are there once"


def test_each_face_has_the_texture_of_its_number(tmp_path: Path) -> None:
    """Faces without coordinates, or of number -1, have the mean of the colours."""
    for name, level in (("a b.png", 64), ("c.png", 128)):
        Image.new("RGB", (4, 4), (level,) * 3).save(tmp_path / name)
    rows = [[(0, 1, 2), mapped((0, 1, 2), 0), 1], [(2, 3, 4), mapped((2, 3, 4), 0), 0], [(4, 5, 2), (), 0]]
    rows += [[(5, 0, 2), (0,) * 6, -1]]
    properties = ["list uchar int vertex_indices", "list uchar float texcoord", "int texnumber"]
    comments = "comment TextureFile a b.png\ncomment TextureFile c.png\n"
    scene = written(tmp_path / "a.ply", ply("binary_little_endian", [sheet(), ("face", properties, rows)], comments))
    plain, first, second = (one.material.albedo for one in scene.surfaces)
    assert plain == pytest.approx(1) and [len(one.faces) for one in scene.surfaces] == [2, 1, 1]
    assert isinstance(first, Texture) and first.image == pytest.approx(np.full((4, 4), srgb_to_linear(64 / 255)))
    assert isinstance(second, Texture) and second.image == pytest.approx(np.full((4, 4), srgb_to_linear(128 / 255)))
    assert sum(map(area, scene.surfaces)) == pytest.approx(3)
    rows[0][2] = 2
    content = ply("ascii", [sheet(), ("face", properties, rows)], comments)
    assert "texnumber is 2, 2 textures are named" in refused(tmp_path / "a.ply", content)
    content = ply("ascii", [sheet(), ("face", properties[:2], [row[:2] for row in rows])], comments)
    assert "names 2 textures, and no texnumber" in refused(tmp_path / "a.ply", content)
    rows[0][1] = (0, 0, 1, 0)
    content = ply("ascii", [sheet(), ("face", properties, rows)], comments)
    assert "a face of 3 corners has 4 numbers as its texcoord" in refused(tmp_path / "a.ply", content)
    rows[0][2] = 0.5
    content = ply("ascii", [sheet(), ("face", [*properties[:2], "float texnumber"], rows)], comments)
    assert "a face's texnumber is 0.5, expected a whole number" in refused(tmp_path / "a.ply", content)


def test_coordinates_of_vertices_stay_with_the_faces_of_each_texture(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        Image.new("RGB", (4, 4), (128, 128, 128)).save(tmp_path / name)
    points = "vertex", [f"float {name}" for name in "xyzst"], [[x, y, 0, x / 2, y / 2] for x, y in SHEET.tolist()]
    rows = [[(2, 1, 6, 3), 1], [(5, 0, 1, 2), 0], [(5, 2, 3, 4), 0]]
    faces = "face", ["list uchar int vertex_indices", "int texnumber"], rows
    comments = "comment TextureFile a.png\ncomment TextureFile b.png\n"
    scene = written(tmp_path / "a.ply", ply("binary_big_endian", [points, faces], comments))
    assert [len(one.vertices) for one in scene.surfaces] == [6, 4]
    assert not any("dropped" in note for note in scene.notes)
    for one in scene.surfaces:
        np.testing.assert_allclose(one.uv, (one.vertices[:, :2] + (1, 0)) / 2, atol=1e-6)


def test_coordinates_per_corner_leave_the_colours_of_vertices(tmp_path: Path) -> None:
    """Vertices are there once for each of their coordinates, and colours still count by area."""
    name, properties, points = sheet()
    points = [[*row[:6], *[255 * (number in (0, 1))] * 3] for number, row in enumerate(points)]
    rows = [[(0, 1, 2), mapped((0, 1, 2), 0)], [(2, 3, 4, 5), mapped((2, 3, 4, 5), 0.5)], [(5, 0, 2), (0.5,) * 6]]
    lists = ["list uchar int vertex_indices", "list uchar float texcoord"]
    split, whole = (
        written(
            tmp_path / "a.ply", ply("ascii", [(name, properties, points), ("face", lists[:of], [r[:of] for r in rows])])
        )
        for of in (2, 1)
    )
    assert len(split.surfaces[0].vertices) > len(whole.surfaces[0].vertices)
    assert split.surfaces[0].material.albedo == pytest.approx(whole.surfaces[0].material.albedo, abs=1e-6)


def test_more_triangles_than_a_scene_takes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scenes.io.mesh_formats.ply_meshes.MAX_TRIANGLES", 15)
    content = ply("binary_little_endian", [vertices(), ("face", ["list uchar int v"], [[one] for one in SIDES])])
    assert refused(tmp_path / "a.ply", content).endswith("a.ply: 16 triangles, expected 15 at most")


def test_numbers_of_textures_that_are_not_named_part_nothing(tmp_path: Path) -> None:
    properties = ["list uchar int vertex_indices", "int texnumber"]
    rows = [[(0, 1, 2), 3], [(2, 3, 4), 0], [(4, 5, 2), -1], [(5, 0, 2), 7]]
    (found,) = written(tmp_path / "a.ply", ply("binary_little_endian", [sheet(), ("face", properties, rows)])).surfaces
    assert area(found) == pytest.approx(3)


def test_empty_lists_of_coordinates_leave_those_of_vertices(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (128, 128, 128)).save(tmp_path / "skin.png")
    points = "vertex", [f"float {name}" for name in "xyzst"], [[x, y, 0, x / 2, y / 2] for x, y in SHEET.tolist()]
    faces = "face", ["list uchar int vertex_indices", "list uchar float texcoord"], [[(0, 1, 2, 3, 4, 5), ()]]
    (found,) = written(tmp_path / "a.ply", ply("ascii", [points, faces], "comment TextureFile skin.png\n")).surfaces
    assert isinstance(found.material.albedo, Texture) and found.uv is not None


@pytest.mark.parametrize("kind", ORDERS)
def test_colours_of_polygons_count_by_their_area(tmp_path: Path, kind: str) -> None:
    """The L is white, the square that is a third of it black."""
    properties = ["list uchar int vertex_indices", "uchar red", "uchar green", "uchar blue"]
    rows = [[(0, 1, 2, 3, 4, 5), 255, 255, 255], [(2, 1, 6, 3), 0, 0, 0]]
    faces = "face", properties, rows
    (found,) = written(tmp_path / "a.ply", ply(kind, [vertices(np.pad(SHEET, ((0, 0), (0, 1)))), faces])).surfaces
    assert found.material.albedo == pytest.approx(3 / 4, abs=1e-6)


def test_a_list_that_is_none_is_refused(tmp_path: Path) -> None:
    def face(kind: str, indices: tuple[float, ...]) -> bytes:
        return ply("ascii", [vertices(), ("face", [f"list uchar {kind} vertex_indices"], [[indices], [SIDES[2]]])])

    assert "refers to vertex 99" in refused(tmp_path / "a.ply", face("int", (0, 1, 99)))
    assert "refers to vertex -1" in refused(tmp_path / "a.ply", face("int", (0, 1, -1)))
    assert "a face's vertex is 2.5, expected a whole number" in refused(tmp_path / "a.ply", face("float", (0, 1, 2.5)))
    cut = ply("binary_little_endian", [vertices(), ("face", ["list char int vertex_indices"], [])])
    cut = cut.replace(b"face 0", b"face 2") + b"\xff" + bytes(4)
    assert "a list of -1 values" in refused(tmp_path / "a.ply", cut)
    bare = ply("ascii", [vertices(), ("face", ["int vertex"], [[3]])])
    assert "its faces have no vertex_indices, but no lists" in refused(tmp_path / "a.ply", bare)


def test_polygons_of_a_mitsuba_scene_are_fans_as_in_an_obj_of_one(tmp_path: Path) -> None:
    faces = "face", ["list uchar int v"], [[one] for one in SIDES]
    textures = "comment TextureFile a.png\ncomment TextureFile b.png\n"  # at which Mitsuba does not look
    (tmp_path / "a.ply").write_bytes(ply("binary_little_endian", [vertices(), faces], textures))
    (found,) = load(
        tmp_path,
        '<shape type="ply"><string name="filename" value="a.ply"/><boolean name="face_normals" value="true"/></shape>',
    ).surfaces
    assert len(found.faces) == sum(len(side) - 2 for side in SIDES)
    assert (found.faces[-4:, 0] == 0).all()


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("-3 0 1 2\n3 0 1 2", "a list of -3 values, of 8 numbers for 2 elements 'face'"),
        ("1.5 0 1 2\n3 0 1 2", "a list of 1.5 values, of 8 numbers"),
        ("nan 0 1 2\n3 0 1 2", "a list of nan values, of 8 numbers"),
        ("1e300 0 1 2\n3 0 1 2", "cut short or damaged: ends within its data, of 8 numbers for 2 elements 'face'"),
        ("3 0 1 2\n3 0 1", "cut short or damaged: ends within its data, of 7 numbers for 2 elements 'face'"),
        ("3 0 1 nan\n3 0 1 2", "a face's vertex is nan, expected a whole number"),
        ("3 0 1 1e30\n3 0 1 2", "a face's vertex is 1e+30, expected a whole number"),
    ],
)
def test_rows_of_a_text_that_cannot_be_are_told_as_they_are(tmp_path: Path, rows: str, words: str) -> None:
    content = ply("ascii", [vertices(), ("face", ["list uchar int vertex_indices"], [])])
    assert words in refused(tmp_path / "a.ply", content.replace(b"face 0", b"face 2") + rows.encode() + b"\n")


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("place", [0, 1])
def test_a_list_longer_than_any_file_is_refused(tmp_path: Path, kind: str, place: int) -> None:
    rows = [[side] for side in SIDES[:3]]
    content = ply(kind, [vertices(), ("face", ["list uint64 int vertex_indices"], rows)])
    start = len(content) - sum(8 + 4 * len(side) for side in SIDES[place:3])
    assert "cut short" in refused(tmp_path / "a.ply", content[:start] + b"\xff" * 8 + content[start + 8 :])


def test_a_property_of_a_name_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    name, properties, rows = vertices()
    content = ply("ascii", [(name, [*properties, "float x"], [[*row, 0] for row in rows])])
    assert "elements 'vertex' have two properties x" in refused(tmp_path / "a.ply", content)


def test_data_that_begin_like_the_end_of_a_line_are_data(tmp_path: Path) -> None:
    """Lines of the header end by CR, and the first byte of the data is that of LF."""
    points = POINTS.copy()
    points[0, 0] = np.frombuffer(b"\n\0\0\0", "<f4")[0]
    elements = [vertices(points), ("face", ["list uchar int vertex_indices"], [[side] for side in SIDES])]
    head, end, body = ply("binary_little_endian", elements).partition(b"end_header\n")
    assert body[:1] == b"\n"
    content = (head + end).replace(b"\n", b"\r") + body
    assert volume(*written(tmp_path / "a.ply", content).surfaces) == pytest.approx(VOLUME)
