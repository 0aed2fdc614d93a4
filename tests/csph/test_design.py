"""Designs against the counts that the paper prints."""

import pytest

from csph.codes.design import MAX_PARAMETERS, Design, codes_for
from csph.layer import CompressiveLayer, make_coding
from scenes.errors import InputError

# block: {compression ratio: (K, parameters full or None, parameters separable)}; over single pixels there is one form
PAPER = {
    (1024, 1, 1): {16: (64, None, 65536), 32: (32, None, 32768), 64: (16, None, 16384), 128: (8, None, 8192),
                   256: (4, None, 4096), 512: (2, None, 2048)},
    (256, 1, 1): {16: (16, None, 4096), 32: (8, None, 2048), 64: (4, None, 1024), 128: (2, None, 512)},
    (1024, 2, 2): {32: (128, 524288, 131584), 64: (64, 262144, 65792), 128: (32, 131072, 32896)},
    (256, 2, 2): {32: (32, 32768, 8320), 64: (16, 16384, 4160), 128: (8, 8192, 2080), 256: (4, 4096, 1040)},
    (1024, 4, 4): {32: (512, 8388608, 532480), 64: (256, 4194304, 266240), 128: (128, 2097152, 133120),
                   256: (64, 1048576, 66560), 512: (32, 524288, 33280)},
    (256, 4, 4): {32: (128, 524288, 34816), 64: (64, 262144, 17408), 128: (32, 131072, 8704), 256: (16, 65536, 4352),
                  512: (8, 32768, 2176)},
    (64, 4, 4): {32: (32, None, 2560), 64: (16, None, 1280), 128: (8, None, 640), 256: (4, None, 320),
                 512: (2, None, 160)},
    (16, 4, 4): {32: (8, None, 256), 64: (4, None, 128), 128: (2, None, 64)},
    (1024, 8, 8): {32: (2048, None, 2228224), 64: (1024, None, 1114112), 128: (512, None, 557056)},
    (256, 8, 8): {32: (512, 8388608, 163840), 64: (256, 4194304, 81920), 128: (128, 2097152, 40960)},
}  # fmt: skip
CASES = [(block, ratio, *counts) for block, ratios in PAPER.items() for ratio, counts in ratios.items()]


@pytest.mark.parametrize(("block", "ratio", "codes", "full", "separable"), CASES)
def test_parameter_counts_are_the_papers(block, ratio, codes, full, separable):
    design = Design.named("learned", block, compression=ratio)
    assert (design.codes, design.parameters, design.compression_ratio) == (codes, separable, ratio)
    if full is not None:
        assert Design.named("learned", block, compression=ratio, full=True).parameters == full
    for one in (design, Design("learned", block, codes, full=True)):
        if one.parameters < 1e6:
            layer = CompressiveLayer.of(one)
            trained = sum(part.numel() for part in layer.parameters())
            assert make_coding(one).parameters == one.parameters == one.storage == trained


