"""Files that users hand in and that would hang, crash, eat memory or silently lose something: refused in one line."""

import json
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

from scenes import InputError
from scenes.io.inputs import file_inside, parse_json, read_json_object, read_text, read_whole_lines, regular_file
from scenes.io.relief import read_levels
from scenes.io.set_index import read_set_index
from scenes.io.textures import load_texture
from scenes.library.catalog import load_scene

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
SIDE = 60_000  # of images that declare more pixels than any limit


def refusal(read: Callable[[Path], object], path: Path) -> str:
    """The one line that `read` refuses `path` with."""
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message and path.name in message
    return message


def mesh_refusal(path: Path) -> str:
    return refusal(lambda file: load_scene(str(file), width=8, height=6), path)


def ball(path: Path, **options: object) -> Path:
    trimesh.creation.icosphere(subdivisions=1, radius=0.5).export(path, **options)
    return path


def edited_glb(path: Path, edit: Callable[[dict], None]) -> Path:
    """A GLB whose JSON was changed, its lengths made to fit again."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    header = json.loads(content[20 : 20 + size])
    edit(header)
    text = json.dumps(header).encode()
    return resealed_glb(path, text, content[20 + size :])


def resealed_glb(path: Path, text: bytes, rest: bytes) -> Path:
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    path.write_bytes(head + text + rest)
    return path


def textured_glb(path: Path) -> Path:
    mesh = trimesh.creation.box()
    uv = np.random.default_rng(0).uniform(0, 1, (len(mesh.vertices), 2))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (200, 100, 50)))
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh.export(path)
    return path


# --- Regular files, text, JSON ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.stl", "a.glb", "a.xml", "a.png", "a.exr"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    read = load_texture if name in ("a.png", "a.exr") else lambda path: load_scene(str(path))
    assert "pipe" in refusal(read, tmp_path / name)


def test_a_device_is_refused(tmp_path):
    (tmp_path / "endless.xml").symlink_to("/dev/zero")
    assert "device" in refusal(lambda path: load_scene(str(path)), tmp_path / "endless.xml")


def test_odd_names_and_folders_are_refused(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path, words in ((tmp_path, "folder"), (tmp_path / "gone", "not found"), (tmp_path / "loop", "looked up")):
        assert words in refusal(regular_file, path)
    for name in ("a\0b", "x" * 5000):
        with pytest.raises(InputError, match="cannot be looked up"):
            regular_file(tmp_path / name)
        with pytest.raises(InputError, match="cannot be looked up"):
            file_inside(tmp_path, name)


def test_names_stay_inside_the_folder_links_followed(tmp_path):
    inside, outside = tmp_path / "in", tmp_path / "secret.txt"
    (inside / "deep").mkdir(parents=True)
    outside.write_text("x")
    (inside / "link.txt").symlink_to(outside)
    (inside / "own.txt").symlink_to(inside / "deep/kept.txt")
    (inside / "deep/kept.txt").write_text("x")
    os.mkfifo(inside / "pipe")
    for name in ("../secret.txt", "..\\secret.txt", str(outside), "link.txt", "deep/../../secret.txt"):
        with pytest.raises(InputError, match="outside"):
            file_inside(inside, name)
    with pytest.raises(InputError, match="not a regular file"):
        file_inside(inside, "pipe")
    for name in ("deep\\kept.txt", "own.txt", "deep/../deep/kept.txt"):
        assert file_inside(inside, name).read_text() == "x"


def test_json_that_is_no_json_and_text_that_is_no_text(tmp_path):
    for text in (b"\xff", b"{", b"[" * 100_000, b'{"a":' * 100_000):
        with pytest.raises(InputError):
            parse_json(text)
        (tmp_path / "a.json").write_bytes(text)
        refusal(read_json_object, tmp_path / "a.json")
    (tmp_path / "a.json").write_text("[1]")
    assert "no JSON object" in refusal(read_json_object, tmp_path / "a.json")
    (tmp_path / "a.txt").write_bytes(b"abc\xff")
    assert "byte 3" in refusal(read_text, tmp_path / "a.txt")
    assert "4 bytes" in refusal(lambda path: read_text(path, most_bytes=3), tmp_path / "a.txt")


def test_a_journal_gives_its_whole_lines(tmp_path):
    assert list(read_whole_lines(tmp_path / "gone.jsonl")) == []
    (tmp_path / "a.jsonl").write_bytes(b'{"view": 1}\n{"vi\n\xff\xfe\n' + b"[" * 100_000 + b'\n\n{"view": 2}')
    assert list(read_whole_lines(tmp_path / "a.jsonl")) == [{"view": 1}, {"view": 2}]


def test_a_refusal_can_be_printed_whatever_the_name(tmp_path):
    name = os.fsdecode(b"caf\xe9.obj")
    assert refused_text(tmp_path / name).encode()


def refused_text(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(str(path))
    return str(caught.value)


# --- Meshes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lines", [1, 40, 79, 80, 100])
def test_a_text_ply_that_was_cut_short_is_refused(tmp_path, lines):
    path = ball(tmp_path / "ball.ply", encoding="ascii")
    whole = path.read_text().splitlines(keepends=True)
    path.write_text("".join(whole[:-lines]))
    assert "cut short" in mesh_refusal(path)


@pytest.mark.parametrize(("wrong", "right"), [("\n3 ", "\n2 "), ("\n3 ", "\n4 "), ("\n3 ", "\nx "), ("\n3 ", " 3 ")])
def test_a_text_ply_with_other_numbers_than_it_says_is_refused(tmp_path, wrong, right):
    path = ball(tmp_path / "ball.ply", encoding="ascii")
    head, data = path.read_text().split("end_header")
    path.write_text(f"{head}end_header{data[:-200]}{data[-200:].replace(wrong, right, 1)}")
    mesh_refusal(path)


def test_a_text_ply_of_triangles_and_quads_is_read(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 1 0\n4 0 1 2 3\n3 1 4 2\n")
    assert len(load_scene(str(tmp_path / "a.ply")).surfaces[0].faces) == 3


@pytest.mark.parametrize("declared", ["element vertex 99999999999999999", "element face 4000000000"])
def test_a_ply_that_declares_more_than_it_has_is_refused_at_once(tmp_path, declared):
    path = ball(tmp_path / "ball.ply")
    kind = declared.rsplit(" ", 1)[0].encode()
    path.write_bytes(re.sub(kind + rb" \d+", declared.encode(), path.read_bytes()))
    assert "cut short or damaged" in mesh_refusal(path)


def test_a_binary_ply_with_another_length_of_one_face_is_refused(tmp_path):
    path = ball(tmp_path / "ball.ply")
    content = bytearray(path.read_bytes())
    content[-13 * 5] = 4  # a face is a byte and three ints
    path.write_bytes(content)
    assert "cut short or damaged" in mesh_refusal(path)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
@pytest.mark.parametrize("left", [0.3, 0.9, 0.99])
def test_an_stl_that_was_cut_short_is_refused(tmp_path, kind, left):
    path = ball(tmp_path / "ball.stl", file_type=kind)
    content = path.read_bytes()
    path.write_bytes(content[: int(left * len(content))])
    assert "cut short" in mesh_refusal(path)


def test_what_follows_the_last_triangle_of_an_stl_is_named(tmp_path):
    """Nothing of such a file is missing; its header may be wrong, so that it is refused."""
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 0)
    whole = bytes(80) + struct.pack("<I", 1) + triangle
    path = tmp_path / "a.stl"
    path.write_bytes(whole)
    assert load_scene(str(path), bare=True).triangles == 1
    path.write_bytes(whole + b"\0\0")
    message = mesh_refusal(path)
    assert "2 bytes after the last of the 1 triangles that its header says" in message and "cut short" not in message
    path.write_bytes(whole[:-1])
    assert "cut short" in mesh_refusal(path)


def test_a_text_stl_with_a_word_for_a_number_is_refused(tmp_path):
    path = ball(tmp_path / "ball.stl", file_type="stl_ascii")
    text = path.read_text()
    path.write_text(text[:2000] + re.sub(r"vertex \S+", "vertex o", text[2000:], count=1))
    mesh_refusal(path)


@pytest.mark.parametrize(("uri", "name"), [("gone%20now.png", "gone now.png"), ("a b%.png", "a b%.png")])
def test_a_glb_without_its_texture_is_refused(tmp_path, uri, name):
    def elsewhere(header: dict) -> None:
        header["images"][0] = {"uri": uri}

    assert uri in mesh_refusal(edited_glb(textured_glb(tmp_path / "a.glb"), elsewhere))
    (tmp_path / name).write_text("no image")
    assert "no image that can be read" in mesh_refusal(tmp_path / "a.glb")
    Image.new("RGB", (4, 4), (200, 100, 50)).save(tmp_path / name)
    paths = tmp_path / "a.glb", textured_glb(tmp_path / "b.glb")
    beside, within = (load_scene(str(path)).surfaces[0].material.albedo.image for path in paths)
    assert np.array_equal(beside, within)


def test_a_glb_reads_no_file_outside_its_folder(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "out.png")

    def outside(header: dict) -> None:
        header["images"][0] = {"uri": "../out.png"}

    assert "outside" in mesh_refusal(edited_glb(textured_glb(folder / "a.glb"), outside))


def _edit(*path: object) -> Callable[[dict], None]:
    """Set the value at a path of keys."""

    def edit(header: dict) -> None:
        at = header
        for key in path[:-2]:
            at = at[key]
        at[path[-2]] = path[-1]

    return edit


@pytest.mark.parametrize(
    "edit",
    [
        _edit("accessors", 0, {"componentType": 5126, "type": "VEC3", "count": 1 << 40}),
        _edit("accessors", 0, "count", -1),
        _edit("accessors", 0, "count", 1 << 40),
        _edit("accessors", 0, "bufferView", -1),
        _edit("bufferViews", 0, "byteLength", 1 << 40),
        _edit("bufferViews", 0, "byteOffset", -4),
        _edit("meshes", 0, "primitives", 0, "attributes", "POSITION", 99),
        _edit("scenes", [{"nodes": [-1]}]),
        _edit("nodes", []),
        _edit("accessors", None),
        _edit("nodes", 0, "scale", [1e300, 1, 1]),
        _edit("nodes", 0, "scale", [float("nan"), 1, 1]),
        _edit("accessors", 0, "sparse", {"count": 1}),
    ],
)
def test_a_glb_with_impossible_numbers_is_refused(tmp_path, edit):
    mesh_refusal(edited_glb(ball(tmp_path / "ball.glb"), edit))


def test_a_glb_of_deep_json_is_refused(tmp_path):
    assert "nested too deeply" in mesh_refusal(resealed_glb(tmp_path / "deep.glb", b'{"a":' * 50_000, b""))


def test_a_glb_with_a_mesh_instanced_beyond_memory_is_refused(tmp_path):
    def crowd(header: dict) -> None:
        mesh = next(node["mesh"] for node in header["nodes"] if "mesh" in node)
        header["nodes"] = [{"mesh": mesh, "name": str(i)} for i in range(2_000)]
        header["scenes"] = [{"nodes": list(range(2_000))}]
        header["scene"] = 0

    path = tmp_path / "crowd.glb"
    trimesh.creation.icosphere(subdivisions=5).export(path)
    assert "triangles with all instances" in mesh_refusal(edited_glb(path, crowd))


@pytest.mark.parametrize("number", ["1e300", "-1e13", "nan", "inf"])
def test_coordinates_beyond_arithmetic_are_refused(tmp_path, number):
    (tmp_path / "far.obj").write_text(f"v {number} 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    mesh_refusal(tmp_path / "far.obj")


@pytest.mark.parametrize("library", ["../out.mtl", "link.mtl", "in.mtl"])
def test_an_obj_reads_no_file_outside_its_folder(tmp_path, library):
    folder = tmp_path / "in"
    folder.mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "out.png")
    (tmp_path / "out.mtl").write_text("newmtl m\nKd 0 1 0\n")
    (folder / "link.mtl").symlink_to(tmp_path / "out.mtl")
    (folder / "in.mtl").write_text("newmtl m\nmap_Kd ../out.png\n")
    (folder / "a.obj").write_text(f"mtllib {library}\n{TRIANGLE}usemtl m\nf 1/1 2/2 3/3\n")
    with pytest.raises(InputError, match="outside the file's folder"):
        load_scene(str(folder / "a.obj"))


# --- XML, images -----------------------------------------------------------------------------------------------------


def test_xml_nested_without_end_is_refused(tmp_path):
    path = tmp_path / "deep.xml"
    path.write_text('<scene version="3.0.0">' + '<bsdf type="twosided">' * 50_000 + "</bsdf>" * 50_000 + "</scene>")
    assert "nested more than" in refusal(lambda file: load_scene(str(file)), path)


def bomb_png(path: Path) -> Path:
    """A few bytes that declare SIDE x SIDE pixels, their checksums right."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", SIDE, SIDE, 8, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize("read", [load_texture, read_levels])
