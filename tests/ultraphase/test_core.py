"""Core and CoreArray against an independent NumPy model, their limits, counters, links and traces."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.errors import InputError
from ultraphase import ChipSpec, Core, CoreArray, Program, assemble
from ultraphase.assembly.isa import Instruction
from ultraphase.assembly.program import Region
from ultraphase.reference import interpret

RAM = 64
REGIONS = (Region("data", "u8", RAM, 0),)
PLAIN = ("ADD", "SUB", "AND", "OR", "XOR", "MUL", "MIN", "MAX")


def program(instructions: list[Instruction]) -> Program:
    return Program("random", tuple(instructions), REGIONS, {}, tuple(("random", n) for n in range(len(instructions))))


def model(instructions: list[Instruction], timestamps: list[int]) -> dict:
    return interpret(instructions, timestamps, RAM)


@st.composite
def programs(draw):
    """Instructions that end: branches go forward; addresses by register are masked first."""
    found: list[Instruction] = []
    register = st.integers(0, 15)
    for _ in range(draw(st.integers(4, 30))):
        kind = draw(
            st.sampled_from(["alu", "alu", "shift", "ram", "ram", "branch", "saturate", "out", "mov", "photon"])
        )
        d, s = draw(register), draw(register)
        wide = st.one_of(st.integers(-(1 << 16), (1 << 16) - 1), st.sampled_from([0, 1, -1, 255, 32767, -32768]))
        constant = draw(st.booleans())
        value = draw(wide if constant else register)
        match kind:
            case "alu":
                found.append(Instruction(draw(st.sampled_from(PLAIN)), d, s, constant, value))
            case "mov":
                found.append(Instruction("MOV", d, 0, constant, value))
            case "shift":
                op = draw(st.sampled_from(["SHL", "SHR", "SAR"]))
                found.append(Instruction(op, d, s, value=draw(st.integers(1, 4))))
            case "saturate":
                found.append(Instruction(draw(st.sampled_from(["SATB", "SATH", "ID"])), d, 0))
            case "out":
                found.append(Instruction(draw(st.sampled_from(["OUTB", "OUTH"])), rs=s))
            case "photon":
                found.append(Instruction("BNT", target=len(found) + 2))
                found.append(Instruction("RDT", d))
            case "ram":
                op = draw(st.sampled_from(["LDB", "LDBS", "LDH", "STB", "STH", "ADDM", "SUBM"]))
                if not constant:
                    found.append(Instruction("AND", s, s, True, RAM - 16 - 2))
                found.append(Instruction(op, d, 0 if constant else s, constant, 2 * draw(st.integers(0, 7))))
            case "branch":
                op = draw(st.sampled_from(["BZ", "BNZ", "BLT", "BBS", "BBC", "JMP", "BNT", "BFE"]))
                takes = Instruction(op).op.takes
                fields = {"rs": s if "s" in takes else 0, "rd": d if "t" in takes else 0}
                fields["bit"] = draw(st.integers(0, 31)) if "b" in takes else 0
                found.append(Instruction(op, **fields, target=len(found) + 1 + draw(st.integers(0, 4))))
    end = len(found)
    found = [dataclasses.replace(one, target=min(one.target, end)) for one in found]
    # a branch must not jump between a mask and its access, nor onto a timestamp that is not there
    inner = {n for n, one in enumerate(found) if n and (one.name == "RDT" or found[n - 1].name == "AND")}
    found = [dataclasses.replace(one, target=end) if one.target in inner else one for one in found]
    return found + [Instruction("HALT")]


@settings(deadline=None, derandomize=True, max_examples=100)
@given(programs(), st.lists(st.lists(st.integers(0, 1023), max_size=4), min_size=3, max_size=3))
def test_core_and_array_equal_the_independent_model(instructions, streams):
    code = program(instructions)
    expected = [model(instructions, stream) for stream in streams]
    for stream, want in zip(streams, expected, strict=True):
        core = Core(code)
        out, counters = core.frame(stream)
        assert (list(core.registers), list(core.ram[:RAM]), list(out)) == (want["r"], want["ram"], want["out"])
        assert (counters.instructions, counters.wraps, counters.saturations) == (want["n"], want["w"], want["s"])
    for stream, want in zip(streams, expected, strict=True):
        array = CoreArray(code, (1, 1))
        frame = array.frame(np.array(stream, np.int64), np.array([0, len(stream)]))
        assert array.registers[:, 0].tolist() == want["r"] and array.ram[0, :RAM].tolist() == want["ram"]
        assert frame.out.reshape(-1).tolist() == want["out"]
    if len({len(want["out"]) for want in expected}) == 1:  # an array's cores put out as many words each
        together = CoreArray(code, (3, 1))  # their row's parity is what ID reads: let it be even
        together.place[:] = 0
        offsets = np.concatenate([[0], np.cumsum([len(stream) for stream in streams])])
        frame = together.frame(np.concatenate([np.array(s, np.int64) for s in streams]), offsets)
        assert together.registers.T.tolist() == [want["r"] for want in expected]
        assert frame.counters.instructions == sum(want["n"] for want in expected)
        assert frame.counters.wraps == sum(want["w"] for want in expected)
        assert frame.cycles[:, 0].tolist() == [3 * want["n"] for want in expected]


@settings(deadline=None, derandomize=True, max_examples=100)
@given(programs(), st.lists(st.lists(st.integers(0, 1023), max_size=4), min_size=3, max_size=3))
def test_cores_that_go_on_alone_do_what_they_do_in_step(instructions, streams):
    def frame_with(few: int) -> tuple:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("ultraphase.array._FEW", few)
            patch.setattr("ultraphase.array._MANY_TIMESTAMPS", 0)
            array = CoreArray(program(instructions), (1, 3))
            offsets = np.concatenate([[0], np.cumsum([len(stream) for stream in streams])])
            try:
                return array, array.frame(np.concatenate([np.array(s, np.int64) for s in streams]), offsets)
            except InputError as error:
                return array, str(error)

    (left, in_step), (right, alone) = frame_with(0), frame_with(3)
    if isinstance(in_step, str):  # cores put out different numbers of words
        assert in_step == alone
        return
    assert np.array_equal(left.ram, right.ram) and np.array_equal(left.registers, right.registers)
    assert np.array_equal(in_step.out, alone.out) and np.array_equal(in_step.cycles, alone.cycles)
    assert in_step.counters == alone.counters and np.array_equal(in_step.out_bits, alone.out_bits)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(programs(), st.lists(st.integers(0, 1023), max_size=4))
def test_steps_are_a_run_in_slow_motion(instructions, stream):
    stepped, ran = Core(program(instructions)), Core(program(instructions))
    stepped.start(stream)
    steps = list(stepped.trace())
    ran.frame(stream)
    assert stepped.registers == ran.registers and stepped.ram == ran.ram and stepped.counters == ran.counters
    for step, following in itertools.pairwise(steps):
        assert step.after == following.before
        assert step.after.counters.instructions == step.before.counters.instructions + 1


COUNTER = """
.space seen, u8, 4
.space sum, s16, 1
loop: BNT idle
      RDT r1
      AND r1, r1, #3
      LDB r2, [seen + r1]
      ADD r2, r2, #1
      SATB r2, r2
      STB [seen + r1], r2
      ADDM [sum], r1
      JMP loop
