"""Sample allocation: how many camera paths each block of pixels traces, from the noise of a pilot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.clamping import Clamp
from render.indirect.camera_paths import PathTask, trace_paths
from render.indirect.launch_layout import BLOCK, LaunchLayout, make_launch
from render.indirect.path_space_filter import GATHER_POINTS, Octaves
from render.indirect.primary_vertices import reuses_early_paths
from render.indirect.reuse import CONNECTIONS_PER_LAUNCH, add_lanes, all_pairs, own_lanes, pair_lanes, select_pairs
from render.scene.traced_scene import Float, TracedScene, UInt32, dr, upload
from render.settings import BATCHES, FILTERED_BATCHES, MIN_SPP

# Seconds of one path with its suffix in units of one connection, those included that carry no light and take no time: 3
# between two walls, 30 in rooms. Which blocks reuse paths depends on it: squared error times time is least at 40 to 64
# between walls and in rooms (measured).
PATH_COST = 40.0


class Schedule(NamedTuple):
    """Sample allocation: pixels in blocks of BLOCK (-1 pads), samples per pixel of each block, whether it reuses paths.

    `batches` of samples are kept apart for the error estimate. With
    `filter_octaves` no block reuses paths, and late light is filtered over regions of these octaves. With a `clamp`
    no path adds more. `remedy` is what to do should fewer paths than the pilot asked for miss the target.
    """

    pixels: np.ndarray
    spp: np.ndarray
    reuses_paths: np.ndarray
    filter_octaves: Octaves | None = None
    clamp: Clamp | None = None
    remedy: str = ""

    @property
    def batches(self) -> int:
        most = BATCHES if self.filter_octaves is None else FILTERED_BATCHES
        return int(min(most, self.spp.min(initial=most)))

    @property
    def paths(self) -> int:
        """Count the paths traced from the camera."""
        return int((self.spp * (self.pixels.reshape(-1, BLOCK) >= 0).sum(axis=1)).sum())

    @property
    def connections(self) -> int:
        """Count the rays between pixels and their neighbours' paths, if all of these carry light."""
        return int(self.spp[self.reuses_paths].sum()) * BLOCK**2

    def rays(self, bounces: int) -> int:
        """Return rays of all paths, connections and points that read regions; glass and cut-outs on the way not
        counted."""
        points = 0 if self.filter_octaves is None else GATHER_POINTS * int((self.pixels >= 0).sum())
        return self.paths * (2 * bounces - 1) + self.connections + points

    @property
    def cost(self) -> float:
        """Work of the schedule in paths of its own for every pixel."""
        each = np.where(self.reuses_paths, 1 + BLOCK / PATH_COST, 1)
        return float((self.spp * each).mean())


def uniform(blocks: np.ndarray, spp: int, *, reuses_paths: bool) -> Schedule:
    """Allocate the same number of samples to every block."""
    count = len(blocks) // BLOCK
    return Schedule(blocks, np.full(count, spp), np.full(count, reuses_paths))


