"""Measure how unevenly the signal falls on the pixels: glints take photons of a budget by means from all the others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# The few brightest pixels, of which there is one at least: a glint of a lamp or pane is this small, a bright wall is
# not.
FEW = 1e-3
# The others' mean, in terms of the asked one, below which it matters: 10 % fewer photons are 5 % more noise of depth,
# and as much as changes a comparison of methods.
MATTERS_BELOW = 0.9


class SignalShares(NamedTuple):
    """Shares of the expected signal in the brightest pixel and in the brightest thousandth of pixels (`few`, one at
    least); mean expected signal of all others, median and mean of all pixels [detections]."""

    brightest_pixel: float
    brightest_thousandth: float
    few: int
    mean_of_others: float
    median: float
    mean: float


def signal_fractions(signal: np.ndarray) -> SignalShares:
    """Measure how much of the expected signal (H, W) the brightest pixels hold; 0 without any signal.

    The others' mean says what a glint costs: with one bright pixel of four alike ones it is the asked mean, however
    large that pixel's share. The median says what a pixel gets where light falls off unevenly without any glint.
    """
    flat = np.sort(np.asarray(signal, dtype=np.float64).ravel())
    few, total = max(1, round(FEW * flat.size)), float(flat.sum())
    if total <= 0:
        return SignalShares(0.0, 0.0, few, 0.0, 0.0, 0.0)
    others = float(flat[:-few].mean()) if few < flat.size else total / flat.size
    fractions = float(flat[-1]) / total, float(flat[-few:].sum()) / total
    median = float(flat[(flat.size - 1) // 2 : flat.size // 2 + 1].mean())
    return SignalShares(*fractions, few, others, median, total / flat.size)


def glint_warning(fractions: SignalShares) -> str | None:
    """Return one line where the few brightest pixels leave the others less than 90 % of the mean, else None."""
    if fractions.mean_of_others >= MATTERS_BELOW * fractions.mean:
        return None
    pixels = "pixel holds" if fractions.few == 1 else f"{fractions.few} pixels hold"
    return (
        f"warning: the brightest {pixels} {fractions.brightest_thousandth:.1%} of the signal: of {fractions.mean:.4g} "
        f"asked photons the other pixels get {fractions.mean_of_others:.4g} on average, the median pixel "
        f"{fractions.median:.4g}"
    )
