"""Photon by photon: primary detections drawn from the returns themselves, so that cost follows photons and not bins.

A return of expected S detections, uniform over arrivals in [start, start + length] and blurred by the pulse, is a
marked Poisson process: N ~ Poisson(S), each at start + U length + pulse, folded into the period. Binned, that is the
independent Poisson law of `flux.expected_counts` exactly, without its rates. Positions are in bins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from render.transient import Transient
from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.rates import Rates
from spad.sensor.model import Sensor

RETURNS_AT_ONCE = 1 << 18  # whose share within the record is computed
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


class PixelFlux(NamedTuple):
    """Light on some pixels in one exposure: N returns grouped by pixel, and a flat background in each of P."""

    owner: np.ndarray  # (N,) int32 pixel
    start: np.ndarray  # (N,) float64 first arrival, bins after the laser's emission
    length: np.ndarray  # (N,) float64 bins
    signal: np.ndarray  # (N,) float64 expected primary detections
    background: np.ndarray  # (P,) float64 expected primary detections over the whole period

    @property
    def pixels(self) -> int:
        return len(self.background)

    def signal_per_pixel(self) -> np.ndarray:
        """Return (P,) float64, what wraps included."""
        return np.bincount(self.owner, self.signal, minlength=self.pixels)


class PhotonEvents(NamedTuple):
    """Detections in no order: pixel (M,) int32 and position (M,) in bins within the period, int32 or float64."""

    pixel: np.ndarray
    position: np.ndarray


def paths_in_bins(near_m: np.ndarray, far_m: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return first arrival and length of returns, float64 in bins, of their nearest and farthest path [m]."""
    near = near_m.astype(np.float64)
    per_bin = SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s
    return near / per_bin, (far_m - near) / per_bin


def light_of(transient: Transient, sensor: Sensor, rates: Rates, pixels: slice) -> PixelFlux:
    """Return the returns of some pixels at a budget's rates; pixels are counted from the slice's first."""
    first, last = int(transient.offsets[pixels.start]), int(transient.offsets[pixels.stop])
    sizes = np.diff(transient.offsets[pixels.start : pixels.stop + 1])
    owner = np.repeat(np.arange(pixels.stop - pixels.start, dtype=np.int32), sizes)
    start, length = paths_in_bins(transient.path_near_m[first:last], transient.path_far_m[first:last], sensor)
    alive = rates.alive.reshape(-1)[pixels]
    return PixelFlux(
        owner=owner,
        start=start,
        length=length,
        signal=transient.radiance[first:last] * (rates.signal_scale * alive[owner]),
        background=rates.background.reshape(-1)[pixels],
    )


def draw_primaries(
    light: PixelFlux,
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    fraction: float = 1.0,
    fractional: bool = False,
    whole_period: bool = False,
) -> PhotonEvents:
    """Draw primary detections within the sensor's bins in a share of the exposure, or over the whole period.

    Whole bins (int32, above 2^31 bins a period int64), or positions within them (float64) where a dead time, or a
    converter, needs to know.
    """
    period = sensor.bins_per_period
    number = rng.poisson(light.signal * fraction)
    position = np.repeat(light.start, number)  # which is grouped, and then costs less than a look-up per detection
    total = len(position)
    if light.length.any():
        spread = np.repeat(light.length, number)
        spread *= rng.random(total, dtype=np.float32)
        position += spread
    for kernel in sensor.kernels:
        delay = kernel.draw(rng, total)
        delay *= np.float32(1 / sensor.bin_width_s)
        position += delay
    steady = rng.poisson(light.background * fraction)
    owner = np.concatenate((light.owner, np.arange(light.pixels, dtype=np.int32)))
    pixel = np.repeat(owner, np.concatenate((number, steady)))
    rest = len(pixel) - total
    if fractional:
        at = np.concatenate((np.mod(position, period), rng.random(rest) * period))
        at[at >= period] = 0  # a tiny negative position rounds up to the period itself
    else:
        at = np.empty(len(pixel), _bin_type(period))
        _fold(position, period, at[:total])
        at[total:] = _uniform_bins(rng, period, rest)
    if sensor.bins == period or whole_period:
        return PhotonEvents(pixel, at)
    seen = at < sensor.bins  # the rest of the period has no bins: nothing is detected there
    return PhotonEvents(pixel[seen], at[seen])


