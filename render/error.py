"""How wrong a render is: nRMSE of the expected counts at the reference sensor's response."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from render.returns import Samples
from scenes.constants import (
    REFERENCE_BINS,
    REFERENCE_PERIOD_S,
    REFERENCE_PULSE_SIGMA_S,
    SPEED_OF_LIGHT_M_PER_S,
)

BIN_M = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PERIOD_S / REFERENCE_BINS
SIGMA_M = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PULSE_SIGMA_S
WIDEST_STENCIL = 256


@dataclass(frozen=True)
class ErrorEstimate:
    """Relative errors: overall (nRMSE), of it deterministic and Monte Carlo; median and 95th percentile over pixels."""

    total: float
    deterministic: float
    monte_carlo: float
    pixel_median: float
    pixel_p95: float

    def to_dict(self) -> dict:
        return asdict(self)


def response(samples: Samples, pixels: np.ndarray) -> np.ndarray:
    """Energy per reference bin after the pulse, (len(pixels), bins) float64, wrapped at the period.

    A sample's pulse and footprint are taken as one Gaussian of variance sigma^2 + h^2 / 3 at bin centres: exact to
    second order, which is all an error estimate needs. `pixels` must be sorted and hold every sample's pixel.
    """
    row = np.searchsorted(pixels, samples.pixel)
    centre = samples.path_m / BIN_M
    sigma = np.sqrt(SIGMA_M**2 + samples.half_width_m**2 / 3) / BIN_M
    counts = np.zeros(len(pixels) * REFERENCE_BINS)
    reach = np.minimum(np.ceil(5 * sigma), WIDEST_STENCIL).astype(int)
    # a few footprints are wide, most are not: one stencil width for each power of two
    size = 1 << np.ceil(np.log2(np.maximum(reach, 1))).astype(int)
    for half in np.unique(size):
        chosen = size == half
        first = np.floor(centre[chosen]).astype(np.int64)[:, None] + np.arange(-half, half + 1)
        z = (first + 0.5 - centre[chosen, None]) / sigma[chosen, None]
        weight = np.exp(-0.5 * z * z) / (math.sqrt(2 * math.pi) * sigma[chosen, None]) * samples.radiance[chosen, None]
        index = row[chosen, None] * REFERENCE_BINS + first % REFERENCE_BINS
        counts += np.bincount(index.ravel(), weights=weight.ravel(), minlength=len(counts))
    return counts.reshape(len(pixels), REFERENCE_BINS)


def estimate(kept: np.ndarray, direct: np.ndarray, batches: list[np.ndarray]) -> ErrorEstimate:
    """Error of what is `kept` against finer `direct` light and the mean of independent indirect `batches`.

    All are (pixels, bins) responses; each batch is an estimate of the whole indirect light. The deterministic part is
    what coarser direct cells and merged returns change, the Monte-Carlo part the variance of the batches' mean,
    sum_b (r_b - mean)^2 / (n (n - 1)), summed over bins.
    """
    reference, noise = direct, np.zeros(len(direct))
    if batches:
        mean = sum(batches) / len(batches)
        reference = direct + mean
    if len(batches) > 1:
        noise = sum(((batch - mean) ** 2).sum(axis=1) for batch in batches) / (len(batches) * (len(batches) - 1))
    deterministic = ((kept - reference) ** 2).sum(axis=1)
    power = (reference**2).sum(axis=1)
    whole = power.sum()
    if whole <= 0:
        return ErrorEstimate(0.0, 0.0, 0.0, 0.0, 0.0)
    per_pixel = np.sqrt((deterministic + noise)[power > 0] / power[power > 0])
    return ErrorEstimate(
        total=math.sqrt((deterministic.sum() + noise.sum()) / whole),
        deterministic=math.sqrt(deterministic.sum() / whole),
        monte_carlo=math.sqrt(noise.sum() / whole),
        pixel_median=float(np.median(per_pixel)),
        pixel_p95=float(np.quantile(per_pixel, 0.95)),
    )


def error_for_budget(reference: np.ndarray, signal: float, background: float) -> float:
    """The error at which Monte-Carlo variance is 1 % of shot variance for that many photons per pixel.

    Shot noise alone has nRMSE sqrt(sum(lambda)) / ||signal part||, with sum(lambda) = pixels (signal + background).
    """
    total, power = reference.sum(), (reference**2).sum()
    if total <= 0:
        return 1.0
    scale = signal * len(reference) / total
    return float(np.clip(0.1 * math.sqrt(len(reference) * (signal + background) / power) / scale, 1e-4, 1.0))
