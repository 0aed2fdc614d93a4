"""Pulses: what one detection looks like in time. Gaussian, with an exponential tail, or measured. Needs no torch.

Every pulse has unit area and is centred: its centroid is the arrival time, t = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scenes.constants import REFERENCE_PULSE_SIGMA_S
from scenes.errors import InputError, normalise_fields, require, require_number
from scenes.files import read_array
from scenes.json_types import JsonObject
from spad.sensor.normal import erfc, erfcx_far, ndtr

MAX_SAMPLES = 1 << 16
FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))  # of a Gaussian
# Steps of a table that stands for two kernels in one, per standard deviation of the narrower. Both kernels and the
# table are of steps: these widen the pulse's variance by 3 / (12 * 16^2) of that one's, 0.1 %.
_STEPS_PER_STD = 16
# Half the window outside which float64 sees nothing of a Gaussian: 1 - erf(8.5 / sqrt 2) = 1.9e-17.
REACH_SIGMAS = 8.5


@dataclass(frozen=True)
class Pulse:
    """A Gaussian, or with `tail_s` a Gaussian convolved with an exponential decay (exponentially modified Gaussian).

    sigma_s   standard deviation of the Gaussian; its FWHM is 2 sqrt(2 ln 2) sigma
    tail_s    time constant of the decay, as of the carriers that diffuse into a SPAD's junction; 0 for none

    Raises InputError for times out of range.

    Examples
    --------
    68.3 % of a Gaussian are within one standard deviation, and its full width at half maximum is 2.355 of them:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> pulse = s2s.Pulse(sigma_s=100e-12)
    >>> pulse.bin_masses(np.array([-100e-12, 100e-12])).round(3).tolist()
    [0.683]
    >>> round(pulse.fwhm_s * 1e12, 1)  # ps
    235.5
    """

    sigma_s: float = REFERENCE_PULSE_SIGMA_S
    tail_s: float = 0.0

    def __post_init__(self) -> None:
        normalise_fields(self, "pulse")
        good = math.isfinite(self.sigma_s) and 0 < self.sigma_s < 1e-3
        require(good, f"pulse sigma {self.sigma_s:g} s is outside (0, 1e-3)")
        good = math.isfinite(self.tail_s) and 0 <= self.tail_s < 1e-3
        require(good, f"pulse tail {self.tail_s:g} s is outside [0, 1e-3)")

    @property
    def fwhm_s(self) -> float:
        """Return the full width at half maximum of the Gaussian part [s]."""
        return FWHM_PER_SIGMA * self.sigma_s

    @property
    def reach_s(self) -> float:
        """Return half the window [s] outside which the pulse holds less than 1e-11 of its area."""
        return max(self.window_s(7))

    @property
    def std_s(self) -> float:
        """Return the standard deviation of the whole pulse [s]."""
        return math.hypot(self.sigma_s, self.tail_s)

    def window_s(self, sigmas: float) -> tuple[float, float]:
        """Return time [s] before and after the centroid outside which lies about what a Gaussian has beyond so many
        `sigmas`, a number of standard deviations."""
        decay = self.tail_s * sigmas**2 / 2  # exp(-sigmas^2 / 2) is left
        return sigmas * self.sigma_s + self.tail_s, sigmas * self.sigma_s + decay

    def draw(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw delays of `size` detections after their arrival [s], (size,) float32: 1e-7 of the pulse's width is
        enough."""
        delay = rng.standard_normal(size, dtype=np.float32) * np.float32(self.sigma_s)
        if self.tail_s:
            delay += (rng.standard_exponential(size, dtype=np.float32) - 1) * np.float32(self.tail_s)
        return delay

    def bin_masses(self, edges_s: np.ndarray) -> np.ndarray:
        """Return share of the pulse between neighbouring edges: (n + 1,) -> (n,) float64."""
        x = edges_s + self.tail_s
        arrived = ndtr(x / self.sigma_s)
        if self.tail_s:
            arrived = arrived - _decayed(x, self.sigma_s, self.tail_s)
        return np.clip(np.diff(arrived), 0, None)


