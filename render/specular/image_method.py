"""Light by way of mirrors, which path tracing finds by chance or not at all.

The image method gives it all. Light that reaches a point by way of plane mirrors 1 ... k (1 nearest the point) runs
along the unfolded straight line to the laser's image L' = S_1 S_2 ... S_k L, where S_i reflects in plane i.

Glints: the laser seen in mirrors, in the smooth coat of plastic and in the faces of glass.
Mirrored light: what the camera sees by way of mirrors and of faces of glass; and what it sees lit by way of them, and
of the coat of plastic.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from render.scene.traced_scene import TracedScene
from render.settings import MAX_BOUNCES
from render.specular.glints import glints
from render.specular.image_sequences import coat_sequences, image_sequences
from render.specular.mirrored_cells import faces_of_glass
from render.specular.mirrored_light import Ways, mirrored_light
from render.specular.mirrors import (
    COATED,
    check_slabs,
    find_mirrors,
    glint_sequences,
    lit_mirrors,
)
from render.specular.unfolded_ways import mirror_tables
from render.transient.samples import Samples, concatenate, merge, no_samples

MAX_FACES = 8  # of glass along a ray of the camera, each of which reflects


class SpecularLight(NamedTuple):
    """Samples of specular light; what was left out or is inexact, one line each; and those samples, not merged, that
    mirrors show of directly lit surfaces."""

    samples: Samples
    notes: tuple[str, ...]
    shown: Samples


def specular_light(
    world: TracedScene,
    grid: int = 4,
    tolerance_m: float = 1e-4,
    allowed: tuple[float, float] = (0.0, 0.0),
    bounces: int = MAX_BOUNCES,
) -> SpecularLight:
    """Return deterministic returns by way of smooth plane surfaces, as `Samples` merged within `tolerance_m`.

    Glints: pixel-mean radiance T R_1 ... R_k I(w) F^2 / (D^2 cos^3 a), with D the unfolded one-way length laser ->
    mirrors -> camera, F the focal length in pixels, a the angle off the optical axis (a pixel's mean is that over its
    square, of which a direction sees cos^3 a / F^2 of solid angle), T the transmission of glass on the way; path length
    D plus glass delay, `bounces` = k. Mirrored light is integrated over grid x grid cells of each pixel: f cos R_1 ...
    I(w) / D^2 with D the unfolded length from the laser to the surface, times the reflectances between surface and
    camera; `bounces` counts every surface met. Light of more surfaces than the `bounces` asked for is left out. Path
    tracing leaves these paths out (`render.indirect.path_suffixes`).

    `allowed` is what uneven cells may make of the image's error: a fraction (0: not asked) of the root sum square over
    pixels of this light and other light together, and that of other light. Where there would be more, and on polished
    surfaces, whose highlights may be smaller than a cell, there are FINER ones.

    Raises InputError where a displaced laser's straight path through a glass slab is off by more than 10 mm.
    """
    notes = check_slabs(world)
    if not any(surface.material.kind in COATED for surface in world.scene.surfaces):
        return SpecularLight(no_samples(), tuple(notes), no_samples())
    mirrors, more = find_mirrors(world)
    notes += more
    tables = mirror_tables(world, mirrors)
    parts, lit = [no_samples()], lit_mirrors(world, mirrors)
    for sequences in glint_sequences(mirrors, notes):
        if sequences.shape[1] <= bounces:
            parts.append(glints(world, tables, mirrors, sequences[lit[sequences[:, -1]]]))
    lighting = [*image_sequences(world, mirrors, notes), *coat_sequences(world, mirrors, notes)]
    lighting = [planes for planes in lighting if lit[planes[-1]] and len(planes) < bounces]  # and the surface lit
    single = [planes for planes in lighting if len(planes) == 1 and bounces > 2]
    straight, every = np.zeros(0, np.int64), np.arange(world.scene.camera.height * world.scene.camera.width)
    faces = faces_of_glass(world, grid) if bounces > 1 else np.zeros(len(every))
    if faces.max() > MAX_FACES:
        notes.append(f"glass: what faces reflect beyond the first {MAX_FACES} along a ray is left out")
    by_faces = min(int(faces.max()), MAX_FACES)
    # the squares of what ways may be off by add up
    fraction = allowed[0] / math.sqrt(1 + len(lighting) + by_faces * (1 + len(single)))
    trace = partial(mirrored_light, world, tables, mirrors, grid=grid, allowed=(fraction, allowed[1]))
    shown = trace(Ways((straight,), every, bounces)) if world.has_mirrors and bounces > 1 else []
    parts += trace(Ways(tuple(lighting), every, bounces)) if lighting else []
    for face in range(by_faces):
        parts += trace(Ways((straight, *single), np.flatnonzero(faces > face), bounces, face))
    merged = merge(concatenate([*parts, *shown]), tolerance_m)
    return SpecularLight(merged, tuple(notes), concatenate([no_samples(), *shown]))
