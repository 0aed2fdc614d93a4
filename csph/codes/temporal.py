"""Temporal codes: K rows over Mt time bins, each a function of nothing but its numbers (and a pulse, or a seed).

fourier   cos and sin of harmonics 1, 2, 3, ...
gray      cos and sin of harmonics 1, 2, 4, 8, ... as far as the pulse's band reaches, then of those left out
coarse    K gates of Mt/K bins: a histogram of wider bins
hadamard  Walsh functions by number of sign changes, 1, 2, 3, ...
random    uniform numbers, as learned codes begin

fourier-published, gray-published   the same harmonics in the published rows: cos and MINUS sin, at bins n = 0, 1, ...
instead of bin centres n + 1/2; Gray's band is that of the pulse's published taps, which are not averaged over a bin

Every pair of published rows is one of ours, turned and mirrored, so that `csph.codes.decode` finds the same depths.
The mean over K is another one, and so are zero-normalised back-projections (`csph.layer`) and what networks make of
them: the largest value of that of 8 codes is, at 10 + 50 photons on the reference sensor, 59 instead of 46 bins off at
1.3 to 2.9 m, and 30 instead of 33 bins 7 m farther.
"""

from __future__ import annotations

import math
from dataclasses import replace
from numbers import Integral

import numpy as np
import torch
from torch import Tensor

from csph.codes.waves import Rows, truncated_waves, waves
from scenes.errors import InputError, did_you_mean, require
from scenes.random_streams import Stream
from spad.formats.rgbd import published_taps
from spad.sensor.model import Sensor
from spad.sensor.template import binned_pulse

FIXED_CODES = ("fourier", "gray", "coarse", "hadamard", "random", "fourier-published", "gray-published")
GROUPS = 64  # of neighbouring time bins that `grouped_energy` tells apart
BAND_LIMIT = 0.2  # of the pulse's spectrum at harmonic 1: what Gray Fourier keeps
MAX_SEED = (1 << 63) - 1  # torch's generators take a bit more


def temporal_code(name: str, codes: int, bins: int, sensor: Sensor, seed: int = 0) -> Tensor:
    """Return (K, Mt) float32 of one of FIXED_CODES; the sensor lends its pulse to the Gray codes, the seed is
    `random`'s.

    Raises InputError for another name and for K that is no whole number or does not fit the code.

    Examples
    --------
    >>> import csph
    >>> import spad
    >>> csph.temporal_code("coarse", 2, 4, spad.sensor_by_name("reference"))
    tensor([[1., 1., 0., 0.],
            [0., 0., 1., 1.]])
    """
    makers = {
        "fourier": lambda: truncated_fourier(codes, bins),
        "gray": lambda: gray_fourier(codes, bins, block_pulse(bins, sensor)),
        "coarse": lambda: coarse_gates(codes, bins),
        "hadamard": lambda: walsh_hadamard(codes, bins),
        "random": lambda: _random(codes, bins, seed),
        "fourier-published": lambda: truncated_fourier(codes, bins, "published"),
        "gray-published": lambda: gray_fourier(codes, bins, published_pulse(bins, sensor), "published"),
    }
    meant = did_you_mean(name, FIXED_CODES) if isinstance(name, str) else ""
    require(name in makers, f"temporal code {name!r} is unknown{meant}, expected one of {', '.join(FIXED_CODES)}")
    whole = isinstance(codes, Integral) and not isinstance(codes, bool) and codes >= 1
    require(whole, f"{name} code: {codes!r} codes, expected a whole number, 1 or more")
    return makers[name]()


def _random(codes: int, bins: int, seed: int) -> Tensor:
    require(codes <= bins, f"random code: {codes} codes, the limit is one a bin, {bins}")
    return uniform_start((codes, bins), bins, seed)


def truncated_fourier(codes: int, bins: int, rows: Rows = "centred") -> Tensor:
    """Return cos and sin in turn of harmonics f = 1 .. K/2, (K, T) float32: cos(2 pi f (i + 1/2) / T), and sin.

    `rows` = "published": cos(2 pi f i / T), and -sin. No harmonic 0, so that rows sum to zero and a uniform background
    leaves no trace; none from T/2 on, where the sine or the cosine vanishes. Raises InputError unless K is even and
    2 <= K < T.

    Examples
    --------
    >>> import csph
    >>> waves = csph.truncated_fourier(4, 16)
    >>> tuple(waves.shape), waves.sum(dim=1).abs().max().item() < 1e-5
    ((4, 16), True)
    """
    return torch.from_numpy(truncated_waves(codes, bins, rows))


def block_pulse(bins: int, sensor: Sensor) -> Tensor:
    """Return (Mt,) float64: the binned pulse of an arrival at the centre of bin 0, on a circle of Mt of the sensor's
    bins."""
    return binned_pulse(torch.tensor(0.5 * sensor.bin_width_s), circle_of(bins, sensor))


def published_pulse(bins: int, sensor: Sensor) -> Tensor:
    """Return (Mt,) float64: the pulse's published taps (`rgbd.published_taps`) from bin 0 on, one sample a bin."""
    taps = torch.from_numpy(published_taps(circle_of(bins, sensor)))
    return torch.nn.functional.pad(taps, (0, bins - len(taps)))


def circle_of(bins: int, sensor: Sensor) -> Sensor:
    """Return the sensor on a period of `bins` bins: what a block of that many bins sees of a periodic pulse."""
    name, period_s = f"{sensor.name}, {bins} bins", bins * sensor.bin_width_s
    return replace(sensor, name=name, bins=bins, period_s=period_s, tdc=None)