def _bin_type(period: int) -> type[np.int32] | type[np.int64]:
    """Return the integers that hold every bin of a period."""
    return np.int32 if period <= 1 << 31 else np.int64


def _fold(position: np.ndarray, period: int, out: np.ndarray) -> None:
    """Fold positions in bins, (N,), into bins within the period, written to `out`; positions are overwritten."""
    whole = np.floor(position, out=position).astype(np.int64)
    if period & (period - 1):
        np.mod(whole, period, out=out, casting="same_kind")
    else:  # the same of a power of two, also below 0, and much faster
        np.bitwise_and(whole, period - 1, out=out, casting="same_kind")


def _uniform_bins(rng: np.random.Generator, period: int, size: int) -> np.ndarray:
    """Draw uniform integers from 0 to period - 1, (size,); powers of two to 2^16 from a quarter of a random word."""
    if period & (period - 1) or period > 1 << 16:
        return rng.integers(0, period, size, dtype=_bin_type(period))
    words = rng.integers(0, 1 << 64, -(-size // 4), dtype=np.uint64)
    return words.view(np.uint16)[:size] & np.uint16(period - 1)


def expected_signal(light: PixelFlux, sensor: Sensor) -> tuple[np.ndarray, float]:
    """Return expected primary signal detections within the bins of every pixel, (P,), and how much of the light
    wrapped."""
    if sensor.bins == sensor.bins_per_period:
        return light.signal_per_pixel(), late_signal(light, sensor)
    import torch

    from spad.detection.flux import recorded_fraction

    inside = np.empty(len(light.signal))
    for first in range(0, len(inside), RETURNS_AT_ONCE):
        some = slice(first, first + RETURNS_AT_ONCE)
        near, length = (torch.from_numpy(bins[some] * sensor.bin_width_s) for bins in (light.start, light.length))
        inside[some] = light.signal[some] * recorded_fraction(near, length, sensor).numpy()
    return np.bincount(light.owner, inside, minlength=light.pixels), late_signal(light, sensor)


def late_signal(light: PixelFlux, sensor: Sensor) -> float:
    """Compute the expected signal that arrives later than one period after the laser's emission."""
    period, width = sensor.bins_per_period, sensor.bin_width_s
    late = light.start + light.length + sensor.response.window_s(8.5)[1] / width > period
    if not late.any():
        return 0.0
    arrival, energy = quadrature_points(light.start[late], light.length[late], light.signal[late], sensor)
    left_s = (period - arrival) * width  # of the period, from the pulse's arrival on
    end_s = np.maximum(left_s, sensor.response.window_s(8.5)[1])
    return float(energy @ sensor.response.bin_masses(np.stack((left_s, end_s), axis=1))[:, 0])


def quadrature_points(
    start: np.ndarray, length: np.ndarray, signal: np.ndarray, sensor: Sensor
) -> tuple[np.ndarray, np.ndarray]:
    """Return places [bins] and parts of the signal that stand for returns of a length, all (N,): Gauss-Legendre
    quadrature over panels no longer than the pulse is wide."""
    count = np.maximum(np.ceil(length * sensor.bin_width_s / sensor.response.std_s).astype(int), 1)
    step = np.repeat(length / count, count)
    nth = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    middle = np.repeat(start, count) + (nth + 0.5) * step
    arrival = middle[:, None] + step[:, None] / 2 * _NODES
    energy = np.repeat(signal / count, count)[:, None] * _WEIGHTS / 2
    return arrival.ravel(), np.broadcast_to(energy, arrival.shape).ravel()
