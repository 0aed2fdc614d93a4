"""Depth methods by the names that the command line takes: estimators, codes such as fourier-16, networks, and files."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.errors import InputError, require

if TYPE_CHECKING:
    from csph.codes.tensor import CodingTensor
    from spad.measurements.histogram import Histogram
    from spad.sensor.model import Sensor

CODES = ("fourier", "gray", "coarse", "hadamard", "random", "fourier-published", "gray-published")
CODES_FILES = (".npy", ".txt")
Method = Callable[["Histogram"], np.ndarray]


def depth_method(name: str, sensor: Sensor, *, seed: int = 0) -> Method:
    """Return the depth method of a name: a function of a histogram that gives depth (H, W) [m].

    An estimator (argmax, matched, ...), a temporal code and its number (fourier-16) decoded by correlation, the name or
    file of a network, or a file of one's own codes (`codes_method`). Raises InputError for anything else.
    """
    if is_classical(name):
        return classical_method(name, sensor, seed=seed)
    from csph.networks.checkpoint import load_model
    from csph.weights.cards import checkpoint_of

    try:
        model = load_model(checkpoint_of(name))[0]
    except InputError as error:
        raise InputError(f"method {name!r} is none of {_classical_kinds()} or a network: {error}") from None

    def estimated(histogram: Histogram) -> np.ndarray:
        from scene2spad.networks.end_warnings import warn_of_clock

        warn_of_clock(name, model.config, histogram.sensor)
        return model.estimate(histogram).depth_m

    return estimated


def is_classical(name: str) -> bool:
    """Tell whether a name is that of a method without a network."""
    from spad.estimators.depth import METHODS

    return name in METHODS or is_codes_file(name) or code_of(name) is not None


def classical_method(name: str, sensor: Sensor, *, seed: int = 0) -> Method:
    """Return the method of a name as `depth_method` does, but none by a network; the seed is of random codes."""
    from spad.estimators.depth import METHODS, histogram_depth_m

    if name in METHODS:
        return lambda histogram: histogram_depth_m(histogram, name)
    if is_codes_file(name):
        return codes_method(Path(name), sensor)
    code = code_of(name)
    if code is None:
        raise InputError(f"method {name!r} is none of {_classical_kinds()}")
    from csph import CodingTensor, temporal_code

    return decoded_by(CodingTensor(name, temporal_code(*code, sensor.bins, sensor, seed)))


def code_of(name: str) -> tuple[str, int] | None:
    """Return a temporal code and its number by a name such as fourier-16; None for another name."""
    found = re.fullmatch(r"([a-z-]+?)-(\d{1,9})", name)
    return (found[1], int(found[2])) if found is not None and found[1] in CODES else None


def _classical_kinds() -> str:
    from spad.estimators.depth import METHODS

    return f"{', '.join(METHODS)}, a code such as fourier-16, codes in a file (.npy, .txt)"


def is_codes_file(name: str | Path) -> bool:
    """Tell by its ending whether a method's name is that of a file of codes."""
    return Path(name).suffix.lower() in CODES_FILES


def codes_method(path: Path, sensor: Sensor) -> Method:
    """Return the method of a file of one's own codes over one pixel: (K, T) as .npy, or a text table of `export`.

    Warns of codes that depend on each other. Raises InputError that names the file for those of other blocks or bins,
    and those that tell no depth.
    """
    from csph.codes.decode import check_decodable, warn_of_rank
    from csph.codes.files import read_codes

    coding = read_codes(path)
    bins, rows, columns = coding.block
    alone = f"{path}: codes of blocks of {bins} bins x {rows} rows x {columns} columns, expected those of one pixel"
    require((bins, rows, columns) == (sensor.bins, 1, 1), f"{alone} over the {sensor.bins} bins of {sensor.name}")
    try:
        check_decodable(coding)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    warn_of_rank(coding, str(path))
    return decoded_by(coding)


def decoded_by(coding: CodingTensor) -> Method:
    """Return the method that encodes counts by a coding tensor of one pixel, and decodes its codes by correlation."""
    from csph import decode_depth, encode
    from spad.estimators.depth import histogram_depth_m

    return lambda histogram: histogram_depth_m(
        histogram, lambda counts, sensor: decode_depth(encode(counts, coding), coding, sensor)
    )
