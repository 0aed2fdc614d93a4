"""Define the single-photon camera, `Sensor`, and the `PhotonBudget` it is used at. Needs no torch."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from functools import reduce
from numbers import Real
from typing import Literal, get_args

import numpy as np

from scenes.constants import MAX_PHOTONS, REFERENCE_BINS, REFERENCE_PERIOD_S, SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError, require, require_choice, require_number, require_whole
from scenes.json_types import JsonObject
from scenes.random_streams import Stream
from spad.sensor.presets import LINOSPAD_FWHM_S, TRAIN_BIN_WIDTH_S, TRAIN_DARK_COUNTS, TRAIN_PULSE
from spad.sensor.pulse import FWHM_PER_SIGMA, AnyPulse, Pulse, SampledPulse, convolved, pulse_from_dict
from spad.sensor.tdc import Tdc

Reset = Literal["synchronous", "free-running"]
HOT_RATE_HZ = 1e4  # of hot pixels in a sensor file that gives their share alone, as with `sense --hot-pixels`
MAX_CYCLES = 1e15  # of an exposure, three years at 10 MHz: every whole number up to there is a float64
MAX_RATE_HZ = 1e12  # of dark counts: one a picosecond, far above any device; sums over pixels stay finite
NUMBERS = (  # fields of a sensor that are one number each
    *("bin_width_s", "period_s", "exposure_s", "pde", "hot_share", "hot_rate_hz", "dead_share", "dead_time_s"),
    "crosstalk",
)


@dataclass(frozen=True)
class Sensor:
    """A SPAD pixel array with one time-to-digital converter a pixel. With its defaults a perfect photon counter.

    bins, bin_width_s     the histogram: bin i covers [i, i+1) bin widths after the laser's emission
    pulse, jitter         the laser's pulse and the detector's timing jitter, a second kernel; `response` is both
    period_s              laser period, a whole number of bin widths (None: the histogram covers it); time wraps at it
    exposure_s            exposure of one frame; cycles = exposure / period, of which the nearest whole number is drawn
    pde                   photon detection efficiency at the laser's wavelength, fill factor included; radiometric
                          budgets count with it
    dark_count_rate_hz    dark counts per second and pixel, uniform in time: a number, or one for each image row, used
                          again from the first where the image has more rows
    hot_share, hot_rate_hz   share of pixels, drawn at random, that have this dark count rate instead, above 0
    dead_share            share of pixels, drawn at random, that never detect anything
    reset                 what the detector does after a detection. `synchronous`: it is armed at the start of every
                          laser cycle and detects the first photon; `free-running`: it is armed again after dead_time_s
    dead_time_s           dead time after a detection, not prolonged by photons that arrive in it
    crosstalk             probability that a detection fires a given one of the four neighbours, at the same time
    tdc                   converters whose codes are not equally wide (`Tdc`); None: every bin is as wide as the others

    Raises InputError for values out of range or of another kind, naming the sensor.

    Examples
    --------
    Light goes 1 m there and back in 6.67 ns, so that 1000 bins of 100 ps reach 15 m:

    >>> import scene2spad as s2s
    >>> sensor = s2s.Sensor(name="mine", bins=1000, bin_width_s=100e-12, exposure_s=1e-3, pulse=s2s.Pulse(150e-12))
    >>> round(sensor.range_m, 2), round(1e3 * sensor.bin_depth_m)  # m, mm
    (14.99, 15)
    >>> round(sensor.cycles)  # of the laser in one exposure: 1 ms / 100 ns
    10000
    """

    name: str = "reference"
    bins: int = REFERENCE_BINS
    bin_width_s: float = REFERENCE_PERIOD_S / REFERENCE_BINS
    pulse: AnyPulse = field(default_factory=Pulse)
    period_s: float = None  # type: ignore[assignment]  # None becomes bins x bin_width_s
    exposure_s: float = 1 / 30
    dark_count_rate_hz: float | tuple[float, ...] = 0.0
    jitter: AnyPulse | None = None
    pde: float = 1.0
    hot_share: float = 0.0
    hot_rate_hz: float = 0.0
    dead_share: float = 0.0
    reset: Reset = "synchronous"
    dead_time_s: float = 0.0
    crosstalk: float = 0.0
    tdc: Tdc | None = None

    def __post_init__(self) -> None:
        require(isinstance(self.name, str), f"sensor: name {self.name!r}, expected text")
        where = f"sensor {self.name}"
        self._normalise(where)
        require(1 <= self.bins <= 65536, f"{where}: {self.bins} bins is outside 1 to 65536")
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
            f"{where}: exposure {self.exposure_s:g} s is not finite or shorter than the period {self.period_s:g} s",
        )
        long = f"{where}: exposure {self.exposure_s:g} s is {self.cycles:.3g} periods of {self.period_s:g} s"
        require(self.cycles <= MAX_CYCLES, f"{long}, the limit is {MAX_CYCLES:g}")
        self._check_detector(where)

    def _normalise(self, where: str) -> None:
        """Make numbers Python's own, as files hold them. Raises InputError for what is no number."""
        object.__setattr__(self, "bins", require_whole(self.bins, f"{where}: bins"))
        for label in NUMBERS:
            value = getattr(self, label)
            if value is not None or label != "period_s":
                object.__setattr__(self, label, require_number(value, f"{where}: {label}"))
        rate = self.dark_count_rate_hz
        if isinstance(rate, tuple | list | np.ndarray) and np.ndim(rate) == 1:
            rows = tuple(float(require_number(row, f"{where}: dark_count_rate_hz of a row")) for row in rate)
            require(len(rows) > 0, f"{where}: dark count rates of no row")
            object.__setattr__(self, "dark_count_rate_hz", rows)
        else:
            what = f"{where}: dark_count_rate_hz"
            good = isinstance(rate, Real) and not isinstance(rate, bool)
            require(good, f"{what} {rate!r}, expected a number, or one for each image row")
            object.__setattr__(self, "dark_count_rate_hz", require_number(rate, what))

    def _check_detector(self, where: str) -> None:
        kinds = (Pulse, SampledPulse)
        require(isinstance(self.pulse, kinds), f"{where}: {self.pulse!r} is no pulse")
        require(self.jitter is None or isinstance(self.jitter, kinds), f"{where}: jitter {self.jitter!r} is no pulse")
        for rate in (*self._dark_rows, self.hot_rate_hz):
            require(0 <= rate <= MAX_RATE_HZ, f"{where}: dark count rate {rate:g} Hz is outside 0 to {MAX_RATE_HZ:g}")
        for label in ("hot_share", "dead_share"):
            fraction = getattr(self, label)
            require(0 <= fraction <= 1, f"{where}: {label} {fraction:g} is outside 0 to 1")
        dark = f"{where}: hot_rate_hz 0 with hot_share {self.hot_share:g}: hot pixels would be dark"
        require(self.hot_rate_hz > 0 or not self.hot_share, f"{dark}, expected a rate above 0, such as {HOT_RATE_HZ:g}")
        require(0 < self.pde <= 1, f"{where}: PDE {self.pde:g} is outside (0, 1]")
        require(0 <= self.crosstalk < 0.25, f"{where}: crosstalk {self.crosstalk:g} is outside [0, 0.25)")
        require_choice(self.reset, get_args(Reset), f"{where}: reset")
        dead = self.dead_time_s
        require(math.isfinite(dead) and 0 <= dead <= 1, f"{where}: dead time {dead:g} s is outside 0 to 1")
        self._check_tdc(where)

    def _check_tdc(self, where: str) -> None:
        if self.tdc is None:
            return
        require(isinstance(self.tdc, Tdc), f"{where}: tdc {self.tdc!r} is no Tdc")
        period, bins = self.bins_per_period, self.bins
        require(bins == period, f"{where}: a tdc needs bins that cover the period, there are {bins} of {period}")
        if not self.tdc.is_at_hand:
            return
        try:
            self.tdc.edges(bins, self.bin_width_s)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None

    @property
    def _dark_rows(self) -> tuple[float, ...]:
        rate = self.dark_count_rate_hz
        return rate if isinstance(rate, tuple) else (rate,)

    @property
    def jitters(self) -> tuple[AnyPulse, ...]:
        """Return what delays the timestamp of a photon that was detected: the detector's jitter, the clock's."""
        clock = None if self.tdc is None or self.tdc.jitter_s == 0 else Pulse(self.tdc.jitter_s)
        return tuple(kernel for kernel in (self.jitter, clock) if kernel is not None)

    @property
    def kernels(self) -> tuple[AnyPulse, ...]:
        """Return what delays a detection, independently: the laser's pulse, and the `jitters`."""
        return (self.pulse, *self.jitters)

    @property
    def response(self) -> AnyPulse:
        """Return the kernels convolved: what one detection looks like in time."""
        return reduce(convolved, self.kernels)

    @property
    def code_edges(self) -> np.ndarray | None:
        """Return edges of the bins in true time, (converters, bins + 1) in bins as `Tdc.edges`; None for equal bins."""
        return None if self.tdc is None else self.tdc.edges(self.bins, self.bin_width_s)

    def converter_map(self, height: int, width: int, seed: int = 0) -> np.ndarray | None:
        """Return which converter each pixel has, (H, W) int64 at random by the seed: a row of `code_edges`."""
        if self.tdc is None:
            return None
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.PIXELS, 2, 0)))
        return rng.integers(len(self.tdc.ends()), size=(height, width))

    @property
    def bins_per_period(self) -> int:
        """Return the number of bins of one laser period, `bins` or more."""
        return round(self.period_s / self.bin_width_s)

    @property
    def cycles(self) -> float:
        """Return the number of laser cycles in one exposure, not rounded; `sense` draws `whole_cycles`."""
        return self.exposure_s / self.period_s

    @property
    def whole_cycles(self) -> int:
        """Return the nearest whole number of laser cycles in one exposure, which holds all of its photons."""
        return max(1, round(self.cycles))

    @property
    def armed_every_cycle(self) -> bool:
        """Tell whether the detector is armed at the start of every laser cycle: synchronous, and its dead time is not
        longer than the period."""
        return self.reset == "synchronous" and self.dead_time_s <= self.period_s

    @property
    def range_m(self) -> float:
        """Return the unambiguous depth range [m], c period / 2."""
        return SPEED_OF_LIGHT_M_PER_S * self.period_s / 2

    @property
    def recorded_range_m(self) -> float:
        """Return the depth [m] that the bins cover: `range_m`, or less where the period has a part without bins."""
        return self.range_m if self.bins == self.bins_per_period else self.bins * self.bin_depth_m

    def check_offset(self, offset_m: float) -> None:
        """Raise InputError unless scenes can be moved away by this many metres within the range."""
        inside = 0 <= offset_m < self.range_m
        require(inside, f"offset {offset_m:g} m is outside 0 to the sensor's range {self.range_m:.4f} m")

    def check_equal_bins(self, where: str) -> None:
        """Raise InputError where converters make bins unequal; `where`, what needs equal ones, comes first."""
        unequal = f"{where}: the converters (tdc) of {self.name} make bins unequal, expected equal ones"
        require(self.tdc is None, f"{unequal}; take the sensor without them")

    @property
    def bin_depth_m(self) -> float:
        """Return the depth [m] that one bin spans, c bin_width / 2."""
        return SPEED_OF_LIGHT_M_PER_S * self.bin_width_s / 2

    def dark_rate_map_hz(self, height: int, width: int, seed: int = 0) -> np.ndarray:
        """Return dark counts per second of every pixel, (H, W) float64: rows, then hot pixels at random by the seed."""
        rows = np.resize(np.asarray(self._dark_rows, dtype=np.float64), height)
        rate = np.repeat(rows[:, None], width, axis=1)
        rate[self._chosen(self.hot_share, height, width, seed, 0)] = self.hot_rate_hz
        return rate

    def dead_pixels(self, height: int, width: int, seed: int = 0) -> np.ndarray:
        """Return pixels that detect nothing, (H, W) bool, at random by the seed."""
        return self._chosen(self.dead_share, height, width, seed, 1)

    @staticmethod
    def _chosen(fraction: float, height: int, width: int, seed: int, what: int) -> np.ndarray:
        chosen = np.zeros(height * width, dtype=bool)
        if fraction > 0:
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(Stream.PIXELS, what, 0)))
            chosen[rng.choice(chosen.size, round(fraction * chosen.size), replace=False)] = True
        return chosen.reshape(height, width)

    def to_dict(self) -> JsonObject:
        """Return what `from_dict` takes, as JSON holds it; without `tdc` where there is none, for older programs."""
        values = asdict(self)
        if self.tdc is None:
            del values["tdc"]
        return values

    @classmethod
    def from_dict(cls, values: JsonObject) -> Sensor:
        """Return the sensor that `to_dict` described. Raises InputError as the class does."""
        parts = {"pulse": pulse_from_dict(values["pulse"]), "jitter": pulse_from_dict(values.get("jitter"))}
        tdc = values.get("tdc")
        return cls(**{**values, **parts, "tdc": None if tdc is None else Tdc(**tdc)})