def pilot_noise(
    world: TracedScene,
    blocks: np.ndarray,
    bounces: int,
    seed: int,
    from_m: float | None = None,
    clamp: Clamp | None = None,
) -> tuple[np.ndarray, ...]:
    """Return squared contributions of one sample summed over the pixels of every block, without and with path reuse.

    With `from_m`, from which on light is filtered, there is one way alone. From a sample or a few, smoothed along the
    Z-order curve: single bright paths must not rule.
    """
    count = len(blocks) // BLOCK
    spp = int(np.clip(256 // max(count, 1), 1, 16))
    per_launch = max(1, CONNECTIONS_PER_LAUNCH // BLOCK**2 // spp)
    parts = []
    for first in range(0, count, per_launch):
        size = min(per_launch, count - first)
        block = np.arange(size)
        launch = make_launch(block, block + first, np.full(size, spp))
        chosen = blocks[first * BLOCK : (first + size) * BLOCK]
        limit = None if clamp is None else clamp.limit[chosen]
        if from_m is None:
            found: tuple[np.ndarray, ...] = _noise_of_paths(world, chosen, launch, bounces, seed, limit)
        else:
            found = (_noise_of_filtered_paths(world, chosen, launch, bounces, seed, from_m, limit),)
        parts.append([part.reshape(size, spp).mean(axis=1) for part in found])
    kernel = np.array((1, 2, 3, 2, 1)) / 9
    totals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return tuple(np.convolve(np.pad(total, 2, mode="edge"), kernel, mode="valid") for total in totals)


def _noise_of_paths(
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


def _noise_of_filtered_paths(
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


def allocate(
    blocks: np.ndarray,
    own: np.ndarray,
    reused: np.ndarray | None = None,
    *,
    cost: float = np.inf,
    squared_error: float = 0.0,
    batches: int = BATCHES,
    min_spp: int = MIN_SPP,
) -> Schedule:
    """Allocate work where it lowers the summed squared error most, until the error is met or `cost` paths a pixel
    spent.

    R samples with noise N and work c add N / R to the error and R c to the work, in one block and one way (own paths or
    reused ones); N / R + L R c is least at R = sqrt(N / (L c)), at least `min_spp` (Neyman 1934). L comes by bisection.
    A block's noise is at least 2 % of the mean, since a short pilot sees no rare path.
    """
    noise = np.stack((own,) if reused is None else (own, reused))
    each = np.array((1.0, 1 + BLOCK / PATH_COST))[: len(noise), None]
    least = noise.min(axis=0).mean()
    noise = np.maximum(noise, 0.02 * least) if least > 0 else np.ones_like(noise)
    most = max(min_spp, 256 * cost) if np.isfinite(cost) else np.inf

    def spent(price: float) -> tuple[np.ndarray, np.ndarray]:
        spp = np.clip(np.sqrt(noise / (price * each)), min_spp, most)
        spp = np.ceil(spp / batches) * batches
        best = np.argmin(noise / spp + price * spp * each, axis=0)
        return best, np.take_along_axis(spp, best[None], 0)[0]

    unit = noise.min(axis=0).mean()
    low, high = -60.0, 60.0  # logarithm of the price in units of the mean noise: the lower, the more is spent
    for _ in range(48):
        middle = 0.5 * (low + high)
        best, spp = spent(np.exp(middle) * unit)
        left = (np.take_along_axis(noise, best[None], 0)[0] / spp).sum()
        if (spp * each[best, 0]).mean() > cost or left < squared_error:
            low = middle
        else:
            high = middle
    best, spp = spent(np.exp(high) * unit)
    return Schedule(blocks, spp.astype(np.int64), best == 1)


def least_spp(spp: int) -> int:
    """Return the paths a pixel of the darkest block where `spp` in all are forced.

    A quarter of them: a floor of all would leave nothing for sharing, which takes more work a path and less noise.
    """
    return min(MIN_SPP, max(BATCHES, spp // 4))


def reallocated(before: Schedule, noise: np.ndarray, fraction: float, most: float) -> Schedule:
    """Allocate paths on top of traced ones where these left the noise.

    Parameters
    ----------
    before : what was traced
    noise : standard error of each pixel's total
    fraction : of the summed squared error that may be left
    most : paths to add, in units of those before
    """
    real = before.pixels >= 0
    squares = np.zeros(len(before.pixels))
    squares[real] = noise[before.pixels[real]] ** 2
    of_blocks = squares.reshape(-1, BLOCK).sum(axis=1)
    of_a_path, never = of_blocks * before.spp, 1e12 * of_blocks.sum() * before.spp.max()
    ways = (np.where(before.reuses_paths, never, of_a_path), np.where(before.reuses_paths, of_a_path, never))
    wanted = allocate(before.pixels, *ways, squared_error=fraction * of_blocks.sum())
    if wanted.cost > (1 + most) * before.cost:
        wanted = allocate(before.pixels, *ways, cost=(1 + most) * before.cost)
    more = np.maximum(wanted.spp - before.spp, before.batches)
    return before._replace(spp=np.ceil(more / before.batches).astype(np.int64) * before.batches)
