"""Sample allocation: how many camera paths each block of pixels traces, from the noise of a pilot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.clamping import Clamp
from render.indirect.launch_layout import BLOCK, make_launch
from render.indirect.path_noise import noise_of_filtered_paths, noise_of_paths
from render.indirect.path_space_filter import GATHER_POINTS, Octaves
from render.indirect.reuse import CONNECTIONS_PER_LAUNCH
from render.scene.traced_scene import TracedScene
from render.settings import BATCHES, FILTERED_BATCHES, MIN_SPP

# Seconds of one path with its suffix in units of one connection, on 2 cores. Which blocks reuse paths depends on it.
PATH_COST = 9.0


class Schedule(NamedTuple):
    """Sample allocation: pixels in blocks of BLOCK (-1 pads), samples per pixel of each block, whether it reuses paths.

    `batches` of samples are kept apart for the error estimate. With
    `filter_octaves` no block reuses paths, and late light is filtered over regions of these octaves. With a `clamp`
    no path adds more.
    """

    pixels: np.ndarray
    spp: np.ndarray
    reuses_paths: np.ndarray
    filter_octaves: Octaves | None = None
    clamp: Clamp | None = None

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
        """Count the rays between pixels and their neighbours' paths."""
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
            found: tuple[np.ndarray, ...] = noise_of_paths(world, chosen, launch, bounces, seed, limit)
        else:
            found = (noise_of_filtered_paths(world, chosen, launch, bounces, seed, from_m, limit),)
        parts.append([part.reshape(size, spp).mean(axis=1) for part in found])
    kernel = np.array((1, 2, 3, 2, 1)) / 9
    totals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return tuple(np.convolve(np.pad(total, 2, mode="edge"), kernel, mode="valid") for total in totals)


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
