"""What the command line says to somebody who mistyped, or gave a file of another kind."""

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from processes import run_process
from readers import READERS

from csph import CodingTensor, encode, temporal_code
from scene2spad.cli import main
from scene2spad.cli.main import COMMANDS, progress_lines
from scenes.library.catalog import load_scene
from spad.measurements.histogram import read_histogram
from spad.sensor.model import Sensor


def run(capsys: pytest.CaptureFixture, *words: str) -> tuple[int, str, str]:
    status = main(list(words))
    out, err = capsys.readouterr()
    return status, out, err


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["rendr", "plane"], "no command 'rendr'; did you mean 'render'?"),
        (["--versio"], "did you mean '--version'?"),
        (["render", "plane", "--widht", "3"], "no option --widht; did you mean '--width'?"),
        (["render", "plane", "--widht=3"], "did you mean '--width'?"),
        (["depth", "x.h5", "--metod", "argmax"], "did you mean '--method'?"),
        (["demo", "--no-seed"], "no option --no-seed"),
        (["study", "depth-ofset"], "did you mean 'depth-offset'?"),
        (["scenes", "galery"], "did you mean 'gallery'?"),
        (["dataset", "tabeltop"], "did you mean 'tabletop'?"),
    ],
)
def test_a_mistyped_word_is_answered_with_the_one_that_was_meant(words, meant, capsys):
    status, out, err = run(capsys, *words)
    assert status == 2 and not out
    assert err.startswith("scene2spad: ") and err.count("\n") == 1 and meant in err
    assert "Unrecognized options Unrecognized" not in err and "invalid choice invalid" not in err.lower()


def test_a_word_too_many_is_told_once(capsys):
    """tyro's box has its title above the same words."""
    status, _, err = run(capsys, "evaluate", "none-s0", "--set", "a.h5", "b.h5")
    assert status == 2 and err == "scene2spad: Unrecognized options: b.h5 (see scene2spad evaluate --help)\n"
    status, _, err = run(capsys, "evaluate", "none-s0", "--set")
    assert status == 2 and err.startswith("scene2spad: Missing value for argument '--set'") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["ultraphase", "list", "a.s", "--define", "SHIFT=5", "--define", "K=32"],
            "ultraphase: --define is given twice; write all its values behind one --define",
        ),
        (["render", "plane", "--width", "3", "--width=4"], "render: --width is given twice, expected once"),
        (["study", "tensors", "--scene_set", "a", "--scene-set", "b"], "study: --scene-set is given twice"),
        (["demo", "--json", "--json"], "demo: --json is given twice, expected once"),
    ],
)
def test_an_option_given_twice_is_refused(words, message, capsys):
    """Refuse an option that is given twice: of one with several values the first ones were lost without a word."""
    status, out, err = run(capsys, *words)
    assert status == 2 and not out and err.startswith(f"scene2spad: {message}") and err.count("\n") == 1


def test_an_option_that_may_stay_open_lists_its_choices_alone(capsys):
    status, _, err = run(capsys, "evaluate", "a", "--set", "b", "--law", "poison")
    expected = "Expected one of ('auto', 'first-photon', 'free-running', 'poisson'); did you mean 'poisson'?"
    assert status == 2 and expected in err and "None" not in err


def test_alone_it_prints_its_help_and_version_its_version(capsys):
    status, out, _ = run(capsys)
    assert status == 0 and "render" in out and "usage" in out.lower()
    status, out, _ = run(capsys, "--version")
    assert status == 0 and out.startswith("scene2spad 0.")


def test_a_file_of_another_kind_is_named_with_the_command_that_takes_it(tmp_path, capsys):
    for kind in ("histogram", "weights"):
        READERS[kind].make(tmp_path / f"a{READERS[kind].suffix}")
    status, _, err = run(capsys, "depth", str(tmp_path / "a.safetensors"))
    assert status == 2 and "is a checkpoint" in err
    status, _, err = run(capsys, "sense", str(tmp_path / "a.h5"))
    assert status == 2 and "expected a transient" in err


