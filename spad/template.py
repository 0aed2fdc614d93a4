"""The centred pulse on the time axis: density, CDF, the CDF's integral, and what a lone arrival puts into each bin.

All functions are torch, elementwise, and compute in float64: times are 1e-7 s, their differences matter to 1e-16 s.
`t` is seconds after the arrival (the pulse's centroid), s the pulse's standard deviation.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from spad.sensor import Pulse, Sensor

# Half the window outside which float64 sees nothing of a Gaussian: 1 - erf(8.5 / sqrt 2) = 1.9e-17.
_REACH_SIGMAS = 8.5

FINE_STEP = 1 / 8  # bins between the arrivals of an estimator's fine grid; a parabola does the rest


def pulse_density(pulse: Pulse, t: Tensor) -> Tensor:
    """f(t) = phi(t / s) / s [1/s], any shape."""
    x = t.double() / pulse.sigma_s
    return torch.exp(-0.5 * x * x) / (pulse.sigma_s * math.sqrt(2 * math.pi))


def pulse_cdf(pulse: Pulse, t: Tensor) -> Tensor:
    """F(t) = Phi(t / s), the share of the pulse that has arrived by t; any shape.

    By erfc: torch.special.ndtr goes by 1 + erf, which has no digit left from -8.3 s on.
    """
    return 0.5 * torch.special.erfc(t.double() * (-math.sqrt(0.5) / pulse.sigma_s))


def pulse_cdf_integral(pulse: Pulse, t: Tensor) -> Tensor:
    """H(t) = integral of F from -infinity to t = t Phi(t / s) + s phi(t / s) [s], any shape; never negative.

    The two terms cancel where t is very negative, so the tail is written with Mills' ratio M(a) = Phi(-a) / phi(a):
    H(-a s) = s phi(a) (1 - a M(a)); and H(t) = t + H(-t) takes it to positive t, where it tends to t.
    """
    x = t.double() / pulse.sigma_s
    a = x.abs()
    mills = math.sqrt(math.pi / 2) * torch.special.erfcx(a / math.sqrt(2))
    density = torch.exp(-0.5 * a * a) / math.sqrt(2 * math.pi)
    # Clamped: from a = 1e7 on, a M(a) = 1 to the last bit and may round above it.
    return pulse.sigma_s * (x.clamp(min=0) + density * (1 - a * mills).clamp(min=0))


def pulse_mass(pulse: Pulse, centre: Tensor, width_s: float) -> Tensor:
    """F(centre + width/2) - F(centre - width/2), the pulse's share in an interval; any shape, >= 0.

    Taken on the left flank for either sign (a Gaussian is even): the right tail is then a difference of small
    numbers and not of numbers near one, so that it keeps its digits and a logarithm of it is sound.
    """
    left = -centre.double().abs()
    return pulse_cdf(pulse, left + width_s / 2) - pulse_cdf(pulse, left - width_s / 2)


def pulse_mass_slope(pulse: Pulse, centre: Tensor, width_s: float) -> Tensor:
    """d/d tau of `pulse_mass` for an arrival at tau, centre = bin centre - tau: f(start) - f(stop) [1/s]."""
    centre = centre.double()
    return pulse_density(pulse, centre - width_s / 2) - pulse_density(pulse, centre + width_s / 2)


def wraps(sensor: Sensor) -> range:
    """The periods m for which a pulse m periods away still reaches a bin within half a period of its arrival."""
    reach = (_REACH_SIGMAS * sensor.pulse.sigma_s + sensor.bin_width_s) / sensor.period_s
    count = max(0, math.ceil(reach - 0.5))
    return range(-count, count + 1)


def wrapped_mass(offset_s: Tensor, sensor: Sensor) -> Tensor:
    """Share of a periodic pulse in a bin whose centre lies `offset_s` after the arrival (half a period either side)."""
    pulse, width, period = sensor.pulse, sensor.bin_width_s, sensor.period_s
    return sum(pulse_mass(pulse, offset_s + m * period, width) for m in wraps(sensor))


def bin_offsets(arrival_s: Tensor, sensor: Sensor) -> Tensor:
    """Bin centre minus arrival, (...,) -> (..., T) [s], folded into half a period (and a bin) either side.

    Split into whole bins and a rest that all bins share: neighbouring bins then meet at one and the same edge, to
    rounding near the arrival and not of the whole period, and a pulse of a hundredth of a bin keeps its total.
    """
    position = arrival_s.double().unsqueeze(-1) / sensor.bin_width_s
    whole = position.floor()
    half = sensor.bins_per_period // 2
    bins = torch.arange(sensor.bins, dtype=torch.float64, device=arrival_s.device)
    steps = torch.remainder(bins - whole + half, sensor.bins_per_period) - half
    return (steps + 0.5 - (position - whole)) * sensor.bin_width_s


def binned_pulse(arrival_s: Tensor, sensor: Sensor) -> Tensor:
    """h_i(tau): expected counts per bin of one detection that arrives at `arrival_s`, (...,) -> (..., T) float64.

    h_i(tau) = sum over m of F(t_(i+1) - tau - m P) - F(t_i - tau - m P), t_i = i bin widths, P the period. Sums to one
    over a period; a sensor whose bins do not cover the period loses what falls outside them.
    """
    return wrapped_mass(bin_offsets(arrival_s, sensor), sensor)


def binned_pulse_slope(arrival_s: Tensor, sensor: Sensor) -> Tensor:
    """d h_i / d tau [1/s], (...,) -> (..., T) float64: the exact derivative of `binned_pulse`."""
    pulse, width, period = sensor.pulse, sensor.bin_width_s, sensor.period_s
    offsets = bin_offsets(arrival_s, sensor)
    return sum(pulse_mass_slope(pulse, offsets + m * period, width) for m in wraps(sensor))


class Taps(NamedTuple):
    """The pulse on the L bins around an arrival, for one sensor."""

    shifts: Tensor  # (L,) int64, bins after the arrival's bin
    steps: Tensor  # (G,) float64, arrival after the centre of its bin, in bins, -1 to 1
    fine: Tensor  # (G, L) float64, h of bin `shifts` for an arrival at `steps`
    coarse: slice  # the taps that the search over all bins uses
    window: Tensor  # (L,) bool, the taps that split signal from background

    @property
    def centred(self) -> Tensor:
        """(L,) h for an arrival in the centre of its bin."""
        return self.fine[len(self.steps) // 2]


@lru_cache(maxsize=16)
def pulse_taps(sensor: Sensor, device: str) -> Taps:
    """The taps of a sensor, computed once a device."""
    sigma, period = sensor.pulse.sigma_s / sensor.bin_width_s, sensor.bins_per_period

    def shifts_within(reach_bins: float) -> tuple[int, int]:
        # No bin twice: a pulse as wide as the period has as many taps as the period has bins.
        reach = math.ceil(reach_bins)
        return min(reach, (period - 1) // 2), min(reach, period // 2)

    # 6 sigma hold all but 2e-9; a bin more, since the fine grid moves the pulse by up to one. The search over all
    # bins needs fewer: beyond 4 sigma lies information only where counts are so many that the peak is beyond doubt.
    below, above = shifts_within(6 * sigma + 1.5)
    near_below, near_above = shifts_within(4 * sigma + 0.5)
    shifts = torch.arange(-below, above + 1, device=device)
    count = round(1 / FINE_STEP)
    steps = torch.arange(-count, count + 1, dtype=torch.float64, device=device) * FINE_STEP
    offsets = torch.remainder(shifts - steps.unsqueeze(-1) + period / 2, period) - period / 2
    return Taps(
        shifts=shifts,
        steps=steps,
        fine=wrapped_mass(offsets * sensor.bin_width_s, sensor),
        coarse=slice(below - near_below, below + near_above + 1),
        window=shifts.abs() <= max(0, round(min(2 * sigma, period / 4))),
    )
