"""The `.mat` files of the Lindell / Peng / ICCV 2023 family: frames and captures read, the newer layout written.

Indices are MATLAB's, from 1; images are (row, column); `spad` is a sparse (rows x columns, bins) matrix whose pixels
run down the columns first. `bin` is the bin that the pulse's peak lies in. Depth in our files is exact in `dist`; the
published `bin` is round(2 d / (c Delta)), with c = 3e8 m/s.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError, listed, require, require_kind, require_whole
from scenes.limits import require_memory
from spad.detection.laws import LOW_FLUX
from spad.estimators.bistatic import CO_LOCATED, laser_baseline_m, time_tells_depth
from spad.estimators.depth import estimate_depth
from spad.formats.linospad import COUNTS, capture_histogram, frame_of
from spad.formats.matfile import Matrix, load_mat, save_mat
from spad.formats.rgbd import PUBLISHED_SPEED_OF_LIGHT_M_PER_S, published_taps
from spad.measurements.histogram import FOREIGN, Histogram
from spad.sensor.model import PRESETS, PhotonBudget, Sensor
from spad.sensor.pulse import SampledPulse
from spad.sensor.template import binned_pulse

RATES_EPSILON = 1e-8
NO_BIN = 1  # what MATLAB's maximum of an empty histogram answers
PEAK_ARRIVALS = 64
log = logging.getLogger("scene2spad")

PULSE_NAME = "PSF_used_for_simulation_nr-"
SAME_PULSE = 1e-3  # of a pulse's sum: taps that differ by less in every bin are of the same pulse
ESTIMATES = {"argmax": "argmax", "lmf": "lmf-published", "zncc": "correlation"}


def write_mat(histogram: Histogram, path: Path) -> Path:
    """Write a histogram as the newer published frame, and its pulse beside it; returns the pulse file's path.

    rates (H, W, T) is the signal's share of the expected counts: S times the binned pulse at the true depth, min-max
    normalised in every pixel, 0 where there is no depth or no signal; rates_norm_params undoes that. Estimates are
    ours, in whole bins from 1 without the published offset of one. `bin` is the fullest bin of the noise-free pulse,
    as published. `bin_hr` and the estimates are of the arrival, which is the pulse's centroid, moved by as much as
    that bin stands off it on average.
    The layout holds no exposure, dead time and law, so that pile-up in its counts cannot be undone (`pile_up_warning`).
    Where nobody knows how many detections are signal, `photons`, `mean_signal_photons` and `SBR` are NaN.
    Where nothing is, and where nothing was detected, bins are 1: published loaders subtract 1 from unsigned numbers.
    Raises InputError as `check_mat` does, for zones whose converters have delays, clocks of their own or a chirp, and
    where the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import scene2spad as s2s
    >>> histogram = s2s.sense(s2s.render("plane", width=4, height=3, bounces=1), signal=20, background=5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     s2s.write_mat(histogram, folder + "/plane.mat").name  # the pulse's file, named by rows and columns
    'PSF_used_for_simulation_nr-3_nc-4.mat'
    """
    require_kind(histogram, Histogram, "write_mat")
    require(isinstance(path, str | os.PathLike), f"write_mat: expected a path, not {type(path).__name__}")
    path, sensor = Path(path), histogram.sensor
    height, width = histogram.depth_m.shape
    check_mat(path, sensor, height, width, laser_baseline_m(histogram))
    own = "converters measure other times than twice the depth over the speed of light (delay, clock, chirp)"
    require(time_tells_depth(histogram), f"{path}: the layout knows no zones whose {own}")
    pulse, taps = _pulse_file(path, height, width), _centred_taps(sensor)
    save_mat(_frame(histogram), path)
    psf = {"PSF_img": np.broadcast_to(taps, (height, width, len(taps))), "psf": taps, "pulse_len": float(len(taps))}
    save_mat(psf, pulse)
    return pulse


def pile_up_warning(histogram: Histogram) -> str | None:
    """Return one line where pile-up matters, which nobody can undo who has the .mat file alone; else None."""
    pile_up = float(histogram.meta.get("pile_up", 0.0))
    if pile_up <= LOW_FLUX:
        return None
    return (
        f"the .mat layout holds no exposure, dead time and law: with {pile_up:.2%} primary detections a cycle in the "
        "brightest pixel its counts are distorted by pile-up, which cannot be undone from that file"
    )


def check_mat(path: Path, sensor: Sensor, height: int, width: int, baseline_m: tuple[float, ...] = CO_LOCATED) -> None:
    """Raise InputError in one line for what the layout cannot hold: a laser beside the camera, bins that do not cover
    the period or are unequal, too large a frame, and the pulse of another sensor in the folder."""
    bins, period = sensor.bins, sensor.bins_per_period
    require(path.suffix == ".mat", f"{path}: the output must end in .mat")
    place = " ".join(f"{1e3 * value:g}" for value in baseline_m)
    require(not any(baseline_m), f"{path}: the layout knows no laser beside the camera, this one is at {place} mm")
    uncovered = f"the layout needs bins that cover the period, {sensor.name} has {bins} of {period}"
    require(bins == period, f"{path}: {uncovered}")
    sensor.check_equal_bins(f"{path}: the layout")
    size = 8 * height * width * bins
    require(size < 2**31, f"{path}: {height} x {width} x {bins} rates take {size} bytes, a version 5 file holds 2^31")
    pulse = _pulse_file(path, height, width)
    if pulse.is_file():
        known, taps = load_mat(pulse, ["psf"]).get("psf", np.zeros(0)).ravel(), _centred_taps(sensor)
        same = known.shape == taps.shape and np.allclose(known, taps, rtol=1e-6, atol=0)
        require(same, f"{pulse}: holds the pulse of another sensor; export to another folder")


def _pulse_file(path: Path, height: int, width: int) -> Path:
    """Return the pulse's file beside a frame, as the family names it."""
    return path.with_name(f"{PULSE_NAME}{height}_nc-{width}.mat")


def _frame(histogram: Histogram) -> dict[str, Matrix | float | dict[str, np.ndarray]]:
    sensor, depth = histogram.sensor, histogram.depth_m.astype(np.float64)
    pulses, known = _pulses(histogram), np.isfinite(depth)
    rates, offset, scaling = _normalised_rates(histogram, pulses)
    arrival = np.remainder(depth, sensor.range_m) / sensor.bin_depth_m
    peak = _peak_offset_bins(sensor)
    fine = np.where(known, arrival + 0.5 + peak, NO_BIN)
    index = np.where(known, pulses.argmax(axis=-1) + 1, NO_BIN).astype(np.uint16)
    counts = torch.from_numpy(histogram.counts)
    estimates = {
        f"est_range_bins_{name}": _whole_bins(estimate_depth(counts, sensor, method).numpy(), peak, sensor)
        for name, method in ESTIMATES.items()
    }
    budget, albedo = histogram.budget, histogram.albedo.astype(np.float64)
    known_split = histogram.signal_known
    return {
        "spad": _sparse(histogram.counts),
        "rates": rates,
        "rates_norm_params": {"rates_offset": offset, "rates_scaling": scaling},
        "bin": index,
        "range_bins": index,
        "bin_hr": fine,
        "range_bins_hr": fine,
        **estimates,
        "intensity": albedo,
        "intensity_hr": albedo,
        "SBR": budget.sbr if known_split else np.nan,
        "mean_signal_photons": budget.signal if known_split else np.nan,
        "photons": budget.signal if known_split else np.nan,
        "mean_background_photons": budget.background,
        "bin_size": sensor.bin_width_s,
        "dist": depth,
    }


def _pulses(histogram: Histogram) -> np.ndarray:
    """Bin the noise-free pulse of every pixel's true depth, (H, W, T); of depth 0 where there is none."""
    depth = histogram.depth_m.astype(np.float64)
    arrival = torch.from_numpy(np.where(np.isfinite(depth), 2 * depth / SPEED_OF_LIGHT_M_PER_S, 0))
    return np.stack([binned_pulse(row, histogram.sensor).numpy() for row in arrival])


def _peak_offset_bins(sensor: Sensor) -> float:
    """Average over arrivals within a bin how far the middle of the fullest bin stands behind the centroid [bins]."""
    middle = sensor.bins // 2 + (np.arange(PEAK_ARRIVALS) + 0.5) / PEAK_ARRIVALS
    fullest = binned_pulse(torch.from_numpy(middle * sensor.bin_width_s), sensor).numpy().argmax(axis=-1)
    return float((fullest + 0.5 - middle).mean())


def _normalised_rates(histogram: Histogram, pulses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normalise each pixel's rates to (rate - min) / (max - min + 1e-8); return these, min and 1 / (max - min +
    1e-8)."""
    signal = np.where(np.isfinite(histogram.depth_m), np.nan_to_num(histogram.expected_signal.astype(np.float64)), 0)
    rates = pulses * signal[..., None]
    low, high = rates.min(axis=-1), rates.max(axis=-1)
    scaling = 1 / (high - low + RATES_EPSILON)
    return (rates - low[..., None]) * scaling[..., None], low, scaling


def _whole_bins(depth_m: np.ndarray, peak_offset: float, sensor: Sensor) -> np.ndarray:
    """Return the bin from 1 that the peak of a pulse from this depth lies in, `peak_offset` bins behind its centroid;
    NO_BIN for none, (H, W) uint16."""
    arrival = np.nan_to_num(depth_m.astype(np.float64)) / sensor.bin_depth_m
    inside = np.floor(arrival + peak_offset) % sensor.bins
    return np.where(np.isnan(depth_m), NO_BIN, inside + 1).astype(np.uint16)


def _sparse(counts: np.ndarray) -> object:
    import scipy.sparse

    height, width, bins = counts.shape
    columns_first = counts.swapaxes(0, 1).reshape(width * height, bins)
    return scipy.sparse.csc_matrix(columns_first.astype(np.float64))


def _centred_taps(sensor: Sensor) -> np.ndarray:
    """Compute the binned pulse that arrives in a bin's centre, as far as it holds anything, (L,) float64."""
    middle = torch.tensor((sensor.bins // 2 + 0.5) * sensor.bin_width_s, dtype=torch.float64)
    pulse = binned_pulse(middle, sensor).numpy()
    held = np.flatnonzero(pulse > 1e-9)
    return pulse[held[0] : held[-1] + 1]


def read_mat(path: Path, frame: int = 0) -> Histogram:
    """Read a frame of either layout, or one `frame`, from 0, of a capture in the prototype's layout.

    The old one (`photons`, `SBR`, no `bin_size`) is that of the training set: its sensor is `iccv2023-train`, and depth
    that of `bin` by the published rounding, bin x c Delta / 2 with c = 3e8 m/s. Others say their bin width; their pulse
    is in a file beside them, as `write_mat` and the published simulation leave it: that of a preset where it is one,
    else its taps; the reference pulse where there is no such file. Expected signal and background are the frame's
    means: files of this family hold no maps. A capture (`formats.linospad`) has no truth; its sensor is `linospad`.

    Raises InputError in one line for a file that is none of these, and a frame that is not there.

    Examples
    --------
    Counts come back as they were, with bins of the same width:

    >>> import tempfile
    >>> import scene2spad as s2s
    >>> histogram = s2s.sense(s2s.render("plane", width=4, height=3, bounces=1), signal=20, background=5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     pulse_file = s2s.write_mat(histogram, folder + "/plane.mat")
    ...     frame = s2s.read_mat(folder + "/plane.mat")
    >>> bool((frame.counts == histogram.counts).all()), frame.sensor.bin_width_s == histogram.sensor.bin_width_s
    (True, True)
    """
    require(isinstance(path, str | os.PathLike), f"read_mat: expected a path, not {type(path).__name__}")
    path = Path(path)
    frame = require_whole(frame, f"{path}: frame")
    contents = load_mat(path)
    if COUNTS in contents:
        capture = frame_of(contents, path, frame)
        try:
            return capture_histogram(capture)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    require(frame == 0, f"{path}: is one frame and no capture of several, frame {frame} is not there")
    missing = {"spad", "SBR", "photons"} - {*contents} | (set() if {"bin", "range_bins"} & {*contents} else {"bin"})
    there = f"{', '.join(sorted(missing))} are missing, there are {', '.join(sorted(contents))}"
    require(not missing, f"{path}: {there}; {FOREIGN}")
    try:
        return _histogram(contents, path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: not a frame of this family ({' '.join(str(error).split())[:80]})") from None


def _newer_sensor(contents: Mapping[str, Matrix], bins: int, pulse_file: Path) -> Sensor:
    """Return the sensor of a frame that says its bin width, with the pulse of the file beside it."""
    plain = Sensor(name="mat", bins=bins, bin_width_s=float(contents["bin_size"].item()))
    if not pulse_file.is_file():
        others = sorted(other.name for other in pulse_file.parent.glob(f"{PULSE_NAME}*.mat"))
        if others:
            log.warning(
                "%s: not there, so the reference pulse is taken; of other sizes: %s", pulse_file, listed(others)
            )
        return plain
    taps = read_taps(pulse_file, bins)
    train = replace(plain, pulse=PRESETS["iccv2023-train"].pulse)
    for known, form in ((plain, _centred_taps), (plain, published_taps), (train, _centred_taps)):
        try:
            other = form(known)
        except InputError:  # more taps than the frame has bins
            continue
        if _same_pulse(taps, other):
            return known
    return replace(plain, pulse=SampledPulse(tuple(taps), plain.bin_width_s))


def read_taps(pulse_file: Path, bins: int) -> np.ndarray:
    """Read the pulse beside a frame: shares (n,) of at most so many bins, which sum to 1. Raises InputError."""
    taps = load_mat(pulse_file, ["psf"]).get("psf", np.zeros(0))
    good = taps.dtype.kind in "uif" and 1 <= taps.size <= bins and bool(np.isfinite(taps).all())
    require(good and taps.min() >= 0 and taps.sum() > 0, f"{pulse_file}: holds no pulse of 1 to {bins} taps (psf)")
    return taps.ravel() / taps.sum(dtype=np.float64)


def _same_pulse(taps: np.ndarray, other: np.ndarray) -> bool:
    return taps.shape == other.shape and bool(np.abs(taps - other).max() < SAME_PULSE)


def _histogram(contents: Mapping[str, Matrix], path: Path) -> Histogram:
    index = contents["bin" if "bin" in contents else "range_bins"].astype(np.int64)
    height, width = index.shape
    require(contents["spad"].ndim == 2, f"spad has {contents['spad'].ndim} dimensions, expected 2")
    require_memory(12 * math.prod(contents["spad"].shape), f"spad of shape {contents['spad'].shape}")
    dense = np.asarray(contents["spad"].todense() if hasattr(contents["spad"], "todense") else contents["spad"])
    if dense.shape[0] != height * width:
        raise InputError(f"spad has {dense.shape[0]} rows for {height} x {width} pixels")
    counts_only = np.isrealobj(dense) and bool(np.isfinite(dense).all() and (dense >= 0).all())
    if not counts_only or (dense != np.floor(dense)).any() or dense.max(initial=0) > np.iinfo(np.int32).max:
        raise InputError("spad holds values that are no counts")
    counts = dense.reshape(width, height, -1).swapaxes(0, 1).astype(np.int32)
    if "bin_size" in contents:
        sensor = _newer_sensor(contents, counts.shape[2], _pulse_file(path, height, width))
    else:
        preset, bins = PRESETS["iccv2023-train"], counts.shape[2]
        sensor = replace(preset, bins=bins, period_s=bins * preset.bin_width_s)
    signal, sbr = float(contents["photons"].item()), float(contents["SBR"].item())
    if "mean_background_photons" in contents:
        background = float(contents["mean_background_photons"].item())
    else:
        background = signal / sbr if sbr > 0 and math.isfinite(sbr) else 0.0
    known_split = not (math.isnan(signal) and math.isnan(sbr))
    if not known_split:  # all detections, as of measured counts
        signal, background = 0.0, float(counts.sum(dtype=float) / max(1, index.size))
    if "dist" in contents:
        depth = contents["dist"].astype(np.float32)
    else:
        depth = (index * (PUBLISHED_SPEED_OF_LIGHT_M_PER_S * sensor.bin_width_s / 2)).astype(np.float32)
    albedo = contents.get("intensity", np.zeros((height, width)))
    return Histogram(
        counts=np.ascontiguousarray(counts),
        sensor=sensor,
        budget=PhotonBudget(signal, background),
        depth_m=depth,
        mixed=np.zeros((height, width), bool),
        albedo=albedo.astype(np.float16),
        expected_signal=np.full((height, width), signal if known_split else np.nan, np.float32),
        expected_background=np.full((height, width), background if known_split else np.nan, np.float32),
        meta={"model": "poisson", "plan": ["read from a .mat file"], "pile_up": 0.0, "wrapped": 0.0, "dark_share": 0.0}
        | {"layout": "mat"},  # which knows no exposure, dead time or law: those of the sensor are not the recording's
    )
