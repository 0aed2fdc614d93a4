"""The `.mat` files of the Lindell / Peng / ICCV 2023 family: their old frames read, the newer layout written and read.

Indices are MATLAB's, from 1; images are (row, column); `spad` is a sparse (rows x columns, bins) matrix whose pixels
run down the columns first. `bin` is the bin that the pulse's peak lies in. Depth in our files is exact in `dist`; the
published `bin` is round(2 d / (c Delta)), with c = 3e8 m/s.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError, require
from scenes.files import whole_file
from spad.depth import estimate_depth
from spad.histogram import Histogram
from spad.rgbd import PUBLISHED_SPEED_OF_LIGHT_M_PER_S
from spad.sensor import PhotonBudget, Sensor, sensor_by_name
from spad.template import binned_pulse

RATES_EPSILON = 1e-8
ESTIMATES = {"argmax": "argmax", "lmf": "lmf-published", "zncc": "correlation"}


def write_mat(histogram: Histogram, path: Path) -> Path:
    """Write a histogram as the newer published frame, and its pulse beside it; returns the pulse file's path.

    rates (H, W, T) is the signal's share of the expected counts: S times the binned pulse at the true depth, min-max
    normalised in every pixel, 0 where there is no depth or no signal; rates_norm_params undoes that. Estimates are
    ours, in whole bins from 1 without the published offset of one; `bin` is 0 where nothing is. Raises InputError in
    one line where the file cannot be written, and for sensors whose bins do not cover the period.
    """
    import scipy.io

    path, sensor = Path(path), histogram.sensor
    require(path.suffix == ".mat", f"{path}: the output must end in .mat")
    require(sensor.bins == sensor.bins_per_period, f"{path}: the layout needs bins that cover the period")
    height, width, bins = histogram.counts.shape
    size = 8 * height * width * bins
    require(size < 2**31, f"{path}: {height} x {width} x {bins} rates take {size} bytes, a version 5 file holds 2^31")
    contents = _frame(histogram)
    with whole_file(path) as beside:
        scipy.io.savemat(beside, contents, do_compression=True)
    pulse = path.with_name(f"PSF_used_for_simulation_nr-{height}_nc-{width}.mat")
    taps = _centred_taps(sensor)
    psf = {"PSF_img": np.broadcast_to(taps, (height, width, len(taps))), "psf": taps, "pulse_len": float(len(taps))}
    with whole_file(pulse) as beside:
        scipy.io.savemat(beside, psf, do_compression=True)
    return pulse


def _frame(histogram: Histogram) -> dict:
    sensor, depth = histogram.sensor, histogram.depth_m.astype(np.float64)
    rates, offset, scaling = _normalised_rates(histogram)
    known = np.isfinite(depth)
    fine = np.where(known, np.remainder(depth, sensor.range_m) / sensor.bin_depth_m + 0.5, 0)
    index = np.where(known, np.floor(fine + 0.5), 0).astype(np.uint16)
    counts = torch.from_numpy(histogram.counts)
    estimates = {
        f"est_range_bins_{name}": _whole_bins(estimate_depth(counts, sensor, method).numpy(), sensor)
        for name, method in ESTIMATES.items()
    }
    budget, albedo = histogram.budget, histogram.albedo.astype(np.float64)
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
        "SBR": budget.sbr,
        "mean_signal_photons": budget.signal,
        "photons": budget.signal,
        "mean_background_photons": budget.background,
        "bin_size": sensor.bin_width_s,
        "dist": depth,
    }


def _normalised_rates(histogram: Histogram) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each pixel's (rate - min) / (max - min + 1e-8), with min and 1 / (max - min + 1e-8)."""
    depth, signal = histogram.depth_m.astype(np.float64), histogram.expected_signal.astype(np.float64)
    known = np.isfinite(depth)
    arrival = torch.from_numpy(np.where(known, 2 * depth / SPEED_OF_LIGHT_M_PER_S, 0))
    rows = [binned_pulse(row, histogram.sensor).numpy() for row in arrival]
    rates = np.stack(rows) * np.where(known, signal, 0)[..., None]
    low, high = rates.min(axis=-1), rates.max(axis=-1)
    scaling = 1 / (high - low + RATES_EPSILON)
    return (rates - low[..., None]) * scaling[..., None], low, scaling


