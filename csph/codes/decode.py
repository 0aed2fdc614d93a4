"""Depth from codes by correlation over K, without a network: for codes of one pixel over all its time bins."""

from __future__ import annotations

import logging
import math
from functools import lru_cache
from weakref import WeakSet

import numpy as np
import torch
from torch import Tensor

from csph.codes.tensor import CodingTensor, as_tensor, encode
from scenes.errors import InputError, require, require_kind
from spad.estimators.depth import by_pixels, correlate, depth_in_range, grid_peak, noise_free_bias_m
from spad.estimators.matching import is_circular
from spad.sensor.model import Sensor
from spad.sensor.template import FINE_STEP, pulse_taps

log = logging.getLogger("csph")

_TOLD: WeakSet[CodingTensor] = WeakSet()  # whose rank was warned of
SEEN, SEEN_BEST = 0.1, 0.9  # of the largest |P C h|
_TIE = 1e-6  # of the largest score: what float32 sums cannot tell apart


def _matrix(coding: CodingTensor, device: str = "cpu") -> Tensor:
    return coding.tensor.flatten(1).double().to(device)


def _background(matrix: Tensor) -> Tensor:
    """Compute C 1, (K,): what a uniform background adds to the codes; 0 where it is no more than rounding."""
    uniform = matrix.sum(-1)
    return torch.where(uniform.abs() > 1e-5 * matrix.abs().sum(-1), uniform, 0.0)


@lru_cache(maxsize=32)
def decoded_rank(coding: CodingTensor) -> int:
    """Return the rank of P C, P as in `_templates`: how many directions of the codes depth is found from.

    A direction counts if its singular value tells two scores apart, whose templates it turns by an angle a: a^2 / 2
    must exceed a tie. It must exceed what the rounding of C to float32 leaves, too.
    """
    matrix = _matrix(coding)
    uniform = _background(matrix)
    left = matrix - torch.outer(uniform, uniform @ matrix) / (uniform @ uniform) if uniform.any() else matrix
    values = torch.linalg.svdvals(left)
    resolved = math.sqrt(2 * _TIE) * float(values[0])
    return int((values > max(resolved, torch.finfo(torch.float32).eps * float(matrix.norm()))).sum())


def check_decodable(coding: CodingTensor) -> None:
    """Raise InputError for codes from which correlation finds no depth: one code, or `decoded_rank` below 2.

    Two codes that do not sum to zero may have rank 1: more is not left of them, and its sign tells two gates apart.
    """
    require(coding.codes >= 2, f"{coding.name}: 1 code tells nothing but a sign, correlation over K needs 2 or more")
    rank, least = decoded_rank(coding), min(2, coding.codes - bool(_background(_matrix(coding)).any()))
    ranked = f"coding tensor {coding.name}: its {coding.codes} codes have rank {rank} where a uniform background is"
    require(rank >= least, f"{ranked} removed, depth by correlation needs {least} or more")


def warn_of_rank(coding: CodingTensor, name: str, *, lost: int = 0) -> None:
    """Warn, once of a coding tensor, where fewer of its codes than all but `lost` tell depth, as they depend on each
    other; `name` comes first."""
    rank = decoded_rank(coding)
    if rank < coding.codes - lost and coding not in _TOLD:
        _TOLD.add(coding)
        message = "%s: its %d codes have rank %d where a uniform background is removed: so many numbers tell depth"
        log.warning(message, name, coding.codes, rank)


@lru_cache(maxsize=8)
def _templates(coding: CodingTensor, sensor: Sensor, device: str) -> Tensor:
    """Compute the unit vectors P C h(tau), (T, G, K) float64, for arrivals at T bin centres and G steps of -1 to 1 bin
    around each.

    P removes the direction C 1 that a uniform background takes: nothing where rows sum to zero (Fourier), the mean
    over K for a coarse histogram. The mean over K is not removed where C 1 = 0: it would carry depth there, and of
    K = 2 codes only a sign would be left.
    """
    templates = _coded_pulses(coding, sensor, device)
    return templates / templates.norm(dim=-1, keepdim=True).clamp(min=1e-30)


def _coded_pulses(coding: CodingTensor, sensor: Sensor, device: str) -> Tensor:
    """Compute P C h(tau) of `_templates`, not normalised."""
    taps = pulse_taps(sensor, device)
    matrix = _matrix(coding, device)
    first = int(taps.shifts[0])
    pulses = torch.stack([correlate(matrix, step.unsqueeze(0), first, sensor).T for step in taps.fine], dim=1)
    uniform = _background(matrix)
    if uniform.any():
        pulses = pulses - (pulses @ uniform).unsqueeze(-1) * uniform / (uniform @ uniform)
    return pulses


