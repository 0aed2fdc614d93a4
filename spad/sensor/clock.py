"""Times as a converter measures them: its clock's rate and chirp, and its electronic delay.

A time t is measured as u + chirp u^2 + delay with u = t / clock: `clock` real seconds pass in one of the converter's.
"""

from __future__ import annotations

import numpy as np


def chirped(time: np.ndarray, chirp: float) -> np.ndarray:
    """Return times as a clock measures them whose rate changes by 2 `chirp` a unit of time; a clock that slows down
    stands still in the end, and does not run back."""
    if chirp < 0:
        time = np.minimum(time, -0.5 / chirp)
    return time * (1 + chirp * time)


def unchirped(time: np.ndarray, chirp: float) -> np.ndarray:
    """Return the times that `chirped` gives `time` for; of a clock that stands still, when it stopped."""
    return 2 * time / (1 + np.sqrt(np.maximum(1 + 4 * chirp * time, 0)))
