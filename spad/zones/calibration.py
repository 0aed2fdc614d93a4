"""Calibrate a multi-zone sensor from captures whose light is known, with standard errors by the Fisher information."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import did_you_mean, require
from spad.sensor.files import ZONES, SensorFile
from spad.sensor.model import Sensor
from spad.sensor.pulse import SampledPulse
from spad.sensor.zone_array import OFF, ZoneArray
from spad.zones.expected_counts import FINE, PulseBasis, Values, ZoneCapture, ZoneModel
from spad.zones.fit import covariance_of, fit

# What can be fitted; the pulse and the gains always are.
OPTIONAL = (
    "delay",
    "skew",
    "clock",
    "bin_width",
    "chirp",
    "background",
    "leak",
    "echo",
    "trials",
    "recovery",
    "compression",
    "crosstalk",
)
# What the fit has where they are off; chirp and crosstalk are one number for all zones.
_OFF = {name: OFF.get(ZONES[name].field, 0.0) for name in OPTIONAL if name != "bin_width"}
MIN_FITTED = 8  # captures
TAIL_BINS = 48
RISE_BINS, RISE_BINS_LIMIT = 2, 8
RETURN_SIGMAS = 6.0  # of a bin's background: Poisson noise alone reaches it in 1 of 1,000 histograms at the most


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration: the fitted sensor, and how well it is known.

    sensor, zones     the calibrated sensor
    errors            standard error of each natural parameter by name, as `natural` orders them
    deviance          Poisson deviance a bin of the captures used
    values, basis     the fit's own parameters
    free              effects that were fitted, of OPTIONAL; the others are off, and the width of a bin is the start's
    """

    sensor: Sensor
    zones: ZoneArray
    errors: dict[str, np.ndarray]
    deviance: float
    values: Values
    basis: PulseBasis
    free: tuple[str, ...]


# From the fit's parameters to a sensor


def natural(model: ZoneModel, values: Values) -> dict[str, np.ndarray]:
    """Return the sensor's own parameters: seconds, detections, and delays that include the pulse's centroid."""
    width, pulse = values["bin_width"][0], model.basis.matrix @ values["pulse"]
    centroid = model.basis.first + pulse @ (np.arange(len(pulse)) + 0.5) / pulse.sum()
    return {
        "gain": values["gain"] * pulse.sum(),
        "delay_s": values["delay"] * width + centroid * width / FINE,
        "skew_s": np.sqrt(np.maximum(values["skew"], 0.0)) * width,
        "clock": values["clock"],
        "bin_width_s": values["bin_width"],
        "chirp_hz": values["chirp"] / width,
        "background": values["background"],
        "leak": values["leak"],
        "echo_m2": values["echo"],
        "trials": values["trials"],
        "recovery": values["recovery"],
        "compression": values["compression"],
        "crosstalk": values["crosstalk"],
    }


def standard_errors(
    model: ZoneModel, values: Values, information: np.ndarray, names: Sequence[tuple[str, int]]
) -> dict[str, np.ndarray]:
    """Return standard errors of the natural parameters, by the inverse Fisher information and the delta method.

    A skew is the root of what is fitted: its error is how far one standard error of that moves it, also at 0.
    """
    covariance = covariance_of(information)
    centre = natural(model, values)
    slopes = {name: np.zeros((len(value), len(names))) for name, value in centre.items()}
    for column, (name, at) in enumerate(names):
        step = 1e-6 * max(abs(values[name][at]), 1e-12 if name in ("bin_width",) else 1e-3)
        if name == "skew":
            step = max(step, math.sqrt(covariance[column, column]))
        moved = {key: value.copy() for key, value in values.items()}
        moved[name][at] += step
        for key, value in natural(model, moved).items():
            known = np.isfinite(centre[key])  # trials of a zone that does not saturate stay infinite
            slopes[key][known, column] = (value[known] - centre[key][known]) / step
    return {key: np.sqrt(np.einsum("ij,jk,ik->i", slope, covariance, slope)) for key, slope in slopes.items()}