def test_a_folder_or_file_as_model_is_one_line(tmp_path, capsys, monkeypatch):
    """Paths were taken into the depth map's name, and OpenEXR gave a traceback."""
    READERS["histogram"].make(tmp_path / "a.h5")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    for model in (str(tmp_path / "run"), "./run", "run", "no/where", "..", "a.h5"):
        status, _, err = run(capsys, "depth", "a.h5", "--method", "network", "--model", model)
        assert status == 2 and f"--model {model!r}: expected a name" in err and "--checkpoint" in err
        assert len(err.strip().splitlines()) == 1
    status, _, err = run(capsys, "depth", "a.h5", "--method", "network", "--model", "nonne-s0")
    assert status == 2 and "model 'nonne-s0' is unknown, like none-s0" in err


def test_depth_maps_of_two_checkpoints_have_two_names():
    from scene2spad.cli.simulation.depth import Depth, depth_label

    def label(checkpoint: str) -> str:
        return depth_label(Depth(file=Path("a.h5"), method="network", checkpoint=Path(checkpoint)))

    labels = [label(name) for name in ("runs/a/model.safetensors", "runs/b/model.safetensors", "w/c.safetensors")]
    assert labels == ["network-a-model", "network-b-model", "network-c"]
    assert label("runs/a/last.safetensors") == "network-a-last"


def test_depth_maps_of_one_network_read_in_two_ways_have_two_names():
    """They overwrote one another, under one label."""
    from scene2spad.cli.simulation.depth import Depth, depth_label

    def labels(**reading: object) -> list[str]:
        common = {"file": Path("a.h5"), "method": "network", **reading}
        return [depth_label(Depth(**common, **of)) for of in ({"model": "m"}, {"checkpoint": Path("runs/m")})]

    assert labels() == ["network-m"] * 2
    assert labels(decoder="median") == ["network-m-median"] * 2
    assert labels(decoder="soft-argmax", int8=True) == ["network-m-soft-argmax-int8"] * 2
    assert labels(int8=True, int8_rule="calibrated") == ["network-m-int8"] * 2
    assert labels(int8=True, int8_rule="published") == ["network-m-int8-published"] * 2


def test_reprs_are_one_line_with_shapes_and_units(tmp_path):
    """A Scene's was 40 kB of arrays."""
    READERS["histogram"].make(tmp_path / "h.h5")
    READERS["transient"].make(tmp_path / "t.exr")
    from render.transient import read_transient

    for thing, words in (
        (load_scene("living-room"), ("triangles", "pixels", "deg")),
        (read_transient(tmp_path / "t.exr"), ("4 x 6 pixels", "returns", " m")),
        (read_histogram(tmp_path / "h.h5"), ("4 x 6 pixels", "64 bins", "ps", "detections")),
    ):
        message = repr(thing)
        assert len(message) < 250 and "\n" not in message and all(word in message for word in words), message


def test_codes_take_numpy_arrays():
    sensor = Sensor(bins=64)
    matrix = temporal_code("fourier", 8, 64, sensor)
    counts = np.random.default_rng(0).poisson(1.0, (3, 5, 64)).astype(np.int32)
    ours = encode(counts, CodingTensor("numpy", matrix.numpy()))
    assert torch.equal(ours, encode(torch.from_numpy(counts), CodingTensor("torch", matrix)))


def test_results_to_a_full_device_end_in_one_line(monkeypatch, capsys):
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    assert main(["scenes", "plane"]) == 2
    assert "No space left" in capsys.readouterr().err


def test_ctrl_c_while_libraries_are_imported_is_one_line():
    """The signal comes with the first import of the command line, half a second before it used to be answered."""
    program = """
import builtins, os, signal, sys
from scene2spad.start import script
wrapped = builtins.__import__
def importing(name, *more):
    if name.startswith("scene2spad.cli"):
        os.kill(os.getpid(), signal.SIGINT)
    return wrapped(name, *more)
builtins.__import__ = importing
sys.argv = ["scene2spad", "scenes"]
script()
"""
    _is_interrupted(program)


IN_A_DESTRUCTOR = """
    class Dying:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGINT)
    Dying()
"""
WHILE_IT_IS_HELD_BACK = """
    from render.backend.interrupts import interrupts_wait
    class Dying:
        def __del__(self):
            raise KeyboardInterrupt
    with interrupts_wait():
        Dying()
        try:
            end = time.monotonic() + 1
            while time.monotonic() < end:
                pass
        except KeyboardInterrupt:
            print("not held back", file=sys.stderr)
            raise
"""
IN_A_START_IN_C = """
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as stop:
        raise ImportError("initialization failed") from stop
"""


