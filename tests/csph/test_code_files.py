"""Files of codes: what is written is read again, and codes that tell no depth are refused."""

import math

import numpy as np
import pytest
import torch

from csph.codes.decode import check_decodable, decode_depth, decoded_rank
from csph.codes.design import Design
from csph.codes.files import read_codes, write_codes
from csph.codes.quantise import quantised
from csph.codes.temporal import FIXED_CODES, temporal_code
from csph.codes.tensor import CodingTensor
from csph.layer import make_coding
from scenes.errors import InputError
from spad.sensor.model import Sensor

BINS = 64
COSINE = torch.cos(2 * math.pi * (torch.arange(BINS) + 0.5) / BINS)
DESIGNS = (
    Design("fourier", (64, 1, 1), 8),
    Design("learned", (16, 2, 3), 5),
    Design("learned", (8, 2, 2), 4, full=True),
)


@pytest.mark.parametrize("suffix", [".npy", ".NPY", ".txt", ".TXT"])
@pytest.mark.parametrize("design", DESIGNS, ids=lambda design: design.name)
def test_written_codes_are_read_again(design, suffix, tmp_path):
    """numpy added .npy to the temporary name of a.NPY."""
    coding = make_coding(design)
    path = write_codes(coding, tmp_path / f"a{suffix}")
    assert [*tmp_path.iterdir()] == [path]
    read = read_codes(path)
    assert read.name == "a" and read.block == coding.block
    assert torch.equal(read.tensor, coding.tensor)
    if suffix.lower() == ".txt":
        assert torch.equal(read.temporal, coding.temporal)
        assert (read.spatial is None) == (coding.spatial is None)


@pytest.mark.parametrize("design", DESIGNS, ids=lambda design: design.name)
def test_tables_of_int8_codes_are_read_in_their_steps(design, tmp_path):
    coding = make_coding(design)
    read, exact = read_codes(write_codes(coding, tmp_path / "a.txt", int8=True)), quantised(coding)
    # the step is written in nine digits, and its multiples are rounded to float32
    near = {"rtol": 5e-9 + float(np.finfo(np.float32).eps), "atol": 0}
    np.testing.assert_allclose(read.temporal, exact.temporal * exact.temporal_scale, **near)
    if exact.spatial is not None:
        np.testing.assert_allclose(read.spatial, exact.spatial * exact.spatial_scale, **near)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no table of codes as `export` writes it"),
        ("1 2\n3 4\n", "is no table of codes as `export` writes it"),
        ("# spatial, shape 1 x 1 x 1\n1\n", "is no table of codes"),
        ("# temporal, shape 2 x 2\n1 2\n3\n", "temporal part holds other than the 2 x 2 numbers that it states"),
        ("# temporal, shape 2 x 2\n1 2 3 4\n", "temporal part holds other than the 2 x 2 numbers"),
        ("# temporal, shape 1 x 2\n1 2\n3 4\n", "temporal part holds other than the 1 x 2 numbers"),
        ("# temporal, shape 1 x 2\n1 2\n# note\n3 4\n", "temporal part holds other than the 1 x 2 numbers"),
        ("# temporal, shape 1 x 2\n1 2\n# temporal, shape 1 x 2\n1 2\n", "states its temporal part twice"),
        ("1 2\n# temporal, shape 1 x 2\n1 2\n", "is no table of codes as `export` writes it"),
        ("# temporal, shape 1 x 2\n1 x\n", "temporal part holds other than the 1 x 2 numbers"),
        ("# temporal, shape 1 x 2, int8, one step is x\n1 2\n", "temporal part holds other than"),
        (f"# temporal, shape 1 x {'9' * 5000}\n1\n", "temporal part holds other than"),
        ("# temporal, shape 1 x 2\n1 nan\n", "expected finite values"),
        ("# temporal, shape 3 x 2\n1 2\n3 4\n5 6\n", "3 codes of a block of 2 counts"),
        ("# temporal, shape 2 x 2\n1 2\n3 4", "ends within a line, so that its last number may be cut short"),
    ],
)
def test_damaged_tables_end_in_one_line(text, message, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"^[^\n]*a\.txt: [^\n]*{message}[^\n]*$"):
        read_codes(path)


