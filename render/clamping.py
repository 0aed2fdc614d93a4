"""Clamping: no path adds more to a pixel than a multiple of the direct light around it; what that takes is measured.

A path whose estimate X of its pixel's radiance lies above a limit adds the limit instead: min(X, limit). Fireflies go,
and with them E[max(X - limit, 0)]: a bias, which the same paths measure, as they know what they would have added. The
limit does not depend on the number of paths, so that neither does the bias.

The excess is kept for each pixel, and for regions of pixels by path length in two independent halves: the product of
these has the square of the bias as its mean, without the square of their noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.backend.drjit_types import Array, Floats, Masks, UInts
from render.error import response
from render.indirect.light_tracing import LightPathSplats
from render.indirect.path_cells import Cells, MomentHistogram, cell_samples, scatter_add_fixed_point
from render.scene.traced_scene import Float, UInt32, dr, mi, upload
from scenes.model import Camera

RADIUS = 2  # pixels around a pixel whose mean direct light the limit is counted in
FLOOR = 0.1  # of the image's mean: that light is taken to be at least this much, say inside a mirror
REGION, MAX_REGIONS = 4, 4096  # pixels a side of a region at least; regions of an image at most
AT_A_TIME = 512  # regions whose response is worked out at a time


class Clamp(NamedTuple):
    """Limits of a clamp: the most that one path may add to every flat pixel of the image, and the region of each
    pixel."""

    limit: np.ndarray
    region: np.ndarray

    @property
    def regions(self) -> int:
        return int(self.region.max(initial=-1)) + 1


class RemovedLight(NamedTuple):
    """Light that a clamp removed, in two independent halves of the paths: the radiance of every flat pixel, (pixels,
    2); and its moments by path length in `cells`, (3, regions, 2, cells), means over the pixels of each `region`."""

    halves: np.ndarray
    cells: Cells
    moments: np.ndarray
    region: np.ndarray

    @property
    def pixels(self) -> np.ndarray:
        """Return the radiance that is missing in every flat pixel: the mean of both halves."""
        return self.halves.mean(axis=1)

    def squared_error(self) -> np.ndarray:
        """Estimate the squared error after the pulse that the missing light makes in every flat pixel.

        That of its region's mean, times how much the squares of the pixels' energies exceed those of the regions' in
        the image, where they do. Below 0 at times; an upper bound with the noise in it where there is one half alone.
        """
        energy = self.moments[0].sum(axis=2)[self.region]
        even, uneven = (float(part.prod(axis=1).sum()) for part in (energy, self.halves))
        return self._of_regions()[self.region] * (max(uneven / even, 1.0) if even > 0 else 1.0)

    def _of_regions(self) -> np.ndarray:
        """Estimate the squared error after the pulse in a pixel that misses its region's mean removed light,
        (regions,)."""
        regions = self.moments.shape[1]
        found = np.zeros(regions)
        for first in range(0, regions, AT_A_TIME):
            some = np.arange(first, min(first + AT_A_TIME, regions))
            halves = [self._response(some, half) for half in (0, 1)]
            found[some] = (halves[0] * halves[1]).sum(axis=1)
        return found

    def _response(self, regions: np.ndarray, half: int) -> np.ndarray:
        values = self.moments[:, regions, half]
        row, cell = np.nonzero(values[0] > 0)
        zero = np.zeros(len(row))  # where cells begin does not matter to a sum of squares
        samples = cell_samples(self.cells, row, zero, cell, *(part[row, cell] for part in values))
        return response(samples, np.arange(len(regions)))


def make_clamp(direct: np.ndarray, camera: Camera, multiple: float) -> Clamp:
    """Limit paths to `multiple` times the mean direct radiance around, from every flat pixel's `direct`."""
    image = np.pad(direct.reshape(camera.height, camera.width), RADIUS, mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(image, (2 * RADIUS + 1,) * 2).mean(axis=(2, 3))
    limit = multiple * np.maximum(around, FLOOR * direct.mean())
    side = max(REGION, math.ceil(math.sqrt(len(direct) / MAX_REGIONS)))
    row, column = np.divmod(np.arange(len(direct)), camera.width)
    return Clamp(limit.ravel(), row // side * (-(-camera.width // side)) + column // side)


class ClampSums:
    """Accumulator of the light that a clamp removes from a whole image.

    Not a dataclass: Dr.Jit would take its fields for variables of a loop.
    """

    def __init__(self, clamp: Clamp, cells: Cells, quantum: float, batches: int) -> None:
        self.clamp, self.cells, self.batches = clamp, cells, batches
        self.rows = MomentHistogram(2 * clamp.regions, cells, quantum)
        self.totals = dr.zeros(mi.UInt64, 2 * len(clamp.limit))

    def evaluate(self) -> None:
        """Run what was added so far."""
        dr.eval(self.totals, self.rows.moments)

    def add(self, pixel: UInts, batch: UInts, region: UInts, x_m: Floats, excess: Floats, active: Masks) -> None:
        """Add an excess, a part of the flat pixel's mean radiance already, at x = path - the pixel's origin."""
        half = batch % 2
        scatter_add_fixed_point(self.totals, excess * self.rows.per_quantum, 2 * pixel + half, active)
        self.rows.add(2 * region + half, x_m, excess, active)

    def removed(self) -> RemovedLight:
        """Read all that was taken."""
        count = np.bincount(self.clamp.region, minlength=self.clamp.regions)
        shape = self.clamp.regions, 2, self.cells.size
        moments = np.stack([part.reshape(shape) for part in self.rows.sums()]) / count[:, None, None]
        pixels = self.totals.numpy().reshape(-1, 2) * self.rows.quantum
        odd = self.batches // 2
        if odd == 0:
            pixels, moments = pixels[:, [0, 0]], moments[:, :, [0, 0]]
        else:
            fraction = np.array((self.batches - odd, odd)) / self.batches
            pixels, moments = pixels / fraction, moments / fraction[:, None]
        return RemovedLight(pixels, self.cells, moments, self.clamp.region)


class ClampedPixels:
    """A clamp as some rows of pixels see it, those of one chunk. Not a dataclass, as above."""

    def __init__(self, sums: ClampSums, pixels: np.ndarray) -> None:
        self.sums = sums
        self.limit = upload(Float, sums.clamp.limit[pixels])
        self.region = upload(UInt32, sums.clamp.region[pixels])
        self.flat = upload(UInt32, np.maximum(pixels, 0))

    def clamped(self, row: UInts, radiance: Floats, active: Masks) -> Array:
        """Return radiance of at most the row's limit; what is not finite stays so."""
        limit = dr.gather(Float, self.limit, row, active)
        return dr.select(active & dr.isfinite(radiance), dr.minimum(radiance, limit), radiance)

    def add(self, row: UInts, batch: UInts, x_m: Floats, excess: Floats, active: Masks) -> None:
        """Keep what was taken of a row's mean radiance."""
        flat, region = (dr.gather(UInt32, part, row, active) for part in (self.flat, self.region))
        self.sums.add(flat, batch, region, x_m, excess, active)


def mean_removed(one: RemovedLight | None, other: RemovedLight | None, fraction: np.ndarray) -> RemovedLight | None:
    """Average what two independent renders lack; `fraction` is the first one's weight in each pixel."""
    if one is None or other is None:
        return None
    halves = fraction[:, None] * one.halves + (1 - fraction[:, None]) * other.halves
    weight = np.bincount(one.region, fraction) / np.bincount(one.region)
    moments = weight[:, None, None] * one.moments + (1 - weight[:, None, None]) * other.moments
    return one._replace(halves=halves, moments=moments)


def clamped_splats(sums: ClampSums, light: LightPathSplats, paths: float, origin_m: np.ndarray) -> LightPathSplats:
    """Clamp splats of light paths, of which there are `paths` for every pixel, as one camera path each."""
    kept = np.minimum(light.radiance, sums.clamp.limit[light.pixel] / paths)
    over = np.flatnonzero(kept < light.radiance)
    if len(over):
        pixel = light.pixel[over]
        region, batch = sums.clamp.region[pixel], light.batch[over]
        x_m, excess = light.path_m[over] - origin_m[pixel], (light.radiance - kept)[over]
        indices = upload(UInt32, pixel), upload(UInt32, batch), upload(UInt32, region)
        sums.add(indices[0], indices[1], indices[2], upload(Float, x_m), upload(Float, excess), mi.Bool(True))
    return light._replace(radiance=kept)
