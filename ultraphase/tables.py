"""The integer matrices that the programs compute, and their tables from int8 coding tensors.

A matrix is (codes, timestamps) int64: a photon at timestamp t adds column t to the core's codes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenes.errors import InputError, require

INT8_SCALE = 127  # a coding tensor's 1.0


def int8_codes(tensor: np.ndarray) -> np.ndarray:
    """Return round(127 C) of a coding tensor with values in [-1, 1], int64, clipped to +-127: +-128 would wrap in int8.

    Raises InputError for values that are not finite.
    """
    require(bool(np.isfinite(tensor).all()), "coding tensor holds values that are not finite")
    scaled = np.rint(INT8_SCALE * np.asarray(tensor, np.float64))
    return scaled.clip(-INT8_SCALE, INT8_SCALE).astype(np.int64)


def quarter_wave(matrix: np.ndarray) -> np.ndarray:
    """Return the table of the Fourier programs: the first quarter of the first row of an int8 truncated-Fourier tensor
    (S.2).

    That row is cos(2 pi (t + 1/2) / M), M a multiple of 4. Raises InputError for a row that a quarter wave does not
    give back: cos(pi - x) = -cos(x), cos(pi + x) = -cos(x), cos(2 pi - x) = cos(x).
    """
    row = np.asarray(matrix)[0]
    require(row.size % 4 == 0, f"quarter wave: {row.size} bins, expected a multiple of 4")
    quarter = row[: row.size // 4]
    require(np.array_equal(_whole_wave(quarter), row), "quarter wave: the first row is no cosine at bin centres")
    return quarter.astype(np.int64)


def _whole_wave(quarter: np.ndarray) -> np.ndarray:
    return np.concatenate([quarter, -quarter[::-1], -quarter, quarter[::-1]])


def wave_matrix(quarter: np.ndarray, harmonics: Sequence[int]) -> np.ndarray:
    """Return what the Fourier programs add, (2 H, 4 Q): rows cos and sin in turn of each harmonic h from a quarter wave
    (Q,).

    w[h t + floor(h / 2)] and a quarter later, w the whole wave with its half-step: phase h (t + 1/2) exactly for odd h,
    half a step more for even h, where a table of Q entries has no better one.
    """
    wave = _whole_wave(np.asarray(quarter, np.int64))
    t = np.arange(wave.size)
    rows = []
    for harmonic in harmonics:
        phase = harmonic * t + harmonic // 2
        rows += [wave[phase % wave.size], wave[(phase - len(quarter)) % wave.size]]
    return np.stack(rows)


def fourier_matrix(quarter: np.ndarray, codes: int) -> np.ndarray:
    """Return what `fourier.s` adds, (K, 4 Q): the `wave_matrix` of harmonics 1 .. K/2."""
    return wave_matrix(quarter, range(1, codes // 2 + 1))


def require_waves(temporal: np.ndarray, harmonics: Sequence[int], where: str) -> None:
    """Raise InputError, naming row and time bin, unless the quarter wave of a temporal tensor (2 H, Mt) gives its rows
    back as cos and sin of the harmonics: exactly but for rounding, and for half a step of the table (pi / Mt)."""
    try:
        quarter = quarter_wave(temporal)
    except InputError as reason:
        raise InputError(f"{where}: {reason}") from None
    held, bins = np.asarray(temporal, np.int64), temporal.shape[1]
    found = wave_matrix(quarter, harmonics)
    most = (int(np.abs(quarter).max()) + 0.5) / np.cos(np.pi / bins)  # the wave's amplitude, which no bin centre has
    off = np.abs(found - held) > most * np.pi / bins + 1
    if off.any():
        row, t = np.argwhere(off)[0]
        wave, harmonic = ("cos", "sin")[row % 2], harmonics[row // 2]
        raise InputError(
            f"{where}: row {row} is not {wave} of harmonic {harmonic}: {held[row, t]} in bin {t}, a quarter wave gives "
            f"{found[row, t]}"
        )


def block_matrix(temporal: np.ndarray, timestamps: int) -> np.ndarray:
    """Return what `separable.s` and `learned.s` add, (timestamps / Mt x K, timestamps): the temporal codes (K, Mt) of
    every block of Mt timestamps, block after block."""
    codes, width = temporal.shape
    matrix = np.zeros((timestamps // width, codes, timestamps), np.int64)
    for block in range(timestamps // width):
        matrix[block, :, block * width : (block + 1) * width] = temporal
    return matrix.reshape(-1, timestamps)


def coarse_matrix(codes: int, timestamps: int) -> np.ndarray:
    """Return what `coarse.s` adds: 1 to the counter that the timestamp falls into, (K, timestamps)."""
    return (np.arange(timestamps) * codes // timestamps == np.arange(codes)[:, None]).astype(np.int64)


def by_block(sums: np.ndarray, block: tuple[int, int], codes: int) -> np.ndarray:
    """Gather what the cores of an array hold by the blocks whose cores `spatial_sum` and `block_sum` add up.

    sums (H, W, blocks * K) -> (H / rows, W / columns, cores, blocks, K).
    """
    (height, width), (rows, columns) = sums.shape[:2], block
    cores = sums.reshape(height // rows, rows, width // columns, columns, -1, codes).swapaxes(1, 2)
    return cores.reshape(height // rows, width // columns, rows * columns, -1, codes)


def spatial_sum(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the frame end of 2 x 2 cores (`sum2x2.s`): sum over the cores of w s / 128, rounded (halves up), then
    saturated to 16 bits.

    sums (..., cores, blocks, K) and weights (cores, K), both integer -> (..., blocks, K) int64.
    """
    return ((weighted_sum(sums, weights) + 64) >> 7).clip(-(1 << 15), (1 << 15) - 1)


def block_sum(sums: np.ndarray, weights: np.ndarray | None, shift: int) -> np.ndarray:
    """Return the frame end of a block of cores (`sumblock.s`): sum over the cores of w s / 2^shift, rounded, halves up.

    sums and weights as of `spatial_sum`; weights None: of s / 2^shift.
    """
    return (weighted_sum(sums, weights) + (1 << shift >> 1)) >> shift


def weighted_sum(sums: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Return the sum over the cores of w s, or of s, before it is divided: (..., cores, blocks, K) and (cores, K) ->
    (..., blocks, K) int64."""
    held = np.asarray(sums, np.int64)
    return (held if weights is None else held * np.asarray(weights, np.int64)[:, None, :]).sum(axis=-3)
