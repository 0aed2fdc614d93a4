"""Time-to-digital converters with unequal codes: what they make of a detection's time, and how codes are corrected.

A counter counts whole clock periods, and fine codes divide each. Codes are meant to be equally wide; real ones differ
(differential nonlinearity), some never come, and their sum drifts off the straight line (integral nonlinearity). The
sensor's bin r holds the codes whose nominal centre lies in it, or with a correction the codes whose corrected time
does. Codes rise with time, so that bin r of a converter is one interval of true time: edges say it all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from scenes.errors import did_you_mean, normalise_fields, require, require_choice
from scenes.files import read_arrays
from scenes.io.inputs import file_sha256
from scenes.random_streams import Stream

Correction = Literal["none", "line", "table"]
CORRECTIONS: tuple[str, ...] = get_args(Correction)
DRAWN = 256  # converters drawn where there is no measured table
MAX_CODES, MAX_CONVERTERS, MAX_BITS = 4096, 1 << 16, 16
_ROUNDING = 1e-9  # bins: a code centre on an edge counts as past it


@dataclass(frozen=True)
class Tdc:
    """One time-to-digital converter a pixel; pixels have converters of the table, or drawn ones, at random by the seed.

    clock_period_s   period of the clock that the fine codes divide
    table            measured codes: a table that ships (`shipped_tables`), or a .npz file with `end_ps`
                     (converters, codes), when each code ends after the clock's edge; empty: DRAWN converters are drawn
    table_sha256     of the table's file: another file of that name is refused. A sensor file's is noted as it is read
    codes            fine codes a clock period of drawn converters; 0 with a table, which has its own
    dnl              differential nonlinearity of drawn ones: standard deviation of the widths of all codes, in codes;
                     at most sqrt(codes - 1), where one code is as wide as all
    missing          fraction of the codes of drawn ones that never come
    jitter_s         standard deviation of the clock's jitter, which adds to the pulse's
    correction       of the codes before they are counted: none; a straight line a pixel; a look-up table a pixel
    correction_bits  of the table's entries, or of the line's two numbers, in fractions of the clock period
    """

    clock_period_s: float
    table: str = ""
    table_sha256: str = ""
    codes: int = 0
    dnl: float = 0.0
    missing: float = 0.0
    jitter_s: float = 0.0
    correction: Correction = "none"
    correction_bits: int = 8

    def __post_init__(self) -> None:
        normalise_fields(self, "tdc")
        period = self.clock_period_s
        require(
            math.isfinite(period) and 1e-12 <= period <= 1e-3,
            f"tdc: clock period {period:g} s is outside 1e-12 to 1e-3",
        )
        require(bool(self.table) == (self.codes == 0), "tdc: expected a table or a number of codes, and not both")
        if self.table:
            plain = self.dnl == self.missing == 0
            require(
                plain, f"tdc: table {self.table} has its own nonlinearity, dnl and missing are for drawn converters"
            )
        else:
            require(1 <= self.codes <= MAX_CODES, f"tdc: {self.codes} codes is outside 1 to {MAX_CODES}")
        require(0 <= self.missing < 1, f"tdc: missing {self.missing:g} is outside [0, 1)")
        require(math.isfinite(self.dnl) and self.dnl >= 0, f"tdc: dnl {self.dnl:g} codes is negative or not finite")
        require(0 <= self.jitter_s < 1e-3, f"tdc: jitter {self.jitter_s:g} s is outside [0, 1e-3)")
        require_choice(self.correction, CORRECTIONS, "tdc: correction")
        bits = self.correction_bits
        require(1 <= bits <= MAX_BITS, f"tdc: {bits} correction bits, expected 1 to {MAX_BITS}")
        if self.is_at_hand:
            self.ends()

    @property
    def is_at_hand(self) -> bool:
        """Tell whether the codes are known. What a sensor has recorded can be read without its table's file."""
        if not self.has_own_table:
            return True
        path = Path(self.table)
        return path.is_file() and self.table_sha256 in ("", file_sha256(path))

    @property
    def has_own_table(self) -> bool:
        """Tell whether the table is a file, and not one that ships."""
        return self.table.endswith(".npz") and self.table not in shipped_tables()

    def ends(self) -> np.ndarray:
        """Return when each code ends, in clock periods after the clock's edge: (converters, codes) float64, read only.

        Raises InputError in one line for a table that is unknown, does not fit the clock, or has changed.
        """
        if self.table:
            return measured_table(self.table, self.clock_period_s, self.table_sha256)
        return _drawn(self.codes, self.dnl, self.missing)

    def edges(self, bins: int, bin_width_s: float) -> np.ndarray:
        """Return the edges in true time of the sensor's bins, which cover one laser period, by converter: (converters,
        bins + 1) float64 in bins, read only. Raises InputError where the period is no whole number of clock periods."""
        return _edges(self, bins, bin_width_s)

    @property
    def bits_per_pixel(self) -> int:
        """Return the bits that the correction keeps in every pixel."""
        numbers = {"none": 0, "line": 2, "table": self.ends().shape[1]}[self.correction]
        return numbers * self.correction_bits


