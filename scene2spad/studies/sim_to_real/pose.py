"""Distance and tilt of a plane from one capture of all zones, by the renderer's derivative, with Fisher covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from scene2spad.datasets.zone_captures import render_plane
from scenes.errors import require
from spad.sensor.model import Sensor
from spad.sensor.zone_array import ZoneArray
from spad.zones.fit import covariance_of
from spad.zones.simulation import ZoneReturns, expected_zone_counts, zone_returns

# Rigid motions that the derivative is taken over: metres, and radians about the sensor's y and x axes.
STEPS = (5e-4, 0.01, 0.01)
REACH = (0.02, 0.2, 0.2)  # the most that one step of the fit moves
ITERATIONS = 5
COVERAGE = 0.95  # of intervals


class Pose(NamedTuple):
    """Distance [m], tilts about y and x [rad], reflectance relative to the calibration's plane; covariance (4, 4)."""

    values: np.ndarray
    covariance: np.ndarray


def render_light(values: np.ndarray, zones: ZoneArray) -> list[ZoneReturns]:
    """Render a plane of that pose: the light of each zone at a reflectance of 1."""
    distance, about_y, about_x, _ = values
    return zone_returns(render_plane(float(distance), zones, (float(about_y), float(about_x))), zones)


def sensed(
    light: list[ZoneReturns], reflectance: float, sensor: Sensor, zones: ZoneArray, drift_s: float
) -> np.ndarray:
    """Return expected counts (Z, T) of rendered light."""
    lit = [seen._replace(light=seen.light * reflectance) for seen in light]
    return expected_zone_counts(lit, sensor, zones, drift_s)


def render_counts(values: np.ndarray, sensor: Sensor, zones: ZoneArray, drift_s: float) -> np.ndarray:
    """Return expected counts (Z, T) of a plane of that pose and reflectance: rendered, then sensed."""
    return sensed(render_light(values, zones), values[3], sensor, zones, drift_s)


def counts_and_derivative(
    values: np.ndarray, sensor: Sensor, zones: ZoneArray, drift_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return expected counts (Z, T) and their differences over small motions and reflectance, (Z, T, 4)."""
    light, columns = render_light(values, zones), []
    for number, step in enumerate(STEPS):
        move = np.eye(4)[number] * step
        up, down = (render_counts(values + sign * move, sensor, zones, drift_s) for sign in (1, -1))
        columns.append((up - down) / (2 * step))
    bright, dim = (sensed(light, values[3] * factor, sensor, zones, drift_s) for factor in (1.01, 0.99))
    columns.append((bright - dim) / (0.02 * values[3]))
    return sensed(light, values[3], sensor, zones, drift_s), np.stack(columns, axis=-1)


def find_pose(
    counts: np.ndarray,
    sensor: Sensor,
    zones: ZoneArray,
    start_m: float,
    *,
    drift_s: float = 0.0,
    model_error: float = 0.01,
) -> Pose:
    """Maximise the likelihood of counts (Z, T) by Fisher scoring, from a plane that faces the sensor at `start_m`.

    A bin of n counts has the variance n + (model_error n)^2. The covariance is the inverse Fisher information.
    """
    values = np.array([start_m, 0.0, 0.0, 1.0])
    reach = np.array([*REACH, 0.5])
    for _ in range(ITERATIONS):
        expected, derivative = counts_and_derivative(values, sensor, zones, drift_s)
        slope = derivative.reshape(-1, 4)
        weight = 1 / (np.maximum(expected, 1e-3) + (model_error * expected) ** 2).ravel()
        information = slope.T @ (slope * weight[:, None])
        covariance = covariance_of(information)
        step = covariance @ (slope.T @ (weight * (counts - expected).ravel()))
        step *= min(1.0, float((reach / np.maximum(np.abs(step), 1e-12)).min()))
        values = values + step
        values[0], values[3] = max(values[0], 5e-3), max(values[3], 1e-3)
        if (np.abs(step) < 0.05 * np.sqrt(np.diag(covariance))).all():
            break
    return Pose(values, covariance)


class ModelCovariance(NamedTuple):
    """Covariance (4, 4) that the model's errors add to a pose, and half widths (4,) of 95 % intervals in units of the
    standard errors of both together."""

    covariance: np.ndarray
    factors: np.ndarray

    def interval(self, found: Pose) -> tuple[np.ndarray, np.ndarray]:
        """Return standard errors of a pose's values, photons and model together, and half widths of 95 % intervals."""
        sigma = np.sqrt(np.diag(found.covariance + self.covariance))
        return sigma, sigma * self.factors


def model_covariance(errors: np.ndarray, covariances: np.ndarray) -> ModelCovariance:
    """Return mean over known poses of e e^T - covariance, without its negative directions.

    errors (N, 4) of poses found from captures of known poses, covariances (N, 4, 4) by the Fisher information. That
    takes the errors of bins as independent. The model's own are not: all bins of a capture are late together. Errors
    are about zero, so that a bias widens the intervals, too. InputError without a known pose.

    Intervals are conformal: the known pose of rank ceil(0.95 (N + 1)) decides how many standard errors hold 95 % of
    further ones, whatever the law of the errors (Vovk et al., Algorithmic Learning in a Random World, 2005). Below 19
    known poses there is no such rank, and Student's t of N degrees of freedom stands in.
    """
    count = len(errors)
    require(count > 0, "model covariance: no capture of a known pose")
    excess = (errors[:, :, None] * errors[:, None, :] - covariances).mean(axis=0)
    values, directions = np.linalg.eigh(excess)
    added = (directions * np.maximum(values, 0)) @ directions.T
    in_sigmas = np.sort(np.abs(errors) / np.sqrt(np.diagonal(covariances + added, axis1=1, axis2=2)), axis=0)
    rank = math.ceil(COVERAGE * (count + 1))
    student = np.full(errors.shape[1], stdtrit(count, (1 + COVERAGE) / 2))
    return ModelCovariance(added, in_sigmas[rank - 1] if rank <= count else student)


def nearest_start(counts: np.ndarray, known_m: Sequence[float], known: np.ndarray) -> float:
    """Return the distance, among expected counts (M, Z, T) of known ones, whose histograms look most like `counts`."""
    flat = known.reshape(len(known), -1)
    likeness = flat @ counts.ravel() / np.linalg.norm(flat, axis=1)
    return float(known_m[int(likeness.argmax())])