PRESETS: dict[str, Sensor] = {
    "reference": Sensor(),
    "iccv2023-train": Sensor(
        name="iccv2023-train",
        bin_width_s=TRAIN_BIN_WIDTH_S,
        pulse=SampledPulse(TRAIN_PULSE, TRAIN_BIN_WIDTH_S),
        dark_count_rate_hz=tuple(30 * counts for counts in TRAIN_DARK_COUNTS),
    ),
    "linospad": Sensor(name="linospad", bins=1536, bin_width_s=26e-12, pulse=Pulse(LINOSPAD_FWHM_S / FWHM_PER_SIGMA)),
}


def detector_maps(
    sensor: Sensor, shape: tuple[int, int], dark_map_hz: np.ndarray | None, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return dark counts per second (H, W) and dead pixels (H, W) bool: the sensor's, or a measured map's and the
    sensor's dead pixels besides."""
    dead = sensor.dead_pixels(*shape, seed)
    if dark_map_hz is None:
        return sensor.dark_rate_map_hz(*shape, seed), dead
    measured_hz, silent = check_dark_map(dark_map_hz, shape)
    return measured_hz, dead | silent


def check_dark_map(measured_hz: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a measured map's dark counts per second (H, W), 0 in dead pixels, and which are dead (NaN).

    Raises InputError for another shape, masked rates, and rates below 0 or above `MAX_RATE_HZ`.
    """
    require(not np.ma.is_masked(measured_hz), "dark count map is masked, fill it first: NaN stands for a dead pixel")
    measured = np.asarray(measured_hz, dtype=np.float64)
    if measured.shape != shape:
        raise InputError(f"dark count map is {measured.shape}, the image {shape}")
    dead = np.isnan(measured)
    measured = np.where(dead, 0.0, measured)
    if not (measured.min(initial=0) >= 0 and measured.max(initial=0) <= MAX_RATE_HZ):
        limit = f"rates must be finite and 0 or more, at most {MAX_RATE_HZ:g} Hz, NaN for a dead pixel"
        raise InputError(f"dark count map: {limit}")
    return measured, dead


@dataclass(frozen=True)
class PhotonBudget:
    """Mean signal and mean background primary detections per pixel per exposure, averaged over all pixels.

    Primary: PDE included, dead time, pile-up and crosstalk not. Signal sums direct and indirect light, what wraps
    included. Background is dark counts, as the sensor has them, and ambient light scaled to fill the asked mean.
    Raises InputError for numbers below 0 or above 1e9.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> budget = s2s.PhotonBudget(signal=10, background=40)  # detections a pixel and exposure
    >>> budget.sbr
    0.25
    >>> s2s.sense(s2s.render("plane", width=4, height=3, bounces=1), signal=10, background=40).budget == budget
    True
    """

    signal: float = 50.0
    background: float = 50.0

    def __post_init__(self) -> None:
        for label, value in (("signal", self.signal), ("background", self.background)):
            value = require_number(value, f"photon budget: {label}")
            object.__setattr__(self, label, value)
            good = 0 <= value <= MAX_PHOTONS
            require(good, f"photon budget: {label} {value:g} photons per pixel is outside 0 to {MAX_PHOTONS:g}")

    @property
    def sbr(self) -> float:
        """Return the ratio of signal to background, infinite without background."""
        return self.signal / self.background if self.background > 0 else math.inf

    def to_dict(self) -> JsonObject:
        """Return both numbers as JSON holds them."""
        return asdict(self)
