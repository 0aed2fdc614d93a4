"""Metadata that users give to a histogram of their own: what programs read of them is checked where it is given."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

import numpy as np

from scenes.errors import InputError, require, require_number, require_whole
from scenes.json_types import JsonObject

# What the file itself has under these names, which would take the place of what is given.
OWN = ("sensor", "budget", "kind", "schema", "sha256")
TEXTS = ("model", "layout")
SHARES = ("pile_up", "wrapped", "dark_share")
CONVERTERS = ("centre_x", "centre_y", "delay_s", "clock")


def check_meta(meta: object, shape: tuple[int, int]) -> JsonObject:
    """Return metadata of a histogram of `shape` (rows, columns) pixels as a dictionary, the same values.

    Raises InputError that names the key: names that a file has itself, what JSON cannot hold, and values of another
    kind than commands read under these names (`model`, `layout`, `plan`, `seed`, `pile_up`, `wrapped`, `dark_share`,
    `transient` with `camera` and `laser`, `zones`).
    """
    meta = _mapping(meta, "histogram: meta")
    for key in meta:
        require(isinstance(key, str), f"histogram: meta {key!r}, expected text as a key")
        require(key not in OWN, f"histogram: meta {key!r} is a name of the file's own, choose another")
    try:
        json.dumps(meta)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"histogram: meta hold what JSON cannot: {error}") from None
    for key in TEXTS:
        what = f"histogram: meta {key!r}: {meta.get(key)!r}, expected text"
        require(key not in meta or isinstance(meta[key], str), what)
    if "plan" in meta:
        lines = isinstance(meta["plan"], list | tuple) and all(isinstance(line, str) for line in meta["plan"])
        require(lines, f"histogram: meta 'plan': {meta['plan']!r}, expected a list of texts")
    if "seed" in meta:
        require_whole(meta["seed"], "histogram: meta 'seed':")
    for key in SHARES:
        if key in meta and not (key == "dark_share" and meta[key] is None):
            _number(meta, key, "")
    if "transient" in meta:
        _check_transient(_mapping(meta["transient"], "histogram: meta 'transient':"))
    if "zones" in meta:
        _check_zones(_mapping(meta["zones"], "histogram: meta 'zones':"), shape)
    return dict(meta)


def _mapping(value: object, what: str) -> JsonObject:
    require(isinstance(value, Mapping), f"{what} {value!r}, expected a dictionary")
    return dict(value)  # type: ignore[call-overload]


def _number(values: JsonObject, key: str, where: str) -> None:
    what = f"histogram: meta {where}{key!r}:"
    require(key in values, f"{what} is missing")
    value = require_number(values[key], what)
    require(math.isfinite(value), f"{what} {value:g} is not finite")


def _check_transient(transient: JsonObject) -> None:
    """Check where the pixels look and where the laser is, as far as it is told."""
    if "camera" in transient:
        camera = _mapping(transient["camera"], "histogram: meta 'transient': 'camera':")
        for key in ("fov_deg", "width", "height"):
            _number(camera, key, "'transient': 'camera': ")
    laser = _mapping(transient.get("laser", {}), "histogram: meta 'transient': 'laser':")
    if "baseline_m" in laser:
        place, what = laser["baseline_m"], "histogram: meta 'transient': 'laser': 'baseline_m':"
        require(isinstance(place, list | tuple) and len(place) == 3, f"{what} {place!r}, expected three numbers")
        for value in place:
            require(math.isfinite(require_number(value, what)), f"{what} {value!r} is not finite")


def _check_zones(zones: JsonObject, shape: tuple[int, int]) -> None:
    """Check centres, delays and clocks of the zones, which are laid out as the pixels are."""
    _number(zones, "chirp_hz", "'zones': ")
    for key in CONVERTERS:
        what = f"histogram: meta 'zones': {key!r}"
        require(key in zones, f"{what} is missing, expected {', '.join((*CONVERTERS, 'chirp_hz'))}")
        try:
            values = np.asarray(zones[key], dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{what}: expected numbers, a list for each row") from None
        good = values.shape == shape and bool(np.isfinite(values).all())
        require(good, f"{what} is of shape {values.shape}, expected finite numbers {shape}")
