"""Fast exact products of histograms with integer tables, against one photon after the other and integer arithmetic."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.errors import InputError
from ultraphase import method
from ultraphase.products import bytes_are_exact, equal_blocks, photon_sums
from ultraphase.reference import add_photons
from ultraphase.tables import block_matrix, coarse_matrix, fourier_matrix, int8_codes, wave_matrix

QUARTER = int8_codes(np.cos(2 * np.pi * (np.arange(256) + 0.5) / 1024))
BLOCK = wave_matrix(QUARTER[2::4], (1, 2, 3, 4))
TABLES = {
    "fourier-8": fourier_matrix(QUARTER, 8).T,
    "fourier-16": fourier_matrix(QUARTER, 16).T,
    "separable": block_matrix(BLOCK, 1024).T,
    "coarse": coarse_matrix(64, 1024).T,
    "learned": np.random.default_rng(0).integers(-127, 128, (1024, 5)),
    "odd length": np.random.default_rng(1).integers(-127, 128, (999, 3)),
    "zeros": np.zeros((1024, 2), np.int64),
}


@pytest.mark.parametrize("name", TABLES)
def test_sums_are_those_of_one_photon_after_the_other(name):
    table, random = TABLES[name], np.random.default_rng(2)
    histograms = random.poisson(0.3, (3, len(table))).astype(np.uint8)
    histograms[1, 7] = 127
    expected = [add_photons(one, table) for one in histograms]
    for in_bytes in (True, False):  # bytes only where the processor has them
        assert photon_sums(histograms, table, in_bytes=in_bytes).tolist() == expected


@settings(deadline=None, derandomize=True, max_examples=10)
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(TABLES)), st.sampled_from([2, 256, 70_000]))
def test_every_type_and_brightness_is_exact(seed, name, high):
    """Several chunks, the last one cut off; also where a byte or float32 would not hold the sums."""
    table, random = TABLES[name], np.random.default_rng(seed)
    dtype = np.uint8 if high <= 256 else random.choice([np.int32, np.int64, np.uint32])
    histograms = random.poisson(0.5, (random.integers(1, 1100), len(table))).astype(dtype)
    bright = random.integers(0, len(histograms), 5)
    histograms[bright, random.integers(0, len(table), 5)] = random.integers(high // 2, high, 5)
    expected = histograms.astype(np.int64) @ table
    for in_bytes in (True, False):
        assert np.array_equal(photon_sums(histograms, table, in_bytes=in_bytes), expected)
    assert np.array_equal(photon_sums(histograms[::2], table), expected[::2])  # not contiguous
    assert np.array_equal(photon_sums(np.asfortranarray(histograms), table), expected)


def test_structure_is_found_where_it_is_and_nowhere_else():
    assert [equal_blocks(TABLES[name]) for name in ("separable", "coarse", "fourier-16", "learned")] == [4, 64, 1, 1]
    spoilt = TABLES["separable"].copy()
    spoilt[700, 0] += 1
    assert equal_blocks(spoilt) == 1
    assert np.array_equal(method("separable-8").matrix(BLOCK).T[:256, :8], BLOCK.T)


def test_products_of_bytes_are_tried_before_they_are_used():
    """The largest products there are, all of one sign: 16-bit sums of pairs would saturate. Equal with and without."""
    counts, table = np.full((70, 1024), 127, np.uint8), np.full((1024, 16), 127)
    table[:, 1::2] = -127
    expected = counts.astype(np.int64) @ table
    assert np.array_equal(photon_sums(counts, table), expected)
    assert np.array_equal(photon_sums(counts + np.uint8(1), table), expected // 127 * 128)  # no byte any more
    vnni = getattr(torch.cpu, "_is_vnni_supported", lambda: False)()
    assert bytes_are_exact() <= vnni


def test_tables_beyond_bytes_and_32_bits_are_exact():
    counts = np.full((3, 1 << 18), 127, np.uint8)
    for table in (np.full((1 << 18, 2), 127), np.full((1 << 18, 2), 128), np.full((1 << 18, 2), -128)):
        assert np.array_equal(photon_sums(counts, table), counts.astype(np.int64) @ table)


def test_negative_counts_are_refused():
    with pytest.raises(InputError, match="-1 counts"):
        photon_sums(np.full((2, 1024), -1), TABLES["fourier-8"])
    with pytest.raises(InputError, match="float32, expected whole numbers"):
        photon_sums(np.full((2, 1024), np.nan, np.float32), TABLES["fourier-8"])
    assert photon_sums(np.zeros((0, 1024), np.uint8), TABLES["fourier-8"]).shape == (0, 8)


@pytest.mark.parametrize("counts", [1 << 44, (1 << 44) + 1, (1 << 55) + 3])
def test_sums_beyond_doubles_are_exact(counts):
    """Two bins of 2^44 + 1 photons with entries of 127 were off: doubles are exact to 2^53 alone."""
    histograms, table = np.zeros((2, 1024), np.uint64), TABLES["fourier-8"]
    histograms[1, [3, 700]] = counts, counts + 2
    expected = [sum(int(n) * int(row[k]) for n, row in zip(histograms[1], table, strict=True)) for k in range(8)]
    assert photon_sums(histograms, table).tolist() == [[0] * 8, expected]


@pytest.mark.parametrize(
    ("histograms", "message"),
    [
        (np.full((1, 1024), 1 << 63, np.uint64), "9223372036854775808 counts in a bin: with entries to 127"),
        (np.full((1, 1024), 1 << 50), "1125899906842624 counts in a bin"),
        (np.zeros((2, 1000), np.uint8), r"histograms of shape \(2, 1000\), expected \(pixels, 1024\)"),
        (np.zeros(1024, np.uint8), r"histograms of shape \(1024,\)"),
        ([[0] * 1024], "expected a ndarray, not list"),
    ],
)
def test_histograms_without_exact_sums_are_refused_in_one_line(histograms, message):
    with pytest.raises(InputError, match=message):
        photon_sums(histograms, TABLES["fourier-8"])
