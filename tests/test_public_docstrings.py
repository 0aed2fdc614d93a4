"""Docstrings of all that `scene2spad` offers: shapes of arrays, units of quantities, and the errors that are raised."""

import ast
import dataclasses
import functools
import inspect
import re
import types
from collections.abc import Callable, Iterator

import pytest

import scene2spad as s2s

ARRAY = re.compile(r"\b(?:ndarray|Tensor)\b")
# (H, W), (N, 3), (B, 1, T, R, C), (H*W + 1,), (K,) and so on; or the words for arrays that have no shape of their own
SHAPE = re.compile(r"\((?:[A-Za-z0-9'.*+/ -]+,\s*)+(?:[A-Za-z0-9'.*+/ -]+)?\)|3x3|4x4|one dimension|same shape")
UNIT_IN_NAME = re.compile(
    r"_(?:m|s|hz|deg|nm|mm|px|sr|m2|j|w|v|f|bits|bytes|minutes|bit_per_s)$|_(?:db|fraction|share)(?:_|$)|_per_"
)
UNIT_IN_WORDS = re.compile(
    r"\[[^\]]+\]|\b(?:metres?|seconds?|degrees?|pixels?|photons?|detections?|joules?|Lightning's|bins?"
    r"|[Rr]elative error|[Ss]hare|[Pp]robability|[Pp]art of|efficiency|reflectance|roughness|[Aa]lpha|index|[Rr]atio"
    r"|scale|[Ww]eight|[Nn]umber|units?|[Cc]osine|cycles?|clocks?|f-number|times|rate|how often|between 0 and 1"
    r"|[Cc]ount|levels?|factor|[Tt]ransmission)\b"
)

# What still says too little, by name. A test sees that no name stands here without a reason.
# `scenes.placing` says not that Placing raises InputError, what moves_camera returns, nor the shape of camera's
# target, (3,).
OPEN: set[str] = set()


def owners() -> Iterator[tuple[str, type | Callable]]:
    for name in s2s.__all__:
        yield name, getattr(s2s, name)


def plain(thing: object) -> Callable | None:
    """The function behind a method, a property or a cached value of a class."""
    if isinstance(thing, (staticmethod, classmethod)):
        return thing.__func__
    if isinstance(thing, property):
        return thing.fget
    if isinstance(thing, functools.cached_property):
        return thing.func
    return thing if isinstance(thing, types.FunctionType) else None


def functions() -> Iterator[tuple[str, Callable, type | None]]:
    """Public functions, and public methods and properties of public classes, with the class."""
    for name, thing in owners():
        if not inspect.isclass(thing):
            yield name, thing, None
            continue
        for member, value in vars(thing).items():
            function = plain(value)
            if function is not None and not member.startswith("_"):
                yield f"{name}.{member}", function, thing


def fields() -> Iterator[tuple[str, dataclasses.Field, str]]:
    """Fields of public dataclasses, with the docstring of the class."""
    for name, thing in owners():
        if dataclasses.is_dataclass(thing):
            yield from ((f"{name}.{one.name}", one, inspect.getdoc(thing) or "") for one in dataclasses.fields(thing))


def is_quantity(hint: object) -> bool:
    return bool(re.fullmatch(r"(float|tuple\[float, .*\])( \| .*)?", str(hint)))


def told(function: Callable, owner: type | None) -> str:
    """What stands in the docstring, and for its attributes in that of the class."""
    return f"{inspect.getdoc(function) or ''}\n{(inspect.getdoc(owner) or '') if owner else ''}"


def about(name: str, text: str) -> str:
    """What a docstring says of a name: its line, what stands indented below it, and the sentence that names it."""
    lines, found = text.splitlines(), []
    for number, line in enumerate(lines):
        if re.search(rf"(?<![\w.]){re.escape(name)}\b", line):
            found.append(line)
            indent = len(line) - len(line.lstrip())
            for after in lines[number + 1 : number + 4]:
                if len(after) - len(after.lstrip()) <= indent and line.lstrip() == line and after[:1] != " ":
                    found.append(after)
                    break
                found.append(after)
    return "\n".join(found)


