"""Estimate the error of a render: nRMSE of the expected counts at the reference sensor's response."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from render.settings import MIN_ERROR
from render.transient.samples import Samples, select
from scenes.constants import (
    REFERENCE_BINS,
    REFERENCE_PERIOD_S,
    REFERENCE_PULSE_SIGMA_S,
    SPEED_OF_LIGHT_M_PER_S,
)
from scenes.errors import told_apart

BIN_M = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PERIOD_S / REFERENCE_BINS
SIGMA_M = SPEED_OF_LIGHT_M_PER_S * REFERENCE_PULSE_SIGMA_S
PULSE_POWER = BIN_M / (2 * math.sqrt(math.pi) * SIGMA_M)  # sum over bins of the square of one return of energy 1
WIDEST_PIECE, MAX_PIECES = 1.0, 64  # sigma: side by side these are even to 0.3 %
REACH = math.ceil(5 * math.sqrt(1 + WIDEST_PIECE**2 / 3) * SIGMA_M / BIN_M)  # bins to each side of a piece's centre
BLOCK_ENTRIES = 1 << 16
# Pixels that a few rare bright paths can spoil: a thousandth of the image, and at least a block that shares its paths.
WORST_FRACTION, MIN_WORST = 1e-3, 16
# The brightest pixels are checked one by one where they hold more than this part of the image's squared radiance.
BRIGHTEST, BRIGHT_FRACTION = 32, 0.25
UNEVEN = 2.0  # times the error above which the median pixel's is said beside it
# Of light that met very many surfaces, in that of even light: its returns lie over a large part of the period.
LATE_POWER = 2.0
RULED = 0.5  # share of the squared error in these pixels above which they rule it
FEW = 1 / 16  # of an image's pixels: the worst ones are no more where they are spoken of


@dataclass(frozen=True)
class ErrorEstimate:
    """Relative errors: overall (nRMSE) and its parts; median and 95th percentile of pixels.

    `bias` is the filter's, `clamped` what a clamp removes, `truncated` what would have met more surfaces than planned.
    `worst_share` is the share of the squared overall error in the worst pixels (`worst_fraction_of`). The overall error
    is a sum of squares: one firefly can rule it, while the median pixel is fine, and being in both of its sums holds it
    below 1. It is the error all the same, so that a target it exceeds is missed; the share says what to do about it.
    """

    total: float
    direct: float
    merging: float
    monte_carlo: float
    bias: float
    pixel_median: float
    pixel_p95: float
    worst_share: float = 0.0
    clamped: float = 0.0
    truncated: float = 0.0

    def to_dict(self) -> dict:
        """Return all parts by name; of light beyond the last bounce only where there is some that matters."""
        parts = asdict(self)
        return parts if self.truncated else {name: part for name, part in parts.items() if name != "truncated"}


# Of a render whose checked pixels hold no light, though others do: nothing is known of its error.
UNKNOWN = ErrorEstimate(1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0)


def response(samples: Samples, pixels: np.ndarray) -> np.ndarray:
    """Return energy per reference bin after the pulse, (len(pixels), bins) float64, wrapped at the period.

    A sample's pulse and footprint are taken as one Gaussian of variance sigma^2 + h^2 / 3 at bin centres: exact to
    second order, which is all an error estimate needs of a footprint no wider than the pulse. Wider ones are cut into
    such pieces: next to each other Gaussians would not add up to what is even. Those of too many pieces are integrals
    of the pulses at their two ends. `pixels` must be sorted and hold every sample's pixel.
    """
    wide = samples.half_width_m > WIDEST_PIECE * MAX_PIECES * SIGMA_M
    if not wide.any():
        return _gaussians(_in_pieces(samples), pixels)
    return _gaussians(_in_pieces(select(samples, ~wide)), pixels) + _even(select(samples, wide), pixels)


def _even(samples: Samples, pixels: np.ndarray) -> np.ndarray:
    """Return `response` of samples that are even over their whole width, which may be many periods."""
    radiance, half_m = (column.astype(np.float64) for column in (samples.radiance, samples.half_width_m))
    per_bin, zero = radiance * BIN_M / (2 * half_m), np.zeros_like(half_m)
    # the sum over bins up to one takes in the half of it that lies beyond its centre
    rise, fall = (
        samples._replace(path_m=samples.path_m + side * half_m + BIN_M / 2, half_width_m=zero, radiance=-side * per_bin)
        for side in (-1, 1)
    )
    counts = np.cumsum(_gaussians(rise, pixels) + _gaussians(fall, pixels), axis=1)
    # what wraps is a constant, which the energy tells
    energy = np.bincount(np.searchsorted(pixels, samples.pixel), radiance, len(pixels))
    return counts + (energy / REFERENCE_BINS - counts.mean(axis=1))[:, None]


def _gaussians(samples: Samples, pixels: np.ndarray) -> np.ndarray:
    """Return `response` of samples each of which is one Gaussian, no wider than the widest piece."""
    counts = np.zeros(len(pixels) * REFERENCE_BINS)
    row = np.searchsorted(pixels, samples.pixel).astype(np.int32) * REFERENCE_BINS
    # float32: an estimate of errors needs no more, from bins counted from a whole one
    whole = np.floor(samples.path_m / BIN_M)
    within = (samples.path_m / BIN_M - whole).astype(np.float32)
    whole = whole.astype(np.int32)
    sigma = (np.sqrt(SIGMA_M**2 + samples.half_width_m**2 / 3) / BIN_M).astype(np.float32)
    height = (samples.radiance / (math.sqrt(2 * math.pi) * sigma)).astype(np.float32)
    stencil = np.arange(-REACH, REACH + 1, dtype=np.int32)
    block = BLOCK_ENTRIES // len(stencil)
    for first in range(0, len(row), block):
        part = slice(first, first + block)
        # in place: a pass over blocks that stay in the cache takes half the time
        weight = np.subtract.outer(within[part], stencil + np.float32(0.5)) / sigma[part, None]
        np.exp(np.multiply(np.square(weight, out=weight), np.float32(-0.5), out=weight), out=weight)
        weight *= height[part, None]
        index = np.add.outer(whole[part], stencil)
        index &= REFERENCE_BINS - 1  # modulo the period, as there are 1024 of them, at a tenth of the time
        index += row[part, None]
        np.add.at(counts, index.ravel(), weight.ravel().astype(np.float64))  # of one type: 40 times as fast
    return counts.reshape(len(pixels), REFERENCE_BINS)


def _in_pieces(samples: Samples) -> Samples:
    """Split samples into pieces of half widths up to WIDEST_PIECE sigma, MAX_PIECES pieces at most."""
    pieces = np.ceil(samples.half_width_m / (WIDEST_PIECE * SIGMA_M)).clip(1, MAX_PIECES).astype(np.int64)
    if len(pieces) == 0 or pieces.max() == 1:
        return samples
    pixel, path, half, radiance, bounces = (np.repeat(column, pieces) for column in samples)
    each = np.repeat(pieces, pieces)
    number = np.arange(len(each)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    path = path + half * ((2 * number + 1) / each - 1)
    return Samples(pixel, path, half / each, radiance / each, bounces)


class CheckedPixels(NamedTuple):
    """Pixels by which an image's error is estimated.

    pixel   sorted flat indices: the plan's random `pilot`, and those `added`
    weight  how many of the image's pixels each stands for
    """

    pixel: np.ndarray
    weight: np.ndarray
    pilot: np.ndarray
    added: np.ndarray

    def mean(self, values: np.ndarray) -> float:
        """Estimate the mean of an image's values (H*W,) from those of the checked pixels."""
        return float(np.average(values[self.pixel], weights=self.weight))


