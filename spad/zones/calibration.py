"""Calibrate a multi-zone sensor from captures whose light is known: Poisson maximum likelihood by Fisher scoring.

The pulse is free: steps of a sixth of a bin over its rise and peak, of half a bin in its tail. The histograms are
linear in it, so that a step costs one product of matrices. Standard errors come from the Fisher information.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import did_you_mean, require
from spad.detection.saturation import saturated, saturated_jacobian
from spad.sensor.model import Sensor
from spad.sensor.pulse import SampledPulse
from spad.zones.sensor import ZoneArray, ZoneReturns

FINE = 6  # steps of the pulse in a bin
TAIL = 2  # the same in the tail
# What can be fitted; the pulse and the gains always are.
OPTIONAL = ("delay", "clock", "bin_width", "background", "trials", "recovery", "compression", "crosstalk")
_STEPS = {"delay": 1e-5, "clock": 1e-6, "bin_width": 1e-6, "trials": 1e-5, "recovery": 1e-5, "compression": 1e-5}
_RIDGE = 1e-11
_HALVINGS = 8


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


# Values by name: pulse (K,), gain, delay [bins], clock and background (Z,), and one number of each other, (1,).
Values = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Calibration:
    """What was fitted.

    sensor, zones     the calibrated sensor
    errors            standard error of each natural parameter by name, as `natural` orders them
    deviance          Poisson deviance a bin of the captures used
    values, basis     the fit's own parameters
    """

    sensor: Sensor
    zones: ZoneArray
    errors: dict[str, np.ndarray]
    deviance: float
    values: Values
    basis: PulseBasis


class ZoneModel:
    """Expected counts and their derivatives for the fit's parameters; delays count in bins.

    Zone `reference` holds the gauge: its gain is 1 (the pulse carries the scale), its delay 0 (the pulse carries it),
    and its clock 1 (the bin width carries it).
    """

    def __init__(self, basis: PulseBasis, bins: int, zones: int, reference: int) -> None:
        self.basis, self.bins, self.zones, self.reference = basis, bins, zones, reference

    def own(self, values: Values, capture: ZoneCapture, zone: int) -> np.ndarray:
        """Return expected signal (T,) of one zone without crosstalk."""
        first, mass = self._mass(values, capture, zone)
        # a pulse step's counts in a bin are the sum of FINE neighbouring masses
        full = np.convolve(mass, self.basis.matrix @ values["pulse"])
        at = np.arange(self.bins) * FINE + FINE - 1 - first - self.basis.first
        inside = (at >= 0) & (at < len(full))
        return np.where(inside, full[np.clip(at, 0, len(full) - 1)], 0.0) * values["gain"][zone]

    def responses(self, values: Values, capture: ZoneCapture, zone: int) -> np.ndarray:
        """Return derivative of `own` with respect to the pulse, (T, K)."""
        first, mass = self._mass(values, capture, zone)
        steps = np.arange(len(self.basis.matrix))
        at = np.arange(self.bins)[:, None] * FINE + FINE - 1 - (steps + self.basis.first)[None, :] - first
        inside = (at >= 0) & (at < len(mass))
        return np.where(inside, mass[np.clip(at, 0, len(mass) - 1)], 0.0) @ (self.basis.matrix * values["gain"][zone])

    def _mass(self, values: Values, capture: ZoneCapture, zone: int) -> tuple[int, np.ndarray]:
        """Light of one zone that a bin would catch, by its start in fine steps: the first step, and the masses.

        Exact for returns that are uniform over their paths and a pulse that is uniform over a step.
        """
        step_s = values["bin_width"][0] / FINE
        near_m, far_m, light = capture.returns[zone]
        scale = 1 / (SPEED_OF_LIGHT_M_PER_S * values["clock"][zone] * step_s)
        late = values["delay"][zone] * FINE + capture.drift_s / step_s
        near = near_m * scale + late
        length = np.maximum((far_m - near_m) * scale, 1e-6)
        first, last = math.floor(near.min()) - 1, math.ceil((near + length).max()) + 2
        after = np.arange(first - 1, last + 2)[:, None] - near
        area = (np.maximum(after, 0) ** 2 - np.maximum(after - length, 0) ** 2) @ (light / (2 * length))
        return first, np.convolve(np.diff(area, 2), np.ones(FINE))

    def flux(self, values: Values, capture: ZoneCapture) -> np.ndarray:
        own = np.array([self.own(values, capture, zone) for zone in range(self.zones)])
        return own + values["crosstalk"][0] * own.sum(axis=0) + values["background"][:, None]

    def expected(self, values: Values, capture: ZoneCapture) -> np.ndarray:
        """Return expected counts (Z, T)."""
        return self._saturated(values, self.flux(values, capture))

    def _saturated(self, values: Values, flux: np.ndarray) -> np.ndarray:
        trials = np.full(self.zones, values["trials"][0])
        return saturated(flux, trials, values["recovery"][0], values["compression"][0])

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
            elif name in ("delay", "clock", "bin_width"):
                for zone in range(self.zones) if name == "bin_width" else (at,):
                    slope[zone, :, column] = self._difference(values, capture, name, at, zone)
        crosstalk = values["crosstalk"][0]
        slope += crosstalk * slope.sum(axis=0)
        flux = own + crosstalk * own.sum(axis=0) + values["background"][:, None]
        for column, (name, at) in enumerate(names):
            if name == "background":
                slope[at, :, column] = 1
            elif name == "crosstalk":
                slope[:, :, column] = own.sum(axis=0)
        trials = np.full(self.zones, values["trials"][0])
        slope = saturated_jacobian(flux, slope, trials, values["recovery"][0], values["compression"][0])
        for column, (name, _) in enumerate(names):
            if name in ("trials", "recovery", "compression"):
                up, down, width = _beside(values, name, 0)
                slope[:, :, column] = (self._saturated(up, flux) - self._saturated(down, flux)) / width
        return self._saturated(values, flux), slope

    def _difference(self, values: Values, capture: ZoneCapture, name: str, at: int, zone: int) -> np.ndarray:
        up, down, width = _beside(values, name, at)
        return (self.own(up, capture, zone) - self.own(down, capture, zone)) / width


def _beside(values: Values, name: str, at: int) -> tuple[Values, Values, float]:
    """Values a little above and below in one number, and the distance between them."""
    size = abs(values[name][at])
    step = _STEPS[name] * (max(size, 1.0) if name != "bin_width" else size)
    pair = []
    for sign in (1, -1):
        moved = values[name].copy()
        moved[at] += sign * step
        pair.append({**values, name: moved})
    return pair[0], pair[1], 2 * step


def parameter_names(values: Values, free: Sequence[str], reference: int) -> list[tuple[str, int]]:
    """List the numbers that a fit changes: the gauge's are left out."""
    fixed = {("gain", reference), ("delay", reference), ("clock", reference)}
    return [(name, at) for name in free for at in range(len(values[name])) if (name, at) not in fixed]


