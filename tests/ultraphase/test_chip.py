"""Supplementary Figure 5: the columns that follow from published numbers alone."""

import pytest

from ultraphase import ChipSpec

# name, clocks per photon, bits per pixel -> time per frame [s], data rate [kB/s], readout power [uW] as printed
PUBLISHED = [
    ("coarse 16", 30, 16 * 8, 3.93e-5, 1.92, 0.84),
    ("coarse 64", 24, 64 * 8, 3.14e-5, 7.68, 3.35),
    ("coarse 256", 24, 256 * 8, 3.14e-5, 30.72, 13.38),
    ("Fourier 8", 210, 8 * 16, 2.74e-4, 1.92, 0.84),
    ("Fourier 16", 330, 16 * 16, 4.32e-4, 3.84, 1.67),
    ("separable 8", 241, 8 * 16, 3.15e-4, 1.92, 0.84),
    ("separable 16", 361, 16 * 16, 4.73e-4, 3.84, 1.67),
]


@pytest.mark.parametrize(("name", "clocks", "bits", "time_s", "kilobytes", "microwatts"), PUBLISHED)
def test_time_rate_and_readout_power_are_the_printed_ones(name, clocks, bits, time_s, kilobytes, microwatts):
    chip = ChipSpec()
    rate = chip.data_rate_bit_per_s(bits, pixels=4, frames_per_s=30)
    assert chip.processing_time_s(550, clocks) == pytest.approx(time_s, rel=6e-3)
    assert rate / 8000 == pytest.approx(kilobytes, rel=1e-3)
    assert 1e6 * chip.readout_power_w(rate) == pytest.approx(microwatts, rel=6e-3)


def test_speed_is_the_published_140_million_operations():
    assert ChipSpec().instructions_per_second == pytest.approx(140e6, rel=1e-3)