SWALLOWED = {"destructor": IN_A_DESTRUCTOR, "held back": WHILE_IT_IS_HELD_BACK, "start in C++": IN_A_START_IN_C}


@pytest.mark.parametrize("comes", SWALLOWED.values(), ids=SWALLOWED.keys())
def test_ctrl_c_that_python_swallows_or_renames_is_one_line(comes):
    program = f"""
import os, signal, sys, time, types
from scene2spad.start import script
def main(argv):{comes}
    while True:
        pass
sys.modules["scene2spad.cli"] = types.SimpleNamespace(main=main)
script()
"""
    _is_interrupted(program)


def _is_interrupted(program: str) -> None:
    # a shell's background job, and all that it starts, begins with the signal ignored
    heeded = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    done = run_process([sys.executable, "-c", heeded + program])
    assert done.returncode == 130 and done.stderr.count("\n") == 1 and "interrupted" in done.stderr, done.stderr


def test_the_shell_completes_commands_and_options(tmp_path, capsys):
    """Bash itself runs the script; words that are no options are left to the shell, which knows files."""
    status, script, _ = run(capsys, "--completion", "bash")
    assert status == 0
    (tmp_path / "c.bash").write_text(script)
    for words, found in ((["re"], "render report"), (["render", "--err"], "--error"), (["render", "li"], "")):
        typed = f"COMP_WORDS=(scene2spad {' '.join(words)}); COMP_CWORD={len(words)}"
        code = f"source {tmp_path}/c.bash; {typed}; _scene2spad; echo ${{COMPREPLY[@]}}"
        assert run_process(["bash", "-c", code]).stdout.strip() == found
    assert "bashcompinit" in run(capsys, "--completion", "zsh")[1]
    for words in (["--completion"], ["--completion", "fish"]):
        asked = words[1] if words[1:] else "of no shell"
        line = f"scene2spad: --completion {asked}, expected one of bash, zsh\n"
        assert run(capsys, *words)[::2] == (2, line)


def test_progress_also_speaks_when_piped(capsys):
    progress_lines(every_s=0.0)("direct light", 0.05)
    assert capsys.readouterr() == ("", "direct light: 5%\n")
    progress_lines(every_s=1e9)("direct light", 0.06)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--width", "3.5"], "--width 3.5, expected a whole number"),
        (["--seed", "1.5"], "--seed 1.5, expected a whole number"),
        (["--offset", "far"], "--offset far, expected a number"),
        (["--error", "x"], "--error x, expected a number"),
        (["--baseline", "1", "2"], "--baseline 1 2, expected 3 numbers"),
        (["--budget", "1", "y"], "--budget 1 y, expected 2 numbers"),
    ],
)
def test_what_is_no_number_is_answered_with_what_is_expected(words, message, capsys):
    status, _, err = run(capsys, "render", "plane", *words)
    assert (status, err) == (2, f"scene2spad: {message}\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--fps", "abc"], "--fps abc, expected numbers"),
        (["--photons", "5", "x"], "--photons 5 x, expected numbers"),
        (["--codes", "8", "1.5"], "--codes 8 1.5, expected whole numbers"),
        (["--pixels", "many"], "--pixels many, expected whole numbers"),
    ],
)
def test_lists_of_what_are_no_numbers_are_answered_alike(words, message, capsys):
    status, _, err = run(capsys, "ultraphase", "sweep", *words)
    assert (status, err) == (2, f"scene2spad: {message}\n")


def test_a_block_that_is_not_whole_is_answered_with_what_is_expected(capsys):
    status, _, err = run(capsys, "train", "--block", "1.5", "2", "2")
    assert (status, err) == (2, "scene2spad: --block 1.5 2 2, expected 3 whole numbers\n")