def fit(
    model: ZoneModel,
    captures: Sequence[ZoneCapture],
    start: Values,
    free: Sequence[str],
    *,
    steps: int = 12,
    model_error: float = 0.0,
    smoothing: float = 0.0,
    tolerance: float = 1e-6,
) -> tuple[Values, np.ndarray, list[tuple[str, int]]]:
    """Maximise the Poisson likelihood; return the values, the Fisher information and what its rows are.

    `model_error` widens the variance of a bin of n counts to n + (model_error n)^2: a model that is wrong by some per
    cent must not be ruled by its fullest bins. `smoothing` is the weight of second differences of the pulse over its
    start. Steps are halved until the weighted squares fall.
    """
    values = {name: np.asarray(value, dtype=np.float64).copy() for name, value in start.items()}
    names = parameter_names(values, free, model.reference)
    pulse = [column for column, (name, _) in enumerate(names) if name == "pulse"]
    over = np.maximum(start["pulse"], 1e-6 * start["pulse"].max())
    rough = np.diff(np.eye(len(over)), 2, axis=0) / over * math.sqrt(smoothing)
    information = np.zeros((len(names), len(names)))
    for _ in range(steps):
        information[:], gradient, weights = 0, np.zeros(len(names)), []
        for capture in captures:
            expected, slope = model.jacobian(values, capture, names)
            weights.append(1 / (np.maximum(expected, 1e-3) + (model_error * expected) ** 2))
            flat = slope.reshape(-1, len(names))
            weighted = flat * weights[-1].reshape(-1, 1)
            information += flat.T @ weighted
            gradient += weighted.T @ (capture.counts - expected).ravel()
        information[np.ix_(pulse, pulse)] += rough.T @ rough
        gradient[pulse] -= rough.T @ (rough @ values["pulse"])
        scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        system = information * scale[:, None] * scale + _RIDGE * np.eye(len(names))
        direction = scale * np.linalg.solve(system, scale * gradient)

        def squares(at: Values, weights: list[np.ndarray] = weights) -> float:
            total = float(((rough @ at["pulse"]) ** 2).sum())
            pairs = zip(captures, weights, strict=True)
            return total + sum(float((w * (c.counts - model.expected(at, c)) ** 2).sum()) for c, w in pairs)

        now, moved = squares(values), values
        for halving in range(_HALVINGS):
            moved = _moved(values, names, direction * 0.5**halving)
            after = squares(moved)
            if after < now:
                break
        else:
            break
        values = moved
        if now - after < tolerance * now:
            break
    return values, information, names


