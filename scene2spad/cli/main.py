"""`scene2spad COMMAND`: parse, run, report. Bad input ends with exit status 2 and one line on stderr."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import logging
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import reduce
from operator import or_
from types import ModuleType
from typing import Annotated

import tyro

from scene2spad.cli.completion import SHELLS, completion_script
from scene2spad.interrupts import stopped
from scene2spad.options.common import Common, flow_help
from scenes.errors import InputError, did_you_mean, require
from scenes.files import finite
from scenes.io.versions import installed_version
from scenes.progress import Progress

log = logging.getLogger("scene2spad")
DESCRIPTION = (
    "From a 3D mesh scene to what a single-photon (SPAD) camera records of it, and on to depth. `--version` tells the "
    "version, `--completion bash` (or zsh) prints completions for a shell: eval it in its start-up file."
)
NARROWEST = 20  # columns; the parser's help does not come to an end in fewer than five or so
PIPED_S = 30.0  # between lines of progress where stderr is no terminal
# In the order of --help: every command and its room. `scene2spad.cli.ROOM.NAME` has the options, a class `Name`, and
# `run`; only what runs is imported.
COMMANDS = {
    "demo": "simulation",
    "scenes": "simulation",
    "render": "simulation",
    "dataset": "simulation",
    "sense": "simulation",
    "depth": "simulation",
    "inspect": "results",
    "compare": "results",
    "export": "results",
    "show": "results",
    "calibrate": "simulation",
    "train": "networks",
    "models": "networks",
    "evaluate": "networks",
    "ultraphase": "experiments",
    "study": "experiments",
    "bench": "experiments",
    "report": "experiments",
}


def main(argv: list[str]) -> int:
    """Run one command and return the exit status: 0 done, 2 bad input, 130 interrupted. Bad input never raises."""
    try:
        if argv == ["--version"]:
            print(f"scene2spad {installed_version('scene2spad')}")
            return 0
        if argv[:1] == ["--completion"]:
            return _print_completion(argv[1:])
        _check_text(argv)
        command = parse_command(argv or ["--help"])
    except InputError as error:
        return _refuse(str(error))
    except SystemExit as stop:
        return int(stop.code or 0)
    except BrokenPipeError:  # --help into a reader that has gone
        sys.stdout = None
        return 0
    _log_to_stderr()
    if command.seed < 0:
        return _refuse(f"seed {command.seed} is negative, expected 0 or more")
    try:
        with _progress() as progress:
            result = runner_of(argv[0])(command, progress)
    except InputError as error:
        return _refuse(str(error))
    except OSError as error:
        return _refuse(f"{error.filename or 'file system'}: {error.strerror or error}")
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        return _refuse("out of memory: use a smaller image or batch, or fewer samples")
    except KeyboardInterrupt:
        return stopped()
    try:
        print(json.dumps(finite(result), allow_nan=False) if command.json else _format_result(result), flush=True)
    except BrokenPipeError:
        sys.stdout = None  # the reader has gone: Python must not try to flush again
    except OSError as error:
        sys.stdout = None
        return _refuse(f"standard output: {error.strerror or error}")
    return 0


def _is_out_of_memory(error: MemoryError | RuntimeError) -> bool:
    """Tell whether memory ran out: PyTorch has an error of its own for GPUs, and only a message for the processor."""
    torch = sys.modules.get("torch")
    on_gpu = torch is not None and isinstance(error, torch.cuda.OutOfMemoryError)
    return isinstance(error, MemoryError) or on_gpu or "can't allocate memory" in str(error)


def options_of(name: str) -> type[Common]:
    """Return the class of a command's options; its module is imported now."""
    options: type[Common] = getattr(_module_of(name), name.capitalize())
    return options


def runner_of(name: str) -> Callable[[Common, Progress], dict]:
    """Return the function that runs a command."""
    run: Callable[[Common, Progress], dict] = _module_of(name).run
    return run


def _module_of(name: str) -> ModuleType:
    return importlib.import_module(f"scene2spad.cli.{COMMANDS[name]}.{name}")


