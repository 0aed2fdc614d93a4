"""A scene farther away, in two of the three senses of DESIGN.md (`time` is a delay of the rendered transient).

ray    every vertex is pushed along its camera ray: each pixel keeps its content; slopes and radiometry change
rigid  the content moves away as a whole, and the field of view narrows to hold what it held at the median depth:
       real occlusion and footprints; pixels keep their content only at that depth
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np

from scenes.errors import InputError, require
from scenes.model import Scene, Surface

OffsetMode = Literal["time", "ray", "rigid"]
CHORD_M = 6e-4  # by which the middle of an edge may lie off its place; inside a face it is at most 1.4 times as much
MAX_SPLITS = 24
MAX_TRIANGLES = 20_000_000
LIMIT_M = 1e4


def check_offset(metres: float) -> float:
    """Return `metres` if it is a distance a scene may be moved by, else an InputError."""
    require(math.isfinite(metres) and 0 <= metres <= LIMIT_M, f"offset {metres:g} m is outside 0 to {LIMIT_M:g}")
    return metres


def check_delay(baseline_m: Iterable[float]) -> None:
    """Raise InputError where a delay is no distance: from a laser that is displaced by this baseline."""
    require(not any(baseline_m), "a time offset needs a co-located laser: with a baseline a delay is no distance")


def pushed_along_rays(scene: Scene, metres: float) -> Scene:
    """Return the scene with every point `metres` farther from the camera, along the ray on which the camera sees it.

    A point p in direction r and at distance d goes to p + metres r, at distance d + metres. A flat face does not stay
    flat, so faces are divided until pushed edges lie within 0.6 mm of their place. Shading
    normals follow: n' is along r (r n) + (n - r (r n)) / (1 + metres / d), the inverse transpose of the map.
    Raises InputError for a surface through the camera's centre.
    """
    check_offset(metres)
    origin = scene.camera.origin
    surfaces = tuple(_pushed(surface, origin, metres) for surface in scene.surfaces)
    triangles = sum(len(s.faces) for s in surfaces)
    return replace(
        scene,
        surfaces=surfaces,
        notes=(*scene.notes, f"ray offset {metres:g} m: {scene.triangles} to {triangles} faces"),
    )


def _pushed(surface: Surface, origin: np.ndarray, metres: float) -> Surface:
    vertices = surface.vertices - origin
    nearest = float(np.linalg.norm(vertices, axis=1).min())
    if nearest < 1e-6:
        raise InputError(f"ray offset: {surface.name} touches the camera's centre")
    columns = [vertices, *(a for a in (surface.uv, surface.normals) if a is not None)]
    table, faces = _divided(np.concatenate(columns, axis=1), surface.faces, metres, surface.name)
    vertices = table[:, :3]
    distance = np.linalg.norm(vertices, axis=1, keepdims=True)
    ray = vertices / distance
    uv = None if surface.uv is None else table[:, 3:5]
    normals = None
    if surface.normals is not None:
        given = table[:, -3:]
        along = ray * (given * ray).sum(axis=1, keepdims=True)
        normals = along + (given - along) / (1 + metres / distance)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.where(length > 0, length, 1)
    return replace(surface, vertices=origin + vertices + metres * ray, faces=faces, uv=uv, normals=normals)


def _divided(table: np.ndarray, faces: np.ndarray, metres: float, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (rows: x y z from the camera, then what is interpolated) and faces, every long edge cut in half.

    Whether an edge is cut depends on its two ends alone, so neighbouring faces agree and no gap opens.
    """
    finished = []
    for _ in range(MAX_SPLITS):
        edges = np.sort(faces[:, ((0, 1), (1, 2), (2, 0))].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        a, b = table[unique[:, 0], :3], table[unique[:, 1], :3]
        middle = (a + b) / 2
        off = metres * np.linalg.norm(_unit(middle) - (_unit(a) + _unit(b)) / 2, axis=1)
        cut = off > CHORD_M
        # a face without a cut edge is finished: none of its edges will ever be cut
        going_on = cut[inverse].reshape(-1, 3).any(axis=1)
        finished.append(faces[~going_on])
        if not going_on.any():
            return table, np.concatenate(finished)
        new = np.full(len(unique), -1)
        new[cut] = len(table) + np.arange(int(cut.sum()))
        table = np.concatenate((table, (table[unique[cut, 0]] + table[unique[cut, 1]]) / 2))
        faces = _split(faces[going_on], new[inverse].reshape(-1, 3)[going_on])
        if sum(map(len, finished)) + len(faces) > MAX_TRIANGLES:
            raise InputError(f"ray offset: {name} needs more than {MAX_TRIANGLES} faces; it comes too near the camera")
    raise InputError(f"ray offset: {name} comes too near the camera to be divided finely enough")


def _unit(points: np.ndarray) -> np.ndarray:
    return np.asarray(points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12))