def _moved(values: Values, names: Sequence[tuple[str, int]], step: np.ndarray) -> Values:
    """Add a step; what must stay positive keeps a twentieth of its size at least."""
    moved = {name: value.copy() for name, value in values.items()}
    for (name, at), change in zip(names, step, strict=True):
        moved[name][at] += change
        if name in ("pulse", "gain", "background", "trials"):
            moved[name][at] = max(moved[name][at], values[name][at] / 20)
        elif name in ("recovery", "compression", "crosstalk"):
            moved[name][at] = max(moved[name][at], 0.0)
    return moved


# From the fit's parameters to a sensor


def natural(model: ZoneModel, values: Values) -> dict[str, np.ndarray]:
    """Return the sensor's own parameters: seconds, detections, and delays that include the pulse's centroid."""
    width, pulse = values["bin_width"][0], model.basis.matrix @ values["pulse"]
    centroid = model.basis.first + pulse @ (np.arange(len(pulse)) + 0.5) / pulse.sum()
    return {
        "gain": values["gain"] * pulse.sum(),
        "delay_s": values["delay"] * width + centroid * width / FINE,
        "clock": values["clock"],
        "bin_width_s": values["bin_width"],
        "background": values["background"],
        "trials": values["trials"],
        "recovery": values["recovery"],
        "compression": values["compression"],
        "crosstalk": values["crosstalk"],
    }


