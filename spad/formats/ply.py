"""Point clouds: points in the camera's frame, and binary PLY with intensity and confidence in [0, 1]."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from render.transient import Transient
from scenes.errors import InputError, require
from scenes.files import whole_file
from scenes.json_types import JsonObject
from spad.estimators.bistatic import pixel_directions, pointing_of
from spad.measurements.histogram import Histogram


def points(seen: Transient | Histogram, depth_m: np.ndarray | None = None) -> np.ndarray:
    """Return the point that each pixel sees, in the camera's frame: x right, y down, z forward.

    Parameters
    ----------
    seen : Transient or Histogram
        What tells where the pixels look.
    depth_m : numpy.ndarray, optional
        Depth (H, W) [m], 0 or more, as `estimate_depth` gives it (default: the true depth). NaN, infinite and masked
        ones are none.

    Returns
    -------
    numpy.ndarray
        Points (H, W, 3) [m], float64; NaN where no depth is.

    Raises
    ------
    InputError
        For depths of another size or below 0, and where nothing tells where the pixels look, as of measured counts.

    Examples
    --------
    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> found = s2s.points(s2s.render("plane", width=8, height=6, bounces=1))
    >>> found.shape, bool(np.allclose(found[..., 2], 3.0))
    ((6, 8, 3), True)
    """
    called = f"points: expected a Transient or a Histogram, not {type(seen).__name__}"
    require(isinstance(seen, Transient | Histogram), called)
    depth = np.ma.asarray(seen.depth_m if depth_m is None else depth_m)
    size = f"points: depth_m is {depth.dtype}{depth.shape}, expected numbers {seen.depth_m.shape}"
    require(depth.dtype.kind in "iuf" and depth.shape == seen.depth_m.shape, size)
    metres = np.ma.filled(depth.astype(np.float64), np.nan)
    least = float(metres.min(initial=0.0, where=metres < 0))
    require(least >= 0, f"points: depth_m: a depth of {least:g} m, expected 0 or more, or none (NaN)")
    metres[np.isinf(metres)] = np.nan
    try:
        return points_of(metres, pointing_of(seen.meta) if isinstance(seen, Histogram) else seen.meta)
    except InputError as error:
        raise InputError(f"points: {error}") from None


def points_of(depth_m: np.ndarray, pointing: JsonObject) -> np.ndarray:
    """Return points (H, W, 3) [m] of depths (H, W) [m], given what tells where the pixels look (`pointing_of`).

    Raises InputError where nothing does.
    """
    directions = pixel_directions(pointing, depth_m.shape)
    if directions is None:
        raise InputError(f"{_why_no_points(depth_m, pointing.get('camera'))}, so there are no points")
    return directions * depth_m[..., None]


def _why_no_points(depth_m: np.ndarray, camera: JsonObject | None) -> str:
    if not camera:
        return "does not say which camera it was seen with"
    rows, columns = depth_m.shape
    image = f"{camera.get('height')} x {camera.get('width')}"
    return f"its {rows} x {columns} depths are not pixels of its camera's image of {image}"


def write_ply(
    points: np.ndarray, path: Path, *, intensity: np.ndarray | None = None, confidence: np.ndarray | None = None
) -> Path:
    """Write a point cloud as binary PLY, whole or not at all, with grey colours for viewers.

    Parameters
    ----------
    points : numpy.ndarray
        Points (..., 3) [m], as `points` gives them; those that are NaN or masked are left out.
    path : Path
        The file (.ply).
    intensity, confidence : numpy.ndarray, optional
        Of every point (...,), in [0, 1] (default: 1). The grey of viewers is the intensity with a display gamma.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        For arrays of other sizes, values outside [0, 1], no point that is known, another ending, and where the file
        cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import scene2spad as s2s
    >>> transient = s2s.render("plane", width=8, height=6, bounces=1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     s2s.write_ply(s2s.points(transient), folder + "/cloud.ply").name
    'cloud.ply'
    """
    require(isinstance(path, str | os.PathLike), f"write_ply: expected a path, not {type(path).__name__}")
    masked = np.ma.getmaskarray(points) if isinstance(points, np.ma.MaskedArray) else None
    path, points = Path(path), np.asarray(points)
    require(path.suffix.lower() == ".ply", f"{path}: a point cloud ends in .ply")
    shaped = points.ndim >= 1 and points.shape[-1] == 3 and points.dtype.kind in "iuf"
    require(shaped, f"{path}: points are {points.dtype}{points.shape}, expected numbers (..., 3)")
    known = np.isfinite(points).all(axis=-1)
    if masked is not None:
        known &= ~masked.any(axis=-1)
    require(bool(known.any()), f"{path}: none of {known.size} points is known, a cloud of none is not written")
    columns = {axis: points[known][:, i].astype("<f4") for i, axis in enumerate("xyz")}
    for name, given in (("intensity", intensity), ("confidence", confidence)):
        values = np.ones(known.shape) if given is None else np.asarray(given)
        fits = values.shape == known.shape and values.dtype.kind in "biuf"
        require(fits, f"{path}: {name} is {values.dtype}{values.shape}, expected numbers {known.shape}")
        columns[name] = values[known].astype("<f4")
        low, high = float(np.nanmin(columns[name], initial=0)), float(np.nanmax(columns[name], initial=0))
        require(low >= 0 and high <= 1 + 1e-6, f"{path}: {name} is from {low:g} to {high:g}, expected 0 to 1")
    grey = np.rint(255 * np.clip(np.nan_to_num(columns["intensity"]), 0, 1) ** (1 / 2.2)).astype(np.uint8)
    _write(columns | dict.fromkeys(("red", "green", "blue"), grey), path)
    return path


def _write(columns: dict[str, np.ndarray], path: Path) -> None:
    """Write columns (N,) of float32 and uint8 as the vertices of a binary PLY."""
    count = len(columns["x"])
    rows = np.empty(count, [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    kinds = {"f": "float", "u": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", "comment camera frame in metres: x right, y down, z forward"]
    lines += [f"element vertex {count}", *(f"property {kinds[v.dtype.kind]} {n}" for n, v in columns.items())]
    with whole_file(path) as beside:
        beside.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
