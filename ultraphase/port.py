"""Check what comes to a core's port: timestamps, and where each core's begin among those of an array."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from scenes.errors import require
from ultraphase.assembly.program import Program

PORT_TIMESTAMPS = 1 << 16  # the port has 16 bits


def whole_timestamps(timestamps: Iterable[int] | np.ndarray, count: int, where: str = "") -> np.ndarray:
    """Return timestamps (N,) as int64. InputError for other than whole numbers in one dimension, and for one that is
    outside 0 to count - 1; `where` stands before the message."""
    listed = isinstance(timestamps, Iterable)
    require(listed, f"{where}timestamps are {timestamps!r}, expected whole numbers in one dimension")
    held = timestamps if isinstance(timestamps, np.ndarray) else np.array(list(timestamps))
    whole = held.ndim == 1 and (held.dtype.kind in "iu" or not held.size)
    require(whole, f"{where}timestamps are {held.dtype}{held.shape}, expected whole numbers in one dimension")
    if held.size:
        least, most = int(held.min()), int(held.max())
        wrong = least if least < 0 else most
        require(0 <= wrong < count, f"{where}timestamp {wrong} is outside 0 to {count - 1}")
    return held.astype(np.int64)


def port_timestamps(timestamps: Iterable[int] | np.ndarray, program: Program) -> np.ndarray:
    """Return timestamps (N,) as the port takes them, int64. InputError for other than whole numbers of 16 bits, and for
    those that the program does not know."""
    held = whole_timestamps(timestamps, PORT_TIMESTAMPS)
    known = program.timestamps
    return held if known is None else whole_timestamps(held, known, f"program {program.name}: ")


def core_offsets(offsets: Sequence[int] | np.ndarray, cores: int, timestamps: int) -> np.ndarray:
    """Return where each core's timestamps begin and the last one's end, (cores + 1,) int64. InputError for other than
    whole numbers that rise from 0 to the number of timestamps."""
    held = np.asarray(offsets)
    require(held.dtype.kind in "iu", f"timestamp offsets are of type {held.dtype}, expected whole numbers")
    held = held.astype(np.int64)
    good = held.shape == (cores + 1,) and held[0] == 0 and held[-1] == timestamps
    good = good and bool((np.diff(held) >= 0).all())
    require(good, f"timestamp offsets: expected {cores + 1} that rise from 0 to the {timestamps} timestamps")
    return held
