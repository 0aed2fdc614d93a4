"""Dense export `(H, W, T)` as .npz or HDF5, in the layouts that transient-imaging codes read.

.npz  `data` (H, W, T), `tofs` (T,) bin centres [s], `bin_width_s`, `depth_m` and what else is known, each an array;
      `axes` and `units` say in text how `data` lies and what all are in
.h5   the same, each with its unit and a description as attributes; `axes` is one of the file.
      mitransient's arrays are (H, W, T) too; y-tal's captures hold H of shape (T, H, W), which `layout="thw"` gives

`sensor` is the JSON of the sensor in whose bins the data are, beside counts `meta` that of what a histogram knows of
itself: `dense_reader` makes the histogram of them again.
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from render.transient import Transient
from scenes.errors import InputError, require, require_choice, require_kind
from scenes.files import whole_file
from scenes.io.hdf5 import HDF5_SUFFIXES, USER_BLOCK, add_checksum
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from spad.measurements.histogram import NOTES, Histogram
from spad.sensor.arrival import record_line, warning_of_most, wrap_line
from spad.sensor.files import pixel_sensor
from spad.sensor.model import Sensor

Layout = Literal["hwt", "thw"]
AXES: dict[str, str] = {"hwt": "row, column, time", "thw": "time, row, column"}
BLOCK = 1024  # pixels binned at once
UNITS = {
    "data": ("detections per bin", "photon counts of every pixel and time bin"),
    "tofs": ("s", "centre of every time bin, from the laser's emission on, within one period of the laser"),
    **{name: NOTES[name] for name in ("depth_m", "expected_signal", "expected_background", "albedo", "mixed")},
    "bin_width_s": ("s", "width of a time bin"),
    "period_s": ("s", "the laser's period: light that arrives later is in the bins of its time less whole periods"),
    "wrapped": ("1", "fraction of the light that arrives later than one period after its emission"),
    "unrecorded": ("1", "fraction of the light that arrives in the part of the period that has no bins"),
    "ambient": ("W/(m^2 sr nm)", "steady spectral radiance of the pixel, which is not in the data"),
    "sensor": ("text", "JSON of the sensor in whose bins the data are"),
    "meta": ("text", "JSON of the photon budget, and of what made the counts"),
}
RADIANCE = ("1/(m^2 sr)", "radiance that arrives in the bin, per joule of the pulse")


def dense(seen: Transient | Histogram, sensor: Sensor | str | Path | None = None) -> dict[str, np.ndarray]:
    """Return a transient or a histogram as dense arrays, by name.

    Parameters
    ----------
    seen : Transient or Histogram
        A transient is put into a sensor's bins, after its pulse.
    sensor : Sensor, str or Path, optional
        The sensor of a transient, as `sense` takes it (default: reference). A histogram has its own.

    Returns
    -------
    dict
        ``data`` (H, W, T): counts, or radiance per joule of the pulse [1/(m^2 sr)], float32. Beside it are ``tofs``
        (T,), bin centres [s], ``depth_m`` (H, W), ``bin_width_s``, ``period_s`` and what else is known. ``wrapped`` is
        the fraction of the light that arrives later than one period after its emission, and is in the bins of its
        time less whole periods. ``ambient`` (H, W) is there where a transient has some [W/(m^2 sr nm)]. ``sensor`` and
        ``meta`` are JSON. Of a histogram ``data`` and the images are its own arrays, which cannot be written to: change
        a copy.

    Raises
    ------
    InputError
        For what is neither, a sensor beside a histogram, one of zones or, beside a transient, with converters (their
        bins are unequal, and differ from pixel to pixel), and arrays beyond the memory limit.

    Examples
    --------
    >>> import scene2spad as s2s
    >>> arrays = s2s.dense(s2s.render("plane", width=8, height=6, bounces=1), "reference")
    >>> arrays["data"].shape, float(arrays["wrapped"])
    ((6, 8, 1024), 0.0)
    """
    if isinstance(seen, Histogram):
        require(sensor is None, "dense: a histogram has a sensor of its own")
        return dense_counts(seen)
    called = f"dense: expected a Transient or a Histogram, not {type(seen).__name__}"
    require(isinstance(seen, Transient), called)
    return dense_radiance(seen, pixel_sensor("reference" if sensor is None else sensor))


def dense_counts(histogram: Histogram) -> dict[str, np.ndarray]:
    """Return the arrays that a dense export of counts holds, by name; the histogram's own as views to read from."""
    arrays = {
        "data": _read_only(histogram.counts),
        **_times(histogram.sensor),
        "depth_m": _read_only(histogram.depth_m),
        "albedo": histogram.albedo.astype(np.float32),
        "mixed": _read_only(histogram.mixed),
        "expected_signal": _read_only(histogram.expected_signal),
        "expected_background": _read_only(histogram.expected_background),
        "meta": _json({**histogram.meta, "budget": histogram.budget.to_dict()}),
    }
    if histogram.signal_known and "wrapped" in histogram.meta:
        arrays["wrapped"] = np.array(float(histogram.meta["wrapped"]))
    return arrays


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def dense_radiance(transient: Transient, sensor: Sensor) -> dict[str, np.ndarray]:
    """Return radiance (H, W, T) float32 in a sensor's bins after its pulse, with the arrays beside it.

    Raises InputError for a sensor with converters, and for arrays beyond the memory limit.
    """
    from spad.detection.flux import signal_per_bin  # which imports torch

    sensor.check_equal_bins("a dense transient")
    pixels = transient.height * transient.width
    require_memory(4 * pixels * sensor.bins, f"a dense transient of {pixels} pixels and {sensor.bins} bins")
    data, wrapped, recorded = np.empty((pixels, sensor.bins), np.float32), 0.0, 0.0
    for start in range(0, pixels, BLOCK):
        part = slice(start, min(start + BLOCK, pixels))
        signal, late = signal_per_bin(transient, sensor, part)
        wrapped, recorded = wrapped + late, recorded + float(signal.sum())
        data[part] = signal.numpy()
    total = float(transient.radiance.sum(dtype=np.float64))
    arrays = {
        "data": data.reshape(transient.height, transient.width, sensor.bins),
        **_times(sensor),
        "depth_m": transient.depth_m,
        "albedo": transient.albedo.astype(np.float32),
        "wrapped": np.array(min(1.0, wrapped / total) if total > 0 else 0.0),
    }
    if sensor.bins < sensor.bins_per_period:
        arrays["unrecorded"] = np.array(max(0.0, 1 - recorded / total) if total > 0 else 0.0)
    return arrays | ({"ambient": transient.ambient} if transient.ambient.any() else {})


