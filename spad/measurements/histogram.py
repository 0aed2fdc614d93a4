"""`Histogram`: the photon counts of an image with the sensor and the truth that made it, and its HDF5 file."""

from __future__ import annotations

import hashlib
import io
import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scenes.errors import InputError, require, require_kind, require_kinds, require_whole
from scenes.files import ATTRIBUTE, check_seal, open_seal, seal, whole_file
from scenes.io.hdf5 import HDF5_SUFFIXES, USER_BLOCK, add_checksum, describe, open_checked, read_dataset
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from scenes.notebook import html_card
from spad.measurements.metadata import check_meta
from spad.measurements.timestamps import checked_events, counts_from_timestamps, timestamps_from_counts
from spad.sensor.files import pixel_sensor
from spad.sensor.model import PhotonBudget, Sensor

MAX_MEAN_COUNTS = 1e9  # of a pixel, as `PhotonBudget` has
FOREIGN = (
    "in Python scene2spad.Histogram.from_counts takes counts (H, W, T), and Histogram.from_timestamps a list of "
    "detections, with their sensor"
)
TRUTH: dict[str, type[np.generic]] = {  # of every pixel, and the type that it is kept in
    "depth_m": np.float32,
    "mixed": np.bool_,
    "albedo": np.float16,
    "expected_signal": np.float32,
    "expected_background": np.float32,
}
NOTES = {  # unit and description of every dataset of the file
    "timestamps": ("bins", "time bin of every detection from 0, ascending in a pixel, pixel after pixel in rows"),
    "offsets": ("1", "detections of pixel p are timestamps[offsets[p]:offsets[p + 1]]"),
    "counts": ("detections per bin", "photon counts, row x column x time bin"),
    "depth_m": ("m", "true radial depth at the pixel's centre, NaN where nothing is or it is unknown"),
    "mixed": ("1", "whether the pixel sees surfaces more than 50 mm apart"),
    "albedo": ("1", "diffuse reflectance at the pixel's centre"),
    "expected_signal": ("detections", "expected signal detections of the pixel in one exposure"),
    "expected_background": ("detections", "expected background detections of the pixel in one exposure"),
}


