"""Define the parts that the options of all commands are made of. No torch, no Mitsuba: --help must be quick."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional as Positional

from scenes.errors import InputError


def may_stay_open(metavar: str) -> object:
    """Return an option that may stay open: its help says itself what happens then."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


def word(metavar: str) -> object:
    """Return a positional argument with the name that its help calls it by."""
    return tyro.conf.arg(metavar=metavar)


def required_word(metavar: str) -> object:
    """Return a positional argument of several values that must not stay open, with the name that its help has."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="(required)")


WITHOUT_HINT = tyro.conf.arg(help_behavior_hint="")  # of an empty default, where "(default: )" would tell nothing

Metres = tuple[float, float, float] | None
Pixels = Annotated[int | None, may_stay_open("PIXELS")]
Count = Annotated[int | None, may_stay_open("N")]
Number = Annotated[float | None, may_stay_open("X")]
Mode = Annotated[Literal["flood", "line", "scan"] | None, may_stay_open("{flood,line,scan}")]
Offset = Literal["time", "ray", "rigid"]
File = Annotated[Path | None, may_stay_open("FILE")]
GivenFile = Annotated[Path, word("FILE")]


@dataclass(frozen=True, kw_only=True)
class Common:
    seed: int = 0
    """Seed of everything random; the same seed gives the same bytes."""
    json: bool = False
    """Print one JSON object as the last line of stdout, and nothing else there."""


@dataclass(frozen=True, kw_only=True)
class Long(Common):
    """Options of commands that may take long."""

    dry_run: bool = False
    """Say what would be done, in which memory and about how long, and write nothing."""


def only_for(command: Common, where: str, options: Mapping[str, tuple[bool, str]]) -> None:
    """Refuse options that were given where they mean nothing.

    `where`: file or command that the message names. `options`: by the field's name, whether the option means
    something here, and what it is for, as in `{"view": (kind == "pack", "a pack")}`. An option was given where its
    value is not the default. Raises InputError.
    """
    defaults = {field.name: field.default for field in fields(command)}
    for name, (means_something, purpose) in options.items():
        value = getattr(command, name)
        if not means_something and value != defaults[name]:
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            words = (f"{one:g}" if isinstance(one, float) else str(one) for one in values)
            option = " ".join([f"--{name.replace('_', '-')}", *words])
            raise InputError(f"{where}: {option} is for {purpose}")


def check_indirect(command: Common, where: str, bounces: int | None, options: Sequence[str]) -> None:
    """Raise InputError for options of indirect light, by their fields' names, where only direct light is rendered."""
    only_for(command, where, dict.fromkeys(options, (bounces != 1, "indirect light (--bounces above 1)")))


def flow_help(options: type[Common]) -> None:
    """Give the parser the text of every option as one paragraph, of which it would keep the line breaks otherwise."""
    texts: dict[str, str] = {}
    for kind in options.__mro__[-2::-1]:
        try:
            (definition,) = ast.parse(inspect.getsource(kind)).body
        except OSError:  # installed without its source, of which the texts are a part: there are none to flow
            return
        assert isinstance(definition, ast.ClassDef)
        for field, text in pairwise(definition.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                texts[ast.unparse(field.target)] = " ".join(str(text.value.value).split())
    for one in fields(options):
        one.metadata = MappingProxyType({**one.metadata, "help": texts[one.name]})