def as_sensor(model: ZoneModel, values: Values, sensor: Sensor, zones: ZoneArray) -> tuple[Sensor, ZoneArray]:
    """Put fitted values into the sensor and its zones."""
    found = natural(model, values)
    width = float(found["bin_width_s"][0])
    samples = tuple((model.basis.matrix @ values["pulse"] / values["pulse"].sum()).tolist())
    covered = sensor.bins == sensor.bins_per_period
    periods = sensor.bins if covered else max(sensor.bins, round(sensor.period_s / width))
    calibrated = replace(
        sensor, bin_width_s=width, period_s=periods * width, pulse=SampledPulse(samples, width / FINE), jitter=None
    )
    return calibrated, replace(
        zones,
        gain=tuple(found["gain"].tolist()),
        delay_s=tuple(found["delay_s"].tolist()),
        skew_s=tuple(found["skew_s"].tolist()),
        clock=tuple(found["clock"].tolist()),
        chirp_hz=float(found["chirp_hz"][0]),
        background=tuple(found["background"].tolist()),
        leak=tuple(found["leak"].tolist()),
        echo_m2=tuple(found["echo_m2"].tolist()),
        trials=tuple(found["trials"].tolist()),
        recovery=tuple(found["recovery"].tolist()),
        compression=tuple(found["compression"].tolist()),
        crosstalk=float(found["crosstalk"][0]),
    )


def calibrated_file(start: SensorFile, fitted: Calibration, name: str, how: str) -> SensorFile:
    """Return the sensor file of a calibration; the sources of what it left as it was are kept, and effects that are off
    have none."""
    key_of = {name: "histogram.bin_width" if name == "bin_width" else f"zones.{name}" for name in OPTIONAL}
    off = {key_of[name] for name in _OFF}
    kept = {key: source for key, source in start.sources.items() if not key.startswith(("pulse.", "jitter."))}
    sources = {key: source for key, source in kept.items() if key not in off}
    fitted_keys = ("pulse.samples", "pulse.step", "zones.gain", *(key_of[name] for name in fitted.free))
    sources.update(dict.fromkeys(fitted_keys, how))
    sensor = replace(fitted.sensor, name=name)
    return SensorFile(sensor, None, fitted.zones, f"{start.sensor.name}, {how}", sources)


def poisson_deviance(counts: np.ndarray, expected: np.ndarray) -> float:
    """Return twice the log-likelihood ratio of counts to the saturated model: about one a bin for a true model."""
    ratio = np.where(counts > 0, counts, 1) / np.maximum(expected, 1e-9)
    return float(2 * (np.where(counts > 0, counts * np.log(ratio), 0) - counts + expected).sum())


# Where to start


def sees_return(counts: np.ndarray) -> np.ndarray:
    """Tell which histograms hold a return: the fullest bin is RETURN_SIGMAS above the median one, (..., T) -> (...)."""
    background = np.median(counts, axis=-1)
    return counts.max(axis=-1) > background + RETURN_SIGMAS * np.sqrt(np.maximum(background, 1.0))


def check_returns(counts: np.ndarray) -> None:
    """Raise InputError for a zone that sees no return in most of the captures, counts (N, Z, T), or if some zone misses
    it in every capture.

    A gain of 0 is no way out: whatever covered the zone, the file would go on to say that it is blind.
    """
    seen = sees_return(counts)
    for zone, number in enumerate(seen.sum(axis=0)):
        kind = "all its counts are 0" if not counts[:, zone].any() else "the others hold background alone or nothing"
        message = f"zone {zone} (of 0 to {seen.shape[1] - 1}) sees a return in {number} of {len(seen)} captures, {kind}"
        advice = "its gain and delay cannot be fitted; uncover it, or leave it out of counts and [zones]"
        require(2 * number > len(seen), f"{message}: {advice}")
    message = f"in none of {len(seen)} captures do all {seen.shape[1]} zones see a return, which a fit begins with"
    require(bool(seen.all(axis=1).any()), message)


