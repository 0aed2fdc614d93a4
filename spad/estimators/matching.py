"""Filters of the depth estimators: counts (P, T) of many pixels -> arrival (P,) in bins, no answer subtracted yet."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from spad.sensor.model import Sensor
from spad.sensor.template import FINE_STEP, FINEST_STEP, Taps, pulse_taps

MAX_DIRECT_TAPS = 128
TOEPLITZ_ROWS = 64
END_STEPS = 32  # places looked at over four standard deviations of the pulse at an end of the bins


def is_circular(sensor: Sensor) -> bool:
    return sensor.bins == sensor.bins_per_period


def correlate(counts: Tensor, weights: Tensor, first: int, sensor: Sensor) -> Tensor:
    """Return sum_l weights[., l] counts[., j + first + l] for every bin j: (P, T), (P or 1, L) -> (P, T), circular if
    the sensor is. By direct sums, whose rounding does not depend on where a pixel's counts lie, unless L is large."""
    bins, taps = counts.shape[-1], weights.shape[-1]
    before, after = -first, taps - 1 + first
    if is_circular(sensor):
        ring = torch.cat([counts[:, bins - before :], counts, counts[:, :after]], dim=-1)
    else:
        ring = torch.nn.functional.pad(counts, (before, after))
    if taps > MAX_DIRECT_TAPS:
        size = ring.shape[-1]
        spectrum = torch.fft.rfft(ring.double()) * torch.fft.rfft(weights.double(), n=size).conj()
        return torch.fft.irfft(spectrum, n=size)[:, :bins]
    if counts.device.type == "cpu":  # one kernel a pixel: three to five times faster than the sum below
        kernels = weights.expand(len(counts), taps).unsqueeze(1)
        return torch.nn.functional.conv1d(ring.unsqueeze(0), kernels, groups=len(counts)).squeeze(0)
    scores = weights[:, :1] * ring[:, :bins]  # not by convolution: that rounds to 10 bits (TF32) on recent GPUs
    for tap in range(1, taps):
        scores.addcmul_(weights[:, tap : tap + 1], ring[:, tap : tap + bins])
    return scores


def _around(counts: Tensor, peak: Tensor, shifts: Tensor, sensor: Sensor) -> tuple[Tensor, Tensor]:
    """Gather the counts of the bins around a peak, and whether the bins exist: (P, T), (P,) -> (P, L) float64 twice."""
    index = peak.unsqueeze(-1) + shifts
    exists = torch.ones_like(index, dtype=torch.bool)
    if not is_circular(sensor):
        exists = (index >= 0) & (index < sensor.bins)
    near = counts.gather(-1, torch.remainder(index, sensor.bins)).double()
    return near * exists, exists.double()


def grid_peak(scores: Tensor) -> Tensor:
    """Return position of the maximum of (..., G) scores in grid steps, (...,) float64: a parabola through the largest
    score and its neighbours; the middle of the first and last of equal maxima, where scores are flat."""
    size = scores.shape[-1]
    first = scores.argmax(-1)
    last = size - 1 - scores.flip(-1).argmax(-1)
    middle = first.clamp(1, size - 2).unsqueeze(-1)
    left, top, right = (scores.gather(-1, middle + step).squeeze(-1).double() for step in (-1, 0, 1))
    bend = left - 2 * top + right
    shift = torch.where(bend < 0, 0.5 * (left - right) / bend, 0.0).clamp(-1, 1)
    return torch.where(first == last, middle.squeeze(-1) + shift, (first + last) / 2)


def argmax_bins(counts: Tensor, sensor: Sensor) -> Tensor:
    return counts.argmax(-1).double() + 0.5


def _matched_peak(counts: Tensor, sensor: Sensor, taps: Taps) -> Tensor:
    """Bin (P,) in whose centre the correlation with the pulse is largest."""
    weights = taps.centred[taps.coarse].to(counts.dtype).unsqueeze(0)
    return correlate(counts, weights, int(taps.shifts[taps.coarse][0]), sensor).argmax(-1)


