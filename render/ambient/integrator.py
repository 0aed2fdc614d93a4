"""Steady light of environment and area lights: paths from the camera to lights, whose way may lead through glass.

A window's light reaches a room through its panes, which stop the shadow rays of Mitsuba's own integrators: those find
it by chance alone. Here a straight line passes thin panes and the holes of cut-outs, to lights as to what is seen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from render.ambient.allocation import STREAMS, numbers_for, relative_numbers
from render.ambient.bilateral_filter import bilateral_filter
from render.ambient.camera_paths import SETS, camera_paths
from render.ambient.light_paths import trace_light_paths
from render.ambient.panes import has_lit_mirrors
from render.direct.integrator import Layers
from render.scene.traced_scene import TracedScene, UInt32, dr, upload

MAX_LANES = 1 << 18  # paths of one launch
FIRST_SPP, MIN_MORE, MAX_MORE = 64, 1.25, 8  # paths a pixel whose noise tells how many times as many are needed
MIN_SPP = 2  # paths a pixel, whose difference tells the noise
UNEVEN = 1 << 24  # keys of launches that give pixels different numbers of paths
CAUSTIC_COST = 0.15  # time of the paths from lamps that are traced for one of the camera's


class AmbientLight(NamedTuple):
    """Radiance of each pixel [W/(m^2 sr nm)], (H, W) float32, its noise (rms over pixels by the image's mean), and the
    mean number of paths a pixel.

    `left_out` is about the share of it that met more surfaces than were followed: the weight that paths still had at
    the last one, beyond which the scene is taken to be as bright as the image.
    Where pixels share their light (`bilateral_filter`) the noise is what is left of it; how far it is blurred is not in
    it.
    """

    radiance: np.ndarray
    error: float
    spp: int
    left_out: float = 0.0


def ambient_light(
    world: TracedScene, spp: int, bounces: int, seed: int, guide_layers: Layers | None = None, *, noise: float = 0.0
) -> AmbientLight:
    """Return steady spectral radiance of environment and area lights at each pixel, after up to `bounces - 1` surfaces.

    Paths of the camera (`render.ambient.camera_paths`), and of lamps where mirrors or solid glass throw their light
    (`render.ambient.light_paths`); unbiased. Same seed, same bytes. With `guide_layers` of the pixels' centres,
    neighbours share what is reflected (`bilateral_filter`): far less noise, biased. `spp` paths a pixel, MIN_SPP at
    least; where a `noise` is enough, as many as take the `AmbientLight.error` there, `spp` at most, and most in the
    pixels that are noisiest (`render.ambient.allocation`).
    """
    sums, spp = _Sums(world, bounces, seed), max(spp, MIN_SPP)
    sums.trace_evenly(spp if noise == 0 else min(spp, FIRST_SPP))
    light, relative = sums.light(guide_layers), None
    while light.error > noise and light.spp < spp:
        # by steps, as the first paths underrate what is rare; and fewer where paths go to the noisiest pixels
        power = 2 if guide_layers is not None else 1
        more = min(max((light.error / noise) ** power, MIN_MORE), MAX_MORE)
        target = min(spp, math.ceil(more * light.spp))
        if guide_layers is not None:
            sums.trace_evenly(target)
        else:
            relative = sums.relative_numbers() if relative is None else relative
            sums.trace_by(relative, target)
        light = sums.light(guide_layers)
    return light


class _Sums:
    """Light of the paths traced so far, and what its noise is told by.

    Path s of a pixel belongs to set s modulo SETS. `sets` are sums over camera paths of what is emitted where it is
    seen, and of what is reflected, (2, SETS, pixels); `number` the paths that they hold, (SETS, pixels). `caustic` are
    sums over `caustic_number` (SETS, 1) paths from lamps for each pixel, (SETS, pixels).
    """

    def __init__(self, world: TracedScene, bounces: int, seed: int) -> None:
        self.world, self.bounces, self.seed = world, bounces, seed & 0xFFFFFFFF
        self.shape = world.scene.camera.height, world.scene.camera.width
        pixels = self.shape[0] * self.shape[1]
        self.sets, self.number = np.zeros((2, SETS, pixels)), np.zeros((SETS, pixels), np.int64)
        self.cut = np.zeros(pixels)  # weight of paths that had to end
        self.caustic, self.caustic_number = np.zeros((SETS, pixels)), np.zeros((SETS, 1), np.int64)
        self.passes = 0  # of uneven numbers

    @property
    def spp(self) -> int:
        """Return the mean number of paths a pixel, rounded down."""
        return int(self.number.sum() // self.number.shape[1])

    def trace_evenly(self, spp: int) -> None:
        """Trace until there are `spp` paths of each pixel; all had the same number before."""
        pixels = self.number.shape[1]
        per_pass = max(1, MAX_LANES // pixels)
        while (first := self.spp) < spp:
            now = min(per_pass, spp - first)
            self._add(np.repeat(np.arange(pixels), now), np.tile(np.arange(first, first + now), pixels), first)
            self._trace_from_lamps(first + now)

    def trace_by(self, relative: np.ndarray, spp: int) -> None:
        """Trace until there are `spp` paths a pixel in the mean, by `relative` numbers of each stream and pixel."""
        per_stream = SETS // STREAMS
        present = self.number.reshape(per_stream, STREAMS, -1).sum(axis=0)
        extra = (numbers_for(spp / STREAMS, relative, present, per_stream) - present).T.ravel()
        ends, begin = np.cumsum(extra), present.T.ravel()
        for first in range(0, int(ends[-1]), MAX_LANES):
            lane = np.arange(first, min(first + MAX_LANES, ends[-1]))
            row = np.searchsorted(ends, lane, side="right")
            place = lane - ends[row] + extra[row] + begin[row]
            self.passes += 1
            self._add(row // STREAMS, place * STREAMS + row % STREAMS, UNEVEN + self.passes)
        self._trace_from_lamps(self._caustic_wanted())

    def _add(self, pixel: np.ndarray, sample: np.ndarray, key: int) -> None:
        """Trace paths of pixels with these numbers; `key` tells a launch's random numbers apart."""
        columns = [upload(UInt32, column) for column in (pixel, sample)]
        numbers = [dr.opaque(UInt32, number) for number in (self.seed, key, self.bounces)]
        *lights, cut = self.world.recordings.call(self.world, "ambient", camera_paths, *columns, *numbers)
        row = sample % SETS * self.number.shape[1] + pixel
        for sums, light in zip(self.sets, lights, strict=True):
            sums += np.bincount(row, np.array(light, np.float64), self.number.size).reshape(sums.shape)
        self.cut += np.bincount(pixel, np.array(cut, np.float64), len(self.cut))
        self.number += np.bincount(row, minlength=self.number.size).reshape(self.number.shape)

    def _trace_from_lamps(self, wanted: int) -> None:
        """Trace paths from lamps until there are `wanted` for each pixel."""
        if not has_lit_mirrors(self.world):
            return
        per_pass = max(1, MAX_LANES // self.number.shape[1])
        while (first := int(self.caustic_number.sum())) < wanted:
            now = min(per_pass, wanted - first)
            self.caustic += trace_light_paths(self.world, first, now, self.bounces, self.seed)
            self.caustic_number[:, 0] += np.bincount(np.arange(first, first + now) % SETS, minlength=SETS)

    def _caustic_wanted(self) -> int:
        """Return how many paths from lamps go best with the camera's: least noise for the time of both."""
        camera, caustic = self.spp * self._camera_noise2(), self.caustic_number.sum() * self._caustic_noise2()
        best = math.sqrt(caustic / max(camera * CAUSTIC_COST, 1e-300)) if caustic > 0 else 0.0
        return math.ceil(min(max(best, 1 / MAX_MORE), MAX_MORE) * self.spp)

    def relative_numbers(self) -> np.ndarray:
        """Return `render.ambient.allocation.relative_numbers` of the camera's paths so far."""
        return relative_numbers(self.sets.sum(axis=0), self.number, self.shape)

    def _camera_noise2(self) -> float:
        streams = 1 if self.passes == 0 else STREAMS
        return float(_squared_noise(self.sets.sum(axis=0), self.number, streams).mean())

    def _caustic_noise2(self) -> float:
        return float(_squared_noise(self.caustic, self.caustic_number).mean()) if self.caustic_number.any() else 0.0

    def light(self, guide_layers: Layers | None) -> AmbientLight:
        """Return the light of all paths and its noise."""
        streams = 1 if self.passes == 0 else STREAMS
        mean = _mean(self.sets.sum(axis=0), self.number, streams)
        noise2 = self._camera_noise2() + self._caustic_noise2()
        if self.caustic_number.any():
            mean = mean + _mean(self.caustic, self.caustic_number)
        if guide_layers is not None:
            mean, noise2 = self._shared(guide_layers)
        # numbers below the least normal one are 0 in some threads and not in others, whose files would differ
        mean = np.where(mean < np.finfo(np.float32).tiny, 0, mean)
        error = float(np.sqrt(noise2) / mean.mean()) if mean.any() else 0.0
        left_out = float((self.cut / self.number.sum(axis=0)).mean())
        return AmbientLight(mean.reshape(self.shape).astype(np.float32), error, self.spp, left_out)

    def _shared(self, guide_layers: Layers) -> tuple[np.ndarray, float]:
        """Return light whose reflected part neighbours share, and its squared noise, told by two halves of the paths;
        every pixel has the same number."""
        spp, (seen, reflected) = self.spp, self.sets
        number = np.array([[spp - spp // 2], [spp // 2]])
        halves = np.stack([(reflected + self.caustic)[half::2].sum(axis=0) for half in (0, 1)])
        means = (halves / np.maximum(number, 1)).reshape(2, *self.shape)
        smooth = bilateral_filter(means, guide_layers, self.world.scene.camera).reshape(2, -1)
        of_seen = _squared_noise(seen, self.number).mean()
        mean = _mean(seen, self.number) + (smooth * number).sum(axis=0) / spp
        return mean, float(of_seen + np.square(smooth[0] - smooth[1]).mean() / 4)


def _mean(sums: np.ndarray, number: np.ndarray, streams: int = 1) -> np.ndarray:
    """Return the mean over streams of their paths' means, from sums and numbers of sets (SETS, pixels)."""
    sums, number = (part.reshape(-1, streams, part.shape[1]).sum(axis=0) for part in (sums, number))
    return (sums / number).mean(axis=0)


def _squared_noise(sums: np.ndarray, number: np.ndarray, streams: int = 1) -> np.ndarray:
    """Estimate the variance of `_mean` in each pixel, from the differences between the sets of a stream."""
    there = number[:, 0] > 0
    sums, number = (part[there].reshape(-1, streams, part.shape[1]) for part in (sums, number))
    off = sums / number - sums.sum(axis=0) / number.sum(axis=0)
    variance = (number * np.square(off)).sum(axis=0) / (max(len(number) - 1, 1) * number.sum(axis=0))
    return variance.sum(axis=0) / streams**2