NOT_CHECKED = CheckedPixels(*(np.empty(0, np.int64),) * 4)


def checked_pixels(pilot: np.ndarray, radiance: np.ndarray) -> CheckedPixels:
    """Return the pixels to check of an image of such radiances (H*W,): a pilot's, each of which stands for many, and
    the brightest for themselves, where these hold much of the squared radiance."""
    count = len(radiance)
    none = pilot[:0]
    if count <= len(pilot) or count <= BRIGHTEST:
        return CheckedPixels(pilot, np.full(len(pilot), count / max(len(pilot), 1)), pilot, none)
    bright = np.argpartition(radiance, -BRIGHTEST)[-BRIGHTEST:]
    power = np.square(radiance, dtype=np.float64)
    if power[bright].sum() <= BRIGHT_FRACTION * power.sum():
        return CheckedPixels(pilot, np.full(len(pilot), count / len(pilot)), pilot, none)
    pixel = np.union1d(pilot, bright)
    weight = np.full(len(pixel), (count - BRIGHTEST) / max(len(pixel) - BRIGHTEST, 1))
    weight[np.searchsorted(pixel, bright)] = 1
    return CheckedPixels(pixel, weight, pilot, np.setdiff1d(bright, pilot))


class IndirectErrors(NamedTuple):
    """Squared errors of indirect light after the pulse, (pixels,) or one for all: noise, merging of returns, a filter's
    bias, what a clamp removed. The pixels are some of an image's: the scales say how many times as much noise, and
    clamped error, the whole image has for its squared power. `left_out` is the share of all light that met more
    surfaces than were followed."""

    noise: np.ndarray | float = 0.0
    merging: np.ndarray | float = 0.0
    bias: np.ndarray | float = 0.0
    clamped: np.ndarray | float = 0.0
    noise_scale: float = 1.0
    clamped_scale: float = 1.0
    left_out: float = 0.0


