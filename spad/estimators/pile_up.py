"""Undo what a detector that is blind for a while makes of its primary detections: the inverses of `detection.laws`."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from scenes.errors import InputError, require_choice
from spad.detection.detectors import LAWS
from spad.detection.laws import LOW_FLUX
from spad.sensor.model import Sensor

log = logging.getLogger(__name__)
# A pixel may end an exposure blind, half a dead time on average: a tenth of the live time of one that was live for 5.
SATURATED_DEAD_TIMES = 5.0


def coates(counts: Tensor, cycles: float) -> Tensor:
    """Return flux per cycle from a synchronous detector's counts (Coates 1968), the maximum-likelihood estimate:

    mu_k = ln[(N - sum_(j<k) n_j) / (N - sum_(j<=k) n_j)], (..., T) -> (..., T) float64. Where no cycle is left after
    bin k, its count is taken half a count lower; where none is left before, nothing is known and mu_k is 0. Raises
    InputError for more counts than cycles.
    """
    arrived = counts.double().cumsum(-1)
    if arrived.numel() and float(arrived[..., -1].max()) > cycles * (1 + 1e-9) + 0.5:
        raise InputError(
            f"a pixel has {float(arrived[..., -1].max()):g} detections in {cycles:g} cycles: "
            "not a synchronous detector's histogram of first photons"
        )
    after = cycles - arrived
    before = after + counts.double()
    return torch.where(before > 0.5, torch.log(before.clamp(min=0.5) / after.clamp(min=0.5)), 0.0).clamp(min=0)


def free_running_flux(counts: Tensor, cycles: float, sensor: Sensor) -> Tensor:
    """Return flux per cycle from a free-running detector's counts: each bin's count over the cycles that were live in
    it.

    In the steady state the detector is blind in bin k of those cycles in which it detected something less than a dead
    time earlier: blind_k = sum_j a_j n_(k-j) over the bins of one dead time before, whole periods of it counting
    every detection (Rapp 2019). mu_k = -ln(1 - n_k / (N - blind_k)) where the dead time is longer than a bin, as only
    one detection a cycle fits; n_k / (N - blind_k) below. (..., T) -> (..., T) float64. A sensor whose bins do not
    cover its period is refused by InputError.

    Detections are taken for even within their bins. That holds for low flux: even light of r photons a bin and cycle is
    found as 2 atanh(r / 2) behind any dead time from a bin on, 0.1 % high at a tenth and 2.2 % at a half. Uneven bins
    are up to 3 % off there. It does not hold for strong light that is uneven within a bin: of two photons a cycle in a
    pulse of 0.1 to 0.3 bins (sigma) half may be missing after a dead time below 2 bins. After one of 20 bins the pulse
    is right within 2 %. A dead time within 2 bins of whole periods ends within the pulse of a later cycle: there 0.6
    to 4.2 times that strong light is found.
    """
    if sensor.bins != sensor.bins_per_period:
        raise InputError(f"sensor {sensor.name}: the dead-time correction needs bins that cover the period")
    counts = counts.double()
    dead = sensor.dead_time_s / sensor.bin_width_s
    if dead == 0:
        return counts / cycles
    # A detection is at a uniform place in its bin, and so is the photon: the share of pairs at a distance under the
    # dead time is the integral of a triangle. It is 1 up to `whole`, of which each period holds one of every bin: a
    # dead time of many periods takes no more memory than a short one. Bin k itself is the logarithm's part.
    whole = max(int(dead - 1), 0)
    bins = torch.arange(sensor.bins, device=counts.device)
    kernel = ((whole - bins) // sensor.bins + (bins > 0)).double()
    for distance in range(whole + 1, int(dead) + 2):
        near = dead - distance
        kernel[distance % sensor.bins] += 1 - (1 - near) ** 2 / 2 if near >= 0 else (1 + near) ** 2 / 2
    if dead < 1:
        kernel[0] += dead - dead**2 / 2
    spectrum = torch.fft.rfft(counts) * torch.fft.rfft(kernel)
    blind = torch.fft.irfft(spectrum, n=sensor.bins)
    live = (cycles - blind).clamp(min=0.5)
    ratio = counts / live
    if dead < 1:
        return ratio
    return -torch.log1p(-ratio.clamp(max=1 - 0.5 / cycles))


def warn_of_saturation(counts: Tensor, sensor: Sensor, law: str | None = None) -> None:
    """Log a warning where a free-running detector's pixels were live for less than 5 dead times in all, counts
    (..., T); `law` as in `without_pile_up`.

    The flux is detections over the live time, which is the exposure less a dead time a detection. Near saturation it is
    a small difference of large numbers: the blind part at the exposure's end alone makes 10 % of it.
    """
    if _law(sensor, law) != "free-running" or sensor.dead_time_s == 0:
        return
    detections = counts.double().sum(-1)
    live = sensor.exposure_s / sensor.dead_time_s - detections
    saturated = int(((live < SATURATED_DEAD_TIMES) & ~_too_few(detections, sensor)).sum())
    if saturated:
        log.warning(
            "pile-up: %d of %d pixels are saturated, live for less than %g dead times of the exposure: their counts "
            "without pile-up are more than 10 %% off, and may be many times too many",
            *(saturated, detections.numel(), SATURATED_DEAD_TIMES),
        )


def _law(sensor: Sensor, law: str | None) -> str:
    if law is not None:
        require_choice(law, LAWS, "detection law")
        return law
    return "first-photon" if sensor.armed_every_cycle else "free-running"


def _too_few(detections: Tensor, sensor: Sensor) -> Tensor:
    """Tell where pile-up changes nothing that counts could show."""
    return detections * max(1.0, sensor.dead_time_s / sensor.period_s) <= LOW_FLUX * sensor.cycles


def without_pile_up(counts: Tensor, sensor: Sensor, law: str | None = None) -> Tensor:
    """Return counts as they would be without pile-up, (..., T) float64: `coates`, or `free_running_flux`, times the
    cycles.

    `law` is the detection law that made the counts, a name in `spad.detection.detectors.LAWS`; `poisson` loses none.
    None stands for the law of the sensor's detector: first-photon where it is armed at every cycle, else free-running.
    A synchronous detector whose dead time is longer than the period is not armed at every cycle.

    Pixels with at most 1 % detections per cycle (or dead time, if longer) keep their counts: what would change is a
    hundredth of one, which does nothing but decide between equal maxima. Saturated pixels are told by
    `warn_of_saturation`. Raises InputError for an unknown law, and counts that it cannot have made.

    The law is undone as if timestamps had no jitter. What jitter moved to before the first arrival then takes from what
    follows: with a jitter of 85 ps (sigma) and a pulse of 42 ps a depth is 2 mm too large at one photon a cycle.
    """
    counts, law = counts.double(), _law(sensor, law)
    if law == "poisson":
        return counts
    if law == "first-photon":
        corrected = coates(counts, sensor.whole_cycles) * sensor.whole_cycles
    else:
        corrected = free_running_flux(counts, sensor.whole_cycles, sensor) * sensor.whole_cycles
    return torch.where(_too_few(counts.sum(-1, keepdim=True), sensor), counts, corrected)
