"""Mitsuba's .serialized meshes: written here by the format's description, read back, and damaged."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import xml_files

from scenes.errors import InputError
from scenes.io.mesh_formats import serialized

POINTS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.5), (0, 1, 0)], float)
FACES = np.array([(0, 1, 2), (0, 2, 3)])
UV = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
UP = np.tile((0.0, 0.0, 1.0), (4, 1))


def mesh(flags: int, version: int, *, double: bool = False, points: np.ndarray = POINTS) -> bytes:
    real = "<f8" if double else "<f4"
    parts = [struct.pack("<I", flags | (serialized.DOUBLE if double else serialized.SINGLE))]
    parts += [b"leaf\0"] if version == 4 else []
    parts += [struct.pack("<QQ", len(points), len(FACES)), points.astype(real).tobytes()]
    parts += [UP.astype(real).tobytes()] if flags & serialized.NORMALS else []
    parts += [UV.astype(real).tobytes()] if flags & serialized.UV else []
    parts += [points.astype(real).tobytes()] if flags & serialized.COLOURS else []
    body = zlib.compress(b"".join([*parts, FACES.astype("<u4").tobytes()]))
    return struct.pack("<HH", serialized.MAGIC, version) + body


def file(path: Path, meshes: list[bytes], version: int) -> Path:
    starts = np.cumsum([0, *map(len, meshes)])[:-1]
    table = starts.astype("<u8" if version == 4 else "<u4").tobytes()
    path.write_bytes(b"".join(meshes) + table + struct.pack("<I", len(meshes)))
    return path


@pytest.mark.parametrize("version", serialized.VERSIONS)
@pytest.mark.parametrize("double", [False, True])
def test_every_mesh_of_a_file_is_found(tmp_path, version, double):
    everything = serialized.NORMALS | serialized.UV | serialized.COLOURS
    path = file(tmp_path / "a.serialized", [mesh(0, version), mesh(everything, version, double=double)], version)
    plain, full = (serialized.read_serialized(path, index) for index in range(2))
    for one in (plain, full):
        assert np.array_equal(one.vertices, POINTS) and np.array_equal(one.faces, FACES)
    assert plain.uv is None and plain.normals is None
    assert np.array_equal(full.uv, UV) and np.array_equal(full.normals, UP)
    assert full.name == ("leaf" if version == 4 else "")


def test_a_scene_takes_one_by_its_index(tmp_path):
    """As the same mesh in a .ply file: same triangles, same texture coordinates, normals of the file."""
    file(tmp_path / "m.serialized", [mesh(0, 4), mesh(serialized.NORMALS | serialized.UV, 4)], 4)
    (tmp_path / "m.ply").write_text(xml_files.PLY)
    index = '<integer name="shapeIndex" value="1"/>'
    mine, theirs = (
        xml_files.load(
            tmp_path, f'<shape type="{kind}"><string name="filename" value="m.{kind}"/>{more}</shape>'
        ).surfaces[0]
        for kind, more in (("serialized", index), ("ply", ""))
    )
    assert np.allclose(mine.vertices, theirs.vertices) and np.array_equal(mine.faces, theirs.faces)
    assert np.allclose(mine.uv, theirs.uv) and np.allclose(mine.normals, UP)


@pytest.mark.parametrize("cut", [0, 3, 5, 40, -1, -4, -9])
def test_a_file_cut_short_is_refused_in_one_line(tmp_path, cut):
    path = file(tmp_path / "a.serialized", [mesh(serialized.UV, 4)], 4)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError) as error:
        serialized.read_serialized(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [(1 << 40, 2, "vertices"), (4, 1 << 40, "triangles"), (40_000_000, 2, "cut short"), (4, 20_000_000, "cut short")],
)
def test_declared_numbers_are_not_believed(tmp_path, vertices, triangles, message):
    """A few bytes that promise gigabytes: refused before they are allocated."""
    body = zlib.compress(struct.pack("<I", serialized.SINGLE) + b"\0" + struct.pack("<QQ", vertices, triangles))
    path = file(tmp_path / "a.serialized", [struct.pack("<HH", serialized.MAGIC, 4) + body], 4)
    with pytest.raises(InputError, match=message):
        serialized.read_serialized(path)


def test_a_mesh_that_is_not_there(tmp_path):
    path = file(tmp_path / "a.serialized", [mesh(0, 4)], 4)
    with pytest.raises(InputError, match="holds 1 meshes, expected shape_index below that, not 1"):
        serialized.read_serialized(path, 1)


def test_damaged_files_are_refused_or_finite(tmp_path):
    rng = np.random.default_rng(11)
    good = file(tmp_path / "a.serialized", [mesh(serialized.NORMALS, 4), mesh(serialized.UV, 4)], 4).read_bytes()
    for number in range(200):
        data = bytearray(good)
        for place in rng.integers(0, len(data), 1 + number % 4):
            data[place] = rng.integers(0, 256)
        path = tmp_path / "b.serialized"
        path.write_bytes(data)
        try:
            found = serialized.read_serialized(path, number % 2)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert len(found.faces) == 2 and len(found.vertices) <= 4
