"""Expected counts of a multi-zone sensor by the numbers that a calibration fits, and their derivatives.

The pulse is free: steps of a sixth of a bin over its rise and peak, of half a bin in its tail. The histograms are
linear in it, so that a step of the fit costs one product of matrices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from spad.detection.saturation import saturated, saturated_jacobian
from spad.sensor.clock import chirped
from spad.zones.simulation import ZoneReturns, since_emission, stray_returns, with_skew

FINE = 6  # steps of the pulse in a bin
TAIL = 2  # the same in the tail
_STEPS = {
    "delay": 1e-5,
    "skew": 3e-3,
    "clock": 1e-6,
    "bin_width": 1e-6,
    "chirp": 1e-6,
    "trials": 1e-5,
    "recovery": 1e-5,
    "compression": 1e-5,
    "leak": 1e-3,
    "echo": 1e-5,
}
LIGHT = ("delay", "skew", "clock", "bin_width", "chirp", "leak", "echo")
COMMON = ("bin_width", "chirp")  # numbers that all zones have in common
SATURATION = ("trials", "recovery", "compression")


class ZoneCapture(NamedTuple):
    """Counts (Z, T) of one exposure, the light that made them, and how late the laser was [s]."""

    returns: list[ZoneReturns]
    counts: np.ndarray
    drift_s: float = 0.0


class PulseBasis(NamedTuple):
    """The pulse's steps: `matrix` (fine steps, K) spreads K numbers; `first` fine step, counted from a path of 0."""

    first: int
    matrix: np.ndarray

    @classmethod
    def made(cls, first_bin: int, fine_bins: int, tail_bins: int) -> PulseBasis:
        fine, tail, step = fine_bins * FINE, tail_bins * TAIL, FINE // TAIL
        matrix = np.zeros((fine + tail * step, fine + tail))
        matrix[np.arange(fine), np.arange(fine)] = 1
        for number in range(tail):
            matrix[fine + number * step : fine + (number + 1) * step, fine + number] = 1 / step
        return cls(first_bin * FINE, matrix)

    @property
    def lengths(self) -> np.ndarray:
        """Number of fine steps over which each of the K numbers is spread, (K,)."""
        return (self.matrix > 0).sum(axis=0)


# By name: pulse (K,); bin_width, chirp [per bin] and crosstalk (1,); all others (Z,), delay in bins. The number that is
# fitted for `skew` is the square of skew_s, in bins squared: counts are nearly linear in it, also at 0.
Values = dict[str, np.ndarray]


