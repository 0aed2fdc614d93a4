"""Pack the content of a page: images, cubes over time, returns and points, small enough to travel within the page."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.json_types import JsonObject

NS_PER_M = 1e9 / SPEED_OF_LIGHT_M_PER_S
METRES_PER_NS = 0.5 / NS_PER_M  # of depth, from a laser at the camera
MAX_CELLS = 1 << 24  # of a cube: more than a browser draws at once are summed in time
COMMON = (0.005, 0.995)  # quantiles that an image's grey scale spans
LEVELS = 255  # of a cube of rates, on a scale of square roots

Palette = Literal["gray", "depth", "error"]


@dataclass(frozen=True, eq=False)
class Layer:
    """One number a pixel: `values` (H, W), shown between `low` and `high`."""

    name: str
    unit: str
    values: np.ndarray
    palette: Palette
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Cube:
    """Numbers of every pixel over time, (H, W, T): whole counts, or rates of which a step of the scale is told.

    metres_per_ns   depth that a nanosecond is; None beside a displaced laser, where depth is no function of time alone
    """

    name: str
    unit: str
    values: np.ndarray
    start_ns: float
    step_ns: float
    drawn: Literal["bars", "line"]
    metres_per_ns: float | None = METRES_PER_NS


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of every pixel, as lines: `offsets` (H*W + 1,), time [ns], energy, and whether the light is direct."""

    offsets: np.ndarray
    time_ns: np.ndarray
    energy: np.ndarray
    direct: np.ndarray
    note: str


@dataclass(frozen=True, eq=False)
class Content:
    """All of a page. What is missing is not shown."""

    title: str
    facts: dict[str, str]
    layers: tuple[Layer, ...] = ()
    cubes: tuple[Cube, ...] = ()
    returns: Returns | None = None
    arrival_ns: np.ndarray | None = None  # (H, W) when light from the true depth arrives, NaN where it is unknown
    points: np.ndarray | None = None  # (N, 3) float32 [m], x right, y down, z forward
    point_value: np.ndarray | None = None  # (N,) in [0, 1], what colours them
    figures: tuple[tuple[str, bytes], ...] = ()  # caption and PNG
    tables: tuple[tuple[str, list[JsonObject]], ...] = ()
    text: str = ""
    notes: list[str] = field(default_factory=list)


def grey_layer(name: str, unit: str, values: np.ndarray) -> Layer:
    """Make a grey image whose white is the 99.5 % quantile."""
    known = values[np.isfinite(values)]
    high = float(np.quantile(known, COMMON[1])) if known.size else 1.0
    return Layer(name, unit, values, "gray", 0.0, high or 1.0)


def packed(values: np.ndarray) -> str:
    """Compress an array's bytes, little-endian, as base64 of zlib."""
    data = np.ascontiguousarray(values)
    data = data.astype(data.dtype.newbyteorder("<"))
    return base64.b64encode(zlib.compress(data.tobytes(), 6)).decode("ascii")


def cube_payload(cube: Cube) -> dict[str, object]:
    """Pack a cube: counts as they are in 8, 16 or 32 bits, rates and larger counts as square roots in LEVELS steps.

    A cube of more than MAX_CELLS is summed over neighbouring bins first; `summed` says over how many.
    """
    values, summed = cube.values, 1
    counted = values.dtype.kind in "iu"
    wide = np.int64 if counted else np.float64  # a file's own numbers may be of 8 bits, which sums exceed
    while values.size > MAX_CELLS and values.shape[2] > 1:
        if values.shape[2] % 2:
            values = np.concatenate([values, np.zeros((*values.shape[:2], 1), values.dtype)], axis=2)
        values, summed = np.add(values[..., ::2], values[..., 1::2], dtype=wide), 2 * summed
    top = float(values.max(initial=0))
    common = {
        "name": cube.name,
        "unit": cube.unit,
        "drawn": cube.drawn,
        "bins": values.shape[2],
        "start_ns": cube.start_ns,
        "metres_per_ns": cube.metres_per_ns,
        "step_ns": cube.step_ns * summed,
        "summed": summed,
        "top": top,
    }
    if counted and top <= np.iinfo(np.uint32).max:
        kind = np.uint8 if top <= 255 else np.uint16 if top <= 65535 else np.uint32
        return {**common, "type": np.dtype(kind).name, "data": packed(values.astype(kind))}
    # steps of the square root: each is the same share of a rate's shot noise
    levels = np.rint(LEVELS * np.sqrt(values / (top or 1.0)))
    return {**common, "type": "uint8", "rooted": True, "data": packed(levels.astype(np.uint8))}