def _split(faces: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Faces with one to three cut edges, at the given new vertices of ab, bc, ca (-1: not cut): into two to four."""
    count = (middle >= 0).sum(axis=1)
    # turn each face so that its one cut edge, or its one uncut edge, is ab
    first = np.where(count == 2, np.argmin(middle >= 0, axis=1), np.argmax(middle >= 0, axis=1))
    turn = (first[:, None] + np.arange(3)) % 3
    corner, cut = np.take_along_axis(faces, turn, axis=1), np.take_along_axis(middle, turn, axis=1)
    a, b, c, ab, bc, ca = np.column_stack((corner, cut))[count == 1].T
    made = [np.column_stack(t) for t in ((a, ab, c), (ab, b, c))]
    a, b, c, ab, bc, ca = np.column_stack((corner, cut))[count == 2].T
    made += [np.column_stack(t) for t in ((a, b, bc), (a, bc, ca), (ca, bc, c))]
    a, b, c, ab, bc, ca = np.column_stack((corner, cut))[count == 3].T
    made += [np.column_stack(t) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(made)


def moved_away(scene: Scene, metres: float, *, median_m: float, nearest_m: float) -> Scene:
    """Return the content `metres` farther along the camera's axis, which is the same as the camera that far back.

    median_m, nearest_m: median and least depth along the axis of what the image shows. The new image holds, at the
    median depth, what the old one held: tan(fov'/2) = tan(fov/2) median / (median + metres). What lies nearer than
    the nearest thing in the image, a wall behind the camera for one, is cut away: it would stand in between.
    """
    check_offset(metres)
    require(
        0 < nearest_m <= median_m < math.inf, f"rigid offset: depths {nearest_m:g} and {median_m:g} m are not in order"
    )
    camera = scene.camera
    axis = camera.rotation[:, 2]
    kept = [_beyond(s, camera.origin, axis, 0.999 * nearest_m) for s in scene.surfaces]
    pose = camera.pose.copy()
    pose[:3, 3] -= metres * axis
    half = math.tan(math.radians(camera.fov_deg) / 2) * median_m / (median_m + metres)
    moved = replace(camera, pose=pose, fov_deg=math.degrees(2 * math.atan(half)))
    note = f"rigid offset {metres:g} m: field of view {camera.fov_deg:.4g} to {moved.fov_deg:.4g} degrees"
    return replace(scene, surfaces=tuple(s for s in kept if s is not None), camera=moved, notes=(*scene.notes, note))


def _beyond(surface: Surface, origin: np.ndarray, axis: np.ndarray, least_m: float) -> Surface | None:
    """Cut off the part of a surface that lies less than `least_m` along the axis: faces that cross the plane are cut
    along it."""
    depth = (surface.vertices - origin) @ axis - least_m
    inside = depth[surface.faces] >= 0
    count = inside.sum(axis=1)
    if count.all() and (count == 3).all():
        return surface
    if not count.any():
        return None
    columns = [surface.vertices, *(a for a in (surface.uv, surface.normals) if a is not None)]
    table = np.concatenate(columns, axis=1)
    faces, made = [surface.faces[count == 3]], [table]
    for corners in (1, 2):
        crossing = surface.faces[count == corners]
        alone = np.argmax(inside[count == corners] == (corners == 1), axis=1)
        a, b, c = np.take_along_axis(crossing, (alone[:, None] + np.arange(3)) % 3, axis=1).T
        start = sum(map(len, made))
        n = len(a)
        for other in (b, c):
            fraction = depth[a] / (depth[a] - depth[other])
            made.append(table[a] + fraction[:, None] * (table[other] - table[a]))
        ab, ac = start + np.arange(n), start + n + np.arange(n)
        pieces = [(a, ab, ac)] if corners == 1 else [(ab, b, c), (ab, c, ac)]
        faces += [np.column_stack(piece) for piece in pieces]
    used, renumbered = np.unique(np.concatenate(faces), return_inverse=True)
    table = np.concatenate(made)[used]
    uv = None if surface.uv is None else table[:, 3:5]
    normals = None if surface.normals is None else table[:, -3:]
    return replace(surface, vertices=table[:, :3], faces=renumbered.reshape(-1, 3), uv=uv, normals=normals)