@pytest.mark.parametrize(
    ("name", "block", "codes", "stored"),
    [
        ("fourier+learned", (256, 4, 4), 64, 1088),  # supplement, Figure 11
        ("fourier+learned", (256, 2, 2), 16, 128),
        ("fourier", (256, 1, 1), 4, 64),
        ("fourier", (1024, 1, 1), 16, 256),
        ("gray", (1024, 1, 1), 16, 256),
        ("fourier+learned", (256, 2, 2), 8, 768 // 8),  # S.2: 768 and 1,024 bits at 8 bits each
        ("fourier+learned", (256, 2, 2), 16, 1024 // 8),
        ("coarse", (1024, 1, 1), 16, 0),
        ("hadamard+learned", (256, 4, 4), 32, 512),
    ],
)
def test_storage_counts_are_the_papers(name, block, codes, stored):
    design = Design.named(name, block, codes=codes)
    assert design.storage == stored
    coding = make_coding(design)
    assert (coding.storage, coding.parameters) == (design.storage, design.parameters)
    assert coding.parameters == codes * block[0] + (codes * block[1] * block[2] if block[1] > 1 else 0)


def test_one_core_would_need_16448_bits_for_learned_temporal_codes():
    # S.2: one core of the 2 x 2 stores all temporal codes and its own pixel's spatial weight of each
    design = Design.named("learned", (256, 2, 2), codes=8)
    assert (design.parameters - design.spatial_parameters + design.codes) * 8 == 16448


def test_names_and_learned_parts():
    assert Design.named("fourier+learned", (256, 4, 4), codes=32).name == "fourier+learned 256x4x4 K32"
    assert Design("learned", (256, 4, 4), 8, full=True).name == "full learned 256x4x4 K8"
    assert Design("learned", (256, 4, 4), 8).learned == ("temporal", "spatial")
    assert Design("learned", (256, 4, 4), 8, full=True).learned == ("temporal",)
    assert Design.named("fourier+learned", (256, 4, 4), codes=8).learned == ("spatial",)
    assert Design.named("random", (256, 4, 4), codes=8).learned == ()
    assert not Design("coarse", (64, 1, 1), 8).zero_mean and Design("fourier", (64, 1, 1), 8).zero_mean


def test_the_largest_designs_can_be_named():
    """The paper's largest block without compression, and every bin of the longest sensor."""
    assert Design("learned", (1024, 4, 4), 16384, full=True).parameters == MAX_PARAMETERS
    assert Design("fourier", (65536, 1, 1), 64).block_name == "65536 x 1 x 1"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: codes_for((256, 4, 4), 100), "100 does not divide the 4096"),
        (lambda: codes_for((16, 1, 1), 32), "32 does not divide the 16"),
        (lambda: codes_for((16, 1, 1), float("nan")), "nan does not divide"),
        (lambda: Design("learned", (4, 2, 2), 17), "17 codes over a block of 4 x 2 x 2, expected a whole number"),
        (lambda: Design("fourier", (16, 2, 2), 17), "expected a whole number from 1 to 16"),
        (lambda: Design("learned", (4, 2, 2), 0), "0 codes"),
        (lambda: Design("learned", (4, 0, 2), 1), "three positive whole numbers"),
        (lambda: Design("haar"), "'haar' is unknown"),
        (lambda: Design("fourier", (64, 1, 1), 4, full=True), "full coding tensors are learned or random"),
        (lambda: Design.named("fourier", (64, 4, 4), codes=4), "no spatial part: fourier.learned"),
        (lambda: Design.named("fourier+fixed", (64, 4, 4), codes=4), "CODE.learned"),
        (lambda: Design.named("fourier", (64, 1, 1)), "one of them"),
        (lambda: Design.named("fourier", (300, 4, 4), codes=8), "over a block of 300 x 4 x 4 has no spatial part"),
        (lambda: Design.named("fourier", (64, 4, 4), codes=0), "0 codes over a block of 64 x 4 x 4, .* from 1 to 64"),
        (
            lambda: Design.named("fourier", (64, 4, 4), codes=999),
            "999 codes over .*, expected a whole number from 1 to",
        ),
        (lambda: make_coding(Design("coarse", (64, 1, 1), 5)), "5 gates do not divide"),
        (lambda: Design("learned", (100_000_000, 4, 4), 32), "100000000 bins are above the limit of 65536"),
        (lambda: Design.named("learned", (65537, 1, 1), codes=1), "block 65537 x 1 x 1: 65537 bins are above"),
        (
            lambda: make_coding(Design("learned", (1024, 8, 8), 65536, full=True)),
            "full learned, 65536 codes over a block of 1024 x 8 x 8: 4294967296 parameters are above the limit of 268",
        ),
        (lambda: Design("learned", (16, 10_000, 10_000), 8), "800000128 parameters are above the limit"),
    ],
)
def test_designs_that_cannot_be_end_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
