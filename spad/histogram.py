"""`Histogram`: the photon counts of an image with the sensor and the truth that made it, and its HDF5 file."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from render.transient import ATTRIBUTE, SCHEMA, check_schema
from scenes.errors import InputError
from scenes.files import whole_file
from spad.sensor import PhotonBudget, Sensor

TRUTH = ("depth_m", "mixed", "albedo", "expected_signal", "expected_background")


@dataclass(frozen=True, eq=False)
class Histogram:
    """Photon counts of every pixel and time bin.

    counts               (H, W, T) int32
    sensor, budget       what recorded it
    depth_m              (H, W) float32 truth: radial depth at the pixel centre, NaN where nothing is
    mixed                (H, W) bool: surfaces more than 50 mm apart in the pixel
    albedo               (H, W) float16 truth at the pixel centre
    expected_signal, expected_background   (H, W) float32, detections per pixel and exposure
    meta                 seed, plan, what made the transient: anything JSON holds
    """

    counts: np.ndarray
    sensor: Sensor
    budget: PhotonBudget
    depth_m: np.ndarray
    mixed: np.ndarray
    albedo: np.ndarray
    expected_signal: np.ndarray
    expected_background: np.ndarray
    meta: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.counts.ndim != 3 or self.counts.dtype != np.int32 or self.counts.shape[2] != self.sensor.bins:
            shape = f"{self.counts.dtype}{self.counts.shape}"
            raise InputError(f"histogram: counts are {shape}, expected int32 (H, W, {self.sensor.bins})")
        if self.counts.size and self.counts.min() < 0:
            raise InputError(f"histogram: a bin holds {self.counts.min()} counts")
        for name in TRUTH:
            array = getattr(self, name)
            if array.shape != self.counts.shape[:2]:
                raise InputError(f"histogram: {name} is {array.shape}, expected {self.counts.shape[:2]}")
            array.setflags(write=False)
        self.counts.setflags(write=False)

    def timestamps(self) -> tuple[np.ndarray, np.ndarray]:
        """Sparse form: time bin of every detection (uint16, ascending in a pixel), and (H*W + 1,) int64 offsets."""
        flat = self.counts.reshape(-1, self.sensor.bins)
        pixel, time_bin = np.nonzero(flat)
        stamps = np.repeat(time_bin.astype(np.uint16), flat[pixel, time_bin])
        return stamps, np.concatenate(([0], np.cumsum(flat.sum(axis=1, dtype=np.int64))))

    def sha256(self) -> str:
        """SHA-256 over counts and truth."""
        sha = hashlib.sha256(str(self.counts.shape).encode())
        for array in (self.counts, *(getattr(self, name) for name in TRUTH)):
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()


def counts_from_timestamps(stamps: np.ndarray, offsets: np.ndarray, bins: int) -> np.ndarray:
    """Dense (pixels, T) int32 counts of sparse detections; the inverse of `Histogram.timestamps`."""
    pixels = len(offsets) - 1
    owner = np.repeat(np.arange(pixels), np.diff(offsets))
    return np.bincount(owner * bins + stamps, minlength=pixels * bins).reshape(pixels, bins).astype(np.int32)


def write_histogram(histogram: Histogram, path: Path) -> None:
    """Write HDF5, whole or not at all: timestamps where they are the smaller form, else dense counts."""
    import h5py

    height, width, _ = histogram.counts.shape
    meta = {
        **histogram.meta,
        "kind": "histogram",
        "schema": SCHEMA,
        "sensor": histogram.sensor.to_dict(),
        "budget": histogram.budget.to_dict(),
        "height": height,
        "width": width,
        "sha256": histogram.sha256(),
    }
    packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    with whole_file(path) as beside, h5py.File(beside, "w") as file:
        file.attrs[ATTRIBUTE] = json.dumps(meta, sort_keys=True)
        if int(histogram.counts.sum(dtype=np.int64)) * 2 < histogram.counts.nbytes:
            stamps, offsets = histogram.timestamps()
            file.create_dataset("timestamps", data=stamps, **(packed if len(stamps) else {}))
            file.create_dataset("offsets", data=offsets, **packed)
        else:
            file.create_dataset("counts", data=histogram.counts, **packed)
        for name in TRUTH:
            file.create_dataset(name, data=getattr(histogram, name), **packed)


def read_histogram(path: Path) -> Histogram:
    """Read a histogram and check its hash.

    Raises InputError in one line for a missing, foreign, truncated or altered file, or one of a newer schema.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: file not found")
    try:
        with h5py.File(path, "r") as file:
            meta = json.loads(file.attrs[ATTRIBUTE])
            data = {name: dataset[()] for name, dataset in file.items()}
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a readable histogram of scene2spad ({reason})") from None
    check_schema(path, meta, "histogram")
    try:
        return _assemble(meta, data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, IndexError, MemoryError) as error:
        raise InputError(f"{path}: damaged, {type(error).__name__} {' '.join(str(error).split())[:120]}") from None


def _assemble(meta: dict, data: dict[str, np.ndarray]) -> Histogram:
    if not (set(TRUTH) <= set(data) and ("counts" in data or {"timestamps", "offsets"} <= set(data))):
        raise InputError(f"datasets are missing, there are {', '.join(sorted(data)) or 'none'}")
    sensor, budget = Sensor.from_dict(meta["sensor"]), PhotonBudget(**meta["budget"])
    shape = (meta["height"], meta["width"], sensor.bins)
    counts = (
        data["counts"] if "counts" in data else counts_from_timestamps(data["timestamps"], data["offsets"], shape[2])
    )
    own = ("kind", "schema", "height", "width", "sha256", "sensor", "budget")
    histogram = Histogram(
        counts=counts.reshape(shape),
        sensor=sensor,
        budget=budget,
        **{name: data[name] for name in TRUTH},
        meta={key: value for key, value in meta.items() if key not in own},
    )
    if histogram.sha256() != meta["sha256"]:
        raise InputError("contents do not match their SHA-256: the file is damaged or was altered")
    return histogram
