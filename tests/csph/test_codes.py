"""Temporal codes by their defining properties."""

import math

import numpy as np
import pytest
import torch

from csph.codes.decode import decode_depth
from csph.codes.design import Design
from csph.codes.temporal import (
    FIXED_CODES,
    block_pulse,
    coarse_gates,
    gray_fourier,
    gray_frequencies,
    temporal_code,
    truncated_fourier,
    uniform_start,
    walsh_hadamard,
)
from csph.codes.tensor import CodingTensor, encode
from csph.layer import CompressiveLayer, make_coding
from csph.networks.config import ModelConfig
from scenes.errors import InputError
from spad.formats.rgbd import published_taps
from spad.sensor.model import Pulse, Sensor
from spad.sensor_names import sensor_by_name

REFERENCE = Sensor()
# mean over image rows of the published training pulse, 16 taps of 80 ps (physics of the ICCV 2023 data set)
PUBLISHED_TAPS = (
    *(0.0013, 0.0016, 0.0038, 0.0232, 0.0906, 0.1705, 0.2091, 0.1812),
    *(0.1327, 0.0842, 0.0478, 0.0248, 0.0131, 0.0075, 0.0050, 0.0037),
)


def published_pulse(bins: int) -> torch.Tensor:
    return torch.nn.functional.pad(torch.tensor(PUBLISHED_TAPS, dtype=torch.float64), (0, bins - 16))


def test_gray_frequencies_of_the_published_pulse_are_the_published_ones():
    long, short = gray_frequencies(published_pulse(1024)), gray_frequencies(published_pulse(256))
    assert long[:17] == [1, 2, 4, 8, 16, 32, 64, 128, 3, 5, 6, 7, 9, 10, 11, 12, 13]
    assert max(long) == 159 and sorted(long) == list(range(1, 160))
    assert short[:11] == [1, 2, 4, 8, 16, 32, 3, 5, 6, 7, 9]


def test_published_rows_are_the_discrete_fourier_transform():
    """cos - j sin at whole bins: codes are the transform's harmonics themselves, sine rows with their minus sign."""
    counts = np.random.default_rng(3).poisson(1.0, (5, 256))
    harmonics = np.fft.rfft(counts)[:, 1:9]
    expected = np.stack([harmonics.real, harmonics.imag], axis=-1).reshape(5, 16)
    coding = CodingTensor("published", temporal_code("fourier-published", 16, 256, REFERENCE))
    np.testing.assert_allclose(encode(torch.from_numpy(counts), coding), expected, atol=1e-4)
    assert torch.equal(coding.temporal[:, 0], torch.tensor([1.0, 0.0] * 8)) and (coding.temporal[1, 1:128] < 0).all()
    ours = truncated_fourier(16, 256)
    assert (ours[1, :128] > 0).all() and ours[0, 0] < 1


def test_published_gray_has_159_harmonics_and_ours_155():
    train = sensor_by_name("iccv2023-train")
    for code, usable in (("gray-published", 159), ("gray", 155)):
        assert temporal_code(code, 2 * usable, 1024, train).shape == (2 * usable, 1024)
        with pytest.raises(InputError, match=f"band holds {usable} harmonics"):
            temporal_code(code, 2 * usable + 2, 1024, train)
    first = temporal_code("gray-published", 32, 1024, train)
    fourier = truncated_fourier(1022, 1024, "published")
    order = (1, 2, 4, 8, 16, 32, 64, 128, 3, 5, 6, 7, 9, 10, 11, 12)
    assert torch.equal(first, torch.cat([fourier[2 * f - 2 : 2 * f] for f in order]))


def test_rows_change_zero_normalised_back_projections_and_not_matched_decoding():
    """Published MAE of the argmax at 10 + 50 photons, K = 8: 57.9 against 45.9 bins near, 29.8 against 31.5 far."""
    taps = published_taps(REFERENCE)
    pulse = np.roll(np.pad(taps, (0, 1024 - len(taps))), -taps.argmax())
    random = np.random.default_rng(2)
    for first, last, expected in ((79, 195, (57.9, 45.9)), (556, 673, (29.8, 31.5))):
        bins = random.integers(first, last, 4096)
        counts = random.poisson(10 * np.stack([np.roll(pulse, k) for k in bins]) + 50 / 1024)
        image = torch.from_numpy(counts.T.reshape(1, 1, 1024, 64, 64).copy())
        errors, depths = [], []
        for code in ("fourier-published", "fourier"):
            layer = CompressiveLayer.of(Design(code, (1024, 1, 1), 8))
            off = np.abs(layer(image)[0, 0].argmax(0).flatten().numpy() - bins)
            errors.append(np.minimum(off, 1024 - off))
            coding = layer.coding()
            depths.append(decode_depth(encode(torch.from_numpy(counts[:256]), coding), coding, REFERENCE))
        for error, mean in zip(errors, expected, strict=True):
            assert abs(error.mean() - mean) < 4 * error.std() / 64
        if first == 79:  # far, 4,096 pixels do not tell the two apart
            paired = errors[0] - errors[1]
            assert paired.mean() > 4 * paired.std() / 64
        # an eighth of a bin, where two arrivals score alike
        assert (depths[0] - depths[1]).abs().median() < REFERENCE.bin_depth_m / 8


def test_gray_band_limit_of_a_gaussian_is_its_closed_form():
    # |F(f)| = exp(-2 (pi sigma f / T)^2) sinc(f / N), T the period and N its bins: the width of a bin blurs too
    for bins in (256, 1024):
        sigma, last = REFERENCE.pulse.sigma_s / REFERENCE.bin_width_s, 0

        def spectrum(f: int, n: int = bins, s: float = sigma) -> float:
            return math.exp(-2 * (math.pi * s * f / n) ** 2) * math.sin(math.pi * f / n) / (math.pi * f / n)

        while last + 1 < bins / 2 and spectrum(last + 1) >= 0.2 * spectrum(1):
            last += 1
        assert max(gray_frequencies(block_pulse(bins, REFERENCE))) == last


