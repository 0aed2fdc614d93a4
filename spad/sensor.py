"""What the single-photon camera is: `Sensor`, its `Pulse`, and the `PhotonBudget` it is used at. Needs no torch."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field

from scenes.constants import REFERENCE_BINS, REFERENCE_PERIOD_S, REFERENCE_PULSE_SIGMA_S, SPEED_OF_LIGHT_M_PER_S
from scenes.errors import require


@dataclass(frozen=True)
class Pulse:
    """The system's impulse response, unit area and centred: its centroid is the arrival time.

    A Gaussian of standard deviation `sigma_s` (laser pulse and timing jitter together); FWHM = 2 sqrt(2 ln 2) sigma.
    """

    sigma_s: float = REFERENCE_PULSE_SIGMA_S

    def __post_init__(self) -> None:
        good = math.isfinite(self.sigma_s) and 0 < self.sigma_s < 1e-3
        require(good, f"pulse sigma {self.sigma_s:g} s is outside (0, 1e-3)")

    @property
    def fwhm_s(self) -> float:
        return 2 * math.sqrt(2 * math.log(2)) * self.sigma_s

    @property
    def reach_s(self) -> float:
        """Half the window outside which the pulse holds less than 1e-11 of its area."""
        return 7 * self.sigma_s


@dataclass(frozen=True)
class Sensor:
    """A SPAD pixel array with one time-to-digital converter a pixel. With its defaults a perfect photon counter.

    bins, bin_width_s     the histogram: bin i covers [i, i+1) bin widths after the laser's emission
    period_s              laser period, a whole number of bin widths (None: the histogram covers it); time wraps at it
    exposure_s            exposure of one frame; cycles = exposure / period
    dark_count_rate_hz    dark counts per second and pixel, uniform in time
    """

    name: str = "reference"
    bins: int = REFERENCE_BINS
    bin_width_s: float = REFERENCE_PERIOD_S / REFERENCE_BINS
    pulse: Pulse = field(default_factory=Pulse)
    period_s: float | None = None
    exposure_s: float = 1 / 30
    dark_count_rate_hz: float = 0.0

    def __post_init__(self) -> None:
        where = f"sensor {self.name}"
        in_range = int(self.bins) == self.bins and 1 <= self.bins <= 65536
        require(in_range, f"{where}: {self.bins} bins is outside 1 to 65536")
        width = self.bin_width_s
        require(
            math.isfinite(width) and 1e-15 <= width <= 1e-3, f"{where}: bin width {width:g} s is outside 1e-15 to 1e-3"
        )
        if self.period_s is None:
            object.__setattr__(self, "period_s", self.bins * width)
        ratio = self.period_s / width
        whole = math.isfinite(ratio) and abs(ratio - round(ratio)) < 1e-6 * ratio and round(ratio) >= self.bins
        require(whole, f"{where}: period {self.period_s:g} s is not a whole number of bin widths, {self.bins} or more")
        require(
            math.isfinite(self.exposure_s) and self.exposure_s >= self.period_s,
            f"{where}: exposure {self.exposure_s:g} s is shorter than the period {self.period_s:g} s",
        )
        rate = self.dark_count_rate_hz
        require(math.isfinite(rate) and rate >= 0, f"{where}: dark count rate {rate:g} Hz is negative or not finite")

    @property
    def bins_per_period(self) -> int:
        return round(self.period_s / self.bin_width_s)

    @property
    def cycles(self) -> float:
        """Laser cycles in one exposure."""
        return self.exposure_s / self.period_s

    @property
    def range_m(self) -> float:
        """Unambiguous depth range c period / 2."""
        return SPEED_OF_LIGHT_M_PER_S * self.period_s / 2

    @property
    def bin_depth_m(self) -> float:
        """Depth that one bin spans, c bin_width / 2."""
        return SPEED_OF_LIGHT_M_PER_S * self.bin_width_s / 2

    def to_dict(self) -> dict:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> Sensor:
        return cls(**{**values, "pulse": Pulse(**values["pulse"])})


PRESETS: dict[str, Sensor] = {"reference": Sensor()}


def sensor_by_name(name: str) -> Sensor:
    """The preset of that name, or an InputError that lists the names."""
    require(name in PRESETS, f"sensor {name!r} is unknown, expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


@dataclass(frozen=True)
class PhotonBudget:
    """Mean signal and mean background primary detections per pixel per exposure, averaged over all pixels.

    Signal sums direct and indirect light, what wraps included. Background is dark counts, as the sensor has them, and
    ambient light scaled to fill the asked mean.
    """

    signal: float = 50.0
    background: float = 50.0

    def __post_init__(self) -> None:
        for label, value in (("signal", self.signal), ("background", self.background)):
            good = math.isfinite(value) and 0 <= value <= 1e9
            require(good, f"photon budget: {label} {value:g} photons per pixel is outside 0 to 1e9")

    @property
    def sbr(self) -> float:
        return self.signal / self.background if self.background > 0 else math.inf

    def to_dict(self) -> dict:
        return asdict(self)
