"""The programs that come with the package: proofs over all timestamps, limits of the number formats, frame ends."""

import itertools
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.errors import InputError
from ultraphase import ChipSpec, Core, CoreArray, assemble, method, verify
from ultraphase.array import ArrayRun
from ultraphase.catalog import FOLDER, PUBLISHED
from ultraphase.tables import block_matrix, fourier_matrix, int8_codes, quarter_wave, spatial_sum

DEFAULT = settings(deadline=None, derandomize=True, max_examples=8)


def temporal(codes: int, bins: int) -> np.ndarray:
    """Int8 truncated Fourier at bin centres, by its definition."""
    angle = 2 * np.pi * np.arange(1, codes // 2 + 1)[:, None] * (np.arange(bins) + 0.5) / bins
    return np.rint(127 * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(int).reshape(codes, bins)


def tensor(name: str) -> np.ndarray | None:
    chosen = method(name)
    return temporal(chosen.codes, chosen.temporal_bins) if chosen.temporal_bins else None


@lru_cache
def proof(name: str):
    chosen = method(name)
    return verify(chosen.program(), chosen.matrix(tensor(name)), chosen.tables(tensor(name)))


@pytest.mark.parametrize("name", [*PUBLISHED, "coarse-16-shift-2", "fourier-2", "separable-20", "addressed-4"])
def test_every_timestamp_adds_its_column_of_the_integer_matrix(name):
    found = proof(name)
    assert np.array_equal(found.table.T, method(name).matrix(tensor(name)))
    assert found.saturates.all() == name.startswith("coarse") and found.states >= 7


def test_matrices_are_what_they_are_called():
    for codes in (16, 64, 256):
        matrix = method(f"coarse-{codes}").matrix()
        assert (matrix.argmax(axis=0) == np.arange(1024) >> (10 - codes.bit_length() + 1)).all()
        assert (matrix.sum(axis=0) == 1).all()
    for name, most in (("fourier-8", 1), ("fourier-16", 1), ("separable-8", 2), ("separable-16", 2)):
        exact = tensor(name)
        matrix = method(name).matrix(exact)[: method(name).codes, : exact.shape[1]]
        # odd harmonics exactly, even ones half a table step late: pi / bins, at most 127 pi / bins and a rounding
        odd = np.repeat(np.arange(method(name).codes // 2) % 2 == 0, 2)
        assert (matrix[odd] == exact[odd]).all()
        assert np.abs(matrix - exact).max() == most <= 127 * np.pi / exact.shape[1] + 1
    for name in ("separable-8", "separable-16"):
        matrix, codes = method(name).matrix(tensor(name)), method(name).codes
        for block in range(4):
            rows = matrix[block * codes : (block + 1) * codes]
            inside = np.arange(1024) // 256 == block
            assert (rows[:, ~inside] == 0).all() and np.array_equal(rows[:, inside], matrix[:codes, :256])


@pytest.mark.parametrize("codes", [8, 16])
def test_fold_at_phases_256_and_768(codes):
    """Folding a quarter as (256 - i) reads entry 0 for entry 256 on the axes: wrong by up to the whole amplitude."""
    name = f"fourier-{codes}"
    table = proof(name).table
    assert table[256, :2].tolist() == [0, 127] and table[768, :2].tolist() == [0, -127]
    assert table[255, :2].tolist() == [0, 127] and table[257, :2].tolist() == [-1, 127]

    def read(file):
        text = (FOLDER / file).read_text()
        return text.replace("XOR  i, i, #QUARTER - 1", "SUB  i, zero_, i\n AND i, i, #QUARTER - 1")

    naive = ".reg zero_, r12\nMOV zero_, #0\n" + (FOLDER / "fourier.s").read_text()
    program = assemble(naive.replace("K, 16", "K, 4"), name="naive", read=read)
    quarter = quarter_wave(temporal(4, 1024))
    added = verify(program, None, {"quarter": quarter}).table
    right = fourier_matrix(quarter, 4).T
    assert np.abs(added - right)[[0, 256, 512, 768], :2].max() >= 126
    with pytest.raises(InputError, match=r"differs from the matrix .*first at timestamp 256, number 0: adds -127"):
        verify(program, right.T, {"quarter": quarter})


def test_the_259th_coherent_photon_wraps_and_is_counted():
    chosen = method("fourier-8")
    tables = chosen.tables(tensor("fourier-8"))
    for photons, wraps in ((258, 0), (259, 1), (550, 1)):
        core = Core(chosen.program(), tables)
        out, counters = core.frame([0] * photons)
        peaks = np.count_nonzero(chosen.matrix(tensor("fourier-8"))[:, 0] == 127)
        assert counters.wraps == wraps * peaks and peaks > 0
        assert out[0] == (127 * photons + 32768) % 65536 - 32768
        found = proof("fourier-8")
        histogram = np.zeros((1, 1024), np.int64)
        histogram[0, 0] = photons
        assert found.frame(histogram)[0].tolist() == list(out)
        assert (found.overflowed(found.sums(histogram)) > 0) == (photons > 258)


def test_8_bit_bins_saturate_and_are_counted():
    for name in ("coarse-16", "coarse-64", "coarse-256"):
        out, counters = Core(method(name).program()).frame([700] * 300)
        assert max(out) == 255 and sum(out) == 255
        assert counters.saturations == 300 - 255 and counters.wraps == 0
        histogram = np.bincount([700] * 300, minlength=1024)[None]
        assert proof(name).frame(histogram)[0].tolist() == list(out)


@pytest.mark.parametrize(
    ("name", "clocks"),
    [("coarse-16", 27), ("coarse-64", 24), ("coarse-256", 24), ("coarse-16-shift-2", 30), ("fourier-8", 135)],
)
def test_clocks_a_photon(name, clocks):
    assert (proof(name).clocks == clocks).all()


@pytest.mark.parametrize("family", ["fourier", "separable"])
def test_eight_more_codes_cost_120_clocks_at_every_timestamp(family):
    by_codes = [proof(f"{family}-{codes}").clocks for codes in (8, 16)]
    assert (by_codes[1] - by_codes[0] == 120).all()
    if family == "separable":
        assert set(np.unique(by_codes[0])) <= {144, 147, 150} and by_codes[0].mean() == 147


@DEFAULT
@given(st.integers(0, 2**32 - 1), st.integers(0, 600))
def test_tabulated_equals_interpreted(seed, photons):
    random = np.random.default_rng(seed)
    coherent = random.integers(0, 1024, 3)
    stamps = np.where(
        random.random(photons) < 0.6, coherent[random.integers(0, 3, photons)], random.integers(0, 1024, photons)
    )
    histogram = np.bincount(stamps, minlength=1024)[None]
    for name in ("coarse-16", "fourier-8"):
        out, _ = Core(method(name).program(), method(name).tables(tensor(name))).frame(stamps)
        assert proof(name).frame(histogram)[0].tolist() == list(out)


def test_tabulated_form_takes_any_integers_and_stays_exact():
    found, random = proof("fourier-8"), np.random.default_rng(3)
    for dtype, high in ((np.uint8, 256), (np.int32, 10), (np.uint16, 60000), (np.int64, 1 << 30)):
        histograms = random.integers(0, high, (700, 1024)).astype(dtype)
        assert np.array_equal(found.sums(histograms), histograms.astype(np.int64) @ found.table)
    assert found.frame(np.zeros((0, 1024), np.uint8)).shape == (0, 8)
    with pytest.raises(InputError, match="512 bins"):
        found.sums(np.zeros((1, 512), np.uint8))
    with pytest.raises(InputError, match=r"histograms of shape \(1024,\), expected \(pixels, 1024\)"):
        found.sums(np.zeros(1024, np.uint8))
    with pytest.raises(InputError, match="-3 counts"):
        found.sums(np.full((1, 1024), -3))


@DEFAULT
@given(st.integers(0, 2**32 - 1))
def test_weight_at_the_frame_end_equals_weight_a_photon(seed):
    """sum_n w c(t_n) = w sum_n c(t_n), in exact integers, before the one rounding that both then share."""
    random = np.random.default_rng(seed)
    codes = int(random.choice([2, 8, 16]))
    matrix = block_matrix(fourier_matrix(quarter_wave(temporal(2, 256)), codes), 1024)
    weights = random.integers(-128, 128, (4, codes))
    histograms = random.poisson(random.choice([0.02, 0.2]), (4, 1024))
    sums = (histograms @ matrix.T).reshape(4, 4, codes)
    a_photon = np.zeros((4, codes), np.int64)
    for core in range(4):
        for t in np.repeat(np.arange(1024), histograms[core]):
            a_photon += weights[core] * matrix[:, t].reshape(4, codes)
    deferred = (sums * weights[:, None, :]).sum(axis=0)
    assert np.array_equal(a_photon, deferred)
    program, quarter = method(f"separable-{codes}"), temporal(codes, 256)
    array = CoreArray(program.program(), (2, 2), program.tables(quarter, weights.reshape(2, 2, codes)))
    lengths = histograms.sum(axis=1)
    stamps = np.concatenate([np.repeat(np.arange(1024), row) for row in histograms])
    frame = array.frame(stamps, np.concatenate([[0], np.cumsum(lengths)]))
    assert np.array_equal(frame.out.reshape(4, codes), np.clip(np.floor(a_photon / 128 + 0.5), -32768, 32767))
    assert np.array_equal(frame.out.reshape(4, codes), spatial_sum(sums, weights))


def test_the_sum_of_four_cores_saturates_at_16_bits():
    chosen = method("separable-8")
    weights = np.full((2, 2, 8), 127)
    array = CoreArray(chosen.program(), (2, 2), chosen.tables(tensor("separable-8"), weights))
    frame = array.frame(np.zeros(4 * 100, int), np.arange(5) * 100)  # 4 x 100 coherent photons of 127 x 127 / 128
    assert frame.out.max() == 32767 and frame.counters.saturations > 0 and frame.counters.wraps == 0
    assert frame.out_bits.tolist() == [[32 * 16, 0], [0, 0]]
    again = array.frame(np.zeros(0, int), np.zeros(5, int))
    assert (again.out == 0).all()  # the frame's end left zeros behind


@pytest.mark.parametrize("name", ["coarse-16", "fourier-8", "separable-8"])
def test_bright_cores_that_go_on_alone_leave_what_they_leave_in_step(name, monkeypatch):
    random, chosen = np.random.default_rng(8), method(name)
    lengths = np.array([3, 900, 70, 0])  # one wraps or saturates, one is dark; separable ones wait for each other
    stamps = np.where(random.random(lengths.sum()) < 0.7, 300, random.integers(0, 1024, lengths.sum()))

    def frame(few: int) -> tuple:
        monkeypatch.setattr("ultraphase.array._FEW", few)
        array = CoreArray(chosen.program(), (2, 2), chosen.tables(tensor(name)))
        return array.frame(stamps, np.concatenate([[0], np.cumsum(lengths)])), array.ram

    (alone, ram), (in_step, other) = frame(256), frame(0)
    assert np.array_equal(ram, other) and alone.counters == in_step.counters
    assert alone.counters.wraps + alone.counters.saturations > 0
    for field in ("out", "out_cores", "out_bits", "cycles", "stalls"):
        assert np.array_equal(getattr(alone, field), getattr(in_step, field))


def test_few_bright_cores_of_many_do_not_hold_up_the_others(monkeypatch):
    """300 cores begin in step, and the one with 500 photons goes on alone when the others' 70 are nearly done."""
    alone = []
    ours = ArrayRun.one_by_one
    monkeypatch.setattr(ArrayRun, "one_by_one", lambda run, lanes: (alone.append(lanes.tolist()), ours(run, lanes)))
    lengths = np.full(300, 70)
    lengths[17] = 500
    stamps, chosen = np.random.default_rng(2).integers(0, 1024, lengths.sum()), method("fourier-8")
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    frame = CoreArray(chosen.program(), (1, 300), chosen.tables(tensor("fourier-8"))).frame(stamps, offsets)
    assert alone == [[17]]
    histograms = np.stack([np.bincount(stamps[a:b], minlength=1024) for a, b in itertools.pairwise(offsets)])
    assert np.array_equal(frame.out, proof("fourier-8").frame(histograms))


@pytest.mark.parametrize("name", ["coarse-64", "fourier-16"])
def test_frames_follow_each_other(name):
    chosen, random = method(name), np.random.default_rng(5)
    core = Core(chosen.program(), chosen.tables(tensor(name)))
    for photons in (100, 0, 37):
        stamps = random.integers(0, 1024, photons)
        out, _ = core.frame(stamps)
        assert list(out) == (np.bincount(stamps, minlength=1024) @ chosen.matrix(tensor(name)).T).tolist()


ADAPTIVE = ".space sum, s16, 2\nloop: BNT idle\nRDT r1\n{body}\nJMP loop\nidle: BFE end\nJMP loop\nend: HALT"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("LDH r2, [sum]\nBBS r2, #3, skip\nADDM [sum], r1\nskip:", "how long timestamp"),
        ("LDH r2, [sum]\nMUL r2, r2, #3\nSTH [sum], r2", "is not additive"),
        ("LDH r2, [sum]\nADD r2, r2, r1\nSUB r2, r2, #512\nSATH r2, r2\nSTH [sum], r2", "is not additive"),
        ("ADDM [sum], r5\nMOV r5, r1", "is not additive"),
        ("LDH r2, [sum]\nBLT r2, r1, skip\nMOV r3, #1\nskip: ADDM [sum], r1", "how long timestamp"),
        ("OUTH r1", "words leave the sensor"),
    ],
)
def test_programs_that_are_not_additive_are_refused(body, message):
    with pytest.raises(InputError, match=message):
        verify(assemble(ADAPTIVE.format(body=body), name="adaptive"))


COUNTS = "loop: BNT idle\nRDT r1\n{body}\nJMP loop\nidle: BFE end\nJMP loop\nend: HALT"


@pytest.mark.parametrize(
    ("before", "body", "message"),
    [
        ("MOV r9, #0\n", "ADD r9, r9, #1\nADDM [sum], r9", "is not additive.*after another photon"),
        ("", "BNZ r9, loop\nMOV r9, #1\nADDM [sum], r9", "depends on RAM or registers, after another photon"),
        ("", "ADDM [sum], r9", "is not additive.*with random registers before the frame"),
        ("MOV r9, #2\n", "BZ r9, add\nSUB r9, r9, #1\nadd: ADDM [sum], r1", "how long timestamp"),
        ("MOV r9, #20\nMOV r8, #-1\n", "ADD r8, r8, #1\nBLT r8, r9, one\nJMP two\none: MOV r3, #1\nADDM [sum], r3\n"
         "JMP loop\ntwo: MOV r3, #2\nADDM [sum], r3", "is not additive"),
        ("MOV r9, #0\nMOV r8, #30\n", "ADD r9, r9, #1\nMOV r3, #1\nXOR r7, r9, r8\nBZ r7, skip\nJMP add\n"
         "skip: MOV r3, #2\nadd: ADDM [sum], r3", "is not additive: 300 photons leave"),
    ],
)  # fmt: skip
def test_programs_wrong_from_a_later_photon_on_are_refused(before, body, message):
    """The first photon of a frame adds what it should; the second, the thirty-first or one after another does not."""
    source = ".space sum, s16, 2\n" + before + COUNTS.format(body=body)
    with pytest.raises(InputError, match=message):
        verify(assemble(source, name="late"))


@pytest.mark.parametrize("name", ["fourier-8", "separable-8"])
def test_a_phase_that_is_cleared_before_the_loop_alone_is_refused(name):
    chosen = method(name)
    text, clears = (FOLDER / f"{chosen.family}.s").read_text(), "        MOV  p, #0"
    line = next(line for line in text.splitlines() if line.startswith(clears))
    moved = text.replace(line + "\n", "").replace("loop:", clears + "\nloop:", 1)
    program = assemble(moved.replace("K, 16", "K, 8"), name="moved", read=lambda file: (FOLDER / file).read_text())
    with pytest.raises(InputError, match="is not additive"):
        verify(program, chosen.matrix(tensor(name)), chosen.tables(tensor(name)))
    stamps = [700, 300]  # the first photon is right, both are not
    for photons, right in ((stamps[:1], True), (stamps, False)):
        core = Core(program, chosen.tables(tensor(name)))
        core.start(photons, park=True)
        core.run()
        histogram = np.bincount(photons, minlength=1024)
        assert np.array_equal(core.contents("codes"), chosen.matrix(tensor(name)) @ histogram) == right


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("MOV r1, #1\nHALT", r"ends without waiting for a photon \(BNT\)"),
        ("b: BNT b\nRDT r1\nADDM [sum], r1\nHALT", "the frame ends at a photon"),
        ("MOV r1, #5\nSTH [sum], r1\n" + COUNTS.format(body=""), r"sum\[0\] is 5 before the first photon"),
        ("OUTH r1\n" + COUNTS.format(body=""), "words leave the sensor"),
    ],
)
def test_programs_that_are_no_table_are_refused(source, message):
    with pytest.raises(InputError, match=message):
        verify(assemble(".space sum, s16, 2\n" + source, name="other"))