def _decayed(x: np.ndarray, sigma: float, tail: float) -> np.ndarray:
    """Compute exp(s^2 / 2 tau^2 - x / tau) Phi(x / s - s / tau), tau times the density of a pulse with a tail.

    Where the exponential may overflow, Phi is as small as that is large: their product is written with
    erfcx(a) = exp(a^2) erfc(a), whose factor exp(-x^2 / 2 s^2) cannot. There a is above sqrt(500).
    """
    exponent = sigma**2 / (2 * tail**2) - x / tail
    below = (sigma / tail - x / sigma) / math.sqrt(2)
    near = np.exp(np.minimum(exponent, 500)) * (0.5 * erfc(below))
    far = 0.5 * erfcx_far(np.maximum(below, math.sqrt(500))) * np.exp(-0.5 * (x / sigma) ** 2)
    return np.where(exponent < 500, near, far)


@dataclass(frozen=True)
class SampledPulse:
    """A measured pulse: `samples` counts (any scale) in steps of `sample_s`, uniform within each step.

    Its own rate is kept: bins of any width integrate it exactly.
    """

    samples: tuple[float, ...]
    sample_s: float

    def __post_init__(self) -> None:
        normalise_fields(self, "measured pulse")
        kind = isinstance(self.samples, tuple | list) or (
            isinstance(self.samples, np.ndarray) and self.samples.ndim == 1
        )
        require(kind, f"measured pulse: samples {self.samples!r}, expected a list of numbers")
        for at, value in enumerate(self.samples):
            if type(value) is not float:  # a table has some ten thousand
                require_number(value, f"measured pulse: samples[{at}]")
        object.__setattr__(self, "samples", tuple(float(value) for value in self.samples))
        count = len(self.samples)
        require(1 <= count <= MAX_SAMPLES, f"measured pulse: {count} samples, expected 1 to {MAX_SAMPLES}")
        good = all(value >= 0 for value in self.samples) and 0 < sum(self.samples) < math.inf
        require(good, "measured pulse: samples must be finite, 0 or more, and not all 0")
        good = math.isfinite(self.sample_s) and 0 < self.sample_s < 1e-3
        require(good, f"measured pulse: sample step {self.sample_s:g} s is outside (0, 1e-3)")
        object.__setattr__(self, "_hash", hash((self.samples, self.sample_s)))

    def __hash__(self) -> int:  # computed once: a sensor is looked up in a cache by every estimator
        return int(self.__dict__["_hash"])

    @property
    def reach_s(self) -> float:
        """Return half the window [s] outside which the pulse is zero."""
        return max(self.window_s(math.inf))

    @property
    def std_s(self) -> float:
        table = pulse_table(self)
        centres = (table.edges_s[1:] + table.edges_s[:-1]) / 2
        return math.sqrt(float(table.mass @ centres**2) + self.sample_s**2 / 12)

    def window_s(self, sigmas: float) -> tuple[float, float]:
        """Return time before and after the centroid outside which lies at most what a Gaussian has beyond `sigmas`."""
        table = pulse_table(self)
        outside = float(ndtr(-sigmas))
        first = int(np.searchsorted(table.arrived, outside, side="right")) - 1
        last = int(np.searchsorted(table.arrived, 1 - outside, side="left"))
        return max(0.0, -float(table.edges_s[first])), max(0.0, float(table.edges_s[min(last, len(self.samples))]))

    def draw(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw delays of `size` detections after their arrival [s], (size,) float32, by the inverse of the CDF."""
        table = pulse_table(self)
        return np.interp(rng.random(size), table.arrived, table.edges_s).astype(np.float32)

    def bin_masses(self, edges_s: np.ndarray) -> np.ndarray:
        """Return share of the pulse between neighbouring edges: (n + 1,) -> (n,) float64."""
        table = pulse_table(self)
        return np.diff(np.interp(edges_s, table.edges_s, table.arrived))


AnyPulse = Pulse | SampledPulse


class PulseTable(NamedTuple):
    """A measured pulse centred and integrated: n steps between n + 1 edges."""

    edges_s: np.ndarray  # (n + 1,) after the centroid
    mass: np.ndarray  # (n,) of each step, sums to 1
    arrived: np.ndarray  # (n + 1,) CDF at the edges, 0 to 1
    integral_s: np.ndarray  # (n + 1,) the CDF's integral up to the edges


@lru_cache(maxsize=64)
def pulse_table(pulse: SampledPulse) -> PulseTable:
    """Return centred edges, shares, CDF (linear within a step) and its integral (quadratic within a step)."""
    mass = np.asarray(pulse.samples)
    mass = mass / mass.sum()
    centroid = float(mass @ (np.arange(len(mass)) + 0.5))
    edges = (np.arange(len(mass) + 1) - centroid) * pulse.sample_s
    arrived = np.concatenate(([0.0], np.cumsum(mass)))
    arrived /= arrived[-1]
    steps = (arrived[1:] + arrived[:-1]) / 2 * pulse.sample_s
    return PulseTable(edges, mass, arrived, np.concatenate(([0.0], np.cumsum(steps))))


@lru_cache(maxsize=64)
def convolved(pulse: AnyPulse, kernel: AnyPulse | None) -> AnyPulse:
    """Return the pulse blurred by a second kernel (timing jitter): exactly where both are Gaussian or one has a tail.

    Otherwise as a table in steps of a sixteenth of the narrower one's standard deviation. Raises InputError where
    that takes more than 65,536 steps.
    """
    if kernel is None:
        return pulse
    if isinstance(pulse, Pulse) and isinstance(kernel, Pulse) and not (pulse.tail_s and kernel.tail_s):
        return Pulse(math.hypot(pulse.sigma_s, kernel.sigma_s), pulse.tail_s + kernel.tail_s)
    step = min(pulse.std_s, kernel.std_s) / _STEPS_PER_STD
    tables = []
    for part in (pulse, kernel):
        before, after = part.window_s(REACH_SIGMAS)
        count = math.ceil(before / step) + math.ceil(after / step)
        message = (
            f"pulse and jitter of {pulse.std_s:g} s and {kernel.std_s:g} s differ too much in width: the wider takes "
        )
        require(count <= MAX_SAMPLES, f"{message}{count} steps of {step:.3g} s, the limit is {MAX_SAMPLES}")
        tables.append(part.bin_masses((np.arange(count + 1) - math.ceil(before / step)) * step))
    both = np.convolve(tables[0], tables[1])
    require(len(both) <= MAX_SAMPLES, f"pulse and jitter together take {len(both)} steps of {step:g} s")
    return SampledPulse(tuple(np.clip(both, 0, None).tolist()), step)


def pulse_from_dict(values: JsonObject | None) -> AnyPulse | None:
    """Return the pulse that `dataclasses.asdict` made. Raises InputError for anything else."""
    if values is None:
        return None
    try:
        return SampledPulse(**values) if "samples" in values else Pulse(**values)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{' '.join(repr(values).split())[:60]} is no pulse ({error})") from None


def read_pulse(path: Path, sample_s: float) -> SampledPulse:
    """Return a measured pulse from a .npy file of samples, one dimension, in steps of `sample_s`. InputError in one
    line.

    A peak in the first or last hundredth of the samples means that they were recorded around a laser period: they are
    rolled until their circular centroid is in the middle.

    Examples
    --------
    Samples of any scale become shares; the centroid is at time 0:

    >>> import tempfile
    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(folder + "/laser.npy", [0, 100, 200, 100, 0])
    ...     pulse = s2s.read_pulse(folder + "/laser.npy", sample_s=50e-12)
    >>> pulse.bin_masses(np.array([-75e-12, -25e-12, 25e-12, 75e-12])).round(6).tolist()
    [0.25, 0.5, 0.25]
    """
    sample_s = require_number(sample_s, f"{path}: sample_s")
    path = Path(path)
    samples = read_array(path)
    good = samples.ndim == 1 and samples.dtype.kind in "fiu"
    require(good, f"{path}: {samples.dtype}{samples.shape}, expected one dimension of numbers")
    samples = samples.astype(np.float64)
    require(bool(np.isfinite(samples).all()), f"{path}: measured pulse: samples must be finite")
    if len(samples) and not 0.01 <= samples.argmax() / len(samples) < 0.99:
        turn = np.exp(2j * np.pi * np.arange(len(samples)) / len(samples))
        centroid = np.angle(samples @ turn) / (2 * np.pi) * len(samples)
        samples = np.roll(samples, len(samples) // 2 - round(float(centroid)))
    try:
        return SampledPulse(tuple(samples.tolist()), sample_s)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
