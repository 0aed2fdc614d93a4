"""Source to words and back: what the assembler takes, what it refuses, and where it says so."""

import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.errors import InputError
from ultraphase import ChipSpec, assemble, assemble_file, disassemble, listing, method
from ultraphase.assembly.isa import DIRECTIONS, OPS, Instruction, decode, encode, format_instruction
from ultraphase.catalog import FOLDER, PUBLISHED

DEFAULT = settings(deadline=None, derandomize=True, max_examples=80)


@st.composite
def instructions(draw, words: int = 64, max_shift: int = 4):
    op = draw(st.sampled_from(OPS))
    register = st.integers(0, 15)
    fields = {"rd": draw(register) if {"d", "t"} & set(op.takes) else 0, "rs": draw(register) if "s" in op.takes else 0}
    constant = st.integers(-(1 << 16), (1 << 16) - 1)
    for kind in op.takes:
        if kind == "v":
            fields["constant"] = draw(st.booleans())
            fields["value"] = draw(constant if fields["constant"] else register)
        elif kind == "m":
            fields["constant"] = draw(st.booleans())
            in_ram = st.integers(0, 512 // op.size - 1).map(lambda place, size=op.size: place * size)
            fields["value"] = draw(in_ram if fields["constant"] else constant)
            fields["rs"] = 0 if fields["constant"] else draw(register)
        elif kind == "n":
            fields["value"] = draw(st.integers(1, max_shift))
        elif kind == "x":
            fields["value"] = draw(st.integers(0, len(DIRECTIONS) - 1))
        elif kind == "l":
            fields["target"] = draw(st.integers(0, words - 1))
        elif kind == "b":
            fields["bit"] = draw(st.integers(0, 31))
    return Instruction(op.name, **fields)


@DEFAULT
@given(instructions())
def test_words_are_instructions_and_back(one):
    assert 0 <= encode(one) < 1 << 32 and decode(encode(one)) == one


@DEFAULT
@given(st.integers(0, (1 << 32) - 1))
def test_a_word_is_one_instruction_or_refused(word):
    try:
        one = decode(word)
    except InputError:
        return
    assert encode(one) == word


@DEFAULT
@given(st.lists(instructions(words=8), min_size=8, max_size=40))
def test_disassembled_programs_assemble_to_the_same_words(found):
    words = tuple(encode(one) for one in found)
    again = assemble(disassemble(words))
    assert again.words == words


@pytest.mark.parametrize("name", [*PUBLISHED, "learned-1", "addressed-8", "coarse-16-shift-2"])
def test_programs_of_the_package_survive_the_round_trip(name):
    program = method(name).program()
    again = assemble(disassemble(program.words, program.regions))
    assert again.words == program.words and again.regions == program.regions


def test_labels_of_disassembled_programs_are_no_names_of_ram():
    program = assemble(".space L1, u8, 1\n.space L_1, u8, 1\n MOV r1, #1\nturn: LDB r2, [L1]\n JMP turn\n")
    again = assemble(disassemble(program.words, program.regions))
    assert again.words == program.words and again.regions == program.regions


def test_listing_has_every_word_with_its_source_line():
    program = method("fourier-8").program()
    text = listing(program)
    for address, word in enumerate(program.words):
        file, number = program.lines[address]
        line = next(line for line in text.splitlines() if line.startswith(f"  {address:3d}  {word:08x}  3  "))
        assert line.endswith(f"; {file}:{number}")
        source = (FOLDER / file).read_text().splitlines()[number - 1].split(";")[0]
        assert format_instruction(program.instructions[address]).split()[0] in source
    assert "2176 of 4096 bits" in text and "table quarter: 256 x u8, 2048 bits" in text


def test_constants_loops_names_and_regions():
    program = assemble(
        """
        .equ K, 0x3
        .table ramp, s8, 2*K, -1, 2, 3, 4, 5, 0b110   ; values given here
        .space odd, u8, 1
        .space sum, s16, (K + 1) % 3                  ; at an even address
        .reg x, r4
        top:
        .for k in 0..K - 1
            LDBS x, [ramp + 2*k]
        skip{k}: BNZ x, skip{k}
            .for n in 1..k
            STH [sum], x
            .end
        .end
        .reg x, r4 + 1
            add x, x, #-K*2
            jmp top
        """
    )
    assert [one.name for one in program.instructions] == [
        *("LDBS", "BNZ", "LDBS", "BNZ", "STH", "LDBS", "BNZ", "STH", "STH", "ADD", "JMP")
    ]
    assert [one.value for one in program.instructions if one.name == "LDBS"] == [0, 2, 4]
    assert program.labels == {"top": 0, "skip0": 1, "skip1": 3, "skip2": 6}
    assert program.instructions[9] == Instruction("ADD", rd=5, rs=5, constant=True, value=-6)
    assert [(r.address, r.bits) for r in program.regions] == [(0, 48), (6, 8), (8, 16)] and program.ram_bits == 72
    assert program.regions[0].values == (-1, 2, 3, 4, 5, 6)


def test_given_constants_win():
    source = ".equ K, 4\nMOV r1, #K\nHALT"
    assert assemble(source, constants={"K": 9}).instructions[0].value == 9
    assert assemble("MOV r1, #MAX_SHIFT", chip=ChipSpec(max_shift=7)).instructions[0].value == 7


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("MOV r1, #1\n  ADD r1, r16, #1", "2:11: 'r16' is no register"),
        ("NOP", "1:1: unknown instruction 'NOP'"),
        (".word 3", "1:1: unknown directive '.word'"),
        ("MOV r1 #1", "1:8: expected ','"),
        ("MOV r1, 1", "1:9: expected a register"),
        ("MOV r1, #1 r2", "1:12: unexpected 'r2'"),
        ("MOV r1, #65536", "1:10: constant 65536 is outside -65536 to 65535"),
        ("MOV r1, #1/0", "1:11: division by zero"),
        ("MOV r1, #size", "1:10: 'size' is not defined"),
        ("MOV r1, $2", "1:9: unexpected '$'"),
        ("SHR r1, r1, #5", "1:14: shift by 5 is outside 1 to 4"),
        ("SHR r1, r1, #0", "1:14: shift by 0"),
        ("BBS r1, #32, a", "1:10: bit 32"),
        ("JMP nowhere", "1:5: label 'nowhere' is not defined"),
        ("a: a: HALT", "1:4: 'a' is defined already"),
        (".equ a, 1\na: HALT", "2:1: 'a' is defined already"),
        (".equ r3, 1", "1:6: 'r3' is defined already"),
        ("LDB r1, [r2 + r3]", "1:15: one base register"),
        ("LDB r1, [4 - r3]", "1:14: one base register"),
        ("SEND up, r1", "1:6: direction 'up'"),
        (".space a, u9, 4", "1:11: kind 'u9'"),
        (".space a, u8, 0", "1:8: a: 0 values"),
        (".table a, u8, 3, 1, 2", "1:8: a: 2 values for 3 places"),
        (".table a, u8, 3, 1, 2, 300", "1:24: a: 300 is outside 0 to 255, those of u8"),
        (".table a, s8, 2, -129, 0", "1:18: a: -129 is outside -128 to 127"),
        (".space a, s16, 4\n  LDH r1, [-4]", "2:12: RAM address -4 is outside 0 to 510"),
        (".space a, s16, 4\n  STH [a + 3], r1", "2:8: RAM address 3 of 16 bits is odd"),
        ("LDB r1, [600]", "1:10: RAM address 600 is outside 0 to 511"),
        (".equ K, 3\n.equ K, 4\nHALT", "2:6: 'K' is defined already"),
        (".eqv K, 3", "1:1: unknown directive '.eqv'; did you mean '.equ'?"),
        ("addn r1, r1, #1", "1:1: unknown instruction 'addn'; did you mean 'ADD'?"),
        (".for k in 0..2\nHALT", "1:1: .for without .end"),
        (".end", "1:1: unknown directive '.end'"),
        ("l{k}: HALT", "1:1: 'l{k}': k is no loop variable"),
        ('.include "x.s"', '1:11: .include "file" is not possible here'),
        ("MOV r1, #" + "(" * 5000, "parentheses or signs deep"),
        (".for a in 1..99999\n.equ x{a}, 1\n.end", "more than 20000 statements"),
        ("JMP a\na:", "branches to word 1, behind the program"),
        ("", "no instructions"),
        ("MOV r1, #99999999999999999999", "does not fit into 32 bits"),
    ],
)
def test_mistakes_are_refused_with_line_and_column(source, message):
    with pytest.raises(InputError) as refused:
        assemble(source, name="p.s")
    assert message in str(refused.value) and "p.s" in str(refused.value) and "\n" not in str(refused.value)


