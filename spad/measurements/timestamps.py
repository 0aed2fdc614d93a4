"""`Timestamps`: a SPAD's native output, the time bin of every detection, pixel after pixel. Needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scenes.errors import InputError, require
from scenes.json_types import JsonObject


@dataclass(frozen=True, eq=False)
class Timestamps:
    """Time bins of an image's detections.

    stamps    (N,) uint16, ascending within a pixel
    offsets   (H*W + 1,) int64: the detections of pixel p are [offsets[p], offsets[p + 1])
    bins      T; a stamp takes ceil(log2 T) bits, 10 for the reference sensor
    meta      seed, plan: anything JSON holds
    """

    height: int
    width: int
    bins: int
    stamps: np.ndarray
    offsets: np.ndarray
    meta: JsonObject = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.stamps.dtype != np.uint16 or self.stamps.ndim != 1:
            raise InputError(f"timestamps are {self.stamps.dtype}{self.stamps.shape}, expected uint16 (N,)")
        if self.offsets.dtype != np.int64 or self.offsets.shape != (self.height * self.width + 1,):
            raise InputError(
                f"timestamp offsets are {self.offsets.dtype}{self.offsets.shape}, "
                f"expected int64 ({self.height * self.width + 1},)"
            )
        whole = self.offsets[0] == 0 and self.offsets[-1] == len(self.stamps) and (np.diff(self.offsets) >= 0).all()
        if not whole:
            raise InputError(f"timestamp offsets must rise from 0 to the {len(self.stamps)} timestamps")
        if len(self.stamps) and int(self.stamps.max()) >= self.bins:
            raise InputError(f"timestamp {self.stamps.max()} is outside the {self.bins} bins")

    def counts(self) -> np.ndarray:
        """Return the dense form, (H, W, T) int32."""
        return counts_from_timestamps(self.stamps, self.offsets, self.bins).reshape(self.height, self.width, self.bins)

    @classmethod
    def of_counts(cls, counts: np.ndarray, meta: JsonObject | None = None) -> Timestamps:
        """Return the sparse form of counts (H, W, T)."""
        height, width, bins = counts.shape
        stamps, offsets = timestamps_from_counts(counts)
        return cls(height, width, bins, stamps, offsets, meta or {})


def checked_events(stamps: np.ndarray, offsets: np.ndarray, pixels: int, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps (N,) and offsets (pixels + 1,) of so many pixels and bins as int64, in the order that they had.

    Raises InputError for what is masked, no whole number, of another shape, or outside 0 to the last bin.
    """
    events, ends = (_whole(values, what) for values, what in ((stamps, "stamps"), (offsets, "offsets")))
    right = ends.shape == (pixels + 1,)
    require(right, f"timestamps: offsets are {ends.shape}, expected ({pixels + 1},) for {pixels} pixels")
    rises = ends[0] == 0 and ends[-1] == len(events) and bool((np.diff(ends) >= 0).all())
    require(rises, f"timestamps: offsets from {ends[0]} to {ends[-1]} must rise from 0 to the {len(events)} stamps")
    wrong = np.flatnonzero((events < 0) | (events >= bins))
    if len(wrong):
        raise InputError(f"timestamps: stamps[{wrong[0]}] is {events[wrong[0]]}, expected a bin from 0 to {bins - 1}")
    return events, ends


def _whole(values: np.ndarray, what: str) -> np.ndarray:
    """Return an array of one dimension of whole numbers as int64.

    Floating-point and unsigned numbers beyond +-2^62 become +-2^62, as int64 would turn them to other numbers: a check
    against bins still refuses them. Raises InputError for masked numbers, fractions and other shapes.
    """
    require(not np.ma.is_masked(values), f"timestamps: {what} are masked, leave the masked ones out")
    array = np.asarray(values)
    good = array.ndim == 1 and (array.dtype.kind in "iuf" or not array.size)
    require(good, f"timestamps: {what} are {array.dtype}{array.shape}, expected whole numbers of one dimension")
    if array.dtype.kind == "f" and (array != np.floor(array)).any():
        raise InputError(f"timestamps: {what} are no whole numbers")
    return array.clip(-(1 << 62), 1 << 62).astype(np.int64) if array.dtype.kind in "fu" else array.astype(np.int64)


def counts_from_timestamps(stamps: np.ndarray, offsets: np.ndarray, bins: int) -> np.ndarray:
    """Return dense (pixels, T) int32 counts of sparse detections; the inverse of `timestamps_from_counts`."""
    pixels = len(offsets) - 1
    owner = np.repeat(np.arange(pixels), np.diff(offsets))
    return np.bincount(owner * bins + stamps, minlength=pixels * bins).reshape(pixels, bins).astype(np.int32)


def timestamps_from_counts(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return time bin of every detection of counts (..., T): (N,) uint16, ascending in a pixel, and (P + 1,) int64
    offsets."""
    flat = counts.reshape(-1, counts.shape[-1])
    pixel, time_bin = np.nonzero(flat)
    stamps = np.repeat(time_bin.astype(np.uint16), flat[pixel, time_bin])
    return stamps, np.concatenate(([0], np.cumsum(flat.sum(axis=1, dtype=np.int64))))
