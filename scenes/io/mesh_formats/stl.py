"""Check an STL, binary or text, and read its colours."""

from __future__ import annotations

import re
import struct

import numpy as np

from scenes.errors import InputError, require

STL_HEADER = 80  # bytes before the number of triangles
_STL_START, _STL_TRIANGLE = 84, 50
_NUMBER = rb"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf(?:inity)?)"
_NO_POINT = re.compile(rb"^[ \t]*vertex\b(?!(?:[ \t]+%s){3}[ \t]*$).*$" % _NUMBER, re.MULTILINE)  # in small letters


def plain_stl(content: bytes) -> tuple[bytes, int]:
    """Return an STL as trimesh reads it rightly, and its number of triangles. InputError for one that was cut.

    A text begins at its first solid, and its lines end by LF.
    """
    if len(content) >= _STL_START:
        count = struct.unpack_from("<I", content, STL_HEADER)[0]
        expected = _STL_START + count * _STL_TRIANGLE
        if len(content) == expected:
            return content, count
        message = f"cut short or damaged: its header says {count} triangles in {expected} bytes, it has {len(content)}"
        if len(content) > expected:
            message = f"{len(content) - expected} bytes after the last of the {count} triangles that its header says"
        require(b"\0" not in content, message)
    text = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    start = re.search(rb"^[ \t]*solid\b", text, re.MULTILINE | re.IGNORECASE)
    if start is None:
        raise InputError("is no STL: neither binary, nor text with a line that begins with solid")
    before, text = text[: start.start()], text[start.start() :]
    return text, _check_stl_text(text.lower(), before.count(b"\n") + 1)


def _check_stl_text(text: bytes, first_line: int) -> int:
    words = ("solid", "endsolid", "facet", "endfacet", "vertex")
    counts = {word: len(re.findall(rb"^[ \t]*%s\b" % word.encode(), text, re.MULTILINE)) for word in words}
    whole = counts["solid"] == counts["endsolid"] and counts["facet"] == counts["endfacet"]
    whole = whole and counts["vertex"] == 3 * counts["facet"]
    require(whole, f"cut short or damaged: {', '.join(f'{count} {word}' for word, count in counts.items())}")
    wrong = _NO_POINT.search(text)
    if wrong is not None:
        line, found = first_line + text.count(b"\n", 0, wrong.start()), wrong[0].strip()[:40].decode(errors="replace")
        raise InputError(f"line {line}: {found!r}, expected vertex and three numbers")
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


def has_some_colours(header: bytes, attributes: np.ndarray) -> bool:
    """Return whether a binary STL has colours of some faces alone, of which `stl_colours` gives none."""
    return stl_colours(header, attributes) is None and bool((attributes >> 15 == 1).any())