class ZoneModel:
    """Expected counts and their derivatives for the fit's parameters; delays count in bins.

    Zone `reference` holds the gauge: its gain is 1 (the pulse carries the scale), its delay 0 (the pulse carries it),
    and its clock 1 (the bin width carries it). Zone `narrowest` has no skew: the pulse carries it. While it is None,
    skews are relative to the reference's, and a squared skew below 0 sharpens. `period` is the laser's in bins, at
    which time wraps; None where the bins cover it.
    """

    def __init__(
        self,
        basis: PulseBasis,
        bins: int,
        zones: int,
        reference: int,
        narrowest: int | None = None,
        period: int | None = None,
    ) -> None:
        self.basis, self.bins, self.zones, self.reference = basis, bins, zones, reference
        self.narrowest = reference if narrowest is None else narrowest
        self.signed_skew = narrowest is None
        self.period = bins if period is None else period

    def parameter_names(self, values: Values, free: Sequence[str]) -> list[tuple[str, int]]:
        """List the numbers that a fit changes: the gauge's are left out."""
        fixed = {(name, self.reference) for name in ("gain", "delay", "clock")} | {("skew", self.narrowest)}
        return [(name, at) for name in free for at in range(len(values[name])) if (name, at) not in fixed]

    def own(self, values: Values, capture: ZoneCapture, zone: int) -> np.ndarray:
        """Return expected signal (T,) of one zone without crosstalk."""
        first, mass = self._mass(values, capture, zone)
        # a pulse step's counts in a bin are the sum of FINE neighbouring masses
        full = np.convolve(mass, self.basis.matrix @ values["pulse"])
        at = np.arange(self.bins) * FINE + FINE - 1 - first - self.basis.first
        return self._folded(full, at) * values["gain"][zone]

    def responses(self, values: Values, capture: ZoneCapture, zone: int) -> np.ndarray:
        """Return derivative of `own` with respect to the pulse, (T, K)."""
        first, mass = self._mass(values, capture, zone)
        steps = np.arange(len(self.basis.matrix))
        at = np.arange(self.bins)[:, None] * FINE + FINE - 1 - (steps + self.basis.first)[None, :] - first
        return self._folded(mass, at) @ (self.basis.matrix * values["gain"][zone])

    def _folded(self, held: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Return what is held at fine steps `at` and whole periods before and after them."""
        turn = self.period * FINE
        found = np.zeros(at.shape)
        for cycle in range(-(int(at.max()) // turn), (len(held) - 1 - int(at.min())) // turn + 1):
            place = at + cycle * turn
            inside = (place >= 0) & (place < len(held))
            found += np.where(inside, held[np.clip(place, 0, len(held) - 1)], 0.0)
        return found

    def _mass(self, values: Values, capture: ZoneCapture, zone: int) -> tuple[int, np.ndarray]:
        """Return the light of a zone that a bin would catch, by its start: the first fine step, and masses.

        Exact for returns that are uniform over their paths and a pulse that is uniform over a step.
        """
        step_s = values["bin_width"][0] / FINE
        scale = 1 / (SPEED_OF_LIGHT_M_PER_S * values["clock"][zone] * step_s)
        late = values["delay"][zone] * FINE + capture.drift_s / step_s
        chirp = values["chirp"][0] / FINE
        period_m = self.period * values["bin_width"][0] * SPEED_OF_LIGHT_M_PER_S
        seen = capture.returns[zone]
        stray = stray_returns(seen, values["leak"][zone], values["echo"][zone])
        light = ZoneReturns(*(np.concatenate(pair) for pair in zip(seen, stray, strict=True)))
        skewed = _skewed(since_emission(light, period_m), values["skew"][zone], FINE / scale)
        return _masses(skewed, scale, late, chirp)

    def flux(self, values: Values, capture: ZoneCapture) -> np.ndarray:
        own = np.array([self.own(values, capture, zone) for zone in range(self.zones)])
        return own + values["crosstalk"][0] * own.sum(axis=0) + values["background"][:, None]

    def expected(self, values: Values, capture: ZoneCapture) -> np.ndarray:
        """Return expected counts (Z, T)."""
        return self._saturated(values, self.flux(values, capture))

    def _saturated(self, values: Values, flux: np.ndarray) -> np.ndarray:
        return saturated(flux, values["trials"], values["recovery"], values["compression"])

    def jacobian(
        self, values: Values, capture: ZoneCapture, names: Sequence[tuple[str, int]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return expected counts (Z, T) and their derivatives (Z, T, P) with respect to the named numbers."""
        own = np.zeros((self.zones, self.bins))
        slope = np.zeros((self.zones, self.bins, len(names)))
        pulse = [column for column, (name, _) in enumerate(names) if name == "pulse"]
        for zone in range(self.zones):
            response = self.responses(values, capture, zone)
            own[zone] = response @ values["pulse"]
            slope[zone][:, pulse] = response
        for column, (name, at) in enumerate(names):
            if name == "gain":
                slope[at, :, column] = own[at] / values["gain"][at]
            elif name in LIGHT:
                for zone in range(self.zones) if name in COMMON else (at,):
                    slope[zone, :, column] = self._difference(values, capture, name, at, zone)
        crosstalk = values["crosstalk"][0]
        slope += crosstalk * slope.sum(axis=0)
        flux = own + crosstalk * own.sum(axis=0) + values["background"][:, None]
        for column, (name, at) in enumerate(names):
            if name == "background":
                slope[at, :, column] = 1
            elif name == "crosstalk":
                slope[:, :, column] = own.sum(axis=0)
        slope = saturated_jacobian(flux, slope, values["trials"], values["recovery"], values["compression"])
        for column, (name, at) in enumerate(names):
            if name in SATURATION:
                up, down, width = _beside(values, name, at)
                slope[:, :, column] = (self._saturated(up, flux) - self._saturated(down, flux)) / width
        return self._saturated(values, flux), slope

    def _difference(self, values: Values, capture: ZoneCapture, name: str, at: int, zone: int) -> np.ndarray:
        up, down, width = _beside(values, name, at)
        return (self.own(up, capture, zone) - self.own(down, capture, zone)) / width


def _skewed(returns: ZoneReturns, squared: float, bin_m: float) -> ZoneReturns:
    """Return the light with a zone's squared skew [bins squared].

    Below 0 it is the extrapolation of what a skew does: twice the light as it is, less the light that is skewed.
    """
    skewed = with_skew(returns, math.sqrt(abs(squared)) * bin_m)
    if squared >= 0:
        return skewed
    near_m, far_m, light = (np.concatenate(pair) for pair in zip(returns, skewed, strict=True))
    weight = np.repeat((2.0, -1.0), (len(returns.light), len(skewed.light)))
    return ZoneReturns(near_m, far_m, weight * light)


def _masses(returns: ZoneReturns, scale: float, late: float, chirp: float) -> tuple[int, np.ndarray]:
    """Return the light that a bin would catch, by its start: the first fine step, and masses; `scale` steps a metre."""
    near_m, far_m, light = returns
    near, far = (chirped(path * scale, chirp) for path in (near_m, far_m))
    length = np.maximum(far - near, 1e-6)
    near = near + late
    first, last = math.floor(near.min()) - 1, math.ceil((near + length).max()) + 2
    density, steps = light / length, last - first + 1
    held = _shared_out(near - first, density, steps) - _shared_out(near - first + length, density, steps)
    return first, np.convolve(held, np.ones(FINE))


def _shared_out(start: np.ndarray, density: np.ndarray, steps: int) -> np.ndarray:
    """Return light that is even from `start` on, each bit of it shared by the whole steps beside it: (steps,).

    The nearer has more, in proportion: that is the integral of a pulse that is uniform over a step.
    """
    at = np.floor(start).astype(np.int64)
    after = start - at
    whole = np.cumsum(np.bincount(at + 2, density, steps))
    partly = np.bincount(at, density * (1 - after) ** 2 / 2, steps)
    return whole + partly + np.bincount(at + 1, density * (1 - after**2 / 2), steps)


def _beside(values: Values, name: str, at: int) -> tuple[Values, Values, float]:
    """Return values a little above and below in one number, and the distance between them."""
    size = abs(values[name][at])
    step = _STEPS[name] * (max(size, 1.0) if name != "bin_width" else size)
    pair = []
    for sign in (1, -1):
        moved = values[name].copy()
        moved[at] += sign * step
        pair.append({**values, name: moved})
    return pair[0], pair[1], 2 * step
