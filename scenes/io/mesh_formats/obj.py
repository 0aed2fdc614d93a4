"""Put an OBJ as trimesh reads it rightly."""

from __future__ import annotations

import re

from scenes.errors import require
from scenes.io.mesh_formats import MAX_FRACTION, MAX_LEVEL

_CAPITALS = re.compile(rb"(?:^|\n)(?:[A-Z]|use[A-Z]|mtl[A-Z])")  # at the beginning of a keyword, or within one
_DIGITS = bytes.maketrans(b"023456789", b"111111111")
# by whether they have texture coordinates and normals
_CORNERS = {(False, False): b"1", (True, False): b"1/1", (False, True): b"1//1", (True, True): b"1/1/1"}


def plain_obj(content: bytes) -> bytes:
    """Return an OBJ as trimesh reads it rightly: no indents, tabs and comments, indices from the first vertex on,
    keywords in small letters.

    Lines end by LF, CR LF or CR.

    trimesh passes over indented lines, takes `mtllib` and `usemtl` of comments too, stumbles over a comment behind a
    face, counts negative indices from the end of the file instead of from their line, and takes vertex 0 for vertex 1.
    Raises InputError for an index of 0, or before the first.
    """
    content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\\\n", b" ").replace(b"\t", b" ")
    if content[:1] in b" #" or b"\n " in content or re.search(rb"\n#.*(?:mtllib|usemtl)", content):
        content = re.sub(rb"^ *#.*(?:mtllib|usemtl).*|^ +", b"", content, flags=re.MULTILINE)
    if _CAPITALS.search(content):
        content = re.sub(rb"^[A-Za-z]+(?= )", lambda key: key[0].lower(), content, flags=re.MULTILINE)
    if re.search(rb"^[fv].*#", content, re.MULTILINE):
        content = re.sub(rb"^((?:f|v|vt|vn) [^#\n]*)#.*", rb"\1", content, flags=re.MULTILINE)
    if re.search(rb"\nf[^-\n]*[ /]-|\nf.*? 0+(?=[ /\n]|$)", content) is None and content[:1] != b"f":
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


def has_colours(content: bytes) -> bool:
    """Return whether the first vertex of an OBJ has a colour behind its place, as those of many programs have."""
    first = re.search(rb"(?:^|[\r\n])[ \t]*[vV][ \t]([^#\r\n]*)", content)
    return first is not None and len(first[1].split()) >= 6


def plain_colours(content: bytes, textured: bool) -> bytes:
    """Return an OBJ whose colours per vertex trimesh reads rightly: as shares of white, and not beside coordinates.

    textured  whether a material of its libraries has a texture; without one, coordinates are of no use

    Numbers beyond MAX_FRACTION are levels up to MAX_LEVEL. trimesh takes them for white, and drops colours beside
    texture coordinates.
    """
    if not has_colours(content):
        return content
    vertices = [line.split() for line in re.findall(rb"^v +.*", content, re.MULTILINE)]
    first = 5 if _has_weights(vertices) else 4  # of the colours
    colours = {word for words in vertices for word in words[first : first + 3]}  # each is read once
    try:
        levels = max(map(float, colours), default=0.0) > MAX_FRACTION
    except ValueError:
        return content  # is told elsewhere
    if levels or first > 4:
        plain = {word: b"%.9g" % (float(word) / MAX_LEVEL) if levels else word for word in colours}
        found = iter(vertices)

        def line(_: re.Match[bytes]) -> bytes:
            words = next(found)
            return b" ".join((*words[:4], *map(plain.__getitem__, words[first : first + 3])))

        content = re.sub(rb"^v +.*", line, content, flags=re.MULTILINE)
    if textured:
        return content
    return re.sub(rb"(?:^f .*\n?){1,1000}", lambda faces: _without_coordinates(faces[0]), content, flags=re.MULTILINE)


def _has_weights(vertices: list[list[bytes]]) -> bool:
    """Return whether vertices have a weight of 1 before their colours: x y z 1 r g b, not x y z r g b alpha."""
    if any(len(words) != 8 for words in vertices):
        return False
    fourth, last = ({words[place] for words in vertices} for place in (4, 7))
    return _are_ones(fourth) and not _are_ones(last)