def test_what_is_set_before_the_loop_and_stays_is_proved():
    source = ".space sum, s16, 2\nMOV r9, #3\nMOV r2, #0\nSTH [sum], r2\n" + COUNTS.format(body="ADDM [sum], r9")
    assert verify(assemble(source, name="constant")).table.tolist() == [[3, 0]] * 1024
    # as long, and adds as much, before and after two photons
    alike = "BNZ r9, more\nJMP add\nmore: SUB r9, r9, #1\nadd: ADDM [sum], r1"
    table = verify(assemble(".space sum, s16, 2\nMOV r9, #2\n" + COUNTS.format(body=alike))).table
    assert table[:, 0].tolist() == list(range(1024))


def test_a_photon_may_not_change_a_table():
    source = ".table t, u8, 2, 1, 2\n" + ADAPTIVE.format(body="STB [t], r1")
    with pytest.raises(InputError, match="a photon changes a table"):
        verify(assemble(source))


def test_tensors_that_a_quarter_wave_does_not_give():
    chosen = method("fourier-8")
    with pytest.raises(InputError, match="no cosine"):
        chosen.tables(np.roll(temporal(8, 1024), 1, axis=1))
    with pytest.raises(InputError, match="expected integers of shape"):
        chosen.tables(temporal(16, 1024))
    with pytest.raises(InputError, match="needs an int8 temporal tensor"):
        chosen.matrix(None)
    with pytest.raises(InputError, match=r"of type list, expected integers of shape \(8, 1024\)"):
        chosen.tables(temporal(8, 1024).tolist())


