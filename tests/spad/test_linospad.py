"""The layout of LinoSPAD captures: read by an independent reader, resampled by law, damaged in every way."""

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_flux import transient_of

from scenes.errors import InputError
from spad.detection.detect import sense_timestamps
from spad.estimators.depth import estimate_depth
from spad.formats.linospad import (
    Capture,
    capture_of,
    pooling,
    read_linospad,
    rebinning,
    resampled,
    resampled_sensor,
    write_linospad,
)
from spad.measurements.timestamps import Timestamps
from spad.sensor.model import PhotonBudget
from spad.sensor_names import sensor_by_name

LINOSPAD = sensor_by_name("linospad")
LAWS = settings(deadline=None, derandomize=True, max_examples=30)


def random_counts(side: int, bins: int = 1536, seed: int = 0) -> np.ndarray:
    """(rows, columns, bins), no two pixels alike."""
    return np.random.default_rng(seed).poisson(0.01, (side, side, bins)).astype(np.int32)


def test_the_layout_is_the_published_one(tmp_path):
    """As the published loaders index it: reshape to (bins, 256, 256), then the last two axes swapped."""
    frames = [random_counts(6, seed=n) for n in range(2)]
    images = [np.random.default_rng(n).random((6, 6)).astype(np.float32) for n in range(2)]
    captures = [capture_of(Timestamps.of_counts(c), image) for c, image in zip(frames, images, strict=True)]
    write_linospad(captures, tmp_path / "c.mat")
    plain = scipy.io.loadmat(tmp_path / "c.mat")
    assert plain["spad_processed_data"].shape == plain["cam_processed_data"].shape == (1, 2)
    for number, counts in enumerate(frames):
        stored = plain["spad_processed_data"][0, number]
        assert scipy.sparse.issparse(stored) and stored.shape == (1536, 36) and stored.dtype == np.float64
        cube = stored.toarray().reshape(1536, 6, 6).swapaxes(-1, -2)
        assert np.array_equal(cube, np.moveaxis(counts, -1, 0))
        again = read_linospad(tmp_path / "c.mat", number)
        assert np.array_equal(again.image, images[number]) and (again.counts != captures[number].counts).nnz == 0
    assert not list(tmp_path.glob(".*"))


def test_captures_written_by_others_are_read(tmp_path):
    """Files of one bare matrix; images in colour, of another size, of integers, or missing."""
    counts = scipy.sparse.csc_matrix(np.eye(1536, 16))
    scipy.io.savemat(tmp_path / "bare.mat", {"spad_processed_data": counts})
    bare = read_linospad(tmp_path / "bare.mat")
    assert bare.image is None and bare.side == 4 and bare.counts.sum() == 16
    cell, camera = np.empty((1, 1), object), np.empty((1, 1), object)
    cell[0, 0], camera[0, 0] = counts, np.full((9, 7, 3), 30, np.uint8)
    scipy.io.savemat(tmp_path / "colour.mat", {"spad_processed_data": cell, "cam_processed_data": camera})
    assert read_linospad(tmp_path / "colour.mat").image.tolist() == np.full((9, 7), 30.0).tolist()


@LAWS
@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_rebinning_is_exact_for_cumulative_counts(bins, new_bins, seed):
    """At every new edge the counts before it are the old ones' piecewise linear interpolation: np.interp is the
    second route."""
    counts = np.random.default_rng(seed).integers(0, 100, bins)
    new = rebinning(bins, new_bins) @ counts
    before = np.interp(
        np.arange(new_bins + 1) / new_bins, np.arange(bins + 1) / bins, np.concatenate([[0], counts.cumsum()])
    )
    assert np.allclose(np.concatenate([[0], new.cumsum()]), before, rtol=0, atol=1e-9 * (1 + counts.sum()))
    assert new.min() >= 0 and new.sum() == pytest.approx(counts.sum(), rel=1e-12)


def test_three_bins_become_two():
    assert rebinning(3, 2).toarray().tolist() == [[1, 0.5, 0], [0, 0.5, 1]]
    assert rebinning(1536, 1024).sum(axis=0).tolist() == np.ones((1, 1536)).tolist()