def shipped_tables() -> dict[str, Path]:
    """Return the measured tables that come with the package, by name."""
    folder = Path(str(files("spad") / "sensors" / "tdc"))
    return {path.stem: path for path in sorted(folder.glob("*.npz"))}


@lru_cache(maxsize=8)
def measured_table(table: str, clock_period_s: float, sha256: str = "") -> np.ndarray:
    """Read a measured table of code widths, shipped or a file's, as ends of codes in clock periods; kept in memory.

    Raises InputError for a file that is no such table, does not fit the clock, or has another hash than `sha256`.
    """
    shipped = shipped_tables()
    if table not in shipped:
        meant = did_you_mean(table, shipped)
        a_file = table.endswith(".npz")
        require(
            a_file, f"tdc: table {table!r} is unknown{meant}, expected a file (.npz) or one of {', '.join(shipped)}"
        )
    path = shipped.get(table, Path(table))
    held = read_arrays(path, "table of codes")
    same = sha256 in ("", file_sha256(path))
    require(same, f"{path}: is another table of codes than the sensor had, its SHA-256 does not begin {sha256[:12]}")
    require("end_ps" in held, f"{path}: holds no end_ps, there are {', '.join(held) or 'none'}")
    end = held["end_ps"]
    good = (
        end.ndim == 2 and end.dtype.kind in "iuf" and 1 <= len(end) <= MAX_CONVERTERS and 1 <= end.shape[1] <= MAX_CODES
    )
    require(good, f"{path}: end_ps is {end.dtype}{end.shape}, expected numbers (converters, codes)")
    ends = end.astype(np.float64) / (clock_period_s * 1e12)
    rises = bool(np.isfinite(ends).all() and ends.min() >= 0 and (np.diff(ends, axis=1) >= 0).all())
    require(rises, f"{path}: end_ps falls, or is negative or not finite")
    last = end[np.abs(ends[:, -1] - 1).argmax(), -1]
    fits = bool((np.abs(ends[:, -1] - 1) < 1e-3).all())
    require(fits, f"{path}: codes end at {last:g} ps, expected the clock period of {clock_period_s * 1e12:g} ps")
    ends = ends / ends[:, -1:]
    ends.setflags(write=False)
    return ends


@lru_cache(maxsize=8)
def _drawn(codes: int, dnl: float, missing: float) -> np.ndarray:
    """Draw widths: a fraction `missing` is 0, the others share the clock period by a symmetric Dirichlet law whose
    concentration gives all codes the standard deviation `dnl` about their mean of 1."""
    absent = round(missing * codes)
    there = codes - absent
    require(there > 0, f"tdc: missing {missing:g} of {codes} codes leaves none")
    most = math.sqrt(codes - 1)  # where one code is as wide as the clock period, and the others have no width
    require(dnl <= most, f"tdc: dnl {dnl:g} is above {most:.3g} codes, the most that {codes} codes can have")
    mean = codes / there
    spread = (1 + dnl**2) / mean - 1
    least = math.sqrt(mean - 1)
    require(
        spread >= -_ROUNDING,
        f"tdc: dnl {dnl:g} is below {least:.3g} codes, what {absent} missing of {codes} make alone",
    )
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(Stream.PIXELS, 3, 0)))
    comes = rng.permuted(np.tile(np.arange(codes) >= absent, (DRAWN, 1)), axis=1)
    # n Dirichlet widths of concentration k each, with a mean of 1, have the variance (n - 1) / (n k + 1)
    widths = comes * 1.0 if spread < _ROUNDING else _gamma(((there - 1) / spread - 1) / there, comes, rng)
    ends = np.cumsum(widths, axis=1)
    ends /= ends[:, -1:]
    ends.setflags(write=False)
    return ends


