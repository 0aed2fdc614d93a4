"""The centred pulse on the time axis: density, CDF, the CDF's integral, and what a lone arrival puts into each bin.

All functions are torch, elementwise, and compute in float64: times are 1e-7 s, their differences matter to 1e-16 s.
`t` is seconds after the arrival (the pulse's centroid). Three kinds of pulse: Gaussian of standard deviation s;
exponentially modified Gaussian, x = t + tau its time after the Gaussian's centre and tau its tail; and measured steps.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from spad.sensor.model import Sensor
from spad.sensor.pulse import REACH_SIGMAS, AnyPulse, Pulse, SampledPulse, pulse_table

FINE_STEP = 1 / 8  # bins between the arrivals of an estimator's fine grid; a parabola does the rest
FINEST_STEP = FINE_STEP / 8  # the same around the best of these, where the pulse is too narrow for a parabola there
NARROW = 0.6  # change of a bin's share a bin of arrival, over the largest share, above which it is: a rise counts, too


def _normal_cdf(x: Tensor) -> Tensor:
    """Compute Phi(x) by erfc: torch.special.ndtr goes by 1 + erf, which has no digit left from -8.3 on."""
    return 0.5 * torch.special.erfc(x * -math.sqrt(0.5))


def _decayed(pulse: Pulse, x: Tensor) -> Tensor:
    """Compute E(x) = exp(s^2 / 2 tau^2 - x / tau) Phi(x / s - s / tau), tau times the density of a pulse with a tail.

    Left of the point where Phi's argument is 0 by erfcx, whose factor exp(-x^2 / 2 s^2) cannot overflow.
    """
    s, tau = pulse.sigma_s, pulse.tail_s
    z = x / s - s / tau
    left = 0.5 * torch.special.erfcx(-z.clamp(max=0) * math.sqrt(0.5)) * torch.exp(-0.5 * (x / s) ** 2)
    right = _normal_cdf(z) * torch.exp((s**2 / (2 * tau**2) - x / tau).clamp(max=0))
    return torch.where(z < 0, left, right)


def _steps_of(pulse: SampledPulse, t: Tensor) -> tuple[tuple[Tensor, ...], Tensor, Tensor, Tensor]:
    """Find the step of a pulse table that t is in: the table on t's device, the step, how far into it t is (0 to 1),
    and whether t is in any."""
    table = pulse_table(pulse)
    columns = tuple(torch.from_numpy(column).to(t.device) for column in table)
    position = (t.double() - float(table.edges_s[0])) / pulse.sample_s
    step = position.floor().clamp(0, len(table.mass) - 1)
    inside = (position >= 0) & (position < len(table.mass))
    return columns, step.long(), (position - step).clamp(0, 1), inside


def pulse_density(pulse: AnyPulse, t: Tensor) -> Tensor:
    """Return f(t) [1/s], any shape: phi(t / s) / s; E(x) / tau; a step's share over its length."""
    t = t.double()
    if isinstance(pulse, SampledPulse):
        columns, step, _, inside = _steps_of(pulse, t)
        return columns[1][step] / pulse.sample_s * inside
    if pulse.tail_s:
        return _decayed(pulse, t + pulse.tail_s) / pulse.tail_s
    x = t / pulse.sigma_s
    return torch.exp(-0.5 * x * x) / (pulse.sigma_s * math.sqrt(2 * math.pi))


def pulse_cdf(pulse: AnyPulse, t: Tensor) -> Tensor:
    """Return F(t), the share of the pulse that has arrived by t, any shape: Phi(t / s); Phi(x / s) - E(x); linear in
    steps."""
    t = t.double()
    if isinstance(pulse, SampledPulse):
        (_, fraction, arrived, _), step, part, _ = _steps_of(pulse, t)
        return arrived[step] + fraction[step] * part
    if pulse.tail_s:
        x = t + pulse.tail_s
        return (_normal_cdf(x / pulse.sigma_s) - _decayed(pulse, x)).clamp(0, 1)
    return _normal_cdf(t / pulse.sigma_s)