@dataclass(frozen=True, eq=False, repr=False)
class Histogram:
    """Photon counts of every pixel and time bin.

    counts               (H, W, T) int32; the array that was given, which can be written to: torch warns of one that
                         cannot and `torch.from_numpy(histogram.counts)` is to share its memory
    sensor, budget       what recorded it
    depth_m              (H, W) float32 truth: radial depth at the pixel centre, NaN where nothing is
    mixed                (H, W) bool: surfaces more than 50 mm apart in the pixel
    albedo               (H, W) float16 truth at the pixel centre
    expected_signal, expected_background   (H, W) float32, detections per pixel and exposure
    meta                 seed, plan, what made the transient: anything JSON holds

    Truth in numbers of another type is converted, and NaN where it is masked. Raises InputError for fields of another
    kind, counts and masks of another type, masked ones, other shapes, and values below 0.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=4, height=3, bounces=1)
    >>> histogram = s2s.sense(transient, signal=20, background=5, seed=1)  # detections a pixel
    >>> histogram.counts.shape, histogram.depth_m.shape
    ((3, 4, 1024), (3, 4))
    >>> round(float(histogram.expected_signal.mean()), 3), round(float(histogram.expected_background.mean()), 3)
    (20.0, 5.0)
    """

    counts: np.ndarray
    sensor: Sensor
    budget: PhotonBudget
    depth_m: np.ndarray
    mixed: np.ndarray
    albedo: np.ndarray
    expected_signal: np.ndarray
    expected_background: np.ndarray
    meta: JsonObject = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_kinds(self, "histogram", sensor=Sensor, budget=PhotonBudget, meta=dict)
        require_kinds(self, "histogram", **dict.fromkeys(("counts", *TRUTH), np.ndarray))
        if self.counts.ndim != 3 or self.counts.dtype != np.int32 or self.counts.shape[2] != self.sensor.bins:
            shape = f"{self.counts.dtype}{self.counts.shape}"
            raise InputError(f"histogram: counts are {shape}, expected int32 (H, W, {self.sensor.bins})")
        _require_unmasked(self.counts, "counts")
        if self.counts.size and self.counts.min() < 0:
            raise InputError(f"histogram: a bin holds {self.counts.min()} counts")
        for name in TRUTH:
            object.__setattr__(self, name, self._checked_truth(name, getattr(self, name)))

    def _checked_truth(self, name: str, array: np.ndarray) -> np.ndarray:
        """Return an image of the truth in its own type, to read from; the caller's own can still be written to."""
        kind = np.dtype(TRUTH[name])
        if array.shape != self.counts.shape[:2]:
            raise InputError(f"histogram: {name} is {array.shape}, expected {self.counts.shape[:2]}")
        # numbers to less precise ones, but no number to a truth value: ~ of the 0s and 1s of a mask is true everywhere
        fits = np.can_cast(array.dtype, kind, "same_kind")
        require(fits, f"histogram: {name} is {array.dtype}, expected {kind}")
        if kind == np.bool_:
            _require_unmasked(array, name)
        with np.errstate(over="ignore"):  # to infinity, which is refused
            held = array.astype(kind, copy=False)
        if isinstance(held, np.ma.MaskedArray):  # files hold no masks
            held = held.filled(np.nan)
        held = held.view()
        if (np.isinf(held) | (held < 0)).any():
            raise InputError(f"histogram: {name} holds infinite or negative values")
        held.setflags(write=False)
        return held

    @classmethod
    def from_counts(cls, counts: np.ndarray, sensor: Sensor | str | Path, meta: JsonObject | None = None) -> Histogram:
        """Make a histogram of measured counts whose truth nobody knows.

        Parameters
        ----------
        counts : (H, W, T) whole numbers from 0 on, one for each pixel and time bin; they are copied
        sensor : what recorded them, or its name or file (.toml); its number of bins is T
        meta : what is to be kept beside them, anything JSON holds

        Returns
        -------
        A histogram with NaN for depth, albedo and expected detections. Its budget states all detections as background.

        Raises
        ------
        InputError for counts of another shape, without a pixel, masked, below 0, above 2^31 - 1, of more than 1e9 a
        pixel on average, or that are no whole numbers; and for metadata as `check_meta`.

        Examples
        --------
        >>> import numpy as np
        >>> import scene2spad as s2s
        >>> s2s.Histogram.from_counts(np.ones((2, 3, 8), int), s2s.Sensor(bins=8)).timestamps()[0].shape
        (48,)
        """
        sensor = pixel_sensor(sensor)
        checked = _checked_counts(counts, sensor.bins)
        unknown = np.full(checked.shape[:2], np.nan, np.float32)
        given = {} if meta is None else check_meta(meta, (checked.shape[0], checked.shape[1]))
        return cls(
            counts=np.array(checked, np.int32, order="C"),  # a copy: buffers are used again
            sensor=sensor,
            budget=PhotonBudget(0.0, float(checked.sum(dtype=float) / unknown.size)),
            depth_m=unknown,
            mixed=np.zeros(unknown.shape, bool),
            albedo=unknown.astype(np.float16),
            expected_signal=unknown.copy(),
            expected_background=unknown.copy(),
            meta={"model": "poisson", "plan": ["measured counts"], "pile_up": 0.0, "wrapped": 0.0, "dark_share": 0.0}
            | given,
        )

    @classmethod
    def from_timestamps(
        cls,
        stamps: np.ndarray,
        offsets: np.ndarray,
        shape: tuple[int, int],
        sensor: Sensor | str | Path,
        meta: JsonObject | None = None,
    ) -> Histogram:
        """Make a histogram of a list of measured detections, as `timestamps` returns one.

        Parameters
        ----------
        stamps : (N,) whole numbers, the time bin of each detection from 0, pixel after pixel in rows, in any order in
            a pixel
        offsets : (H*W + 1,) whole numbers: the detections of pixel p are stamps[offsets[p]:offsets[p + 1]]
        shape : rows and columns (H, W) of the image
        sensor : what recorded them, or its name or file (.toml)
        meta : what is to be kept beside them, anything JSON holds

        Returns
        -------
        A histogram as `from_counts` makes.

        Raises
        ------
        InputError for stamps outside the sensor's bins, offsets that do not rise from 0 to N, and as `from_counts`.

        Examples
        --------
        >>> import scene2spad as s2s
        >>> s2s.Histogram.from_timestamps([5, 1, 5], [0, 2, 3], (1, 2), s2s.Sensor(bins=8)).counts[0, 0].tolist()
        [0, 1, 0, 0, 0, 1, 0, 0]
        """
        sensor = pixel_sensor(sensor)
        sides = isinstance(shape, tuple | list) and len(shape) == 2
        require(sides, f"timestamps: shape {shape!r}, expected rows and columns (H, W)")
        rows, columns = (require_whole(side, "timestamps: side of the image") for side in shape)
        require(rows > 0 and columns > 0, f"timestamps: image of {rows} x {columns} pixels, expected 1 x 1 or more")
        require_memory(16 * rows * columns * sensor.bins, f"a histogram of {rows * columns} pixels")
        flat = counts_from_timestamps(*checked_events(stamps, offsets, rows * columns, sensor.bins), sensor.bins)
        return cls.from_counts(flat.reshape(rows, columns, sensor.bins), sensor, meta)

    @property
    def signal_known(self) -> bool:
        """Tell whether signal and background are told apart: nobody knows them of measured counts."""
        return bool(np.isfinite(self.expected_signal).any())

    @property
    def budget_in_words(self) -> str:
        """Return the photon budget as pages and notebooks show it."""
        signal, background = self.budget.signal, self.budget.background
        if self.signal_known:
            return f"{signal:g} signal + {background:g} background detections a pixel"
        return f"{signal + background:g} detections a pixel; how many are signal is unknown"

    def __repr__(self) -> str:
        (height, width, bins), sensor = self.counts.shape, self.sensor
        return (
            f"Histogram({height} x {width} pixels (rows x columns) x {bins} bins of "
            f"{sensor.bin_width_s * 1e12:.4g} ps, "
            f"{int(self.counts.sum(dtype=np.int64))} detections in all, {self.budget_in_words}, sensor {sensor.name!r})"
        )

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the facts, and the detections as a picture."""
        (height, width, bins), sensor = self.counts.shape, self.sensor
        facts = {
            "pixels": f"{height} rows x {width} columns",
            "time": f"{bins} bins of {sensor.bin_width_s * 1e12:.4g} ps, sensor {sensor.name}",
            "photon budget": self.budget_in_words,
            "detections": f"{int(self.counts.sum(dtype=np.int64)):,}",
        }
        return html_card("Histogram", facts, self.counts.sum(axis=2, dtype=np.int64))

    def timestamps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sparse form: time bin of every detection (uint16, ascending in a pixel), and (H*W + 1,) int64
        offsets."""
        return timestamps_from_counts(self.counts)

    def sha256(self) -> str:
        """Return SHA-256 over counts and truth."""
        sha = hashlib.sha256(str(self.counts.shape).encode())
        for array in (self.counts, *(getattr(self, name) for name in TRUTH)):
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()


