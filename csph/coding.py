"""Compressive histograms: coding tensors, codes of a histogram or of its timestamps, and depth by correlation.

A pixel keeps K codes y_k = sum_i C[k, i] n_i instead of T counts n_i; a detection in bin i adds column i of C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from scenes.errors import InputError
from spad.depth import by_pixels, correlate, depth_in_range, grid_peak, noise_free_bias_m
from spad.sensor import Sensor
from spad.template import FINE_STEP, pulse_taps


@dataclass(frozen=True, eq=False)
class CodingTensor:
    """K codes over a block of Mt bins x Mr rows x Mc columns. So far of one pixel: Mr = Mc = 1, Mt = T.

    name      what it is called in results
    temporal  (K, Mt) float32
    """

    name: str
    temporal: Tensor
    rows: int = 1
    columns: int = 1

    def __post_init__(self) -> None:
        where = f"coding tensor {self.name}"
        if self.temporal.ndim != 2 or 0 in self.temporal.shape or not bool(self.temporal.isfinite().all()):
            raise InputError(f"{where}: shape {tuple(self.temporal.shape)}, expected finite values of shape (K, Mt)")
        if self.rows != 1 or self.columns != 1:
            raise InputError(f"{where}: a block of {self.rows} x {self.columns} pixels, only 1 x 1 is supported")
        object.__setattr__(self, "temporal", self.temporal.detach().float())

    @property
    def codes(self) -> int:
        """K"""
        return self.temporal.shape[0]

    @property
    def bins(self) -> int:
        """Mt"""
        return self.temporal.shape[1]

    @property
    def compression_ratio(self) -> float:
        """Mt Mr Mc / K"""
        return self.bins * self.rows * self.columns / self.codes


def truncated_fourier(codes: int, bins: int) -> Tensor:
    """(K, T) float32, rows cos and sin in turn of harmonics f = 1 .. K/2: cos(2 pi f (i + 1/2) / T), and sin.

    No harmonic 0, so that rows sum to zero and a uniform background leaves no trace; none from T/2 on, where the sine
    or the cosine vanishes at the bin centres. Raises InputError unless K is even and 2 <= K <= T - 2.
    """
    if codes % 2 or not 2 <= codes <= bins - 2:
        raise InputError(
            f"truncated Fourier: {codes} codes, expected an even number from 2 to {bins - 2} for {bins} bins"
        )
    harmonics = torch.arange(1, codes // 2 + 1, dtype=torch.int64).unsqueeze(-1)
    # The phase in half bins, an integer reduced before it becomes an angle: exact for every harmonic.
    half_bins = (harmonics * (2 * torch.arange(bins) + 1)) % (2 * bins)
    angle = half_bins.double() * (math.pi / bins)
    return torch.stack([angle.cos(), angle.sin()], dim=1).reshape(codes, bins).float()


def encode(counts: Tensor, coding: CodingTensor) -> Tensor:
    """y = C n: counts (..., T) -> codes (..., K) float32. Raises InputError for another number of bins."""
    if counts.ndim < 1 or counts.shape[-1] != coding.bins:
        shape = tuple(counts.shape)
        raise InputError(f"histogram of shape {shape}: the last axis must be the {coding.bins} bins of {coding.name}")
    if not counts.numel():
        return torch.empty((*counts.shape[:-1], coding.codes), device=counts.device)
    columns = coding.temporal.to(counts.device).T
    codes = by_pixels(lambda part: part.float() @ columns, counts.reshape(-1, coding.bins))
    return codes.reshape(*counts.shape[:-1], coding.codes)


def encode_timestamps(timestamps: Tensor, offsets: Tensor, coding: CodingTensor) -> Tensor:
    """Sum of the columns of C that a pixel's detections name, without a histogram: (P, K) float32.

    timestamps (N,) bin of each detection, any integer type, pixel after pixel; offsets (P + 1,) where each pixel's
    begin, and the end: 0 .. N. A pixel without detections gives zeros. Raises InputError for bad offsets or bins.
    """
    index, starts = timestamps.to(torch.int64), offsets.to(torch.int64)
    bounded = starts.ndim == 1 and len(starts) >= 1 and index.ndim == 1
    if not (bounded and starts[0] == 0 and starts[-1] == len(index) and bool((starts.diff() >= 0).all())):
        raise InputError(
            f"timestamp offsets must rise from 0 to the {index.numel()} timestamps, one entry more than pixels"
        )
    if len(index) and not (index.min() >= 0 and index.max() < coding.bins):
        low, high = int(index.min()), int(index.max())
        raise InputError(
            f"timestamps from {low} to {high} are outside the bins 0 to {coding.bins - 1} of {coding.name}"
        )
    columns = coding.temporal.to(index.device).T.contiguous()
    return torch.nn.functional.embedding_bag(index, columns, starts, mode="sum", include_last_offset=True)


@lru_cache(maxsize=8)
def _templates(coding: CodingTensor, sensor: Sensor, device: str) -> Tensor:
    """(T, G, K) float64: unit vectors P C h(tau) for arrivals at T bin centres and G steps of -1 to 1 bin around each.

    P removes the direction C 1 that a uniform background takes: nothing where rows sum to zero (Fourier), the mean
    over K for a coarse histogram. The mean over K is not removed where C 1 = 0: it would carry depth there, and of
    K = 2 codes only a sign would be left.
    """
    taps = pulse_taps(sensor, device)
    matrix = coding.temporal.double().to(device)
    first = int(taps.shifts[0])
    templates = torch.stack([correlate(matrix, step.unsqueeze(0), first, sensor).T for step in taps.fine], dim=1)
    uniform = matrix.sum(-1)
    uniform = torch.where(uniform.abs() > 1e-5 * matrix.abs().sum(-1), uniform, 0.0)
    if uniform.any():
        templates = templates - (templates @ uniform).unsqueeze(-1) * uniform / (uniform @ uniform)
    return templates / templates.norm(dim=-1, keepdim=True).clamp(min=1e-30)


def _raw_depth(codes: Tensor, coding: CodingTensor, sensor: Sensor) -> Tensor:
    templates = _templates(coding, sensor, str(codes.device))
    centre = templates.shape[1] // 2
    coarse = templates[:, centre].float().T

    def one(part: Tensor) -> Tensor:
        peak = (part.float() @ coarse).argmax(-1)
        # In float64: of K = 2 codes the score changes by 3e-7 over an eighth of one of 1024 bins.
        scores = (templates[peak] @ part.double().unsqueeze(-1)).squeeze(-1)
        bins = peak + 0.5 + (grid_peak(scores) - centre) * FINE_STEP
        return torch.where(part.any(-1), bins, math.nan)

    return by_pixels(one, codes, max(coding.bins, templates[0].numel())) * sensor.bin_depth_m


@lru_cache(maxsize=32)
def _bias_m(coding: CodingTensor, sensor: Sensor) -> float:
    return noise_free_bias_m(lambda counts: _raw_depth(encode(counts, coding), coding, sensor), sensor)


def decode_depth(codes: Tensor, coding: CodingTensor, sensor: Sensor) -> Tensor:
    """Depth [m] at the highest score <y, C h(tau)> / |C h(tau)| over arrivals tau, (..., K) -> (...,) float32.

    h(tau) is the binned pulse. Searched over the bin centres, then over a grid of eighths of a bin and a parabola; the
    noise-free answer is subtracted as in `spad.depth`. NaN where all codes are zero. Raises InputError for another
    number of codes or bins, and codes that are not finite.
    """
    if coding.bins != sensor.bins:
        raise InputError(f"coding tensor {coding.name} has {coding.bins} bins, sensor {sensor.name} has {sensor.bins}")
    if codes.ndim < 1 or codes.shape[-1] != coding.codes:
        raise InputError(
            f"codes of shape {tuple(codes.shape)}: the last axis must be the {coding.codes} of {coding.name}"
        )
    if not codes.numel():
        return torch.empty(codes.shape[:-1], device=codes.device)
    if not bool(codes.isfinite().all()):
        raise InputError(f"codes of {coding.name} are not all finite")
    depth = _raw_depth(codes.reshape(-1, coding.codes), coding, sensor) - _bias_m(coding, sensor)
    return depth_in_range(depth, sensor).reshape(codes.shape[:-1])
