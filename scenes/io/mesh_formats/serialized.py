"""Reads Mitsuba's .serialized meshes: several compressed meshes in a file, found by offsets at its end.

A mesh is a magic number and a version (two bytes each), then a zlib stream: flags, a name (version 4), the numbers of
vertices and triangles, positions, and what the flags name. The file ends with where each mesh begins and how many
there are. Declared numbers are checked against what is there before anything is allocated.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes.errors import InputError, require
from scenes.io.inputs import read_bytes
from scenes.io.mesh_formats.mesh_files import MAX_TRIANGLES
from scenes.limits import require_memory

MAGIC = 0x041C
VERSIONS = (3, 4)
NORMALS, UV, COLOURS, FACE_NORMALS, SINGLE, DOUBLE = 0x0001, 0x0002, 0x0008, 0x0010, 0x1000, 0x2000
CHUNK = 1 << 20
MAX_NAME = 4096
WIDE_INDICES = 1 << 32  # vertices from which a corner takes eight bytes


@dataclass(frozen=True, eq=False)
class SerializedMesh:
    """Vertices (N, 3), faces (F, 3), and uv (N, 2) and normals (N, 3) where the file has them."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    normals: np.ndarray | None
    name: str


def read_serialized(path: Path, index: int = 0) -> SerializedMesh:
    """Read mesh number `index` of a .serialized file, from 0.

    Raises InputError in one line for a file that is cut short, is of another kind, or holds no such mesh.
    """
    data = read_bytes(path, "mesh file")
    try:
        start, stop = _place(data, index)
        magic, version = struct.unpack_from("<HH", data, start)
        require(magic == MAGIC, f"mesh {index} begins with {magic:#06x}, expected {MAGIC:#06x}")
        require(version in VERSIONS, f"version {version}, expected {' or '.join(map(str, VERSIONS))}")
        return _mesh(_Stream(data[start + 4 : stop]), version)
    except (struct.error, zlib.error) as error:
        raise InputError(f"{path}: broken .serialized file ({error})") from None
    except InputError as error:
        raise InputError(f"{path}: broken .serialized file ({error})") from None


def _place(data: bytes, index: int) -> tuple[int, int]:
    """Find the bytes at which mesh `index` begins and ends."""
    magic, version = struct.unpack_from("<HH", data, 0)
    require(magic == MAGIC, f"begins with {magic:#06x}, expected {MAGIC:#06x}")
    require(version in VERSIONS, f"version {version}, expected {' or '.join(map(str, VERSIONS))}")
    (count,) = struct.unpack_from("<I", data, len(data) - 4)
    size, form = (8, "Q") if version == 4 else (4, "I")
    table = len(data) - 4 - size * count
    require(count > 0 and table > 0, f"names {count} meshes at its end, which do not fit into {len(data)} bytes")
    require(0 <= index < count, f"holds {count} meshes, expected shape_index below that, not {index}")
    starts = (*struct.unpack_from(f"<{count}{form}", data, table), table)
    start = starts[index]
    require(start + 4 <= table, f"mesh {index} would begin at byte {start} of {len(data)}")
    stop = min(other for other in starts if other > start)
    require(start + 4 <= stop, f"mesh {index} would end {stop - start} bytes after its beginning")
    return start, stop


class _Stream:
    """A zlib stream that gives no more than is asked for."""

    def __init__(self, data: bytes) -> None:
        self._inflate, self._packed, self._ready = zlib.decompressobj(), data, bytearray()

    def take(self, size: int) -> bytes:
        """Read the next `size` bytes; InputError where the stream ends before."""
        while len(self._ready) < size:
            more = self._inflate.decompress(self._packed, CHUNK)
            self._packed = self._inflate.unconsumed_tail
            if not more:
                raise InputError(f"cut short: {size} bytes expected, {len(self._ready)} are left")
            self._ready += more
        taken = bytes(self._ready[:size])
        del self._ready[:size]
        return taken

    def end(self) -> None:
        """Meet the end of the stream, where its checksum is compared; InputError where there is none."""
        more = self._inflate.decompress(self._packed, CHUNK)
        require(self._inflate.eof and not more and not self._ready, "holds more, or less, than its mesh")

    def numbers(self, form: str) -> tuple[int, ...]:
        return struct.unpack(f"<{form}", self.take(struct.calcsize(f"<{form}")))

    def array(self, rows: int, columns: int, dtype: str) -> np.ndarray:
        kind = np.dtype(dtype)
        return np.frombuffer(self.take(rows * columns * kind.itemsize), kind).reshape(rows, columns)


def _mesh(stream: _Stream, version: int) -> SerializedMesh:
    (flags,) = stream.numbers("I")
    name = _name(stream) if version == 4 else ""
    vertices, triangles = stream.numbers("QQ")
    require(triangles <= MAX_TRIANGLES, f"{triangles} triangles, expected {MAX_TRIANGLES} at most")
    require(vertices <= 3 * MAX_TRIANGLES, f"{vertices} vertices, expected {3 * MAX_TRIANGLES} at most")
    require_memory(200 * triangles + 100 * vertices, f"a mesh of {triangles} triangles")
    real = "<f8" if flags & DOUBLE else "<f4"
    points = stream.array(vertices, 3, real)
    normals = stream.array(vertices, 3, real) if flags & NORMALS else None
    uv = stream.array(vertices, 2, real) if flags & UV else None
    if flags & COLOURS:
        stream.array(vertices, 3, real)
    faces = stream.array(triangles, 3, "<u8" if vertices >= WIDE_INDICES else "<u4").astype(np.int64)
    stream.end()
    kept = None if flags & FACE_NORMALS or normals is None else normals.astype(np.float64)
    return SerializedMesh(points.astype(np.float64), faces, None if uv is None else uv.astype(np.float64), kept, name)


def _name(stream: _Stream) -> str:
    letters = bytearray()
    while (letter := stream.take(1)) != b"\0":
        letters += letter
        require(len(letters) <= MAX_NAME, f"its name is longer than {MAX_NAME} bytes")
    return letters.decode("utf-8", errors="replace")