def estimate(
    coarse: np.ndarray,
    fine: np.ndarray,
    indirect: np.ndarray | float = 0.0,
    errors: IndirectErrors = IndirectErrors(),  # noqa: B008  # cannot change
    weight: np.ndarray | float = 1.0,
) -> ErrorEstimate:
    """Return error of direct light by `coarse` against `fine` cells beside the indirect light's own errors.

    coarse, fine, indirect are (pixels, bins) responses. Without indirect light and its errors there is direct light
    alone. `weight` (pixels,) says how many pixels of the image each stands for; median and percentile are those of
    the pixels that stand for most.
    """
    noise, merging, bias, clamped = (np.broadcast_to(part, len(coarse)) for part in errors[:4])
    direct = ((coarse - fine) ** 2).sum(axis=1)
    power = ((fine + indirect) ** 2).sum(axis=1)
    weight = np.broadcast_to(weight, len(coarse))
    whole = (weight * power).sum()
    if whole <= 0:
        return ErrorEstimate(*(0.0,) * 7)
    of_image = direct, merging, noise * errors.noise_scale, bias, clamped * errors.clamped_scale
    *parts, lost = (max((weight * part).sum() / whole, 0.0) for part in of_image)
    late = LATE_POWER / REFERENCE_BINS * ((fine + indirect).sum(axis=1) * errors.left_out / (1 - errors.left_out)) ** 2
    truncated = float((weight * late).sum() / whole)
    squared = np.maximum(direct + merging + noise + bias + clamped + late, 0)
    typical = (power > 0) & (weight == weight.max())
    per_pixel = np.sqrt(squared[typical] / power[typical]) if typical.any() else np.zeros(1)
    return ErrorEstimate(
        math.sqrt(sum(parts) + lost + truncated),
        *(math.sqrt(part) for part in parts),  # type: ignore[misc]  # mypy cannot count them
        pixel_median=float(np.median(per_pixel)),
        pixel_p95=float(np.quantile(per_pixel, 0.95)),
        clamped=math.sqrt(lost),
        truncated=math.sqrt(truncated),
    )


def worst_pixels(pixels: int) -> int:
    """Return the number of pixels that count as the worst: a thousandth, at least 16, at most all."""
    return min(max(round(WORST_FRACTION * pixels), MIN_WORST), pixels)


def is_ruled_by_few(error: ErrorEstimate, pixels: int) -> bool:
    """Return whether a few of an image's pixels rule its error; False where the worst are no small part of it."""
    return error.worst_share > RULED and worst_pixels(pixels) <= FEW * pixels


def is_ruled_by_bounces(error: ErrorEstimate) -> bool:
    """Return whether light of more surfaces than are followed rules an error, which no number of paths lowers."""
    return error.truncated**2 > RULED * error.total**2