def _check_text(argv: list[str]) -> None:
    """Raise InputError for a word that is no text in this locale, as names of files may be: not every library takes
    such names. So for an empty one: as a file it would be the current folder."""
    for word in argv:
        empty = not word or (word.startswith("--") and word.endswith("="))
        require(not empty, f"{word or repr(word)} is empty, expected a value; is a variable of the shell unset?")
        cure = f"is no {sys.getfilesystemencoding()} text; rename the file, or set a locale that has its letters"
        require(word.encode("utf-8", "ignore").decode() == word, f"{word}: {cure}")


def _check_words(argv: list[str]) -> None:
    """Raise InputError for a command or an option that does not exist, with the one that was probably meant."""
    name = argv[0]
    if name.startswith("-"):
        require(name in ("-h", "--help"), f"no option {name}{did_you_mean(name, ('--help', '--version'))}")
        return
    require(name in COMMANDS, f"no command {name!r}{did_you_mean(name, COMMANDS)} (there are {', '.join(COMMANDS)})")
    options = option_words(name)
    for word in argv[1:]:
        option = word.partition("=")[0].replace("_", "-")
        if option.startswith("--") and option not in options:
            raise InputError(
                f"{name}: no option {option}{did_you_mean(option, options)} (see scene2spad {name} --help)"
            )
    _check_given_once(name, argv[1:])


def _check_given_once(name: str, words: list[str]) -> None:
    """Raise InputError for an option that stands twice, of which the parser would take the last one's values alone, and
    for one without a value that would change nothing."""
    given: set[str] = set()
    lists = {_option(one.name): one.default for one in fields(options_of(name)) if "..." in str(one.type)}
    for word, following in zip(words, [*words, "--"][1:], strict=True):
        option = word.partition("=")[0].replace("_", "-")
        if option.startswith("--") and option != "--help":
            hint = f"; write all its values behind one {option}" if option in lists else ", expected once"
            require(option not in given, f"{name}: {option} is given twice{hint}")
            given.add(option)
            # with a default of its own, none is an answer: no baselines
            without = lists.get(option) == () and "=" not in word and following.startswith("--")
            require(not without, f"{name}: {option} has no value; is a variable of the shell unset?")


def option_words(name: str) -> set[str]:
    """Return the words that a command takes as options, with their dashes."""
    known = fields(options_of(name))
    options = {_option(field.name) for field in known}
    return (
        options
        | {f"--no-{field.name.replace('_', '-')}" for field in known if field.type in ("bool", bool)}
        | {"--help"}
    )


def _option(field: str) -> str:
    return f"--{field.rstrip('_').replace('_', '-')}"


def _print_completion(argv: list[str]) -> int:
    shell = " ".join(argv)
    require(shell in SHELLS, f"--completion {shell or 'of no shell'}, expected one of {', '.join(SHELLS)}")
    print(completion_script(shell, {name: sorted(option_words(name)) for name in COMMANDS}), end="")
    return 0


def parse_command(argv: list[str]) -> Common:
    """Return the command that words of the command line name, with its options.

    Raises SystemExit: 2 after one line on stderr for words that are none, 0 after `--help`.
    """
    _check_words(argv)
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    usage = io.StringIO()
    try:
        with contextlib.redirect_stderr(usage):
            if argv[0] in COMMANDS:
                if {"-h", "--help"} & {*argv}:
                    flow_help(options_of(argv[0]))
                return tyro.cli(options_of(argv[0]), prog=f"scene2spad {argv[0]}", args=argv[1:])
            every = [Annotated[options_of(name), tyro.conf.subcommand(name)] for name in COMMANDS]
            return tyro.cli(reduce(or_, every), prog="scene2spad", description=DESCRIPTION, args=argv)
    except SystemExit as stop:
        if stop.code:
            print(f"scene2spad: {_one_line(usage.getvalue())}", file=sys.stderr)
            raise SystemExit(2) from None
        sys.stderr.write(usage.getvalue())
        raise