def _require_unmasked(array: np.ndarray, name: str) -> None:
    require(not np.ma.is_masked(array), f"histogram: {name} are masked, fill them first: `{name}.filled(0)`")


def _checked_counts(counts: np.ndarray, bins: int) -> np.ndarray:
    """Return counts of so many bins as an array; InputError for what `Histogram.from_counts` says."""
    _require_unmasked(counts, "counts")
    try:
        array = np.asarray(counts)
    except (ValueError, RuntimeError) as error:  # rows of several lengths, tensors that are being trained
        raise InputError(f"histogram: counts are no array of numbers ({error})") from None
    if array.ndim != 3 or array.shape[2] != bins or array.dtype.kind not in "iufb":
        raise InputError(f"histogram: counts are {array.dtype}{array.shape}, expected (H, W, {bins})")
    require(array.size > 0, f"histogram: counts are of {array.shape[0]} x {array.shape[1]} pixels, expected 1 or more")
    least, most = float(array.min()), float(array.max())
    whole = array.dtype.kind in "iub" or bool((array == np.floor(array)).all())
    if not (least >= 0 and most <= np.iinfo(np.int32).max and whole):
        raise InputError(f"histogram: counts from {least:g} to {most:g}, expected whole numbers from 0 to 2^31 - 1")
    mean = float(array.sum(dtype=float)) / (array.shape[0] * array.shape[1])
    require(mean <= MAX_MEAN_COUNTS, f"histogram: counts of {mean:.4g} a pixel on average, the limit is 1e9")
    return array


