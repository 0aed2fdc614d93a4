"""From what `export` wrote, dense arrays and point clouds, to what its page shows."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZipFile

import numpy as np

from scene2spad.viewer.content import Content, Cube, Layer, grey_layer
from scene2spad.viewer.sources import depth_layer
from scenes.errors import InputError, require
from scenes.io.hdf5 import open_checked
from scenes.io.inputs import read_bytes
from scenes.io.mesh_formats.ply import read_ply
from spad.formats.dense import AXES
from spad.formats.dense_reader import read_dense_arrays

MAPS = {"expected_signal": "photons", "expected_background": "photons", "albedo": ""}
COLUMNS = [(name, "<f4") for name in ("x", "y", "z", "intensity", "confidence")]
COLUMNS += [(name, "u1") for name in ("red", "green", "blue")]
DENSE = ("data", "tofs", "depth_m")  # arrays that every dense export holds
HEADER = "property float x property float y property float z property float intensity property float confidence"


def is_dense(path: Path) -> bool:
    """Tell whether a file (.npz, .h5) holds the arrays of a dense export, by their names alone."""
    if path.suffix.lower() == ".npz":
        try:
            with ZipFile(path) as file:
                return {f"{name}.npy" for name in DENSE} <= {*file.namelist()}
        except Exception:  # what zipfile raises for damaged directories is of many types
            return False
    try:
        with open_checked(path) as file:
            return {*DENSE} <= {*file}
    except (InputError, OSError):
        return False


def is_cloud(path: Path) -> bool:
    """Tell whether a file (.ply) has the columns of a point cloud that `export` writes."""
    with path.open("rb") as file:
        return HEADER in _columns(file.read(1024))


def _columns(content: bytes) -> str:
    """Return the header of a point cloud in one line."""
    return " ".join(content.partition(b"end_header\n")[0].decode("latin-1").split())


def dense_content(path: Path) -> Content:
    """Show a dense export (.npz, .h5): its images, and the counts or the light of every pixel over time.

    Raises InputError for arrays that do not belong together.
    """
    arrays, _ = dense_arrays(path)
    data, time_s, depth_m = arrays["data"], arrays["tofs"], arrays["depth_m"]
    counted = data.dtype.kind in "iu"
    unit = "detections" if counted else "1/(m² sr)"
    layers = [grey_layer("sum over time", unit, data.sum(axis=2, dtype=np.float64))]
    if np.isfinite(depth_m).any():
        layers.append(depth_layer("true depth", depth_m))
    layers += [_map(path, name, arrays[name], depth_m.shape) for name in MAPS if name in arrays]
    step_s = _step_s(arrays)
    cube = Cube("detections" if counted else "light", f"{unit} per bin", np.ascontiguousarray(data),
                1e9 * (float(time_s[0]) - step_s / 2), 1e9 * step_s, "bars" if counted else "line")  # fmt: skip
    facts = {"kind": "dense array", "pixels": f"{depth_m.shape[0]} rows x {depth_m.shape[1]} columns"}
    facts["bins"] = f"{len(time_s)} of {1e12 * step_s:.4g} ps"
    return Content(path.name, facts, tuple(layers), (cube,))


def _step_s(arrays: dict[str, np.ndarray]) -> float:
    """Return the width of a time bin [s]. The only bin of a sensor begins with the laser's emission, so that its centre
    is half its width."""
    time_s = arrays["tofs"]
    return float(time_s[1] - time_s[0] if len(time_s) > 1 else 2 * time_s[0])


def dense_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the arrays of an export, whose `data` has time last, and its texts, each by name.

    Raises InputError for arrays that are missing or do not belong together.
    """
    arrays, text = read_dense_arrays(path)
    missing = [name for name in DENSE if name not in arrays]
    require(not missing, f"{path}: no dense array that `export` wrote: holds no {', '.join(missing)}")
    data, time_s, depth_m = arrays["data"], arrays["tofs"], arrays["depth_m"]
    shaped = data.ndim == 3 and depth_m.ndim == 2 and time_s.ndim == 1 and len(time_s) > 0
    if shaped and text.get("axes") == AXES["thw"]:
        data = np.moveaxis(data, 0, 2)
    require(shaped, f"{path}: data {data.shape}, tofs {time_s.shape} and depth_m {depth_m.shape} are no dense export")
    if data.shape == (len(time_s), *depth_m.shape) and data.shape != (*depth_m.shape, len(time_s)):
        data = np.moveaxis(data, 0, 2)
    fits = data.shape == (*depth_m.shape, len(time_s))
    require(fits, f"{path}: data of shape {data.shape} for {depth_m.shape} pixels and {len(time_s)} times")
    known = bool(np.isfinite(data).all()) and bool(np.isfinite(time_s).all()) and bool((np.diff(time_s) > 0).all())
    known = known and (len(time_s) > 1 or time_s[0] > 0)
    require(
        known and float(data.min(initial=0)) >= 0, f"{path}: holds negative or infinite numbers, or times that fall"
    )
    return arrays | {"data": data}, text


def _map(path: Path, name: str, values: np.ndarray, shape: tuple[int, ...]) -> Layer:
    require(values.shape == shape, f"{path}: {name} of shape {values.shape}, expected {shape}")
    return grey_layer(name.replace("_", " "), MAPS[name], values)


def cloud_content(path: Path) -> Content:
    """Show a point cloud (.ply) that `export` wrote. Raises InputError for a file of other columns."""
    content = read_bytes(path, "point cloud")
    known = HEADER in _columns(content)
    require(known, f"{path}: no point cloud that `export` wrote (x y z intensity confidence); render a mesh")
    try:
        read_ply(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    rows = np.frombuffer(content.partition(b"end_header\n")[2], np.dtype(COLUMNS))
    points = np.stack([rows[axis] for axis in "xyz"], axis=1)
    distance = np.linalg.norm(points, axis=1)
    facts = {"kind": "point cloud", "points": f"{len(rows):,}"}
    if len(rows):
        facts["distance"] = f"{distance.min():.4g} to {distance.max():.4g} m"
        facts["confidence"] = f"{rows['confidence'].min():.3g} to {rows['confidence'].max():.3g}"
    return Content(path.name, facts, points=points.astype(np.float32), point_value=rows["intensity"].astype(float))