def _are_ones(words: set[bytes]) -> bool:
    try:
        return {float(word) for word in words} == {1.0}
    except ValueError:
        return False


def _without_coordinates(faces: bytes) -> bytes:
    """Return lines of faces whose corners have no texture coordinates: a/b/c is a//c, a/b is a."""
    faces = re.sub(rb"/[^/ \n]+/", b"//", faces)
    return re.sub(rb"(?<=[^/ \n])/(?:[^/ \n]*|/)(?=[ \n]|$)", b"", faces)


def alike_obj(content: bytes) -> tuple[bytes, bool]:
    """Return an OBJ in which all faces of a material are alike, and whether trimesh must keep its groups apart.

    trimesh drops the texture coordinates of a material's faces, or their normals, where one face has none. Such faces
    follow at the end, in groups that are named by what is missing; groups of the file itself go then. A corner keeps
    what all corners of its face have.
    """
    forms = content.translate(_DIGITS)
    while b"11" in forms:
        forms = forms.replace(b"11", b"1")
    faces = set(re.findall(rb"^f .*", forms, re.MULTILINE))
    if len({corner for face in faces for corner in face.split()[1:]}) <= 1:
        return content, False
    lines = content.split(b"\n")
    found = _kinds(lines, forms.split(b"\n"))
    apart = {
        (material, kind): numbers
        for material, kinds in found.items()
        for kind, numbers in kinds.items()
        if kind != max(kinds)
    }
    if not apart:
        return b"\n".join(lines), False
    lines = [b"" if line.startswith(b"g ") else line for line in lines]
    named = [any(kind[place] for kinds in found.values() for kind in kinds) for place in (0, 1)]
    for (material, kind), numbers in sorted(apart.items(), key=lambda one: one[0][1]):
        missing = [key for key, has, some in zip(("vt", "vn"), kind, named, strict=True) if some and not has]
        lines += [b"g faces without " + " and ".join(missing).encode(), b"usemtl " + material]
        for number in numbers:
            lines.append(lines[number])
            lines[number] = b""
    return b"\n".join(lines), True


def _kinds(lines: list[bytes], forms: list[bytes]) -> dict[bytes, dict[tuple[bool, bool], list[int]]]:
    """Return by material the lines of faces with and without texture coordinates and normals; made alike in each.

    forms  the lines with 1 in place of every number
    """
    found: dict[bytes, dict[tuple[bool, bool], list[int]]] = {}
    known: dict[bytes, tuple[bool, bool]] = {}
    material = b""
    for number, form in enumerate(forms):
        if form.startswith(b"usemtl "):
            material = lines[number][7:].strip()
        elif form.startswith(b"f ") and form.split()[1:]:
            if form not in known:
                corners = [(corner.split(b"/") + [b"", b""])[:3] for corner in form.split()[1:]]
                known[form] = all(corner[1] for corner in corners), all(corner[2] for corner in corners)
            kind = known[form]
            found.setdefault(material, {}).setdefault(kind, []).append(number)
            if {*form.split()[1:]} != {_CORNERS[kind]}:
                lines[number] = _cut_to(kind, lines[number])
    return found


def _cut_to(kind: tuple[bool, bool], face: bytes) -> bytes:
    """Return the line of a face with no texture coordinates, or no normals, where its kind has none."""
    kept = []
    for corner in face.split()[1:]:
        vertex, uv, normal = (corner.split(b"/") + [b"", b""])[:3]
        parts = (vertex, uv if kind[0] else b"", normal if kind[1] else b"")
        kept.append(b"/".join(parts).rstrip(b"/"))
    return b"f " + b" ".join(kept)


def obj_fault(content: bytes) -> str:
    """Return what is wrong with the first line that trimesh cannot read: a vertex or face, with its number; or ""."""
    lines = content.splitlines()
    keys = [line.split(maxsplit=1)[0].lower() if line.strip() else b"" for line in lines]
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
