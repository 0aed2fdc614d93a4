"""Mirrored light: what the camera sees by way of mirrors, and what it sees lit by way of mirrors."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from render.scene.traced_scene import TracedScene
from render.specular.mirrored_cells import CELLS_PER_LAUNCH, lit_cells, seen_cells
from render.specular.mirrors import Mirrors, image_of
from render.specular.unfolded_ways import MirrorTables
from render.transient.samples import Samples, merge, select
from scenes.model import Camera

FINER, FINER_M = (32, 128), 2e-3  # cells a side of pixels with narrow highlights, of those uneven still; merged within
RESOLVED = 0.5  # of a lobe's width between neighbouring cells: those that are no farther apart miss no highlight


class Ways(NamedTuple):
    """Ways of light: sequences of planes (k,) by which the laser's light comes, from what they light to the laser, one
    after the other; the flat pixels looked at, sorted; the most surfaces met; and the number of the face of glass, from
    0 on, that the camera looks by (None: it looks straight, or by mirrors)."""

    sequences: tuple[np.ndarray, ...]
    pixels: np.ndarray
    bounces: int
    face: int | None = None


class _Traced(NamedTuple):
    """Mirrored light of one sequence in some pixels: a sample a lit cell, launch by launch; and which pixels may have a
    highlight between their cells."""

    parts: list[Samples]
    narrow: list[np.ndarray]


def mirrored_light(
    world: TracedScene,
    tables: MirrorTables,
    mirrors: Mirrors,
    ways: Ways,
    grid: int,
    allowed: tuple[float, float],
) -> list[Samples]:
    """Trace what the camera sees by these ways: directly or by way of up to MAX_ORDER mirrors, of which a face of glass
    may be the first; without planes only by way of mirrors or such a face.

    Pixels whose cells are uneven get FINER ones, until the root sum square of what the others' means may be off by is
    within `allowed`, of each sequence: such a fraction (0: not asked) of that of its light and of other light together.
    """
    at_first = _of_pixels(world, tables, mirrors, ways, ways.pixels, grid)
    parts = []
    for sequence, traced in zip(ways.sequences, at_first, strict=True):
        trace = partial(_of_pixels, world, tables, mirrors, ways._replace(sequences=(sequence,)))
        parts += _refined(world.scene.camera, traced, trace, grid, allowed)
    return parts


def _refined(
    camera: Camera, traced: _Traced, trace: Callable, grid: int, allowed: tuple[float, float]
) -> list[Samples]:
    """Return samples of pixels that `grid` cells a side show well enough, and finer ones of the others, which `trace`
    traces."""
    fraction, other = allowed
    pixels, parts = camera.height * camera.width, list[Samples]()
    pixel, radiance = (np.concatenate([part[k] for part in traced.parts]) for k in (0, 3))
    most = fraction * math.hypot(other, float(np.linalg.norm(np.bincount(pixel, radiance, pixels))))
    # what a pixel shows may reach into its neighbours, between their cells
    narrow = np.zeros((camera.height, camera.width), bool)
    narrow.flat[np.concatenate(traced.narrow)] = True
    finer = binary_dilation(narrow, np.ones((3, 3))).ravel()
    sides = (grid, *(side for side in FINER if side > grid and fraction > 0))
    for side in sides:
        finer = (finer | _too_uneven(_unevenness(traced.parts, pixels, side), most)) & (side < sides[-1])
        within = 0 if side == grid else FINER_M
        parts += (merge(select(part, ~finer[part.pixel]), within) for part in traced.parts)
        if not finer.any():
            break
        (traced,) = trace(np.flatnonzero(finer), sides[sides.index(side) + 1])
        finer = np.zeros(pixels, bool)
    return parts


def _of_pixels(
    world: TracedScene, tables: MirrorTables, mirrors: Mirrors, ways: Ways, pixels: np.ndarray, grid: int
) -> list[_Traced]:
    """Return the mirrored light of each sequence in some pixels."""
    camera, laser = world.scene.camera, world.scene.laser
    traced = [_Traced([], []) for _ in ways.sequences]
    per_chunk = max(1, CELLS_PER_LAUNCH // grid**2)
    for first in range(0, len(pixels), per_chunk):
        chunk = pixels[first : first + per_chunk]
        seen = seen_cells(world, tables, chunk, grid, ways.face)
        for sequence, (parts, narrow) in zip(ways.sequences, traced, strict=True):
            image = image_of(mirrors, sequence[None], laser.position(camera) - camera.origin)[0] + world.eye_m
            found = lit_cells(world, tables, seen, grid, image, sequence)
            path, half_width, radiance, met, polished, off_peak = (np.array(part) for part in found)
            narrow.append(chunk[_may_miss_highlights(polished, off_peak, grid)])
            bounces = met + 1 + len(sequence)
            lit = np.flatnonzero((radiance > 0) & (bounces <= ways.bounces))
            path, half_width, radiance = (values[lit].astype(float) for values in (path, half_width, radiance))
            number = bounces[lit].astype(np.uint8)
            parts.append(Samples(chunk[lit // grid**2], path, half_width, radiance, number))
    return traced


def _may_miss_highlights(polished: np.ndarray, off_peak: np.ndarray, grid: int) -> np.ndarray:
    """Return which pixels have polished cells, and cells beside these that are not or lie farther from them than
    RESOLVED, (pixels,): a highlight may then fall between."""
    polished = polished.reshape(-1, grid * grid)
    wide = np.zeros(len(polished), bool)
    if grid > 1:
        places = off_peak.T.reshape(-1, grid, grid, 3)
        steps = (np.square(np.diff(places, axis=axis)).sum(axis=-1).max(axis=(1, 2)) for axis in (1, 2))
        wide = polished.all(axis=1) & (np.maximum(*steps) <= RESOLVED**2)
    return polished.any(axis=1) & ~wide


def _unevenness(parts: list[Samples], pixels: int, grid: int) -> np.ndarray:
    """Compute the standard error of each pixel's mean, as if its cells lay there by chance."""
    pixel, radiance = (np.concatenate([part[index] for part in parts]) for index in (0, 3))
    mean = np.bincount(pixel, weights=radiance, minlength=pixels)
    return np.sqrt(np.maximum(np.bincount(pixel, weights=radiance**2, minlength=pixels) - mean**2 / grid**2, 0))


def _too_uneven(unevenness: np.ndarray, allowed: float) -> np.ndarray:
    """Return the fewest pixels without which the root sum square of the others' unevenness is within `allowed`."""
    order = np.argsort(unevenness, kind="stable")
    over = np.zeros(len(order), bool)
    over[order] = np.cumsum(np.square(unevenness[order])) > allowed**2
    return over
