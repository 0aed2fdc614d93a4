"""Write MATLAB's version 5 files, and read those that may be damaged: their structure is checked before scipy sees it.

scipy.io trusts sizes and indices that a file states: a damaged one ends the process, or reads memory that is not
its own. Layout: MathWorks, *MAT-File Format*, "Level 5 MAT-File Format".
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from scenes.errors import InputError, require
from scenes.files import whole_file
from scenes.limits import require_memory

if TYPE_CHECKING:
    import scipy.sparse

# What a variable is: an array of numbers, text or cells, or a sparse matrix
Matrix: TypeAlias = "np.ndarray | scipy.sparse.csc_matrix"

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
ITEM_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
INTEGERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4"}
CELL, STRUCT, CHAR, SPARSE = 1, 2, 4, 5
NUMERIC = range(6, 16)  # double, single, int8 .. uint64
COMPLEX_FLAG = 0x0800
MAX_NESTING = 16
# scipy's says when a file was made, and on what system: the same data would be other bytes
HEADER_TEXT = b"MATLAB 5.0 MAT-file, written by scene2spad"
HEADER_TEXT_BYTES = 116


def save_mat(contents: Mapping[str, Matrix | float | dict[str, np.ndarray]], path: Path) -> None:
    """Write variables as a compressed .mat file of version 5, whole or not at all; the same data give the same bytes.

    Raises InputError where it cannot be written.
    """
    import scipy.io

    made = io.BytesIO()
    scipy.io.savemat(made, contents, do_compression=True)
    made.seek(0)
    made.write(HEADER_TEXT.ljust(HEADER_TEXT_BYTES))
    with whole_file(path) as beside:
        beside.write_bytes(made.getbuffer())


def load_mat(path: Path, names: Sequence[str] | None = None) -> dict[str, Matrix]:
    """Read the variables of a .mat file of version 5.

    Parameters: `names` (default: all). Numbers come as numpy arrays, sparse matrices as scipy's with indices that
    were checked. Raises InputError in one line that names the file: missing, version 7.3, damaged, of a class other
    than numbers, text, cells and structures, or larger than the memory limit.
    """
    import scipy.io
    import scipy.sparse

    path = Path(path)
    require(not path.is_dir(), f"{path}: is a folder, expected a file")
    require(path.is_file(), f"{path}: file not found")
    data = path.read_bytes()
    try:
        plain = checked_contents(data)
        found = scipy.io.loadmat(io.BytesIO(plain), variable_names=names)
    except InputError as error:
        raise InputError(f"{path}: not a readable .mat file: {error}") from None
    except Exception as error:  # scipy raises bare and varied exceptions
        raise InputError(f"{path}: not a readable .mat file ({' '.join(str(error).split())[:80]})") from None
    return {name: value for name, value in found.items() if not name.startswith("__")}


def checked_contents(data: bytes) -> bytes:
    """Return the same file with its compressed variables unpacked, every element's structure checked.

    Raises InputError, without the file's name, at the first element that does not hold what it states.
    """
    require(len(data) >= HEADER_BYTES, f"{len(data)} bytes, its header takes {HEADER_BYTES}")
    if data[:8] == b"\x89HDF\r\n\x1a\n" or b"MATLAB 7.3" in data[:HEADER_BYTES]:
        raise InputError("it is of version 7.3; save it again with -v7")
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise InputError("its header has no mark of byte order")
    require(data[124:126] == struct.pack(f"{order}H", 0x0100), "not of version 5")
    parts, at = [data[:HEADER_BYTES]], HEADER_BYTES
    while at < len(data):
        require(len(data) - at >= 8, "is cut short")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        require(size <= len(data) - at - 8, f"an element states {size} bytes, {len(data) - at - 8} are left")
        body, at = data[at + 8 : at + 8 + size], at + 8 + size
        if kind == COMPRESSED:
            part = _unpacked(body)
        else:
            require(kind == MATRIX, f"an element of type {kind} where a variable is expected")
            part = struct.pack(f"{order}II", kind, size) + body
        require(_matrix(part, 0, order, 0) == len(part), "a variable's size is not that of its parts")
        parts.append(part)
    return b"".join(parts)


def _unpacked(body: bytes) -> bytes:
    """Decompress one variable; its size is bounded before it is kept."""
    stream, parts, total = zlib.decompressobj(), [], 0
    try:
        while not stream.eof:
            part = stream.decompress(body, 1 << 24)
            total += len(part)
            require_memory(3 * total, "a compressed variable")
            require(bool(part) or stream.eof, "a compressed variable is cut short")
            parts.append(part)
            body = stream.unconsumed_tail
    except zlib.error as error:
        raise InputError(f"a compressed variable is damaged ({error})") from None
    require(not stream.unused_data, "bytes follow a compressed variable")
    return b"".join(parts)


def _element(data: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Read an element's tag: its type, where its bytes begin, how many they are, and where the next element is."""
    require(len(data) - at >= 8, "an element is cut short")
    kind, size = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:  # the small form: at most four bytes, in the tag itself
        kind, size = kind & 0xFFFF, kind >> 16
        require(size <= 4, f"a small element states {size} bytes")
        return kind, at + 4, size, at + 8
    require(size <= len(data) - at - 8, f"an element states {size} bytes, {len(data) - at - 8} are left")
    end = at + 8 + size
    return kind, at + 8, size, min(len(data), end if kind == MATRIX else end + -size % 8)