idle: BFE end
      JMP loop
end:  LDH r3, [sum]
      OUTH r3
      HALT
"""


def test_states_are_immutable_and_counters_count():
    core = Core(assemble(COUNTER))
    core.start([3, 3, 1])
    first = core.step()
    with pytest.raises(dataclasses.FrozenInstanceError):
        first.before.word = 7
    saved = first.after
    core.run()
    assert saved.ram == bytes(512) and saved.out == () and core.out == [7]
    assert core.contents("seen").tolist() == [0, 1, 0, 2]
    # 9 instructions a photon, then BNT, BFE, LDH, OUTH, HALT
    assert core.counters.instructions == 3 * 9 + 5 and core.counters.cycles == 3 * 32
    assert core.counters.photons == 3 and core.counters.ram_reads == 3 * 2 + 1 and core.counters.ram_writes == 3 * 2
    out, again = core.frame([2])
    assert out == (9,) and again.photons == 1 and again.instructions == 14  # RAM stays from frame to frame


def test_watch_shows_each_change():
    core = Core(assemble(COUNTER))
    core.start([3, 3, 0, 1])
    seen = [contents for _, contents in core.watch("sum")]
    assert seen == [(3,), (6,), (7,)]
    core.start([2])
    trace = [str(step) for step in core.trace(3)]
    assert "RDT r1" in trace[1] and "r1: 1 -> 2" in trace[1]
    with pytest.raises(InputError, match="no region 'nothing'"):
        list(core.watch("nothing"))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("MOV r1, #64\nLDB r2, [r1]\nHALT", "RAM address 64 is outside the declared 0 to 63"),
        ("MOV r1, #-1\nSTB [r1 + 0], r2\nHALT", "RAM address -1"),
        ("LDH r2, [r2 + 63]\nHALT", "RAM address 63 is outside the declared 0 to 62"),
        ("MOV r1, #3\nADDM [r1 + 2], r2\nHALT", "address 5 of 16 bits is odd"),
        ("LDH r1, [r1 + 3]\nHALT", "address 3 of 16 bits is odd"),
        ("RDT r1\nRDT r1\nHALT", "2, word 1 (RDT r1): no timestamp is there"),
        ("MOV r1, #1", "runs behind its last instruction"),
        ("a: JMP a", "no progress"),
        ("a: BNT a\nHALT", "no progress"),
        ("a: OUTB r1\nJMP a", "the frame does not end: more than 500 words a core, and 16 a photon, left cores"),
    ],
)
def test_core_and_array_refuse_alike(source, message, monkeypatch):
    monkeypatch.setattr("ultraphase.core.MAX_WORDS", 500)
    code = assemble(".space data, u8, 64\n" + source, name="p")
    stream = [] if source.startswith("a:") else [1]
    for run in (
        lambda: Core(code).frame(stream),
        lambda: CoreArray(code, (1, 2)).frame(np.array(stream * 2, int), np.array([0, len(stream), 2 * len(stream)])),
    ):
        with pytest.raises(InputError) as refused:
            run()
        line = message.replace("2, word 1", "3, word 1")
        assert line in str(refused.value)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("LDB r1, [400]\nHALT", "RAM address 400 is not there: the program declares no RAM"),
        ("LDH r1, [400]\nHALT", "RAM address 400 is not there: the program declares no RAM"),
        (".space a, u8, 1\nLDH r1, [0]\nHALT", "RAM address 0 is outside the declared 1 byte"),
    ],
)
def test_a_program_without_ram_is_said_to_have_none(source, message):
    code = assemble(source, name="p")
    for run in (
        lambda: Core(code).frame([]),
        lambda: CoreArray(code, (1, 1)).frame(np.zeros(0, int), np.zeros(2, int)),
    ):
        with pytest.raises(InputError, match=message):
            run()


def test_limits_of_the_chip_are_the_specs():
    code = assemble("SHR r1, r1, #4\nHALT")
    with pytest.raises(InputError, match="shift by 4 is outside 1 to 2"):
        Core(code, chip=ChipSpec(max_shift=2))
    with pytest.raises(InputError, match="2 words, 1 over the 1"):
        Core(code, chip=ChipSpec(program_words=1))
    with pytest.raises(InputError, match="64 bits of RAM, 48 bits over the 16"):
        assemble(".space a, u8, 8\nHALT", chip=ChipSpec(ram_bits=16))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"clock_s": 0.0}, "chip: clock_s 0, expected above 0"),
        ({"clock_s": math.nan}, "chip: clock_s nan, expected above 0"),
        ({"energy_per_instruction_j": -1.0}, "chip: energy_per_instruction_j -1, expected above 0"),
        ({"clocks_per_instruction": 0}, "chip: 0 clocks an instruction, expected 1 or more"),
        ({"cores": (0, 6)}, "chip: cores 0 x 6, expected 1 or more each"),
    ],
)
def test_chips_that_cannot_be_are_refused(changed, message):
    with pytest.raises(InputError, match=message):
        ChipSpec(**changed)


@pytest.mark.parametrize("wrong", [[63.9], [1.0, 2.0], np.zeros((2, 2), int)])
def test_timestamps_that_are_no_whole_numbers_are_refused(wrong):
    code = assemble("HALT")
    with pytest.raises(InputError, match="expected whole numbers in one dimension"):
        Core(code).start(wrong)
    with pytest.raises(InputError, match="expected whole numbers in one dimension"):
        CoreArray(code, (1, 1)).frame(np.asarray(wrong), np.array([0, len(wrong)]))


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({}, "table t has no contents"),
        ({"t": np.arange(3)}, r"shape \(3,\)"),
        ({"t": np.array([0, 1, 2, 256])}, "values 0 to 256 are outside 0 to 255"),
        ({"t": np.array([0.5] * 4)}, "float64"),
        ({"t": np.arange(4), "u": np.arange(4)}, "no table u"),
    ],
)
def test_tables_are_checked(tables, message):
    code = assemble(".table t, u8, 4\n.space s, u8, 4\nHALT")
    with pytest.raises(InputError, match=message):
        Core(code, tables)


def test_timestamps_are_checked():
    code = assemble(COUNTER)
    with pytest.raises(InputError, match="outside 0 to 65535"):
        Core(code).frame([-1])
    with pytest.raises(InputError, match="expected 5 that rise"):
        CoreArray(code, (2, 2)).frame(np.zeros(3, int), np.array([0, 1, 2, 3]))


PASS = """
      ID r1
      BBS r1, #0, right
      RECV r2, east
      OUTH r2
      HALT
