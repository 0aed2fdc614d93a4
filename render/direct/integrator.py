"""Direct light, integrated: every cell's footprint spreads its energy over path lengths."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, UInts
from render.direct.cell_tree import MAX_CELLS, CellTree
from render.direct.footprints import albedo
from render.scene.rays import camera_rays, first_opaque
from render.scene.refraction import refracted_hit
from render.scene.traced_scene import Bool, Float, TracedScene, UInt32, dr
from render.transient.samples import Samples, concatenate, merge, no_samples, packed, with_energy

RAYS_PER_LAUNCH, MIN_ROWS = 1 << 19, 16
REFINE = 6
# A footprint of half spans a > b is as good as uniform where b^2 / a is below this: what a uniform return lays on the
# wrong side of a bin's edge goes with b^2 / a. It is a seventieth of the reference sensor's bin, 29 mm (measured: less
# gains nothing).
UNIFORM_M = 4e-4


class DirectLight(NamedTuple):
    """Samples of direct light; per pixel the `mixed` flag; how many footprints were clipped; rays cast."""

    samples: Samples
    mixed: np.ndarray
    clipped: int
    rays: int


class Layers(NamedTuple):
    """First surface along every pixel-centre ray: radial depth [m] (NaN: nothing), world normal toward the camera,
    albedo."""

    depth_m: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray


def default_edge_threshold(grid: int) -> float:
    """Return share of a first cell of a typical pixel below which an edge is not worth its rays.

    Falls with the grid, as the error of all other cells does: what both leave costs least in sum (measured).
    """
    return min(1.0, 2 / grid)


def direct_light(
    world: TracedScene,
    pixels: np.ndarray,
    grid: int,
    tolerance_m: float = 1e-4,
    refine: int = REFINE,
    edge_threshold: float | None = None,
) -> DirectLight:
    """Return direct returns of the given flat pixel indices (sorted, each once), merged within `tolerance_m`.

    Every pixel starts as grid x grid cells, one ray and footprint each (`render.direct.footprints`). A cell is cut in
    four, at most `refine` times and down to 1/MAX_CELLS of a pixel or less, where
    - its footprint is not small, so that first order no longer describes it;
    - a highlight on it may be too narrow for it (`render.direct.edges.compare`); or
    - it and a neighbouring cell lie on different surfaces, or one is in shadow, or one is painted darker: an edge runs
      through one of them.
      An edge or highlight that could change less than `edge_threshold` of a first cell's energy, in a pixel of the root
      mean square of its group's radiance, is left alone; by default `default_edge_threshold` the grid.

    New cells are compared with their neighbours too, of whatever size and pixel, and those are cut in turn: a wire
    thinner than a cell is followed from wherever a ray hit it. All cuts of a pass are traced in one launch. What
    silhouettes and shadows part in the end is parted in the middle between the rays (`render.direct.children`).
    Footprints not small at the end are clipped to the face they lie on, and counted if that changes them.

    Small cells that are not cut, and whose neighbours lie on the same surface, take their spread of path lengths from
    them instead of from the tangent plane (`render.direct.edges.first_edges`).

    Pixels are treated in groups of whole rows, at least MIN_ROWS and about RAYS_PER_LAUNCH rays each. Neither across
    edges of groups nor, where not all pixels are asked for, across edges of pixels are cells compared.
    """
    edge_threshold = default_edge_threshold(grid) if edge_threshold is None else edge_threshold
    width = world.scene.camera.width
    per_chunk = max(MIN_ROWS, RAYS_PER_LAUNCH // (grid * grid * width)) * width
    parts = [
        _chunk(world, pixels[i : i + per_chunk], grid, tolerance_m, refine, edge_threshold)
        for i in range(0, max(len(pixels), 1), per_chunk)
    ]
    if len(parts) == 1:
        return parts[0]
    mixed = np.concatenate([part.mixed for part in parts])
    samples = concatenate([part.samples for part in parts])
    return DirectLight(samples, mixed, sum(p.clipped for p in parts), sum(p.rays for p in parts))


def _chunk(
    world: TracedScene, pixels: np.ndarray, grid: int, tolerance_m: float, refine: int, edge_threshold: float
) -> DirectLight:
    tree = CellTree(world, pixels, grid)
    touched = tree.refine(max(0, min(refine, math.ceil(math.log2(MAX_CELLS / grid)))), edge_threshold / grid**2)
    tree.place_edges()
    clipped = tree.clip()
    leaves = tree.child[: tree.used] < 0
    if tolerance_m == 0:
        samples = with_energy(_samples(tree, np.flatnonzero(leaves), tolerance_m))
        return DirectLight(samples, tree.mixed, clipped, tree.rays)
    # pixels that were left alone are a table of equal cells; what was cut is a list
    plain = _merge_plain(tree, np.flatnonzero(~touched), tolerance_m)
    leaves[: len(pixels) * grid * grid] &= np.repeat(touched, grid * grid)
    cells = np.flatnonzero(leaves)
    cut = merge(_samples(tree, cells, tolerance_m), tolerance_m)
    return DirectLight(concatenate([plain, cut]), tree.mixed, clipped, tree.rays)


def _samples(tree: CellTree, cells: np.ndarray, tolerance_m: float) -> Samples:
    """Make the returns of `cells`.

    A cell with half spans a > b is a trapezoid of path lengths, which one uniform return describes badly at the edges
    of bins. Where b^2 / a is above the tolerance and UNIFORM_M two returns do it better, without another ray: its
    halves along the smaller span, at p +- b/2 with half width sqrt(a^2 + b^2 / 4).
    """
    count = len(cells)
    minor, least = tree.minor_m[cells], max(tolerance_m, UNIFORM_M)
    wide = np.flatnonzero(minor > least)  # of others b^2 / a is less, too
    # b^4 > least^2 a^2, where the half width is sqrt(a^2 + b^2)
    square = minor[wide] ** 2
    wide = wide[square * (square + least**2) > (least * tree.half_width_m[cells[wide]]) ** 2]
    found = no_samples(count + len(wide))
    pixel, path, half_width, radiance, _ = found
    pixel[:count] = tree.pixel(cells)
    for column, values in ((path, tree.path_m), (half_width, tree.half_width_m), (radiance, tree.energy)):
        np.take(values, cells, out=column[:count], mode="clip")  # other modes copy once more
    found.bounces[:] = 1
    minor = minor[wide]
    pixel[count:] = pixel[wide]
    radiance[wide] = radiance[count:] = radiance[wide] / 2
    half_width[wide] = half_width[count:] = np.sqrt(half_width[wide] ** 2 - 0.75 * minor**2)
    path[count:] = path[wide] + minor / 2
    path[wide] -= minor / 2
    return found


def _merge_plain(tree: CellTree, ranks: np.ndarray, tolerance_m: float) -> Samples:
    """Merge the returns of pixels whose cells are all of level 0.

    Most pixels need no sort: all their cells merge, or no two do.
    """
    cells = tree.grid**2
    index = ranks[:, None] * cells + np.arange(cells)
    if cells > 64:
        return merge(_samples(tree, index.ravel(), tolerance_m), tolerance_m)
    energy = tree.energy[index]
    lit = energy > 0
    key = np.floor(tree.path_m[index] / tolerance_m)
    columns = [key[:, k] for k in range(cells)]
    same = _all([columns[0] == column for column in columns[1:]], len(ranks)) & _all(list(lit.T), len(ranks))
    parts = [_merge_rows(tree, index[same], energy[same])]
    rest = index[~same]
    if cells == 1:
        return parts[0]
    if cells <= 4:
        pairs = [columns[i] != columns[j] for i in range(cells) for j in range(i)]
        apart = _all(pairs, len(ranks)) & _all(list(lit.T), len(ranks))
        parts.append(_samples(tree, index[apart].ravel(), tolerance_m))
        rest = index[~(same | apart)]
    parts.append(merge(_samples(tree, rest.ravel(), tolerance_m), tolerance_m))
    return concatenate(parts)


def _all(conditions: list[np.ndarray], length: int) -> np.ndarray:
    """Combine conditions by elementwise and."""
    every = np.ones(length, bool)
    for condition in conditions:
        every &= condition
    return every


def _merge_rows(tree: CellTree, index: np.ndarray, energy: np.ndarray) -> Samples:
    """Make one return for each row of cells, with the sum of energy, the centroid and the variance of its cells."""
    weight = energy.astype(np.float64).T
    path = tree.path_m[index].astype(np.float64).T
    half_width = tree.half_width_m[index].astype(np.float64).T
    total: np.ndarray = sum(weight)  # type: ignore[assignment]  # of arrays: one after the other
    centroid = sum(weight * path) / total if len(total) else total
    variance = sum(weight * ((path - centroid) ** 2 + half_width**2 / 3)) / total if len(total) else total
    pixel = tree.pixel(index[:, 0])
    return packed(pixel, centroid, np.sqrt(3 * variance), total, np.ones(len(index), np.uint8))


def centre_layers(world: TracedScene) -> Layers:
    """Return depth, normal and albedo at every pixel centre, (H, W)."""
    shape = (world.scene.camera.height, world.scene.camera.width)
    pixel = dr.arange(UInt32, shape[0] * shape[1])
    dr.eval(pixel)
    found = world.recordings.call(world, ("centre layers", world.refracts), _centres, pixel)
    dr.eval(found)
    depth, x, y, z, reflectance = (values.numpy().reshape(shape) for values in found)
    normal = np.stack((x, y, z), axis=-1)
    return Layers(depth.copy(), normal.astype(np.float16), reflectance.astype(np.float16))


def _centres(world: TracedScene, pixel: UInts) -> tuple[Array, ...]:
    ray, _ = camera_rays(world, Float(pixel % world.width) + 0.5, Float(pixel // world.width) + 0.5)
    if world.refracts:
        bent = refracted_hit(world, ray, Bool(True))
        si, direction, distance = bent.interaction, bent.direction, dr.norm(bent.interaction.p - world.eye)
    else:
        si, _, _, distance = first_opaque(world, ray, Bool(True))
        direction = ray.d
    hit = si.is_valid()
    normal = si.n * dr.select(hit, dr.select(dr.dot(si.n, direction) > 0, Float(-1), Float(1)), 0)
    return dr.select(hit, distance, dr.nan), *normal, albedo(world, si, hit)