def test_a_narrow_pulse_keeps_more_harmonics():
    wide = gray_frequencies(block_pulse(256, Sensor(pulse=Pulse(1e-9))))
    narrow = gray_frequencies(block_pulse(256, Sensor(pulse=Pulse(1e-12))))
    assert len(wide) < 20 and narrow[:8] == [1, 2, 4, 8, 16, 32, 64, 3] and len(narrow) == 127


def test_gray_rows_are_fourier_rows_in_another_order():
    frequencies = gray_frequencies(block_pulse(256, REFERENCE))[:8]
    gray, fourier = temporal_code("gray", 16, 256, REFERENCE), truncated_fourier(254, 256)
    assert torch.equal(gray, torch.cat([fourier[2 * f - 2 : 2 * f] for f in frequencies]))


@pytest.mark.parametrize("bins", [2, 8, 64])
def test_walsh_functions_are_orthogonal_and_ordered_by_sign_changes(bins):
    rows = walsh_hadamard(bins - 1, bins)
    assert set(rows.unique().tolist()) == {-1, 1} and (rows.sum(1) == 0).all()
    assert torch.equal(rows @ rows.T, bins * torch.eye(bins - 1))
    assert ((rows.diff(dim=1) != 0).sum(1) == torch.arange(1, bins)).all()
    import scipy.linalg

    hadamard = torch.from_numpy(scipy.linalg.hadamard(bins)).float()
    assert {tuple(row) for row in rows.tolist()} == {tuple(row) for row in hadamard.tolist()[1:]}


def test_coarse_gates_partition_the_bins():
    rows = coarse_gates(8, 64)
    assert torch.equal(rows.sum(0), torch.ones(64)) and (rows.sum(1) == 8).all()
    assert torch.equal(rows.argmax(0), torch.arange(64) // 8)


def test_random_codes_follow_their_seed_and_range():
    one, same, other = (uniform_start((8, 1024), 1024, seed) for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)
    # 8192 draws: the largest is within 1 % of the limit but for a chance of e^-41 a side
    assert 0.99 / 32 < one.abs().max() <= 1 / 32
    assert abs(one.mean()) < 5 / 32 / math.sqrt(3 * one.numel())


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_learned_codes_in_space_and_in_time_begin_independently(seed):
    coding = make_coding(Design("learned", (256, 4, 4), 32), seed=seed)
    in_space = coding.spatial.flatten()
    in_time = coding.temporal.flatten()[: in_space.numel()]
    assert abs(np.corrcoef(in_space, in_time)[0, 1]) < 4 / math.sqrt(in_space.numel())


@pytest.mark.parametrize(
    ("name", "codes", "bins", "message"),
    [
        ("coarse", 3, 64, "3 gates do not divide 64 bins"),
        ("coarse", 128, 64, "128 gates"),
        ("hadamard", 64, 64, "1 to 63"),
        ("hadamard", 8, 60, "power of two"),
        ("gray", 7, 64, "even number"),
        ("gray", 60, 64, "holds 12 harmonics of 64 bins"),
        ("fourier", 63, 64, "even number"),
        ("fourier", 0, 64, "1 or more"),
        ("haar", 4, 64, "'haar' is unknown"),
        ("fourier", 8.0, 64, "8.0 codes, expected a whole number"),
        ("random", "8", 64, "'8' codes, expected a whole number"),
        ("hadamard", True, 64, "True codes, expected a whole number"),
    ],
)
def test_codes_that_do_not_fit_end_in_one_line(name, codes, bins, message):
    with pytest.raises(InputError, match=message) as caught:
        temporal_code(name, codes, bins, REFERENCE)
    assert "\n" not in str(caught.value)


def test_all_codes_but_coarse_and_random_sum_to_zero():
    for name in FIXED_CODES:
        total = temporal_code(name, 8, 64, REFERENCE).double().sum(1).abs().max()
        assert (total < 1e-5) == (name not in ("coarse", "random"))


def test_gray_fourier_takes_any_pulse():
    assert gray_fourier(4, 16, torch.eye(16)[0]).shape == (4, 16)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ModelConfig(design=Design("learned", (256, 1, 1), 1)), "leaves zeros"),
        (lambda: ModelConfig(design=Design("learned", (1, 2, 2), 2)), "blocks of 1 bin: .* leaves zeros"),
        (lambda: Design("furier", (256, 1, 1), 4), "did you mean 'fourier'"),
        (lambda: Design("learned", (256, 1, 1), 4.0), "4.0 codes over a block of 256 x 1 x 1, expected a whole number"),
        (lambda: Design.named("lerned", (256, 1, 1), codes=4), "did you mean 'learned'"),
        (lambda: temporal_code("hadamrd", 4, 256, Sensor()), "did you mean 'hadamard'"),
    ],
)
def test_designs_that_are_none_are_told_what_would_be_one(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_one_code_tells_no_depth():
    coding = CodingTensor("coarse-1", temporal_code("coarse", 1, 1024, Sensor()))
    with pytest.raises(InputError, match="nothing but a sign"):
        decode_depth(torch.ones(4, 1), coding, Sensor())
    assert ModelConfig(design=Design("learned", (256, 1, 1), 1), layer={"keep_mean": True}).design.codes == 1


@pytest.mark.parametrize("name", [None, 8])
def test_what_names_no_code_is_refused_in_one_line(name):
    with pytest.raises(InputError, match=rf"^temporal code {name} is unknown, expected one of fourier, gray"):
        temporal_code(name, 8, 64, Sensor())
