"""Cut polygons of an OBJ or a PLY with dents into triangles: a fan from their first corner covers what is outside."""

from __future__ import annotations

import re

import numpy as np

MAX_CORNERS = 1000  # of a polygon that is cut so: the time grows with their square
TURNED = -1e-9  # share of its size by which a triangle of a fan is turned round; above, it is rounding


def without_dents(content: bytes) -> bytes:
    """Return an OBJ in which the polygons that a fan from their first corner would cut wrongly are triangles.

    A polygon that crosses itself, or has more than MAX_CORNERS corners, stays as it is; so does a file with numbers
    that cannot be read, which are told elsewhere. Indices count from 1.
    """
    faces = [*re.finditer(rb"^f(?: +[^ \n]+){4,} *$", content, re.MULTILINE)]
    if not faces:
        return content
    corners = [face[0].split()[1:] for face in faces]
    try:
        lines = re.findall(rb"^v +([^\n]*)", content, re.MULTILINE)
        points = np.array([[*map(float, line.split(maxsplit=3)[:3])] for line in lines])
        bare = re.sub(rb"/[^ ]*", b"", b" ".join(map(b" ".join, corners)))
        indices = np.array([*map(int, bare.split())]) - 1
        ends = np.cumsum([*map(len, corners)])
        dented = _dented(points, indices, ends)
    except (ValueError, IndexError, OverflowError):
        return content
    parts, end = [], 0
    for number in dented:
        triangles = cut_polygon(points[indices[ends[number] - len(corners[number]) : ends[number]]])
        rows = [b" ".join((b"f", *(corners[number][i] for i in one))) for one in triangles]
        parts += [content[end : faces[number].start()], b"\n".join(rows)] if rows else []
        end = faces[number].end() if rows else end
    return b"".join((*parts, content[end:]))


def triangulated(
    points: np.ndarray, corners: np.ndarray, lengths: np.ndarray, *, fans: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons into triangles: each is three places (m, 3) in `corners`, and of the polygon of that number (m,).

    points   (n, 3)
    corners  indices of points of all polygons, one after the other
    lengths  how many corners each polygon has, 3 or more
    fans     cut all into fans from their first corner, those with dents, too

    Polygons that cross themselves, or are too large, are fans always.
    """
    ends, counts = np.cumsum(lengths), lengths - 2
    owners = np.repeat(np.arange(len(lengths)), counts)
    inside = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
    triangles = (ends - lengths)[owners, None] + np.column_stack((0 * inside, inside + 1, inside + 2))
    cut = {}
    for number in [] if fans else _dented(points, corners, ends):
        start = int(ends[number] - lengths[number])
        cut[number] = start + np.reshape(cut_polygon(points[corners[start : ends[number]]]), (-1, 3)).astype(np.int64)
    cut = {number: found for number, found in cut.items() if len(found)}
    if not cut:
        return triangles, owners
    kept = ~np.isin(owners, [*cut])
    owners = np.concatenate((owners[kept], *(np.full(len(found), number) for number, found in cut.items())))
    return np.concatenate((triangles[kept], *cut.values())), owners


def _dented(points: np.ndarray, indices: np.ndarray, ends: np.ndarray) -> list[int]:
    """Return the numbers of the polygons of which a fan has a triangle that is turned round; `ends` of their
    corners."""
    sizes = np.diff(ends, prepend=0)
    found: list[int] = []
    for size in np.unique(sizes[(sizes > 3) & (sizes <= MAX_CORNERS)]):
        numbers = np.flatnonzero(sizes == size)
        spokes = points[indices[ends[numbers, None] + np.arange(-size, 0)]]
        spokes = spokes[:, 1:] - spokes[:, :1]
        areas = np.cross(spokes[:, :-1], spokes[:, 1:])
        whole = areas.sum(axis=1, keepdims=True)
        length = np.linalg.norm(areas, axis=2).max(axis=1) * np.linalg.norm(whole[:, 0], axis=1)
        turned = ((areas * whole).sum(axis=2) < TURNED * length[:, None]).any(axis=1)
        found += numbers[turned].tolist()
    return sorted(found)


def cut_polygon(points: np.ndarray) -> list[tuple[int, int, int]]:
    """Cut a polygon (n, 3) into triangles of its corners by clipping ears; none where it crosses itself.

    A corner on a straight side makes no triangle of its own.
    """
    spokes = points[1:] - points[0]
    normal = np.cross(spokes[:-1], spokes[1:]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(points, axis, axis=1)
    if (normal[axis] < 0) != (axis == 1):
        flat = flat[:, ::-1]
    least = 1e-12 * float(np.abs(normal[axis]))
    left, found = [*range(len(points))], []
    while len(left) > 2:
        for at in range(len(left)):
            corner = left[at - 1], left[at], left[(at + 1) % len(left)]
            area = _area(flat[corner[0]], flat[corner[1]], flat[corner[2]])
            if abs(area) <= least or (area > 0 and not _holds_any(flat[[*corner]], flat[left])):
                found += [corner] if area > least else []
                del left[at]
                break
        else:
            return []
    return found


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Compute twice the area of triangles in a plane, below 0 where they run clockwise."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def _holds_any(triangle: np.ndarray, points: np.ndarray) -> bool:
    """Tell whether points (n, 2) other than its corners lie in a triangle (3, 2), or on its border."""
    a, b, c = triangle
    inside = (_area(a, b, points) >= 0) & (_area(b, c, points) >= 0) & (_area(c, a, points) >= 0)
    return bool((inside & (points[:, None] != triangle).any(axis=2).all(axis=1)).any())
