"""The assembler: source text to `Program`.

One statement a line, `;` begins a comment. Numbers are decimal, 0x or 0b; constants are expressions of + - * / % and
parentheses over numbers, `.equ` names, region names (their byte address) and loop variables.

    NAME:                        label; `{h}` in a name is the value of the loop variable h
    OP operand, operand, ...     see `isa.OPS`; constants after `#`, RAM operands as [register + constant]
    .equ NAME, value             constant; one handed to `assemble` wins over it. MAX_SHIFT is the chip's
    .reg NAME, register          another name for a register, from here on; `r1 + n` is the n-th after r1
    .table NAME, kind, count[, values]   RAM filled before the program runs; kind is u8, s8 or s16
    .space NAME, kind, count     RAM that the program writes
    .for h in a..b / .end        the lines between, once for every h from a to b, both included
    .include "file"              the lines of another file; inside a loop they see its variables

Errors are InputErrors that begin with file, line and column.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from scenes.errors import InputError, require
from scenes.io.inputs import file_inside, read_text
from ultraphase.assembly.isa import BY_NAME, DIRECTIONS, REGISTERS, VALUE_BITS, Instruction
from ultraphase.assembly.program import KINDS, Program, Region
from ultraphase.assembly.source import Cursor, Line, Token, source_lines
from ultraphase.chip import ChipSpec

_REGISTER = re.compile(r"r(\d+)\Z")
_MAX_STATEMENTS = 20_000
_MAX_INCLUDES = 8  # inside one another
_MAX_NESTED = 32  # parentheses and signs, and loops
_MAX_REPEATED = 1 << 18  # lines of all loops' turns, those of loops inside others counted each time
_MAX_BYTES = 1 << 22
_MAX_VALUE = 1 << 31
_MAX_DIGITS = 64

Reader = Callable[[str], str]


def assemble(
    text: str,
    *,
    name: str = "program",
    constants: Mapping[str, int] | None = None,
    chip: ChipSpec | None = None,
    read: Reader | None = None,
) -> Program:
    """Return source to program, checked against the chip.

    name        what messages call the source
    constants   values that win over the source's `.equ`
    read        gives the text of an included file's name; without it `.include` is refused

    Raises InputError with file, line and column for a mistake in the source, and with what is over for a program that
    does not fit the chip.
    """
    assembly = _Assembly(chip or ChipSpec(), dict(constants or {}), read)
    assembly.take(source_lines(name, text))
    return assembly.program(name)


def assemble_file(
    path: Path,
    constants: Mapping[str, int] | None = None,
    chip: ChipSpec | None = None,
    name: str | None = None,
) -> Program:
    """Return `assemble` of a file, called by its own name or by `name`; files that it includes are looked for beside
    it."""
    path = Path(path)

    def read(name: str) -> str:
        return _source_text(file_inside(path.parent, name, "included file", "the program's folder"))

    assembly = _Assembly(chip or ChipSpec(), dict(constants or {}), read)
    assembly.take(source_lines(path.name, _source_text(path)))
    return assembly.program(name or path.name)


def _source_text(path: Path) -> str:
    return read_text(path, "assembler source", most_bytes=_MAX_BYTES)


class _Assembly:
    """State of an assembly while its lines are taken in order; labels are resolved last, as branches may look ahead."""

    def __init__(self, chip: ChipSpec, given: dict[str, int], read: Reader | None) -> None:
        self.chip, self.given, self.read, self.max_shift = chip, given, read, chip.max_shift
        self.values: dict[str, int] = {"MAX_SHIFT": chip.max_shift, **given}
        self.constants: set[str] = set()  # what the source defines by .equ, or reads where it was given
        self.registers = {f"r{number}": number for number in range(REGISTERS)}
        self.regions: list[Region] = []
        self.labels: dict[str, int] = {}
        self.pending: list[tuple[Cursor, Instruction, dict[str, Token]]] = []
        self.includes = self.statements = self.repeated = self.loops = 0

    def take(self, lines: list[Line]) -> None:
        """Take all lines of a file, or of one turn of a loop."""
        at = 0
        while at < len(lines):
            word = lines[at].tokens[0].text
            if word == ".for":
                body = self._body(lines, at)
                self._loop(lines[at], lines[at + 1 : body])
                at = body + 1
                continue
            self.statements += 1
            if self.statements > _MAX_STATEMENTS:
                raise lines[at].fail(1, f"more than {_MAX_STATEMENTS} statements")
            self._statement(lines[at])
            at += 1

    @staticmethod
    def _body(lines: list[Line], start: int) -> int:
        """Index of the .end that belongs to the .for at `start`."""
        depth = 0
        for at in range(start, len(lines)):
            depth += {".for": 1, ".end": -1}.get(lines[at].tokens[0].text, 0)
            if depth == 0:
                return at
        raise lines[start].fail(lines[start].tokens[0].column, ".for without .end")

    def _loop(self, head: Line, body: list[Line]) -> None:
        cursor = Cursor(head, 1)
        variable = cursor.take("name", "a loop variable")
        if cursor.take("name", "'in'").text != "in":
            raise head.fail(variable.column, "expected: .for NAME in FIRST..LAST")
        first = self._expression(cursor)
        cursor.expect("..")
        last = self._expression(cursor)
        cursor.end()
        column = head.tokens[0].column
        if self.loops >= _MAX_NESTED:
            raise head.fail(column, f".for inside {_MAX_NESTED} others, expected fewer")
        self.repeated += max(0, last - first + 1) * max(1, len(body))
        if self.repeated > _MAX_REPEATED:
            raise head.fail(column, f"loops repeat {self.repeated} lines, expected {_MAX_REPEATED} at the most")
        self.loops += 1
        for value in range(first, last + 1):
            loops = {**head.loops, variable.text: value}
            self.take([Line(line.file, line.number, line.text, line.tokens, loops) for line in body])
        self.loops -= 1

    def _statement(self, line: Line) -> None:
        cursor = Cursor(line)
        tokens = line.tokens
        while len(tokens) > cursor.at + 1 and tokens[cursor.at + 1].text == ":":
            self._label(cursor)
        if cursor.next.kind == "end":
            return
        token = cursor.take("name", "an instruction, a label or a directive")
        directive = {".equ": self._equ, ".reg": self._reg, ".table": self._region, ".space": self._region}
        if token.text == ".include":
            self._include(line)
        elif token.text in directive:
            directive[token.text](cursor, token)
            cursor.end()
        elif token.text.upper() in BY_NAME:
            self._instruction(cursor, token.text.upper())
            cursor.end()
        else:
            raise line.fail(
                token.column, f"unknown {'directive' if token.text[0] == '.' else 'instruction'} {token.text!r}"
            )

    def _label(self, cursor: Cursor) -> None:
        token = cursor.take("name", "a label")
        name = self._name(cursor.line, token)
        if name in self.labels or name in self.values or name in self.registers:
            raise cursor.line.fail(token.column, f"{name!r} is defined already")
        self.labels[name] = len(self.pending)
        cursor.expect(":")

    @staticmethod
    def _name(line: Line, token: Token) -> str:
        """Fill in the {h} of a name."""

        def value(found: re.Match[str]) -> str:
            if found[1] not in line.loops:
                raise line.fail(token.column, f"{token.text!r}: {found[1]} is no loop variable here")
            return str(line.loops[found[1]])

        return re.sub(r"\{(\w+)\}", value, token.text)

    def _include(self, line: Line) -> None:
        at = line.tokens[-1]
        if self.read is None or self.includes >= _MAX_INCLUDES or at.kind != "file":
            raise line.fail(at.column, f'.include "file" is not possible here, or more than {_MAX_INCLUDES} deep')
        try:
            text = self.read(at.text)
        except InputError as error:
            raise line.fail(at.column, str(error)) from None
        self.includes += 1
        self.take([replace(one, loops=line.loops) for one in source_lines(at.text, text)])
        self.includes -= 1

    def _new_name(self, cursor: Cursor, *, rebind: bool = False) -> str:
        token = cursor.take("name", "a name")
        name = self._name(cursor.line, token)
        taken = name in self.labels or (name in self.values and name not in self.given) or bool(_REGISTER.match(name))
        if taken or (name in self.registers and not rebind):
            raise cursor.line.fail(token.column, f"{name!r} is defined already")
        cursor.expect(",")
        return name

    def _equ(self, cursor: Cursor, token: Token) -> None:
        name = self._new_name(cursor)
        value = self._expression(cursor)
        self.constants.add(name)
        self.values[name] = self.given.get(name, value)

    def _reg(self, cursor: Cursor, token: Token) -> None:
        name = self._new_name(cursor, rebind=True)
        at = cursor.next
        number = self._expression(cursor, self.registers)
        if not 0 <= number < REGISTERS:
            raise cursor.line.fail(at.column, f"register {number} is outside r0 to r{REGISTERS - 1}")
        self.registers[name] = number

    def _region(self, cursor: Cursor, token: Token) -> None:
        at = cursor.next
        name = self._new_name(cursor)
        kind = cursor.take("name", "u8, s8 or s16")
        if kind.text not in KINDS:
            raise cursor.line.fail(kind.column, f"kind {kind.text!r}, expected one of {', '.join(KINDS)}")
        cursor.expect(",")
        count = self._expression(cursor)
        if not 1 <= count <= 1 << 20:
            raise cursor.line.fail(at.column, f"{name}: {count} values, expected 1 or more")
        values = []
        while token.text == ".table" and cursor.mark(","):
            values.append(self._expression(cursor))
        if values and len(values) != count:
            raise cursor.line.fail(at.column, f"{name}: {len(values)} values for {count} places")
        size = KINDS[kind.text].itemsize
        end = max((region.end for region in self.regions), default=0)
        address = -(-end // size) * size
        self.regions.append(Region(name, kind.text, count, address, token.text == ".table", tuple(values)))
        self.values[name] = address

    def _instruction(self, cursor: Cursor, name: str) -> None:
        fields: dict[str, int | bool] = {}
        targets: dict[str, Token] = {}
        for number, kind in enumerate(BY_NAME[name].takes):
            if number:
                cursor.expect(",")
            self._operand(cursor, kind, fields, targets)
        self.pending.append((cursor, Instruction(name, **fields), targets))  # type: ignore[arg-type]

    def _operand(self, cursor: Cursor, kind: str, fields: dict[str, int | bool], targets: dict[str, Token]) -> None:
        if kind in "dt":
            fields["rd"] = self._register(cursor)
        elif kind == "s":
            fields["rs"] = self._register(cursor)
        elif kind == "v":
            fields["constant"] = cursor.mark("#")
            fields["value"] = self._constant(cursor) if fields["constant"] else self._register(cursor)
        elif kind == "n":
            cursor.expect("#")
            at = cursor.next
            fields["value"] = self._expression(cursor)
            if not 1 <= fields["value"] <= self.max_shift:
                raise cursor.line.fail(at.column, f"shift by {fields['value']} is outside 1 to {self.max_shift}")
        elif kind == "b":
            cursor.expect("#")
            at = cursor.next
            fields["bit"] = self._expression(cursor)
            if not 0 <= fields["bit"] < 32:
                raise cursor.line.fail(at.column, f"bit {fields['bit']} is outside 0 to 31")
        elif kind == "l":
            targets["target"] = cursor.take("name", "a label")
        elif kind == "x":
            token = cursor.take("name", "a direction")
            if token.text not in DIRECTIONS:
                raise cursor.line.fail(token.column, f"direction {token.text!r}, expected {', '.join(DIRECTIONS)}")
            fields["value"] = DIRECTIONS.index(token.text)
        else:
            self._ram_operand(cursor, fields)

    def _ram_operand(self, cursor: Cursor, fields: dict[str, int | bool]) -> None:
        """Parse [register + constant] in any order, or one of the two alone."""
        cursor.expect("[")
        at, base, offset = cursor.next, None, 0
        sign = 1
        while True:
            token = cursor.next
            if token.kind == "name" and self._name(cursor.line, token) in self.registers:
                if base is not None or sign < 0:
                    raise cursor.fail("one base register at the most, and not subtracted")
                base = self._register(cursor)
            else:
                offset += sign * self._product(cursor, {})
            if cursor.mark("]"):
                break
            sign = 1 if cursor.mark("+") else -1
            if sign < 0:
                cursor.expect("-")
        fields |= {"constant": base is None, "rs": base or 0, "value": self._in_word(cursor.line, at, offset)}

    def _register(self, cursor: Cursor) -> int:
        token = cursor.take("name", "a register")
        name = self._name(cursor.line, token)
        if name not in self.registers:
            raise cursor.line.fail(token.column, f"{name!r} is no register; constants begin with #")
        return self.registers[name]

    def _constant(self, cursor: Cursor) -> int:
        at = cursor.next
        return self._in_word(cursor.line, at, self._expression(cursor))

    @staticmethod
    def _in_word(line: Line, at: Token, value: int) -> int:
        most = 1 << VALUE_BITS - 1
        if not -most <= value < most:
            raise line.fail(at.column, f"constant {value} is outside {-most} to {most - 1}")
        return value

    def _expression(self, cursor: Cursor, more: Mapping[str, int] | None = None) -> int:
        total = self._product(cursor, more or {})
        while cursor.next.kind == "mark" and cursor.next.text in ("+", "-"):
            sign = 1 if cursor.mark("+") else -1
            if sign < 0:
                cursor.expect("-")
            total += sign * self._product(cursor, more or {})
        return total

    def _product(self, cursor: Cursor, more: Mapping[str, int]) -> int:
        total = self._atom(cursor, more)
        while cursor.next.kind == "mark" and cursor.next.text in ("*", "/", "%"):
            operator = cursor.take("mark", "an operator")
            right = self._atom(cursor, more)
            if operator.text != "*" and right == 0:
                raise cursor.line.fail(operator.column, "division by zero")
            total = total * right if operator.text == "*" else total // right if operator.text == "/" else total % right
            if abs(total) >= _MAX_VALUE:
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
            value = int(token.text, base) if len(token.text) <= _MAX_DIGITS else _MAX_VALUE
            if value >= _MAX_VALUE:
                raise cursor.line.fail(token.column, f"{token.text} does not fit into 32 bits")
            return value
        token = cursor.take("name", "a number or a name")
        name = self._name(cursor.line, token)
        for known in (cursor.line.loops, self.values, more):
            if name in known:
                self.constants |= {name} & self.given.keys()
                return known[name]
        raise cursor.line.fail(token.column, f"{name!r} is not defined here")

    def _parenthesis(self, cursor: Cursor, more: Mapping[str, int]) -> int:
        cursor.expect("(")
        value = self._expression(cursor, more)
        cursor.expect(")")
        return value

    def program(self, name: str) -> Program:
        """Make the program once all labels are known: the branches find their targets; checked against the chip."""
        there = ", ".join(sorted(self.constants)) or "none"
        for given in self.given:
            known = given in self.constants
            require(known, f"--define {given}: {name} has no constant of this name, there are {there}")
        instructions = []
        for cursor, instruction, targets in self.pending:
            if targets:
                token = targets["target"]
                label = self._name(cursor.line, token)
                if label not in self.labels:
                    raise cursor.line.fail(token.column, f"label {label!r} is not defined")
                target = min(self.labels[label], 511)  # one past the store's largest is refused by Program.check
                instruction = Instruction(**{**vars(instruction), "target": target})
            instructions.append(instruction)
        places = tuple((cursor.line.file, cursor.line.number) for cursor, _, _ in self.pending)
        program = Program(name, tuple(instructions), tuple(self.regions), self.labels, places)
        program.check(self.chip)
        return program
