"""Check an STL, binary or text, and read its colours."""

from __future__ import annotations

import re
import struct

import numpy as np

from scenes.errors import require

STL_HEADER = 80  # bytes before the number of triangles
_STL_START, _STL_TRIANGLE = 84, 50


def check_stl(content: bytes) -> int:
    """Return the number of triangles of an STL, binary or text. InputError for one that was cut."""
    if len(content) >= _STL_START:
        count = struct.unpack_from("<I", content, STL_HEADER)[0]
        expected = _STL_START + count * _STL_TRIANGLE
        if len(content) == expected:
            return count
        text = content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower()
        message = f"cut short or damaged: its header says {count} triangles in {expected} bytes, it has {len(content)}"
        if len(content) > expected:
            message = f"{len(content) - expected} bytes after the last of the {count} triangles that its header says"
        require(text, message)
    return _check_stl_text(content.lower())


def _check_stl_text(text: bytes) -> int:
    words = ("solid", "endsolid", "facet", "endfacet", "vertex")
    counts = {word: len(re.findall(rb"^[ \t]*%s\b" % word.encode(), text, re.MULTILINE)) for word in words}
    whole = counts["solid"] == counts["endsolid"] and counts["facet"] == counts["endfacet"]
    whole = whole and counts["vertex"] == 3 * counts["facet"]
    require(whole, f"cut short or damaged: {', '.join(f'{count} {word}' for word, count in counts.items())}")
    return counts["facet"]


def stl_colours(header: bytes, attributes: np.ndarray) -> np.ndarray | None:
    """Return the colours (faces, 3) of a binary STL as shares of white; None where not every face has one.

    header      the STL_HEADER bytes that the file begins with
    attributes  16 bits of each face: five for each colour, and one that says whether they hold

    Programs do so in two ways. Those that name a colour of the whole body in the header, after COLOR=, have red in the
    lowest bits, and set the last bit for faces of the body's colour. Others have blue there, and set it for colours.
    """
    fives = (attributes[:, None] >> np.array((0, 5, 10))) & 31
    flagged = attributes >> 15 == 1
    body = header.partition(b"COLOR=")[2][:3]
    if len(body) == 3:
        whole = flagged | (not attributes.any())
        return np.where(whole[:, None], np.frombuffer(body, np.uint8) / 255, fives / 31)
    return fives[:, ::-1] / 31 if flagged.all() else None