def pulse_cdf_integral(pulse: AnyPulse, t: Tensor) -> Tensor:
    """Return H(t) = integral of F from -infinity to t [s], any shape; never negative, and t itself far after the pulse.

    Gaussian: t Phi(t / s) + s phi(t / s). With a tail: that at x, minus tau F. Steps: quadratic in each.
    """
    t = t.double()
    if isinstance(pulse, SampledPulse):
        (_, fraction, arrived, integral), step, part, _ = _steps_of(pulse, t)
        within = integral[step] + pulse.sample_s * (arrived[step] * part + fraction[step] * part**2 / 2)
        return torch.where(t >= float(pulse_table(pulse).edges_s[-1]), t, within)
    gaussian = _gaussian_cdf_integral(pulse.sigma_s, t + pulse.tail_s)
    return (gaussian - pulse.tail_s * pulse_cdf(pulse, t)).clamp(min=0) if pulse.tail_s else gaussian


def _gaussian_cdf_integral(sigma_s: float, t: Tensor) -> Tensor:
    """Integrate the Gaussian's distribution function up to t.

    The two terms cancel where t is very negative, so the tail is written with Mills' ratio M(a) = Phi(-a) / phi(a):
    H(-a s) = s phi(a) (1 - a M(a)); and H(t) = t + H(-t) takes it to positive t, where it tends to t.
    """
    x = t / sigma_s
    a = x.abs()
    mills = math.sqrt(math.pi / 2) * torch.special.erfcx(a / math.sqrt(2))
    density = torch.exp(-0.5 * a * a) / math.sqrt(2 * math.pi)
    # Clamped: from a = 1e7 on, a M(a) = 1 to the last bit and may round above it.
    return sigma_s * (x.clamp(min=0) + density * (1 - a * mills).clamp(min=0))


def pulse_mass(pulse: AnyPulse, centre: Tensor, width_s: float) -> Tensor:
    """Return F(centre + width/2) - F(centre - width/2), the pulse's share in an interval; any shape, >= 0.

    A Gaussian, which is even, is taken on the left flank for either sign: the right tail is then a difference of
    small numbers and not of numbers near one, so that it keeps its digits and a logarithm of it is sound.
    """
    centre = centre.double()
    if isinstance(pulse, Pulse) and not pulse.tail_s:
        centre = -centre.abs()
    return (pulse_cdf(pulse, centre + width_s / 2) - pulse_cdf(pulse, centre - width_s / 2)).clamp(min=0)


def pulse_mass_slope(pulse: AnyPulse, centre: Tensor, width_s: float) -> Tensor:
    """Return d/d tau of `pulse_mass` for an arrival at tau, centre = bin centre - tau: f(start) - f(stop) [1/s]."""
    centre = centre.double()
    return pulse_density(pulse, centre - width_s / 2) - pulse_density(pulse, centre + width_s / 2)


def wraps(sensor: Sensor) -> range:
    """Return the periods m for which a pulse m periods away still reaches a bin within half a period of its arrival."""
    reach = (max(sensor.response.window_s(REACH_SIGMAS)) + sensor.bin_width_s) / sensor.period_s
    count = max(0, math.ceil(reach - 0.5))
    return range(-count, count + 1)


def _total(parts: Iterable[Tensor]) -> Tensor:
    return functools.reduce(operator.add, parts)


def wrapped_mass(offset_s: Tensor, sensor: Sensor) -> Tensor:
    """Return share of a periodic pulse in a bin whose centre lies `offset_s` after the arrival (half a period either
    side)."""
    pulse, width, period = sensor.response, sensor.bin_width_s, sensor.period_s
    return _total(pulse_mass(pulse, offset_s + m * period, width) for m in wraps(sensor))


