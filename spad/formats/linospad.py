"""Captures in the layout of the LinoSPAD prototype (Lindell et al. 2018): `.mat` files read and written, and binned.

A file holds two cells of one entry a frame: `spad_processed_data`, sparse (bins, pixels) counts whose pixels run down
the columns first, and `cam_processed_data`, intensity images. The prototype has 1536 bins of 26 ps and 256 x 256
pixels. Bins and pixels are put together by sums alone, so that counts are conserved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse

from scenes.errors import require
from scenes.limits import require_memory
from spad.formats.matfile import Matrix, load_mat, save_mat
from spad.measurements.histogram import Histogram
from spad.measurements.timestamps import Timestamps
from spad.sensor.model import PRESETS, Sensor

BINS = 1536
COUNTS, IMAGES = "spad_processed_data", "cam_processed_data"


@dataclass(frozen=True, eq=False)
class Capture:
    """One frame: counts (bins, side * side) sparse, pixels down the columns first; its image (h, w) float32, if any."""

    counts: scipy.sparse.csc_matrix
    image: np.ndarray | None = None

    @property
    def side(self) -> int:
        return math.isqrt(self.counts.shape[1])


def capture_of(detections: Timestamps, image: np.ndarray | None = None) -> Capture:
    """Return a square image's detections as a frame of the layout; InputError for an image that is none."""
    side = detections.height
    require(side == detections.width, f"image of {detections.width} x {side} pixels: the layout's images are square")
    row, column = np.divmod(np.repeat(np.arange(side * side), np.diff(detections.offsets)), side)
    ones = np.ones(len(detections.stamps))
    shape = (detections.bins, side * side)
    counts = scipy.sparse.csc_matrix((ones, (detections.stamps.astype(np.int64), column * side + row)), shape)
    return Capture(counts, image)


def write_linospad(captures: Sequence[Capture], path: Path) -> None:
    """Write frames as a version 5 .mat file, whole or not at all. Frames without an image get one that is black."""
    path = Path(path)
    require(path.suffix == ".mat", f"{path}: the output must end in .mat")
    require(len(captures) > 0, f"{path}: no frame to write")
    frames, images = np.empty((1, len(captures)), object), np.empty((1, len(captures)), object)
    for number, capture in enumerate(captures):
        frames[0, number] = capture.counts
        images[0, number] = np.zeros((capture.side, capture.side)) if capture.image is None else capture.image
    save_mat({COUNTS: frames, IMAGES: images}, path)


def read_linospad(path: Path, frame: int = 0, *, bins: int = BINS) -> Capture:
    """Return one frame of a file, from 0. A file of a single sparse matrix, without a cell, is one frame.

    Raises InputError in one line for a file that is missing, damaged, of MATLAB's version 7.3 or of another layout,
    a frame that is not there, images that are not square, and counts that are negative or not finite.
    """
    return frame_of(load_mat(path, [COUNTS, IMAGES]), Path(path), frame, bins=bins)


def frame_of(contents: Mapping[str, Matrix], path: Path, frame: int, *, bins: int = BINS) -> Capture:
    """Return one frame of a file's variables, as `read_linospad` does."""
    require(COUNTS in contents, f"{path}: holds no {COUNTS}, it is no LinoSPAD capture")
    frames = _entries(contents[COUNTS])
    require(0 <= frame < len(frames), f"{path}: frame {frame} is not one of its {len(frames)}, from 0")
    counts = _checked(frames[frame], f"{path}: frame {frame}", bins)
    images = _entries(contents[IMAGES]) if IMAGES in contents else []
    image = np.asarray(images[frame]) if frame < len(images) else None
    usable = image is not None and image.ndim in (2, 3) and image.size > 0 and image.dtype.kind in "uif"
    if image is None or not usable:
        return Capture(counts)
    return Capture(counts, image.astype(np.float32).mean(axis=tuple(range(2, image.ndim))))


def _entries(cell: Matrix) -> list[Matrix]:
    """Entries of a MATLAB cell; what is no cell is the only one."""
    return list(cell.ravel()) if isinstance(cell, np.ndarray) and cell.dtype == object else [cell]


