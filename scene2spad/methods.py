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
    from spad.formats.histogram import Histogram
    from spad.sensor.model import Sensor

CODES = ("fourier", "gray", "coarse", "hadamard", "random", "fourier-published", "gray-published")
Method = Callable[["Histogram"], np.ndarray]


def depth_method(name: str, sensor: Sensor, *, seed: int = 0) -> Method:
    """Return the depth method of a name: a function of a histogram that gives depth (H, W) [m].

    An estimator (argmax, matched, ...), a temporal code and its number (fourier-16) decoded by correlation, the name or
    file of a network, or codes (K, T) of one's own in a .npy file. Raises InputError for anything else.
    """
    from spad.estimators.depth import METHODS, histogram_depth_m

    if name in METHODS:
        return lambda histogram: histogram_depth_m(histogram, name)
    if name.endswith(".npy"):
        from csph.codes.files import read_codes

        coding = read_codes(Path(name))
        bins, rows, columns = coding.block
        alone = f"{name}: codes of blocks of {bins} bins x {rows} rows x {columns} columns, expected those of one pixel"
        require((bins, rows, columns) == (sensor.bins, 1, 1), f"{alone} over the {sensor.bins} bins of {sensor.name}")
        return decoded_by(coding)
    found = re.fullmatch(r"([a-z-]+?)-(\d{1,4})", name)
    if found is not None and found[1] in CODES:
        from csph import CodingTensor, temporal_code

        return decoded_by(CodingTensor(name, temporal_code(found[1], int(found[2]), sensor.bins, sensor, seed)))
    from csph.networks.model import load_model
    from csph.weights.cards import checkpoint_of

    try:
        model = load_model(checkpoint_of(name))[0]
    except InputError as error:
        kinds = f"{', '.join(METHODS)}, a code such as fourier-16, codes in a .npy file or a network"
        raise InputError(f"method {name!r} is none of {kinds}: {error}") from None
    return lambda histogram: model.estimate(histogram).depth_m


def decoded_by(coding: CodingTensor) -> Method:
    """Return the method that encodes counts by a coding tensor of one pixel, and decodes its codes by correlation."""
    from csph import decode_depth, encode
    from spad.estimators.depth import histogram_depth_m

    return lambda histogram: histogram_depth_m(
        histogram, lambda counts, sensor: decode_depth(encode(counts, coding), coding, sensor)
    )
