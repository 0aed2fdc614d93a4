"""Read dense exports (.npz, .h5) that `spad.formats.dense` wrote: their arrays, and the histogram of their counts."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import ZipFile

import numpy as np

from scenes.errors import InputError, require
from scenes.files import npy_array
from scenes.io.hdf5 import open_checked, read_dataset
from scenes.io.inputs import parse_json, regular_file
from scenes.json_types import JsonObject
from scenes.limits import require_memory
from spad.formats.dense import AXES, UNITS
from spad.measurements.histogram import TRUTH, Histogram
from spad.sensor.model import PhotonBudget, Sensor

if TYPE_CHECKING:
    import h5py

TEXT = ("axes", "units", "sensor", "meta")  # the others are numbers
MAX_TEXT_BYTES = 1 << 28
BY_HAND = (
    "; in Python scene2spad.Histogram.from_counts takes its counts (H, W, T) with their sensor, and "
    "scene2spad.write_histogram makes the file"
)


def read_dense_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the numbers and the texts of a dense export, each by name; `axes` is among the texts.

    Raises InputError in one line that names the file, for one that is not there, damaged, or holds other things.
    """
    path = regular_file(Path(path), "dense array")
    try:
        if path.suffix.lower() == ".npz":
            return _from_npz(path)
        with open_checked(path) as file:
            text = {name: _text(file[name], name) for name in TEXT if name in file}
            axes = file.attrs.get("axes")
            text |= {"axes": axes} if isinstance(axes, str) else {}
            return {name: read_dataset(file, name) for name in UNITS if name in file and name not in TEXT}, text
    except InputError as error:
        raise InputError(f"{path}: no dense array that `export` wrote: {error}") from None
    except Exception as error:  # what h5py and zipfile raise for damaged files is of many types
        words = " ".join(str(error).split())[:80]
        raise InputError(f"{path}: not a readable {path.suffix.lower()} file ({words})") from None


def _from_npz(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    numbers, text = {}, {}
    with ZipFile(path) as archive:
        entries = archive.infolist()
        require_memory(2 * sum(entry.file_size for entry in entries), "its arrays")
        for entry in entries:
            name = entry.filename.removesuffix(".npy")
            with archive.open(entry) as file:
                values = npy_array(file, entry.file_size, "U" if name in TEXT else "biuf", name)
            if name in TEXT:
                text[name] = str(values[()])
            else:
                numbers[name] = values
    return numbers, text


def _text(dataset: h5py.Dataset, name: str) -> str:
    import h5py

    plain = isinstance(dataset, h5py.Dataset) and dataset.dtype.kind == "S" and dataset.shape == ()
    require(plain and dataset.dtype.itemsize <= MAX_TEXT_BYTES, f"{name} holds no text")
    return bytes(dataset[()]).decode("ascii", "replace")


def read_dense(path: Path) -> Histogram:
    """Read the counts of a dense export (.npz, .h5) as the histogram that they were written from.

    Counts, truth, sensor, budget and metadata are those of the histogram. Raises InputError in one line for a file of
    light, which has to be sensed; for one that does not say its sensor, as those of other programs and of older
    versions, with the way round; and for a file that is missing, foreign or damaged.

    Examples
    --------
    >>> import tempfile
    >>> import scene2spad as s2s
    >>> histogram = s2s.sense(s2s.render("plane", width=4, height=3, bounces=1), signal=20, background=5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = s2s.write_dense(s2s.dense(histogram), folder + "/plane.npz")
    ...     again = s2s.read_dense(path)
    >>> bool((again.counts == histogram.counts).all()), again.budget == histogram.budget
    (True, True)
    """
    require(isinstance(path, str | os.PathLike), f"read_dense: expected a path, not {type(path).__name__}")
    path = Path(path)
    arrays, text = read_dense_arrays(path)
    try:
        return _histogram(arrays, text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, MemoryError, OverflowError) as error:
        words = " ".join(str(error).split())[:80]
        raise InputError(f"{path}: damaged, its sensor or meta do not fit ({type(error).__name__} {words})") from None


def _histogram(arrays: dict[str, np.ndarray], text: dict[str, str]) -> Histogram:
    require("data" in arrays, f"is of kind dense, but holds no data{BY_HAND}")
    counts = arrays["data"]
    light = "is of kind dense and holds light, expected counts; sense the transient: `scene2spad sense`"
    require(counts.dtype.kind in "iu", light)
    missing = [name for name in ("sensor", "meta", "axes") if name not in text]
    missing += [name for name in TRUTH if name not in arrays]
    held = f"is of kind dense and does not hold {', '.join(missing)}, expected a histogram"
    require(not missing, f"{held}{BY_HAND}")
    require(text["axes"] in AXES.values(), f"axes {text['axes'][:40]!r}, expected one of: {'; '.join(AXES.values())}")
    sensor, meta = Sensor.from_dict(_json(text, "sensor")), _json(text, "meta")
    if text["axes"] == AXES["thw"] and counts.ndim == 3:
        counts = np.moveaxis(counts, 0, 2)
    width_s = float(arrays.get("bin_width_s", sensor.bin_width_s))
    fits = counts.ndim == 3 and counts.shape[2] == sensor.bins and math.isclose(width_s, sensor.bin_width_s)
    what = f"data of shape {counts.shape} and bins of {width_s:g} s"
    require(fits, f"{what} do not fit its sensor of {sensor.bins} bins of {sensor.bin_width_s:g} s")
    known = {name: arrays[name] for name in TRUTH}
    budget = PhotonBudget(**meta.pop("budget"))
    whole = np.ascontiguousarray(counts, np.int32)
    require(bool((whole == counts).all()), "holds counts above 2^31 - 1")
    return Histogram(whole, sensor, budget, **known, meta=meta)


def _json(text: dict[str, str], name: str) -> JsonObject:
    found = parse_json(text[name])
    require(isinstance(found, dict), f"{name} is no JSON object")
    return found  # type: ignore[return-value]