@LAWS
@given(st.sampled_from([1, 2, 4]), st.integers(0, 2**32 - 1))
def test_no_count_is_lost_and_each_stays_in_its_block(factor, seed):
    counts = random_counts(8, seed=seed)
    found = resampled(capture_of(Timestamps.of_counts(counts)), 1024, factor)
    assert found.dtype == np.float32 and found.shape == (8 // factor, 8 // factor, 1024)
    blocks = counts.reshape(8 // factor, factor, 8 // factor, factor, 1536).sum(axis=(1, 3, 4))
    assert np.array_equal(found.sum(axis=-1), blocks)  # halves of integers are exact
    assert found.min() >= 0


@pytest.mark.parametrize("depth_m", [0.31, 2.0, 5.5])
def test_a_plane_survives_writer_reader_and_resampling(tmp_path, depth_m):
    """The mean of 64 pixels' estimates lies within 4 standard errors (the estimates' own spread) and a tenth of a bin
    of 5.8 mm, which bounds what the even spread inside a 26 ps bin may cost."""
    side = 16
    tilted = depth_m + 0.01 * np.arange(8)[:, None] + 0.003 * np.arange(8)  # of blocks of 2 x 2 pixels
    paths = 2 * np.kron(tilted, np.ones((2, 2))).ravel()
    row = sense_timestamps(
        transient_of(*[[(path, path, 1.0)] for path in paths]), LINOSPAD, PhotonBudget(60, 20), seed=3
    )
    detections = Timestamps(side, side, row.bins, row.stamps, row.offsets)
    write_linospad([capture_of(detections)], tmp_path / "plane.mat")
    counts = resampled(read_linospad(tmp_path / "plane.mat"))
    assert counts.sum() == len(detections.stamps)
    sensor = resampled_sensor(LINOSPAD)
    assert sensor.bins == 1024 and sensor.bin_width_s == pytest.approx(39e-12)
    assert sensor.range_m == pytest.approx(LINOSPAD.range_m)
    error = (estimate_depth(torch.from_numpy(counts), sensor).numpy() - tilted).ravel()
    assert abs(error.mean()) < 4 * error.std() / 8 + 0.1 * sensor.bin_depth_m
    # 240 signal photons of 187 ps: 28 mm / sqrt(240) = 1.8 mm
    assert error.std() < 3e-3


def bad_files(folder):
    good = scipy.sparse.csc_matrix(np.eye(1536, 16))
    cases = {
        "bins": (scipy.sparse.csc_matrix((1024, 16)), "1024 x 16, expected 1536 bins"),
        "pixels": (scipy.sparse.csc_matrix((1536, 15)), "1536 x 15, expected 1536 bins x a square"),
        "negative": (-good, "negative or not finite"),
        "nan": (good * np.nan, "negative or not finite"),
        "words": (np.array(["a", "b"]), "holds no matrix of counts"),
        "cube": (np.zeros((2, 2, 2)), "holds no matrix of counts"),
    }
    for name, (value, message) in cases.items():
        scipy.io.savemat(folder / f"{name}.mat", {"spad_processed_data": value})
        yield folder / f"{name}.mat", message
    scipy.io.savemat(folder / "other.mat", {"spad": good})
    yield folder / "other.mat", "holds no spad_processed_data"
    (folder / "noise.mat").write_bytes(bytes(range(256)) * 9)
    yield folder / "noise.mat", "not a readable .mat"
    scipy.io.savemat(
        folder / "cut.mat", {"spad_processed_data": scipy.sparse.random(1536, 256, 0.2, "csc", random_state=0)}
    )
    (folder / "cut.mat").write_bytes((folder / "cut.mat").read_bytes()[:-400])
    yield folder / "cut.mat", "not a readable .mat"
    (folder / "empty.mat").write_bytes(b"")
    yield folder / "empty.mat", "not a readable .mat"
    with h5py.File(folder / "hdf5.mat", "w", userblock_size=512) as file:
        file["spad_processed_data"] = np.zeros((4, 4))
    with (folder / "hdf5.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    yield folder / "hdf5.mat", "version 7.3"
    yield folder / "missing.mat", "file not found"
    yield folder, "is a folder, expected a file"


def test_bad_files_are_refused_in_one_line(tmp_path):
    for path, message in bad_files(tmp_path):
        with pytest.raises(InputError, match=message) as caught:
            read_linospad(path)
        assert "\n" not in str(caught.value) and path.name in str(caught.value)


def test_what_does_not_fit_is_refused(tmp_path):
    capture = capture_of(Timestamps.of_counts(random_counts(6)))
    write_linospad([capture], tmp_path / "c.mat")
    for frame in (-1, 1):
        with pytest.raises(InputError, match=f"frame {frame} is not one of its 1"):
            read_linospad(tmp_path / "c.mat", frame)
    with pytest.raises(InputError, match="6 x 6 pixels is not tiled by 4 x 4"):
        resampled(capture, factor=4)
    with pytest.raises(InputError, match="square"):
        capture_of(Timestamps.of_counts(np.zeros((2, 3, 8), np.int32)))
    with pytest.raises(InputError, match=r"\.mat"):
        write_linospad([capture], tmp_path / "c.h5")
    with pytest.raises(InputError, match="no frame"):
        write_linospad([], tmp_path / "d.mat")
    assert pooling(4, 2).sum() == 16 and isinstance(capture, Capture)
