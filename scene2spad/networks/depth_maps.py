"""Depth maps of an evaluation: a file of every method, view and photon level, of the channel Z without confidence."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from csph.evaluation.methods import KeepMap, Row
from scenes.errors import require
from spad.estimators.bistatic import pointing_of
from spad.formats.depth_map import write_depth
from spad.measurements.histogram import Histogram


def check_free(folder: Path) -> None:
    """Raise InputError for a folder of maps that holds something: maps of two evaluations are not told apart."""
    free = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    require(free, f"evaluate: {folder}: is not empty, and would mix maps of two evaluations; remove it or change --out")


def map_writer(folder: Path, methods: Iterable[str]) -> KeepMap:
    """Return what writes each depth map to FOLDER/METHOD/VIEW-SCENE-SIGNAL+BACKGROUND.exr; InputError for methods whose
    folders would be one."""
    names: dict[str, str] = {}
    for method in methods:
        other = names.setdefault(_file_name(method), method)
        require(other == method, f"evaluate: maps of {method} and {other} would have one folder, {_file_name(method)}")

    def keep(row: Row, depth_m: np.ndarray, histogram: Histogram) -> None:
        file = f"{row.view}-{_file_name(row.scene)}-{row.signal:.12g}+{row.background:.12g}.exr"
        target = folder / _file_name(row.method) / file
        target.parent.mkdir(parents=True, exist_ok=True)
        meta = {"method": row.method, "histogram_sha256": histogram.sha256()}
        write_depth(depth_m, target, meta | pointing_of(histogram.meta))

    return keep


def _file_name(name: str) -> str:
    """Return the name of a method or a scene as a file's."""
    return re.sub(r"[^\w.+-]+", "-", name).strip("-")