@pytest.mark.parametrize(
    "text",
    [
        b"# temporal, shape 2 x 4\r\n1 2 3 4\r\n5 6 7 8\r\n",
        b"# temporal, shape 2 x 4\n1 2 3 4\n\n5 6 7 8\n\n",
        b"# mine: two codes\n\n# temporal, shape 2 x 4\n# the first\n1 2 3 4\n# the second\n5 6 7 8\n# end\n",
    ],
    ids=["Windows line ends", "blank lines", "comments"],
)
def test_tables_of_other_editors_are_read_whole(text, tmp_path):
    """Windows line ends were no table, and rows behind a comment were dropped."""
    (tmp_path / "a.txt").write_bytes(text)
    assert read_codes(tmp_path / "a.txt").temporal.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (COSINE.repeat(16, 1), "its 16 codes have rank 1 where a uniform background is removed, .* needs 2 or more"),
        (torch.outer(torch.linspace(-3, 5, 16), COSINE), "its 16 codes have rank 1"),  # of which float32 rounds each
        (torch.stack([COSINE, COSINE + 1, 2 * COSINE - 3]), "its 3 codes have rank 1"),  # of rank 2 with its background
        (torch.ones(4, BINS), "its 4 codes have rank 0"),
        (torch.ones(2, BINS), "its 2 codes have rank 0 .* needs 1 or more"),
        (torch.zeros(4, BINS), "its 4 codes have rank 0"),
        (torch.stack([COSINE, 1e-6 * COSINE.roll(16)]), "its 2 codes have rank 1"),  # less than scores can tell
    ],
)
def test_codes_that_tell_no_depth_are_refused(rows, message):
    sensor = Sensor(name="64 bins", bins=BINS, period_s=BINS * Sensor().bin_width_s)
    with pytest.raises(InputError, match=f"^coding tensor mine: {message}"):
        decode_depth(torch.ones(3, len(rows)), CodingTensor("mine", rows), sensor)


@pytest.mark.parametrize("name", FIXED_CODES)
def test_codes_by_name_are_decoded(name):
    """Take what a uniform background adds for one direction of gates and of random codes."""
    sensor, lost = Sensor(), int(name in ("coarse", "random"))
    for codes in (2, 4, 8, 16, 64):
        coding = CodingTensor(name, temporal_code(name, codes, sensor.bins, sensor))
        check_decodable(coding)
        assert decoded_rank(coding) == codes - lost


def test_codes_that_depend_on_each_other_are_told_once(caplog):
    """Warned of where they came from a file, and not where a program made the coding tensor."""
    sensor = Sensor(name="64 bins", bins=BINS, period_s=BINS * Sensor().bin_width_s)
    waves = temporal_code("fourier", 6, BINS, sensor)
    twice = CodingTensor("mine", torch.cat([waves, waves[:3]]))
    for _ in range(2):
        decode_depth(torch.ones(3, 9), twice, sensor)
    (told,) = (record.getMessage() for record in caplog.records)
    assert told.startswith("coding tensor mine: its 9 codes have rank 6 where a uniform background is removed")
    caplog.clear()
    for name in FIXED_CODES:  # a background takes one number of gates and of random codes: no fault of theirs
        decode_depth(torch.ones(3, 8), CodingTensor(name, temporal_code(name, 8, BINS, sensor)), sensor)
    assert not caplog.records


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_the_rank_is_that_of_the_codes_in_any_unit_and_above_a_background(scale):
    waves = temporal_code("fourier", 6, BINS, Sensor())
    twice = torch.cat([waves, waves[:3]])
    assert decoded_rank(CodingTensor("twice", scale * twice)) == 6
    assert decoded_rank(CodingTensor("lit", scale * (twice + torch.linspace(50, 100, 9).unsqueeze(1)))) == 6
