"""Expected rates of one pixel, for figures: as `flux.expected_counts`, without a second for torch's import where the
response is Gaussian.

Returns that have a length are then summed by Gauss-Legendre quadrature over panels no longer than the pulse is wide,
where `flux` integrates in closed form. Others rise more steeply than they are wide, and would take too many panels.
"""

from __future__ import annotations

import math

import numpy as np

from render.transient import Transient
from spad.detection.detect import expected_in_pixel
from spad.detection.photons import light_of, quadrature_points
from spad.detection.rates import rates_for
from spad.sensor.model import PhotonBudget, Sensor
from spad.sensor.pulse import Pulse

WINDOW_SIGMAS = 6.0


def quadrature_in_pixel(
    transient: Transient, sensor: Sensor, budget: PhotonBudget, row: int, column: int, *, seed: int = 0
) -> np.ndarray:
    """Return expected primary detections per bin of one pixel, (T,) float64: `detect.expected_in_pixel` to 1e-6 of
    its peak."""
    pulse = sensor.response
    if not isinstance(pulse, Pulse) or pulse.tail_s:
        return expected_in_pixel(transient, sensor, budget, row, column, seed=seed)
    pixel, period = row * transient.width + column, sensor.bins_per_period
    rates = rates_for(transient, sensor, budget, seed=seed)
    light = light_of(transient, sensor, rates, slice(pixel, pixel + 1))
    edges = np.arange(sensor.bins + 1.0)  # of the record: a longer period has none elsewhere
    unequal = rates.converter is not None and sensor.code_edges is not None
    if rates.converter is not None and sensor.code_edges is not None:  # the bins cover the period then
        edges = sensor.code_edges[rates.converter.reshape(-1)[pixel]]
    width = sensor.bin_width_s
    arrival, energy = quadrature_points(light.start, light.length, light.signal, sensor)
    # an edge may lie some bins from where it is meant to be
    reach = math.ceil(float(np.abs(edges - np.arange(sensor.bins + 1)).max())) + 1
    before, after = (math.ceil(part / width) + reach for part in pulse.window_s(WINDOW_SIGMAS))
    number = np.floor(arrival).astype(np.int64)[:, None] + np.arange(-before, after + 2)
    at = edges[number % period] + number // period * period if unequal else number.astype(float)
    mass = pulse.bin_masses((at - arrival[:, None]) * width) * energy[:, None]
    place = number[:, :-1] % period
    seen = place < sensor.bins
    signal = np.bincount(place[seen], mass[seen], minlength=sensor.bins)
    return signal + light.background[0] / period * np.diff(edges)
