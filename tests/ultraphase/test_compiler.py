"""Compiled codes: every timestamp, the frame's end of blocks of cores, and what does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.errors import InputError
from ultraphase import ChipSpec, CoreArray, assemble, verify
from ultraphase.catalog import FOLDER
from ultraphase.compiler import compile_code
from ultraphase.frame_end import require_compiled_end
from ultraphase.integer_code import IntegerCode, folded_temporal
from ultraphase.tables import block_sum, coarse_matrix


def waves(harmonics: tuple[int, ...], bins: int) -> np.ndarray:
    """Int8 cosine and sine at bin centres, by their definition."""
    angle = 2 * np.pi * np.array(harmonics)[:, None] * (np.arange(bins) + 0.5) / bins
    return np.rint(127 * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(int).reshape(-1, bins)


def fourier(harmonics: tuple[int, ...], bins: int, block: tuple[int, int] = (1, 1), seed: int = 0) -> IntegerCode:
    spatial = None
    if block != (1, 1):
        spatial = np.random.default_rng(seed).integers(-127, 128, (2 * len(harmonics), *block))
    return IntegerCode("waves", waves(harmonics, bins), spatial, harmonics)


def learned(codes: int, bins: int, block: tuple[int, int] = (1, 1), *, full: bool = False) -> IntegerCode:
    random = np.random.default_rng(codes)
    if full:
        return IntegerCode("full", random.integers(-127, 128, (codes, bins, *block)))
    spatial = None if block == (1, 1) else random.integers(-127, 128, (codes, *block))
    return IntegerCode("learned", random.integers(-127, 128, (codes, bins)), spatial)


CODES = {
    "truncated Fourier": fourier((1, 2, 3, 4), 1024),
    "Gray Fourier": fourier((1, 2, 4, 8, 16, 3, 5, 12), 1024),
    "Fourier of short blocks": fourier((1, 2, 3), 64),
    "Fourier + learned": fourier(tuple(range(1, 9)), 256, (2, 2)),
    "a loop over harmonics": fourier(tuple(range(1, 17)), 256, (4, 4)),
    "a loop without blocks": fourier(tuple(range(1, 17)), 1024),
    "learned, 64 bins": learned(3, 64, (2, 2)),
    "learned, 16 bins": learned(2, 16, (4, 4)),
    "learned, single pixels": learned(3, 128),
    "full": learned(2, 16, (1, 2), full=True),
    "a row of three": learned(2, 32, (1, 3)),
    "a column of three": learned(1, 32, (3, 1)),
}


def of_core(compiled, row: int, column: int) -> dict[str, np.ndarray]:
    tables = compiled.tables(compiled.block)
    return {name: values if values.ndim == 1 else values[row, column] for name, values in tables.items()}


@pytest.mark.parametrize("name", CODES)
def test_every_timestamp_adds_its_column(name):
    compiled = compile_code(CODES[name])
    last = compiled.block[0] - 1, compiled.block[1] - 1
    for core in {(0, 0), last}:
        proof = verify(compiled.program, compiled.matrix[core], of_core(compiled, *core))
        assert (proof.clocks == proof.clocks[0]).all()  # no timestamp takes longer than another
    assert compiled.program.ram_bytes == compiled.layout.total <= 512


@pytest.mark.parametrize(
    "name", ["Fourier + learned", "learned, 16 bins", "full", "a row of three", "a column of three"]
)
def test_ends_of_compiled_blocks_are_proved(name):
    require_compiled_end(compile_code(CODES[name]))


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("STH  [place + 0], zero", "MOV  zero, #0", "leaves other than zeros"),
        ("        MOV  zero, #0\n", "", "leaves other than zeros"),
        ("#HALF", "#HALF - 1", "puts out other than the weighted sum"),
        ("#HALF", "#HALF + 1", "puts out other than the weighted sum"),
        ("OUTH a", "MAX  a, a, #-32000\n        OUTH a", "puts out other than the weighted sum"),
        ("LDBS b", "LDB  b", "puts out other than the weighted sum"),
    ],
)
def test_wrong_ends_of_compiled_blocks_are_refused(right, wrong, message):
    """One frame of 550 photons was all that was compared, and the first five put out in it what the right end does."""
    made, text = compile_code(learned(1, 256, (2, 2))), (FOLDER / "sumblock.s").read_text()
    changed = made.source.replace('.include "sumblock.s"', text.replace(right, wrong))
    assert right in text
    program = assemble(changed, name="wrong", read=lambda name: (FOLDER / name).read_text())
    with pytest.raises(InputError, match=f"program wrong: the end of its frame {message}"):
        require_compiled_end(replace(made, program=program))


@pytest.mark.parametrize("name", CODES)
def test_blocks_of_cores_put_out_their_weighted_sum(name):
    compiled, random = compile_code(CODES[name]), np.random.default_rng(3)
    (down, right), codes = compiled.block, compiled.code.codes
    shape = 2 * down, 2 * right
    histograms = random.poisson(0.2, (*shape, 1024))
    array = CoreArray(compiled.program, shape, compiled.tables(shape))
    flat = histograms.reshape(-1, 1024)
    for _ in range(2):  # the first frame leaves zeros behind
        stamps = np.concatenate([np.repeat(np.arange(1024), row) for row in flat])
        frame = array.frame(stamps, np.concatenate([[0], np.cumsum(flat.sum(axis=1))]))
        for n, (row, column) in enumerate(np.ndindex(2, 2)):
            block = histograms[row * down : (row + 1) * down, column * right : (column + 1) * right]
            sums = np.einsum("rct,rcnt->rcn", block, compiled.matrix).reshape(down * right, -1, codes)
            if compiled.block == (1, 1):
                expected = sums[0]
            else:
                weights = None if compiled.weights is None else compiled.weights.reshape(down * right, codes)
                expected = block_sum(sums, weights, compiled.code.output_shift)
            assert np.array_equal(frame.out[n].reshape(-1, codes), expected)


@pytest.mark.parametrize("name", ["Fourier + learned", "learned, 16 bins", "full", "a row of three"])
def test_a_blocks_sum_never_leaves_16_bits(name):
    """All cores at the ends of their sums, weights of either sign: nothing wraps on the way out."""
    compiled = compile_code(CODES[name])
    for value in (-32768, 32767):
        array = CoreArray(compiled.program, compiled.block, compiled.tables(compiled.block))
        region = compiled.program.region("codes")
        array.ram[:, region.address : region.end] = np.full(region.count, value, np.int16).view(np.uint8)
        if compiled.weights is not None:
            weight = compiled.program.region("weight")
            array.ram[:, weight.address : weight.end] = np.full(weight.count, 127, np.uint8)
        cores = compiled.block[0] * compiled.block[1]
        frame = array.frame(np.zeros(0, int), np.zeros(cores + 1, int))
        sums = np.full((cores, region.count // compiled.code.codes, compiled.code.codes), value)
        weights = None if compiled.weights is None else np.full((cores, compiled.code.codes), 127)
        expected = block_sum(sums, weights, compiled.code.output_shift)
        assert np.array_equal(frame.out.ravel(), expected.ravel()) and frame.counters.wraps == 0
        assert np.abs(expected).max() > 16383  # and no more than one bit is given away


def test_an_even_harmonic_is_half_a_step_late_and_an_odd_one_exact():
    code = fourier((1, 2, 3, 4), 256)
    folded = folded_temporal(code)
    assert np.array_equal(folded[[0, 1, 4, 5]], code.temporal[[0, 1, 4, 5]])
    assert 0 < np.abs(folded - code.temporal).max() <= 127 * np.pi / 256 + 1


def test_the_fastest_loop_that_the_store_holds_is_taken():
    compiled = compile_code(CODES["a loop over harmonics"])
    assert compiled.loop_order.startswith("2 turns of 8 harmonics") and len(compiled.program.words) <= 256
    assert compile_code(fourier(tuple(range(1, 9)), 256)).loop_order.startswith("8 harmonics one after the other")


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (
            learned(8, 256, (2, 2)),
            r"2,121 bytes of RAM a core \(table 2,048, spatial weights 8, ways 1, sums 64\)",
        ),
        (learned(8, 256, (2, 2)), r"would fit: 1 code of 256 bins, or a Fourier code"),
        (learned(8, 64, (4, 4)), r"777 bytes .* would fit: 5 codes of 64 bins, or its table shared by the 16 cores"),
        (learned(2, 256), r"528 bytes .* would fit: 1 code of 256 bins, or 2 codes of blocks of 128 bins"),
        (learned(127, 1024), r"neither fewer codes nor another block nor a shared table nor a Fourier code"),
        (fourier((1, 2, 4, 8, 16, 32, 64, 128, 3, 5, 6, 7), 1024), r"over the 256 of the core; would fit: 22 codes"),
        (learned(2, 4), r"sums 1,024\), 512 are there; would fit: 2 codes of blocks of 16 bins$"),
        (fourier((1, 2, 3), 8), r"sums 1,536\), 512 are there; would fit: 6 codes of blocks of 32 bins$"),
        (fourier(tuple(range(1, 16)), 32), r"would fit: 6 codes of 32 bins$"),
        (fourier(tuple(range(1, 32)), 512), r"over the 256 of the core; would fit: 60 codes$"),
        (learned(1, 64, (32, 32)), r"blocks of 32 x 32 cores, the sum of more than 512 leaves 32 bits$"),
        (learned(2, 48), r"blocks of 48 bins, expected a power of two"),
    ],
)
def test_what_does_not_fit_is_refused_with_what_would(code, message):
    with pytest.raises(InputError, match=message) as refusal:
        compile_code(code)
    assert "\n" not in str(refusal.value)


def test_what_would_fit_does():
    for fewer in (learned(1, 256, (2, 2)), learned(5, 64, (4, 4)), learned(1, 256), learned(2, 128)):
        compile_code(fewer)
    for longer in (learned(2, 16), fourier((1, 2, 3), 32), fourier(tuple(range(1, 31)), 512)):
        compile_code(longer)
    compile_code(fourier((1, 2, 4, 8, 16, 32, 64, 128, 3, 5, 6), 1024))


@pytest.mark.parametrize(("codes", "bins"), [(62, 512), (58, 512), (34, 1024), (38, 1024), (46, 1024), (32, 1024)])
def test_a_fourier_code_is_suggested_where_its_program_fits(codes, bins):
    """RAM alone was looked at: of 31 harmonics the program store holds no loop."""
    with pytest.raises(InputError) as refusal:
        compile_code(learned(codes, bins))
    suggested = "a Fourier code of the same size" in str(refusal.value)
    try:
        compile_code(fourier(tuple(range(1, codes // 2 + 1)), bins))
    except InputError:
        assert not suggested
    else:
        assert suggested
    assert suggested == (codes == 32)


def test_a_larger_chip_takes_more():
    code = learned(8, 256, (2, 2))
    chip = ChipSpec(ram_bits=8 * 2128)
    compiled = compile_code(code, chip)
    assert verify(compiled.program, compiled.matrix[0, 0], of_core(compiled, 0, 0), chip=chip).states >= 7


def test_codes_of_other_shapes_are_refused():
    with pytest.raises(InputError, match="expected \\(K, Mt\\) and \\(K, Mr, Mc\\)"):
        IntegerCode("odd", np.zeros((2, 16), int), np.zeros((3, 2, 2), int))
    with pytest.raises(InputError, match="a block of one core"):
        IntegerCode("alone", np.zeros((2, 16), int), np.zeros((2, 1, 1), int))
    with pytest.raises(InputError, match="128 is outside"):
        IntegerCode("large", np.full((2, 16), 128))
    with pytest.raises(InputError, match="3 x 2 cores does not divide into blocks of 2 x 2"):
        compile_code(learned(2, 16, (2, 2))).tables((2, 3))


@pytest.mark.parametrize(
    ("harmonics", "message"),
    [
        ((1, 2), r"2 harmonics for codes of shape \(8, 1024\), expected one for each two rows"),
        ((1, 2, 3, 4, 5), "5 harmonics for codes"),
        ((1, 2, 5, 9), "row 4 is not cos of harmonic 5"),
        ((1, 2, 4, 3), "row 4 is not cos of harmonic 4"),
        ((1, -2, 3, 4), "harmonic -2, expected 1 or more"),
        ((1, 0, 3, 4), "harmonic 0, expected 1 or more"),
        ((1.5, 2, 3, 4), "harmonic 1.5, expected a whole number"),
        (4, "harmonics 4, expected whole numbers in a row"),
    ],
)
def test_harmonics_that_are_not_those_of_the_rows_are_refused(harmonics, message):
    with pytest.raises(InputError, match=f"code waves: {message}"):
        IntegerCode("waves", waves((1, 2, 3, 4), 1024), harmonics=harmonics)


def test_rows_that_are_not_those_of_the_harmonics_are_refused():
    late = waves((1, 2, 3, 4), 256)
    late[7] = np.roll(late[7], 2)
    with pytest.raises(InputError, match="row 7 is not sin of harmonic 4"):
        IntegerCode("late", late, harmonics=(1, 2, 3, 4))
    with pytest.raises(InputError, match="code table: quarter wave: the first row is no cosine"):
        IntegerCode("table", np.arange(16).reshape(2, 8), harmonics=(1,))


@pytest.mark.parametrize("bins", [8, 16, 64, 1024])
@pytest.mark.parametrize("amplitude", [3, 31, 127])
def test_waves_of_any_length_and_height_are_taken(bins, amplitude):
    """Take rounded codes, and even harmonics that are half a step of the table late, as Fourier codes."""
    harmonics = tuple(range(1, bins // 4))
    angle = 2 * np.pi * np.array(harmonics)[:, None] * (np.arange(bins) + 0.5) / bins
    rows = np.rint(amplitude * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(np.int8).reshape(-1, bins)
    code = IntegerCode("waves", rows, harmonics=np.array(harmonics))
    assert code.harmonics == harmonics and folded_temporal(code).shape == rows.shape


@pytest.mark.parametrize("changed", [{"spatial": np.ones((32, 2, 2), int)}, {"temporal": np.eye(32, 1024, dtype=int)}])
def test_counters_are_of_equal_gates_alone(changed):
    given = {"temporal": coarse_matrix(32, 1024), "counters": True} | changed
    with pytest.raises(InputError, match="code gates: counters "):
        IntegerCode("gates", **given)


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_counters_follow_the_timestamps_of_the_chip(bits):
    chip = ChipSpec(timestamp_bits=bits)
    compiled = compile_code(IntegerCode("gates", coarse_matrix(32, 1 << bits), counters=True), chip)
    assert verify(compiled.program, compiled.matrix[0, 0], chip=chip).clocks.size == 1 << bits
    assert compiled.program.timestamps == 1 << bits
    shorter = IntegerCode("gates", coarse_matrix(32, 1 << bits - 1), counters=True)
    with pytest.raises(InputError, match=f"counters over {1 << bits - 1} bins, expected all {1 << bits} timestamps"):
        compile_code(shorter, chip)


def test_what_is_no_array_of_bytes_is_refused():
    with pytest.raises(InputError, match="temporal of type list, expected a NumPy array"):
        IntegerCode("list", [[1, 2]])
    with pytest.raises(InputError, match="value 128 is outside -127 to 127"):
        IntegerCode("lowest", np.full((2, 16), -128, np.int8))
