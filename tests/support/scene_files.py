"""Files that a scene is made of: small good ones of every kind, and the numbers that reading them hands out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

Numbers = Iterable[tuple[np.ndarray, bool]]  # arrays, and whether they may hold NaN


def write_mesh(path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(subdivisions=1, radius=0.5).export(path)


def read_scene(path: Path) -> Numbers:
    from scenes.library.catalog import load_scene

    for surface in load_scene(str(path), width=16, height=12).surfaces:
        yield surface.vertices, False
        yield surface.faces, False


XML = """<scene version="3.0.0">
  <sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 1, 4" target="0, 0.5, 0" up="0, 1, 0"/></transform></sensor>
  <bsdf type="roughplastic" id="paint"><rgb name="diffuse_reflectance" value="0.4, 0.3, 0.2"/>
    <float name="alpha" value="0.2"/></bsdf>
  <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/></transform>
    <ref id="paint"/></shape>
  <shape type="sphere"><float name="radius" value="0.5"/><point name="center" x="0" y="0.5" z="0"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <emitter type="constant"><rgb name="radiance" value="0.01"/></emitter>
</scene>
"""


def write_image(path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)).save(path)


def read_texture(path: Path) -> Numbers:
    from scenes.io.textures import load_texture

    yield load_texture(path).image, False


def write_depth_image(path: Path) -> None:
    from PIL import Image

    levels = np.random.default_rng(0).integers(800, 3000, (24, 32)).astype(np.uint16)
    Image.fromarray(levels).save(path)


def write_depth_exr(path: Path) -> None:
    import OpenEXR

    depth = np.random.default_rng(0).uniform(0.8, 3, (24, 32)).astype(np.float32)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"Z": depth}).write(str(path))


def read_rgbd(path: Path) -> Numbers:
    from scenes.io.relief import RgbdFiles, rgbd

    photograph = path.parent / "photograph.bmp"
    if not photograph.is_file():
        photograph = Path(path.parent.parent / "photograph.bmp")
        write_grey(photograph)
    scene = rgbd(RgbdFiles(photograph, path, 40.0, 0.001 if path.suffix == ".png" else 1.0, False), width=16)
    for surface in scene.surfaces:
        yield surface.vertices, False


def write_grey(path: Path) -> None:
    from PIL import Image

    if not path.is_file():
        Image.fromarray(np.random.default_rng(1).integers(20, 255, (24, 32), np.uint8)).save(path)


def write_serialized(path: Path) -> None:
    """One mesh of Mitsuba's format, version 4, with normals."""
    import struct
    import zlib

    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    body = struct.pack("<I", 0x1001) + b"ball\0" + struct.pack("<QQ", len(ball.vertices), len(ball.faces))
    body += np.asarray(ball.vertices, "<f4").tobytes() + np.asarray(ball.vertex_normals, "<f4").tobytes()
    body += np.asarray(ball.faces, "<u4").tobytes()
    path.write_bytes(struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1))


def read_serialized(path: Path) -> Numbers:
    from scenes.io.mesh_formats.serialized import read_serialized

    found = read_serialized(path)
    yield found.vertices, True
    yield found.faces, False
