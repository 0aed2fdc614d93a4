"""Dense export `(H, W, T)` as .npz or HDF5, in the layouts that transient-imaging codes read.

.npz  `data` (H, W, T), `tofs` (T,) bin centres [s], `bin_width_s`, `depth_m` and what else is known, each an array
.h5   the same, each with its unit and a description as attributes.
      mitransient's arrays are (H, W, T) too; y-tal's captures hold H of shape (T, H, W), which `layout="thw"` gives
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Literal

import numpy as np

from render.transient import Transient
from scenes.errors import InputError
from scenes.files import whole_file
from scenes.io.hdf5 import HDF5_SUFFIXES
from scenes.limits import require_memory
from spad.detection.flux import signal_per_bin
from spad.formats.histogram import NOTES, Histogram
from spad.sensor.model import Sensor

Layout = Literal["hwt", "thw"]
BLOCK = 1024  # pixels binned at once
UNITS = {
    "data": ("detections per bin", "photon counts of every pixel and time bin"),
    "tofs": ("s", "centre of every time bin, from the laser's emission on"),
    **{name: NOTES[name] for name in ("depth_m", "expected_signal", "expected_background", "albedo")},
    "bin_width_s": ("s", "width of a time bin"),
}
RADIANCE = ("1/(m^2 sr)", "radiance that arrives in the bin, per joule of the pulse")


def dense_counts(histogram: Histogram) -> dict[str, np.ndarray]:
    """Return the arrays that a dense export of counts holds, by name."""
    sensor = histogram.sensor
    return {
        "data": histogram.counts,
        "tofs": (np.arange(sensor.bins) + 0.5) * sensor.bin_width_s,
        "bin_width_s": np.array(sensor.bin_width_s),
        "depth_m": histogram.depth_m,
        "albedo": histogram.albedo.astype(np.float32),
        "expected_signal": histogram.expected_signal,
        "expected_background": histogram.expected_background,
    }


def dense_radiance(transient: Transient, sensor: Sensor) -> dict[str, np.ndarray]:
    """Return radiance (H, W, T) float32 in a sensor's bins after its pulse, with the arrays beside it."""
    pixels = transient.height * transient.width
    require_memory(4 * pixels * sensor.bins, f"a dense transient of {pixels} pixels and {sensor.bins} bins")
    data = np.empty((pixels, sensor.bins), np.float32)
    for start in range(0, pixels, BLOCK):
        part = slice(start, min(start + BLOCK, pixels))
        data[part] = signal_per_bin(transient, sensor, part)[0].numpy()
    return {
        "data": data.reshape(transient.height, transient.width, sensor.bins),
        "tofs": (np.arange(sensor.bins) + 0.5) * sensor.bin_width_s,
        "bin_width_s": np.array(sensor.bin_width_s),
        "depth_m": transient.depth_m,
        "albedo": transient.albedo.astype(np.float32),
    }


def write_dense(arrays: dict[str, np.ndarray], path: Path, *, layout: Layout = "hwt") -> Path:
    """Write the arrays as .npz or .h5, whole or not at all. Raises InputError for another ending."""
    data = arrays["data"] if layout == "hwt" else np.moveaxis(arrays["data"], 2, 0)
    arrays = arrays | {"data": np.ascontiguousarray(data)}
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with whole_file(path) as beside, beside.open("wb") as file:
            np.savez_compressed(file, allow_pickle=True, **arrays)
        return path
    if suffix not in HDF5_SUFFIXES:
        raise InputError(f"{path}: a dense export ends in .npz or .h5")
    with whole_file(path) as beside:
        beside.write_bytes(_hdf5(arrays, layout))
    return path


def _hdf5(arrays: dict[str, np.ndarray], layout: Layout) -> bytes:
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.attrs["axes"] = "row, column, time" if layout == "hwt" else "time, row, column"
        for name, values in arrays.items():
            packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 1} if values.ndim else {}
            unit, note = RADIANCE if name == "data" and values.dtype.kind == "f" else UNITS[name]
            dataset = file.create_dataset(name, data=values, **packed)
            dataset.attrs["unit"], dataset.attrs["description"] = unit, note
    return buffer.getvalue()
