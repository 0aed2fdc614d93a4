"""Refuse what users give cores, chips and loads in one line that names value and limit, or take it as it is."""

import re

import numpy as np
import pytest

from scenes.errors import InputError
from ultraphase import ChipSpec, Core, CoreArray, assemble, assemble_file, method, verify
from ultraphase.arrivals import TimedCore
from ultraphase.power import Cost, Load, power

COARSE = method("coarse-16").program()


def refused(call) -> str:
    with pytest.raises(InputError) as error:
        call()
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        (np.array([5, 1024]), "timestamp 1024 is outside 0 to 1023"),
        (np.array([5, 70000]), "timestamp 70000 is outside 0 to 65535"),
        (np.array([-2, 5]), "timestamp -2 is outside 0 to"),
        (np.array([3.7, 5.0]), "expected whole numbers in one dimension"),
        (7, "timestamps are 7, expected whole numbers"),
    ],
)
def test_every_way_into_a_core_checks_its_timestamps(stamps, message):
    clocks = np.array([0.0, 5000.0])
    ways = (
        lambda: Core(COARSE).frame(stamps),
        lambda: CoreArray(COARSE, (1, 1)).frame(stamps, np.array([0, 2])),
        lambda: TimedCore(COARSE).timed_frame(clocks, stamps, 100_000),
    )
    for way in ways:
        assert message in refused(way)


def test_offsets_that_are_not_whole_are_refused():
    """Cut to whole numbers they gave a photon to another core."""
    array = CoreArray(COARSE, (1, 2))
    stamps = np.array([10, 20, 30])
    assert "offsets are of type float64, expected whole" in refused(lambda: array.frame(stamps, np.array([0, 1.9, 3])))
    assert array.frame(stamps, [0, 2, 3]).counters.photons == 3


@pytest.mark.parametrize("shape", [4, (2.0, 2), (2, 2, 1), "22", None, (0, 2)])
def test_shapes_of_an_array_are_two_whole_numbers(shape):
    message = refused(lambda: CoreArray(COARSE, shape))
    assert message.startswith("core array of shape ") and "expected" in message


@pytest.mark.parametrize("kind", [Core, CoreArray, TimedCore])
def test_a_core_takes_a_program_and_tables_by_name(kind):
    assert "expected a Program" in refused(lambda: kind("fourier-8"))
    assert "not Method" in refused(lambda: kind(method("fourier-8")))
    quarter = np.zeros(256, int)
    call = (method("fourier-8").program(), *(((1, 1),) if kind is CoreArray else ()), quarter)
    assert "tables of type ndarray, expected contents by name" in refused(lambda: kind(*call))


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("ram_bits", 4096.0, "a whole number"),
        ("ram_bits", "4096", "a whole number"),
        ("program_words", 256.5, "a whole number"),
        ("clocks_per_instruction", 2.5, "a whole number"),
        ("timestamp_bits", True, "a whole number"),
        ("max_shift", None, "a whole number"),
        ("clock_s", "1", "a number"),
        ("cores", 3, "two whole numbers (rows, columns)"),
        ("cores", (3,), "two whole numbers (rows, columns)"),
        ("cores", (4, 4.0), "a whole number"),
    ],
)
def test_fields_of_a_chip_are_of_their_kind(field, value, expected):
    message = refused(lambda: ChipSpec(**{field: value}))
    assert message.startswith(f"chip: {field} ") and message.endswith(f"expected {expected}")


def test_numbers_of_numpy_become_pythons():
    chip = ChipSpec(ram_bits=np.int64(4096), clock_s=np.float32(1e-9), cores=[np.int32(3), 6])
    assert type(chip.ram_bits) is int and type(chip.clock_s) is float and chip.cores == (3, 6)
    assert CoreArray(COARSE, np.array([1, 2])).shape == (1, 2)


@pytest.mark.parametrize("wrong", [{"pixels": 2.5}, {"pixels": "4"}, {"photons": "550"}, {"frames_per_s": None}])
def test_fields_of_a_load_are_of_their_kind(wrong):
    (name, value), *_ = wrong.items()
    assert f"load: {name} {value!r}, expected a" in refused(lambda: Load(**wrong))


