"""Check an STL, binary or text."""

from __future__ import annotations

import re
import struct

from scenes.errors import require

_STL_HEADER, _STL_TRIANGLE = 84, 50


def check_stl(content: bytes) -> int:
    """Return the number of triangles of an STL, binary or text. InputError for one that was cut."""
    if len(content) >= _STL_HEADER:
        count = struct.unpack_from("<I", content, _STL_HEADER - 4)[0]
        expected = _STL_HEADER + count * _STL_TRIANGLE
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