def bin_offsets(arrival_s: Tensor, sensor: Sensor) -> Tensor:
    """Return bin centre minus arrival, (...,) -> (..., T) [s], folded into half a period (and a bin) either side.

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
    """Return h_i(tau): expected counts per bin of one detection that arrives at `arrival_s`, (...,) -> (..., T)
    float64.

    h_i(tau) = sum over m of F(t_(i+1) - tau - m P) - F(t_i - tau - m P), t_i = i bin widths, P the period. Sums to one
    over a period; a sensor whose bins do not cover the period loses what falls outside them.
    """
    return wrapped_mass(bin_offsets(arrival_s, sensor), sensor)


def binned_pulse_slope(arrival_s: Tensor, sensor: Sensor) -> Tensor:
    """Return d h_i / d tau [1/s], (...,) -> (..., T) float64: the exact derivative of `binned_pulse`."""
    pulse, width, period = sensor.response, sensor.bin_width_s, sensor.period_s
    offsets = bin_offsets(arrival_s, sensor)
    return _total(pulse_mass_slope(pulse, offsets + m * period, width) for m in wraps(sensor))


class Taps(NamedTuple):
    """The pulse on the L bins around an arrival, for one sensor."""

    shifts: Tensor  # (L,) int64, bins after the arrival's bin
    steps: Tensor  # (G,) float64, arrival after the centre of its bin, in bins, -1 to 1
    fine: Tensor  # (G, L) float64, h of bin `shifts` for an arrival at `steps`
    coarse: slice  # the taps that the search over all bins uses
    window: Tensor  # (L,) bool, the taps that split signal from background
    finest: Tensor | None  # (G', L) float64, of a narrow pulse or rise: h in FINEST_STEPs from -1 - FINE_STEP bins on

    @property
    def centred(self) -> Tensor:
        """Return h for an arrival in the centre of its bin, (L,)."""
        return self.fine[len(self.steps) // 2]


@lru_cache(maxsize=16)
def pulse_taps(sensor: Sensor, device: str) -> Taps:
    """Return the taps of a sensor, computed once a device."""
    period = sensor.bins_per_period

    def shifts_within(sigmas: float, margin_bins: float) -> tuple[int, int]:
        # No bin twice: a pulse as wide as the period has as many taps as the period has bins.
        before, after = (math.ceil(t / sensor.bin_width_s + margin_bins) for t in sensor.response.window_s(sigmas))
        below = min(before, (period - 1) // 2)
        return below, min(after, period - 1 - below)

    # 6 sigma hold all but 2e-9; a bin more, since the fine grid moves the pulse by up to one. The search over all
    # bins needs fewer: beyond 4 sigma lies information only where counts are so many that the peak is beyond doubt.
    below, above = shifts_within(6, 1.5)
    near_below, near_above = shifts_within(4, 0.5)
    window = [max(0, round(min(t / sensor.bin_width_s, period / 4))) for t in sensor.response.window_s(2)]
    shifts = torch.arange(-below, above + 1, device=device)
    count = round(1 / FINE_STEP)
    steps = torch.arange(-count, count + 1, dtype=torch.float64, device=device) * FINE_STEP

    def moved(by: Tensor) -> Tensor:
        offsets = torch.remainder(shifts - by.unsqueeze(-1) + period / 2, period) - period / 2
        return wrapped_mass(offsets * sensor.bin_width_s, sensor)

    fine = moved(steps)
    ends = round((1 + FINE_STEP) / FINEST_STEP)
    finest = torch.arange(-ends, ends + 1, dtype=torch.float64, device=device) * FINEST_STEP
    return Taps(
        shifts=shifts,
        steps=steps,
        fine=fine,
        coarse=slice(below - near_below, below + near_above + 1),
        window=(shifts >= -window[0]) & (shifts <= window[1]),
        finest=moved(finest) if float(fine.diff(dim=0).abs().max() / fine.max()) > NARROW * FINE_STEP else None,
    )
