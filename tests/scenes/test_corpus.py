"""Broken and odd files: each ends in one clear line, or in a scene that says what was done; none in a traceback."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scene2spad.cli import main
from scenes import InputError
from scenes.io.mesh_formats.meshes import load_mesh
from scenes.io.relief import RgbdFiles, middlebury, rgbd
from scenes.library.catalog import load_scene
from scenes.library.hard_cases import million_triangles

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = "ply\nformat ascii 1.0\n{comment}element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face 1\nproperty list uchar int vertex_indices\nend_header\n{vertices}\n{face}\n"
SENSOR = "<sensor type='perspective'><float name='fov' value='40'/></sensor>"


def text(name: str, content: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return make


def ply(vertices: str = "0 0 0\n1 0 0\n0 1 0", face: str = "3 0 1 2", comment: str = "") -> str:
    return PLY.format(vertices=vertices, face=face, comment=comment)


def exported(name: str, keep: float = 1.0, flip: int | None = None) -> Callable[[Path], Path]:
    """A box in that format, cut after a share of its bytes, or with one byte of its middle turned over."""

    def make(folder: Path) -> Path:
        path = folder / name
        trimesh.creation.box((0.5, 0.6, 0.7)).export(path)
        content = bytearray(path.read_bytes())
        if flip is not None:
            content[flip] ^= 0xFF
        path.write_bytes(content[: int(keep * len(content))])
        return path

    return make


def renamed(real: str, shown: str) -> Callable[[Path], Path]:
    return lambda folder: exported(real)(folder).rename(folder / shown)


def glb_without_triangles(folder: Path) -> Path:
    body = json.dumps({"asset": {"version": "2.0"}}).encode()
    body += b" " * (-len(body) % 4)
    chunk = struct.pack("<II", len(body), 0x4E4F534A) + body
    (folder / "no.glb").write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunk)) + chunk)
    return folder / "no.glb"


def cyclic_includes(folder: Path) -> Path:
    for one, other in (("a", "b"), ("b", "a")):
        (folder / f"{one}.xml").write_text(f"<scene version='3.0.0'><include filename='{other}.xml'/></scene>")
    return folder / "a.xml"


def missing_texture(folder: Path) -> Path:
    (folder / "m.mtl").write_text("newmtl a\nmap_Kd gone.png\n")
    return text("m.obj", f"mtllib m.mtl\n{TRIANGLE}vt 0 0\nusemtl a\nf 1/1 2/1 3/1\n")(folder)


REFUSED = {
    "empty obj": (text("e.obj", ""), "empty"),
    "blank ply": (text("e.ply", " \n\n"), "empty"),
    "no faces obj": (text("p.obj", TRIANGLE), "no faces|no mesh"),
    "points only ply": (text("p.ply", ply(face="").replace("element face 1", "element face 0")), "no faces|no mesh"),
    "NaN vertex": (text("n.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "NaN"),
    "infinite vertex": (text("i.ply", ply("0 0 0\ninf 0 0\n0 1 0")), "NaN or infinite|broken"),
    "index too large": (text("x.obj", TRIANGLE + "f 1 2 9\n"), "vertex|broken"),
    "negative index beyond": (text("x.obj", TRIANGLE + "f -1 -2 -9\n"), "vertex|broken"),
    "negative index ply": (text("x.ply", ply(face="3 0 1 -2")), "refers to vertex"),
    "words as numbers": (text("w.obj", "v a b c\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "broken"),
    "all degenerate": (text("d.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "degenerate"),
    "one point": (text("o.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n"), "extent"),
    "huge": (text("h.obj", "v -1e308 0 0\nv 1e308 0 0\nv 0 1 0\nf 1 2 3\n"), "coordinate"),
    "truncated stl": (exported("t.stl", 0.5), "broken"),
    "truncated ply": (exported("t.ply", 0.6), "broken|vertex"),
    "truncated glb": (exported("t.glb", 0.4), "broken"),
    "glb without meshes": (glb_without_triangles, "empty|no mesh|no faces"),
    "ply called obj": (renamed("a.ply", "b.obj"), "holds .ply data"),
    "glb called stl": (renamed("a.glb", "b.stl"), "holds .glb data"),
    "noise as glb": (text("noise.glb", "\x00\x01 not at all"), "broken"),
    "texture missing": (missing_texture, "gone.png"),
    "unknown kind": (text("scene.fbx", "x"), "extension|expected one of"),
    "cyclic include": (cyclic_includes, "includes itself"),
    "xml cut short": (text("c.xml", "<scene version='3.0.0'><shape"), "xml"),
    "xml without shapes": (text("s.xml", f"<scene version='3.0.0'>{SENSOR}</scene>"), "no shapes"),
    "xml of something else": (text("h.xml", "<html/>"), "expected <scene>"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, case, capsys):
    make, why = REFUSED[case]
    path = make(tmp_path)
    with pytest.raises(InputError, match=why) as caught:
        load_scene(str(path))
    message = str(caught.value)
    assert "\n" not in message and str(tmp_path) in message and len(message) < 600
    assert main(["render", str(path), "--out", str(tmp_path / "o.exr")]) == 2
    output = capsys.readouterr()
    assert output.out == "" and output.err.count("\n") == 1 and "Traceback" not in output.err
    assert not (tmp_path / "o.exr").exists()


TWO = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0.3\n"
CROSSED = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.2 0.2 -1\nv 0.2 0.2 1\nv 0.8 0.3 0\n"
MM = "comment units: mm\n"
REPAIRED = {
    "degenerate among others": (text("d.obj", f"{TWO}f 1 2 3\nf 1 1 2\n"), "degenerate faces dropped: 1"),
    "face twice": (text("t.obj", f"{TWO}f 1 2 3\nf 3 2 1\n"), "duplicate faces dropped: 1"),
    "stray vertex": (text("u.ply", ply("9 9 9\n0 0 0\n1 0 0\n0 1 0", "3 1 2 3").replace("x 3", "x 4")), "unref"),
    "negative indices as OBJ allows": (text("r.obj", TRIANGLE + "f -3 -2 -1\n"), "m kept"),
    "self-intersecting": (text("s.obj", f"{CROSSED}f 1 2 3\nf 4 5 6\n"), "no colour"),
    "millimetres": (text("mm.obj", "v 0 0 0\nv 900 0 0\nv 0 400 0\nf 1 2 3\n"), "looks like millimetres"),
    "millimetres by its own words": (text("mm.ply", ply("0 0 0\n90 0 0\n0 9 0", comment=MM)), "unit 'mm'"),
    "inches": (text("in.obj", "v 0 0 0\nv 30 0 0\nv 0 20 0\nf 1 2 3\n"), "looks like inches"),
    "inches by its own words": (text("in.obj", f"# File units = inches\n{TRIANGLE}f 1 2 3\n"), "unit 'inch'"),
    "no unit fits": (text("far.obj", "v 0 0 0\nv 9e5 0 0\nv 0 9e5 0\nf 1 2 3\n"), "made up"),
    "material file missing": (text("l.obj", f"mtllib gone.mtl\n{TRIANGLE}f 1 2 3\n"), "gone.mtl not found"),
}  # fmt: skip


@pytest.mark.parametrize("case", REPAIRED)
def test_what_can_be_mended_is_read_and_said(tmp_path, case):
    make, what = REPAIRED[case]
    scene = load_scene(str(make(tmp_path)))
    assert any(what in note for note in scene.notes), scene.notes
    assert scene.triangles > 4 and all(np.isfinite(s.vertices).all() for s in scene.surfaces)


@pytest.mark.parametrize(
    ("content", "extent_m"),
    [("v 0 0 0\nv 900 0 0\nv 0 400 0\n", 0.9), ("v 0 0 0\nv 30 0 0\nv 0 20 0\n", 30 * 0.0254)]
    + [(f"# units: cm\n{TRIANGLE}", 0.01), (f"# Units in Feet\n{TRIANGLE}", 0.3048), (f"# unit: m\n{TRIANGLE}", 1.0)],
)
def test_units_make_the_size_in_metres(tmp_path, content, extent_m):
    (tmp_path / "m.obj").write_text(content + "f 1 2 3\n")
    model = load_mesh(tmp_path / "m.obj").surfaces[0]
    assert np.ptp(model.vertices, axis=0).max() == pytest.approx(extent_m)


@pytest.mark.slow
def test_a_million_triangles_are_read(tmp_path):
    big = million_triangles().surfaces[0]
    trimesh.Trimesh(big.vertices, big.faces, process=False).export(tmp_path / "big.stl")
    assert load_mesh(tmp_path / "big.stl").triangles > 1_000_000


def test_flipped_bytes_never_end_in_a_traceback(tmp_path):
    """One byte of every fifth of each format turned over: a scene or one line."""
    for kind in ("stl", "ply", "glb", "obj"):
        size = len(exported(f"f.{kind}")(tmp_path).read_bytes())
        for at in range(0, size, max(1, size // 5)):
            path = exported(f"f.{kind}", flip=at)(tmp_path)
            try:
                assert load_mesh(path).triangles > 0
            except InputError as error:
                assert "\n" not in str(error)


def image(path: Path, values: np.ndarray) -> Path:
    from PIL import Image

    Image.fromarray(values).save(path)
    return path


BAD_PAIRS = {
    "no scale": (np.full((8, 8), 900, np.uint16), {"scale_m": None}, "scale"),
    "nothing known": (np.zeros((8, 8), np.uint16), {}, "no known depth"),
    "colours as depth": (np.random.default_rng(0).integers(0, 255, (8, 8, 3)).astype(np.uint8), {}, "one channel"),
    "other proportions": (np.full((4, 16), 900, np.uint16), {}, "other proportions"),
    "no focal length": (np.full((8, 8), 900, np.uint16), {"focal_px": 0.0}, "focal length"),
    "wrong scale": (np.full((8, 8), 900, np.uint16), {"scale_m": 1e3}, "check the scale"),
}


@pytest.mark.parametrize("case", BAD_PAIRS)
def test_rgbd_pairs_that_say_too_little_are_refused(tmp_path, case):
    depth, change, why = BAD_PAIRS[case]
    photo = image(tmp_path / "photo.png", np.full((8, 8), 128, np.uint8))
    options = {"focal_px": 10.0, "scale_m": 1e-3} | change
    with pytest.raises(InputError, match=why):
        rgbd(RgbdFiles(photo, image(tmp_path / "depth.png", depth), **options))


def test_a_middlebury_folder_with_something_missing_is_refused(tmp_path):
    image(tmp_path / "disp1.png", np.full((8, 8), 90, np.uint8))
    image(tmp_path / "view1.png", np.full((8, 8), 90, np.uint8))
    with pytest.raises(InputError, match=r"dmin\.txt"):
        middlebury(tmp_path)
    (tmp_path / "dmin.txt").write_text("many")
    with pytest.raises(InputError, match="no number"):
        middlebury(tmp_path)
