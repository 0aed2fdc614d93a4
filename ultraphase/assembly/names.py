"""Resolve the names of a source, and constant expressions: numbers, `.equ` names, RAM addresses, loop variables."""

from __future__ import annotations

import re
from collections.abc import Mapping

from scenes.errors import require
from ultraphase.assembly.isa import REGISTERS
from ultraphase.assembly.source import Cursor, Line, Token

_REGISTER = re.compile(r"r(\d+)\Z")
_MAX_NESTED = 32  # parentheses and signs
MAX_VALUE = 1 << 31
_MAX_DIGITS = 64


def name_of(line: Line, token: Token) -> str:
    """Return a name with its {h} filled in, the value of the loop variable h."""

    def value(found: re.Match[str]) -> str:
        if found[1] not in line.loops:
            raise line.fail(token.column, f"{token.text!r}: {found[1]} is no loop variable here")
        return str(line.loops[found[1]])

    return re.sub(r"\{(\w+)\}", value, token.text)


class Names:
    """Hold what the names of a source stand for, as far as its lines were read.

    given   constants of the caller; each wins over the source's `.equ`, and must be one that the source has
    """

    def __init__(self, given: Mapping[str, int], chips: Mapping[str, int]) -> None:
        self.given = given
        self.values: dict[str, int] = {**chips, **given}
        self.defined = set(chips)  # names of `values` that are taken
        self.constants: set[str] = set()  # what the source defines by .equ, or reads where it was given
        self.registers = {f"r{number}": number for number in range(REGISTERS)}
        self.labels: dict[str, int] = {}

    def new(self, cursor: Cursor, what: str) -> str:
        """Take a name that a directive defines, and the comma behind it; `what` it names: a constant, a register, a
        part of RAM."""
        token = cursor.take("name", "a name")
        name = name_of(cursor.line, token)
        taken = name in self.labels or name in self.defined or bool(_REGISTER.match(name))
        if taken or (name in self.registers and what != "a register"):
            raise cursor.line.fail(token.column, f"{name!r} is defined already")
        self._not_given(cursor.line, token, name, what)
        cursor.expect(",")
        return name

    def _not_given(self, line: Line, token: Token, name: str, what: str) -> None:
        """Raise InputError where a name that was given as a constant is something else in the source."""
        if name in self.given and what != "a constant":
            raise line.fail(token.column, f"--define {name}: {name!r} is {what} here, expected a constant (.equ)")

    def define(self, name: str, value: int, *, constant: bool = False) -> None:
        """Enter the address of a part of RAM, or a constant, where a given one wins."""
        self.defined.add(name)
        self.values[name] = self.given.get(name, value) if constant else value
        if constant:
            self.constants.add(name)

    def label(self, cursor: Cursor, word: int) -> None:
        """Take a label and its colon: it stands for the next word."""
        token = cursor.take("name", "a label")
        name = name_of(cursor.line, token)
        if name in self.labels or name in self.defined or name in self.registers:
            raise cursor.line.fail(token.column, f"{name!r} is defined already")
        self._not_given(cursor.line, token, name, "a label")
        self.labels[name] = word
        cursor.expect(":")

    def register(self, cursor: Cursor) -> int:
        """Take the name of a register, and return its number."""
        token = cursor.take("name", "a register")
        name = name_of(cursor.line, token)
        if name not in self.registers:
            raise cursor.line.fail(token.column, f"{name!r} is no register; constants begin with #")
        return self.registers[name]

    def at_register(self, cursor: Cursor) -> bool:
        """Return whether the next token names a register."""
        token = cursor.next
        return token.kind == "name" and name_of(cursor.line, token) in self.registers

    def check_given(self, program: str) -> None:
        """Raise InputError for a given constant that the source neither defines nor reads."""
        there = ", ".join(sorted(self.constants)) or "none"
        for name in self.given:
            known = name in self.constants
            require(known, f"--define {name}: {program} has no constant of this name, there are {there}")

    def expression(self, cursor: Cursor, more: Mapping[str, int] | None = None) -> int:
        """Take sums and differences of products; `more` names count beside the constants."""
        total = self.product(cursor, more or {})
        while cursor.next.kind == "mark" and cursor.next.text in ("+", "-"):
            sign = 1 if cursor.mark("+") else -1
            if sign < 0:
                cursor.expect("-")
            total += sign * self.product(cursor, more or {})
        return total

    def product(self, cursor: Cursor, more: Mapping[str, int]) -> int:
        """Take products, quotients and remainders; division rounds down."""
        total = self._atom(cursor, more)
        while cursor.next.kind == "mark" and cursor.next.text in ("*", "/", "%"):
            operator = cursor.take("mark", "an operator")
            right = self._atom(cursor, more)
            if operator.text != "*" and right == 0:
                raise cursor.line.fail(operator.column, "division by zero")
            total = total * right if operator.text == "*" else total // right if operator.text == "/" else total % right
            if abs(total) >= MAX_VALUE:
                raise cursor.line.fail(operator.column, f"{total} does not fit into 32 bits")
        return total

    def _atom(self, cursor: Cursor, more: Mapping[str, int]) -> int:
        if cursor.depth > _MAX_NESTED:
            raise cursor.fail(f"more than {_MAX_NESTED} parentheses or signs deep")
        if cursor.next.text in ("-", "("):
            cursor.depth += 1
            negative = cursor.mark("-")
            value = -self._atom(cursor, more) if negative else self._parenthesis(cursor, more)
            cursor.depth -= 1
            return value
        token = cursor.next
        if token.kind == "number":
            cursor.at += 1
            base = {"0x": 16, "0b": 2}.get(token.text[:2].lower(), 10)
            # Python refuses to convert very long decimals
            value = int(token.text, base) if len(token.text) <= _MAX_DIGITS else MAX_VALUE
            if value >= MAX_VALUE:
                raise cursor.line.fail(token.column, f"{token.text} does not fit into 32 bits")
            return value
        token = cursor.take("name", "a number or a name")
        name = name_of(cursor.line, token)
        for known in (cursor.line.loops, self.values, more):
            if name in known:
                if known is self.values:  # a loop variable of the same name is another number
                    self.constants |= {name} & self.given.keys()
                return known[name]
        raise cursor.line.fail(token.column, f"{name!r} is not defined here")

    def _parenthesis(self, cursor: Cursor, more: Mapping[str, int]) -> int:
        cursor.expect("(")
        value = self.expression(cursor, more)
        cursor.expect(")")
        return value