def test_a_card_says_what_was_not_recorded(capfd):
    """In words on the terminal; JSON keeps null and an empty object."""
    name = "learned-256x4x4-128x-tdc-s0"
    assert main(["models", name]) == 0
    assert "errors: not recorded\n" in capfd.readouterr().out
    assert main(["models", "none-s0"]) == 0
    out = capfd.readouterr().out
    assert "cpu_minutes: not recorded\n" in out and "7 m farther: 31, as it is: 31" in out
    assert main(["models", name, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["errors"] == {}


def test_the_models_are_a_table_and_each_limit_stands_once(capfd):
    """Every model had a line of 300 letters with the same two limits."""
    assert main(["models", "--json"]) == 0
    cards = json.loads(capfd.readouterr().out)["models"]
    assert main(["models"]) == 0
    lines = capfd.readouterr().out.splitlines()
    rows, limits = lines[2 : 2 + len(cards)], lines[3 + len(cards) : -1]
    assert [row.split()[0] for row in rows] == [card["name"] for card in cards]
    at = lines[1].index("compression")
    assert [row[at:].split()[0] for row in rows] == [f"{card['compression']:g}x" for card in cards]
    said = [limit.rpartition(" (")[0].strip() for limit in limits]
    assert len(said) == len(set(said)) and [limit.endswith(" (all)") for limit in limits[:3]] == [True, True, False]
    for card in cards:
        own = [limit for limit in limits if card["name"] in limit.rpartition(" (")[2] or limit.endswith(" (all)")]
        assert len(own) == len(card["not_for"])


def test_help_needs_no_source(capsys, monkeypatch):
    """Installed as compiled files alone, `--help` would end in a traceback."""

    def absent(thing: object) -> str:
        raise OSError("could not get source code")

    monkeypatch.setattr("scene2spad.options.common.inspect.getsource", absent)
    assert main(["inspect", "--help"]) == 0
    assert "--pixel" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_names_what_a_command_takes(name, capsys):
    """No argument is called by its type: the texts of the help speak of files, scenes and models."""
    assert main([name, "--help"]) == 0
    usage = capsys.readouterr().out.split("\n\n")[0]
    assert not {"STR", "[STR]", "PATH", "[PATH]"} & set(usage.split()), usage


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fills_its_lines_and_names_no_empty_default(name, capsys, monkeypatch):
    """The text of an option stands in one line where the terminal is wide: lines do not break as in the source."""
    monkeypatch.setenv("COLUMNS", "2000")
    assert main([name, "--help"]) == 0
    out = capsys.readouterr().out
    inside = [line.strip("│ ") for line in out.splitlines() if line.startswith("│")]
    assert not [line for line in inside if line.startswith(tuple("abcdefghijklmnopqrstuvwxyz`(.,"))]
    assert name == "report" or out.split("\n\n")[1].count("\n") == 0
    assert not [line for line in inside if "(default: )" in line or "(default: '')" in line]


STOPPING = """
import os, signal, sys, tempfile, types
from scene2spad.start import script
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job begins without
def main(argv):
    with tempfile.TemporaryDirectory(dir="."):
        os.kill(os.getpid(), signal.{name})
    return 0
sys.modules["scene2spad.cli"] = types.SimpleNamespace(main=main)
script()
"""


@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_signals_that_stop_a_command_let_it_clean_up_and_say_so_in_a_line(tmp_path, name, status):
    heard = f"import signal; signal.signal(signal.{name}, signal.SIG_DFL)\n"  # these tests, too, may run under nohup
    program = [sys.executable, "-c", heard + STOPPING.format(name=name)]
    done = run_process(program, cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (status, 1) and "interrupted" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_signal_within_generated_code_gives_its_status_too(tmp_path):
    """Imports run much of it, as for dataclasses; `python -m` ended by SIGINT then, whatever the signal."""
    stopping = STOPPING.format(name="SIGTERM").replace("os.kill(", "exec('os.kill(").replace("SIGTERM)", "SIGTERM)')")
    heard = "import signal; signal.signal(signal.SIGTERM, signal.SIG_DFL)\n"
    (tmp_path / "stopping.py").write_text(heard + stopping)
    done = run_process([sys.executable, "-m", "stopping"], cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (143, 1) and "interrupted" in done.stderr


def test_a_signal_that_is_ignored_stays_ignored(tmp_path):
    """As nohup has it: the terminal may close."""
    program = ["sh", "-c", 'trap "" HUP; exec "$@"', "sh", sys.executable, "-c", STOPPING.format(name="SIGHUP")]
    done = run_process(program, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
