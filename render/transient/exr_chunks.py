"""Tell whether a multi-part OpenEXR file was written to its end, by its tables of chunks and the last chunk alone."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

HEAD = 8  # bytes of magic number and version
DEEP = b"deepscanline"


def is_complete(path: Path) -> bool:
    """Tell whether the offset of every chunk is written and the file ends where its last chunk does.

    OpenEXR does not report it where the last bytes of its buffer, or the tables that it fills in afterwards, are lost
    to a full disk.
    """
    with path.open("rb") as file:
        file.seek(HEAD)
        try:
            parts = []
            while header := _header(file):
                parts.append(header)
            counts = [struct.unpack("<i", header[b"chunkCount"])[0] for header in parts]
            offsets = [one for count in counts for one in struct.unpack(f"<{count}Q", file.read(8 * count))]
            if min(offsets) == 0:
                return False
            file.seek(max(offsets))
            part = struct.unpack("<i4x", file.read(8))[0]  # and the chunk's first row
            # of deep rows a table of counts precedes the values, and both have a size
            sizes = "<QQ8x" if parts[part][b"type"] == DEEP else "<i"
            lengths = struct.unpack(sizes, file.read(struct.calcsize(sizes)))
            end = file.tell() + sum(lengths)
            return end == file.seek(0, 2)
        except (struct.error, KeyError, IndexError, ValueError):  # the file ends before it tells
            return False


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