@functools.cache
def tree_of(module: str) -> dict[str, ast.FunctionDef]:
    """Functions of a module by name, methods as Class.method."""
    parsed = ast.parse(inspect.getsource(__import__(module, fromlist=["_"])))
    found = {node.name: node for node in parsed.body if isinstance(node, ast.FunctionDef)}
    for owner in parsed.body:
        if isinstance(owner, ast.ClassDef):
            found |= {f"{owner.name}.{one.name}": one for one in owner.body if isinstance(one, ast.FunctionDef)}
    return found


REFUSING = {"require"}


def raises_input_error(module: str, name: str, seen: frozenset[str] = frozenset()) -> bool:
    """Whether a function's source raises InputError, itself or by functions of its own module."""
    known = tree_of(module)
    if name not in known or name in seen:
        return False
    owner = name.partition(".")[0] if "." in name else ""
    for node in ast.walk(known[name]):
        if isinstance(node, ast.Raise) and node.exc is not None and "InputError" in ast.unparse(node.exc):
            return True
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in REFUSING:
                return True
            inner = called.replace("self.", f"{owner}.") if owner else called
            if raises_input_error(module, inner, seen | {name}):
                return True
    return False


def test_the_rules_find_what_is_missing():
    """Names and texts of which it is known what they say."""
    assert SHAPE.search("counts (H, W, T) int32") and SHAPE.search("(H*W + 1,) int64") and not SHAPE.search("an image")
    assert UNIT_IN_NAME.search("depth_m") and not UNIT_IN_NAME.search("radiance")
    assert UNIT_IN_WORDS.search("radiance [W/(m^2 sr nm)]") and not UNIT_IN_WORDS.search("how bright it is")
    assert about("b", "a   first\nb   second (H, W)\n    and more\nc   third").splitlines() == [
        "b   second (H, W)", "    and more", "c   third",
    ]  # fmt: skip
    assert raises_input_error("scene2spad.chain", "render") and not raises_input_error("scene2spad.chain", "models")


def without_docstrings() -> list[str]:
    said = [name for name, thing in owners() if not inspect.getdoc(thing)]
    return said + [label for label, function, _ in functions() if not function.__doc__]


def without_shapes() -> list[str]:
    """Functions that take or give arrays, and fields that are arrays, of which no shape is told."""
    missing = []
    for label, function, _ in functions():
        arrays = any(ARRAY.search(str(hint)) for hint in function.__annotations__.values())
        if arrays and not SHAPE.search(inspect.getdoc(function) or ""):
            missing.append(label)
    for label, field, text in fields():
        if ARRAY.search(str(field.type)) and not SHAPE.search(about(field.name, text)):
            missing.append(label)
    return missing


def without_units() -> list[str]:
    """Numbers that are taken, given or held, of which neither the name nor a word tells the unit."""
    missing = []
    for label, function, owner in functions():
        for name, hint in function.__annotations__.items():
            called = label.rpartition(".")[2] if name == "return" else name
            said = (inspect.getdoc(function) or "") if name == "return" else about(name, told(function, owner))
            if is_quantity(hint) and not UNIT_IN_NAME.search(called) and not UNIT_IN_WORDS.search(said):
                missing.append(label)
    for label, field, text in fields():
        told_by_name = UNIT_IN_NAME.search(field.name)
        if is_quantity(field.type) and not told_by_name and not UNIT_IN_WORDS.search(about(field.name, text)):
            missing.append(label)
    return missing


def without_errors() -> list[str]:
    """Functions, and classes by their making, that raise InputError and do not say so."""
    missing = []
    for label, function, owner in functions():
        refuses = raises_input_error(function.__module__, function.__qualname__)
        if refuses and "InputError" not in told(function, owner):
            missing.append(label)
    for name, thing in owners():
        begins = [f"{thing.__qualname__}.{one}" for one in ("__init__", "__post_init__")]
        refuses = inspect.isclass(thing) and any(raises_input_error(thing.__module__, one) for one in begins)
        if refuses and "InputError" not in (inspect.getdoc(thing) or ""):
            missing.append(name)
    return missing


RULES = (without_docstrings, without_shapes, without_units, without_errors)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_public_docstrings_hold_to(rule):
    missing = sorted({*rule()} - OPEN)
    assert not missing, "\n".join(missing)


def test_nothing_is_called_open_that_is_not():
    assert {label for rule in RULES for label in rule()} >= OPEN