def _first_peak(scores: Tensor, circular: bool) -> Tensor:
    """Bin of the largest of (P, T) scores; the first of equals, not whichever rounding favours, and the middle of a
    run of equals, as within the gates of a coarse histogram. A run at the end of a circle goes on at its beginning."""
    bins = scores.shape[-1]
    top = scores >= scores.amax(-1, keepdim=True) - _TIE * scores.abs().amax(-1, keepdim=True)
    first = top.byte().argmax(-1, keepdim=True)
    beyond = ~top & (torch.arange(bins, device=scores.device) > first)
    end = torch.where(beyond.any(-1), beyond.byte().argmax(-1), bins)
    start = first.squeeze(-1)
    if circular:
        start = torch.where(top[:, 0] & (end < bins), -(~top).flip(-1).byte().argmax(-1), start)
    return (start + end - 1).div(2, rounding_mode="floor") % bins


def _raw_depth(codes: Tensor, coding: CodingTensor, sensor: Sensor) -> Tensor:
    templates = _templates(coding, sensor, str(codes.device))
    centre = templates.shape[1] // 2
    coarse, circular = templates[:, centre].float().T, is_circular(sensor)

    def one(part: Tensor) -> Tensor:
        peak = _first_peak(part.float() @ coarse, circular)
        # In float64: of K = 2 codes the score changes by 3e-7 over an eighth of one of 1024 bins.
        scores = (templates[peak] @ part.double().unsqueeze(-1)).squeeze(-1)
        bins = peak + 0.5 + (grid_peak(scores) - centre) * FINE_STEP
        return torch.where(part.any(-1), bins, math.nan)

    return by_pixels(one, codes, max(coding.bins, templates[0].numel())) * sensor.bin_depth_m


@lru_cache(maxsize=32)
def _bias_m(coding: CodingTensor, sensor: Sensor) -> float:
    place = _seen_bin(coding, sensor)
    return noise_free_bias_m(lambda counts: _raw_depth(encode(counts, coding), coding, sensor), sensor, place)


def _seen_bin(coding: CodingTensor, sensor: Sensor) -> int:
    """Return the middle bin, or where codes hardly see a pulse there, as those of a gate beside it, the middle one of
    the bins that they see best."""
    pulses = _coded_pulses(coding, sensor, "cpu")
    seen, middle = pulses[:, pulses.shape[1] // 2].norm(dim=-1), coding.bins // 2
    if seen[middle] >= SEEN * seen.max():
        return middle
    best = torch.nonzero(seen >= SEEN_BEST * seen.max()).flatten()
    return int(best[len(best) // 2])


def decode_depth(codes: Tensor | np.ndarray, coding: CodingTensor, sensor: Sensor) -> Tensor:
    """Return depth [m] at the highest score <y, C h(tau)> / |C h(tau)| over arrivals tau, (..., K) -> (...,) float32.

    `codes` may be a numpy array. h(tau) is the binned pulse. Searched over the bin centres, then over a grid of
    eighths of a bin and a parabola; of equal scores the first, of neighbours that score alike their middle; the
    noise-free answer is subtracted as in `spad.estimators.depth`. NaN where all codes are zero. Codes that depend on
    each other are warned of, once; the number that goes with a background is none of those. Raises InputError for
    another number of codes or bins, codes that are not finite, and a coding tensor of rank below 2.

    Examples
    --------
    Eight Fourier codes in place of 1024 counts hold a depth of 4 m:

    >>> import numpy as np
    >>> import scene2spad as s2s
    >>> wall = s2s.transient_from_rgbd(np.full((1, 2), 4.0), np.ones((1, 2)), np.zeros((1, 2)))
    >>> histogram = s2s.sense(wall, signal=2000, background=0)  # photons a pixel
    >>> fourier = s2s.coding_tensor("fourier", 8)
    >>> depth_m = s2s.decode_depth(s2s.encode(histogram.counts, fourier), fourier, histogram.sensor)
    >>> bool((abs(depth_m - 4.0) < 0.05).all())
    True
    """
    require_kind(coding, CodingTensor, "decode_depth", " of `coding_tensor`")
    require_kind(sensor, Sensor, "decode_depth")
    codes = as_tensor(codes)
    if coding.bins != sensor.bins:
        raise InputError(f"coding tensor {coding.name} has {coding.bins} bins, sensor {sensor.name} has {sensor.bins}")
    check_decodable(coding)
    if codes.ndim < 1 or codes.shape[-1] != coding.codes:
        raise InputError(
            f"codes of shape {tuple(codes.shape)}: the last axis must be the {coding.codes} of {coding.name}"
        )
    if not codes.numel():
        return torch.empty(codes.shape[:-1], device=codes.device)
    if not bool(codes.isfinite().all()):
        raise InputError(f"codes of {coding.name} are not all finite")
    warn_of_rank(coding, f"coding tensor {coding.name}", lost=int(_background(_matrix(coding)).any()))
    depth = _raw_depth(codes.reshape(-1, coding.codes), coding, sensor) - _bias_m(coding, sensor)
    return depth_in_range(depth, sensor).reshape(codes.shape[:-1])
