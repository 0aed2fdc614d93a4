"""Rows of a Fourier series over time bins, without torch: the emulated processor's tables are made of them, too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from scenes.errors import require

Rows = Literal["centred", "published"]


def waves(harmonics: Sequence[int] | np.ndarray, bins: int, rows: Rows = "centred") -> np.ndarray:
    """Return cos and sin in turn of each harmonic f, (2F, Mt) float32: cos(2 pi f (i + 1/2) / Mt) at the bin centres.

    published: cos and -sin at 2 pi f i / Mt, the real and imaginary part of a discrete Fourier transform.
    """
    published = rows == "published"
    # The phase in half bins, an integer reduced before it becomes an angle: exact for every harmonic.
    half_bins = np.asarray(harmonics)[:, None] * (2 * np.arange(bins) + (not published)) % (2 * bins)
    angle = half_bins * (math.pi / bins)
    sine = -np.sin(angle) if published else np.sin(angle)
    return np.stack([np.cos(angle), sine], axis=1).reshape(-1, bins).astype(np.float32)


def truncated_waves(codes: int, bins: int, rows: Rows = "centred") -> np.ndarray:
    """Return the K rows of harmonics 1 .. K/2, (K, Mt) float32; see `csph.codes.temporal.truncated_fourier`.

    Raises InputError unless K is even and 2 <= K < Mt.
    """
    most = (bins - 1) // 2 * 2
    require(most >= 2, f"truncated Fourier: {bins} bins hold no harmonic, expected 3 bins or more")
    require(
        codes % 2 == 0 and 2 <= codes <= most,
        f"truncated Fourier: {codes} codes, expected an even number from 2 to {most} for {bins} bins",
    )
    return waves(np.arange(1, codes // 2 + 1), bins, rows)