def middle_capture(captures: Sequence[ZoneCapture]) -> ZoneCapture:
    """Return the capture next to the middle one in which every zone sees a return."""
    good = np.flatnonzero([sees_return(capture.counts).all() for capture in captures])
    return captures[good[np.abs(good - len(captures) // 2).argmin()]]


def starting_values(
    captures: Sequence[ZoneCapture], sensor: Sensor, zones: int, basis: PulseBasis, reference: int
) -> Values:
    """Find rough values from the captures: pulse from the middle capture, gains and delays from its zones."""
    middle = middle_capture(captures)
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
        "skew": np.zeros(zones),
        "clock": np.ones(zones),
        "bin_width": sensor.bin_width_s * one,
        "chirp": 0.0 * one,
        "background": background,
        "leak": np.zeros(zones),
        "echo": np.zeros(zones),
        "trials": np.full(zones, 2.5 * most),
        "recovery": np.full(zones, 0.7),
        "compression": np.zeros(zones),
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
    model_error: float = 0.004,
    smoothing: float = 1e3,
    start: Calibration | None = None,
) -> Calibration:
    """Calibrate from captures in order of distance; what is not `free` stays off, the delays of the zones at 0.

    First the pulse, gains, delays and background from every fourth capture, then all from every second, then from all;
    from `start`, all at once. Raises InputError for fewer than eight captures without a start, and a zone that sees no
    return in most of them.
    """
    check_effects(free)
    require(
        start is not None or len(captures) >= MIN_FITTED,
        f"calibrate: {len(captures)} captures, expected {MIN_FITTED} or more",
    )
    check_returns(np.array([capture.counts for capture in captures]))
    reference = zones.count // 2
    if start is not None:
        basis, values = start.basis, dict(start.values)
    else:
        basis = _basis_for(captures, sensor, reference)
        values = starting_values(captures, sensor, zones.count, basis, reference)
    for name, value in _OFF.items():
        if name not in free:
            values[name] = np.full_like(values[name], value)
    everything = ["pulse", "gain", *free]
    model_of = partial(ZoneModel, basis, sensor.bins, zones.count, reference, period=sensor.bins_per_period)
    if start is None:
        simple = ["pulse", "gain", *(name for name in ("delay", "background") if name in free)]
        first = partial(fit, model_of(), smoothing=smoothing)
        values, *_ = first(captures[::4], values, simple, steps=8, model_error=max(0.1, model_error))
        values, *_ = first(captures[::2], values, everything, steps=6, model_error=max(0.02, model_error))
    narrowest = int(values["skew"].argmin())  # the pulse is as wide as it is in this zone
    values["skew"] -= values["skew"][narrowest]
    model = model_of(narrowest)
    values, information, names = fit(model, captures, values, everything, model_error=model_error, smoothing=smoothing)
    calibrated = as_sensor(model, values, sensor, zones)
    bins = sum(capture.counts.size for capture in captures)
    deviance = sum(poisson_deviance(c.counts, model.expected(values, c)) for c in captures) / bins
    errors = standard_errors(model, values, information, names)
    return Calibration(*calibrated, errors, deviance, values, basis, tuple(free))


def _basis_for(captures: Sequence[ZoneCapture], sensor: Sensor, reference: int) -> PulseBasis:
    """Choose the pulse's steps: fine from before its rise to 4 bins after its peak, coarse for TAIL_BINS more.

    The rise begins where the middle capture's reference zone leaves its background; RISE_BINS more are for what its
    noise hides and all captures together show.
    """
    middle = middle_capture(captures)
    near_m, far_m, light = middle.returns[reference]
    path = float((near_m + far_m) @ light / (2 * light.sum()))
    counts = middle.counts[reference]
    peak, background = int(counts.argmax()), np.median(counts)
    raised = counts > background + 3 * np.sqrt(np.maximum(background, 1.0))
    rise = int((~raised[:peak][::-1]).argmax()) if not raised[:peak].all() else peak
    before = min(rise + RISE_BINS, RISE_BINS_LIMIT)
    at = math.floor(peak - path / (SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s))
    return PulseBasis.made(at - before, before + 5, min(TAIL_BINS, sensor.bins // 3))