def standard_errors(
    model: ZoneModel, values: Values, information: np.ndarray, names: Sequence[tuple[str, int]]
) -> dict[str, np.ndarray]:
    """Return standard errors of the natural parameters, by the inverse Fisher information and the delta method."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    system = information * scale[:, None] * scale + _RIDGE * np.eye(len(scale))
    covariance = scale[:, None] * scale * np.linalg.inv(system)
    centre = natural(model, values)
    slopes = {name: np.zeros((len(value), len(names))) for name, value in centre.items()}
    for column, (name, at) in enumerate(names):
        step = 1e-6 * max(abs(values[name][at]), 1e-12 if name in ("bin_width",) else 1e-3)
        moved = {key: value.copy() for key, value in values.items()}
        moved[name][at] += step
        for key, value in natural(model, moved).items():
            slopes[key][:, column] = (value - centre[key]) / step
    return {key: np.sqrt(np.einsum("ij,jk,ik->i", slope, covariance, slope)) for key, slope in slopes.items()}


def as_sensor(model: ZoneModel, values: Values, sensor: Sensor, zones: ZoneArray) -> tuple[Sensor, ZoneArray]:
    """Put fitted values into the sensor and its zones."""
    found = natural(model, values)
    width = float(found["bin_width_s"][0])
    samples = tuple((model.basis.matrix @ values["pulse"] / values["pulse"].sum()).tolist())
    periods = max(sensor.bins, round(sensor.period_s / width))
    calibrated = replace(
        sensor, bin_width_s=width, period_s=periods * width, pulse=SampledPulse(samples, width / FINE), jitter=None
    )
    return calibrated, replace(
        zones,
        gain=tuple(found["gain"].tolist()),
        delay_s=tuple(found["delay_s"].tolist()),
        clock=tuple(found["clock"].tolist()),
        background=tuple(found["background"].tolist()),
        trials=(float(found["trials"][0]),) * zones.count,
        recovery=float(found["recovery"][0]),
        compression=float(found["compression"][0]),
        crosstalk=float(found["crosstalk"][0]),
    )


def poisson_deviance(counts: np.ndarray, expected: np.ndarray) -> float:
    """Return twice the log-likelihood ratio of counts to the saturated model, summed: about one a bin for a true
    model."""
    ratio = np.where(counts > 0, counts, 1) / np.maximum(expected, 1e-9)
    return float(2 * (np.where(counts > 0, counts * np.log(ratio), 0) - counts + expected).sum())


# Where to start


def starting_values(
    captures: Sequence[ZoneCapture], sensor: Sensor, zones: int, first_bin: int, basis: PulseBasis, reference: int
) -> Values:
    """Return rough values from the captures themselves: pulse from the middle capture, gains and delays from its
    zones."""
    middle = captures[len(captures) // 2]
    counts = middle.counts.astype(np.float64)
    background = np.maximum(np.median(counts, axis=1), 1.0)
    signal = np.maximum(counts - background[:, None], 0.0)
    light = np.array([returns.light.sum() for returns in middle.returns])
    paths = np.array([(r.near_m + r.far_m) @ r.light / (2 * r.light.sum()) for r in middle.returns])
    lag = paths / (SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s) + middle.drift_s / sensor.bin_width_s
    centre = (signal @ (np.arange(sensor.bins) + 0.5)) / signal.sum(axis=1) - lag
    steps = (np.arange(len(basis.matrix)) + 0.5 + basis.first) / FINE
    shape = np.interp(steps + lag[reference], np.arange(sensor.bins) + 0.5, signal[reference])
    pulse = np.linalg.lstsq(basis.matrix, shape, rcond=None)[0]
    pulse = np.maximum(pulse, 1e-5 * pulse.max())
    pulse *= signal[reference].sum() / light[reference] / (basis.matrix @ pulse).sum()
    gain = signal.sum(axis=1) / light
    most = max(float(capture.counts.sum(axis=1).max()) for capture in captures)
    one = np.ones(1)
    return {
        "pulse": pulse,
        "gain": gain / gain[reference],
        "delay": centre - centre[reference],
        "clock": np.ones(zones),
        "bin_width": sensor.bin_width_s * one,
        "background": background,
        "trials": 2.5 * most * one,
        "recovery": 0.7 * one,
        "compression": 0.0 * one,
        "crosstalk": 0.0 * one,
    }


def check_effects(free: Sequence[str]) -> None:
    """Raise InputError for an effect that cannot be fitted."""
    for name in free:
        known = f"{did_you_mean(name, OPTIONAL)}, expected among {', '.join(OPTIONAL)}"
        require(name in OPTIONAL, f"calibrate: {name} cannot be fitted{known}")


def calibrate(
    captures: Sequence[ZoneCapture],
    sensor: Sensor,
    zones: ZoneArray,
    *,
    free: Sequence[str] = OPTIONAL,
    model_error: float = 0.005,
    smoothing: float = 100.0,
    start: Calibration | None = None,
) -> Calibration:
    """Calibrate from captures in order of distance; what is not `free` stays off, the delays of the zones at 0.

    First the pulse, gains, delays and background from every fourth capture, then all from every second, then from all;
    from `start`, all at once. Raises InputError for fewer than eight captures without a start.
    """
    check_effects(free)
    require(start is not None or len(captures) >= 8, f"calibrate: {len(captures)} captures, expected 8 or more")
    reference = zones.count // 2
    if start is not None:
        basis, values = start.basis, dict(start.values)
    else:
        basis = _basis_for(captures, sensor, reference)
        values = starting_values(captures, sensor, zones.count, 0, basis, reference)
    off = {"recovery": 0.0, "compression": 0.0, "crosstalk": 0.0, "clock": 1.0, "trials": math.inf, "delay": 0.0}
    for name, value in off.items():
        if name not in free:
            values[name] = np.full_like(values[name], value)
    model = ZoneModel(basis, sensor.bins, zones.count, reference)
    simple = ["pulse", "gain", *(name for name in ("delay", "background") if name in free)]
    everything = ["pulse", "gain", *free]
    options = {"smoothing": smoothing}
    if start is None:
        values, *_ = fit(model, captures[::4], values, simple, steps=8, model_error=max(0.1, model_error), **options)
        values, *_ = fit(
            model, captures[::2], values, everything, steps=6, model_error=max(0.02, model_error), **options
        )
    values, information, names = fit(model, captures, values, everything, model_error=model_error, **options)
    calibrated = as_sensor(model, values, sensor, zones)
    bins = sum(capture.counts.size for capture in captures)
    deviance = sum(poisson_deviance(c.counts, model.expected(values, c)) for c in captures) / bins
    return Calibration(*calibrated, standard_errors(model, values, information, names), deviance, values, basis)


def _basis_for(captures: Sequence[ZoneCapture], sensor: Sensor, reference: int) -> PulseBasis:
    """Steps of the pulse: fine from three bins before the return's peak to four after it, coarse for 34 more."""
    middle = captures[len(captures) // 2]
    near_m, far_m, light = middle.returns[reference]
    path = float((near_m + far_m) @ light / (2 * light.sum()))
    peak = int(middle.counts[reference].argmax()) - path / (SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s)
    return PulseBasis.made(math.floor(peak) - 3, 8, min(34, sensor.bins // 3))