@pytest.mark.parametrize("name", ["fourier-8", "separable-8", "addressed-8"])
def test_tensors_that_a_program_does_not_compute_are_refused(name):
    """Tables and matrix come from the first row alone: the others must be its harmonics."""
    chosen, right = method(name), tensor(name)
    gray, zeros = right[[0, 1, 2, 3, 6, 7, 4, 5]], right.copy()
    zeros[1:] = 0
    for wrong, row in ((gray, 4), (zeros, 1)):
        for call in (chosen.tables, chosen.matrix):
            with pytest.raises(InputError, match=f"program {name}: row {row} is not .* of harmonic"):
                call(wrong)


def test_programs_follow_the_timestamps_of_the_chip_or_refuse_it():
    chip, chosen = ChipSpec(timestamp_bits=8), method("coarse-16")
    found = verify(chosen.program(chip), chosen.matrix(chip=chip), chip=chip)
    assert found.table.shape == (256, 16) and (found.table.sum(axis=0) == 16).all()
    assert chosen.program(chip).timestamps == 256
    with pytest.raises(InputError, match="program coarse-256: 256 bins of the chip's 256 timestamps"):
        method("coarse-256").program(chip)
    for call in (method("fourier-8").program, lambda chip: method("fourier-8").matrix(tensor("fourier-8"), chip)):
        with pytest.raises(InputError, match="program fourier-8: is for 1,024 timestamps, the chip has 256"):
            call(chip)


