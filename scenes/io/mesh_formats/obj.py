"""Put an OBJ as trimesh reads it rightly."""

from __future__ import annotations

import re

from scenes.errors import require


def plain_obj(content: bytes) -> bytes:
    """Return an OBJ as trimesh reads it rightly: no indents, tabs and comments, indices from the first vertex on.

    trimesh passes over indented lines, takes the first `mtllib` of comments too, stumbles over a comment behind a face,
    counts negative indices from the end of the file instead of from their line, and takes vertex 0 for vertex 1. Raises
    InputError for an index of 0, or before the first.
    """
    content = content.replace(b"\r\n", b"\n").replace(b"\\\n", b" ").replace(b"\t", b" ")
    if content[:1] in b" #" or b"\n " in content or re.search(rb"\n#.*mtllib", content):
        content = re.sub(rb"^ +|^#.*mtllib.*", b"", content, flags=re.MULTILINE)
    if re.search(rb"^[fv].*#", content, re.MULTILINE):
        content = re.sub(rb"^((?:f|v|vt|vn) [^#\n]*)#.*", rb"\1", content, flags=re.MULTILINE)
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


def obj_fault(content: bytes) -> str:
    """Return what is wrong with the first line that trimesh cannot read: a vertex or face, with its number; or ""."""
    lines = content.splitlines()
    keys = [line.split(maxsplit=1)[0] if line.strip() else b"" for line in lines]
    counts = [keys.count(key) for key in (b"v", b"vt", b"vn")]
    for number, (key, line) in enumerate(zip(keys, lines, strict=True), start=1):
        words = line.partition(b"#")[0].rstrip(b" \t\\").split()[1:]
        shown = line.strip().decode("utf-8", errors="replace")[:60]
        try:
            if key in (b"v", b"vt", b"vn"):
                require(len([float(word) for word in words]) >= (2 if key == b"vt" else 3), "too few numbers")
            elif key == b"f":
                for word in words:
                    for index, count in zip(word.split(b"/"), counts, strict=False):
                        if index and abs(int(index)) > count:
                            return f"line {number}: a face's index {int(index)}, {count} are there"
        except ValueError:  # of which InputError is one
            what = {b"f": "numbers of vertices", b"vt": "u v"}.get(key, "x y z")
            return f"line {number}: {shown!r} is not {what}"
    return ""
