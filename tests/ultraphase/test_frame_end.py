"""The end of a frame: run more than once, and what it puts out named."""

import numpy as np
import pytest

from scenes.errors import InputError
from ultraphase import Method, assemble, method, verify
from ultraphase.catalog import FOLDER
from ultraphase.frame_end import require_block_end
from ultraphase.tables import int8_codes

GATE = """
.space count, s16, 1
.space sum, s16, 1
      MOV r2, #1
loop: BNT idle
      RDT r1
      ADDM [count], r2
      ADDM [sum], r1
      JMP loop
idle: BFE end
      JMP loop
"""
CLEAR = "MOV r1, #0\nSTH [count], r1\nSTH [sum], r1\nHALT\n"
BOTH = "end: LDH r1, [count]\nOUTH r1\nLDH r1, [sum]\nOUTH r1\n"


def waves(codes: int, bins: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(1, codes // 2 + 1)[:, None] * (np.arange(bins) + 0.5) / bins
    return int8_codes(np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(codes, bins))


@pytest.mark.parametrize(
    ("end", "words"),
    [
        (BOTH + CLEAR, ("count[0]", "sum[0]")),
        (BOTH.replace("[sum]", "[count]") + CLEAR, ("count[0]", "count[0]")),
        ("end: LDH r1, [sum]\nOUTH r1\nSAR r1, r1, #1\nOUTH r1\n" + CLEAR, ("sum[0]", "")),
        ("end: LDH r1, [count]\nOUTB r1\nLDH r1, [sum]\nOUTH r1\n" + CLEAR, ("", "sum[0]")),
        ("end: HALT\n", ()),
    ],
)
def test_each_word_that_leaves_is_named(end, words):
    found = verify(assemble(GATE + end, name="gate"))
    assert found.puts_out == words and found.numbers == ("count[0]", "sum[0]")


def test_a_word_without_its_upper_byte_is_no_number_even_where_that_is_zero():
    few = GATE.replace("ADDM [count], r2", "BBS r1, #9, loop\nBBS r1, #8, loop\nADDM [count], r2")  # under 256
    found = verify(assemble(few + BOTH.replace("OUTH r1\nLDH r1, [sum]", "OUTB r1\nLDH r1, [sum]") + CLEAR))
    assert found.puts_out == ("", "sum[0]")


def test_a_word_of_more_bits_than_its_number_is_no_number():
    """As many bits as the matrix' numbers have are what a frame costs, and what a reader of the stream counts on."""
    chosen = method("coarse-16")
    wide = (FOLDER / "coarse.s").read_text().replace("OUTB count", "OUTH count")
    assert verify(assemble(wide, name="wide")).puts_out == ("",) * 16
    signed = wide.replace("LDB  count, [codes + bin]\n        OUTH", "LDBS count, [codes + bin]\n        OUTH")
    for source in (wide, signed):
        with pytest.raises(InputError, match="its frame puts out no number as word 0, no number as word 1"):
            verify(assemble(source, name="wide"), chosen.matrix())


def test_counters_that_lost_their_limit_are_refused_and_so_are_codes_that_got_one():
    chosen, text = method("coarse-16"), (FOLDER / "coarse.s").read_text()
    wraps = assemble(text.replace("SATB count, count", "AND  count, count, #255"), name="wraps")
    assert not verify(wraps, chosen.matrix()).saturates.any()  # none said which
    with pytest.raises(InputError, match=r"program wraps: codes\[0\] wraps around, expected to saturate"):
        verify(wraps, chosen.matrix(), saturates=chosen.saturates)
    with pytest.raises(InputError, match=r"program coarse-16: codes\[0\] saturates, expected to wrap around"):
        verify(chosen.program(), chosen.matrix(), saturates=False)
    assert verify(chosen.program(), chosen.matrix(), saturates=True).saturates.all()
    gate = assemble(GATE + BOTH + CLEAR)  # timestamp 0 adds nothing to `sum`, the others do
    assert not verify(gate, saturates=False).saturates.any()


@pytest.mark.parametrize("lost", ["MOV  a, a", "MAX  a, a, #-32768", "MIN  a, a, #32767"])
def test_a_block_whose_sum_lost_a_limit_is_refused(monkeypatch, tmp_path, lost):
    """Four bright cores add up to more than 16 bits; a sum that wrapped around there was called proved."""
    for path in FOLDER.iterdir():
        if path.suffix == ".s":
            (tmp_path / path.name).write_text(path.read_text().replace("SATH a, a", lost))
    monkeypatch.setattr("ultraphase.catalog.FOLDER", tmp_path)
    with pytest.raises(InputError, match="separable-8: a block of cores puts out other than the weighted sum"):
        require_block_end(method("separable-8"), waves(8, 256))


@pytest.mark.parametrize("half", [63, 65])
def test_a_block_whose_sum_is_rounded_from_another_half_is_refused(monkeypatch, tmp_path, half):
    """One sum of 128 tells the two apart; programs off by 2 and by 4 of 128 were called proved."""
    for path in FOLDER.iterdir():
        if path.suffix == ".s":
            (tmp_path / path.name).write_text(path.read_text().replace("ADD  a, a, #64", f"ADD  a, a, #{half}"))
    monkeypatch.setattr("ultraphase.catalog.FOLDER", tmp_path)
    with pytest.raises(InputError, match="separable-2: a block of cores puts out other than the weighted sum"):
        require_block_end(Method("separable", 2), waves(2, 256))


@pytest.mark.parametrize(
    ("idle", "message"),
    [
        ("idle: BFE end\n", "end the frame after 0 of 100"),  # nothing leads back to the loop
        ("idle: BFE end\nADDM [count], r2\nJMP loop\n", r"leave \d+ in count\[0\], all at once 100"),
        ("idle: BFE end\nMOV r2, #2\nJMP loop\n", r"leave \d+ in count\[0\], all at once 100"),
        ("idle: BFE end\nMOV r4, #9\nOUTH r4\nJMP loop\n", "put out words before the frame is over"),
        ("idle: BFE end\nMOV r7, #1\nJMP loop\n", "put out other words than all at once"),
    ],
)
def test_what_a_core_does_while_it_waits_is_run(idle, message):
    """No photon was ever waited for: a frame that ends at the first look in vain was called proved."""
    source = GATE.replace("idle: BFE end\n      JMP loop\n", idle)
    end = "end: LDH r1, [count]\nADD r1, r1, r7\nOUTH r1\nLDH r1, [sum]\nOUTH r1\nMOV r7, #0\n" + CLEAR
    with pytest.raises(InputError, match=f"program gate: photons that come one by one {message}"):
        verify(assemble(source.replace("MOV r2, #1", "MOV r2, #1\nMOV r7, #0") + end, name="gate"))
    assert verify(assemble(GATE.replace("BFE end", "BFE end\nADD r6, r6, #1") + BOTH + CLEAR)).puts_out  # turns counted


@pytest.mark.parametrize("kept", ["STH [count], r1\n", "STH [sum], r1\n", "STH [count], r1\nSTH [sum], r1\n"])
def test_an_end_that_leaves_sums_behind_is_refused(kept):
    """Every frame after the first began with the sums of those before; the end never ran, and all was verified."""
    end = BOTH + CLEAR.replace(kept, "")
    with pytest.raises(
        InputError, match=r"gate: the same photons put out .* after another frame: its end leaves other"
    ):
        verify(assemble(GATE + end, name="gate"))


def test_an_end_that_puts_out_more_each_time_is_refused():
    end = "end: ADD r9, r9, #1\nAND r9, r9, #1\nBZ r9, over\nOUTH r9\nover: HALT\n"
    with pytest.raises(InputError, match=r"the same photons put out \d+ words, and \d+ after another frame"):
        verify(assemble(GATE + end, name="gate"))


def test_a_program_of_a_matrix_puts_out_its_numbers_in_their_order():
    matrix = np.stack([np.ones(1024, int), np.arange(1024)])
    assert verify(assemble(GATE + BOTH + CLEAR, name="gate"), matrix).puts_out == ("count[0]", "sum[0]")
    for end, words in (
        (BOTH.replace("[sum]", "[count]"), "count.0. as word 0, count.0. as word 1"),
        (
            BOTH.replace("count", "x").replace("sum", "count").replace("x", "sum"),
            "sum.0. as word 0, count.0. as word 1",
        ),
        ("end: ", "nothing"),
    ):
        message = rf"gate: its frame puts out {words}, expected count\[0\], sum\[0\]"
        with pytest.raises(InputError, match=message):
            verify(assemble(GATE + end + CLEAR, name="gate"), matrix)


def test_the_ends_of_the_catalogue_are_proved():
    for name in ("coarse-16", "fourier-8", "addressed-4"):
        chosen = method(name)
        temporal = waves(chosen.codes, 1024) if chosen.temporal_bins else None
        found = verify(chosen.program(), chosen.matrix(temporal), chosen.tables(temporal))
        assert found.puts_out == found.numbers and len(found.numbers) == len(chosen.matrix(temporal))
    separable = method("separable-8")
    assert verify(separable.program(), None, separable.tables(waves(8, 256))).puts_out is None
    require_block_end(separable, waves(8, 256))


def test_a_block_whose_end_leaves_sums_behind_is_refused(monkeypatch, tmp_path):
    for path in FOLDER.iterdir():
        if path.suffix == ".s":
            (tmp_path / path.name).write_text(path.read_text().replace("STH  [place + 0], zero", "MOV  zero, #0"))
    monkeypatch.setattr("ultraphase.catalog.FOLDER", tmp_path)
    with pytest.raises(InputError, match="separable-8: a block of cores puts out other than the weighted sum"):
        require_block_end(method("separable-8"), waves(8, 256))


def test_tables_of_many_cores_are_refused_where_one_is_verified():
    program, quarter = method("fourier-8").program(), waves(8, 1024)[0, :256]
    for many in (quarter[None, None], np.tile(quarter, (2, 2, 1))):
        with pytest.raises(InputError, match=r"verify: table quarter of shape .*, expected \(count,\): one core"):
            verify(program, None, {"quarter": many})
