"""Fit the numbers of a multi-zone sensor to counts: Poisson maximum likelihood by Fisher scoring."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from spad.sensor.zone_array import largest_chirp
from spad.zones.expected_counts import Values, ZoneCapture, ZoneModel

_RIDGE = 1e-11
_HALVINGS = 8
_TOLERANCE = 1e-6
_ACTIVE_SETS = 12
_FLOOR = 1e-4  # of the pulse's peak: what is below is flat to the smoothing
_FLAT = 1e-6  # squared relative precision below which nothing is known of a number
# The most that one step may change of what moves the light in time [bins], and relatively of clocks.
_REACH = {"delay": 0.5, "skew": 1.0, "clock": 0.02, "chirp": 1e-3}
_REACH_RELATIVE = {"bin_width": 0.02, "trials": 1.0}
# Sizes of what can be 0 at the start: a number at 0 of which the captures say much must be free to grow.
_SCALE = {
    "leak": 1e-3,
    "echo": 1e-5,
    "compression": 0.1,
    "recovery": 0.1,
    "crosstalk": 1e-3,
    "skew": 0.01,
    "chirp": 1e-4,
}
_ROUNDING = 1 - 1e-9  # a chirp at its largest must be one that the sensor file takes
_POSITIVE = ("pulse", "gain", "background", "trials")
_NOT_NEGATIVE = ("recovery", "compression", "crosstalk", "leak", "echo")


@np.errstate(over="ignore", invalid="ignore")  # a step whose light overflows is halved: its squares do not fall
def fit(
    model: ZoneModel,
    captures: Sequence[ZoneCapture],
    start: Values,
    free: Sequence[str],
    *,
    steps: int = 40,
    model_error: float = 0.0,
    smoothing: float = 0.0,
) -> tuple[Values, np.ndarray, list[tuple[str, int]]]:
    """Maximise the Poisson likelihood; return the values, the Fisher information and what its rows are.

    `model_error` widens the variance of a bin of n counts to n + (model_error n)^2: a model that is wrong by some per
    cent must not be ruled by its fullest bins. `smoothing` is the weight of squared third differences of the pulse's
    logarithm. Steps are halved until the weighted squares fall.
    """
    values = {name: np.asarray(value, dtype=np.float64).copy() for name, value in start.items()}
    names = model.parameter_names(values, free)
    pulse = [column for column, (name, _) in enumerate(names) if name == "pulse"]
    lengths = model.basis.lengths
    not_negative = _NOT_NEGATIVE if model.signed_skew else (*_NOT_NEGATIVE, "skew")
    information = np.zeros((len(names), len(names)))
    detected = np.max([capture.counts.sum(axis=1) for capture in captures], axis=0)
    chirp = _ROUNDING * largest_chirp(captures[0].counts.shape[1])
    for _ in range(steps):
        information[:], gradient, weights = 0, np.zeros(len(names)), []
        rough, rough_slope = roughness(values["pulse"], lengths)
        for capture in captures:
            expected, slope = model.jacobian(values, capture, names)
            weights.append(1 / (np.maximum(expected, 1e-3) + (model_error * expected) ** 2))
            flat = slope.reshape(-1, len(names))
            weighted = flat * weights[-1].reshape(-1, 1)
            information += flat.T @ weighted
            gradient += weighted.T @ (capture.counts - expected).ravel()
        information[np.ix_(pulse, pulse)] += smoothing * rough_slope.T @ rough_slope
        gradient[pulse] -= smoothing * rough_slope.T @ rough
        bounds = _step_bounds(values, names, np.diag(information), detected, chirp, not_negative)
        direction = _bounded_step(information, gradient, *bounds)

        def squares(at: Values, weights: list[np.ndarray] = weights) -> float:
            total = smoothing * float((roughness(at["pulse"], lengths)[0] ** 2).sum())
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
        if now - after < _TOLERANCE * now:
            break
    return values, information, names


def roughness(pulse: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return third differences of the logarithm of a pulse (K,) per fine step, and their derivatives (., K).

    They are 0 for a Gaussian and for an exponential, so that smoothing by them takes neither away; where the length of
    steps (K,) changes there are none. Below _FLOOR of the peak a pulse counts as flat.
    """
    density = pulse / lengths
    raised = density + _FLOOR * density.max()
    parts = [np.flatnonzero(lengths == length) for length in np.unique(lengths)]
    rows = [np.diff(np.eye(len(pulse))[part], 3, axis=0) / lengths[part[0]] ** 3 for part in parts]
    third = np.concatenate(rows)
    return third @ np.log(raised), third / (raised * lengths)


def _step_bounds(
    values: Values,
    names: Sequence[tuple[str, int]],
    curvature: np.ndarray,
    detected: np.ndarray,
    chirp: float,
    not_negative: Sequence[str] = _NOT_NEGATIVE,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute how far each parameter may fall and rise in a step, (P,): within the linearisation, and what is positive
    stays so. No zone has fewer trials than detections, `detected` (Z,), and no clock a larger chirp than `chirp`.

    What the captures say nothing about stays where it is.
    """
    low, high = np.full(len(names), -math.inf), np.full(len(names), math.inf)
    for column, (name, at) in enumerate(names):
        value, size = values[name][at], max(float(np.abs(values[name]).max()), _SCALE.get(name, 0.0))
        reach = _REACH.get(name, math.inf)
        if name in _REACH_RELATIVE:
            reach = _REACH_RELATIVE[name] * abs(value)
        if curvature[column] * size * size < _FLAT:
            reach = 0.0
        room = 0.95 * value if name in _POSITIVE else value if name in not_negative else math.inf
        if name == "trials":
            room = max(0.0, value - 1.02 * detected[at])
        low[column], high[column] = -min(reach, room), reach
        if name == "chirp":
            low[column], high[column] = max(-reach, -chirp - value), min(reach, chirp - value)
    return low, high


def _bounded_step(information: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Solve information x step = gradient (P,) within bounds: what would leave them is held there, in turn."""
    step, held = np.zeros(len(gradient)), low == high
    for _ in range(_ACTIVE_SETS):
        free = np.flatnonzero(~held)
        pull = gradient[free] - information[np.ix_(free, np.flatnonzero(held))] @ step[held]
        step[free] = covariance_of(information[np.ix_(free, free)]) @ pull
        outside = ~held & ((step < low) | (step > high))
        if not outside.any():
            break
        held |= outside
        step[held] = np.clip(step, low, high)[held]
    return np.clip(step, low, high)


def _moved(values: Values, names: Sequence[tuple[str, int]], step: np.ndarray) -> Values:
    """Add a step."""
    moved = {name: value.copy() for name, value in values.items()}
    for (name, at), change in zip(names, step, strict=True):
        moved[name][at] += change
    return moved


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Invert a Fisher information (P, P) whose rows differ in scale by many orders of magnitude."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    system = information * scale[:, None] * scale + _RIDGE * np.eye(len(scale))
    return scale[:, None] * scale * np.linalg.inv(system)