def matched_bins(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return peak of <n - mean n, h(tau)> / |h(tau) - mean h|: the mean takes a uniform background out, the norm makes
    the noise-free pulse score highest at its true arrival (Cauchy-Schwarz) also where |h| depends on the sub-bin
    phase."""
    taps = pulse_taps(sensor, str(counts.device))
    peak = _matched_peak(counts, sensor, taps)
    near, _ = _around(counts, peak, taps.shifts, sensor)
    total = counts.sum(-1).double().unsqueeze(-1)

    def scores_of(pulses: Tensor) -> Tensor:
        mean = pulses.sum(-1) / sensor.bins
        square = (pulses**2).sum(-1) - sensor.bins * mean**2
        return ((pulses @ near.unsqueeze(-1)).squeeze(-1) - total * mean) / square.clamp(min=1e-30).sqrt()

    return peak + 0.5 + _best_step(scores_of, taps)


def _best_step(scores_of: Callable[[Tensor], Tensor], taps: Taps) -> Tensor:
    """Find the arrival after the bin's centre, in bins (P,): on the fine grid, and for a narrow pulse on a finer one
    around it.

    `scores_of` takes pulses (G, L), or of each pixel (P, G, L), and gives scores (P, G).
    """
    best = grid_peak(scores_of(taps.fine))
    if taps.finest is None:
        return best * FINE_STEP - 1
    steps = round(FINE_STEP / FINEST_STEP)
    rows = best.round().long().unsqueeze(-1) * steps + torch.arange(2 * steps + 1, device=best.device)
    return (rows[:, 0] + grid_peak(scores_of(taps.finest[rows]))) * FINEST_STEP - 1 - FINE_STEP


def _signal_and_background(
    near: Tensor, exists: Tensor, total: Tensor, sensor: Sensor, taps: Taps
) -> tuple[Tensor, Tensor]:
    """Signal S and background B per bin, (P,) each, by two moments: counts inside a window of +-2 sigma around the peak
    = m S + W B, all counts = M S + T B, where m and M are the pulse's shares in the window and in all bins (M = 1 but
    at the edge of bins that do not cover the period), W the window's bins.

    Floors of half a count on S and on T B (the mean of Jeffreys' prior after no count) keep pixels without background
    or without signal finite: at B = 0 a single stray count would otherwise have likelihood zero.
    """
    inside = (near * taps.window).sum(-1)
    fraction = (exists * taps.window * taps.centred).sum(-1)
    width = (exists * taps.window).sum(-1)
    whole = exists @ taps.centred
    background = (fraction * total - whole * inside) / (fraction * sensor.bins - whole * width).clamp(
        min=1e-6 * sensor.bins
    )
    background = background.clamp(min=0.5 / sensor.bins)
    return (total - sensor.bins * background).clamp(min=0.5) / whole, background


def likelihood(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return log-likelihood of an arrival in the centre of each bin, up to a constant of the pixel, (P, T) -> (P, T).

    S and B are those at the matched filter's peak. The weights depend on S / B through a logarithm, so rough estimates
    serve: with the true S and B the share of outliers changes by less than 0.3 % of the pixels and the others' rms by
    less than 1.3 %, at six levels from (2, 2) to (50, 5000) detections (measured). One pass is enough.
    """
    taps = pulse_taps(sensor, str(counts.device))
    total = counts.sum(-1).double()
    peak = _matched_peak(counts, sensor, taps)
    near, exists = _around(counts, peak, taps.shifts, sensor)
    signal, background = _signal_and_background(near, exists, total, sensor, taps)

    # log(S h + B) = log B + log(1 + S h / B), and sum_i n_i log B does not depend on tau: only taps with h > 0 count.
    ratio = (signal / background).unsqueeze(-1)
    weights = torch.log1p(ratio * taps.centred[taps.coarse]).to(counts.dtype)
    first = int(taps.shifts[taps.coarse][0])
    scores = correlate(counts, weights, first, sensor)
    if not is_circular(sensor):
        # What falls outside the bins is not expected there: the term S sum_i h_i(tau) is no longer constant.
        seen = correlate(torch.ones_like(counts[:1]), taps.centred[taps.coarse].to(counts.dtype)[None], first, sensor)
        scores = scores - signal.to(counts.dtype).unsqueeze(-1) * seen
    return scores


def _peak_at_an_end(counts: Tensor, peak: Tensor, sensor: Sensor, taps: Taps) -> Tensor:
    """Return the likeliest bins (P,), given those that are so by one S and B a pixel: others where a part of the pulse
    lies outside the bins.

    There S depends on how much of it does. Of a wide pulse the place that S and B were estimated at would keep the
    answer beside it, so that bins near that end have an S and B each: some of them, then all between two of those.
    """
    best, bins = peak.clone(), sensor.bins
    if is_circular(sensor):
        return best
    before, after = -int(taps.shifts[taps.window][0]), int(taps.shifts[taps.window][-1])
    first, last = (0, min(2 * before, bins) - 1), (max(bins - 2 * after, 0), bins - 1)
    for near_end, (low, high) in ((peak < before, first), (peak >= bins - after, last)):
        rows = torch.nonzero(near_end).squeeze(1)
        if not len(rows):
            continue
        some, stride = counts[rows], max(1, (high - low) // END_STEPS)
        places = [best[rows], *(torch.full_like(rows, place) for place in range(low, high + 1, stride))]
        found = _likeliest(some, places, sensor, taps)
        places = [(found + shift).clamp(low, high) for shift in range(1 - stride, stride)]
        best[rows] = _likeliest(some, places, sensor, taps)
    return best


def _likeliest(counts: Tensor, places: list[Tensor], sensor: Sensor, taps: Taps) -> Tensor:
    """Return that of some bins (P,) whose centre is the likeliest arrival."""
    scores = torch.stack([_profile(counts, place, sensor, taps) for place in places], -1)
    return torch.stack(places, -1).gather(-1, scores.argmax(-1, keepdim=True)).squeeze(-1)


def _profile(counts: Tensor, place: Tensor, sensor: Sensor, taps: Taps) -> Tensor:
    """Return log-likelihood of arrivals in the centres of bins (P,), S and B estimated there, up to a constant of the
    pixel."""
    near, exists = _around(counts, place, taps.shifts, sensor)
    total = counts.sum(-1).double()
    signal, background = _signal_and_background(near, exists, total, sensor, taps)
    expected = signal * (exists @ taps.centred) + sensor.bins * background
    ratio = (signal / background).unsqueeze(-1) * taps.centred
    return (near * torch.log1p(ratio)).sum(-1) + total * torch.log(background) - expected


def log_matched_bins(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return Poisson maximum likelihood over all bin centres, then around the best on a grid of eighths of a bin."""
    taps = pulse_taps(sensor, str(counts.device))
    total = counts.sum(-1).double()
    peak = _peak_at_an_end(counts, likelihood(counts, sensor).argmax(-1), sensor, taps)
    near, exists = _around(counts, peak, taps.shifts, sensor)
    _, background = _signal_and_background(near, exists, total, sensor, taps)
    # S at its most likely for each tau, the signal counted over the share of the pulse that the bins see: the term
    # S sum_i h_i(tau) is then the same for every tau, and a pulse half outside the bins is not pulled inwards.
    counted = (total - sensor.bins * background).clamp(min=0.5).unsqueeze(-1)

    def scores_of(pulses: Tensor) -> Tensor:
        seen = (pulses @ exists.unsqueeze(-1)).squeeze(-1).clamp(min=1e-3)
        ratio = (counted / seen / background.unsqueeze(-1)).unsqueeze(-1)
        return (torch.log1p(ratio * pulses) @ near.unsqueeze(-1)).squeeze(-1)

    return peak + 0.5 + _best_step(scores_of, taps)


def published_log_matched_bins(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return argmax_j sum_l n_(j + l) log(1 + h_l), h the unit-sum pulse, whole bins: the filter of the ICCV 2023 code.

    It knows neither S nor B. Answered at the bin's centre; the published answer is a bin more, by two indices from 1.
    """
    taps = pulse_taps(sensor, str(counts.device))
    weights = torch.log1p(taps.centred).to(counts.dtype).unsqueeze(0)
    return correlate(counts, weights, int(taps.shifts[0]), sensor).argmax(-1).double() + 0.5


def correlation(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return <n - mean n, h(tau) - mean h> for the pulse h in the centre of each bin, (P, T) -> (P, T)."""
    taps = pulse_taps(sensor, str(counts.device))
    mean = (taps.centred.sum() / sensor.bins).to(counts.dtype)
    scores = correlate(counts, taps.centred.to(counts.dtype).unsqueeze(0), int(taps.shifts[0]), sensor)
    return scores - counts.sum(-1, keepdim=True) * mean


def normalised_correlation(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return zero-normalised cross-correlation (ZNCC) with the pulse in the centre of each bin, in [-1, 1], (B, T, P)
    -> (B, T, P); 0 where all bins of a pixel hold the same."""
    taps = pulse_taps(sensor, str(counts.device))
    pulse, mean = taps.centred, counts.mean(1, keepdim=True)
    norm = ((pulse**2).sum() - pulse.sum() ** 2 / sensor.bins).sqrt().to(counts.dtype)
    spread = torch.linalg.vector_norm(counts - mean, dim=1, keepdim=True)
    scores = _correlate_all(counts, pulse.to(counts.dtype), int(taps.shifts[0]), sensor)
    return scores.sub_(mean * pulse.sum().to(counts.dtype)).div_((spread * norm).clamp(min=1e-6))


def _correlate_all(counts: Tensor, weights: Tensor, first: int, sensor: Sensor) -> Tensor:
    """`correlate` for one set of weights (L,) and bins that come before pixels, (B, T, P): blocks of bins by one small
    Toeplitz matrix each, in place of two transpositions and a kernel a pixel (a sixth of the time on 72 x 88)."""
    (batch, bins, pixels), taps = counts.shape, len(weights)
    before, after, rest = -first, taps - 1 + first, -bins % TOEPLITZ_ROWS
    edges = [counts.new_zeros(batch, size, pixels) for size in (before, after + rest)]
    if is_circular(sensor):
        edges = [counts[:, bins - before :], torch.cat([counts[:, :after], edges[1][:, :rest]], dim=1)]
    ring = torch.cat([edges[0], counts, edges[1]], dim=1)
    width = TOEPLITZ_ROWS + taps - 1
    rows = torch.nn.functional.pad(weights, (0, TOEPLITZ_ROWS)).repeat(TOEPLITZ_ROWS)
    matrix = rows[: TOEPLITZ_ROWS * width].view(TOEPLITZ_ROWS, width)  # each row begins a place further right
    return (matrix @ ring.unfold(1, width, TOEPLITZ_ROWS).mT).reshape(batch, -1, pixels)[:, :bins]


def correlation_bins(counts: Tensor, sensor: Sensor) -> Tensor:
    """Return peak over whole bins of the zero-normalised cross-correlation (ZNCC) with the pulse in a bin's centre, and
    a parabola through its neighbours. `matched_bins` knows the pulse at every place within a bin, this one does not."""
    taps = pulse_taps(sensor, str(counts.device))
    best = correlation(counts, sensor).argmax(-1)  # the counts' own norm is the same for every bin
    near, _ = _around(counts, best, taps.shifts, sensor)
    neighbours = taps.fine[[0, len(taps.steps) // 2, -1]]  # a bin before, here, a bin after
    total = counts.sum(-1, keepdim=True).double()
    return best + 0.5 + (grid_peak(near @ neighbours.T - total * neighbours.sum(-1) / sensor.bins) - 1)
