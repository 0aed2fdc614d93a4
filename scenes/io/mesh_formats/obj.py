"""Put an OBJ as trimesh reads it rightly."""

from __future__ import annotations

import re

from scenes.errors import require


def plain_obj(content: bytes) -> bytes:
    """Return an OBJ as trimesh reads it rightly: no indents and tabs, indices from the first vertex on.

    trimesh passes over indented lines, takes the first `mtllib` of comments too, counts negative indices from the end
    of the file instead of from their line, and takes vertex 0 for vertex 1. Raises InputError for an index of 0, or
    before the first.
    """
    content = content.replace(b"\r\n", b"\n").replace(b"\\\n", b" ").replace(b"\t", b" ")
    if content[:1] in b" #" or b"\n " in content or re.search(rb"\n#.*mtllib", content):
        content = re.sub(rb"^ +|^#.*mtllib.*", b"", content, flags=re.MULTILINE)
    if re.search(rb"\nf[^-\n]*[ /]-|\nf.*? 0+(?=[ /\n]|$)", content) is None:
        return content
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = content.split(b"\n")
    for number, line in enumerate(lines):
        key, *corners = line.partition(b"#")[0].split() or [b""]
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            found = [_corner(corner, [*counts.values()], number + 1) for corner in corners]
            lines[number] = b" ".join((key, *found))
    return b"\n".join(lines)


def _corner(corner: bytes, counts: list[int], line: int) -> bytes:
    """Return a corner, vertex/uv/normal, with indices that count from 1; `counts` of each are above its line."""
    parts = corner.split(b"/")
    for place, count in zip(range(len(parts)), counts, strict=False):
        index = int(parts[place] or 1)
        wrong = index < -count or (index == 0 and place == 0)
        require(not wrong, f"line {line}: a face's index {index}, {count} are there to count back, and 1 is the first")
        if index < 0:
            parts[place] = b"%d" % (count + 1 + index)
    return b"/".join(parts)