def test_int8_codes_stay_within_127():
    assert int8_codes(np.array([1.0, -1.0, 1.004, 0.5 / 127, 0.0])).tolist() == [127, -127, 127, 0, 0]
    with pytest.raises(InputError, match="not finite"):
        int8_codes(np.array([np.nan]))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fourier-8-shift-2", "program fourier-8-shift-2: shift 2 is for coarse programs"),
        ("coarse-16-shift-0", "program coarse-16-shift-0: shift of 0 bits an instruction, expected 1 or more"),
    ],
)
def test_shifts_that_change_nothing_or_divide_by_zero_are_refused(name, message):
    with pytest.raises(InputError, match=message):
        method(name)
    assert method("coarse-16-shift-2").program().instructions != method("coarse-16").program().instructions


@pytest.mark.parametrize("name", ["coarse-16", "fourier-8", "separable-8"])
def test_timestamps_beyond_a_programs_range_are_refused(name):
    """A table of 1,024 timestamps would fold a record of 1,536 bins into them, without a word."""
    program, chosen = method(name).program(), method(name)
    bins = chosen.temporal_bins
    tables = chosen.tables(np.zeros((chosen.codes, bins), np.int64)) if bins else {}
    offsets = np.array([0, 1])
    for refusing in (
        lambda: Core(program, tables).start([1024]),
        lambda: CoreArray(program, (1, 1), tables).frame(np.array([1535]), offsets),
    ):
        with pytest.raises(InputError, match=rf"program {name}: timestamp \d+ is outside 0 to 1023"):
            refusing()
    Core(program, tables).start([1023])
    assert method("addressed-4").program().timestamps == 16 * 1024