@pytest.mark.parametrize("side", [9_000, SIDE])
def test_an_image_that_declares_too_many_pixels_is_refused(tmp_path, read, side, monkeypatch):
    monkeypatch.setitem(globals(), "SIDE", side)
    refused = refusal(read, bomb_png(tmp_path / "bomb.png"))
    assert "limit" in refused


@pytest.mark.parametrize("read", [load_texture, read_levels])
def test_no_damaged_byte_of_a_pngs_pixels_is_accepted(tmp_path, read):
    """Pillow reads past the checksums of pixels, and keeps the rows that it has where their stream breaks off."""
    levels = np.random.default_rng(0).integers(800, 3000, (24, 32)).astype(np.uint16)
    Image.fromarray(levels).save(tmp_path / "good.png")
    content = (tmp_path / "good.png").read_bytes()
    read(tmp_path / "good.png")
    for at in range(content.index(b"IDAT") + 4, content.index(b"IEND") - 4, 23):
        (tmp_path / "bad.png").write_bytes(content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :])
        refusal(read, tmp_path / "bad.png")


def test_a_glb_with_a_damaged_texture_is_refused(tmp_path):
    path = textured_glb(tmp_path / "a.glb")
    content = bytearray(path.read_bytes())
    content[content.index(b"IDAT") + 10] ^= 16
    path.write_bytes(content)
    assert "no image that can be read" in mesh_refusal(path)