def gray_frequencies(pulse: Tensor) -> list[int]:
    """Return harmonics in the order that Gray Fourier takes them, for a pulse (Mt,) sampled on a circle of Mt bins.

    Usable are those below Mt/2 where the pulse's spectrum is at least 0.2 of that at harmonic 1; among them the powers
    of two come first, then the others, ascending (Gutierrez-Barragan et al., CVPR 2022, as published for ICCV 2023).
    """
    spectrum = torch.fft.rfft(pulse.double()).abs()
    inside = spectrum[1 : (len(pulse) + 1) // 2] >= BAND_LIMIT * spectrum[1:2]  # of one bin both are empty
    usable = [f for f, kept in enumerate(inside.tolist(), start=1) if kept]
    return sorted(usable, key=lambda f: (f & (f - 1) != 0, f))


def gray_fourier(codes: int, bins: int, pulse: Tensor, rows: Rows = "centred") -> Tensor:
    """Return cos and sin in turn of the first K/2 of `gray_frequencies`, (K, Mt) float32, as `truncated_fourier` does.

    Raises InputError where there are fewer.
    """
    frequencies = gray_frequencies(pulse)
    require(len(frequencies) > 0, f"Gray Fourier: {bins} bins hold no harmonic, expected 3 bins or more")
    if codes % 2 or not 2 <= codes <= 2 * len(frequencies):
        raise InputError(
            f"Gray Fourier: {codes} codes, expected an even number from 2 to {2 * len(frequencies)}: the pulse's band "
            f"holds {len(frequencies)} harmonics of {bins} bins"
        )
    return torch.from_numpy(waves(frequencies[: codes // 2], bins, rows))


def coarse_gates(codes: int, bins: int) -> Tensor:
    """Return (K, Mt) float32: row k is 1 in bins k Mt/K to (k + 1) Mt/K, else 0. InputError unless K divides Mt."""
    require(1 <= codes <= bins and bins % codes == 0, f"coarse histogram: {codes} gates do not divide {bins} bins")
    return torch.eye(codes).repeat_interleave(bins // codes, dim=1)


def walsh_hadamard(codes: int, bins: int) -> Tensor:
    """Return (K, Mt) float32 of +-1: the Walsh functions with 1 .. K sign changes, so that every row sums to zero.

    Entry (s, i) is (-1)^popcount(i & r), r the bit-reversed Gray code of s. Raises InputError unless Mt is a power of
    two and K <= Mt - 1.
    """
    bits = bins.bit_length() - 1
    require(bins == 1 << bits and bits >= 1, f"Walsh-Hadamard: {bins} bins, expected a power of two from 2 on")
    require(1 <= codes <= bins - 1, f"Walsh-Hadamard: {codes} codes, expected 1 to {bins - 1} for {bins} bins")
    rows = [int(f"{s ^ (s >> 1):0{bits}b}"[::-1], 2) for s in range(1, codes + 1)]
    common = torch.tensor(rows).unsqueeze(-1) & torch.arange(bins)
    parity = torch.zeros_like(common)
    for bit in range(bits):
        parity ^= common >> bit & 1
    return (1 - 2 * parity).float()


def spatial_seed(seed: int) -> int:
    """Return the seed of the spatial codes that begin beside temporal codes of `seed`, of 32 bits: torch's generator
    on CPUs takes no more of a seed, so that seeds further apart can be the same one."""
    _require_seed(seed)
    return int(np.random.SeedSequence(seed, spawn_key=(Stream.SPATIAL_CODES,)).generate_state(1)[0])


def _require_seed(seed: int) -> None:
    require(0 <= seed <= MAX_SEED, f"seed {seed} is outside 0 to {MAX_SEED}")


def _generator(seed: int) -> torch.Generator:
    _require_seed(seed)
    return torch.Generator().manual_seed(seed)


def uniform_start(shape: tuple[int, ...], taps: int, seed: int) -> Tensor:
    """Return uniform in +-1/sqrt(taps), float32: where learned factors begin; taps is the number of entries of one
    code. Raises InputError for a seed that is no generator's."""
    generator = _generator(seed)
    return (2 * torch.rand(shape, generator=generator) - 1) / math.sqrt(taps)


def orthogonal_start(shape: tuple[int, ...], taps: int, seed: int) -> Tensor:
    """Return codes (K, ...) of `taps` entries, float32: rows of random orthogonal matrices, one under the other.

    All rows have the root mean square length of `uniform_start`'s, 1/sqrt(3). Any `taps` rows that follow one another
    from a multiple of `taps` are orthogonal; of K a multiple of `taps` so are the columns, and the rank is full.
    Raises InputError for a seed that is no generator's.
    """
    generator = _generator(seed)
    stacked = []
    for _ in range(math.ceil(shape[0] / taps)):
        factor, triangle = torch.linalg.qr(torch.randn(taps, taps, generator=generator, dtype=torch.float64))
        stacked.append(factor * triangle.diagonal().sign())  # then every orthogonal matrix is as likely
    return (torch.cat(stacked)[: shape[0]] / math.sqrt(3)).reshape(shape).float()


def bin_energy(temporal: Tensor) -> np.ndarray:
    """Return (Mt,) float64: mean over K (and pixels) of C~^2 in each time bin, C~ = C less its mean over time."""
    code = temporal.detach().double().cpu()
    code = code - code.mean(1, keepdim=True)
    return code.square().transpose(0, 1).flatten(1).mean(1).numpy()


def grouped_energy(temporal: Tensor) -> np.ndarray:
    """Return `bin_energy` averaged over each of at most GROUPS groups of neighbouring bins."""
    energy = bin_energy(temporal)
    groups = next(n for n in range(min(GROUPS, len(energy)), 0, -1) if len(energy) % n == 0)
    return energy.reshape(groups, -1).mean(1)