def _checked(counts: Matrix, where: str, bins: int) -> scipy.sparse.csc_matrix:
    numeric = scipy.sparse.issparse(counts) or isinstance(counts, np.ndarray)
    require(numeric and counts.ndim == 2 and counts.dtype.kind in "buif", f"{where}: holds no matrix of counts")
    found = scipy.sparse.csc_matrix(counts, dtype=np.float64)
    pixels = found.shape[1]
    message = f"{where}: counts of shape {found.shape[0]} x {pixels}, expected {bins} bins x a square number of pixels"
    require(found.shape[0] == bins and pixels > 0 and math.isqrt(pixels) ** 2 == pixels, message)
    good = bool(np.isfinite(found.data).all() and (found.data >= 0).all())
    require(good, f"{where}: holds counts that are negative or not finite")
    return found


def capture_histogram(capture: Capture, sensor: Sensor | None = None) -> Histogram:
    """Return a capture as a histogram without truth: depth, expected signal and background are NaN in every pixel.

    `sensor` (default: the `linospad` preset) has the capture's bins. A capture does not say which photons are signal,
    so that the budget states all of them as background. Raises InputError for counts that are no whole numbers or of
    another number of bins, and images that need more memory than the limit.
    """
    sensor, side = sensor or PRESETS["linospad"], capture.side
    bins, pixels = capture.counts.shape
    require(bins == sensor.bins, f"capture of {bins} bins, sensor {sensor.name} has {sensor.bins}")
    require_memory(12 * bins * pixels, f"a capture of {pixels} pixels")
    found = capture.counts.data
    whole = bool((found == np.floor(found)).all() and found.max(initial=0) <= np.iinfo(np.int32).max)
    require(whole, "holds counts that are no whole numbers of 32 bits")
    columns_first = capture.counts.astype(np.int32).T.toarray().reshape(side, side, bins)
    counts = np.ascontiguousarray(columns_first.swapaxes(0, 1))
    return Histogram.from_counts(counts, sensor, {"plan": ["read from a capture"], "layout": "mat"})


def rebinning(bins: int, new_bins: int) -> scipy.sparse.csr_matrix:
    """Return R (new_bins, bins): the share of each bin that lies in each new one, both dividing one and the same
    period.

    Counts taken as spread evenly over their bin. Every column sums to 1, no entry is negative, and the cumulative
    counts at every edge that both divisions have stay exactly what they were.
    """
    require(min(bins, new_bins) >= 1, f"bins {bins} to {new_bins}: expected 1 or more")
    # edges in units of 1 / (bins * new_bins) of the period are whole numbers
    edges = np.union1d(np.arange(bins + 1) * new_bins, np.arange(new_bins + 1) * bins)
    fraction = np.diff(edges) / new_bins
    return scipy.sparse.csr_matrix((fraction, (edges[:-1] // bins, edges[:-1] // new_bins)), (new_bins, bins))


def pooling(side: int, factor: int) -> scipy.sparse.csc_matrix:
    """Return P (side * side, pixels): sums of factor x factor pixels, down the columns first before, row after row
    after."""
    require(factor >= 1 and side % factor == 0, f"image of {side} x {side} pixels is not tiled by {factor} x {factor}")
    column, row = np.divmod(np.arange(side * side), side)
    to = row // factor * (side // factor) + column // factor
    shape = (side * side, (side // factor) ** 2)
    return scipy.sparse.csc_matrix((np.ones(side * side), (np.arange(side * side), to)), shape)


def resampled(capture: Capture, bins: int = 1024, factor: int = 2) -> np.ndarray:
    """Return R counts P: `bins` bins over the same period, sums of factor x factor pixels, (side / factor, ..., bins)
    float32.

    No negative count and no ringing, as resampling by Fourier transform gives; no photon lost, as decimation does.
    """
    small = rebinning(capture.counts.shape[0], bins) @ (capture.counts @ pooling(capture.side, factor))
    side = capture.side // factor
    return np.ascontiguousarray(small.toarray().T.astype(np.float32)).reshape(side, side, bins)


def resampled_sensor(sensor: Sensor, bins: int = 1024) -> Sensor:
    """Return the sensor whose bins the counts are in afterwards: the same pulse and period."""
    width = sensor.bins * sensor.bin_width_s / bins
    return replace(sensor, name=f"{sensor.name}-{bins}", bins=bins, bin_width_s=width, period_s=bins * width)