def _gamma(shape: float, comes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw gamma variates where a code `comes`, and 0 elsewhere; each row is in units of its largest.

    A shape near 0 has variates below the smallest number. They are drawn in logarithms, as G(k) = G(k + 1) U^(1 / k)
    (Marsaglia, Tsang 2000).
    """
    shape = max(shape, 1e-9)
    logs = np.log(rng.standard_gamma(shape + 1, comes.shape)) + np.log1p(-rng.random(comes.shape)) / shape
    logs = np.where(comes, logs, -np.inf)
    return np.exp(logs - logs.max(axis=1, keepdims=True))


@lru_cache(maxsize=8)
def _edges(tdc: Tdc, bins: int, bin_width_s: float) -> np.ndarray:
    ratio = bins * bin_width_s / tdc.clock_period_s
    periods = round(ratio)
    laser, clock = bins * bin_width_s, tdc.clock_period_s
    whole = periods >= 1 and abs(ratio - periods) < 1e-6 * ratio
    require(whole, f"tdc: laser period of {laser:g} s is no whole number of clock periods of {clock:g} s")
    ends = tdc.ends()
    converters, codes = ends.shape
    turn = np.arange(periods)[:, None]
    at = (turn + reported_times(tdc)[:, None]).reshape(-1, periods * codes) * (bins / periods)
    places = np.floor(at + _ROUNDING).astype(np.int64).clip(0, bins - 1)
    held = np.array([np.bincount(row + 1, minlength=bins + 1) for row in places])
    first = np.broadcast_to(held.cumsum(axis=1), (converters, bins + 1))  # code that each bin begins with
    begins = (turn + np.pad(ends[:, :-1], ((0, 0), (1, 0)))[:, None]).reshape(converters, -1)
    begins = np.pad(begins, ((0, 0), (0, 1)), constant_values=periods)
    edges = np.take_along_axis(begins, first, axis=1) * (bins / periods)
    edges.setflags(write=False)
    return edges


def reported_times(tdc: Tdc) -> np.ndarray:
    """Return the time in clock periods that each fine code stands for, (converters, codes), or (1, codes) of all."""
    ends = tdc.ends()
    codes = ends.shape[1]
    nominal = (np.arange(codes) + 0.5) / codes
    if tdc.correction == "none":
        return nominal[None]
    widths = np.diff(ends, axis=1, prepend=0)
    middle = ends - widths / 2
    steps = 1 << tdc.correction_bits
    if tdc.correction == "table":
        return (np.minimum(np.floor(middle * steps), steps - 1) + 0.5) / steps
    # least squares over what comes, each code weighted by how often it does
    centre, mean = widths @ nominal, (widths * middle).sum(axis=1)
    apart = nominal - centre[:, None]
    spread = (widths * apart**2).sum(axis=1)
    rise = np.ones(len(spread))  # kept by converters of which one code comes: every slope fits it
    np.divide((widths * apart * (middle - mean[:, None])).sum(axis=1), spread, out=rise, where=spread > _ROUNDING**2)
    rise, begin = (np.round(value * steps) / steps for value in (rise, mean - rise * centre))
    # within the clock period: codes before the first that comes must not fall into the period before
    return (begin[:, None] + rise[:, None] * nominal).clip(0, 1 - 1 / (2 * steps))


def rising_edges(edges: np.ndarray) -> np.ndarray:
    """Return first edges of all converters' bins on one rising axis, converter after converter: (converters bins,)."""
    bins = edges.shape[1] - 1
    return (edges[:, :-1] + bins * np.arange(len(edges))[:, None]).ravel()


def time_codes(position: np.ndarray, converter: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the bins that converters put times into: (M,) int32.

    position   (M,) true time in bins, 0 to the number of bins
    converter  (M,) row of `edges` of each
    edges      (converters, bins + 1) of `Tdc.edges`
    """
    bins = edges.shape[1] - 1
    first = converter.astype(np.int64) * bins
    # of edges that coincide, around a code that never comes, the last
    return (
        (np.searchsorted(rising_edges(edges), position + first, side="right") - 1 - first)
        .clip(0, bins - 1)
        .astype(np.int32)
    )


def recalibrated(counts: np.ndarray, converter: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return a recorded histogram on equal bins: each bin's counts are spread over the true time that it stands for.

    counts (H, W, T), converter (H, W) row of `edges` -> (H, W, T) float64. A photon's place within a code's interval is
    not known: the spread is the expectation for arrivals uniform over it. Linear in the counts: summing rows of C that
    are averaged over each code's true time is encoding what this returns.
    """
    height, width, bins = counts.shape
    true, arrived = np.arange(bins + 1.0), np.zeros((height, width, bins + 1))
    np.cumsum(counts, axis=2, out=arrived[..., 1:])
    for row, column in np.ndindex(height, width):
        # edges that coincide hold a code that never comes: nothing arrives between them
        arrived[row, column] = np.interp(true, edges[converter[row, column]], arrived[row, column])
    return np.diff(arrived, axis=2)


class ClockError(NamedTuple):
    """Mean and root mean square of what converters report minus the true time [bins]."""

    mean: float
    rms: float


def clock_error(edges: np.ndarray) -> ClockError:
    """Return mean and rms [bins] of a bin's centre minus the true time, over times uniform in the period and over
    converters; a perfect clock has an rms of 1/sqrt(12) bins."""
    centre = np.arange(edges.shape[1] - 1) + 0.5
    early, late = centre - edges[:, :-1], centre - edges[:, 1:]
    period = len(centre) * len(edges)
    return ClockError(
        float((early**2 - late**2).sum() / 2 / period), math.sqrt((early**3 - late**3).sum() / 3 / period)
    )
