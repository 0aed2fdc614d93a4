"""Describe a dense export for `inspect`, and one pixel of it."""

from __future__ import annotations

import numpy as np

from scenes.errors import InputError
from scenes.io.inputs import parse_json
from scenes.json_types import JsonObject
from spad.formats.dense import AXES, RADIANCE, UNITS

SCALARS = ("bin_width_s", "period_s", "wrapped", "unrecorded")


def of_dense(arrays: dict[str, np.ndarray], text: dict[str, str]) -> JsonObject:
    """Return what an export holds: shape, axes, units, its sensor where it names one, and light that wraps."""
    data, depth_m = arrays["data"], arrays["depth_m"]
    rows, columns, bins = data.shape
    axes = text.get("axes", "unknown")
    shape = (bins, rows, columns) if axes == AXES["thw"] else data.shape
    known = depth_m[np.isfinite(depth_m)]
    found: JsonObject = {
        "data": _holds(data),
        "shape": list(shape),
        "axes": axes,
        "unit": UNITS["data"][0] if _counted(data) else RADIANCE[0],
        "rows": rows,
        "columns": columns,
        "bins": bins,
        "sensor": _sensor(text),
    }
    found |= {name: float(arrays[name]) for name in SCALARS if name in arrays and arrays[name].size == 1}
    found["depth_m"] = [float(known.min()), float(known.max())] if known.size else []
    return found | {"arrays": sorted({*arrays, *text})}


def pixel_of_dense(arrays: dict[str, np.ndarray], pixel: tuple[int, int]) -> JsonObject:
    """Return one pixel of an export: its true depth, its sum, and every bin that holds something."""
    values, depth = arrays["data"][pixel], float(arrays["depth_m"][pixel])
    return {
        "row": pixel[0],
        "column": pixel[1],
        "depth_m": depth if np.isfinite(depth) else None,
        "sum": values.sum(dtype=np.int64 if _counted(values) else np.float64).item(),
        "counts": [{"bin": int(at), _holds(values): values[at].item()} for at in np.flatnonzero(values)],
    }


def _counted(data: np.ndarray) -> bool:
    return data.dtype.kind in "iu"


def _holds(data: np.ndarray) -> str:
    return "counts" if _counted(data) else "radiance"


def _sensor(text: dict[str, str]) -> str | None:
    """Return the name of the sensor that an export states; None of older versions and other programs."""
    try:
        stated = parse_json(text.get("sensor", ""))
    except InputError:
        return None
    return str(stated["name"])[:80] if isinstance(stated, dict) and "name" in stated else None