def test_power_takes_a_cost():
    assert "expected a Cost" in refused(lambda: power(None, Load()))
    assert power(Cost(24, 0, 0), Load(0)).processing_energy_w == 0


def test_names_of_programs_are_text():
    assert "program None: expected a file (.s) or FAMILY-K" in refused(lambda: method(None))


def test_a_program_that_runs_on_is_shown_where():
    code = assemble("MOV r1, #1\nADD r1, r1, #2", name="p")
    for run in (
        lambda: Core(code).frame([]),
        lambda: list(started(code).trace()),
        lambda: CoreArray(code, (1, 1)).frame(np.zeros(0, int), np.zeros(2, int)),
    ):
        assert refused(run) == "p:2, word 1 (ADD r1, r1, #2): runs behind its last instruction"


def started(code) -> Core:
    core = Core(code)
    core.start([])
    return core


def test_cores_that_put_out_different_numbers_of_words_are_named():
    code = assemble("ID r1\nBBC r1, #0, one\nOUTH r1\none: OUTH r1\nHALT", name="p")
    message = refused(lambda: CoreArray(code, (1, 2)).frame(np.zeros(0, int), np.zeros(3, int)))
    assert re.fullmatch(r"program p: cores put out .* words: core \(0, 0\) 1, core \(0, 1\) 2", message)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: assemble(None), "assemble: expected a str of source"),
        (lambda: assemble_file(None), "assemble_file: expected the path of a source, not NoneType"),
        (lambda: verify(None), "verify: expected a Program of"),
        (lambda: verify(method("fourier-8").program(), tables=[1]), "verify: tables of type list"),
    ],
)
def test_what_is_no_program_is_refused_in_one_line(call, message):
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"A": 1.5}, "assemble: constant A 1.5, expected a whole number"),
        ({"A": None}, "assemble: constant A None, expected a whole number"),
        ({"A": True}, "assemble: constant A True, expected a whole number"),
        ({"A": "7"}, "assemble: constant A '7', expected a whole number"),
        ({"A": 1 << 40}, "assemble: constant A 1099511627776 does not fit into 32 bits"),
        ([], "assemble: constants [], expected whole numbers by name"),
        ({1: 2}, "assemble: constants {1: 2}, expected whole numbers by name"),
    ],
)
def test_constants_are_whole_numbers_by_name(constants, message):
    """A core of whole numbers put out 1.5."""
    source = ".equ A, 3\n  MOV r1, #A\n  OUTH r1\n  HALT\n"
    assert message in refused(lambda: assemble(source, constants=constants))
    assert Core(assemble(source, constants={"A": np.int64(5)})).frame([])[0] == (5,)


@pytest.mark.parametrize("chip", ["x", 5, 0, {}])
def test_chips_are_of_their_kind(chip, tmp_path):
    (tmp_path / "halt.s").write_text(" HALT\n")
    calls = {
        "assemble": lambda: assemble(" HALT\n", chip=chip),
        "assemble_file": lambda: assemble_file(tmp_path / "halt.s", chip=chip),
        "Core": lambda: Core(COARSE, chip=chip),
        "CoreArray": lambda: CoreArray(COARSE, chip=chip),
        "verify": lambda: verify(COARSE, chip=chip),
    }
    for name, call in calls.items():
        assert f"{name}: chip: expected a ChipSpec, not {type(chip).__name__}" in refused(call)


@pytest.mark.parametrize("place", ["a", (-1, 0), (0, 0.5), 3, (0,)])
def test_places_of_a_core_are_two_whole_numbers_from_0(place):
    assert refused(lambda: Core(COARSE, place=place)).startswith("Core: place ")
    assert Core(COARSE, place=(2, 5)).frame([3])[1].photons == 1


def test_an_array_of_more_cores_than_memory_holds_is_refused():
    message = refused(lambda: CoreArray(COARSE, (10**6, 10**6)))
    assert message.startswith("a core array of 1000000 x 1000000: needs ")


def test_programs_too_large_for_the_core_name_their_codes():
    message = refused(lambda: method("fourier-900").program())
    assert message.startswith("program fourier-900: 900 codes do not fit the core (") and "RAM address 512" in message
    assert refused(lambda: method("learned-4").program()).startswith("program learned-4: 8480 bits of RAM")