def test_files_that_are_missing_or_no_text(tmp_path):
    (tmp_path / "a.s").write_text('HALT\n.include "b.s"\n')
    with pytest.raises(InputError, match=r"a\.s:2:11: .*'b\.s' not found"):
        assemble_file(tmp_path / "a.s")
    (tmp_path / "b.s").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="is not text"):
        assemble_file(tmp_path / "a.s")
    (tmp_path / "b.s").write_text('.include "a.s"')
    with pytest.raises(InputError, match="more than 8 deep"):
        assemble_file(tmp_path / "a.s")


def test_the_257th_instruction_is_refused():
    full = "MOV r1, #1\n" * 256
    assert len(assemble(full).words) == 256
    with pytest.raises(InputError, match="257 words, 1 over the 256"):
        assemble(full + "HALT")
    with pytest.raises(InputError, match=r"fourier-26: 297 words, 41 over|fourier-26: \d+ words, \d+ over the 256"):
        method("fourier-26").program()


@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("coarse-16", 128),
        ("coarse-64", 512),
        ("coarse-256", 2048),
        ("fourier-8", 2176),
        ("fourier-16", 2304),
        ("separable-8", 1088),
        ("separable-16", 1664),
        ("learned-1", 2120),
        ("addressed-8", 4096),
    ],
)
def test_ram_that_the_programs_use(name, bits):
    assert method(name).program().ram_bits == bits


