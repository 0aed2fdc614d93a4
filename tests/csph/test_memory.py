"""Table 1 of the supplement, and what section S.6 says of it, recomputed."""

import math

import numpy as np
import pytest

from csph.codes.design import Design
from csph.evaluation.memory import (
    best_blocks,
    data_compression,
    memory_compression,
    separable_factor,
    stored,
    transmitted,
)
from scenes.errors import InputError


def test_table_1_by_counting_arrays():
    for n, m, k in ((4096, 64, 8), (1000, 10, 3), (512, 512, 4)):
        blocks = n // m
        sent = np.zeros((blocks, k))
        held = sent.size + np.zeros((k, m)).size
        assert transmitted(blocks, k) == sent.size and stored(n, blocks, k) == held
        assert data_compression(n, blocks, k) == pytest.approx(n / sent.size)
        assert memory_compression(n, blocks, k) == pytest.approx(n / held)


def test_one_block_over_everything_needs_more_memory_than_the_histogram():
    for n in (1e6, 1e9):
        assert (memory_compression(n, 1, np.arange(1, 513)) < 1).all()


def test_the_best_balance_for_a_billion_counts_lies_where_the_supplement_sees_it():
    blocks = np.logspace(0, 6, 601)
    full = memory_compression(1e9, blocks, 64)
    assert 1e4 < blocks[full.argmax()] < 1e5 and blocks[full.argmax()] == pytest.approx(best_blocks(1e9), rel=0.02)
    # over the ranges that the text names, memory shrinks to this share of the best at least (recomputed, not printed)
    assert full[(blocks >= 1e4) & (blocks <= 1e5)].min() > 0.57 * full.max()
    thin = memory_compression(1e9, blocks, 64, 16)
    assert 1e3 < blocks[thin.argmax()] < 1e5 and best_blocks(1e9, 16) == pytest.approx(best_blocks(1e9) / 4)
    assert thin[(blocks >= 1e3) & (blocks <= 1e5)].min() > 0.15 * thin.max()
    # one coding tensor then has M = N / B entries, M / 16 if separable: 10,000 to 100,000, and 625 to 62,500
    assert [1e9 / blocks for blocks in (1e5, 1e4)] == [1e4, 1e5]
    assert [1e9 / blocks / 16 for blocks in (1e5, 1e3)] == [625, 62500]


def test_block_sizes_named_in_the_text():
    assert math.prod((1024, 4, 4)) == math.prod((256, 8, 8)) == 16384
    for block, size in (((256, 4, 4), 272), ((1024, 4, 4), 1040)):
        assert Design("learned", block, 64).parameters == 64 * size
    # "about 16 times smaller" holds for the blocks of 4 x 4 pixels that are named, not for all of the paper's
    assert separable_factor(256, 4, 4) == pytest.approx(15.06, abs=0.01)
    assert separable_factor(1024, 4, 4) == pytest.approx(15.75, abs=0.01)
    assert separable_factor(256, 2, 2) == pytest.approx(3.94, abs=0.01)
    assert separable_factor(256, 8, 8) == pytest.approx(51.2, abs=0.01)


@pytest.mark.parametrize("block", [(256, 4, 4), (1024, 4, 4)])
def test_separable_tensors_save_memory_from_ten_million_counts_on(block):
    size = math.prod(block)
    for n in (1e7, 1e8, 1e9):
        for codes in (64, 128, 256, 512):
            assert memory_compression(n, n / size, codes, separable_factor(*block)) > 1


def test_what_cannot_be_is_refused():
    for blocks, codes, factor in ((0, 4, 1), (4, 0, 1), (4, 4, 0)):
        with pytest.raises(InputError, match="must be positive"):
            memory_compression(100, blocks, codes, factor)