def write_histogram(histogram: Histogram, path: Path) -> None:
    """Write HDF5, whole or not at all: timestamps where they are the smaller form, else dense counts.

    Raises InputError for another ending than .h5 or .hdf5, and where the path cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> measured = s2s.Histogram.from_counts(np.ones((3, 4, 8), int), s2s.Sensor(bins=8))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     s2s.write_histogram(measured, folder + "/measured.h5")
    ...     int(s2s.read_histogram(folder + "/measured.h5").counts.sum())  # 3 x 4 pixels x 8 bins
    96
    """
    import h5py

    require_kind(histogram, Histogram, "write_histogram")
    require(isinstance(path, str | os.PathLike), f"write_histogram: expected a path, not {type(path).__name__}")
    require(Path(path).suffix.lower() in HDF5_SUFFIXES, f"{path}: a histogram ends in .h5")
    meta = {**histogram.meta, "sensor": histogram.sensor.to_dict(), "budget": histogram.budget.to_dict()}
    packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    buffer = io.BytesIO()  # HDF5 itself does not survive a full disk
    with h5py.File(
        buffer, "w", libver="latest", userblock_size=USER_BLOCK
    ) as file:  # older layouts hold no metadata over 64 kB
        file.attrs[ATTRIBUTE] = seal(meta, "histogram", histogram.sha256())
        if int(histogram.counts.sum(dtype=np.int64)) * 2 < histogram.counts.nbytes:
            stamps, offsets = histogram.timestamps()
            file.create_dataset("timestamps", data=stamps, **(packed if len(stamps) else {}))
            file.create_dataset("offsets", data=offsets, **packed)
        else:
            file.create_dataset("counts", data=histogram.counts, **packed)
        for name in TRUTH:
            file.create_dataset(name, data=getattr(histogram, name), **packed)
        describe(file, NOTES)
    with whole_file(path) as beside:
        beside.write_bytes(buffer.getbuffer())
        add_checksum(beside)


def read_histogram(path: Path) -> Histogram:
    """Read a histogram and check its hash.

    Raises InputError in one line for a missing, foreign, truncated or altered file, or one of a newer schema.

    Examples
    --------
    What is read is what was written, to the last bit:

    >>> import tempfile
    >>> import scene2spad as s2s
    >>> histogram = s2s.sense(s2s.render("plane", width=4, height=3, bounces=1), signal=20, background=5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     s2s.write_histogram(histogram, folder + "/plane.h5")
    ...     s2s.read_histogram(folder + "/plane.h5").sha256() == histogram.sha256()
    True
    """
    require(isinstance(path, str | os.PathLike), f"read_histogram: expected a path, not {type(path).__name__}")
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: file not found")
    try:
        with open_checked(path) as file:
            if ATTRIBUTE not in file.attrs:
                raise InputError(f"not a file of scene2spad; {FOREIGN}")
            meta, sha256 = open_seal(file.attrs[ATTRIBUTE], "histogram")
            unknown = sorted(set(file) - {*TRUTH, "counts", "timestamps", "offsets"})
            if unknown:
                raise InputError(f"holds {', '.join(unknown)[:80]}, which no histogram has")
            histogram = _assemble(meta, {name: read_dataset(file, name) for name in file})
        meta = check_seal(meta, sha256, histogram.sha256())
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, IndexError, MemoryError) as error:
        raise InputError(f"{path}: not a readable HDF5 file ({' '.join(str(error).split())[:120]})") from None
    return replace(histogram, meta={key: value for key, value in meta.items() if key not in ("sensor", "budget")})


def _assemble(meta: JsonObject, data: dict[str, np.ndarray]) -> Histogram:
    if not ({*TRUTH} <= {*data} and ("counts" in data or {"timestamps", "offsets"} <= {*data})):
        raise InputError(f"datasets are missing, there are {', '.join(sorted(data)) or 'none'}")
    sensor, budget = Sensor.from_dict(meta["sensor"]), PhotonBudget(**meta["budget"])
    counts = data.get("counts")
    require_memory(5 * data["depth_m"].size * sensor.bins, f"a histogram of {data['depth_m'].size} pixels")
    if counts is None:
        flat = counts_from_timestamps(data["timestamps"], data["offsets"], sensor.bins)
        counts = flat.reshape(*data["depth_m"].shape, sensor.bins)
    return Histogram(counts, sensor, budget, **{name: data[name] for name in TRUTH})  # type: ignore[arg-type]
