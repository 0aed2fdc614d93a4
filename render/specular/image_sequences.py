"""By way of which plane mirrors in a row the laser's light goes: those that rays from the laser find."""

from __future__ import annotations

import math

import numpy as np

from render.scene.rays import first_opaque, shape_index, spawn
from render.scene.traced_scene import Bool, Float, TracedScene, dr, mi, upload
from render.specular.mirrors import MAX_ORDER, Mirrors

MAX_IMAGES = 64  # sequences
# Rays a side of each face, and in all. A sequence that none of them takes is lit through less than a ten thousandth of
# a face; of more than 32 faces, through more.
RAYS_PER_SIDE, MAX_RAYS = 128, 1 << 19
MAX_COATS = 16  # plane faces of glass and of smooth plastic
MAX_FACING = 256  # planes among which it is looked which one a mirrored ray meets
ON_PLANE = 1e-5  # of the distance: what a hit may lie off a plane


def image_sequences(world: TracedScene, mirrors: Mirrors, notes: list[str]) -> list[np.ndarray]:
    """Return sequences (k,) of metal planes that the laser's light takes, k = 1 to MAX_ORDER, the shorter ones first.

    Planes are in order from what they light to the laser. Of more than MAX_IMAGES sequences those of few planes are
    taken, and of these those that most rays take; `notes` says so.
    """
    metal = np.flatnonzero(mirrors.is_metal)
    if len(metal) == 0:
        return []
    rows, counts = np.unique(_sequences_of_rays(world, mirrors, metal), axis=0, return_counts=True)
    if len(metal) > MAX_FACING:
        notes.append(
            f"mirrored light: ways by two or more of {len(metal)} planes are left out, the limit is {MAX_FACING}"
        )
    rows = rows[np.lexsort((-counts, (rows >= 0).sum(axis=1)))]
    if len(rows) > MAX_IMAGES:
        notes.append(f"mirrored light: {len(rows) - MAX_IMAGES} of {len(rows)} ways by mirrors are left out")
    return [row[row >= 0] for row in rows[:MAX_IMAGES]]


def coat_sequences(world: TracedScene, mirrors: Mirrors, notes: list[str]) -> list[np.ndarray]:
    """Return the planes of glass and of smooth plastic, a sequence (1,) each, that the laser may shine on.

    Of more than MAX_COATS those are taken that look largest from the laser; `notes` says so.
    """
    camera, laser = world.scene.camera, world.scene.laser
    coats = np.flatnonzero(~mirrors.is_metal)
    corners = mirrors.corners[coats] - (laser.position(camera) - camera.origin)
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    middle = corners.mean(axis=1)
    distance = np.linalg.norm(middle, axis=1)
    radius = np.arctan2(np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1), distance)
    lit = np.full(len(coats), True)
    if laser.mode == "flood":
        off = np.arccos(np.clip(middle @ camera.rotation[:, 2] / np.maximum(distance, 1e-300), -1, 1))
        lit = off - radius <= laser.half_angle(camera)
    area = np.linalg.norm(np.cross(*sides), axis=-1) * np.abs((mirrors.normal[coats] * middle).sum(axis=1))
    order = np.argsort(-area / np.maximum(distance, 1e-300) ** 3, kind="stable")
    order = order[lit[order]]
    if len(order) > MAX_COATS:
        left_out = f"{len(order) - MAX_COATS} of {len(order)}"
        notes.append(f"glass and smooth plastic: what {left_out} plane faces throw on other surfaces is left out")
    return [coats[[face]] for face in order[:MAX_COATS]]


def _sequences_of_rays(world: TracedScene, mirrors: Mirrors, metal: np.ndarray) -> np.ndarray:
    """Return the sequences that rays from the laser to all faces take, (n, MAX_ORDER) planes; -1 fills their ends."""
    side = min(RAYS_PER_SIDE, max(1, math.isqrt(MAX_RAYS // len(metal))))
    right, up = np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2)
    corners = mirrors.corners[metal][:, :, None]
    points = corners[:, 0] + right.reshape(-1, 1) * (corners[:, 2] - corners[:, 0])
    points = (points + up.reshape(-1, 1) * (corners[:, 1] - corners[:, 0])).reshape(-1, 3) + world.eye_m
    way = points - (world.scene.laser.position(world.scene.camera) - world.origin)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-300)
    ray = mi.Ray3f(mi.Point3f(world.laser), mi.Vector3f(*(upload(Float, axis) for axis in way.T)))
    active, begin, found = dr.full(Bool, True, len(way)), None, []
    met = np.empty((0, len(way)), np.int64)
    for order in range(MAX_ORDER if len(metal) <= MAX_FACING else 1):
        si = first_opaque(world, ray, active, begin)[0]
        hit, shape, begin = active & si.is_valid(), shape_index(si), mi.Point3f(si.p)
        ray = spawn(si, ray.d - 2 * dr.dot(si.n, ray.d) * si.n)
        dr.eval(hit, shape, begin, ray)
        # rays at a face that meet another first leave that one to its own rays
        candidates = np.repeat(metal, side * side)[None] if order == 0 else metal[:, None]
        plane = _plane_at(mirrors, candidates, np.array(begin).T - world.eye_m, np.array(shape), np.array(hit))
        going = plane >= 0
        met = np.concatenate((plane[None], met))  # the last mirror of a sequence is met first
        row = np.full((int(going.sum()), MAX_ORDER), -1)
        row[:, : len(met)] = met[:, going].T
        found.append(row)
        active = upload(Bool, going)
    return np.concatenate(found)


def _plane_at(
    mirrors: Mirrors, candidates: np.ndarray, points: np.ndarray, shape: np.ndarray, hit: np.ndarray
) -> np.ndarray:
    """Return the first of the candidate planes, (k, n) or (k, 1), on which each point that was hit lies, (n,); -1:
    none."""
    plane = np.full(len(points), -1)
    least = ON_PLANE * np.linalg.norm(points, axis=1)
    for row in candidates:
        left = np.flatnonzero(hit & (plane < 0))
        one = row if len(row) == 1 else row[left]
        off = (points[left] * mirrors.normal[one]).sum(axis=1) - mirrors.offset[one]
        there = (mirrors.shape[one] == shape[left]) & (np.abs(off) < least[left])
        plane[left[there]] = np.broadcast_to(one, len(left))[there]
    return plane