right: MOV r2, #123
.for n in 1..5
      ADD r2, r2, #1
.end
      SEND west, r2
      HALT
"""


def test_words_pass_between_cores_and_waiting_takes_time():
    frame = CoreArray(assemble(PASS), (2, 2)).frame(np.zeros(0, int), np.zeros(5, int))
    assert frame.out.tolist() == [[128], [128]] and frame.out_cores.tolist() == [[0, 0], [1, 0]]
    # the sender needs ID, BBS, MOV, 5 ADD, SEND = 9 instructions; the receiver waits for it after ID and BBS
    assert frame.cycles.tolist() == [[3 * 12, 3 * 10]] * 2 and frame.stalls.tolist() == [[3 * 7, 0]] * 2


def test_a_full_link_holds_the_sender():
    source = "ID r1\nBBS r1, #0, right\nMOV r3, #20\nMOV r4, #0\n"
    source += "w: ADD r4, r4, #1\nBLT r4, r3, w\nRECV r2, east\nRECV r3, east\nOUTH r2\nOUTH r3\nHALT\n"
    source += "right: MOV r2, #1\nSEND west, r2\nMOV r2, #2\nSEND west, r2\nHALT"
    frame = CoreArray(assemble(source), (1, 2)).frame(np.zeros(0, int), np.zeros(3, int))
    assert frame.out.tolist() == [[1, 2]] and frame.stalls[0, 1] > 0


@pytest.mark.parametrize(
    ("source", "shape", "message"),
    [
        ("RECV r1, east\nHALT", (1, 2), "core (0, 1) has no east neighbour"),
        ("ID r1\nBBS r1, #0, b\nRECV r2, east\nHALT\nb: HALT", (1, 2),
         "core (0, 0) waits at p:3, word 2 (RECV r2, east) for core (0, 1) for a word, which has halted"),
        ("ID r1\nBBS r1, #0, b\nRECV r2, east\nHALT\nb: RECV r2, west\nHALT", (1, 2), "which waits itself"),
        ("ID r1\nBBS r1, #0, b\nSEND east, r1\nSEND east, r1\nHALT\nb: HALT", (1, 2),
         "to take a word, which has halted"),
    ],
)  # fmt: skip
def test_blocked_cores_are_explained(source, shape, message):
    with pytest.raises(InputError) as refused:
        CoreArray(assemble(source, name="p"), shape).frame(np.zeros(0, int), np.zeros(shape[0] * shape[1] + 1, int))
    assert message in str(refused.value)


def test_a_core_alone_has_no_links():
    with pytest.raises(InputError, match="a core alone has no neighbours"):
        Core(assemble("SEND west, r1\nHALT")).frame([])


def test_the_chips_own_array_is_eighteen_independent_cores():
    random, code = np.random.default_rng(0), assemble(COUNTER)
    shape = ChipSpec().cores
    lengths = random.integers(0, 30, shape[0] * shape[1])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    stamps = random.integers(0, 1024, offsets[-1])
    frame = CoreArray(code, shape).frame(stamps, offsets)
    for number in range(len(lengths)):
        out, counters = Core(code).frame(stamps[offsets[number] : offsets[number + 1]])
        assert tuple(frame.out[number]) == out and frame.cycles.reshape(-1)[number] == counters.cycles
