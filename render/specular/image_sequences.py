"""By way of which plane mirrors in a row the laser's light goes: those that rays from the laser find."""

from __future__ import annotations

import math

import numpy as np

from render.scene.rays import first_opaque, shape_index, spawn
from render.scene.traced_scene import Bool, Float, TracedScene, dr, mi, upload
from render.specular.mirrors import MAX_ORDER, Mirrors

MAX_IMAGES = 64  # sequences
# Rays a side of each face, and in all. A sequence that none of them takes is lit through less than a ten thousandth of
# a face.
RAYS_PER_SIDE, MAX_RAYS = 128, 1 << 21
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
    kept = rows[:, 0] >= 0
    rows, counts = rows[kept], counts[kept]
    rows = rows[np.lexsort((-counts, (rows >= 0).sum(axis=1)))]
    if len(rows) > MAX_IMAGES:
        notes.append(f"mirrored light: {len(rows) - MAX_IMAGES} of {len(rows)} ways by mirrors are left out")
    return [row[row >= 0] for row in rows[:MAX_IMAGES]]


def _sequences_of_rays(world: TracedScene, mirrors: Mirrors, metal: np.ndarray) -> np.ndarray:
    """Return the sequences that rays from the laser to all faces take, (rays, MAX_ORDER) planes; -1 fills their
    ends."""
    side = min(RAYS_PER_SIDE, max(1, math.isqrt(MAX_RAYS // len(metal))))
    right, up = np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2)
    corners = mirrors.corners[metal][:, :, None]
    points = corners[:, 0] + right.reshape(-1, 1) * (corners[:, 2] - corners[:, 0])
    points = (points + up.reshape(-1, 1) * (corners[:, 1] - corners[:, 0])).reshape(-1, 3) + world.eye_m
    laser = world.scene.laser.position(world.scene.camera) - world.origin
    way = points - laser
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-300)
    ray = mi.Ray3f(mi.Point3f(world.laser), mi.Vector3f(*(upload(Float, axis) for axis in way.T)))
    active, begin, found = dr.full(Bool, True, len(way)), None, []
    met = np.empty((0, len(way)), np.int64)
    for _ in range(MAX_ORDER):
        si = first_opaque(world, ray, active, begin)[0]
        hit, shape, begin = active & si.is_valid(), shape_index(si), mi.Point3f(si.p)
        ray = spawn(si, ray.d - 2 * dr.dot(si.n, ray.d) * si.n)
        dr.eval(hit, shape, begin, ray)
        plane = _plane_at(mirrors, metal, np.array(begin).T - world.eye_m, np.array(shape))
        going = np.array(hit) & (plane >= 0)
        met = np.concatenate((plane[None], met))  # the last mirror of a sequence is met first
        row = np.full((len(way), MAX_ORDER), -1)
        row[:, : len(met)] = np.where(going, met, -1).T
        found.append(row)
        if not going.any():
            break
        active = upload(Bool, going)
    return np.concatenate(found)


def _plane_at(mirrors: Mirrors, metal: np.ndarray, points: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the metal plane of a shape on which each point lies, (n,); -1: none."""
    plane = np.full(len(points), -1)
    least = ON_PLANE * np.linalg.norm(points, axis=1)
    for one in metal:
        there = (plane < 0) & (shape == mirrors.shape[one])
        plane[there & (np.abs(points @ mirrors.normal[one] - mirrors.offset[one]) < least)] = one
    return plane