def _whole_bins(depth_m: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Bin from 1 that a depth lies in, 0 for none, (H, W) uint16."""
    inside = np.floor(np.nan_to_num(depth_m.astype(np.float64)) / sensor.bin_depth_m) % sensor.bins
    return np.where(np.isnan(depth_m), 0, inside + 1).astype(np.uint16)


def _sparse(counts: np.ndarray) -> object:
    import scipy.sparse

    height, width, bins = counts.shape
    columns_first = counts.swapaxes(0, 1).reshape(width * height, bins)
    return scipy.sparse.csc_matrix(columns_first.astype(np.float64))


def _centred_taps(sensor: Sensor) -> np.ndarray:
    """The binned pulse that arrives in a bin's centre, as far as it holds anything, (L,) float64."""
    middle = torch.tensor((sensor.bins // 2 + 0.5) * sensor.bin_width_s, dtype=torch.float64)
    pulse = binned_pulse(middle, sensor).numpy()
    held = np.flatnonzero(pulse > 1e-9)
    return pulse[held[0] : held[-1] + 1]


def read_mat(path: Path) -> Histogram:
    """Read a frame of either layout.

    The old one (`photons`, `SBR`, no `bin_size`) is that of the training set: its sensor is `iccv2023-train`, and depth
    that of `bin` by the published rounding, bin x c Delta / 2 with c = 3e8 m/s. Others say their bin width, and get the
    reference pulse. Expected signal and background are the frame's means: files of this family hold no maps.

    Raises InputError in one line for a file that is none.
    """
    import scipy.io

    path = Path(path)
    require(path.is_file(), f"{path}: file not found")
    try:
        contents = scipy.io.loadmat(path)
    except Exception as error:  # scipy raises bare and varied exceptions on damage
        raise InputError(f"{path}: not a readable .mat file ({' '.join(str(error).split())[:80]})") from None
    missing = {"spad", "SBR", "photons"} - {*contents} | (set() if {"bin", "range_bins"} & {*contents} else {"bin"})
    require(not missing, f"{path}: {', '.join(sorted(missing))} are missing, there are {', '.join(sorted(contents))}")
    try:
        return _histogram(contents)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: not a frame of this family ({' '.join(str(error).split())[:80]})") from None


def _histogram(contents: dict) -> Histogram:
    index = contents["bin" if "bin" in contents else "range_bins"].astype(np.int64)
    height, width = index.shape
    dense = np.asarray(contents["spad"].todense() if hasattr(contents["spad"], "todense") else contents["spad"])
    if dense.shape[0] != height * width:
        raise InputError(f"spad has {dense.shape[0]} rows for {height} x {width} pixels")
    if (dense < 0).any() or (dense != np.floor(dense)).any():
        raise InputError("spad holds values that are no counts")
    counts = dense.reshape(width, height, -1).swapaxes(0, 1).astype(np.int32)
    if "bin_size" in contents:
        sensor = Sensor(name="mat", bins=counts.shape[2], bin_width_s=float(contents["bin_size"].item()))
    else:
        sensor = replace(sensor_by_name("iccv2023-train"), bins=counts.shape[2], period_s=None)
    signal, sbr = float(contents["photons"].item()), float(contents["SBR"].item())
    if "mean_background_photons" in contents:
        background = float(contents["mean_background_photons"].item())
    else:
        background = signal / sbr if sbr > 0 and math.isfinite(sbr) else 0.0
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
        expected_signal=np.full((height, width), signal, np.float32),
        expected_background=np.full((height, width), background, np.float32),
        meta={"model": "poisson", "plan": ["read from a .mat file"], "pile_up": 0.0, "wrapped": 0.0, "dark_share": 0.0},
    )
