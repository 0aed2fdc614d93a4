"""Classical depth estimators: from a histogram of counts to depth, with the bound they are judged against.

Conventions: bin i covers [i, i + 1) bin widths, its centre is i + 1/2; the pulse is centred, so its centroid is the
arrival time t and depth = c t / 2; time wraps at the period. Every estimator subtracts its own mean answer to the
noise-free pulse, `noise_free_bias_m`.

    argmax       centre of the fullest bin, first of equals
    matched      peak of the zero-normalised circular correlation with the binned pulse
    log-matched  Poisson maximum likelihood: argmax over tau of sum_i n_i log(S h_i(tau) + B) - S sum_i h_i(tau)
    correlation  the same as matched over whole bins, with a parabola: zero-normalised cross-correlation
    lmf-published   argmax over whole bins of the correlation with log(1 + h), the filter of the ICCV 2023 code
    coates       log-matched, after pile-up is undone: Coates' correction of first photons, or the dead-time correction
                 of a detector that is not armed at every cycle, by the law that made the counts where it is known
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from scenes.constants import SPEED_OF_LIGHT_M_PER_S
from scenes.errors import InputError, did_you_mean, require
from spad.detection.detectors import LAWS
from spad.detection.laws import LOW_FLUX
from spad.estimators.bistatic import radial_depth_of, recorded_range_m, time_tells_depth
from spad.estimators.matching import (
    argmax_bins,
    correlate,
    correlation_bins,
    grid_peak,
    is_circular,
    likelihood,
    log_matched_bins,
    matched_bins,
    published_log_matched_bins,
)
from spad.estimators.pile_up import warn_of_saturation, without_pile_up
from spad.measurements.histogram import Histogram
from spad.sensor.model import Sensor
from spad.sensor.template import binned_pulse, binned_pulse_slope, pulse_taps

__all__ = [
    "ESTIMATORS",
    "METHODS",
    "by_pixels",
    "checked_histogram",
    "confidence",
    "confidence_map",
    "correlate",
    "cramer_rao_m",
    "depth_errors",
    "depth_in_range",
    "detection_law",
    "estimate_depth",
    "grid_peak",
    "histogram_depth_m",
    "histogram_errors",
    "no_error_reason",
    "noise_free_bias_m",
]

_BIAS_PHASES = 16
_BIAS_SIGNAL = 1e4
_CHUNK = {"cpu": 1 << 20, "cuda": 1 << 24}  # counts per chunk: a few MB a tensor on a CPU, which its cache holds

ESTIMATORS: dict[str, Callable[[Tensor, Sensor], Tensor]] = {
    "argmax": argmax_bins,
    "matched": matched_bins,
    "log-matched": log_matched_bins,
    "correlation": correlation_bins,
    "lmf-published": published_log_matched_bins,
    "coates": log_matched_bins,  # of counts without pile-up
}
METHODS: tuple[str, ...] = tuple(ESTIMATORS)


def checked_histogram(counts: Tensor, bins: int) -> Tensor:
    """Return the counts as (P, T) rows, or an InputError: last axis, negative or non-finite counts."""
    if counts.ndim < 1 or counts.shape[-1] != bins:
        raise InputError(f"histogram of shape {tuple(counts.shape)}: the last axis must be the sensor's {bins} bins")
    if counts.numel():
        low, high = (float(value) for value in torch.aminmax(counts))
        if not (low >= 0 and math.isfinite(high)):
            raise InputError(f"histogram counts range from {low:g} to {high:g}, expected finite counts of 0 or more")
    return counts.reshape(-1, bins)


def by_pixels(function: Callable[..., Tensor], rows: Tensor, per_pixel: int = 0, *beside: Tensor) -> Tensor:
    """Return `function` (P, T) -> (P, ...) over chunks of pixels, so that memory does not grow with the image.

    `per_pixel` is the size of its largest intermediate tensor for one pixel, where that exceeds T; `beside` (P, ...)
    are its further arguments."""
    size = max(1, _CHUNK.get(rows.device.type, _CHUNK["cuda"]) // max(1, rows.shape[-1], per_pixel))
    parts = zip(*(torch.split(one, size) for one in (rows, *beside)), strict=True)
    return torch.cat([function(*part) for part in parts])


def depth_in_range(depth_m: Tensor, sensor: Sensor) -> Tensor:
    """Return float32 depth in [0, range): wrapped where the bins cover the period, else clamped to the bins."""
    if is_circular(sensor):
        depth_m = torch.remainder(depth_m, sensor.range_m)
    else:
        depth_m = depth_m.clamp(0, sensor.recorded_range_m)
    single = depth_m.float()  # may round up to the range itself, which is depth 0
    return torch.where(single.double() >= sensor.range_m, 0.0, single)


def _raw_depth(rows: Tensor, sensor: Sensor, method: str) -> Tensor:
    def one(part: Tensor) -> Tensor:
        part = part if part.dtype == torch.float64 else part.float()
        bins = ESTIMATORS[method](part, sensor)
        return torch.where(part.sum(-1) > 0, bins, math.nan)

    return by_pixels(one, rows, pulse_taps(sensor, str(rows.device)).fine.numel()) * sensor.bin_depth_m


def noise_free_bias_m(
    estimator: str | Callable[[Tensor], Tensor], sensor: Sensor, time_bin: int | None = None
) -> float:
    """Return mean over sub-bin phases of estimate - truth [m] for the expected counts of a lone pulse without
    background.

    `estimator` is one of METHODS, before the subtraction (computed once a sensor), or any function of counts (P, T)
    that gives depth (P,) in metres. The function's pulse arrives in `time_bin`, the middle one if it is left out.
    """
    if isinstance(estimator, str):
        _require_method(estimator)
        return _method_bias_m(estimator, sensor)
    phases = (torch.arange(_BIAS_PHASES, dtype=torch.float64) + 0.5) / _BIAS_PHASES
    arrival = ((sensor.bins // 2 if time_bin is None else time_bin) + phases) * sensor.bin_width_s
    error = estimator(_BIAS_SIGNAL * binned_pulse(arrival, sensor)).double() - arrival * SPEED_OF_LIGHT_M_PER_S / 2
    half = sensor.range_m / 2
    return float((torch.remainder(error + half, sensor.range_m) - half).mean())


@lru_cache(maxsize=64)
def _method_bias_m(method: str, sensor: Sensor) -> float:
    return noise_free_bias_m(lambda counts: _raw_depth(counts, sensor, method), sensor)


def _require_method(method: str) -> None:
    if method not in METHODS:
        meant = did_you_mean(method, METHODS)
        raise InputError(f"depth method {method!r} is unknown{meant}, expected one of {', '.join(METHODS)}")


def estimate_depth(counts: Tensor, sensor: Sensor, method: str = "log-matched", *, law: str | None = None) -> Tensor:
    """Estimate half the optical path [m] from counts, (..., T) -> (...,) float32 in [0, range); NaN without counts.

    It is the depth where the laser is co-located with the camera. Counts know no laser: `histogram_depth_m` takes a
    `Histogram`, which does, and gives the depth beside a displaced one too. `law` is the detection law whose losses
    `coates` undoes; None stands for that of the sensor's detector (`spad.estimators.pile_up.without_pile_up`). Raises
    InputError for an unknown method, a wrong number of bins, negative or non-finite counts, and with `coates` for an
    unknown law, and counts that the law cannot have made.

    Examples
    --------
    All photons in bin 100 of the reference sensor, whose bins are 14.6 mm of depth wide:

    >>> import torch
    >>> import spad
    >>> counts = torch.zeros(1024)
    >>> counts[100] = 50
    >>> round(float(spad.estimate_depth(counts, spad.sensor_by_name("reference"), "argmax")), 3)
    1.471
    """
    _require_method(method)
    rows = checked_histogram(counts, sensor.bins)
    if not len(rows):
        return torch.empty(counts.shape[:-1], dtype=torch.float32, device=counts.device)
    if method == "coates":
        warn_of_saturation(rows, sensor, law)
        rows = by_pixels(lambda part: without_pile_up(part, sensor, law), rows)
    depth = _raw_depth(rows, sensor, method) - noise_free_bias_m(method, sensor)
    return depth_in_range(depth, sensor).reshape(counts.shape[:-1])


def confidence(
    counts: Tensor, depth_m: Tensor, sensor: Sensor, method: str = "log-matched", *, law: str | None = None
) -> Tensor:
    """Return probability that an estimated depth is the pulse's and not a chance peak, (..., T), (...,) -> (...,)
    float32.

    The posterior share of arrivals within two pulse widths (the window that holds 95 % of a Gaussian) of the estimate,
    with every bin as likely before as any other: softmax of the log-likelihood over bins, S and B as `log-matched`
    estimates them. NaN where the depth is. Of any method's depth; that of `coates` is judged by counts without the
    pile-up of `law`, as it was estimated. Raises InputError as `estimate_depth` does.
    """
    _require_method(method)
    rows = checked_histogram(counts, sensor.bins)
    if depth_m.shape != counts.shape[:-1]:
        raise InputError(f"depth of shape {tuple(depth_m.shape)} for counts of shape {tuple(counts.shape)}")
    if not len(rows):
        return torch.empty_like(depth_m, dtype=torch.float32)
    taps = pulse_taps(sensor, str(rows.device))
    reach = taps.shifts[taps.window]
    estimate = (depth_m.reshape(-1, 1).double() / sensor.bin_depth_m).floor().nan_to_num(0).clamp(0, sensor.bins - 1)

    def near(part: Tensor, place: Tensor) -> Tensor:
        if method == "coates":
            part = without_pile_up(part, sensor, law)
        part = part if part.dtype == torch.float64 else part.float()  # which counts bins to 16 million
        posterior, index = likelihood(part, sensor).softmax(-1), place + reach
        inside = (
            torch.ones_like(index, dtype=torch.bool) if is_circular(sensor) else (index >= 0) & (index < sensor.bins)
        )
        # no bin twice, where the window is as wide as the period
        return (posterior.gather(-1, index.remainder(sensor.bins)) * inside).sum(-1).clamp(max=1)

    fraction = by_pixels(near, rows, 0, estimate.long()).float()
    return torch.where(depth_m.isnan(), math.nan, fraction.reshape(depth_m.shape))


def confidence_map(histogram: Histogram, depth_m: np.ndarray, method: str = "log-matched") -> np.ndarray | None:
    """Return the probability of each pixel's estimate that it is no chance peak, (H, W) float32; None where the depth
    is not the recorded time that the probability is of, as beside a displaced laser."""
    if not time_tells_depth(histogram):
        return None
    counts, law = torch.from_numpy(histogram.counts), _undone_law(histogram, method)
    return confidence(counts, torch.from_numpy(depth_m), histogram.sensor, method, law=law).numpy()


def cramer_rao_m(arrival_s: Tensor, signal: Tensor, background_per_bin: Tensor, sensor: Sensor) -> Tensor:
    """Return lowest standard deviation of an unbiased depth estimate [m], (...,) float64, S and B known:

    c/2 [sum_i (S dh_i/dtau)^2 / (S h_i + B)]^(-1/2), with the exact derivative of the binned pulse. All three inputs
    broadcast: arrival [s], signal detections S, background detections B per bin. Infinite where S = 0.
    """
    signal, background = (torch.as_tensor(value).double().unsqueeze(-1) for value in (signal, background_per_bin))
    rate = signal * binned_pulse(arrival_s, sensor) + background
    slope = signal * binned_pulse_slope(arrival_s, sensor)
    information = torch.where(rate > 0, slope**2 / rate, 0.0).sum(-1)
    return SPEED_OF_LIGHT_M_PER_S / 2 * information**-0.5


def detection_law(histogram: Histogram) -> str | None:
    """Return the detection law that made a histogram, None where the sensor's detector is all that is known.

    `sense` states the law and the pile-up in `meta`. Measured counts state `poisson` and a pile-up of 0, since nobody
    knows either: there the answer is None, as it is where pile-up is too small to matter.
    """
    meta, sensor = histogram.meta, histogram.sensor
    law = meta.get("model")
    if law == "poisson":
        blind = meta.get("pile_up", 0.0) * max(1.0, sensor.dead_time_s / sensor.period_s)
        return law if blind > LOW_FLUX else None
    return law if law in LAWS else None


def _undone_law(histogram: Histogram, method: str) -> str | None:
    """Return `detection_law`; with `coates`, InputError for zones, which no law of a pixel's detector has acted on, and
    for what a .mat file held, which tells no law."""
    if method == "coates" and histogram.meta.get("layout") == "mat":
        raise InputError(
            "depth method coates: a .mat file holds no exposure, dead time and law, which undoing pile-up needs; use "
            "log-matched, the histogram (.h5), or Histogram.from_counts with the sensor that recorded the counts"
        )
    zones = histogram.meta.get("model") == "zones"
    refused = "depth method coates: undoes the pile-up of a pixel's detector; counts of a sensor of zones have none"
    require(not (zones and method == "coates"), f"{refused}, use log-matched")
    return detection_law(histogram)


def histogram_depth_m(
    histogram: Histogram, estimator: str | Callable[[Tensor, Sensor], Tensor] = "log-matched"
) -> np.ndarray:
    """Estimate the radial depth [m] of every pixel, (H, W) float32; NaN where a pixel has no count.

    `estimator` is one of METHODS, or any function (counts (H, W, T), sensor) -> half the optical path (H, W) [m].
    With a displaced laser that half path becomes a distance by the scene's geometry (`radial_depth_of`). `coates`
    undoes the law that made the histogram (`detection_law`). Raises InputError as `estimate_depth` does, and with
    `coates` for counts of a sensor of zones or from a .mat file.
    """
    counts = torch.from_numpy(histogram.counts)
    if isinstance(estimator, str):
        half_path = estimate_depth(counts, histogram.sensor, estimator, law=_undone_law(histogram, estimator))
    else:
        half_path = estimator(counts, histogram.sensor)
    return radial_depth_of(histogram, half_path.numpy())


def depth_errors(
    estimate: Tensor | np.ndarray,
    truth: Tensor | np.ndarray,
    *,
    range_m: float | np.ndarray,
    exclude: Tensor | np.ndarray | None = None,
) -> dict[str, float | int]:
    """Return error figures of a depth map against the truth [m], both of one shape, over the pixels not in `exclude`.

    mae_mm, rmse_mm, median_mm (signed) and median_abs_mm (of |error|) are over `pixels` of them. Left out and counted:
    empty (truth NaN), beyond_range (truth at the range, one for all or (H, W), or beyond), missing (estimate NaN or
    infinite). within_10mm is the share strictly under 10 mm of `pixels` and `missing` together: no estimate is no good
    one, and methods that answer for other pixels compare. What a masked array masks is NaN. Raises InputError for maps
    of other shapes, of no numbers, and of depths below 0.
    """
    estimate, truth = map(_metres, (estimate, truth))
    keep = (
        np.ones(truth.shape, bool)
        if exclude is None
        else ~np.array(exclude.cpu() if isinstance(exclude, Tensor) else exclude, dtype=bool)
    )
    if not estimate.shape == truth.shape == keep.shape:
        raise InputError(f"depth of shape {estimate.shape}, truth {truth.shape} and mask {keep.shape} must be alike")
    empty = keep & np.isnan(truth)
    beyond = keep & (truth >= range_m)
    missing = keep & ~empty & ~beyond & ~np.isfinite(estimate)
    error = (estimate - truth)[keep & ~empty & ~beyond & ~missing] * 1e3
    figures = dict.fromkeys(("mae_mm", "rmse_mm", "median_mm", "median_abs_mm", "within_10mm"), math.nan)
    if error.size:
        absolute = np.abs(error)
        figures |= {
            "mae_mm": float(absolute.mean()),
            "rmse_mm": float(np.sqrt((error**2).mean())),
            "median_mm": float(np.median(error)),
            "median_abs_mm": float(np.median(absolute)),
        }
    if asked := error.size + int(missing.sum()):
        figures["within_10mm"] = int((np.abs(error) < 10).sum()) / asked
    counted = {"empty": int(empty.sum()), "beyond_range": int(beyond.sum()), "missing": int(missing.sum())}
    return {**figures, "pixels": int(error.size), **counted}


def _metres(depth: Tensor | np.ndarray) -> np.ndarray:
    """Return a depth map as float64, NaN where it is masked."""
    array = np.ma.asarray(depth.cpu().numpy() if isinstance(depth, Tensor) else depth)
    require(array.dtype.kind in "iuf", f"depth map: values are {array.dtype}, expected real numbers")
    metres: np.ndarray = np.ma.filled(array.astype(np.float64), np.nan)
    negative = np.isfinite(metres) & (metres < 0)
    least = float(metres.min(initial=0.0, where=negative))
    require(not negative.any(), f"depth map: a depth of {least:g} m, expected 0 or more, or none (NaN)")
    return metres


def no_error_reason(errors: Mapping[str, float | int]) -> str | None:
    """Say why figures of `depth_errors` are over no pixel; None where they are over some."""
    if errors["pixels"]:
        return None
    if errors["missing"]:
        return "no estimate in range"
    return "no pixel in range" if errors["beyond_range"] else "no true depth"


def histogram_errors(
    depth_m: Tensor | np.ndarray, histogram: Histogram, *, exclude: np.ndarray | None = None
) -> dict[str, float | int]:
    """Return `depth_errors` against the truth of a histogram, of the pixels whose return its record can hold."""
    return depth_errors(depth_m, histogram.depth_m, range_m=recorded_range_m(histogram), exclude=exclude)