def _times(sensor: Sensor) -> dict[str, np.ndarray]:
    """Return the sensor, its bins and its period."""
    return {
        "tofs": (np.arange(sensor.bins) + 0.5) * sensor.bin_width_s,
        "bin_width_s": np.array(sensor.bin_width_s),
        "period_s": np.array(sensor.bins_per_period * sensor.bin_width_s),
        "sensor": _json(sensor.to_dict()),
    }


def _json(values: JsonObject) -> np.ndarray:
    """Return JSON as an array of one text. Raises InputError for what JSON cannot hold."""
    try:
        return np.array(json.dumps(values))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"dense: the metadata hold what JSON cannot: {error}") from None


def arrival_reasons(arrays: dict[str, np.ndarray], sensor: Sensor) -> list[str]:
    """Return one line each, as `sense` has them, for light that wraps and for light that finds no bins; a warning
    where it is most of it."""
    wrapped, unrecorded = (float(arrays.get(name, 0.0)) for name in ("wrapped", "unrecorded"))
    wrap = warning_of_most(wrap_line(wrapped, sensor), wrapped) if wrapped > 0 else None
    return [line for line in (wrap, record_line(unrecorded, sensor)) if line is not None]


def write_dense(arrays: dict[str, np.ndarray], path: Path, *, layout: Layout = "hwt") -> Path:
    """Write the arrays of `dense` as .npz or HDF5, whole or not at all.

    Parameters
    ----------
    arrays : dict
        What `dense` gives, ``data`` (H, W, T).
    path : Path
        The file; its ending, .npz or .h5, is the format.
    layout : str
        hwt for ``data`` of rows, columns and time, or thw for time first. The file's ``axes`` says which.

    Returns
    -------
    Path
        The file. `read_dense` reads counts of it as a histogram again.

    Raises
    ------
    InputError
        For another ending or layout, arrays that are none of `dense`, and where the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import scene2spad as s2s
    >>> histogram = s2s.sense(s2s.render("plane", width=8, height=6, bounces=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = s2s.write_dense(s2s.dense(histogram), folder + "/counts.npz")
    ...     s2s.read_dense(path).sha256() == histogram.sha256()
    True
    """
    require(isinstance(path, str | os.PathLike), f"write_dense: expected a path, not {type(path).__name__}")
    path = Path(path)
    require_choice(layout, AXES, f"{path}: layout")
    require_kind(arrays, dict, "write_dense", " of `dense`")
    unknown = sorted({*map(str, arrays)} - {*UNITS})
    require(not unknown, f"{path}: {', '.join(unknown)[:80]} is no array of `dense`")
    require("data" in arrays and np.ndim(arrays["data"]) == 3, f"{path}: expected data (H, W, T) of `dense`")
    suffix = path.suffix.lower()
    require(suffix in (".npz", *HDF5_SUFFIXES), f"{path}: a dense export ends in .npz or .h5")
    data = arrays["data"] if layout == "hwt" else np.moveaxis(arrays["data"], 2, 0)
    arrays = {name: np.asarray(values) for name, values in (arrays | {"data": np.ascontiguousarray(data)}).items()}
    with whole_file(path) as beside:
        if suffix == ".npz":
            units = {name: _note(name, values)[0] for name, values in arrays.items()}
            text = {"axes": np.array(AXES[layout]), "units": np.array(json.dumps(units))}
            with beside.open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **arrays, **text)
        else:
            beside.write_bytes(_hdf5(arrays, layout))
            add_checksum(beside)
    return path


def _note(name: str, values: np.ndarray) -> tuple[str, str]:
    """Return the unit and the description of an array."""
    return RADIANCE if name == "data" and values.dtype.kind == "f" else UNITS[name]


def _hdf5(arrays: dict[str, np.ndarray], layout: Layout) -> bytes:
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=USER_BLOCK) as file:
        file.attrs["axes"] = AXES[layout]
        for name, values in arrays.items():
            packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 1} if values.ndim else {}
            stored = values.astype("S") if values.dtype.kind == "U" else values
            dataset = file.create_dataset(name, data=stored, **packed)
            dataset.attrs["unit"], dataset.attrs["description"] = _note(name, values)
    return buffer.getvalue()
