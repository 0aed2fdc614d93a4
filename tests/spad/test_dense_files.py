"""Dense exports: HDF5 is read as it was written, or refused."""

from pathlib import Path

import h5py
import numpy as np
import pytest

import scene2spad as s2s

LINES = "no dense array that `export` wrote: its bytes do not match their SHA-256"


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    image = np.array([[2.0, 3.0]])
    seen = s2s.transient_from_rgbd(image, np.ones_like(image), np.ones_like(image))
    histogram = s2s.sense(seen, signal=20, background=2, sensor=s2s.Sensor(bins=64))
    return s2s.write_dense(s2s.dense(histogram), tmp_path_factory.mktemp("dense") / "whole.h5")


def test_a_changed_digit_of_a_dense_hdf5_file_is_seen(whole, tmp_path):
    """Numbers of the sensor and of the budget are text, which no part of HDF5 checks."""
    content, broken = whole.read_bytes(), tmp_path / "broken.h5"
    for text in (b'"bins": 64', b'"signal": 20'):
        assert content.count(text) == 1
        broken.write_bytes(content.replace(text, text[:-1] + b"1"))
        with pytest.raises(s2s.InputError, match=LINES):
            s2s.read_dense(broken)


def test_no_flipped_bit_of_a_dense_hdf5_file_is_read(whole, tmp_path):
    rng, content, broken = np.random.default_rng(2), whole.read_bytes(), tmp_path / "broken.h5"
    for place in rng.choice(len(content), 100, replace=False):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        broken.write_bytes(damaged)
        with pytest.raises(s2s.InputError) as refused:
            s2s.read_dense(broken)
        assert "\n" not in str(refused.value) and "broken.h5" in str(refused.value)


def test_other_programs_and_files_without_a_checksum_open(whole, tmp_path):
    """The checksum stands in HDF5's user block, which its readers pass over; files of earlier versions have none."""
    with h5py.File(whole) as file, h5py.File(tmp_path / "old.h5", "w") as old:
        for name in file:
            file.copy(name, old)
        old.attrs["axes"] = file.attrs["axes"]
        assert file["data"].shape == (1, 2, 64)
    assert s2s.read_dense(tmp_path / "old.h5").sha256() == s2s.read_dense(whole).sha256()