def test_an_exr_that_declares_too_many_pixels_is_refused(tmp_path):
    path = tmp_path / "bomb.exr"
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(path))
    content = path.read_bytes()
    at = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(content[:at] + struct.pack("<4i", 0, 0, SIDE - 1, SIDE - 1) + content[at + 16 :])
    refusal(load_texture, path)


# --- Sets ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b'{"view": 0, "file": "\xff"}\n', "no UTF-8"),
        (b'{"view": 0, "file": "a', "its end is missing"),
        (b'{"view": 0, "file": "../a.exr"}\n', "outside the set's folder"),
        (b'{"view": 0, "file": "gone.exr"}\n', "not found"),
        (b'{"view": 0}\n', "names the file None"),
        (b'{"view": "0", "file": "a.exr"}\n', "is of view '0'"),
        (b'{"view": 0, "file": "a.exr"}\n{"view": 0, "file": "a.exr"}\n', "line 2 is of view 0"),
        (b"[" * 100_000 + b"\n", "nested too deeply"),
        (b"[]\n", "no JSON object"),
    ],
)
def test_a_damaged_index_of_a_set_is_refused(tmp_path, line, words):
    (tmp_path / "a.exr").touch()
    (tmp_path.parent / "a.exr").touch()
    (tmp_path / "index.jsonl").write_bytes(line)
    with pytest.raises(InputError) as caught:
        read_set_index(tmp_path)
    assert words in str(caught.value) and "index.jsonl" in str(caught.value) and "\n" not in str(caught.value)
