"""Point clouds as binary PLY: x right, y down, z forward from the camera [m], intensity and confidence in [0, 1]."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scenes.errors import require
from scenes.files import whole_file


def write_ply(points: np.ndarray, path: Path, *, intensity: np.ndarray, confidence: np.ndarray) -> Path:
    """Write points (N, 3) [m] with intensity (N,) and confidence (N,), whole or not at all; grey colours beside them.

    Viewers show the grey (`red`, `green`, `blue`), which is the intensity with a display gamma.
    """
    require(path.suffix.lower() == ".ply", f"{path}: a point cloud ends in .ply")
    grey = np.rint(255 * np.clip(intensity, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    columns = {
        **{axis: points[:, i].astype("<f4") for i, axis in enumerate("xyz")},
        "intensity": intensity.astype("<f4"),
        "confidence": confidence.astype("<f4"),
        **dict.fromkeys(("red", "green", "blue"), grey),
    }
    rows = np.empty(len(points), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    kinds = {"f": "float", "u": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", "comment camera frame in metres: x right, y down, z forward"]
    lines += [f"element vertex {len(points)}", *(f"property {kinds[v.dtype.kind]} {n}" for n, v in columns.items())]
    with whole_file(path) as beside:
        beside.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
    return path