def _numbers(data: bytes, at: int, order: str, what: str) -> tuple[np.ndarray, int]:
    """Read an element of whole numbers as int64."""
    kind, start, size, after = _element(data, at, order)
    require(kind in INTEGERS and size % ITEM_BYTES[kind] == 0, f"{what} are of type {kind} and {size} bytes")
    values = np.frombuffer(data, f"{order}{INTEGERS[kind]}", size // ITEM_BYTES[kind], start)
    return values.astype(np.int64), after


def _values(data: bytes, at: int, order: str, count: int | None, what: str) -> int:
    """Check an element of `count` numbers (None: any), and return where the next one is."""
    kind, _, size, after = _element(data, at, order)
    require(kind in ITEM_BYTES and size % ITEM_BYTES[kind] == 0, f"{what} are of type {kind} and {size} bytes")
    found = size // ITEM_BYTES[kind]
    require(count is None or found == count, f"{what}: {found} numbers, its dimensions say {count}")
    return after


def _matrix(data: bytes, at: int, order: str, depth: int) -> int:
    """Check one variable, cell or field, and return where the next element is."""
    require(depth <= MAX_NESTING, f"cells are nested more than {MAX_NESTING} deep")
    kind, at, size, after = _element(data, at, order)
    require(kind == MATRIX, f"an element of type {kind} where a matrix is expected")
    if size == 0:  # an empty cell
        return after
    flags, at = _numbers(data, at, order, "flags")
    require(len(flags) == 2, f"{len(flags)} flags, expected 2")
    dimensions, at = _numbers(data, at, order, "dimensions")
    good = 2 <= len(dimensions) <= 32 and bool((dimensions >= 0).all())
    require(good, f"dimensions {dimensions.tolist()[:8]}")
    count = math.prod(dimensions.tolist())
    require_memory(8 * count, f"a variable of dimensions {dimensions.tolist()}")
    at = _values(data, at, order, None, "the name")
    number, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & COMPLEX_FLAG)
    if number == SPARSE:
        at = _sparse(data, at, order, dimensions, is_complex)
    elif number == CHAR:
        at = _values(data, at, order, None, "text")
    elif number in NUMERIC:
        for part in ("real parts", "imaginary parts")[: 1 + is_complex]:
            at = _values(data, at, order, count, part)
    elif number == CELL:
        at = _each(data, at, order, depth, count)
    elif number == STRUCT:
        length, at = _numbers(data, at, order, "the length of field names")
        require(len(length) == 1 and 1 <= length[0] <= 64, "the length of field names is not one of 1 to 64")
        _, _, total, _ = _element(data, at, order)
        at = _values(data, at, order, None, "field names")
        at = _each(data, at, order, depth, count * (total // int(length[0])))
    else:
        raise InputError(f"holds a variable of class {number}; numbers, text, cells and structures are read")
    require(at == after, "a variable's parts do not fill it")
    return after


def _each(data: bytes, at: int, order: str, depth: int, count: int) -> int:
    # each takes eight bytes at least
    require(count <= (len(data) - at) // 8, f"{count} cells or fields in {len(data) - at} bytes")
    for _ in range(count):
        at = _matrix(data, at, order, depth + 1)
    return at


def _sparse(data: bytes, at: int, order: str, dimensions: np.ndarray, is_complex: bool) -> int:
    """Check a sparse matrix: row indices inside it, column starts that rise from 0 to their number."""
    require(len(dimensions) == 2, f"a sparse matrix of {len(dimensions)} dimensions")
    rows, columns = (int(side) for side in dimensions)
    index, at = _numbers(data, at, order, "row indices")
    starts, at = _numbers(data, at, order, "column starts")
    require(len(starts) == columns + 1, f"{len(starts)} column starts for {columns} columns")
    rise = starts[0] == 0 and bool((np.diff(starts) >= 0).all())
    require(rise and starts[-1] <= len(index), "column starts do not rise from 0 to the number of row indices")
    used = index[: starts[-1]]
    require(not used.size or (used.min() >= 0 and used.max() < rows), f"a row index is outside 0 to {rows - 1}")
    for part in ("real parts", "imaginary parts")[: 1 + is_complex]:
        kind, _, size, after = _element(data, at, order)
        _values(data, at, order, None, part)
        held = size // ITEM_BYTES[kind]
        require(starts[-1] <= held, f"{held} {part} for {starts[-1]} entries of a sparse matrix")
        at = after
    return at