def worst_fraction_of(standard_error: np.ndarray, error: ErrorEstimate) -> float:
    """Estimate the share of the squared error in the worst pixels, from every pixel's Monte-Carlo error (H*W,).

    Only that part of the error is known of every pixel, and only it is ruled by a few.
    """
    variance = np.sort(np.square(standard_error, dtype=np.float64))
    whole = variance.sum()
    if whole <= 0 or error.total <= 0:
        return 0.0
    ruled = float(variance[-worst_pixels(len(variance)) :].sum() / whole)
    return ruled * min(error.monte_carlo**2 / error.total**2, 1.0)


def is_met(error: ErrorEstimate, target: float) -> bool:
    """Return whether the stated error is at most the target."""
    return error.total <= target


def target_verdict(error: ErrorEstimate, target: float, pixels: int) -> str:
    """Say in one line whether the stated error meets the target; where a few pixels rule a missed one, say so."""
    stated, limit = told_apart(error.total, target)
    if is_met(error, target):
        message = f"error: {stated} stated, meets the target of {limit}"
        if error.pixel_median > UNEVEN * error.total:
            message += f"; the median pixel's is {error.pixel_median:.2g}, as bright ones rule the sum"
        return message
    message = f"warning: the stated error of {stated} MISSES the target of {limit}"
    message += f"; the median pixel's is {error.pixel_median:.2g}"
    if is_ruled_by_bounces(error):
        message += f"; {error.truncated:.2g} is light beyond the last bounce"
    if is_ruled_by_few(error, pixels):
        rest = error.total * math.sqrt(1 - error.worst_share)
        message += (
            f"; {error.worst_share:.0%} of its square lies in the worst {worst_pixels(pixels)} of {pixels} pixels"
        )
        message += f" (fireflies), {rest:.2g} without them"
    return message


def noise_of_responses(responses: list[np.ndarray]) -> np.ndarray:
    """Return expected squared error of the mean of independent batches, per pixel, from each one's response.

    Takes what bins have in common into account: filtered light spreads over some, and errors of a low-discrepancy set
    cancel between some.
    """
    if len(responses) < 2:
        return np.zeros(len(responses[0]))
    return np.var(responses, axis=0, ddof=1).sum(axis=1) / len(responses)


def power_of(direct: Samples) -> tuple[float, float]:
    """Return squared sum of direct light's response over bins and pixels; and that of a unit of energy with the pulse
    alone.

    A pixel's light is taken as one Gaussian, of the pulse's variance and its own: an underestimate where it is mixed.
    """
    pixels = int(direct.pixel.max(initial=-1)) + 1
    # float64: the variance is the small difference of two large numbers
    path_m, half_m, radiance = (np.float64(part) for part in (direct.path_m, direct.half_width_m, direct.radiance))
    energy, first, second = (
        np.bincount(direct.pixel, weights=radiance * moment, minlength=pixels)
        for moment in (np.ones(1), path_m, path_m**2 + half_m**2 / 3)
    )
    lit = energy > 0
    variance = np.maximum(second[lit] / energy[lit] - (first[lit] / energy[lit]) ** 2, 0)
    power = energy[lit] ** 2 * BIN_M / (2 * math.sqrt(math.pi) * np.sqrt(SIGMA_M**2 + variance))
    return float(power.sum()), PULSE_POWER


def error_for_budget(reference: np.ndarray, signal: float, background: float) -> float:
    """Return the error at which Monte-Carlo variance is 1 % of shot variance for that many photons per pixel.

    Shot noise alone has nRMSE sqrt(sum(lambda)) / ||signal part||, with sum(lambda) = pixels (signal + background).
    """
    total, power = reference.sum(), (reference**2).sum()
    if total <= 0:
        return 1.0
    scale = signal * len(reference) / total
    error = 0.1 * math.sqrt(len(reference) * (signal + background) / power) / scale
    return float(np.clip(error, MIN_ERROR, 1.0))


def error_of_background(background: float, signal: float) -> float:
    """Return nRMSE that a background of that many photons a pixel would make, were it an error of the signal's photons.

    b / N in each of N bins, beside s photons of one return with the pulse alone:
    (b / s) sqrt(1 / N) / sqrt(PULSE_POWER).
    """
    return background / signal / math.sqrt(REFERENCE_BINS * PULSE_POWER)
