"""Write OpenEXR files, and tell by their chunk tables and last chunk alone whether they were written to the end.

OpenEXR does not report it where the last bytes of its buffer, or the tables that it fills in afterwards, are lost to a
full disk.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    import OpenEXR

MAGIC, MULTI_PART = 20000630, 0x1000
DEEP = b"deepscanline"


def write_exr(file: OpenEXR.File, path: Path) -> None:
    """Write a file; OSError where that fails, or ends early, and for a name that OpenEXR cannot take."""
    try:
        file.write(str(path))
    except RuntimeError as error:
        raise OSError(str(error)) from None
    except UnicodeEncodeError:
        raise OSError("its name is no UTF-8 text") from None
    if not is_complete(path):
        raise OSError("its last bytes were lost: is the disk full?")


def is_complete(path: Path) -> bool:
    """Tell whether the offset of every chunk is written and the file ends where its last chunk does: a file of one
    part, or several, whose first chunk was written first."""
    with path.open("rb") as file:
        try:
            magic, version = struct.unpack("<II", file.read(8))
            several = bool(version & MULTI_PART)
            types = [_header(file).get(b"type")]
            while several and (header := _header(file)):
                types.append(header.get(b"type"))
            offsets = _offsets(file)
            file.seek(max(offsets))
            part = struct.unpack("<i", file.read(4))[0] if several else 0
            # then the chunk's first row; of deep rows a table of counts precedes the values, and both have a size
            sizes = "<4xQQ8x" if types[part] == DEEP else "<4xi"
            lengths = struct.unpack(sizes, file.read(struct.calcsize(sizes)))
            end = file.tell() + sum(lengths)
            return magic == MAGIC and min(offsets) > 0 and end == file.seek(0, 2)
        except (struct.error, IndexError, ValueError):  # the file ends before it tells
            return False


def _offsets(file: BinaryIO) -> tuple[int, ...]:
    """Read the tables of all parts, which end where the first chunk begins."""
    start = file.tell()
    (first,) = struct.unpack("<Q", file.read(8))
    file.seek(start)
    count = max(first - start, 0) // 8
    return struct.unpack(f"<{count}Q", file.read(8 * count))


def _header(file: BinaryIO) -> dict[bytes, bytes]:
    """Read the attributes of the next part; none after the last."""
    found = {}
    while name := _text(file):
        _text(file)  # its type
        found[name] = file.read(struct.unpack("<i", file.read(4))[0])
    return found


def _text(file: BinaryIO) -> bytes:
    found = b""
    while (byte := file.read(1)) not in (b"", b"\0"):
        found += byte
    return found
