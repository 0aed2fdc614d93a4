"""Measure how noisy single paths are: squares of what they add, own and reused, for a pilot."""

from __future__ import annotations

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.indirect.camera_paths import PathTask, trace_paths
from render.indirect.launch_layout import BLOCK, LaunchLayout
from render.indirect.primary_vertices import reuses_early_paths
from render.indirect.reuse import add_lanes, all_pairs, own_lanes, pair_lanes, select_pairs
from render.scene.traced_scene import Float, TracedScene, UInt32, dr, upload


def noise_of_paths(
    world: TracedScene,
    pixels: np.ndarray,
    launch: LaunchLayout,
    bounces: int,
    seed: int,
    limit: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Sum squared contributions of a block's sample to the pixels of the block, own and reused.

    Histograms of paths that fall into different bins have this variance. `limit`: what a path may add to each pixel.
    """
    most = None if limit is None else upload(Float, limit)
    paths = trace_paths(PathTask(world, pixels, launch, bounces, seed, reuses_paths=True))
    own, alone, reused = (_Squares(most) for _ in range(3))
    lanes = own_lanes(paths)
    add_lanes(lanes._replace(early_m=Float(0)), paths, own, own=True)
    add_lanes(lanes, paths, alone, own=True)
    add_lanes(pair_lanes(world, paths, all_pairs(dr.width(paths.batch))), paths, reused, own=False)
    return own.by_block(BLOCK), alone.by_block(BLOCK) + reused.by_block(BLOCK**2)


def noise_of_filtered_paths(
    world: TracedScene,
    pixels: np.ndarray,
    launch: LaunchLayout,
    bounces: int,
    seed: int,
    from_m: float,
    limit: np.ndarray | None = None,
) -> np.ndarray:
    """Return the same of filtered light: what is later than `from_m` behind direct light is read from regions, whose
    area, and with it the number of paths in them, grows with the square of its excess path."""
    start, most = dr.opaque(Float, from_m), None if limit is None else upload(Float, limit)
    paths = trace_paths(PathTask(world, pixels, launch, bounces, seed, from_m=start))
    primary: Array = paths.primary
    own = _Squares(most, primary.path + primary.late_m, start, primary.point.reflectance > 0)
    add_lanes(own_lanes(paths), paths, own, own=True)
    noise = own.by_block(BLOCK)
    pairs = select_pairs(paths, reuses_paths=False, early=reuses_early_paths(world))
    if pairs is not None:
        early = _Squares(most)
        add_lanes(pair_lanes(world, paths, pairs), paths, early, own=False)
        block = dr.gather(UInt32, pairs.suffix, dr.arange(UInt32, dr.width(pairs.suffix) // BLOCK) * BLOCK) // BLOCK
        np.add.at(noise, block.numpy(), early.by_block(BLOCK))
    return noise


class _Squares:
    """In place of `IndirectAccumulator`: the sum of squares of what every lane adds; with `from_m`, late light that a
    filter takes counts as little as its noise.

    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(self, limit: Floats = None, late_m: Floats = None, from_m: Floats = None, taken: Masks = None) -> None:
        self._limit, self._late_m, self._from_m, self._taken = limit, late_m, from_m, taken
        self._lanes: Floats = None

    def clamped(
        self, pixel: UInts, batch: UInts, path: Floats, radiance: Floats, active: Masks, adding: Masks
    ) -> Array:
        """Return radiance of one path, no more than it may add."""
        if self._limit is None:
            return radiance
        limit = dr.gather(Float, self._limit, pixel, active)
        return dr.select(dr.isfinite(radiance), dr.minimum(radiance, limit), radiance)

    def add(self, pixel: UInts, batch: UInts, path: Floats, radiance: Floats, active: Masks) -> Array:
        """Compute the square of an added radiance."""
        return dr.select(active & dr.isfinite(radiance), dr.square(radiance), 0)

    def filtered(self, path: Floats, radiance: Floats, diffuse: Masks) -> Array:
        """Return radiance of one path; what a filter takes, over the root of the number of pixels in a region."""
        if self._from_m is None:
            return radiance
        behind_m = dr.maximum(path - self._late_m, 0)
        return radiance / dr.select(diffuse & self._taken, 1 + behind_m / self._from_m, 1)

    def add_total(self, pixel: UInts, batch: UInts, total: Floats) -> None:
        """Keep every lane's sum."""
        self._lanes = total

    def by_block(self, size: int) -> np.ndarray:
        """Sum the squares over groups of `size` lanes each."""
        return self._lanes.numpy().astype(np.float64).reshape(-1, size).sum(axis=1)