def _one_line(box: str) -> str:
    """tyro explains errors in a box of several lines: its sentences in one line."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    written = plain.splitlines()
    if plain.startswith(("╭", " ")):  # the box's title, which stands again in the first sentence; a space without UTF-8
        written = written[1:]
    lines = [re.sub(r"[│╭╮╰╯─|]+", " ", line).strip() for line in written]
    text = " ".join(line for line in lines if line and not set(line) <= set("-=_ "))
    text = re.sub(r"\s+", " ", text).removeprefix("Parsing error ").removeprefix("Invalid choice ").strip()
    choice = re.search(r"invalid choice '(.*?)' for argument '.*?'\. Expected one of \((.*?)\)", text)
    if choice is not None:
        # an option that may stay open has None among its choices, in any order
        known = sorted(set(re.findall(r"'(.*?)'", choice[2])) - {"None"})
        expected = choice[0].replace(choice[2], ", ".join(map(repr, known)))
        text = text.replace(choice[0], f"{expected}{did_you_mean(choice[1], known)}", 1)
    text = _unparsed(text) or text
    text = re.sub(r" no type matching .*?could be instantiated from (\[.*?\])\. Got errors.*", r" cannot be \1", text)
    return re.sub(r"For full helptext, run:? (.*)$", r"(see \1)", text) or "bad command line; see scene2spad --help"


def _unparsed(text: str) -> str:
    """Return what an option of numbers was given and what it takes instead, or "" where tyro says something else."""
    found = re.search(r"Error parsing (--[\w-]+): (.*?) (?:Got errors|Argument helptext)", text)
    if found is None or "..." in found[2]:
        return ""
    implied = {"for int()": ["INT"], "to float": ["FLOAT"]}
    metavar = re.search(rf"Argument helptext: {found[1]}((?: (?:INT|FLOAT))+)", text)
    named = re.findall(r"\b(?:INT|FLOAT)\b", found[2] if metavar is None else metavar[1])
    kinds = named or next((k for w, k in implied.items() if w in found[2]), [])
    given = " ".join(re.findall(r"'(.*?)'", found[2]))
    several = re.search(rf"Argument helptext: {found[1]} \[(INT|FLOAT) \[", text)
    if several is not None and given:
        return f"{found[1]} {given}, expected {'whole ' if several[1] == 'INT' else ''}numbers"
    if not kinds or not given:
        return ""
    what = "whole number" if kinds[0] == "INT" else "number"
    return f"{found[1]} {given}, expected {f'a {what}' if len(kinds) == 1 else f'{len(kinds)} {what}s'}"


def _refuse(reason: str) -> int:
    print(f"scene2spad: {' '.join(reason.split())}", file=sys.stderr)
    return 2


def _format_result(result: dict) -> str:
    return "\n".join(f"{key}: {_format_value(value)}" for key, value in result.items())


def _format_value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        flat = all(isinstance(item, (int, float)) for item in value.values())
        formatted = [f"{key}: {_format_value(item)}" for key, item in value.items()]
        return ", ".join(formatted) if flat else "".join(f"\n  {item}".replace("\n", "\n  ") for item in formatted)
    if isinstance(value, (list, tuple)) and all(isinstance(item, (int, float)) for item in value):
        return " ".join(map(_format_value, value))
    if isinstance(value, (list, tuple)):
        return "".join(f"\n  {_format_value(item)}" for item in value)
    return str(value)


def _log_to_stderr() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    for name in ("scene2spad", "render", "spad", "csph"):
        logger = logging.getLogger(name)
        logger.handlers[:] = [handler]
        logger.setLevel(logging.INFO)
        logger.propagate = False


@contextlib.contextmanager
def _progress() -> Iterator[Progress]:
    """Yield a progress bar on stderr, and the function that moves it; where stderr is piped, a line now and then."""
    if not sys.stderr.isatty():
        yield progress_lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("start", total=1.0)
        yield lambda what, fraction: bar.update(task, description=what, completed=fraction)


def progress_lines(every_s: float = PIPED_S) -> Progress:
    """Return a progress that prints a line where the last one, or the start, is `every_s` ago."""
    last_s = time.monotonic()

    def report(what: str, fraction: float) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= every_s:
            last_s = time.monotonic()
            print(f"{what}: {fraction:.0%}", file=sys.stderr, flush=True)

    return report