@pytest.mark.parametrize(("codes", "bits"), [(2, 4240), (8, 16960)])
def test_a_learned_temporal_tensor_does_not_fit(codes, bits):
    with pytest.raises(InputError, match=f"{bits} bits of RAM, {bits - 4096} bits over the 4096"):
        method(f"learned-{codes}").program()


@pytest.mark.parametrize("name", ["fourier-7", "fourier-0", "coarse-12", "walsh-8", "fourier", "coarse-16-shift-0"])
def test_names_that_are_no_program(name):
    with pytest.raises(InputError):
        method(name).program()


# --- Sources that would hang or take all memory ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (".for h in 1..2000000000\n.end\nHALT\n", "p.s:1:1: loops repeat 2000000000 lines"),
        (".for h in 1..2000000000\nHALT\n.end\n", "p.s:1:1: loops repeat"),
        (".for h in 1..20000\n.for i in 1..20000\n.end\n.end\nHALT\n", "p.s:2:1: loops repeat"),
        (".for h in 1..9999\n.for i in 2..1\n" + "HALT\n" * 5000 + ".end\n.end\n", "p.s:1:1: loops repeat"),
        (".for h in 1..1\n" * 200 + ".end\n" * 200, "p.s:33:1: .for inside 32 others"),
        (f".equ A, {'(' * 5000}1{')' * 5000}\n", "more than 32 parentheses"),
        (f".equ A, {'-' * 5000}1\n", "more than 32 parentheses"),
        (f".equ A, {'9' * 5000}\n", "does not fit into 32 bits"),
    ],
)
def test_loops_and_nesting_without_end_are_refused_at_once(source, message):
    with pytest.raises(InputError) as refused:
        assemble(source, name="p.s")
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_a_constant_that_the_source_does_not_know_is_refused():
    for source, there in ((".equ N, 4\nMOV r1, #N\nHALT\n", "N"), ("HALT\n", "none")):
        with pytest.raises(InputError, match=rf"^--define M: a\.s has no constant of this name, there are {there}$"):
            assemble(source, name="a.s", constants={"M": 2})
    assert assemble("MOV r1, #M\nHALT\n", constants={"M": 2}).instructions[0].value == 2


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (".space K, u8, 4\nMOV r1, #K\nHALT\n", "a.s:1:8: --define K: 'K' is RAM here, expected a constant (.equ)"),
        ("MOV r1, #K\n.table K, u8, 1, 4\nHALT\n", "a.s:2:8: --define K: 'K' is RAM here"),
        ("K: MOV r1, #1\nHALT\n", "a.s:1:1: --define K: 'K' is a label here"),
        (".reg K, r3\nMOV K, #1\nHALT\n", "a.s:1:6: --define K: 'K' is a register here"),
        (".equ N, 2\n.for K in 1..N\nMOV r1, #K\n.end\nHALT\n", "a.s has no constant of this name, there are N"),
        (".equ K, 3\n.equ K, 4\nMOV r1, #K\nHALT\n", "a.s:2:6: 'K' is defined already"),
    ],
)
def test_a_given_name_that_is_no_constant_of_the_source_is_refused(source, message):
    with pytest.raises(InputError) as refused:
        assemble(source, name="a.s", constants={"K": 2})
    assert message in str(refused.value)


def test_a_given_constant_may_stand_beside_a_loop_variable_of_its_name():
    source = ".equ n, 5\nMOV r2, #n\n.for n in 0..1\nMOV r1, #n\n.end\nHALT\n"
    assert [one.value for one in assemble(source, constants={"n": 7}).instructions[:3]] == [7, 0, 1]


def test_a_source_includes_regular_files_of_its_folder_alone(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "out.s").write_text("HALT\n")
    (folder / "link.s").symlink_to(tmp_path / "out.s")
    os.mkfifo(folder / "pipe.s")
    named = (("/dev/zero", "outside"), ("../out.s", "outside"), ("link.s", "outside"), ("pipe.s", "not a regular file"))
    for name, message in named:
        (folder / "a.s").write_text(f'.include "{name}"\nHALT\n')
        with pytest.raises(InputError, match=rf"a\.s:1:11: included file .*{message}"):
            assemble_file(folder / "a.s")
    with pytest.raises(InputError, match=r"pipe\.s: is a device, pipe or socket"):
        assemble_file(folder / "pipe.s")
    with (folder / "big.s").open("wb") as file:
        file.truncate(1 << 33)
    with pytest.raises(InputError, match=r"big\.s: 8589934592 bytes"):
        assemble_file(folder / "big.s")


def test_an_included_file_sees_the_variables_of_the_loop_around_it():
    source = '.for n in 1..12\n.include "one.s"\n.end\nHALT\n'
    found = assemble(source, read={"one.s": "label{n}: MOV r1, #n\n"}.__getitem__)
    assert [one.value for one in found.instructions[:-1]] == list(range(1, 13))
    assert found.labels["label12"] == 11
